//! A first table by splitting: the cell of largest squared error is cut in two across its longest axis, again and
//! again.

/// Rounds of power iteration for the longest axis of a cell: its direction need not be exact.
const POWER_ROUNDS: usize = 6;

/// A cell: a run of the vectors, its mean, and its squared error about the mean.
struct Cell {
    start: usize,
    end: usize,
    mean: Vec<f32>,
    squared_error: f64,
}

/// Up to `num_entries` entries, `[entry, t]`: the means of cells of the vectors.
///
/// Fewer where the vectors have fewer distinct values.
///
/// * `vectors`: `[vector, t]`; their order is changed
pub fn split(vectors: &mut [f32], num_steps: usize, num_entries: usize) -> Vec<f32> {
    let mut cells = vec![Cell::new(vectors, num_steps, 0, vectors.len() / num_steps)];
    while cells.len() < num_entries {
        let largest = (0..cells.len())
            .reduce(|a, b| if cells[b].squared_error > cells[a].squared_error { b } else { a });
        let Some(at) = largest.filter(|&at| cells[at].squared_error > 0.0) else { break };
        let cell = &cells[at];
        let middle = cell.cut(vectors, num_steps);
        if middle == cell.start || middle == cell.end {
            cells[at].squared_error = 0.0;
            continue;
        }
        let upper = Cell::new(vectors, num_steps, middle, cell.end);
        cells[at] = Cell::new(vectors, num_steps, cell.start, middle);
        cells.push(upper);
    }
    cells.into_iter().flat_map(|cell| cell.mean).collect()
}

impl Cell {
    fn new(vectors: &[f32], num_steps: usize, start: usize, end: usize) -> Self {
        let members = || vectors[start * num_steps..end * num_steps].chunks_exact(num_steps);
        let mut sums = vec![0.0f64; num_steps];
        members().for_each(|v| sums.iter_mut().zip(v).for_each(|(sum, &x)| *sum += f64::from(x)));
        let mean: Vec<f32> = sums.iter().map(|sum| (sum / (end - start) as f64) as f32).collect();
        let mut errors = vec![0.0f32; num_steps];
        members().for_each(|v| {
            for ((error, &x), &m) in errors.iter_mut().zip(v).zip(&mean) {
                *error += (x - m) * (x - m);
            }
        });
        let squared_error = errors.into_iter().map(f64::from).sum();
        Self { start, end, mean, squared_error }
    }

    /// Moves the members beyond the mean along the longest axis to the end, and says where they begin.
    fn cut(&self, vectors: &mut [f32], num_steps: usize) -> usize {
        let members = &mut vectors[self.start * num_steps..self.end * num_steps];
        let axis = self.longest_axis(members, num_steps);
        let along =
            |v: &[f32]| v.iter().zip(&self.mean).zip(&axis).map(|((x, m), a)| (x - m) * a).sum::<f32>() > 0.0;
        let (mut low, mut high) = (0, members.len() / num_steps);
        while low < high {
            if !along(&members[low * num_steps..][..num_steps]) {
                low += 1;
            } else {
                high -= 1;
                (0..num_steps).for_each(|t| members.swap(low * num_steps + t, high * num_steps + t));
            }
        }
        self.start + low
    }

    /// The main axis of the covariance of the members, by power iteration; its length means nothing.
    fn longest_axis(&self, members: &[f32], num_steps: usize) -> Vec<f32> {
        let mut covariance = vec![0.0f32; num_steps * num_steps];
        let mut difference = vec![0.0f32; num_steps];
        for v in members.chunks_exact(num_steps) {
            for ((d, &x), &m) in difference.iter_mut().zip(v).zip(&self.mean) {
                *d = x - m;
            }
            for (row, &a) in covariance.chunks_exact_mut(num_steps).zip(&difference) {
                row.iter_mut().zip(&difference).for_each(|(c, &b)| *c += a * b);
            }
        }
        let diagonal = |t: usize| covariance[t * num_steps + t];
        let first = (0..num_steps).reduce(|a, b| if diagonal(b) > diagonal(a) { b } else { a }).unwrap_or(0);
        let mut axis = covariance[first * num_steps..][..num_steps].to_vec();
        for _ in 0..POWER_ROUNDS {
            let largest = axis.iter().fold(0.0f32, |a, b| a.max(b.abs()));
            if largest == 0.0 {
                break;
            }
            axis.iter_mut().for_each(|a| *a /= largest);
            let next = covariance.chunks_exact(num_steps);
            axis = next.map(|row| row.iter().zip(&axis).map(|(c, a)| c * a).sum()).collect();
        }
        axis
    }
}
