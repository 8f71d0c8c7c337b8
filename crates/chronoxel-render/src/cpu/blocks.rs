//! Which blocks of a brick can be seen, and how far it is to the nearest that can.

/// For each block, `[z, y, x]`, the distance to the nearest that can be seen, in blocks and along the axis in which it
/// is largest: 0 for those that can be seen themselves. `None` where all can.
///
/// * `is_visible`: one flag per block, 1 where it can be seen
/// * `along_edge`: blocks along an edge of the brick
pub(super) fn distances(mut is_visible: Vec<u8>, along_edge: usize) -> Option<Vec<f32>> {
    if is_visible.iter().all(|v| *v == 1) {
        return None;
    }
    let mut distances = vec![0u8; is_visible.len()];
    for _ in 0..along_edge {
        distances.iter_mut().zip(&is_visible).for_each(|(distance, v)| *distance += 1 - v);
        for stride in [1, along_edge, along_edge * along_edge] {
            is_visible = dilated(&is_visible, stride, along_edge);
        }
    }
    Some(distances.into_iter().map(f32::from).collect())
}

/// Lowest and highest blocks that can be seen, along x, y, z.
///
/// * `is_visible`: as in [`distances`], at least one set
pub(super) fn extent(is_visible: &[u8], along_edge: usize) -> [[usize; 3]; 2] {
    let (mut low, mut high) = ([along_edge; 3], [0; 3]);
    for (i, _) in is_visible.iter().enumerate().filter(|(_, v)| **v == 1) {
        let place = [i % along_edge, i / along_edge % along_edge, i / (along_edge * along_edge)];
        low = std::array::from_fn(|a| low[a].min(place[a]));
        high = std::array::from_fn(|a| high[a].max(place[a]));
    }
    [low, high]
}

/// Flags set where they are, or where one of the two neighbours along an axis is.
fn dilated(flags: &[u8], stride: usize, along_edge: usize) -> Vec<u8> {
    let mut wider = flags.to_vec();
    for (line, wider) in
        flags.chunks_exact(stride * along_edge).zip(wider.chunks_exact_mut(stride * along_edge))
    {
        let num = line.len() - stride;
        wider[stride..].iter_mut().zip(&line[..num]).for_each(|(w, before)| *w |= before);
        wider[..num].iter_mut().zip(&line[stride..]).for_each(|(w, after)| *w |= after);
    }
    wider
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_found_by_trying_all() {
        let edge = 8;
        for seed in 1..40usize {
            let is_visible: Vec<u8> = (0..edge * edge * edge)
                .map(|i| u8::from((i * 7919 + seed * 104_729) % 211 < seed % 5))
                .collect();
            let place = |i: usize| [i % edge, i / edge % edge, i / (edge * edge)];
            let expected: Vec<f32> = (0..is_visible.len())
                .map(|i| {
                    let seen = (0..is_visible.len()).filter(|&j| is_visible[j] == 1);
                    let distance =
                        |j: usize| (0..3).map(|a| place(i)[a].abs_diff(place(j)[a])).max().unwrap_or(0);
                    seen.map(distance).min().unwrap_or(edge) as f32
                })
                .collect();
            if is_visible.contains(&1) {
                let [low, high] = extent(&is_visible, edge);
                for a in 0..3 {
                    let seen = (0..is_visible.len()).filter(|&j| is_visible[j] == 1).map(|j| place(j)[a]);
                    assert_eq!((seen.clone().min(), seen.max()), (Some(low[a]), Some(high[a])));
                }
            }
            assert_eq!(distances(is_visible, edge).unwrap(), expected);
        }
        assert_eq!(distances(vec![1; 8], 2), None);
    }
}
