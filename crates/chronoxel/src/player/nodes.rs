//! What the active cut asks of nodes: how wrong the picture is where one is drawn, what drawing it costs, and whether it is in memory.

use std::collections::HashMap;

use chronoxel_core::{
    BrickLayout, NodeFacts, NodeId, NodeStatistics, Octree, Projection, Ray, SpanKind, SpanRecord,
    UniformGrid,
    metrics::{ColorSpace, ColorTable, approximate_spatial},
};
use chronoxel_store::Store;
use chronoxel_stream::{NodeView, Residency, State, ViewVolume};

use crate::session::{Held, HeldKey, Spans, View};

/// Entries of the table that colours are estimated from.
const NUM_ENTRIES: usize = 256;
/// What can be seen and is not of one value has at least this error, times its pixels per voxel: the estimate speaks of colours alone, not of light.
const LEAST_COLOR_ERROR: f64 = 1e-3;
/// Time to decode a sample of a brick, against that of a sample along a ray: measured on CPUs.
const DECODE_COST: f64 = 0.25;
/// Most errors that are kept; then all are forgotten.
const MOST_ERRORS: usize = 1 << 18;

/// The spans of all levels at one step; `None` for levels whose spans are not in memory, or cannot be read.
pub(super) struct StepSpans {
    of_levels: Vec<Option<Spans>>,
    /// `[level][rank]`: of a node and of all below it. Filtering smooths peaks and holes away, so that a node may be transparent, or whole, and what it
    /// stands for not.
    below: Vec<Vec<Below>>,
}

/// What is drawn of a node or of any below it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Below {
    /// Smallest and largest sample; the first is larger where there is none.
    range: [f64; 2],
    /// Whether any of them has a mask, or no data.
    has_holes: bool,
}

impl Below {
    fn of(record: Option<&SpanRecord>) -> Self {
        match record {
            Some(record) if record.kind != SpanKind::Empty => {
                Self { range: record.drawn_range, has_holes: record.mask.is_some() }
            }
            _ => Self { range: [f64::INFINITY, f64::NEG_INFINITY], has_holes: true },
        }
    }

    fn with(self, other: Self) -> Self {
        let range = [self.range[0].min(other.range[0]), self.range[1].max(other.range[1])];
        Self { range, has_holes: self.has_holes || other.has_holes }
    }
}

impl StepSpans {
    /// Of the spans of each level, finest first.
    pub fn new(tree: &Octree, of_levels: Vec<Option<Spans>>) -> Self {
        let mut below: Vec<Vec<Below>> = Vec::with_capacity(of_levels.len());
        for (level, spans) in of_levels.iter().enumerate() {
            let nodes = tree.nodes(level as u8);
            let own = |rank: usize| Below::of(spans.as_ref().map(|spans| &spans[rank]));
            let mut of_level: Vec<Below> = (0..nodes.len()).map(own).collect();
            if let Some(of_children) = below.last() {
                let mut rank = 0;
                for (morton, child) in tree.nodes(level as u8 - 1).iter().zip(of_children) {
                    // Both lists are in Morton order.
                    while nodes[rank] < morton >> 3 {
                        rank += 1;
                    }
                    of_level[rank] = of_level[rank].with(*child);
                }
            }
            below.push(of_level);
        }
        Self { of_levels, below }
    }

    /// Level by level, as far as they are known.
    pub fn of_levels(&self) -> &[Option<Spans>] {
        &self.of_levels
    }

    /// Of a node of a level, by its rank.
    pub fn record(&self, tree: &Octree, node: NodeId) -> Option<&SpanRecord> {
        self.of_levels[usize::from(node.level)].as_ref()?.get(tree.rank(node)?)
    }

    /// What is drawn of a node or of any below it, if anything is.
    fn below(&self, tree: &Octree, node: NodeId) -> Option<Below> {
        let below = self.below[usize::from(node.level)][tree.rank(node)?];
        (below.range[0] <= below.range[1]).then_some(below)
    }
}

/// Colour errors under one transfer function, as far as they were asked for.
pub(super) struct ColorErrors {
    table: ColorTable,
    view: View,
    /// By node and first step of its span; what lies below may change within the span.
    known: HashMap<(NodeId, u32), (Below, f64)>,
}

impl ColorErrors {
    /// Of a view, over the range of the variable.
    pub fn new(view: &View, range: [f64; 2]) -> Self {
        let table = ColorTable::new(&view.transfer, range, NUM_ENTRIES, ColorSpace::Rgb);
        Self { table, view: view.clone(), known: HashMap::new() }
    }

    /// Whether they hold for another view.
    pub fn fits(&self, view: &View) -> bool {
        self.view.transfer == view.transfer
    }

    /// The estimated spatial error of a node over a span (ellsworth2000, eq. 19), 0 where it has one colour.
    ///
    /// * `below`: of everything below the node
    fn of(&mut self, node: NodeId, record: &SpanRecord, below: Below) -> f64 {
        let key = (node, record.start);
        if let Some((_, error)) = self.known.get(&key).filter(|(of, _)| *of == below) {
            return *error;
        }
        let [min, max] = below.range;
        if self.known.len() >= MOST_ERRORS {
            self.known.clear();
        }
        let statistics = &record.statistics;
        let is_masked = below.has_holes;
        let is_uniform = min == max && !is_masked;
        let estimate = approximate_spatial(
            &self.table,
            &self.view.transfer,
            &NodeStatistics {
                min,
                max,
                mean: statistics.mean.clamp(min, max),
                std: statistics.std,
                temporal_error: 0.0,
                facts: NodeFacts { is_uniform, is_masked, ..NodeFacts::default() },
            },
        );
        let error = if is_uniform { 0.0 } else { estimate.error.max(LEAST_COLOR_ERROR) };
        self.known.insert(key, (below, error));
        error
    }
}

/// The nodes of one frame.
pub(super) struct FrameNodes<'a> {
    pub tree: &'a Octree,
    pub store: &'a Store,
    pub variable: usize,
    pub grid: &'a UniformGrid,
    pub layout: &'a BrickLayout,
    pub view: &'a View,
    pub volume: &'a ViewVolume,
    pub spans: &'a StepSpans,
    /// The spans of the step that is likely to come next, as far as they are in memory: a split that the next frame could not show is not done.
    pub next: Option<&'a [Option<Spans>]>,
    pub residency: &'a Residency<HeldKey>,
    pub errors: &'a mut ColorErrors,
    /// Some of the picture's rays, that tell how much of a node is seen.
    pub rays: &'a SomeRays,
    /// Whether to say of every node that it is in memory, or will be waited for.
    pub assumes_resident: bool,
}

impl FrameNodes<'_> {
    /// The record of a node whose samples would be drawn; `None` where it would be skipped: outside the picture, transparent, without data.
    pub fn drawn(&self, node: NodeId) -> Option<&SpanRecord> {
        let record = self.spans.record(self.tree, node)?;
        let is_seen = self.volume.may_see(self.region(node))
            && record.kind != SpanKind::Empty
            && !self.view.transfer.is_transparent_over(record.drawn_range);
        is_seen.then_some(record)
    }

    /// The key of what must be in memory to draw a node; `None` where nothing must.
    pub fn key(&self, node: NodeId) -> Option<(HeldKey, SpanRecord)> {
        let record = self.drawn(node)?;
        key_of(node.level, record).map(|key| (key, *record))
    }

    fn region(&self, node: NodeId) -> [[f64; 3]; 2] {
        let size = (self.layout.edge << node.level) as f64;
        let low = node.brick().map(|b| f64::from(b) * size);
        [low, std::array::from_fn(|a| (low[a] + size).min(self.grid.dims[a] as f64 - 1.0).max(low[a]))]
    }

    /// Edge of a voxel of a node in pixels, where it is largest (leven2002, section 5.1).
    pub fn pixels_per_voxel(&self, node: NodeId) -> f64 {
        self.volume.pixels_per_voxel(self.region(node), node.level, self.grid, self.view.size[1])
    }
}

/// Rays through a picture, along its columns and rows: a node that is a quarter of the picture's height is crossed by nine of them or more.
const RAYS_ALONG: [usize; 2] = [16, 12];

/// Rays that are spread evenly over a picture.
pub(super) struct SomeRays {
    /// Each through as many pixels as the next.
    rays: Vec<Ray>,
    pixels_each: f64,
}

impl SomeRays {
    /// Of a picture.
    pub fn of(view: &View) -> Self {
        let [columns, rows] = RAYS_ALONG;
        let through = view.camera.rays(view.size);
        let place = |n: usize, of: usize, size: usize| (n as f64 + 0.5) / of as f64 * size as f64;
        let rays = (0..columns * rows).map(|n| {
            through.ray([place(n % columns, columns, view.size[0]), place(n / columns, rows, view.size[1])])
        });
        let rays: Vec<Ray> = rays.collect();
        let num_pixels = view.size[0] as f64 * view.size[1] as f64;
        Self { pixels_each: num_pixels / rays.len() as f64, rays }
    }

    /// Lengths of all of the picture's rays in a box of the world, summed up, as far as these tell.
    fn length_in(&self, low: [f64; 3], high: [f64; 3]) -> f64 {
        self.rays.iter().map(|ray| length_in(ray, low, high)).sum::<f64>() * self.pixels_each
    }
}

/// The length of a ray in a box.
fn length_in(ray: &Ray, low: [f64; 3], high: [f64; 3]) -> f64 {
    let (mut entry, mut exit) = (0.0f64, f64::INFINITY);
    for a in 0..3 {
        let inverse = 1.0 / ray.direction[a];
        let (near, far) = ((low[a] - ray.origin[a]) * inverse, (high[a] - ray.origin[a]) * inverse);
        // NaN, where a ray runs along a face, sets no limit.
        entry = entry.max(near.min(far));
        exit = exit.min(near.max(far));
    }
    if exit > entry && exit.is_finite() { exit - entry } else { 0.0 }
}

impl FrameNodes<'_> {
    /// Samples that rays take in a node, roughly: by some rays where it is large in the picture, so that it may be seen in part; else for each octant that is seen,
    /// its volume times the rays that cross a unit of area there, over the step length.
    fn num_samples(&self, node: NodeId) -> f64 {
        let [low, high] = self.region(node);
        let camera = &self.view.camera;
        let extent: [f64; 3] = std::array::from_fn(|a| 0.5 * (high[a] - low[a]) * self.grid.spacing[a]);
        let size = extent.iter().copied().fold(0.0, f64::max);
        let per_unit = self.view.size[1] as f64 / (2.0 * camera.half_height());
        let step = self.view.step_voxels * self.grid.smallest_spacing() * f64::from(node.level).exp2();
        let [first, last] = [low, high].map(|corner| self.grid.world_from_voxel(corner));
        let centre: [f64; 3] = std::array::from_fn(|a| 0.5 * (first[a] + last[a]));
        let distance = match camera.projection() {
            Projection::Orthographic { .. } => 1.0,
            Projection::Perspective { .. } => {
                let squares = (0..3).map(|a| (centre[a] - camera.position()[a]).powi(2));
                squares.sum::<f64>().sqrt() - size
            }
        };
        let quarter = 0.25 * self.view.size[1] as f64;
        if 2.0 * size * per_unit > quarter * distance {
            return self.rays.length_in(first, last) / step;
        }
        let rays_per_area = |octant: usize| {
            let centre: [f64; 3] = std::array::from_fn(|a| {
                low[a] + (0.25 + 0.5 * (octant >> a & 1) as f64) * (high[a] - low[a])
            });
            if !self.volume.may_see([centre, centre]) {
                return 0.0;
            }
            let world = self.grid.world_from_voxel(centre);
            let distance = (0..3).map(|a| (world[a] - camera.position()[a]).powi(2)).sum::<f64>().sqrt();
            match camera.projection() {
                Projection::Orthographic { .. } => per_unit * per_unit,
                // From within, most of an octant is half its size away.
                Projection::Perspective { .. } => (per_unit / distance.max(0.5 * size)).powi(2),
            }
        };
        (0..8).map(rays_per_area).sum::<f64>() * extent.iter().product::<f64>() / step
    }
}

/// The key of what must be in memory to draw a span; `None` where nothing must.
pub(super) fn key_of(level: u8, record: &SpanRecord) -> Option<HeldKey> {
    match (record.kind, record.mask) {
        (SpanKind::Empty, _) | (SpanKind::Constant(_), None) => None,
        _ => HeldKey::new(level, record),
    }
}

impl NodeView for FrameNodes<'_> {
    fn error(&mut self, node: NodeId) -> f64 {
        let is_seen = self.volume.may_see(self.region(node));
        let Some(below) = self.spans.below(self.tree, node).filter(|_| is_seen) else { return 0.0 };
        if self.view.transfer.is_transparent_over(below.range) {
            return 0.0;
        }
        let error = match self.spans.record(self.tree, node).copied() {
            Some(record) if record.statistics.count > 0 => self.errors.of(node, &record, below),
            _ => 1.0,
        };
        error * self.pixels_per_voxel(node)
    }

    /// Samples along rays, and those to decode.
    fn cost(&mut self, node: NodeId) -> f64 {
        let Some(record) = self.drawn(node) else { return 0.0 };
        if matches!(record.kind, SpanKind::Constant(_)) && record.mask.is_none() {
            return 1.0;
        }
        self.num_samples(node) + DECODE_COST * self.layout.num_full() as f64
    }

    fn num_bytes(&mut self, node: NodeId) -> usize {
        self.key(node).map_or(0, |(_, record)| Held::most_bytes(self.store, self.variable, &record))
    }

    fn is_resident(&mut self, node: NodeId) -> bool {
        if self.assumes_resident || !self.volume.may_see(self.region(node)) {
            return true;
        }
        let is_here = |record: &SpanRecord| {
            let is_transparent = self.view.transfer.is_transparent_over(record.drawn_range);
            key_of(node.level, record).is_none_or(|key| {
                is_transparent || matches!(self.residency.state(&key), State::Resident | State::Failed)
            })
        };
        let rank = self.tree.rank(node);
        let at_next = self
            .next
            .zip(rank)
            .and_then(|(spans, rank)| spans.get(usize::from(node.level))?.as_ref()?.get(rank));
        // Spans that cannot be read are dealt with in drawing.
        self.spans.record(self.tree, node).is_none_or(is_here) && at_next.is_none_or(is_here)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_length_of_a_ray_in_a_box_is_that_between_its_faces() {
        let ray = |origin: [f64; 3], direction: [f64; 3]| Ray { origin, direction };
        let length = |ray: &Ray| length_in(ray, [0.0; 3], [2.0, 4.0, 6.0]);
        assert_eq!(length(&ray([-1.0, 1.0, 1.0], [1.0, 0.0, 0.0])), 2.0);
        assert_eq!(length(&ray([0.5, 1.0, 1.0], [1.0, 0.0, 0.0])), 1.5);
        assert_eq!(length(&ray([3.0, 1.0, 1.0], [1.0, 0.0, 0.0])), 0.0);
        assert_eq!(length(&ray([-1.0, 5.0, 1.0], [1.0, 0.0, 0.0])), 0.0);
        let [x, y] = [0.6, 0.8];
        assert!((length(&ray([0.0, 0.0, 3.0], [x, y, 0.0])) - 2.0 / x).abs() < 1e-12);
    }
}
