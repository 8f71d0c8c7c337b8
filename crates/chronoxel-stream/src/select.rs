//! Which nodes to draw, and how: the walk down the time-space partitioning tree.

use std::ops::Range;

use chronoxel_core::{
    BrickLayout, Eye, NodeFacts, NodeId, Octree, SpanKind, SpanRecord, TimeNode, UniformGrid,
};

use crate::{ActiveCut, NodeErrors, Place, StepStatistics, ViewVolume};

/// How a node of the draw list is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum How {
    /// Not at all: outside the picture, without data, or transparent over its whole drawn range.
    Skip,
    /// As one scalar value everywhere.
    Constant(f64),
    /// As one colour (sRGB) and opacity per unit length everywhere.
    ConstantColor([f32; 4]),
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
    /// The steps for which it is drawn like this; the data is that of the first.
    pub steps: Range<u32>,
    /// How to draw it.
    pub how: How,
}

/// What a range of values looks like under a transfer function.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Appearance {
    /// Nothing of it can be seen.
    Transparent,
    /// All of it has one colour and opacity.
    Uniform([f32; 4]),
    /// Colours or opacities differ.
    Varied,
}

/// Errors up to which a node is drawn as something simpler.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Tolerances {
    /// A node whose spatial error is no larger is drawn in its mean colour. At 0 no node is: what is alike at every sample is found
    /// brick by brick, and drawn as it is.
    pub spatial: f64,
    /// A node whose temporal error over some steps is no larger is drawn as it is at the first of them. At 0 that is so only where the store says that
    /// the same payload is drawn.
    pub temporal: f64,
}

/// Coherence in space and time, and how much of it to use.
pub struct Coherence<'a> {
    /// How much error is allowed.
    pub tolerances: Tolerances,
    /// Of the step drawn.
    pub statistics: &'a StepStatistics,
    /// By which metric.
    pub errors: &'a mut dyn NodeErrors,
}

/// The walk down the tree for one picture.
pub struct Selector<'a> {
    /// The nodes that exist.
    pub tree: &'a Octree,
    /// The shape of the bricks.
    pub layout: &'a BrickLayout,
    /// The grid they cover.
    pub grid: &'a UniformGrid,
    /// Steps of the series.
    pub num_steps: u32,
    /// The step to draw.
    pub step: u32,
    /// The finest level to draw.
    pub level: u8,
    /// Nodes to stop at, drawn as bricks, where that is above `level`.
    pub cut: Option<&'a ActiveCut>,
    /// What the camera sees.
    pub view: &'a ViewVolume,
    /// Whether what cannot be seen is left out, as it should be; drawing it changes nothing but the time it takes.
    pub skips_transparent: bool,
}

impl Selector<'_> {
    /// The draw list, front to back; its boxes are disjoint and cover the grid's box.
    ///
    /// The traversal of ellsworth2000, figure 2, for any number of levels, with the condition of its first test the right way round: a node is drawn as a whole
    /// where it is coherent in space and time within the tolerances, over the longest steps for which it is; else its children are, in view order.
    /// Bricks of the finest level are always drawn, with the data of the longest steps for which they are coherent in time.
    ///
    /// * `coherence`: without it each step is drawn by itself
    /// * `record`: the span of a node that holds a step
    /// * `appearance`: what a range of values looks like
    ///
    /// # Errors
    /// Whatever `record` returns.
    pub fn draw_list<E>(
        &self,
        coherence: Option<Coherence<'_>>,
        record: &mut dyn FnMut(NodeId, u32) -> Result<SpanRecord, E>,
        appearance: &dyn Fn([f64; 2]) -> Appearance,
    ) -> Result<Vec<DrawItem>, E> {
        let sizes = (0..self.tree.num_levels()).map(|level| self.tree.nodes(level as u8).len());
        let first_of_level = sizes.scan(0, |sum, n| Some(std::mem::replace(sum, *sum + n))).collect();
        let eye = Eye::of(&self.view.camera, self.grid);
        let mut walk =
            Walk { selector: self, eye, first_of_level, coherence, record, appearance, items: Vec::new() };
        walk.descend(self.tree.root())?;
        Ok(walk.items)
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

/// A walk under way.
struct Walk<'a, 'b, E> {
    selector: &'a Selector<'a>,
    eye: Eye,
    /// Place of the first node of each level among all.
    first_of_level: Vec<usize>,
    coherence: Option<Coherence<'b>>,
    record: &'a mut dyn FnMut(NodeId, u32) -> Result<SpanRecord, E>,
    appearance: &'a dyn Fn([f64; 2]) -> Appearance,
    items: Vec<DrawItem>,
}

/// Steps over which a node is coherent.
struct Coherent {
    time: TimeNode,
    /// Its mean colour, where it is coherent in space as well.
    mean_color: Option<[f32; 4]>,
}

impl<E> Walk<'_, '_, E> {
    fn descend(&mut self, node: NodeId) -> Result<(), E> {
        let selector = self.selector;
        let region = selector.region_of(node);
        if !selector.view.may_see(region) {
            self.push(node, region, selector.step..selector.step + 1, How::Skip);
            return Ok(());
        }
        let children: [Option<NodeId>; 8] = std::array::from_fn(|octant| {
            node.child(octant as u8).filter(|child| selector.tree.rank(*child).is_some())
        });
        let is_finest = node.level <= selector.level || selector.cut.is_some_and(|cut| cut.contains(node));
        if is_finest || children.iter().all(Option::is_none) {
            return self.draw_brick(node, region);
        }
        if let Some(Coherent { time, mean_color: Some(color) }) = self.coherent(node, false) {
            let steps = time.steps(selector.num_steps);
            self.push(node, region, steps, how_in_color(color));
            return Ok(());
        }
        let first = self.items.len();
        let half = (selector.layout.edge << node.level) as f64 / 2.0;
        for octant in self.eye.octants_front_to_back(region[0].map(|low| low + half)) {
            if let Some(child) = children[octant] {
                self.descend(child)?;
                continue;
            }
            let low = std::array::from_fn(|a| region[0][a] + half * (octant >> a & 1) as f64);
            let octant_box = selector.cut([low, low.map(|v| v + half)]);
            if (0..3).all(|a| octant_box[0][a] < octant_box[1][a]) {
                self.draw_brick(node, octant_box)?;
            }
        }
        // Where nothing is to be seen of any child, nothing is of the node.
        if self.items[first..].iter().all(|item| item.how == How::Skip) {
            self.items.truncate(first);
            self.push(node, region, selector.step..selector.step + 1, How::Skip);
        }
        Ok(())
    }

    /// Draws a box from a node's own data.
    fn draw_brick(&mut self, node: NodeId, region: [[f64; 3]; 2]) -> Result<(), E> {
        let step = self.selector.step;
        let record = (self.record)(node, step)?;
        let how = self.how_to_draw(&record);
        if how == How::Skip {
            self.push(node, region, step..step + 1, how);
            return Ok(());
        }
        let Some(Coherent { time, mean_color }) = self.coherent_in_time(node, &record)? else {
            self.push(node, region, step..step + 1, how);
            return Ok(());
        };
        let steps = time.steps(self.selector.num_steps);
        let how = match mean_color {
            Some(color) => how_in_color(color),
            None if steps.start == step => how,
            None => {
                let first = (self.record)(node, steps.start)?;
                self.how_to_draw(&first)
            }
        };
        self.push(node, region, steps, how);
        Ok(())
    }

    fn push(&mut self, node: NodeId, region: [[f64; 3]; 2], steps: Range<u32>, how: How) {
        self.items.push(DrawItem { node, region, steps, how });
    }

    /// The longest steps over which a brick may be drawn as it is at the first of them.
    fn coherent_in_time(&mut self, node: NodeId, record: &SpanRecord) -> Result<Option<Coherent>, E> {
        let Some(coherence) = &self.coherence else { return Ok(None) };
        let exact = coherence.tolerances.temporal == 0.0;
        let mut found = self.coherent(node, true);
        while let Some(Coherent { time, mean_color: None }) = found {
            let steps = time.steps(self.selector.num_steps);
            let step = self.selector.step;
            if !exact || steps.start == step {
                break;
            }
            let first = (self.record)(node, steps.start)?;
            if draws_alike((&first, steps.start), (record, step)) {
                break;
            }
            found = self.coherent_within(node, true, TimeNode::holding(step, time.level - 1));
        }
        Ok(found)
    }

    fn coherent(&mut self, node: NodeId, is_brick: bool) -> Option<Coherent> {
        let num_levels = self.coherence.as_ref()?.statistics.of_time_levels.len() as u8;
        let longest = TimeNode::holding(self.selector.step, num_levels.checked_sub(1)?);
        self.coherent_within(node, is_brick, longest)
    }

    /// `timetree_traverse` of the paper: the longest steps, `longest` or a part of them, over which the node is coherent in time, and unless it
    /// is a brick of the finest level drawn, in space.
    fn coherent_within(&mut self, node: NodeId, is_brick: bool, longest: TimeNode) -> Option<Coherent> {
        let Coherence { tolerances, statistics, errors } = self.coherence.as_mut()?;
        let rank = self.selector.tree.rank(node)?;
        let index = self.first_of_level[usize::from(node.level)] + rank;
        if !is_brick && tolerances.spatial == 0.0 {
            return None;
        }
        for level in (0..=longest.level).rev() {
            let at = Place { node: index, time: TimeNode::holding(self.selector.step, level) };
            let NodeFacts { is_masked, mask_changes, .. } = statistics.at(at).facts;
            // A single step has no error in time.
            if level > 0 && (mask_changes || errors.temporal(at) > tolerances.temporal) {
                continue;
            }
            let mean_color = match tolerances.spatial > 0.0 && !is_masked {
                true => (errors.spatial(at) <= tolerances.spatial).then(|| errors.mean_color(at)),
                false => None,
            };
            if is_brick || mean_color.is_some() {
                return Some(Coherent { time: at.time, mean_color });
            }
        }
        None
    }

    fn how_to_draw(&self, record: &SpanRecord) -> How {
        if record.kind == SpanKind::Empty {
            return How::Skip;
        }
        match (record.kind, (self.appearance)(record.drawn_range)) {
            (_, Appearance::Transparent) if self.selector.skips_transparent => How::Skip,
            // A mask cuts holes into a constant brick, so that it cannot be crossed in one step.
            _ if record.mask.is_some() => How::Payload,
            (SpanKind::Constant(value), _) => How::Constant(value),
            (_, Appearance::Uniform(color)) => How::ConstantColor(color),
            _ => How::Payload,
        }
    }
}

/// A node in its mean colour.
fn how_in_color(color: [f32; 4]) -> How {
    match color[3] > 0.0 {
        true => How::ConstantColor(color),
        false => How::Skip,
    }
}

/// Whether a node looks the same at two steps because the same is stored for both.
fn draws_alike((a, step_a): (&SpanRecord, u32), (b, step_b): (&SpanRecord, u32)) -> bool {
    let same_place = a.window == b.window && a.mask == b.mask;
    match (a.kind, b.kind) {
        (SpanKind::Constant(a), SpanKind::Constant(b)) => same_place && a.to_bits() == b.to_bits(),
        (SpanKind::Coded { .. }, SpanKind::Coded { .. }) => {
            same_place && a.kind == b.kind && step_a - a.start == step_b - b.start
        }
        (a, b) => a == b,
    }
}

#[cfg(test)]
mod tests;
