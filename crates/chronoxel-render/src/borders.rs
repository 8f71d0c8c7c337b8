//! Filtering across the borders of levels: bricks beside coarser ones meet them without a jump.
//!
//! A sample of a brick that lies in the closed box of what is drawn coarser takes the value that is drawn there (as lamar1999's
//! transition textures, in the brick's own border). Samples of finer levels divide the cells of coarser ones, so that what the finer
//! brick interpolates on a face that both share is what the coarser one does: the picture's field is continuous there. Which sample
//! changes, and to what, follows from its place alone: neighbours of the same level change alike. Where coarser
//! samples without data would have a part, a sample keeps its own value; so a linear field stays linear up to the boundary of the data.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use chronoxel_core::{BrickLayout, NodeId};
use rayon::prelude::*;

use crate::{DrawBrick, DrawHow, PreparedBrick};

/// For each entry of a draw list, those of coarser nodes that its samples reach.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LevelBorders {
    coarser: Vec<Vec<usize>>,
}

impl LevelBorders {
    /// Of the entries of a draw list.
    ///
    /// * `entries`: the node of each, and its box; boxes are those of nodes, and do not overlap
    pub fn new(entries: &[(NodeId, [[f64; 3]; 2])], layout: &BrickLayout) -> Self {
        let boxes = Boxes::new(entries, layout);
        let coarser = entries.par_iter().map(|&(node, region)| {
            let mut found = Vec::new();
            boxes.collect(reach(node, region, layout), &mut found);
            found.retain(|&other| entries[other].0.level > node.level);
            // The coarsest is the last: its values hold where several meet.
            found.sort_unstable_by_key(|&other| (entries[other].0.level, other));
            found
        });
        Self { coarser: coarser.collect() }
    }

    /// Entries of coarser nodes that the samples of an entry reach, coarsest last.
    pub fn coarser_than(&self, entry: usize) -> &[usize] {
        &self.coarser[entry]
    }

    /// Adds to entries all those that they depend on, directly or through others; ascending, without the entries themselves.
    pub fn needed_by(&self, entries: Range<usize>) -> Vec<usize> {
        let mut is_needed = vec![false; self.coarser.len()];
        let mut open: Vec<usize> = entries.clone().collect();
        while let Some(entry) = open.pop() {
            for &other in &self.coarser[entry] {
                if !std::mem::replace(&mut is_needed[other], true) {
                    open.push(other);
                }
            }
        }
        (0..is_needed.len()).filter(|entry| is_needed[*entry] && !entries.contains(entry)).collect()
    }
}

/// The draw list whose bricks meet coarser ones without a jump.
///
/// * `borders`: of the same list
/// * `ranges`: of entries that are drawn as a constant or not at all, the range of the values that look like that, where it is known
pub fn filter_level_borders(
    bricks: &[DrawBrick],
    borders: &LevelBorders,
    ranges: &(dyn Fn(usize) -> Option<[f64; 2]> + Sync),
) -> Vec<DrawBrick> {
    let mut filtered = bricks.to_vec();
    let mut order: Vec<usize> = (0..bricks.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(bricks[i].node.level));
    // Coarsest first: what a brick takes from a coarser one is what that one shows in the end.
    for of_level in order.chunk_by(|&a, &b| bricks[a].node.level == bricks[b].node.level) {
        let changed: Vec<_> = of_level
            .par_iter()
            .map_init(Changes::default, |changes, &i| {
                Some((i, changed_brick(&filtered, i, borders.coarser_than(i), ranges, changes)?))
            })
            .flatten()
            .collect();
        for (i, brick) in changed {
            filtered[i].how = DrawHow::Samples(Arc::new(brick));
        }
    }
    filtered
}

/// A brick with the values of the coarser ones around it; `None` where nothing changes.
fn changed_brick(
    bricks: &[DrawBrick],
    entry: usize,
    coarser: &[usize],
    ranges: &(dyn Fn(usize) -> Option<[f64; 2]> + Sync),
    changes: &mut Changes,
) -> Option<PreparedBrick> {
    let DrawBrick { node, region, how: DrawHow::Samples(prepared) } = &bricks[entry] else { return None };
    changes.begin(prepared.layout());
    for &other in coarser {
        let neighbour = &bricks[other];
        let shared = Shared::new(*node, *region, neighbour.region, prepared.layout());
        match (&neighbour.how, ranges(other)) {
            (DrawHow::Samples(coarse), _) => shared.take(&CoarseField::new(coarse, neighbour.node), changes),
            (_, Some(range)) => shared.clamp(prepared, range, changes),
            (_, None) => {}
        }
    }
    (!changes.changed.is_empty()).then(|| prepared.with_values(&changes.changed, &changes.values))
}

/// The values that samples of a brick change to.
#[derive(Default)]
struct Changes {
    /// NaN where one stays.
    values: Vec<f64>,
    changed: Vec<usize>,
}

impl Changes {
    fn begin(&mut self, layout: &BrickLayout) {
        self.changed.drain(..).for_each(|index| self.values[index] = f64::NAN);
        self.values.resize(layout.num_full(), f64::NAN);
    }

    fn set(&mut self, index: usize, value: f64) {
        if self.values[index].is_nan() {
            self.changed.push(index);
        }
        self.values[index] = value;
    }
}

/// The box around the samples of a node that its drawing in `region` may use, voxels of level 0.
fn reach(node: NodeId, region: [[f64; 3]; 2], layout: &BrickLayout) -> [[f64; 3]; 2] {
    let scale = (1u64 << node.level) as f64;
    [
        region[0].map(|v| v - scale * layout.low as f64),
        region[1].map(|v| v + scale * (layout.high - 1) as f64),
    ]
}

/// The samples of a node that lie in the closed box of a neighbour: ranges along the axes of its full brick.
struct Shared {
    along: [Range<usize>; 3],
    full: usize,
    /// Of the full brick's first sample, in samples of the node.
    first: [f64; 3],
    scale: f64,
}

impl Shared {
    fn new(node: NodeId, region: [[f64; 3]; 2], neighbour: [[f64; 3]; 2], layout: &BrickLayout) -> Self {
        let scale = (1u64 << node.level) as f64;
        let reach = reach(node, region, layout);
        let full = layout.full_edge();
        let first = node.brick().map(|b| f64::from(b) * layout.edge as f64 - layout.low as f64);
        let along = std::array::from_fn(|a| {
            let from = (reach[0][a].max(neighbour[0][a]) / scale).ceil() - first[a];
            let to = (reach[1][a].min(neighbour[1][a]) / scale).floor() - first[a];
            from.max(0.0) as usize..((to + 1.0).max(0.0) as usize).min(full)
        });
        Self { along, full, first, scale }
    }

    /// The values of a coarser brick.
    fn take(&self, coarse: &CoarseField<'_>, changes: &mut Changes) {
        let [x, y, z] = [0, 1, 2].map(|a| {
            let place = |i: usize| coarse.along(a, (self.first[a] + i as f64) * self.scale);
            self.along[a].clone().map(|i| (i, place(i))).collect::<Vec<_>>()
        });
        for &(k, at_z) in &z {
            for &(j, at_y) in &y {
                for &(i, at_x) in &x {
                    if let Some(value) = coarse.between([at_x, at_y, at_z]) {
                        changes.set(i + self.full * (j + self.full * k), value);
                    }
                }
            }
        }
    }

    /// The own values, within a range.
    fn clamp(&self, prepared: &PreparedBrick, [low, high]: [f64; 2], changes: &mut Changes) {
        let [x, y, z] = &self.along;
        for k in z.clone() {
            for j in y.clone() {
                for i in x.clone() {
                    let index = i + self.full * (j + self.full * k);
                    let changed = changes.values[index];
                    let own = if changed.is_nan() { prepared.value(index) } else { changed };
                    if !(low..=high).contains(&own) {
                        changes.set(index, own.max(low).min(high));
                    }
                }
            }
        }
    }
}

/// A coarse brick as it is drawn: what it interpolates.
struct CoarseField<'a> {
    brick: &'a PreparedBrick,
    origin: [f64; 3],
    per_voxel: f64,
}

/// A place along an axis: the sample before it, in the full brick, and the weight of the one after it.
type Along = (usize, f64);

impl<'a> CoarseField<'a> {
    fn new(brick: &'a PreparedBrick, node: NodeId) -> Self {
        let edge = brick.layout().edge as f64;
        let origin = node.brick().map(|b| f64::from(b) * edge);
        Self { brick, origin, per_voxel: 1.0 / (1u64 << node.level) as f64 }
    }

    /// Where a coordinate of its box lies, in voxels of level 0.
    fn along(&self, axis: usize, voxel: f64) -> Along {
        let layout = self.brick.layout();
        let place = voxel * self.per_voxel - self.origin[axis];
        let cell = place.floor().clamp(0.0, (layout.edge - 1) as f64);
        (cell as usize + layout.low, place - cell)
    }

    /// The value at a place; `None` where a masked sample has a part in it.
    fn between(&self, [x, y, z]: [Along; 3]) -> Option<f64> {
        let full = self.brick.layout().full_edge();
        let first = x.0 + full * (y.0 + full * z.0);
        let mut sum = 0.0;
        for (dz, wz) in [(0, 1.0 - z.1), (full * full, z.1)] {
            for (dy, wy) in [(0, 1.0 - y.1), (full, y.1)] {
                if wz * wy == 0.0 {
                    continue;
                }
                for (dx, wx) in [(0, 1.0 - x.1), (1, x.1)] {
                    let (index, weight) = (first + dx + dy + dz, wx * wy * wz);
                    if weight != 0.0 && self.brick.mask.as_ref().is_some_and(|mask| mask.get(index)) {
                        return None;
                    }
                    sum += weight * f64::from(self.brick.samples[index]);
                }
            }
        }
        Some(self.brick.offset + self.brick.scale * sum)
    }
}

/// The boxes of a draw list by place.
struct Boxes {
    /// By level and place among the bricks of that level.
    cells: HashMap<(u8, [u32; 3]), Cell>,
    root: u8,
    /// Voxels along an edge of a cell of level 0.
    edge: f64,
}

#[derive(Clone, Copy)]
enum Cell {
    Entry(usize),
    Divided,
}

impl Boxes {
    fn new(entries: &[(NodeId, [[f64; 3]; 2])], layout: &BrickLayout) -> Self {
        let edge = layout.edge as f64;
        let placed: Vec<(u8, [u32; 3])> = entries
            .iter()
            .map(|(_, [low, high])| {
                // Boxes are cut at the end of the grid: then a smaller cell has all that is left of them.
                let longest = (0..3).map(|a| (high[a] - low[a]) / edge).fold(1.0, f64::max);
                let level = (longest.ceil() as u64).next_power_of_two().trailing_zeros() as u8;
                (level, low.map(|v| ((v / edge) as u32) >> level))
            })
            .collect();
        let highest = placed.iter().map(|(level, cell)| level + bits(cell)).max();
        let root = highest.unwrap_or(0);
        let mut cells = HashMap::new();
        for (i, &(level, cell)) in placed.iter().enumerate() {
            cells.insert((level, cell), Cell::Entry(i));
            for above in level + 1..=root {
                let key = (above, cell.map(|c| c >> (above - level)));
                if cells.insert(key, Cell::Divided).is_some() {
                    break;
                }
            }
        }
        Self { cells, root, edge }
    }

    /// Entries whose closed boxes touch a closed box.
    fn collect(&self, within: [[f64; 3]; 2], found: &mut Vec<usize>) {
        self.descend(self.root, [0; 3], within, found);
    }

    fn descend(&self, level: u8, cell: [u32; 3], [low, high]: [[f64; 3]; 2], found: &mut Vec<usize>) {
        let size = self.edge * (1u64 << level) as f64;
        let touches =
            (0..3).all(|a| f64::from(cell[a]) * size <= high[a] && low[a] <= f64::from(cell[a] + 1) * size);
        if !touches {
            return;
        }
        match self.cells.get(&(level, cell)) {
            Some(Cell::Entry(entry)) => found.push(*entry),
            Some(Cell::Divided) if level > 0 => {
                for octant in 0..8 {
                    let child = std::array::from_fn(|a| 2 * cell[a] + (octant >> a & 1));
                    self.descend(level - 1, child, [low, high], found);
                }
            }
            _ => {}
        }
    }
}

/// Bits of the largest of three numbers.
fn bits(cell: &[u32; 3]) -> u8 {
    cell.iter().map(|c| u32::BITS - c.leading_zeros()).max().unwrap_or(0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{BitMask, ResidentBrick};

    fn layout() -> BrickLayout {
        BrickLayout::new(8).unwrap()
    }

    fn curved([x, y, z]: [f64; 3]) -> f64 {
        (0.31 * x).sin() + (0.23 * y - 0.11 * x).cos() + 0.02 * z * (0.17 * z).sin()
    }

    fn linear([x, y, z]: [f64; 3]) -> f64 {
        0.5 * x - 0.25 * y + 0.125 * z
    }

    fn region_of(node: NodeId) -> [[f64; 3]; 2] {
        let size = (8u32 << node.level) as f64;
        let low = node.brick().map(|b| f64::from(b) * size);
        [low, low.map(|v| v + size)]
    }

    /// A field's samples at a node, rounded to 65536 steps from -8 to 8 or, `per_brick`, from the smallest to the largest.
    fn brick(
        node: NodeId,
        field: fn([f64; 3]) -> f64,
        per_brick: bool,
        mask: impl Fn([f64; 3]) -> bool,
    ) -> DrawBrick {
        let full = layout().full_edge();
        let scale = f64::from(1u32 << node.level);
        let places: Vec<[f64; 3]> = (0..full.pow(3))
            .map(|i| [i % full, i / full % full, i / full / full])
            .map(|i| std::array::from_fn(|a| (f64::from(node.brick()[a] * 8) + i[a] as f64 - 1.0) * scale))
            .collect();
        let values: Vec<f64> = places.iter().map(|p| field(*p)).collect();
        let [low, high] = match per_brick {
            false => [-8.0, 8.0],
            true => values.iter().fold([f64::MAX, f64::MIN], |[l, h], v| [l.min(*v), h.max(*v)]),
        };
        let per_step = (high - low) / 65535.0;
        let samples = values.iter().map(|v| ((v - low) / per_step).round() as u16).collect();
        let mask = Some(BitMask::from_flags(places.into_iter().map(mask)));
        let resident = ResidentBrick { samples, offset: low, scale: per_step, mask };
        let how = DrawHow::Samples(Arc::new(PreparedBrick::new(resident, &layout()).unwrap()));
        DrawBrick { node, region: region_of(node), how }
    }

    /// An octant of level 2 beside octants of level 1, one of which has children.
    fn nodes() -> Vec<NodeId> {
        let mut nodes: Vec<NodeId> = (0..2).map(|z| NodeId::new(2, [0, 0, z])).collect();
        let of_level_1: Vec<[u32; 3]> = (0..16).map(|i| [2 + i % 2, i / 2 % 2, i / 4]).collect();
        for brick in of_level_1 {
            match brick {
                [2, 1, 1] | [2, 0, 2] => {
                    nodes.extend(
                        (0..8u32)
                            .map(|o| NodeId::new(0, std::array::from_fn(|a| 2 * brick[a] + (o >> a & 1)))),
                    );
                }
                _ => nodes.push(NodeId::new(1, brick)),
            }
        }
        nodes
    }

    fn filter(bricks: &[DrawBrick]) -> Vec<DrawBrick> {
        let entries: Vec<_> = bricks.iter().map(|b| (b.node, b.region)).collect();
        filter_level_borders(bricks, &LevelBorders::new(&entries, &layout()), &|_| None)
    }

    fn prepared(brick: &DrawBrick) -> &PreparedBrick {
        match &brick.how {
            DrawHow::Samples(prepared) => prepared,
            _ => panic!("not drawn from samples"),
        }
    }

    /// What a brick shows at a place of its box.
    fn shown(brick: &DrawBrick, place: [f64; 3]) -> f64 {
        let field = CoarseField::new(prepared(brick), brick.node);
        field.between(std::array::from_fn(|a| field.along(a, place[a]))).unwrap()
    }

    /// The largest difference at places that two bricks' boxes share, between those of which `is_wanted`.
    fn largest_jump(bricks: &[DrawBrick], is_wanted: impl Fn(u8, u8) -> bool) -> (f64, usize) {
        let (mut largest, mut num): (f64, usize) = (0.0, 0);
        for (i, a) in bricks.iter().enumerate() {
            for b in bricks[..i].iter().filter(|b| is_wanted(a.node.level, b.node.level)) {
                let low: [f64; 3] = std::array::from_fn(|k| a.region[0][k].max(b.region[0][k]));
                let high: [f64; 3] = std::array::from_fn(|k| a.region[1][k].min(b.region[1][k]));
                if (0..3).any(|k| low[k] > high[k]) {
                    continue;
                }
                for t in 0..9 * 9 * 9 {
                    let t = [t % 9, t / 9 % 9, t / 81].map(|t| f64::from(t) / 8.0 * 0.97);
                    let place = std::array::from_fn(|k| low[k] + t[k] * (high[k] - low[k]));
                    largest = largest.max((shown(a, place) - shown(b, place)).abs());
                    num += 1;
                }
            }
        }
        (largest, num)
    }

    #[test]
    fn a_curved_field_does_not_jump_between_levels() {
        for per_brick in [false, true] {
            let bricks: Vec<_> =
                nodes().into_iter().map(|n| brick(n, curved, per_brick, |_| false)).collect();
            let (before, num) = largest_jump(&bricks, |a, b| a != b);
            assert!(before > 0.1 && num > 10_000, "{before} at {num} places");
            let (after, _) = largest_jump(&filter(&bricks), |_, _| true);
            // A rounding of each of the two.
            assert!(after <= 16.0 / 65535.0, "{after}");
        }
    }

    #[test]
    fn neighbours_of_a_level_change_alike() {
        let bricks: Vec<_> = nodes().into_iter().map(|n| brick(n, curved, false, |_| false)).collect();
        let filtered = filter(&bricks);
        let num_changed =
            bricks.iter().zip(&filtered).filter(|(a, b)| prepared(a).samples != prepared(b).samples);
        assert!(num_changed.count() > 10);
        let (jump, num) = largest_jump(&filtered, |a, b| a == b);
        assert!(jump == 0.0 && num > 10_000, "{jump} at {num} places");
    }

    #[test]
    fn a_linear_field_stays_as_it_is() {
        // Masked beyond a slanted plane, with values there that are made up.
        fn field(p: [f64; 3]) -> f64 {
            if is_masked(p) { 7.0 } else { linear(p) }
        }
        fn is_masked([x, y, z]: [f64; 3]) -> bool {
            x + y + 0.7 * z > 47.0
        }
        let bricks: Vec<_> = nodes().into_iter().map(|n| brick(n, field, false, is_masked)).collect();
        let filtered = filter(&bricks);
        for (before, after) in bricks.iter().zip(&filtered) {
            let (mask, full) = (prepared(before).mask.as_ref().unwrap(), layout().num_full());
            let unmasked: Vec<usize> = (0..full).filter(|i| !mask.get(*i)).collect();
            let difference =
                unmasked.iter().map(|&i| (prepared(before).value(i) - prepared(after).value(i)).abs());
            assert!(difference.fold(0.0, f64::max) <= 1.01 * 16.0 / 65535.0);
        }
    }

    #[test]
    fn values_beside_a_uniform_look_come_within_its_range() {
        let coarse = NodeId::new(1, [0, 0, 0]);
        let skipped = DrawBrick { node: coarse, region: region_of(coarse), how: DrawHow::Skip };
        let fine = brick(NodeId::new(0, [2, 0, 0]), curved, true, |_| false);
        let bricks = [skipped, fine];
        let entries: Vec<_> = bricks.iter().map(|b| (b.node, b.region)).collect();
        let borders = LevelBorders::new(&entries, &layout());
        assert_eq!(borders.coarser_than(1), [0]);
        assert_eq!(borders.needed_by(1..2), [0]);
        let filtered = filter_level_borders(&bricks, &borders, &|_| Some([20.0, 21.0]));
        for t in 0..8 {
            let t = f64::from(t);
            assert!((shown(&filtered[1], [16.0, t, 7.5 - t / 2.0]) - 20.0).abs() < 1e-3);
            let place = [17.0 + t / 2.0, t, t];
            assert!((shown(&filtered[1], place) - shown(&bricks[1], place)).abs() < 1e-3);
        }
    }
}
