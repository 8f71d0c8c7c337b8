//! Playback as a player does it, without files, threads, GPUs or a clock: cut, wants, loads that take frames, and at rest nothing.

use std::collections::HashSet;

use chronoxel_core::{BrickLayout, Camera, NodeId, Octree, UniformGrid, octree::levels_of};
use chronoxel_stream::{
    ActiveCut, CutLimits, Late, NodeView, Pace, Playback, Playhead, Residency, Shown, State, Tier,
    ViewVolume, Want,
};

const EDGE: usize = 8;
const PAYLOAD: usize = 1000;
const HEIGHT: usize = 512;
const NUM_STEPS: u32 = 40;

type Key = (u32, NodeId);

const REST: Playhead =
    Playhead { num_steps: NUM_STEPS, position: 0.0, steps_per_frame: 0.0, is_looping: true };

struct Player {
    grid: UniformGrid,
    tree: Octree,
    cut: ActiveCut,
    residency: Residency<Key>,
    /// Loads under way, and the frames that they still take.
    loading: Vec<(Key, u32)>,
    camera: Camera,
    /// The volume is transparent below this level of x, by the transfer function.
    transparent_below: f64,
    playback: Playback,
    frame: u64,
    latency: u32,
    num_loaded: u64,
}

/// What a frame did.
struct Frame {
    is_settled: bool,
    num_requests: usize,
    /// Nodes drawn from an ancestor.
    num_missing: usize,
    shown: Shown,
    cost: f64,
}

struct View<'a> {
    grid: &'a UniformGrid,
    volume: ViewVolume,
    transparent_below: f64,
    residency: &'a Residency<Key>,
    /// The step drawn, and the next one, so that no split is done that the next frame cannot show.
    steps: Vec<u32>,
}

impl View<'_> {
    fn region(node: NodeId) -> [[f64; 3]; 2] {
        let size = (EDGE << node.level) as f64;
        let low = node.brick().map(|b| f64::from(b) * size);
        [low, low.map(|l| l + size)]
    }

    fn is_seen(&self, node: NodeId) -> bool {
        let region = Self::region(node);
        self.volume.may_see(region) && region[1][0] > self.transparent_below
    }
}

impl NodeView for View<'_> {
    fn error(&mut self, node: NodeId) -> f64 {
        match self.is_seen(node) {
            true => self.volume.pixels_per_voxel(Self::region(node), node.level, self.grid, HEIGHT),
            false => 0.0,
        }
    }

    fn cost(&mut self, node: NodeId) -> f64 {
        f64::from(u8::from(self.is_seen(node)))
    }

    fn num_bytes(&mut self, _: NodeId) -> usize {
        PAYLOAD
    }

    fn is_resident(&mut self, node: NodeId) -> bool {
        self.steps.iter().all(|step| is_there(self.residency, (*step, node)))
    }
}

fn is_there(residency: &Residency<Key>, key: Key) -> bool {
    matches!(residency.state(&key), State::Resident | State::Failed)
}

fn camera(grid: &UniformGrid, azimuth: f64, zoom: f64) -> Camera {
    Camera::orbit(grid.bounds(), azimuth, 20.0, zoom, Some(30.0), 1.0).unwrap()
}

impl Player {
    fn new(budget: usize, most_in_flight: usize) -> Self {
        let grid = UniformGrid::new([64; 3], [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(EDGE).unwrap();
        let tree = Octree::full(&levels_of(&grid, &layout));
        Self {
            cut: ActiveCut::new(&tree, &grid, &layout),
            residency: Residency::new(budget, NUM_STEPS as usize * PAYLOAD, most_in_flight),
            loading: Vec::new(),
            camera: camera(&grid, 30.0, 1.0),
            transparent_below: 0.0,
            playback: Playback::new(REST, Late::Wait),
            frame: 0,
            latency: 2,
            num_loaded: 0,
            grid,
            tree,
        }
    }

    fn draw(&mut self, limits: &CutLimits, fails: impl Fn(Key) -> bool) -> Frame {
        self.frame += 1;
        self.answer(fails);
        let steps: Vec<u32> = self.playback.coming(1).into_iter().map(|(step, _)| step).collect();
        let mut view = View {
            grid: &self.grid,
            volume: ViewVolume::of_camera(&self.camera, 1.0, &self.grid),
            transparent_below: self.transparent_below,
            residency: &self.residency,
            steps,
        };
        let change = self.cut.adapt(&self.tree, limits, &mut view);
        let drawn: Vec<NodeId> = self.cut.nodes().filter(|n| view.is_seen(*n)).collect();
        let step = self.playback.step();
        let num_missing = drawn.iter().filter(|n| !is_there(&self.residency, (step, **n))).count();
        self.check_cover();
        let mut wants = Vec::new();
        let mut want = |step, node, tier| wants.push(Want { key: (step, node), tier, num_bytes: PAYLOAD });
        for (step, tier) in self.playback.coming(6) {
            drawn.iter().for_each(|node| want(step, *node, tier));
            let children = self.cut.pending_nodes().flat_map(|n| (0..8).filter_map(move |o| n.child(o)));
            children.for_each(|node| want(step, node, tier));
        }
        if self.playback.head().steps_per_frame == 0.0 {
            change.wanted.iter().for_each(|node| want(step, *node, Tier::Needed));
        }
        (0..NUM_STEPS).for_each(|step| want(step, self.tree.root(), Tier::Coarse));
        self.residency.set_wants(wants);
        let requests = self.residency.next_requests();
        self.loading.extend(requests.iter().map(|key| (*key, self.latency)));
        for key in self.residency.take_withdrawn() {
            self.loading.retain(|(loading, _)| *loading != key);
            self.residency.cancelled(key);
        }
        self.check_budget();
        assert_eq!(self.residency.num_in_flight(), self.loading.len());
        let residency = &self.residency;
        let shown = self.playback.advance(&mut |step| drawn.iter().all(|n| is_there(residency, (step, *n))));
        let is_settled = change.is_settled && self.loading.is_empty();
        Frame { is_settled, num_requests: requests.len(), num_missing, shown, cost: drawn.len() as f64 }
    }

    fn answer(&mut self, fails: impl Fn(Key) -> bool) {
        self.loading.iter_mut().for_each(|(_, left)| *left = left.saturating_sub(1));
        let (ended, loading) = self.loading.iter().partition::<Vec<_>, _>(|(_, left)| *left == 0);
        self.loading = loading;
        for (key, _) in ended {
            match fails(key) {
                true => self.residency.failed(key),
                false => self.num_loaded += u64::from(self.residency.loaded(key, PAYLOAD)),
            }
            self.check_budget();
        }
    }

    fn check_budget(&mut self) {
        let r = &mut self.residency;
        assert!(r.held_bytes() + r.reserved_bytes() <= r.budget_bytes());
        r.take_evicted();
    }

    fn check_cover(&self) {
        let volume: usize = self.cut.nodes().map(|n| 1usize << (3 * n.level)).sum();
        assert_eq!(volume, 512, "the full tree has no missing octants");
        let nodes: HashSet<NodeId> = self.cut.nodes().collect();
        let top = self.tree.root().level;
        let has_ancestor = |n: &NodeId| {
            (n.level..top)
                .scan(*n, |at, _| {
                    *at = at.parent();
                    Some(*at)
                })
                .any(|a| nodes.contains(&a))
        };
        assert!(!nodes.iter().any(has_ancestor));
    }

    /// Frames until nothing changes, at most so many.
    fn rest(&mut self, limits: &CutLimits, most: u32) -> u32 {
        (0..most)
            .find(|_| {
                let frame = self.draw(limits, |_| false);
                frame.is_settled && frame.num_requests == 0
            })
            .expect("it settles")
    }
}

#[test]
fn a_still_picture_refines_fully_and_then_nothing_is_done() {
    let mut player = Player::new(2000 * PAYLOAD, 100);
    let limits = CutLimits { most_splits_per_frame: 20, ..CutLimits::default() };
    player.rest(&limits, 200);
    assert_eq!(player.cut.nodes().count(), 512);
    let loaded = player.num_loaded;
    for _ in 0..10 {
        let frame = player.draw(&limits, |_| false);
        assert!(frame.is_settled && frame.num_requests == 0 && frame.num_missing == 0);
    }
    assert_eq!(player.num_loaded, loaded);
}

#[test]
fn a_still_picture_settles_within_tight_limits() {
    let mut player = Player::new(300 * PAYLOAD, 100);
    let limits = CutLimits { bytes: 150 * PAYLOAD, most_splits_per_frame: 8, ..CutLimits::default() };
    for azimuth in [0.0, 70.0, 200.0] {
        player.camera = camera(&player.grid, azimuth, 3.0);
        player.rest(&limits, 300);
        assert!((140..=150).contains(&player.cut.nodes().count()));
    }
    // A transfer function that hides half of the volume leaves more for the rest.
    let finest = |player: &Player| player.cut.nodes().filter(|n| n.level == 0 && n.brick()[0] >= 4).count();
    let before = finest(&player);
    player.transparent_below = 32.0;
    player.rest(&limits, 300);
    assert!(finest(&player) > before, "{} {before}", finest(&player));
}

/// A series many times larger than memory plays round and round, forwards and backwards, at any speed.
#[test]
fn a_series_larger_than_memory_plays_without_misses() {
    let limits = CutLimits { bytes: 80 * PAYLOAD, most_splits_per_frame: 8, ..CutLimits::default() };
    for steps_per_frame in [1.0, -1.0, 0.5, 8.0] {
        let mut player = Player::new(1100 * PAYLOAD, 400);
        player.playback.set_head(Playhead { steps_per_frame, ..REST });
        let (mut num_missing, mut num_late) = (0, 0);
        for frame in 0..150 {
            let drawn = player.draw(&limits, |_| false);
            num_missing += drawn.num_missing;
            num_late += usize::from(frame >= 30 && drawn.shown == Shown::Late);
        }
        assert_eq!(num_late, 0, "at {steps_per_frame}");
        assert!(num_missing <= 2, "{num_missing} at {steps_per_frame}: only the first frames have nothing");
        assert!(player.cut.nodes().count() > 70, "{}", player.cut.nodes().count());
    }
}

/// Where the loads cannot keep up, steps come late or fewer of them, and each that is shown is whole.
#[test]
fn slow_loads_delay_or_drop_steps() {
    let limits = CutLimits { bytes: 80 * PAYLOAD, most_splits_per_frame: 8, ..CutLimits::default() };
    for late in [Late::Wait, Late::Drop] {
        let mut player = Player::new(1100 * PAYLOAD, 60);
        player.playback = Playback::new(Playhead { steps_per_frame: 1.0, ..REST }, late);
        let (mut num_missing, mut num_shown) = (0, 0);
        for frame in 0..400 {
            let drawn = player.draw(&limits, |_| false);
            if frame >= 100 {
                num_missing += drawn.num_missing;
                num_shown += usize::from(drawn.shown == Shown::Next);
            }
        }
        assert_eq!(num_missing, 0, "{late:?}");
        // Thirty loads a frame, for eighty payloads a step and those of splits that wait.
        assert!((60..=150).contains(&num_shown), "{num_shown} {late:?}");
        assert_eq!(
            player.playback.num_dropped() > 100,
            late == Late::Drop,
            "{}",
            player.playback.num_dropped()
        );
    }
}

/// Everything at once: the camera jumps, the slider is dragged, the transfer function and the budget change, some payloads never load.
#[test]
fn nothing_breaks_whatever_happens() {
    let mut player = Player::new(500 * PAYLOAD, 100);
    let mut limits = CutLimits { most_splits_per_frame: 10, ..CutLimits::default() };
    let broken = |(step, node): Key| node.morton % 11 == 5 || step == 13;
    for n in 0..400u32 {
        let hash = n.wrapping_mul(2_654_435_761) >> 8;
        match n % 7 {
            0 => player.camera = camera(&player.grid, f64::from(hash % 360), 1.0 + f64::from(hash % 5)),
            2 => {
                let position = f64::from(hash % NUM_STEPS);
                player.playback.set_head(Playhead { position, ..player.playback.head() });
            }
            3 => {
                let steps_per_frame = f64::from(hash % 5) - 2.0;
                player.playback.set_head(Playhead { steps_per_frame, ..player.playback.head() });
            }
            4 => player.transparent_below = f64::from(hash % 60),
            5 => limits.bytes = (20 + hash as usize % 300) * PAYLOAD,
            6 => {
                player.residency.set_budget(hash as usize % 800 * PAYLOAD);
                player.check_budget();
            }
            _ => player.latency = 1 + hash % 5,
        }
        player.draw(&limits, broken);
    }
    // Left alone, it comes to rest; what cannot be loaded is not asked for any more.
    player.residency.set_budget(1500 * PAYLOAD);
    player.playback.set_head(REST);
    let rests = (0..300).any(|_| {
        let frame = player.draw(&limits, broken);
        frame.is_settled && frame.num_requests == 0
    });
    assert!(rests);
    let counts = player.residency.counts();
    assert!(counts.hits > 0 && counts.misses > 0 && counts.failures > 0 && counts.evictions > 0);
}

/// The cut follows the cost that a target for the time of a frame leaves it.
#[test]
fn a_target_is_held_by_the_cut() {
    let mut player = Player::new(2000 * PAYLOAD, 100);
    let mut pace = Pace::new(20.0);
    let mut times = Vec::new();
    for frame in 0..120 {
        player.camera = camera(&player.grid, f64::from(frame), 1.0);
        let limits = CutLimits { cost: pace.cost_limit(), most_splits_per_frame: 40, ..CutLimits::default() };
        let drawn = player.draw(&limits, |_| false);
        // 3 ms, and 0.1 ms for each node; from frame 60 on a machine a quarter as fast.
        let slope = if frame < 60 { 0.1 } else { 0.4 };
        let ms = 3.0 + slope * drawn.cost;
        pace.measured(ms, drawn.cost);
        times.push(ms);
    }
    for window in [30..60, 90..120] {
        let mut window = times[window].to_vec();
        window.sort_by(f64::total_cmp);
        let median = window[15];
        assert!((median / 20.0 - 1.0).abs() < 0.15, "{median} ms");
    }
}
