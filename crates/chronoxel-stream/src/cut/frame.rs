//! One frame's adaptation of a cut: the queues of splits and merges.

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashSet, VecDeque},
};

use chronoxel_core::{NodeId, Octree};

use super::{ActiveCut, CutChange, CutLimits, NodeView, node_map::NodeMap};

/// How much larger the error of a split must be than those of the merges that it is exchanged for: what is nearly equal would change places for ever
/// while the view moves a little.
const EXCHANGE_MARGIN: f64 = 1.05;
/// How much a pending split's error counts for more, so that it is not given up for one that is hardly better.
const PENDING_BONUS: f64 = 1.1;
/// Exchanges that are looked for in vain in a frame.
const MOST_REFUSALS: usize = 8;
/// Splits in a row that do not fit after which no smaller one is tried.
const MOST_MISFITS: usize = 64;
/// Sums of costs differ in their last digits by the order of the sum.
const ROUNDING: f64 = 1e-9;

/// Cost of drawing and bytes of payloads; whole numbers of bytes are exact.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Amount {
    cost: f64,
    bytes: f64,
}

impl Amount {
    fn plus(self, other: Self) -> Self {
        Self { cost: self.cost + other.cost, bytes: self.bytes + other.bytes }
    }

    fn minus(self, other: Self) -> Self {
        Self { cost: self.cost - other.cost, bytes: self.bytes - other.bytes }
    }
}

/// What the view says of a node.
#[derive(Debug, Clone, Copy)]
struct Facts {
    error: f64,
    amount: Amount,
}

/// Bits of a number that is not negative, in its order.
type Ordered = u64;

fn ordered(error: f64) -> Ordered {
    error.to_bits()
}

/// Merges that make room for a split.
struct Exchange {
    merges: Vec<NodeId>,
    /// What the split and the merges change together.
    delta: Amount,
}

/// A frame under way.
pub(super) struct Frame<'a> {
    cut: &'a mut ActiveCut,
    tree: &'a Octree,
    limits: &'a CutLimits,
    view: &'a mut dyn NodeView,
    facts: NodeMap<Facts>,
    /// What the cut takes, with the room kept for what is pending.
    used: Amount,
    split_queue: BinaryHeap<(Ordered, NodeId)>,
    /// May hold nodes that can no longer be merged.
    merge_queue: BinaryHeap<Reverse<(Ordered, NodeId)>>,
    /// Candidates for merging that free no cost, set aside while cost is what is short.
    idle_merges: Vec<NodeId>,
    /// Children of a split node that are on the cut.
    num_on_cut: NodeMap<u8>,
    pending: Vec<NodeId>,
    /// Merges that wait for payloads.
    wanted_last: Vec<NodeId>,
    change: CutChange,
}

impl<'a> Frame<'a> {
    pub(super) fn new(
        cut: &'a mut ActiveCut,
        tree: &'a Octree,
        limits: &'a CutLimits,
        view: &'a mut dyn NodeView,
    ) -> Self {
        let num_nodes = cut.nodes.len();
        Self {
            cut,
            tree,
            limits,
            view,
            facts: NodeMap::with_capacity_and_hasher(num_nodes + num_nodes / 4, Default::default()),
            used: Amount::default(),
            split_queue: BinaryHeap::new(),
            merge_queue: BinaryHeap::new(),
            idle_merges: Vec::new(),
            num_on_cut: NodeMap::with_capacity_and_hasher(num_nodes / 4, Default::default()),
            pending: Vec::new(),
            wanted_last: Vec::new(),
            change: CutChange::default(),
        }
    }

    pub(super) fn adapt(mut self) -> CutChange {
        self.count_children();
        self.merge_too_fine();
        self.survey();
        self.merge_into_limits();
        self.merge_for_nothing();
        self.split();
        self.cut.pending = self.pending.into_iter().collect();
        let mut change = self.change;
        change.wanted.extend(self.wanted_last);
        let mut seen = HashSet::new();
        change.wanted.retain(|node| seen.insert(*node));
        change.is_settled = change.splits.is_empty() && change.merges.is_empty() && change.wanted.is_empty();
        change
    }

    fn facts(&mut self, node: NodeId) -> Facts {
        if let Some(facts) = self.facts.get(&node) {
            return *facts;
        }
        let positive = |x: f64| if x > 0.0 { x } else { 0.0 };
        let cost = positive(self.view.cost(node)).min(f64::MAX);
        let amount = Amount { cost, bytes: self.view.num_bytes(node) as f64 };
        let facts = Facts { error: positive(self.view.error(node)), amount };
        self.facts.insert(node, facts);
        facts
    }

    /// What a split node still takes to draw the octants that have no child.
    fn remainder(&mut self, node: NodeId, num_missing: u8) -> Amount {
        match num_missing {
            0 => Amount::default(),
            n => {
                let Amount { cost, bytes } = self.facts(node).amount;
                Amount { cost: cost * f64::from(n) / 8.0, bytes }
            }
        }
    }

    /// What splitting a node adds.
    fn split_delta(&mut self, node: NodeId) -> Amount {
        let num_missing = self.cut.num_missing(self.tree, node);
        let parts = children_of(self.tree, node).map(|child| self.facts(child).amount);
        let children = parts.fold(Amount::default(), Amount::plus);
        children.plus(self.remainder(node, num_missing)).minus(self.facts(node).amount)
    }

    fn exceeds(&self, used: Amount) -> bool {
        used.cost > self.limits.cost * (1.0 + ROUNDING) || used.bytes > self.limits.bytes as f64
    }

    fn fits(&self, used: Amount) -> bool {
        used.cost <= self.limits.cost && used.bytes <= self.limits.bytes as f64
    }

    /// Whether taking something away helps where a limit is exceeded.
    fn helps(&self, used: Amount, freed: Amount) -> bool {
        used.cost > self.limits.cost && freed.cost > 0.0
            || used.bytes > self.limits.bytes as f64 && freed.bytes > 0.0
    }

    fn count_children(&mut self) {
        let top = self.tree.root().level;
        // In their order, children follow each other.
        let mut children: Option<(NodeId, u8)> = None;
        for node in self.cut.nodes.iter().filter(|node| node.level < top) {
            let parent = node.parent();
            match &mut children {
                Some((same, count)) if *same == parent => *count += 1,
                _ => {
                    self.num_on_cut.extend(children);
                    children = Some((parent, 1));
                }
            }
        }
        self.num_on_cut.extend(children);
    }

    /// Merges until no node is finer than the finest level.
    fn merge_too_fine(&mut self) {
        for level in 0..self.limits.finest_level.min(self.tree.root().level) {
            let end = NodeId { level: level + 1, morton: 0 };
            let mut parents: Vec<NodeId> = self.cut.nodes.range(..end).map(|node| node.parent()).collect();
            parents.dedup();
            for node in parents {
                self.merge(node);
                self.want_merged(node);
            }
        }
    }

    /// Adds up what the cut takes, and fills the queues.
    fn survey(&mut self) {
        let whole: Vec<NodeId> = self.cut.nodes.iter().copied().collect();
        let partial: Vec<(NodeId, u8)> = self.cut.partial.iter().map(|(n, m)| (*n, *m)).collect();
        let mut used = Amount::default();
        for node in whole {
            used = used.plus(self.facts(node).amount);
            self.enqueue_split(node);
        }
        for (node, num_missing) in partial {
            used = used.plus(self.remainder(node, num_missing));
        }
        self.used = used;
        let split: Vec<NodeId> = self.num_on_cut.keys().copied().collect();
        for node in split {
            self.enqueue_merge(node);
        }
    }

    fn enqueue_split(&mut self, node: NodeId) {
        if node.level <= self.limits.finest_level {
            return;
        }
        let bonus = if self.cut.pending.contains(&node) { PENDING_BONUS } else { 1.0 };
        let error = self.facts(node).error;
        if error > 0.0 {
            self.split_queue.push((ordered(error * bonus), node));
        }
    }

    /// Puts a node in the queue of merges if all its children are on the cut.
    fn enqueue_merge(&mut self, node: NodeId) {
        if self.is_mergeable(node) {
            let error = self.facts(node).error;
            self.merge_queue.push(Reverse((ordered(error), node)));
        }
    }

    fn is_mergeable(&self, node: NodeId) -> bool {
        let num_children = children_of(self.tree, node).count();
        num_children > 0 && self.num_on_cut.get(&node).is_some_and(|&n| usize::from(n) == num_children)
    }

    /// The next candidate for merging, taken out of the queue.
    fn pop_merge(&mut self) -> Option<NodeId> {
        while let Some(Reverse((_, node))) = self.merge_queue.pop() {
            if self.is_mergeable(node) {
                return Some(node);
            }
        }
        None
    }

    fn merge(&mut self, node: NodeId) {
        for child in children_of(self.tree, node) {
            self.cut.nodes.remove(&child);
        }
        self.cut.nodes.insert(node);
        self.cut.partial.remove(&node);
        self.num_on_cut.remove(&node);
        if node != self.tree.root() {
            *self.num_on_cut.entry(node.parent()).or_default() += 1;
        }
        self.change.merges.push(node);
    }

    /// Merges, and keeps sums and queues up to date.
    fn do_merge(&mut self, node: NodeId) {
        let freed = self.split_delta(node);
        self.used = self.used.minus(freed);
        self.merge(node);
        self.enqueue_split(node);
        if node != self.tree.root() {
            self.enqueue_merge(node.parent());
        }
    }

    fn want_merged(&mut self, node: NodeId) {
        if !self.view.is_resident(node) {
            self.change.wanted.push(node);
        }
    }

    /// Merges while a limit is exceeded: of the merges that help the one of the smallest error, or any where none does.
    fn merge_into_limits(&mut self) {
        let mut useless: VecDeque<NodeId> = VecDeque::new();
        while self.exceeds(self.used) {
            let Some(node) = self.pop_merge() else {
                let Some(node) = useless.pop_front() else { break };
                self.do_merge(node);
                self.want_merged(node);
                continue;
            };
            let freed = self.split_delta(node);
            match self.helps(self.used, freed) {
                true => {
                    self.do_merge(node);
                    self.want_merged(node);
                }
                false => useless.push_back(node),
            }
        }
        // The smallest error is to come up first again.
        for node in useless {
            self.enqueue_merge(node);
        }
    }

    /// Merges what is drawn, shows no error, and is cheaper to draw as a whole.
    fn merge_for_nothing(&mut self) {
        let mut others = Vec::new();
        while let Some(Reverse((error, _))) = self.merge_queue.peek().copied()
            && error == 0
        {
            let Some(node) = self.pop_merge() else { break };
            let facts = self.facts(node);
            let is_cheaper = facts.amount.cost > 0.0 && self.split_delta(node).cost > 0.0;
            if facts.error > 0.0 || !is_cheaper {
                others.push(node);
            } else if self.view.is_resident(node) {
                self.do_merge(node);
            } else {
                self.wanted_last.push(node);
                others.push(node);
            }
        }
        for node in others {
            self.enqueue_merge(node);
        }
    }

    fn split(&mut self) {
        let (mut num_refusals, mut num_misfits) = (0, 0);
        while self.change.splits.len() + self.pending.len() < self.limits.most_splits_per_frame
            && num_misfits < MOST_MISFITS
        {
            let Some((_, node)) = self.split_queue.pop() else { break };
            if !self.cut.nodes.contains(&node) || children_of(self.tree, node).next().is_none() {
                continue;
            }
            let delta = self.split_delta(node);
            if self.fits(self.used.plus(delta)) {
                num_misfits = 0;
                self.split_or_wait(node, Exchange { merges: Vec::new(), delta });
                continue;
            }
            let exchange = match num_refusals < MOST_REFUSALS {
                true => self.find_exchange(node, delta),
                false => None,
            };
            match exchange {
                Some(exchange) => self.split_or_wait(node, exchange),
                None => {
                    num_refusals += 1;
                    num_misfits += 1;
                }
            }
        }
    }

    /// Merges that make room for a split and whose errors are smaller together than its own.
    fn find_exchange(&mut self, node: NodeId, split: Amount) -> Option<Exchange> {
        let budget = self.facts(node).error / EXCHANGE_MARGIN;
        let is_short_of_bytes = self.used.plus(split).bytes > self.limits.bytes as f64;
        if is_short_of_bytes {
            for idle in std::mem::take(&mut self.idle_merges) {
                self.enqueue_merge(idle);
            }
        }
        let (mut merges, mut own_parent, mut delta, mut error) = (Vec::new(), None, split, 0.0);
        let is_found = loop {
            if self.fits(self.used.plus(delta)) {
                break true;
            }
            let Some(candidate) = self.pop_merge() else { break false };
            if node.level < self.tree.root().level && candidate == node.parent() {
                own_parent = Some(candidate);
                continue;
            }
            error += self.facts(candidate).error;
            if error >= budget {
                self.enqueue_merge(candidate);
                break false;
            }
            let freed = self.split_delta(candidate);
            if self.helps(self.used.plus(delta), freed) {
                delta = delta.minus(freed);
                merges.push(candidate);
            } else {
                error -= self.facts(candidate).error;
                self.idle_merges.push(candidate);
            }
        };
        own_parent.into_iter().for_each(|parent| self.enqueue_merge(parent));
        if is_found {
            return Some(Exchange { merges, delta });
        }
        merges.into_iter().for_each(|candidate| self.enqueue_merge(candidate));
        None
    }

    /// Splits where all is there that is needed, or else keeps the room and asks for it.
    fn split_or_wait(&mut self, node: NodeId, exchange: Exchange) {
        let needed = children_of(self.tree, node).chain(exchange.merges.iter().copied());
        let absent: Vec<NodeId> = needed.filter(|needed| !self.view.is_resident(*needed)).collect();
        if !absent.is_empty() {
            self.change.wanted.extend(absent);
            self.pending.push(node);
            // What the merges free beyond that is not free yet.
            self.used.cost += exchange.delta.cost.max(0.0);
            self.used.bytes += exchange.delta.bytes.max(0.0);
            return;
        }
        for merged in exchange.merges {
            self.do_merge(merged);
        }
        self.used = self.used.plus(self.split_delta(node));
        self.do_split(node);
    }

    fn do_split(&mut self, node: NodeId) {
        let children: Vec<NodeId> = children_of(self.tree, node).collect();
        self.cut.nodes.remove(&node);
        self.cut.nodes.extend(&children);
        let num_missing = self.cut.num_missing(self.tree, node);
        if num_missing > 0 {
            self.cut.partial.insert(node, num_missing);
        }
        if node != self.tree.root()
            && let Some(count) = self.num_on_cut.get_mut(&node.parent())
        {
            *count -= 1;
        }
        self.num_on_cut.insert(node, children.len() as u8);
        self.enqueue_merge(node);
        self.change.splits.push(node);
        for child in children {
            self.enqueue_split(child);
        }
    }
}

/// Children of a node that exist.
fn children_of(tree: &Octree, node: NodeId) -> impl Iterator<Item = NodeId> + use<'_> {
    let level = node.level.saturating_sub(1);
    let nodes = if node.level > 0 { tree.nodes(level) } else { &[] };
    let first = node.morton << 3;
    let start = nodes.partition_point(|&morton| morton < first);
    nodes[start..]
        .iter()
        .take_while(move |&&morton| morton <= first | 7)
        .map(move |&morton| NodeId { level, morton })
}
