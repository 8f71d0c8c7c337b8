//! Which nodes to draw, and how: the walk down the octree.

use chronoxel_core::{BrickLayout, NodeId, Octree, SpanKind, SpanRecord, UniformGrid, view_order};

use crate::ViewVolume;

/// How a node of the draw list is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum How {
    /// Not at all: outside the picture, without data, or transparent over its whole drawn range.
    Skip,
    /// As one scalar value everywhere.
    Constant(f64),
    /// From its payload.
    Payload,
}

/// One entry of the draw list.
#[derive(Debug, Clone, PartialEq)]
pub struct DrawItem {
    /// The node whose data is drawn.
    pub node: NodeId,
    /// The half-open box to draw it in, in voxels of the grid; the node's own box, or the octant of
    /// a child that does not exist.
    pub region: [[f64; 3]; 2],
    /// How to draw it.
    pub how: How,
}

/// The walk down the tree for one picture.
pub struct Selector<'a> {
    /// The nodes that exist.
    pub tree: &'a Octree,
    /// The shape of the bricks.
    pub layout: &'a BrickLayout,
    /// The grid they cover.
    pub grid: &'a UniformGrid,
    /// The finest level to draw.
    pub level: u8,
    /// What the camera sees.
    pub view: &'a ViewVolume,
}

impl Selector<'_> {
    /// The draw list, front to back; its boxes are disjoint and cover the grid's box.
    ///
    /// * `record`: the span of a node at the step drawn
    /// * `is_transparent`: whether the transfer function is zero over a range of values
    ///
    /// # Errors
    /// Whatever `record` returns.
    pub fn draw_list<E>(
        &self,
        mut record: impl FnMut(NodeId) -> Result<SpanRecord, E>,
        is_transparent: impl Fn([f64; 2]) -> bool,
    ) -> Result<Vec<DrawItem>, E> {
        let mut regions = Vec::new();
        self.descend(self.tree.root(), &mut regions);
        let boxes: Vec<_> = regions.iter().map(|(_, region)| *region).collect();
        view_order(&boxes, &self.view.camera, self.grid, self.layout)
            .into_iter()
            .map(|i| {
                let (node, region) = regions[i];
                let how = if self.view.may_see(region) {
                    how_to_draw(&record(node)?, &is_transparent)
                } else {
                    How::Skip
                };
                Ok(DrawItem { node, region, how })
            })
            .collect()
    }

    /// Collects the nodes to draw under `node`, with the box of each.
    fn descend(&self, node: NodeId, regions: &mut Vec<(NodeId, [[f64; 3]; 2])>) {
        let region = self.region_of(node);
        let children: [Option<NodeId>; 8] = std::array::from_fn(|octant| {
            node.child(octant as u8).filter(|child| self.tree.rank(*child).is_some())
        });
        if node.level <= self.level || children.iter().all(Option::is_none) {
            regions.push((node, region));
            return;
        }
        let half = (self.layout.edge << node.level) as f64 / 2.0;
        for (octant, child) in children.into_iter().enumerate() {
            let Some(child) = child else {
                let low = std::array::from_fn(|a| region[0][a] + half * (octant >> a & 1) as f64);
                let octant_box = self.cut([low, low.map(|v| v + half)]);
                if (0..3).all(|a| octant_box[0][a] < octant_box[1][a]) {
                    regions.push((node, octant_box));
                }
                continue;
            };
            self.descend(child, regions);
        }
    }

    /// The box that a node draws, cut to the tree's extent over the grid.
    fn region_of(&self, node: NodeId) -> [[f64; 3]; 2] {
        let size = (self.layout.edge << node.level) as f64;
        let low = node.brick().map(|b| f64::from(b) * size);
        self.cut([low, low.map(|v| v + size)])
    }

    /// Cuts a box so that it does not reach past the last brick that holds a sample.
    fn cut(&self, [low, high]: [[f64; 3]; 2]) -> [[f64; 3]; 2] {
        let edge = self.layout.edge;
        let end: [f64; 3] = self.grid.dims.map(|n| (n.div_ceil(edge) * edge) as f64);
        [low, std::array::from_fn(|a| high[a].min(end[a]))]
    }
}

fn how_to_draw(record: &SpanRecord, is_transparent: impl Fn([f64; 2]) -> bool) -> How {
    match record.kind {
        SpanKind::Empty => How::Skip,
        _ if is_transparent(record.drawn_range) => How::Skip,
        // A mask cuts holes into a constant brick, so that it cannot be crossed in one step.
        SpanKind::Constant(value) if record.mask.is_none() => How::Constant(value),
        SpanKind::Constant(_) | SpanKind::Coded { .. } => How::Payload,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{Camera, Projection, SpanStatistics, octree::levels_of};

    fn everything(eye: [f64; 3]) -> ViewVolume {
        let projection = Projection::Perspective { fov_y_deg: 30.0 };
        ViewVolume {
            camera: Camera::new(eye, [0.0; 3], [0.0, 1.0, 0.0], projection).unwrap(),
            planes: vec![],
        }
    }

    fn record(kind: SpanKind, drawn_range: [f64; 2]) -> SpanRecord {
        let statistics = SpanStatistics { count: 1, min: 0.0, max: 0.0, mean: 0.0, std: 0.0 };
        SpanRecord { start: 0, len: 1, window: 1, kind, mask: None, drawn_range, statistics }
    }

    fn volume(items: &[DrawItem]) -> f64 {
        items.iter().map(|i| (0..3).map(|a| i.region[1][a] - i.region[0][a]).product::<f64>()).sum()
    }

    #[test]
    fn every_level_covers_the_volume_once() {
        let grid = UniformGrid::new([20, 9, 30], [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(8).unwrap();
        let levels = levels_of(&grid, &layout);
        let tree = Octree::full(&levels);
        let view = everything([-5.0, 40.0, 11.0]);
        for level in 0..levels.len() as u8 {
            let selector = Selector { tree: &tree, layout: &layout, grid: &grid, level, view: &view };
            let items = selector
                .draw_list(|_| Ok::<_, ()>(record(SpanKind::Constant(1.0), [1.0; 2])), |_| false)
                .unwrap();
            assert!(items.iter().all(|i| i.node.level == level));
            assert_eq!(volume(&items), 24.0 * 16.0 * 32.0);
        }
    }

    #[test]
    fn a_missing_child_is_drawn_from_its_parent() {
        let grid = UniformGrid::new([16, 16, 16], [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(8).unwrap();
        let tree = Octree::from_levels(vec![vec![0, 1, 2, 4, 5, 6, 7], vec![0]]).unwrap();
        let view = everything([100.0; 3]);
        let selector = Selector { tree: &tree, layout: &layout, grid: &grid, level: 0, view: &view };
        let items = selector
            .draw_list(|_| Ok::<_, ()>(record(SpanKind::Constant(1.0), [1.0; 2])), |_| false)
            .unwrap();
        let parents: Vec<_> = items.iter().filter(|i| i.node.level == 1).map(|i| i.region).collect();
        assert_eq!(parents, [[[8.0, 8.0, 0.0], [16.0, 16.0, 8.0]]]);
        assert_eq!(volume(&items), 4096.0);
    }

    #[test]
    fn nothing_is_hidden_by_what_comes_after_it() {
        let grid = UniformGrid::new([64, 32, 64], [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(8).unwrap();
        let tree = Octree::full(&levels_of(&grid, &layout));
        for eye in [[-9.0, 70.0, 20.0], [33.0, 12.0, 30.0], [80.0, 15.0, -40.0]] {
            let view = everything(eye);
            let selector = Selector { tree: &tree, layout: &layout, grid: &grid, level: 0, view: &view };
            let items = selector
                .draw_list(|_| Ok::<_, ()>(record(SpanKind::Constant(1.0), [1.0; 2])), |_| false)
                .unwrap();
            for (n, first) in items.iter().enumerate() {
                for later in &items[n + 1..] {
                    // Some plane has the later box on its far side, as seen from the eye.
                    let apart = (0..3).any(|a| {
                        let ([low, high], [l, h]) = (first.region, later.region);
                        (h[a] <= low[a] && eye[a] >= h[a]) || (l[a] >= high[a] && eye[a] <= l[a])
                    });
                    assert!(apart, "{first:?} before {later:?}");
                }
            }
        }
    }

    #[test]
    fn empty_and_transparent_nodes_are_skipped() {
        let hidden = |range: [f64; 2]| range[1] < 0.5;
        assert_eq!(how_to_draw(&record(SpanKind::Empty, [0.0, 1.0]), hidden), How::Skip);
        assert_eq!(how_to_draw(&record(SpanKind::Constant(0.2), [0.2; 2]), hidden), How::Skip);
        assert_eq!(how_to_draw(&record(SpanKind::Constant(0.7), [0.7; 2]), hidden), How::Constant(0.7));
    }
}
