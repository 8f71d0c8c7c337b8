//! What of the payloads is in memory: explicit states, priorities, and a budget of bytes that holds at every instant.
//!
//! The shell (whoever owns files and threads) says each frame what it wants, begins the loads that [`Residency::next_requests`] names, reports
//! how each ended, and drops what [`Residency::take_evicted`] names. Nothing here reads, waits or looks at a clock.
//!
//! ```
//! use chronoxel_stream::{Residency, State, Tier, Want};
//!
//! let mut residency = Residency::new(100, 0, 8);
//! let want = |key, tier| Want { key, tier, num_bytes: 60 };
//! residency.set_wants(vec![want("step 3", Tier::Coming(1)), want("step 2", Tier::Needed)]);
//! assert_eq!(residency.next_requests(), ["step 2"]); // both do not fit
//! assert!(residency.loaded("step 2", 40));
//! assert_eq!(residency.next_requests(), ["step 3"]);
//! assert_eq!((residency.held_bytes(), residency.reserved_bytes()), (40, 60));
//!
//! residency.set_wants(vec![want("step 4", Tier::Needed)]);
//! assert_eq!(residency.take_withdrawn(), ["step 3"]);
//! residency.cancelled("step 3");
//! assert_eq!((residency.next_requests(), residency.state(&"step 2")), (vec!["step 4"], State::Resident));
//! ```

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap},
    hash::Hash,
};

/// How urgent a want is; the more urgent is the smaller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Tier {
    /// Drawn in this frame.
    Needed,
    /// Drawn when playback has gone on by so many shown steps, 1 being the next.
    Coming(u32),
    /// The coarsest levels of any step, so that every step shows something at once.
    Coarse,
    /// Anything else that would be good to have.
    Rest,
}

/// One payload that is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Want<K> {
    /// Which.
    pub key: K,
    /// How urgently. A key may be wanted in several tiers: the most urgent counts, and being wanted as [`Tier::Coarse`] protects it as well.
    pub tier: Tier,
    /// What it takes in memory, or a bound of that while it is not known.
    pub num_bytes: usize,
}

/// Where a payload is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    /// Not in memory, and not wanted.
    Absent,
    /// Wanted; its load has not begun.
    Queued,
    /// Being loaded.
    Loading,
    /// In memory.
    Resident,
    /// Could not be loaded, however often it was tried.
    Failed,
}

/// What happened so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ResidencyCounts {
    /// Payloads that were resident when they were first wanted as [`Tier::Needed`].
    pub hits: u64,
    /// Payloads that were not.
    pub misses: u64,
    /// Loads begun.
    pub requests: u64,
    /// Payloads taken out of memory to make room.
    pub evictions: u64,
    /// Loads that ended when they were wanted no more, or with no room left.
    pub wasted: u64,
    /// Loads that failed, every try counted.
    pub failures: u64,
}

/// Loads of a payload that may fail before it counts as failed.
const MOST_TRIES: u8 = 3;

/// Position in a tier of what is tried again.
const LAST: u32 = u32::MAX;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Absent,
    /// `reserved` bytes are set aside for it; the shell was told that it is wanted no more if `is_withdrawn`.
    Loading {
        reserved: usize,
        is_withdrawn: bool,
    },
    Resident {
        num_bytes: usize,
        last_use: u64,
    },
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    place: Place,
    /// Of the want; `None` where there is none.
    tier: Option<Tier>,
    /// Whether it is wanted as coarse, in whichever tier it counts.
    is_coarse: bool,
    /// Bytes to reserve.
    bound: usize,
    /// What it took when it was last loaded, while it is wanted.
    learned: usize,
    /// Whether the wants before these needed it.
    was_needed: bool,
    /// Which call of `set_wants` wanted it last.
    generation: u64,
}

/// Urgency for eviction: what is not wanted comes last.
type Rank = (bool, Tier);

const NOT_WANTED: Entry = Entry {
    place: Place::Absent,
    tier: None,
    is_coarse: false,
    bound: 0,
    learned: 0,
    was_needed: false,
    generation: 0,
};

impl Entry {
    fn rank(&self) -> Rank {
        (self.tier.is_none(), self.tier.unwrap_or(Tier::Rest))
    }
}

/// A resident payload in the order of eviction: least urgent first, then least recently used.
type Candidate<K> = (Rank, Reverse<u64>, K);

/// A wanted payload in the order of loading: most urgent first, then as the shell listed them.
type Queued<K> = Reverse<(Tier, u32, K)>;

/// States of payloads under a budget. See the [module](self).
#[derive(Debug)]
pub struct Residency<K> {
    budget_bytes: usize,
    coarse_bytes: usize,
    most_in_flight: usize,
    entries: HashMap<K, Entry>,
    tries: HashMap<K, u8>,
    /// Queued keys by `is_coarse`; those that are no longer queued are passed over.
    queue: [BinaryHeap<Queued<K>>; 2],
    /// Residents by `is_coarse`. Uses since a candidate was put in are not seen until it comes up.
    candidates: [BinaryHeap<Candidate<K>>; 2],
    /// Whether they were gathered since the wants changed.
    has_candidates: bool,
    /// Bytes held and reserved by `is_coarse`.
    used: [usize; 2],
    reserved: usize,
    /// Bytes of all coarse wants.
    wanted_coarse: usize,
    in_flight: usize,
    withdrawn: Vec<K>,
    evicted: Vec<K>,
    newly_failed: Vec<K>,
    generation: u64,
    now: u64,
    peak_bytes: usize,
    counts: ResidencyCounts,
}

impl<K: Copy + Eq + Hash + Ord> Residency<K> {
    /// Nothing in memory yet.
    ///
    /// * `budget_bytes`: most bytes held and reserved together, ever
    /// * `coarse_bytes`: the part of them that is kept for wants of tier [`Tier::Coarse`], as far as there are such wants; at most half counts
    /// * `most_in_flight`: most loads under way at a time
    pub fn new(budget_bytes: usize, coarse_bytes: usize, most_in_flight: usize) -> Self {
        Self {
            budget_bytes,
            coarse_bytes,
            most_in_flight,
            entries: HashMap::new(),
            tries: HashMap::new(),
            queue: [BinaryHeap::new(), BinaryHeap::new()],
            candidates: [BinaryHeap::new(), BinaryHeap::new()],
            has_candidates: true,
            used: [0; 2],
            reserved: 0,
            wanted_coarse: 0,
            in_flight: 0,
            withdrawn: Vec::new(),
            evicted: Vec::new(),
            newly_failed: Vec::new(),
            generation: 0,
            now: 0,
            peak_bytes: 0,
            counts: ResidencyCounts::default(),
        }
    }

    /// Replaces all wants; those of one tier are loaded in the order given.
    ///
    /// What is loading and wanted no more is withdrawn; what is resident and wanted no more stays until its room is needed.
    pub fn set_wants(&mut self, wants: Vec<Want<K>>) {
        self.generation += 1;
        self.now += 1;
        let mut queue = Vec::new();
        for (n, want) in wants.into_iter().enumerate() {
            if self.want(want) == Place::Absent {
                queue.push(Reverse((want.tier, (n as u32).min(LAST - 1), want.key)));
            }
        }
        self.settle_wants();
        let mut lists = [Vec::new(), Vec::new()];
        for item in queue {
            let Reverse((tier, _, key)) = item;
            // A key's most urgent want stands for all of them.
            if let Some(entry) = self.entries.get(&key)
                && entry.tier == Some(tier)
            {
                lists[usize::from(entry.is_coarse)].push(item);
            }
        }
        self.queue = lists.map(BinaryHeap::from);
        self.has_candidates = false;
    }

    /// Takes a want in, and says where its payload is.
    fn want(&mut self, want: Want<K>) -> Place {
        let entry = self.entries.entry(want.key).or_insert(NOT_WANTED);
        let before = *entry;
        if entry.generation != self.generation {
            entry.generation = self.generation;
            entry.was_needed = entry.tier == Some(Tier::Needed);
            entry.is_coarse = false;
            entry.bound = entry.learned;
            entry.tier = None;
        }
        let is_needed_already = entry.tier == Some(Tier::Needed);
        entry.tier = Some(entry.tier.map_or(want.tier, |tier| tier.min(want.tier)));
        entry.is_coarse |= want.tier == Tier::Coarse;
        entry.bound = entry.bound.max(want.num_bytes);
        if entry.tier == Some(Tier::Needed) && !is_needed_already {
            let is_new = u64::from(!entry.was_needed);
            match &mut entry.place {
                Place::Resident { last_use, .. } => {
                    *last_use = self.now;
                    self.counts.hits += is_new;
                }
                _ => self.counts.misses += is_new,
            }
        }
        let bytes = bytes_of(entry);
        self.used[usize::from(before.is_coarse)] -= bytes;
        self.used[usize::from(entry.is_coarse)] += bytes;
        entry.place
    }

    /// Takes the wants away that this generation did not repeat.
    fn settle_wants(&mut self) {
        let Self { entries, generation, used, withdrawn, wanted_coarse, .. } = self;
        *wanted_coarse = 0;
        entries.retain(|key, entry| {
            if entry.generation == *generation {
                if entry.is_coarse {
                    let held = bytes_of(entry);
                    *wanted_coarse = wanted_coarse.saturating_add(if held > 0 { held } else { entry.bound });
                }
                if let Place::Loading { is_withdrawn, .. } = &mut entry.place {
                    *is_withdrawn = false;
                }
                return true;
            }
            let bytes = bytes_of(entry);
            used[usize::from(entry.is_coarse)] -= bytes;
            used[0] += bytes;
            entry.is_coarse = false;
            entry.tier = None;
            if let Place::Loading { is_withdrawn, .. } = &mut entry.place
                && !std::mem::replace(is_withdrawn, true)
            {
                withdrawn.push(*key);
            }
            entry.place != Place::Absent
        });
    }

    fn gather_candidates(&mut self) {
        self.has_candidates = true;
        let mut lists = [Vec::new(), Vec::new()];
        for (key, entry) in &self.entries {
            if let Place::Resident { last_use, .. } = entry.place {
                lists[usize::from(entry.is_coarse)].push((entry.rank(), Reverse(last_use), *key));
            }
        }
        self.candidates = lists.map(BinaryHeap::from);
    }

    /// Bytes kept for coarse wants.
    fn coarse_share(&self) -> usize {
        self.coarse_bytes.min(self.wanted_coarse).min(self.budget_bytes / 2)
    }

    /// Loads to begin now, most urgent first: room is reserved for each, and made by evicting what is less urgent, or not wanted, the least
    /// recently used first.
    pub fn next_requests(&mut self) -> Vec<K> {
        self.next_requests_within(usize::MAX)
    }

    /// [`Self::next_requests`] that reserve at most so many bytes together, or one request where the first alone is larger: for a limit of what is
    /// transferred per frame.
    pub fn next_requests_within(&mut self, most_bytes: usize) -> Vec<K> {
        let mut requests = Vec::new();
        let mut left_bytes = most_bytes;
        let mut passed = [Vec::new(), Vec::new()];
        // Once a want is refused, what is less urgent must not take the room that it waits for.
        let mut is_refused = [false; 2];
        while self.in_flight < self.most_in_flight {
            let open = (0..2).filter(|&class| !is_refused[class]);
            let Some(class) = open.max_by_key(|&class| self.queue[class].peek()) else { break };
            let Some(item) = self.queue[class].pop() else { break };
            let Reverse((tier, _, key)) = item;
            let entry = self.entries.get(&key).filter(|e| e.place == Place::Absent && e.tier == Some(tier));
            let Some(entry) = entry.copied().filter(|_| !self.has_failed(&key)) else { continue };
            if entry.bound > left_bytes && !requests.is_empty() {
                passed[class].push(item);
                break;
            }
            if !self.make_room(&entry) {
                passed[class].push(item);
                is_refused[class] = entry.bound <= self.most_ever(class);
                continue;
            }
            self.reserve(key, entry.bound);
            left_bytes = left_bytes.saturating_sub(entry.bound);
            requests.push(key);
        }
        for (queue, passed) in self.queue.iter_mut().zip(passed) {
            queue.extend(passed);
        }
        requests
    }

    fn has_failed(&self, key: &K) -> bool {
        self.tries.get(key).is_some_and(|&tries| tries >= MOST_TRIES)
    }

    /// Bytes that a want could get if nothing else were in memory.
    fn most_ever(&self, class: usize) -> usize {
        match class {
            0 => self.budget_bytes - self.coarse_share(),
            _ => self.budget_bytes,
        }
    }

    fn reserve(&mut self, key: K, num_bytes: usize) {
        let entry = self.entries.get_mut(&key).expect("it is queued");
        entry.place = Place::Loading { reserved: num_bytes, is_withdrawn: false };
        self.used[usize::from(entry.is_coarse)] += num_bytes;
        self.reserved += num_bytes;
        self.in_flight += 1;
        self.counts.requests += 1;
        self.note_peak();
    }

    fn note_peak(&mut self) {
        debug_assert!(self.used[0] + self.used[1] <= self.budget_bytes);
        self.peak_bytes = self.peak_bytes.max(self.used[0] + self.used[1]);
    }

    /// Evicts until a payload fits, only what is less urgent; or nothing, where that is not enough.
    fn make_room(&mut self, entry: &Entry) -> bool {
        let (bound, class, share) = (entry.bound, usize::from(entry.is_coarse), self.coarse_share());
        if bound > self.most_ever(class) {
            return false;
        }
        // Within the share that is theirs, coarse payloads need yield to nothing but what is drawn now.
        let is_protected = class == 1 && self.used[1].saturating_add(bound) <= share;
        let mut used = self.used;
        let mut victims = Vec::new();
        let fits = loop {
            let misses_other = class == 0 && used[0] > self.budget_bytes - share - bound;
            let misses_total = used[0] + used[1] > self.budget_bytes - bound;
            if !misses_other && !misses_total {
                break true;
            }
            let allowed = |from: usize, rank: Rank| match from {
                0 if is_protected => rank > (false, Tier::Needed),
                0 => rank > entry.rank(),
                _ => (class == 1 || used[1] > share) && !misses_other && rank > entry.rank(),
            };
            let found = [self.least_urgent(0), self.least_urgent(1)];
            let options = (0..2).filter(|&from| found[from].is_some_and(|(rank, ..)| allowed(from, rank)));
            let Some(from) = options.max_by_key(|&from| found[from]) else { break false };
            let victim = self.candidates[from].pop().expect("it was seen");
            used[from] -= bytes_of(&self.entries[&victim.2]);
            victims.push((from, victim));
        };
        for (from, victim) in victims {
            match fits {
                true => self.evict(victim.2),
                false => self.candidates[from].push(victim),
            }
        }
        fits
    }

    /// The first of a class to go, checked against what it is now.
    fn least_urgent(&mut self, class: usize) -> Option<Candidate<K>> {
        if !self.has_candidates {
            self.gather_candidates();
        }
        loop {
            let candidate = *self.candidates[class].peek()?;
            let (rank, Reverse(seen), key) = candidate;
            let entry = self.entries.get(&key);
            match entry.map(|e| (e.place, e.is_coarse, e.rank())) {
                Some((Place::Resident { last_use, .. }, is_coarse, now))
                    if usize::from(is_coarse) == class && now == rank =>
                {
                    if last_use == seen {
                        return Some(candidate);
                    }
                    self.candidates[class].pop();
                    self.candidates[class].push((rank, Reverse(last_use), key));
                }
                _ => {
                    self.candidates[class].pop();
                }
            }
        }
    }

    fn evict(&mut self, key: K) {
        let Some(entry) = self.entries.get_mut(&key) else { return };
        self.used[usize::from(entry.is_coarse)] -= bytes_of(entry);
        entry.place = Place::Absent;
        self.put_back(key);
        self.evicted.push(key);
        self.counts.evictions += 1;
    }

    fn queue_again(&mut self, key: K) {
        if let Some(Entry { tier: Some(tier), is_coarse, .. }) = self.entries.get(&key) {
            self.queue[usize::from(*is_coarse)].push(Reverse((*tier, LAST, key)));
        }
    }

    /// Loads under way that are wanted no more, each once: they may be cancelled, and are still answered.
    pub fn take_withdrawn(&mut self) -> Vec<K> {
        let Self { withdrawn, entries, .. } = self;
        withdrawn.retain(|key| {
            matches!(entries.get(key), Some(Entry { place: Place::Loading { is_withdrawn: true, .. }, .. }))
        });
        // Wanted and not wanted again in turns, a load was noted more than once.
        withdrawn.sort_unstable();
        withdrawn.dedup();
        std::mem::take(withdrawn)
    }

    /// What is to be dropped now: to be asked for after every call that can make room ([`Self::next_requests`], [`Self::loaded`],
    /// [`Self::set_budget`]), before anything new is put in its place.
    pub fn take_evicted(&mut self) -> Vec<K> {
        std::mem::take(&mut self.evicted)
    }

    /// What could not be loaded however often it was tried, each once.
    pub fn take_failed(&mut self) -> Vec<K> {
        std::mem::take(&mut self.newly_failed)
    }

    /// A load ended well; whether it may stay. Where it may not, there is no room for it any more, and it must be dropped.
    ///
    /// What is wanted no more stays where its room is still there, as anything else that is not wanted.
    ///
    /// * `num_bytes`: what it takes in fact
    pub fn loaded(&mut self, key: K, num_bytes: usize) -> bool {
        let Some((mut entry, reserved)) = self.end_load(key) else { return false };
        self.tries.remove(&key);
        (entry.bound, entry.learned) = (num_bytes, num_bytes);
        let fits = num_bytes <= reserved || self.make_room(&entry);
        self.counts.wasted += u64::from(!fits || entry.tier.is_none());
        if fits {
            self.now += 1;
            let last_use = self.now;
            entry.place = Place::Resident { num_bytes, last_use };
            let class = usize::from(entry.is_coarse);
            self.used[class] += num_bytes;
            if self.has_candidates {
                self.candidates[class].push((entry.rank(), Reverse(last_use), key));
            }
            self.note_peak();
        }
        self.entries.insert(key, entry);
        self.put_back(key);
        fits
    }

    /// A load failed. It is tried again while it is wanted, three times in all, and then counts as failed.
    pub fn failed(&mut self, key: K) {
        if self.end_load(key).is_none() {
            return;
        }
        self.counts.failures += 1;
        let tries = self.tries.entry(key).or_default();
        *tries += 1;
        if *tries == MOST_TRIES {
            self.newly_failed.push(key);
        }
        self.put_back(key);
    }

    /// A load was given up because it was withdrawn; where it is wanted again by now, it is queued again.
    pub fn cancelled(&mut self, key: K) {
        if self.end_load(key).is_some() {
            self.put_back(key);
        }
    }

    /// Forgets what failed, so that it is tried anew.
    pub fn forget_failures(&mut self) {
        let failed: Vec<K> = self.tries.drain().map(|(key, _)| key).collect();
        for key in failed {
            if self.entries.get(&key).is_some_and(|e| e.place == Place::Absent) {
                self.queue_again(key);
            }
        }
    }

    /// Frees what a load had reserved, and says how much that was; `None` where there was no such load.
    fn end_load(&mut self, key: K) -> Option<(Entry, usize)> {
        let entry = self.entries.get_mut(&key)?;
        let Place::Loading { reserved, .. } = entry.place else { return None };
        entry.place = Place::Absent;
        self.used[usize::from(entry.is_coarse)] -= reserved;
        self.reserved -= reserved;
        self.in_flight -= 1;
        Some((*entry, reserved))
    }

    /// Queues what is not in memory and still wanted, and forgets it where it is not.
    fn put_back(&mut self, key: K) {
        match self.entries.get(&key) {
            Some(Entry { place: Place::Absent, tier: None, .. }) => drop(self.entries.remove(&key)),
            Some(Entry { place: Place::Absent, .. }) => self.queue_again(key),
            _ => {}
        }
    }

    /// Changes the budget; where it shrinks, what no longer fits goes at once. Loads under way lose their room where nothing else is left to go,
    /// and are kept when they end only if they fit then.
    pub fn set_budget(&mut self, budget_bytes: usize) {
        self.budget_bytes = budget_bytes;
        while self.used[0] + self.used[1] > budget_bytes {
            let found = [self.least_urgent(0), self.least_urgent(1)];
            let share = self.coarse_share();
            let is_over = self.used[1] > share;
            let not_needed = |c: &Candidate<K>| c.0 > (false, Tier::Needed);
            let others = found[0].filter(not_needed);
            let coarse = found[1].filter(|c| not_needed(c) && (is_over || others.is_none()));
            if let Some(candidate) = others.max(coarse) {
                self.evict(candidate.2);
            } else if !self.revoke_one() {
                let candidate = found[0].max(found[1]).expect("bytes are used, so something is resident");
                self.evict(candidate.2);
            }
        }
    }

    /// Takes the room from the least urgent load under way.
    fn revoke_one(&mut self) -> bool {
        let loading = self.entries.iter().filter_map(|(key, entry)| match entry.place {
            Place::Loading { reserved, .. } if reserved > 0 => Some((entry.rank(), *key)),
            _ => None,
        });
        let Some((_, key)) = loading.max() else { return false };
        let entry = self.entries.get_mut(&key).expect("it was found");
        if let Place::Loading { reserved, .. } = &mut entry.place {
            self.used[usize::from(entry.is_coarse)] -= *reserved;
            self.reserved -= *reserved;
            *reserved = 0;
        }
        true
    }

    /// Where a payload is.
    pub fn state(&self, key: &K) -> State {
        match self.entries.get(key).map(|e| e.place) {
            Some(Place::Resident { .. }) => State::Resident,
            Some(Place::Loading { .. }) => State::Loading,
            _ if self.has_failed(key) => State::Failed,
            Some(Place::Absent) => State::Queued,
            None => State::Absent,
        }
    }

    /// Notes that a payload was used, so that it leaves later.
    pub fn touch(&mut self, key: &K) {
        if let Some(Entry { place: Place::Resident { last_use, .. }, .. }) = self.entries.get_mut(key) {
            self.now += 1;
            *last_use = self.now;
        }
    }

    /// The budget.
    pub fn budget_bytes(&self) -> usize {
        self.budget_bytes
    }

    /// Bytes of what is resident.
    pub fn held_bytes(&self) -> usize {
        self.used[0] + self.used[1] - self.reserved
    }

    /// Bytes set aside for loads under way.
    pub fn reserved_bytes(&self) -> usize {
        self.reserved
    }

    /// The most bytes ever held and reserved together.
    pub fn peak_bytes(&self) -> usize {
        self.peak_bytes
    }

    /// Loads under way.
    pub fn num_in_flight(&self) -> usize {
        self.in_flight
    }

    /// What happened so far.
    pub fn counts(&self) -> ResidencyCounts {
        self.counts
    }
}

/// Bytes that an entry holds or has reserved.
fn bytes_of(entry: &Entry) -> usize {
    match entry.place {
        Place::Absent => 0,
        Place::Loading { reserved, .. } => reserved,
        Place::Resident { num_bytes, .. } => num_bytes,
    }
}

#[cfg(test)]
mod tests;
