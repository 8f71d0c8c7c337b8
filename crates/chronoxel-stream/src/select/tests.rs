//! What the walk down the tree must choose: volumes and errors made up, lists checked.

use std::{collections::HashMap, sync::Arc};

use chronoxel_core::{
    Camera, NodeStatistics, PayloadAddress, Projection, SpanStatistics, octree::levels_of,
    time_tree::num_time_levels,
};

use super::*;
use crate::{CutLimits, NodeView};

/// A grid, its tree, and an eye that sees all of it.
struct Volume {
    grid: UniformGrid,
    layout: BrickLayout,
    tree: Octree,
    view: ViewVolume,
}

impl Volume {
    fn new(dims: [usize; 3], eye: [f64; 3]) -> Self {
        let grid = UniformGrid::new(dims, [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(8).unwrap();
        let projection = Projection::Perspective { fov_y_deg: 30.0 };
        let camera = Camera::new(eye, [0.0; 3], [0.0, 1.0, 0.0], projection).unwrap();
        let tree = Octree::full(&levels_of(&grid, &layout));
        Self { grid, layout, tree, view: ViewVolume { camera, planes: vec![] } }
    }

    fn selector(&self, step: u32, level: u8) -> Selector<'_> {
        Selector {
            tree: &self.tree,
            layout: &self.layout,
            grid: &self.grid,
            num_steps: NUM_STEPS,
            step,
            level,
            cut: None,
            view: &self.view,
            skips_transparent: true,
        }
    }

    /// Every brick a constant.
    fn plain_list(&self, level: u8) -> Vec<DrawItem> {
        let mut record = |_, step| Ok::<_, ()>(record(SpanKind::Constant(1.0), [1.0; 2], step));
        self.selector(0, level).draw_list(None, &mut record, &|_| Appearance::Varied).unwrap()
    }

    fn num_nodes(&self) -> usize {
        (0..self.tree.num_levels()).map(|level| self.tree.nodes(level as u8).len()).sum()
    }
}

const NUM_STEPS: u32 = 8;

fn record(kind: SpanKind, drawn_range: [f64; 2], step: u32) -> SpanRecord {
    let statistics = SpanStatistics { count: 1, min: 0.0, max: 0.0, mean: 0.0, std: 0.0 };
    SpanRecord { start: step, len: 1, window: 1, kind, mask: None, drawn_range, statistics }
}

/// A payload of its own at each step.
fn coded(step: u32) -> SpanRecord {
    let at = PayloadAddress { row: step, node: 0 };
    record(SpanKind::Coded { class: 0, at }, [0.0, 1.0], step)
}

fn volume(items: &[DrawItem]) -> f64 {
    items.iter().map(|i| (0..3).map(|a| i.region[1][a] - i.region[0][a]).product::<f64>()).sum()
}

#[test]
fn every_level_covers_the_volume_once() {
    let volume_of = Volume::new([20, 9, 30], [-5.0, 40.0, 11.0]);
    for level in 0..volume_of.tree.num_levels() as u8 {
        let items = volume_of.plain_list(level);
        assert!(items.iter().all(|i| i.node.level == level));
        assert_eq!(volume(&items), 24.0 * 16.0 * 32.0);
    }
}

#[test]
fn a_missing_child_is_drawn_from_its_parent() {
    let mut sparse = Volume::new([16; 3], [100.0; 3]);
    sparse.tree = Octree::from_levels(vec![vec![0, 1, 2, 4, 5, 6, 7], vec![0]]).unwrap();
    let items = sparse.plain_list(0);
    let parents: Vec<_> = items.iter().filter(|i| i.node.level == 1).map(|i| i.region).collect();
    assert_eq!(parents, [[[8.0, 8.0, 0.0], [16.0, 16.0, 8.0]]]);
    assert_eq!(volume(&items), 4096.0);
}

/// Whether some plane has the later box on its far side, as seen from the eye.
fn is_behind(eye: [f64; 3], [low, high]: [[f64; 3]; 2], [l, h]: [[f64; 3]; 2]) -> bool {
    (0..3).any(|a| (h[a] <= low[a] && eye[a] >= h[a]) || (l[a] >= high[a] && eye[a] <= l[a]))
}

#[test]
fn nothing_is_hidden_by_what_comes_after_it() {
    for eye in [[-9.0, 70.0, 20.0], [33.0, 12.0, 30.0], [80.0, 15.0, -40.0]] {
        let volume = Volume::new([64, 32, 64], eye);
        // Nodes of several levels: some octants of level 2 and 1 are alike.
        let mut errors = Script::new(&volume);
        for (level, brick) in [(2, [0, 0, 0]), (1, [2, 1, 3]), (1, [3, 0, 0])] {
            errors.set(NodeId::new(level, brick), 0, [0.0, 0.0]);
        }
        let items = errors.list(&volume, 3, Tolerances { spatial: 0.1, temporal: 0.0 });
        assert!(items.iter().any(|i| i.node.level == 2) && items.iter().any(|i| i.node.level == 1));
        for (n, first) in items.iter().enumerate() {
            for later in &items[n + 1..] {
                assert!(is_behind(eye, first.region, later.region), "{first:?} before {later:?}");
            }
        }
    }
}

#[test]
fn empty_and_transparent_nodes_are_skipped() {
    let volume = Volume::new([8; 3], [100.0; 3]);
    let appearance = |range: [f64; 2]| match range {
        [_, high] if high < 0.5 => Appearance::Transparent,
        [low, _] if low > 2.0 => Appearance::Uniform([0.5; 4]),
        _ => Appearance::Varied,
    };
    let how = |span: SpanRecord, skips_transparent| {
        let selector = Selector { skips_transparent, ..volume.selector(0, 0) };
        selector.draw_list(None, &mut |_, _| Ok::<_, ()>(span), &appearance).unwrap()[0].how
    };
    let at = PayloadAddress { row: 0, node: 0 };
    let coded = SpanKind::Coded { class: 0, at };
    assert_eq!(how(record(SpanKind::Empty, [f64::NAN; 2], 0), false), How::Skip);
    assert_eq!(how(record(SpanKind::Constant(0.2), [0.2; 2], 0), true), How::Skip);
    assert_eq!(how(record(SpanKind::Constant(0.2), [0.2; 2], 0), false), How::Constant(0.2));
    assert_eq!(how(record(SpanKind::Constant(0.7), [0.7; 2], 0), true), How::Constant(0.7));
    assert_eq!(how(record(coded, [0.1, 0.4], 0), true), How::Skip);
    assert_eq!(how(record(coded, [0.1, 0.6], 0), true), How::Payload);
    assert_eq!(how(record(coded, [2.1, 2.6], 0), true), How::ConstantColor([0.5; 4]));
    let masked = SpanRecord { mask: Some(at), ..record(coded, [2.1, 2.6], 0) };
    assert_eq!(how(masked, true), How::Payload, "a mask has holes");
}

#[test]
fn a_node_of_which_nothing_is_seen_is_one_entry() {
    let volume = Volume::new([32; 3], [100.0; 3]);
    let corner = NodeId::new(0, [3, 3, 3]);
    let mut record = |node, step| {
        let value = if node == corner { 1.0 } else { 0.0 };
        Ok::<_, ()>(record(SpanKind::Constant(value), [value; 2], step))
    };
    let appearance = |range: [f64; 2]| match range[1] > 0.5 {
        true => Appearance::Varied,
        false => Appearance::Transparent,
    };
    let items = volume.selector(0, 0).draw_list(None, &mut record, &appearance).unwrap();
    let levels = [0, 1].map(|level| items.iter().filter(|i| i.node.level == level).count());
    assert_eq!((levels, items.len()), ([8, 7], 15));
    assert_eq!(items.iter().filter(|i| i.how != How::Skip).map(|i| i.node).collect::<Vec<_>>(), [corner]);
}

/// Errors as a test says; 1 elsewhere. Single steps have no temporal error.
struct Script {
    errors: HashMap<Place, [f64; 2]>,
    statistics: StepStatistics,
    tree: Octree,
    first_of_level: Vec<usize>,
}

impl Script {
    fn new(volume: &Volume) -> Self {
        let facts = NodeFacts::default();
        let statistics =
            NodeStatistics { min: 0.0, max: 1.0, mean: 0.5, std: 0.1, temporal_error: 1.0, facts };
        let row = Arc::new(vec![statistics; volume.num_nodes()]);
        let of_time_levels = vec![row; usize::from(num_time_levels(NUM_STEPS))];
        let sizes = (0..volume.tree.num_levels()).map(|level| volume.tree.nodes(level as u8).len());
        let first_of_level = sizes.scan(0, |sum, n| Some(std::mem::replace(sum, *sum + n))).collect();
        Self {
            errors: HashMap::new(),
            statistics: StepStatistics { of_time_levels },
            tree: volume.tree.clone(),
            first_of_level,
        }
    }

    fn node(&self, node: NodeId) -> usize {
        self.first_of_level[usize::from(node.level)] + self.tree.rank(node).unwrap()
    }

    /// Of a node over the time node of a level that holds step 3: in space and in time.
    fn set(&mut self, node: NodeId, time_level: u8, errors: [f64; 2]) {
        let place = Place { node: self.node(node), time: TimeNode::holding(3, time_level) };
        self.errors.insert(place, errors);
    }

    fn set_facts(&mut self, node: NodeId, facts: NodeFacts) {
        let index = self.node(node);
        for row in &mut self.statistics.of_time_levels {
            Arc::make_mut(row)[index].facts = facts;
        }
    }

    fn list(&mut self, volume: &Volume, step: u32, tolerances: Tolerances) -> Vec<DrawItem> {
        self.list_on(&volume.selector(step, 0), tolerances)
    }

    fn list_on(&mut self, selector: &Selector<'_>, tolerances: Tolerances) -> Vec<DrawItem> {
        let statistics = self.statistics.clone();
        let coherence = Coherence { tolerances, statistics: &statistics, errors: self };
        let mut record = |_, step| Ok::<_, ()>(coded(step));
        selector.draw_list(Some(coherence), &mut record, &|_| Appearance::Varied).unwrap()
    }
}

impl NodeErrors for Script {
    fn temporal(&mut self, at: Place) -> f64 {
        assert!(at.time.level > 0, "a single step has no error in time");
        self.errors.get(&at).map_or(1.0, |errors| errors[1])
    }

    fn spatial(&mut self, at: Place) -> f64 {
        self.errors.get(&at).map_or(1.0, |errors| errors[0])
    }

    fn mean_color(&mut self, at: Place) -> [f32; 4] {
        [0.25, 0.5, 0.75, if at.time.level == 1 { 0.0 } else { 0.1 }]
    }
}

#[test]
fn a_brick_is_drawn_with_the_first_of_the_longest_steps_that_it_is_alike_over() {
    let volume = Volume::new([8; 3], [100.0; 3]);
    let node = NodeId::new(0, [0; 3]);
    let mut script = Script::new(&volume);
    let steps = |script: &mut Script, temporal| {
        let items = script.list(&volume, 3, Tolerances { spatial: 0.0, temporal });
        assert_eq!((items.len(), items[0].how), (1, How::Payload));
        items[0].steps.clone()
    };
    // Over two steps 0.2, over four 0.05, over eight 0.3.
    for (level, error) in [(1, 0.2), (2, 0.05), (3, 0.3)] {
        script.set(node, level, [1.0, error]);
    }
    assert_eq!(steps(&mut script, 0.01), 3..4);
    assert_eq!(steps(&mut script, 0.05), 0..4, "also where shorter steps have a larger error");
    assert_eq!(steps(&mut script, 0.3), 0..8);
    script.set_facts(node, NodeFacts { mask_changes: true, is_masked: true, ..NodeFacts::default() });
    assert_eq!(steps(&mut script, 0.3), 3..4, "a mask that changes is never taken from another step");
}

#[test]
fn without_tolerance_only_equal_payloads_are_drawn_from_other_steps() {
    let volume = Volume::new([8; 3], [100.0; 3]);
    let node = NodeId::new(0, [0; 3]);
    let mut script = Script::new(&volume);
    (1..4).for_each(|level| script.set(node, level, [1.0, 0.0]));
    let statistics = script.statistics.clone();
    let coherence =
        Coherence { tolerances: Tolerances::default(), statistics: &statistics, errors: &mut script };
    // Steps 2 and 3 share a payload; 0 and 1 have another.
    let mut record = |_, step: u32| {
        let span = coded(step / 2);
        Ok::<_, ()>(SpanRecord { start: step, ..span })
    };
    let items =
        volume.selector(3, 0).draw_list(Some(coherence), &mut record, &|_| Appearance::Varied).unwrap();
    assert_eq!(items[0].steps, 2..4);
}

#[test]
fn nodes_alike_in_space_and_time_are_drawn_in_their_mean_colour() {
    let volume = Volume::new([32; 3], [100.0; 3]);
    let (root, octant) = (NodeId::new(2, [0; 3]), NodeId::new(1, [1, 0, 1]));
    let mut script = Script::new(&volume);
    let slight = Tolerances { spatial: 0.1, temporal: 0.1 };
    // The root is alike in space over all steps, but not in time; an octant is in both over four steps.
    script.set(root, 3, [0.0, 0.5]);
    script.set(octant, 3, [0.0, 0.5]);
    script.set(octant, 2, [0.1, 0.1]);
    script.set(octant, 0, [0.0, 0.0]);
    let items = script.list(&volume, 3, slight);
    assert_eq!(items.len(), 57);
    let found: Vec<&DrawItem> = items.iter().filter(|i| i.node.level > 0).collect();
    assert_eq!((found.len(), found[0].node, found[0].steps.clone()), (1, octant, 0..4));
    assert_eq!(found[0].how, How::ConstantColor([0.25, 0.5, 0.75, 0.1]));
    // More tolerance in time: the whole volume is one box.
    let all = script.list(&volume, 3, Tolerances { spatial: 0.1, temporal: 0.5 });
    assert_eq!((all.len(), all[0].node, all[0].steps.clone()), (1, root, 0..8));
    // None in space: every brick.
    assert_eq!(script.list(&volume, 3, Tolerances { spatial: 0.0, temporal: 0.5 }).len(), 64);
    // What is masked somewhere has no mean colour.
    script.set_facts(octant, NodeFacts { is_masked: true, ..NodeFacts::default() });
    assert_eq!(script.list(&volume, 3, slight).len(), 64);
    // A mean colour that cannot be seen is not drawn.
    script.set(root, 1, [0.0, 0.0]);
    assert_eq!(script.list(&volume, 3, slight)[0].how, How::Skip);
}

/// A view in which some nodes are too coarse.
struct TooCoarse(Vec<NodeId>);

impl NodeView for TooCoarse {
    fn error(&mut self, node: NodeId) -> f64 {
        f64::from(u8::from(self.0.contains(&node)))
    }

    fn cost(&mut self, _: NodeId) -> f64 {
        1.0
    }

    fn num_bytes(&mut self, _: NodeId) -> usize {
        1
    }

    fn is_resident(&mut self, _: NodeId) -> bool {
        true
    }
}

#[test]
fn the_walk_stops_at_the_cut() {
    let scene = Volume::new([64, 32, 64], [100.0; 3]);
    let mut cut = ActiveCut::new(&scene.tree, &scene.grid, &scene.layout);
    let fine = [NodeId::new(3, [0; 3]), NodeId::new(2, [1, 0, 0]), NodeId::new(1, [2, 0, 1])];
    cut.adapt(&scene.tree, &CutLimits::default(), &mut TooCoarse(fine.to_vec()));
    let list = |level, tolerances, script: &mut Script| {
        script.list_on(&Selector { cut: Some(&cut), ..scene.selector(3, level) }, tolerances)
    };
    let mut script = Script::new(&scene);
    let exact = Tolerances::default();
    let items = list(0, exact, &mut script);
    let drawn: Vec<NodeId> = items.iter().map(|i| i.node).collect();
    assert!(drawn.iter().all(|node| cut.contains(*node)) && drawn.len() == cut.nodes().count());
    assert_eq!((drawn.len(), volume(&items)), (3 + 7 + 8, 64.0 * 32.0 * 64.0));
    // Never finer than the level asked for.
    let items = list(1, exact, &mut script);
    assert_eq!((items.len(), volume(&items)), (3 + 8, 64.0 * 32.0 * 64.0));
    // What is accepted above the cut or on it is drawn in its mean colour.
    let slight = Tolerances { spatial: 0.1, temporal: 0.1 };
    for node in [fine[2], NodeId::new(2, [0, 0, 1])] {
        script.set(node, 2, [0.1, 0.1]);
    }
    let items = list(0, slight, &mut script);
    let plain: Vec<_> =
        items.iter().filter(|i| i.how != How::Payload).map(|i| (i.node.level, &i.how)).collect();
    let color = How::ConstantColor([0.25, 0.5, 0.75, 0.1]);
    assert_eq!(items.len(), 3 + 8);
    assert!(plain.contains(&(1, &color)) && plain.contains(&(2, &color)) && plain.len() == 2, "{plain:?}");
}
