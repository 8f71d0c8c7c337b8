//! Scripted traces: a made-up shell with slow and failing loads, checked after every event.

use std::collections::BTreeMap;

use super::*;
use crate::{Playhead, random::Random, scrubbing};

type Key = (u32, u32);

/// What a shell would do, without files or threads.
struct Shell {
    residency: Residency<Key>,
    memory: BTreeMap<Key, usize>,
    loading: Vec<Key>,
    budget: usize,
    size: fn(Key) -> usize,
    wants: Vec<Want<Key>>,
    num_begun: u64,
    num_ended: u64,
}

/// What a payload takes in fact.
fn size(key: Key) -> usize {
    10 + (key.0.wrapping_mul(31) ^ key.1.wrapping_mul(17)) as usize % 23
}

const BOUND: usize = 32;

impl Shell {
    fn new(budget: usize, coarse: usize, most_in_flight: usize) -> Self {
        Self {
            residency: Residency::new(budget, coarse, most_in_flight),
            memory: BTreeMap::new(),
            loading: Vec::new(),
            budget,
            size,
            wants: Vec::new(),
            num_begun: 0,
            num_ended: 0,
        }
    }

    fn check(&mut self) {
        for key in self.residency.take_evicted() {
            assert!(self.memory.remove(&key).is_some(), "{key:?} was not in memory");
        }
        let r = &self.residency;
        assert!(r.held_bytes() + r.reserved_bytes() <= self.budget);
        assert_eq!(r.held_bytes(), self.memory.values().sum::<usize>());
        assert!(r.reserved_bytes() <= self.loading.len() * BOUND);
        assert_eq!(r.num_in_flight(), self.loading.len());
        assert!(self.memory.keys().all(|key| r.state(key) == State::Resident));
        assert!(self.loading.iter().all(|key| r.state(key) == State::Loading));
        let is_known = |w: &Want<Key>| r.state(&w.key) != State::Absent;
        assert!(self.wants.iter().all(is_known));
        assert_eq!(r.counts().requests, self.num_begun);
        assert_eq!(self.num_begun, self.num_ended + self.loading.len() as u64);
    }

    fn want(&mut self, wants: Vec<Want<Key>>) {
        self.wants.clone_from(&wants);
        self.residency.set_wants(wants);
        self.check();
    }

    fn tier(&self, key: &Key) -> Option<Tier> {
        self.wants.iter().filter(|w| w.key == *key).map(|w| w.tier).min()
    }

    fn begin(&mut self) -> Vec<Key> {
        let requests = self.residency.next_requests();
        let least_urgent = requests.iter().filter_map(|key| self.tier(key)).max();
        for key in &self.residency.evicted {
            let (gone, come) = (self.tier(key), least_urgent.expect("only requests make room"));
            // Within their share, coarse payloads displace what is only coming.
            let is_allowed = gone > Some(come) || come >= Tier::Coarse && gone > Some(Tier::Needed);
            assert!(gone.is_none() || is_allowed, "{gone:?} gave way to {come:?}");
        }
        self.num_begun += requests.len() as u64;
        self.loading.extend(&requests);
        self.check();
        requests
    }

    fn end(&mut self, index: usize, fate: Fate) {
        let key = self.loading.swap_remove(index);
        self.num_ended += 1;
        match fate {
            Fate::Loaded => {
                if self.residency.loaded(key, (self.size)(key)) {
                    self.memory.insert(key, (self.size)(key));
                }
            }
            Fate::Failed => self.residency.failed(key),
            Fate::Cancelled => self.residency.cancelled(key),
        }
        self.check();
    }

    /// Loads until nothing is left to do.
    fn run(&mut self) {
        for _ in 0..100_000 {
            self.begin();
            if self.loading.is_empty() {
                return;
            }
            while !self.loading.is_empty() {
                self.end(0, Fate::Loaded);
            }
        }
        panic!("it never rests");
    }
}

#[derive(Clone, Copy)]
enum Fate {
    Loaded,
    Failed,
    Cancelled,
}

fn want(key: Key, tier: Tier) -> Want<Key> {
    Want { key, tier, num_bytes: BOUND }
}

fn wants(keys: impl IntoIterator<Item = Key>, tier: Tier) -> Vec<Want<Key>> {
    keys.into_iter().map(|key| want(key, tier)).collect()
}

#[test]
fn the_most_urgent_is_loaded_first_and_leaves_last() {
    let mut shell = Shell { size: |_| BOUND, ..Shell::new(3 * BOUND, 0, 8) };
    let tiers = [Tier::Rest, Tier::Coarse, Tier::Coming(2), Tier::Coming(1), Tier::Needed];
    shell.want(tiers.iter().enumerate().map(|(n, tier)| want((n as u32, 0), *tier)).collect());
    assert_eq!(shell.begin(), [(4, 0), (3, 0), (2, 0)]);
    shell.run();
    let held = |shell: &Shell| shell.memory.keys().map(|k| k.0).collect::<Vec<_>>();
    assert_eq!(held(&shell)[..], [2, 3, 4]);
    // One more is needed: the least urgent leaves. Needed ones leave for nothing that is no more urgent.
    let mut now = shell.wants.clone();
    now.push(want((9, 9), Tier::Needed));
    shell.want(now);
    shell.run();
    assert_eq!(held(&shell)[..], [3, 4, 9]);
    shell.want(wants([(3, 0), (4, 0), (9, 9), (7, 7)], Tier::Needed));
    assert_eq!((shell.begin(), shell.residency.state(&(7, 7))), (vec![], State::Queued));
    // What is wanted no more leaves, the least recently used first.
    shell.residency.touch(&(4, 0));
    shell.residency.touch(&(9, 9));
    shell.want(wants([(7, 7)], Tier::Rest));
    shell.begin();
    assert_eq!(held(&shell)[..], [4, 9]);
}

#[test]
fn what_can_never_fit_stops_nothing_else() {
    let mut shell = Shell::new(BOUND, 0, 8);
    shell
        .want(vec![Want { key: (0, 0), tier: Tier::Needed, num_bytes: BOUND + 1 }, want((1, 0), Tier::Rest)]);
    assert_eq!(shell.begin(), [(1, 0)]);
}

#[test]
fn a_frame_transfers_no_more_than_its_limit() {
    let mut shell = Shell::new(10 * BOUND, 0, 8);
    shell.want(wants((0..9).map(|n| (n, 0)), Tier::Needed));
    let r = &mut shell.residency;
    assert_eq!(r.next_requests_within(3 * BOUND + 1), [(0, 0), (1, 0), (2, 0)]);
    assert_eq!(r.next_requests_within(1), [(3, 0)], "one at least");
    assert_eq!(r.next_requests().len(), 4, "eight in flight at most");
}

#[test]
fn coarse_payloads_keep_their_share() {
    let mut shell = Shell::new(10 * BOUND, 3 * BOUND, 64);
    let play = |step: u32| {
        let mut all = wants((0..20).map(|n| (step, n)), Tier::Needed);
        all.extend(wants((0..20).map(|n| (step + 1, n)), Tier::Coming(1)));
        all.extend(wants((0..3).map(|n| (n, 1000)), Tier::Coarse));
        all
    };
    for step in 5..30 {
        shell.want(play(step));
        shell.run();
        assert!((0..3).all(|n| shell.memory.contains_key(&(n, 1000))), "step {step}");
        assert!(shell.memory.keys().filter(|k| k.0 == step).count() >= 7);
    }
    // Without coarse wants, their share is free.
    shell.want(wants((0..200).map(|n| (50, n)), Tier::Needed));
    shell.run();
    assert!(shell.memory.keys().all(|k| k.0 == 50));
    // A needed one that is coarse as well counts once.
    let mut all = wants([(0, 1000)], Tier::Coarse);
    all.extend(wants([(0, 1000)], Tier::Needed));
    shell.want(all.clone());
    assert_eq!(shell.begin(), [(0, 1000)]);
    shell.run();
    let misses = shell.residency.counts().misses;
    shell.want(all);
    assert_eq!(shell.residency.counts().misses, misses, "it was needed before");
}

#[test]
fn withdrawn_loads_may_be_cancelled_or_come_all_the_same() {
    let mut shell = Shell::new(10 * BOUND, 0, 8);
    shell.want(wants([(0, 0), (1, 0), (2, 0)], Tier::Needed));
    shell.begin();
    shell.want(wants([(2, 0)], Tier::Needed));
    let mut withdrawn = shell.residency.take_withdrawn();
    withdrawn.sort();
    assert_eq!((withdrawn, shell.residency.take_withdrawn()), (vec![(0, 0), (1, 0)], vec![]));
    // One is wanted again, but was cancelled by then: it is loaded anew. The other arrives, and stays while there is room.
    shell.want(wants([(0, 0), (2, 0)], Tier::Needed));
    shell.end(0, Fate::Cancelled);
    assert_eq!(shell.begin(), [(0, 0)]);
    let arrived = shell.loading.iter().position(|k| *k == (1, 0)).unwrap();
    shell.end(arrived, Fate::Loaded);
    assert_eq!(shell.residency.state(&(1, 0)), State::Resident);
    assert_eq!(shell.residency.counts().wasted, 1);
    assert!(!shell.residency.loaded((8, 8), 1), "nobody asked for it");
}

#[test]
fn a_failing_load_is_tried_three_times() {
    let mut shell = Shell::new(10 * BOUND, 0, 8);
    shell.want(wants([(0, 0)], Tier::Needed));
    for n in 0..3 {
        assert_eq!((shell.begin(), shell.residency.take_failed()), (vec![(0, 0)], vec![]), "try {n}");
        shell.end(0, Fate::Failed);
    }
    assert_eq!((shell.begin(), shell.residency.state(&(0, 0))), (vec![], State::Failed));
    assert_eq!(shell.residency.take_failed(), [(0, 0)]);
    shell.want(wants([(0, 0), (1, 0)], Tier::Needed));
    assert_eq!(shell.begin(), [(1, 0)]);
    shell.residency.forget_failures();
    assert_eq!(shell.begin(), [(0, 0)]);
}

#[test]
fn a_shrinking_budget_holds_at_once() {
    let mut shell = Shell::new(20 * BOUND, 0, 4);
    shell.want(wants((0..12).map(|n| (n, 0)), Tier::Needed));
    shell.begin();
    (0..4).for_each(|_| shell.end(0, Fate::Loaded));
    shell.begin();
    for budget in [5 * BOUND, 3 * BOUND, BOUND, 0, 6 * BOUND] {
        shell.budget = budget;
        shell.residency.set_budget(budget);
        shell.check();
    }
    (0..4).for_each(|_| shell.end(0, Fate::Loaded));
    shell.run();
    assert!(shell.residency.held_bytes() > 5 * BOUND);
}

/// A payload larger than its bound is not loaded over and over again.
#[test]
fn a_bound_that_was_too_low_is_learned() {
    let mut residency = Residency::new(100, 0, 8);
    let small = |key, tier| Want { key, tier, num_bytes: 10 };
    let all = || vec![small(0, Tier::Needed), small(1, Tier::Needed)];
    residency.set_wants(all());
    assert_eq!(residency.next_requests(), [0, 1]);
    assert!(residency.loaded(0, 60));
    assert!(!residency.loaded(1, 60));
    for _ in 0..3 {
        residency.set_wants(all());
        assert!(residency.next_requests().is_empty(), "60 bytes do not fit beside the others");
    }
    residency.set_wants(vec![small(1, Tier::Needed)]);
    residency.set_wants(all());
    residency.set_wants(vec![small(1, Tier::Needed)]);
    assert_eq!((residency.next_requests(), residency.take_evicted()), (vec![1], vec![0]));
    assert!(residency.loaded(1, 60));
}

/// Cameras that teleport, sliders dragged, budgets that change, loads that are slow, fail or are cancelled.
#[test]
fn budgets_hold_under_any_trace() {
    for seed in 0..40 {
        let random = &mut Random(seed);
        let coarse = random.below(10 * BOUND);
        let mut shell = Shell::new(40 * BOUND, coarse, 1 + random.below(20));
        let (mut step, mut first) = (0, 0);
        let bad = random.unit() * 0.5;
        for _ in 0..400 {
            match random.below(10) {
                0..3 => {
                    step = if random.chance(0.2) { random.below(50) as u32 } else { (step + 1) % 50 };
                    first = if random.chance(0.2) { random.below(100) as u32 } else { first };
                    let coming = match random.chance(0.3) {
                        true => scrubbing(50, step, random.below(3) as i32 - 1, 4),
                        false => Playhead {
                            num_steps: 50,
                            position: f64::from(step),
                            steps_per_frame: 1.0,
                            is_looping: true,
                        }
                        .coming(4),
                    };
                    let num_nodes = 1 + random.below(20) as u32;
                    let mut all: Vec<_> = coming
                        .into_iter()
                        .flat_map(|(step, tier)| wants((first..first + num_nodes).map(|n| (step, n)), tier))
                        .collect();
                    all.extend(wants((0..50).map(|step| (step, 0)), Tier::Coarse));
                    if random.chance(0.3) {
                        all.extend(wants((0..20).map(|n| (random.below(50) as u32, n)), Tier::Rest));
                    }
                    shell.want(all);
                }
                3..6 => drop(shell.begin()),
                6 => {
                    for key in shell.residency.take_withdrawn() {
                        let index = shell.loading.iter().position(|k| *k == key).expect("it is in flight");
                        if random.chance(0.5) {
                            shell.end(index, Fate::Cancelled);
                        }
                    }
                }
                7 if random.chance(0.2) => {
                    shell.budget = random.below(60 * BOUND);
                    shell.residency.set_budget(shell.budget);
                    shell.check();
                }
                _ if !shell.loading.is_empty() => {
                    let index = random.below(shell.loading.len());
                    let fate = if random.chance(bad) { Fate::Failed } else { Fate::Loaded };
                    shell.end(index, fate);
                }
                _ => {}
            }
        }
        // Every request is answered, and then nothing is left to do.
        shell.run();
        assert_eq!((shell.residency.num_in_flight(), shell.residency.reserved_bytes()), (0, 0));
        assert!(shell.residency.peak_bytes() <= 60 * BOUND);
        let left = shell
            .wants
            .iter()
            .filter(|w| shell.residency.state(&w.key) == State::Queued)
            .min_by_key(|w| w.tier);
        let free = shell.budget - shell.residency.held_bytes();
        let coarse_share = coarse.min(shell.budget / 2);
        assert!(left.is_none() || free < BOUND + coarse_share, "{free} bytes are free, and {left:?} waits");
    }
}

/// A store larger than memory plays round and round, forwards and backwards: with the bandwidth for it, nothing is missed once it has begun.
#[test]
fn steady_play_finds_everything_in_memory() {
    for steps_per_frame in [1.0, -1.0, 0.5, 8.0] {
        let mut shell = Shell::new(40 * BOUND, 4 * BOUND, 10);
        let mut head = Playhead { num_steps: 64, position: 0.0, steps_per_frame, is_looping: true };
        let mut misses_at_first = 0;
        for frame in 0..200 {
            let mut all: Vec<_> = head
                .coming(4)
                .into_iter()
                .flat_map(|(step, tier)| wants((0..8).map(|n| (step, n)), tier))
                .collect();
            all.extend(wants((0..64).map(|step| (step, 0)), Tier::Coarse));
            shell.want(all);
            // Ten loads a frame, where eight are new in each.
            shell.begin();
            while !shell.loading.is_empty() {
                shell.end(0, Fate::Loaded);
            }
            head = head.next().unwrap();
            if frame == 10 {
                misses_at_first = shell.residency.counts().misses;
            }
        }
        let ResidencyCounts { hits, misses, .. } = shell.residency.counts();
        assert_eq!(misses, misses_at_first, "of {hits} at {steps_per_frame}");
    }
}

/// Dragging the slider anywhere finds the coarsest level of every step there.
#[test]
fn scrubbing_always_shows_something() {
    let mut shell = Shell::new(100 * BOUND, 50 * BOUND, 5);
    let coarsest = || wants((0..50).map(|step| (step, 0)), Tier::Coarse);
    shell.want(coarsest());
    shell.run();
    let random = &mut Random(3);
    for _ in 0..300 {
        let step = random.below(50) as u32;
        let around = scrubbing(50, step, 0, 6);
        let mut all: Vec<_> =
            around.into_iter().flat_map(|(s, tier)| wants((0..30).map(|n| (s, n)), tier)).collect();
        all.extend(coarsest());
        shell.want(all);
        shell.begin();
        while !shell.loading.is_empty() {
            shell.end(0, Fate::Loaded);
        }
        assert!((0..50).all(|step| shell.memory.contains_key(&(step, 0))));
    }
}

/// Many wants in every frame: a second or less, where a walk through all of them for each would take hours.
#[test]
fn a_hundred_thousand_wants_are_no_trouble() {
    let num = 100_000u32;
    let mut residency = Residency::new(50_000 * BOUND, 1000 * BOUND, 2000);
    for frame in 0..12 {
        let tier = |n: u32| [Tier::Needed, Tier::Coming(n % 7), Tier::Coarse, Tier::Rest][n as usize % 4];
        residency.set_wants((0..num).map(|n| want((frame / 4, n), tier(n))).collect());
        for key in residency.next_requests() {
            assert!(residency.loaded(key, size(key)));
        }
        residency.take_evicted();
    }
    assert_eq!(residency.counts().requests, 24_000);
}
