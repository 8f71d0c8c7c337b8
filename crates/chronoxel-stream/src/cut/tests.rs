//! Cuts under made-up views: after every frame they cover the volume, keep their limits, and get better.

use std::collections::{HashMap, HashSet};

use chronoxel_core::octree::levels_of;

use super::*;
use crate::random::Random;

const EDGE: usize = 8;

struct Scene {
    grid: UniformGrid,
    layout: BrickLayout,
    tree: Octree,
}

impl Scene {
    fn full(dims: [usize; 3]) -> Self {
        let grid = UniformGrid::new(dims, [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(EDGE).unwrap();
        Self { grid, layout, tree: Octree::full(&levels_of(&grid, &layout)) }
    }

    /// A tree from which subtrees are missing.
    fn adaptive(dims: [usize; 3], random: &mut Random) -> Self {
        let full = Self::full(dims);
        let mut levels: Vec<Vec<u64>> = vec![full.tree.nodes(full.tree.root().level).to_vec()];
        for level in (0..full.tree.root().level).rev() {
            let parents = levels.last().unwrap();
            let exists = |m: &&u64| parents.binary_search(&(**m >> 3)).is_ok() && random.chance(0.7);
            levels.push(full.tree.nodes(level).iter().filter(exists).copied().collect());
        }
        levels.reverse();
        Self { tree: Octree::from_levels(levels).unwrap(), ..full }
    }

    fn cut(&self) -> ActiveCut {
        ActiveCut::new(&self.tree, &self.grid, &self.layout)
    }

    fn nodes(&self) -> Vec<NodeId> {
        let levels = 0..self.tree.num_levels() as u8;
        levels
            .flat_map(|level| self.tree.nodes(level).iter().map(move |&morton| NodeId { level, morton }))
            .collect()
    }

    fn children(&self, node: NodeId) -> Vec<NodeId> {
        let children = (0..8).filter_map(|octant| node.child(octant));
        children.filter(|child| self.tree.rank(*child).is_some()).collect()
    }

    /// Bricks of level 0 that a node's box holds inside the grid.
    fn volume(&self, node: NodeId) -> u64 {
        let bricks = self.grid.dims.map(|n| n.div_ceil(EDGE) as u64);
        (0..3)
            .map(|a| {
                let low = u64::from(node.brick()[a]) << node.level;
                bricks[a].min(low + (1 << node.level)).saturating_sub(low)
            })
            .product()
    }

    /// Volume drawn from a node and all below it, where each node on the cut draws itself; panics where one lies below another.
    fn drawn(&self, cut: &ActiveCut, node: NodeId) -> u64 {
        let children = self.children(node);
        if cut.contains(node) {
            let mut below = children;
            while let Some(child) = below.pop() {
                assert!(!cut.contains(child), "{child:?} below {node:?}");
                below.extend(self.children(child));
            }
            return self.volume(node);
        }
        assert!(!children.is_empty(), "nothing draws {node:?}");
        let of_children: u64 = children.iter().map(|c| self.volume(*c)).sum();
        let missing = self.volume(node) - of_children;
        assert_eq!(missing > 0, cut.partial_nodes().any(|n| n == node), "{node:?}");
        missing + children.into_iter().map(|child| self.drawn(cut, child)).sum::<u64>()
    }

    fn check_cover(&self, cut: &ActiveCut) {
        assert_eq!(self.drawn(cut, self.tree.root()), self.volume(self.tree.root()));
        assert!(cut.nodes().chain(cut.partial_nodes()).all(|node| self.tree.rank(node).is_some()));
    }
}

#[derive(Clone, Default)]
struct Script {
    errors: HashMap<NodeId, f64>,
    costs: HashMap<NodeId, f64>,
    bytes: HashMap<NodeId, usize>,
    absent: HashSet<NodeId>,
}

impl Script {
    /// Everything drawn at cost 1 and 1 byte; errors double from level to level.
    fn plain(scene: &Scene) -> Self {
        let nodes = scene.nodes();
        Self {
            errors: nodes.iter().map(|n| (*n, f64::from(1u32 << n.level))).collect(),
            costs: nodes.iter().map(|n| (*n, 1.0)).collect(),
            bytes: nodes.iter().map(|n| (*n, 1)).collect(),
            absent: HashSet::new(),
        }
    }

    /// Errors, costs and sizes at random, some nodes culled.
    fn random(scene: &Scene, random: &mut Random) -> Self {
        let mut script = Self::default();
        for node in scene.nodes() {
            let is_culled = random.chance(0.2);
            let error = if is_culled { 0.0 } else { random.unit() * f64::from(1u32 << node.level) };
            script.errors.insert(node, error);
            script.costs.insert(node, if is_culled { 0.0 } else { 1.0 + random.unit() });
            script.bytes.insert(node, if random.chance(0.1) { 0 } else { 50 + random.below(50) });
        }
        script
    }

    /// Cost and bytes of a cut, by its definition.
    fn used(&self, scene: &Scene, cut: &ActiveCut) -> (f64, usize) {
        let whole = cut.nodes().map(|n| (self.costs[&n], self.bytes[&n]));
        let part = cut.partial_nodes().map(|n| {
            let octants = (0..8).filter_map(|o| n.child(o)).filter(|c| scene.volume(*c) > 0);
            let num_missing = octants.filter(|c| scene.tree.rank(*c).is_none()).count();
            (self.costs[&n] * num_missing as f64 / 8.0, self.bytes[&n])
        });
        whole.chain(part).fold((0.0, 0), |(cost, bytes), (c, b)| (cost + c, bytes + b))
    }
}

impl NodeView for Script {
    fn error(&mut self, node: NodeId) -> f64 {
        self.errors[&node]
    }

    fn cost(&mut self, node: NodeId) -> f64 {
        self.costs[&node]
    }

    fn num_bytes(&mut self, node: NodeId) -> usize {
        self.bytes[&node]
    }

    fn is_resident(&mut self, node: NodeId) -> bool {
        !self.absent.contains(&node)
    }
}

fn unlimited() -> CutLimits {
    CutLimits::default()
}

#[test]
fn without_limits_one_frame_reaches_the_finest_cut() {
    let mut random = Random(1);
    for scene in [Scene::full([70, 33, 64]), Scene::adaptive([128, 64, 96], &mut random)] {
        for finest_level in [0, 2] {
            let mut cut = scene.cut();
            let limits = CutLimits { finest_level, ..unlimited() };
            let mut view = Script::plain(&scene);
            assert!(!cut.adapt(&scene.tree, &limits, &mut view).is_settled);
            scene.check_cover(&cut);
            let finest = |n: &NodeId| n.level == finest_level || scene.children(*n).is_empty();
            assert!(cut.nodes().all(|n| finest(&n)));
            let change = cut.adapt(&scene.tree, &limits, &mut view);
            assert_eq!(change, CutChange { is_settled: true, ..CutChange::default() });
        }
        // A coarser finest level merges again.
        let mut cut = scene.cut();
        cut.adapt(&scene.tree, &unlimited(), &mut Script::plain(&scene));
        cut.adapt(&scene.tree, &CutLimits { finest_level: 2, ..unlimited() }, &mut Script::plain(&scene));
        scene.check_cover(&cut);
        assert!(cut.nodes().all(|n| n.level >= 2));
    }
}

#[test]
fn the_largest_errors_split_first() {
    let scene = Scene::full([64; 3]);
    let mut cut = scene.cut();
    let mut view = Script::plain(&scene);
    let near = NodeId::new(2, [1, 0, 1]);
    view.errors.insert(near, 7.0);
    let limits = CutLimits { most_splits_per_frame: 2, ..unlimited() };
    assert_eq!(cut.adapt(&scene.tree, &limits, &mut view).splits, [scene.tree.root(), near]);
    let next = cut.adapt(&scene.tree, &limits, &mut view).splits;
    assert!(next.iter().all(|n| n.level == 2) && next.len() == 2, "{next:?}");
}

#[test]
fn what_is_culled_does_not_split_and_merges_only_for_room() {
    let scene = Scene::full([32; 3]);
    let mut cut = scene.cut();
    let mut view = Script::plain(&scene);
    cut.adapt(&scene.tree, &unlimited(), &mut view);
    let [culled, seen] = [[0, 0, 0], [1, 0, 0]].map(|brick| NodeId::new(1, brick));
    let mut left_out = scene.children(culled);
    left_out.push(culled);
    for node in &left_out {
        view.errors.insert(*node, 0.0);
        view.costs.insert(*node, 0.0);
    }
    assert!(cut.adapt(&scene.tree, &unlimited(), &mut view).is_settled, "it stays until room is needed");
    let tight = CutLimits { bytes: 57, ..unlimited() };
    assert_eq!(cut.adapt(&scene.tree, &tight, &mut view).merges, [culled]);
    // Seen again, at a time without room, it takes that of a node with a smaller error.
    view.errors.insert(culled, 3.0);
    view.errors.insert(seen, 0.5);
    let change = cut.adapt(&scene.tree, &tight, &mut view);
    assert_eq!((change.splits, change.merges), (vec![culled], vec![seen]));
    // All others have 2.
    view.errors.insert(seen, 2.05);
    assert!(cut.adapt(&scene.tree, &tight, &mut view).is_settled, "hardly better is not worth an exchange");
    scene.check_cover(&cut);
}

#[test]
fn what_shows_no_error_merges_where_that_is_cheaper_to_draw() {
    let scene = Scene::full([16; 3]);
    let mut cut = scene.cut();
    let mut view = Script::plain(&scene);
    cut.adapt(&scene.tree, &unlimited(), &mut view);
    view.errors.insert(scene.tree.root(), 0.0);
    view.absent.insert(scene.tree.root());
    let change = cut.adapt(&scene.tree, &unlimited(), &mut view);
    assert_eq!((change.merges, change.wanted), (vec![], vec![scene.tree.root()]));
    view.absent.clear();
    assert_eq!(cut.adapt(&scene.tree, &unlimited(), &mut view).merges, [scene.tree.root()]);
}

#[test]
fn a_split_waits_for_its_children_or_yields() {
    let scene = Scene::full([32; 3]);
    let mut cut = scene.cut();
    let mut view = Script::plain(&scene);
    let limits = CutLimits { most_splits_per_frame: 1, ..unlimited() };
    cut.adapt(&scene.tree, &limits, &mut view);
    let [first, second] = [[0, 0, 0], [1, 1, 1]].map(|brick| NodeId::new(1, brick));
    view.errors.insert(first, 9.0);
    view.absent = scene.children(first).into_iter().chain(scene.children(second)).collect();
    let change = cut.adapt(&scene.tree, &limits, &mut view);
    assert_eq!((change.splits.len(), &change.wanted), (0, &scene.children(first)));
    // Some have come: the others are still wanted. A candidate that is hardly better changes nothing.
    scene.children(first).iter().take(3).for_each(|n| assert!(view.absent.remove(n)));
    view.errors.insert(second, 9.5);
    let change = cut.adapt(&scene.tree, &limits, &mut view);
    assert_eq!(change.wanted, scene.children(first)[3..]);
    assert_eq!(cut.pending_nodes().collect::<Vec<_>>(), [first]);
    view.errors.insert(second, 20.0);
    assert_eq!(cut.adapt(&scene.tree, &limits, &mut view).wanted, scene.children(second));
    view.absent.clear();
    assert_eq!(cut.adapt(&scene.tree, &limits, &mut view).splits, [second]);
    assert_eq!(cut.adapt(&scene.tree, &limits, &mut view).splits, [first]);
    scene.check_cover(&cut);
}

#[test]
fn missing_octants_are_drawn_from_the_node_and_counted() {
    let mut scene = Scene::full([16; 3]);
    scene.tree = Octree::from_levels(vec![vec![0, 1, 2, 4, 5, 6], vec![0]]).unwrap();
    let mut view = Script::plain(&scene);
    view.bytes.insert(scene.tree.root(), 10);
    view.costs.insert(scene.tree.root(), 4.0);
    for (cost, bytes, fits) in [(7.0, 16, true), (6.9, 16, false), (7.0, 15, false)] {
        let mut cut = scene.cut();
        let change = cut.adapt(&scene.tree, &CutLimits { cost, bytes, ..unlimited() }, &mut view);
        assert_eq!(change.splits.len(), usize::from(fits), "{cost} {bytes}");
        assert_eq!(cut.partial_nodes().count(), usize::from(fits));
        scene.check_cover(&cut);
    }
    // A child that would lie outside the grid is not missing.
    let thin = Scene::full([16, 16, 8]);
    let mut cut = thin.cut();
    cut.adapt(&thin.tree, &unlimited(), &mut Script::plain(&thin));
    assert_eq!(cut.partial_nodes().count(), 0);
}

/// Everything changes all the time: errors, what is culled, limits, what is resident.
#[test]
fn any_trace_leaves_a_cover_within_its_limits() {
    for seed in 0..60 {
        let random = &mut Random(seed);
        let dims = [0; 3].map(|_| 1 + random.below(80));
        let scene = if seed % 3 == 0 { Scene::full(dims) } else { Scene::adaptive(dims, random) };
        let mut cut = scene.cut();
        let mut view = Script::random(&scene, random);
        let mut limits = unlimited();
        for _ in 0..40 {
            if random.chance(0.3) {
                view = Script::random(&scene, random);
                let absent = random.unit();
                view.absent = scene.nodes().into_iter().filter(|_| random.chance(absent)).collect();
            }
            if random.chance(0.3) {
                let scale = scene.tree.nodes(0).len().max(4);
                limits = CutLimits {
                    cost: if random.chance(0.3) { f64::INFINITY } else { random.unit() * 2.0 * scale as f64 },
                    bytes: 100 + random.below(100 * scale),
                    finest_level: random.below(scene.tree.num_levels()) as u8 / 2,
                    most_splits_per_frame: 1 + random.below(40),
                };
            }
            let change = cut.adapt(&scene.tree, &limits, &mut view);
            scene.check_cover(&cut);
            let (cost, bytes) = view.used(&scene, &cut);
            let is_root = cut.contains(scene.tree.root());
            let fits = cost <= limits.cost * (1.0 + 1e-8) && bytes <= limits.bytes;
            assert!(fits || is_root, "{cost} {bytes} over {limits:?}");
            assert!(change.splits.len() <= limits.most_splits_per_frame);
            assert!(cut.nodes().all(|n| n.level >= limits.finest_level));
            assert!(change.wanted.iter().all(|n| view.absent.contains(n)));
        }
    }
}

/// With view and limits fixed, exchanges lower the error of what is not split, and end.
#[test]
fn exchanges_lower_the_error_and_end() {
    let mut num_exchanges = 0;
    for seed in 0..60 {
        let random = &mut Random(seed ^ 0xabc);
        let scene = Scene::adaptive([64, 40, 64], random);
        let mut cut = scene.cut();
        let mut limits = unlimited();
        for _ in 0..4 {
            let mut view = Script::random(&scene, random);
            let scale = scene.tree.nodes(0).len().max(4);
            if random.chance(0.5) {
                limits.bytes = 200 + random.below(60 * scale);
            } else {
                limits.cost = 4.0 + random.unit() * scale as f64;
            }
            limits.most_splits_per_frame = 1 + random.below(30);
            let mut num_frames = 0;
            // The first frame may have to merge for its limits.
            cut.adapt(&scene.tree, &CutLimits { most_splits_per_frame: 0, ..limits }, &mut view);
            loop {
                let change = cut.adapt(&scene.tree, &limits, &mut view);
                let sum = |nodes: &[NodeId]| nodes.iter().map(|n| view.errors[n]).sum::<f64>();
                let (split, merged) = (sum(&change.splits), sum(&change.merges));
                assert!(change.splits.is_empty() && merged == 0.0 || merged < split, "{split} {merged}");
                num_exchanges += usize::from(merged > 0.0);
                num_frames += 1;
                assert!(num_frames < 400, "no end");
                if change.is_settled {
                    break;
                }
            }
            let before = cut.clone();
            for _ in 0..3 {
                assert!(cut.adapt(&scene.tree, &limits, &mut view).is_settled);
            }
            assert_eq!(cut, before);
        }
    }
    assert!(num_exchanges > 100, "{num_exchanges}");
}

#[test]
fn a_first_frame_is_refined_whatever_is_resident() {
    let scene = Scene::full([64; 3]);
    let mut view = Script::plain(&scene);
    view.absent = scene.nodes().into_iter().collect();
    let mut cut = scene.cut();
    let limits = CutLimits { bytes: 200, most_splits_per_frame: 1, ..unlimited() };
    assert!(cut.refine_fully(&scene.tree, &limits, &mut view).is_settled);
    scene.check_cover(&cut);
    assert!((190..=200).contains(&cut.nodes().count()));
}

/// A flight of an eye past a volume: near nodes are fine, far ones coarse, and what is behind costs nothing.
#[test]
fn refinement_follows_the_eye() {
    let scene = Scene::full([128; 3]);
    let mut cut = scene.cut();
    let limits = CutLimits { cost: 300.0, bytes: 320, most_splits_per_frame: 16, ..unlimited() };
    for frame in 0..60 {
        let eye = f64::from(frame) * 2.0;
        let mut view = Script::plain(&scene);
        for (node, error) in &mut view.errors {
            let [x, y, z] = node.brick().map(|b| (f64::from(b) + 0.5) * f64::from(8u32 << node.level));
            let distance = ((x - eye).powi(2) + (y - 20.0).powi(2) + (z - 20.0).powi(2)).sqrt();
            *error *= 100.0 / distance.max(1.0);
        }
        cut.adapt(&scene.tree, &limits, &mut view);
        scene.check_cover(&cut);
        let (cost, bytes) = view.used(&scene, &cut);
        assert!(cost <= 300.0 && bytes <= 320);
        if frame > 25 {
            let here = NodeId::new(0, [(eye / 8.0) as u32, 2, 2]);
            assert!(cut.contains(here), "{here:?} at frame {frame}");
        }
    }
}
