//! Windows out of phase: random grids, series, phases, partitions of time and interruptions. Whatever happened on the
//! way, the finished store is that of an uninterrupted run, and at every moment what is finished can be read.

mod common;
mod known;

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use chronoxel_codec::{
    Indices, Payload, PayloadClass, Stage, StageClass, Table, TableClass, decoded_range, stage_to_bytes,
};
use chronoxel_core::{
    BitMask, BrickLayout, NodeId, NodeStatistics, Octree, SampleType, SpanKind, SpanRecord, SpanStatistics,
    TimeAxis, TimeNode, UniformGrid, octree::levels_of,
};
use chronoxel_store::{
    SpanContent, SpanWrite, Store, StoreDescription, StoreWriter, TimeTreeEntry, VariableDescription, verify,
};

use common::{copy_folder, tree_of};

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }

    fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// A span, and the step whose reading completes it for the encoder.
struct Due {
    step: u32,
    span: SpanWrite,
}

/// A series with the spans of every node: `[variable][level][node]`, in the order of time.
struct Case {
    description: StoreDescription,
    longest: u32,
    spans: Vec<Vec<Vec<Vec<Due>>>>,
    /// `[variable][time level][index]`: statistics of all nodes; empty where the store has no time tree.
    statistics: Vec<Vec<Vec<Vec<NodeStatistics>>>>,
}

fn classes(windows: &[u32]) -> Vec<PayloadClass> {
    let listed = |entries, rows, shift| StageClass {
        index_bits: 8,
        table: TableClass::Listed { entries, rows },
        shift,
    };
    let mut classes = vec![PayloadClass::affine(8)];
    for &window in windows {
        classes.push(PayloadClass { stages: vec![listed(4, window, 0)] });
        classes.push(PayloadClass { stages: vec![listed(3, (window - 1) / 4 + 1, 2), listed(2, window, 0)] });
    }
    // The same rows may serve two window lengths.
    classes.sort_by_key(|class| format!("{class:?}"));
    classes.dedup();
    classes
}

/// A few nodes of a tree; the dimensions alone decide how many steps share a shard.
fn tree(random: &mut Random, grid: &UniformGrid, layout: &BrickLayout) -> Octree {
    let levels = levels_of(grid, layout);
    let mut nodes: Vec<BTreeSet<u64>> = vec![BTreeSet::new(); levels.len()];
    for _ in 0..1 + random.below(4) {
        let brick = levels[0].bricks.map(|n| random.below(n as u64) as u32);
        let mut morton = NodeId::new(0, brick).morton;
        for level in &mut nodes {
            level.insert(morton);
            morton >>= 3;
        }
    }
    Octree::from_levels(nodes.into_iter().map(|level| level.into_iter().collect()).collect()).unwrap()
}

/// Spans of a dyadic partition of the window `start .. start + len`, those outside the series left out.
fn partition(random: &mut Random, start: i64, len: u32, num_steps: u32, into: &mut Vec<(u32, u32, u32)>) {
    if len > 1 && random.below(5) < 2 {
        partition(random, start, len / 2, num_steps, into);
        partition(random, start + i64::from(len / 2), len / 2, num_steps, into);
        return;
    }
    let (first, end) = (start.max(0), (start + i64::from(len)).min(i64::from(num_steps)));
    if first < end {
        into.push((first as u32, (end - first) as u32, len));
    }
}

fn payload(random: &mut Random, class: &PayloadClass, layout: &BrickLayout) -> Payload {
    let stages = class.stages.iter().map(|class| {
        // Few kinds of bricks, so that many are equal.
        let kind = random.below(3) as usize;
        let num = layout.num_full();
        let (table, most) = match class.table {
            TableClass::Affine => (Table::Affine { offset: kind as f64, scale: 0.5 }, 256),
            TableClass::Listed { entries, rows } => {
                let num = entries as usize * rows as usize;
                let entries = (0..num).map(|at| ((at * 7 + kind) % 50) as u16).collect();
                let table = Table::Listed { offset: -1.0, scale: 0.25, num_rows: rows as usize, entries };
                (table, num / rows as usize)
            }
        };
        let indices = Indices::U8((0..num).map(|at| ((at + at / 40 * kind) % most) as u8).collect());
        Stage { indices, table, shift: class.shift }.into_canonical(layout).unwrap()
    });
    Payload { stages: stages.collect() }
}

fn span_of(
    random: &mut Random,
    description: &StoreDescription,
    variable: usize,
    node_rank: u32,
    (start, len, window): (u32, u32, u32),
) -> SpanWrite {
    let layout = &description.layout;
    let (content, drawn_range) = match random.below(6) {
        0 => (SpanContent::Empty, [f64::NAN; 2]),
        1 => {
            let value = random.below(3) as f64;
            (SpanContent::Constant(value), [value; 2])
        }
        _ => {
            let all = &description.variables[variable].classes;
            let fit: Vec<usize> = (0..all.len()).filter(|&class| all[class].fits_window(window)).collect();
            let class = fit[random.below(fit.len() as u64) as usize];
            let payload = payload(random, &all[class], layout);
            let stages = payload.stages.iter().map(|stage| stage_to_bytes(stage, layout)).collect();
            let range = decoded_range(&payload, layout, len).unwrap();
            (SpanContent::Coded { class: class as u8, stages }, range)
        }
    };
    let is_empty = content == SpanContent::Empty;
    let every = 2 + random.below(2) as usize;
    let mask = (!is_empty && random.one_in(4))
        .then(|| BitMask::from_flags((0..layout.num_full()).map(|sample| sample % every == 0)));
    let statistics = match is_empty || random.one_in(3) {
        true => SpanStatistics { count: 0, min: f64::NAN, max: f64::NAN, mean: f64::NAN, std: f64::NAN },
        false => {
            let low = random.below(100) as f64;
            SpanStatistics { count: u64::from(len), min: low, max: low + 2.0, mean: low + 0.5, std: 0.5 }
        }
    };
    SpanWrite { node_rank, start, len, window, content, mask, drawn_range, statistics }
}

fn case(random: &mut Random) -> Case {
    let layout = BrickLayout::new(8).unwrap();
    // One brick or several: 64, 32 or 16 steps to a shard; 100 bricks: 4; 1,000 bricks: 1.
    let dims = [[7, 8, 5], [20, 9, 8], [24, 17, 16], [40, 40, 32], [80, 80, 80], [80, 80, 73]];
    let grid = UniformGrid::new(dims[random.below(6) as usize], [0.0; 3], [1.0; 3]).unwrap();
    let num_steps = 1 + random.below(70) as u32;
    let longest = 1u32 << random.below(5);
    let windows: Vec<u32> = (0..=longest.ilog2()).map(|power| 1 << power).collect();
    let variables = (0..1 + u64::from(random.one_in(3))).map(|variable| VariableDescription {
        name: format!("v{variable}"),
        units: String::new(),
        sample_type: SampleType::F32,
        fill_value: None,
        windows: windows.clone(),
        classes: classes(&windows),
    });
    let description = StoreDescription {
        grid,
        times: TimeAxis::regular(num_steps as usize, 1.0, "").unwrap(),
        layout,
        tree: tree(random, &grid, &layout),
        variables: variables.collect(),
        zstd_level: 1,
        time_tree: random.one_in(2).then_some(TimeTreeEntry { stride: 1 }),
        mesh: None,
        encoder: serde_json::Value::Null,
    };
    // Spans may come one by one, or all those of a window at its end.
    let by_window = random.one_in(2);
    let mut spans = Vec::new();
    for variable in 0..description.variables.len() {
        let levels = (0..description.tree.num_levels() as u8).map(|level| {
            let nodes = description.tree.nodes(level).iter().enumerate();
            let nodes = nodes.map(|(rank, &morton)| {
                let [x, y, z] = NodeId { level, morton }.brick();
                let phase = (x + 3 * y + 5 * z) % longest;
                let mut start = i64::from(phase) - i64::from(longest);
                let mut due = Vec::new();
                while start < i64::from(num_steps) {
                    let mut leaves = Vec::new();
                    partition(random, start, longest, num_steps, &mut leaves);
                    let end = (start + i64::from(longest)).min(i64::from(num_steps));
                    due.extend(leaves.into_iter().map(|leaf| Due {
                        step: if by_window { end as u32 } else { leaf.0 + leaf.1 } - 1,
                        span: span_of(random, &description, variable, rank as u32, leaf),
                    }));
                    start += i64::from(longest);
                }
                due
            });
            nodes.collect()
        });
        spans.push(levels.collect());
    }
    let of_variable = |spans: &Vec<Vec<Vec<Due>>>| {
        known::agreeing(&description.tree, num_steps, |node, step| {
            let holds = |due: &&Due| (due.span.start..due.span.start + due.span.len).contains(&step);
            spans[0][node].iter().find(holds).unwrap().span.statistics
        })
    };
    let statistics = description.time_tree.map_or(Vec::new(), |_| spans.iter().map(of_variable).collect());
    Case { description, longest, spans, statistics }
}

impl Case {
    fn num_steps(&self) -> u32 {
        self.description.times.num_steps() as u32
    }

    /// What a step brings of a variable and level that the writer does not have yet.
    fn batch(&self, writer: &StoreWriter, variable: usize, level: usize, step: u32) -> Vec<SpanWrite> {
        let due = self.spans[variable][level].iter().flatten().filter(|due| due.step == step);
        let is_new =
            |span: &&SpanWrite| span.start >= writer.covered_until(variable, level as u8, span.node_rank);
        due.map(|due| &due.span).filter(is_new).cloned().collect()
    }

    /// Puts and commits from a step on, until `stop` says so after a put (`None`) or a commit of a step. Gives the writer back at the end.
    fn go_on(
        &self,
        mut writer: StoreWriter,
        from: u32,
        mut stop: impl FnMut(Option<u32>, &StoreWriter) -> bool,
    ) -> Option<StoreWriter> {
        for step in from..self.num_steps() {
            for (variable, levels) in self.spans.iter().enumerate() {
                for level in 0..levels.len() {
                    let batch = self.batch(&writer, variable, level, step);
                    writer.put(variable, level as u8, batch).unwrap();
                    if stop(None, &writer) {
                        return None;
                    }
                }
            }
            self.put_statistics(&mut writer, step);
            writer.set_carry(serde_json::json!(step));
            writer.commit_step(step).unwrap();
            if stop(Some(step), &writer) {
                return None;
            }
        }
        Some(writer)
    }

    fn put_statistics(&self, writer: &mut StoreWriter, step: u32) {
        for (variable, levels) in self.statistics.iter().enumerate() {
            for at in TimeNode::closed_by(step, self.num_steps()) {
                let row = &levels[usize::from(at.level)][at.index as usize];
                writer.put_statistics(variable, at, row).unwrap();
            }
        }
    }

    /// Holds all statistics that can be read against those that were put.
    fn check_statistics(&self, store: &Store) {
        for (variable, levels) in self.statistics.iter().enumerate() {
            for (level, rows) in levels.iter().enumerate() {
                for (index, due) in rows.iter().enumerate() {
                    let at = TimeNode { level: level as u8, index: index as u32 };
                    assert!(store.has_statistics(at) || !store.is_complete());
                    let found = store.statistics(variable, at);
                    assert_eq!(store.has_statistics(at), found.is_ok());
                    if let Ok(found) = found {
                        found.iter().zip(due).for_each(|(found, due)| check_same(found, due));
                    }
                }
            }
        }
    }

    fn expected(&self, variable: usize, level: usize, node: usize, step: u32) -> &SpanWrite {
        let mut spans = self.spans[variable][level][node].iter().map(|due| &due.span);
        spans.find(|span| (span.start..span.start + span.len).contains(&step)).unwrap()
    }

    /// Holds the finished steps of a store against the spans that were put; gives their number.
    fn check(&self, path: &Path, thorough: bool) -> u32 {
        let store = Store::open(path).unwrap();
        let finished = store.header().num_steps_finished;
        for (variable, levels) in self.spans.iter().enumerate() {
            for (level, nodes) in levels.iter().enumerate() {
                for step in 0..finished {
                    let found = store.spans(variable, level as u8, step).unwrap();
                    assert_eq!(found.len(), nodes.len());
                    for (node, found) in found.iter().enumerate() {
                        let due = self.expected(variable, level, node, step);
                        check_span(found, due);
                        if thorough && due.start == step {
                            self.check_bytes(&store, variable, level as u8, found, due);
                        }
                    }
                }
                assert!(store.spans(variable, level as u8, finished).is_err());
            }
        }
        self.check_statistics(&store);
        if thorough {
            let report = verify(&store, &|_, _| {});
            assert!(report.is_ok(), "{:?}", report.problems);
        }
        finished
    }

    fn check_bytes(&self, store: &Store, variable: usize, level: u8, found: &SpanRecord, due: &SpanWrite) {
        assert_eq!(store.read_mask(variable, level, found).unwrap(), due.mask);
        if let SpanContent::Coded { stages, .. } = &due.content {
            let payload = store.read_payload(variable, level, found).unwrap();
            let bytes: Vec<_> = payload.stages.iter().map(|s| stage_to_bytes(s, store.layout())).collect();
            assert_eq!(&bytes, stages);
        }
    }
}

/// Absent numbers are NaN, and equal.
fn check_same(found: &NodeStatistics, due: &NodeStatistics) {
    let numbers = |s: &NodeStatistics| [s.min, s.max, s.mean, s.std, s.temporal_error].map(f64::to_bits);
    assert!(numbers(found) == numbers(due) && found.facts == due.facts, "{found:?} {due:?}");
}

fn check_span(found: &SpanRecord, due: &SpanWrite) {
    assert_eq!((found.start, found.len, found.window), (due.start, due.len, due.window));
    assert_eq!(found.mask.is_some(), due.mask.is_some());
    assert_eq!(found.statistics.count, due.statistics.count);
    match (&found.kind, &due.content) {
        (SpanKind::Empty, SpanContent::Empty) => {}
        (SpanKind::Constant(found), SpanContent::Constant(due)) => assert_eq!(found, due),
        (SpanKind::Coded { class: found, .. }, SpanContent::Coded { class: due, .. }) => {
            assert_eq!(found, due);
        }
        _ => panic!("{found:?} where {due:?} was put"),
    }
}

/// A commit killed part way: a store as it was before, of which some files came to lie where they belong.
fn half_commit(random: &mut Random, before: &Path, after: &Path, crashed: &Path) {
    copy_folder(before, crashed);
    let names: BTreeSet<PathBuf> = tree_of(before).into_iter().map(|(name, _)| name).collect();
    let mut new = tree_of(after);
    new.retain(|(name, _)| !names.contains(name) && !name.starts_with(".partial"));
    for (name, bytes) in new {
        // Metadata comes before what it describes, and may be all that came.
        let is_metadata = name.ends_with("zarr.json");
        if !is_metadata && random.one_in(2) {
            continue;
        }
        std::fs::create_dir_all(crashed.join(&name).parent().unwrap()).unwrap();
        std::fs::write(crashed.join(&name), bytes).unwrap();
        let temporary = name.to_string_lossy().replace('/', "!");
        std::fs::remove_file(crashed.join(".partial").join(temporary)).ok();
    }
}

fn resume_and_finish(case: &Case, path: &Path) {
    let (writer, next) = StoreWriter::resume(path, &case.description).unwrap();
    case.go_on(writer, next, |_, _| false).unwrap().finish().unwrap();
}

/// Writes a case again and again interrupted, and compares with the uninterrupted store. Gives the numbers of resumes and
/// of killed commits.
fn check_interrupted(
    case: &Case,
    random: &mut Random,
    folder: &Path,
    whole: &[(PathBuf, Vec<u8>)],
) -> [u32; 2] {
    let mut counts = [0; 2];
    let [path, before, crashed] = ["a.cxl", "before.cxl", "crashed.cxl"].map(|name| folder.join(name));
    let longest = case.longest;
    let mut next_writer = Some((StoreWriter::create(&path, &case.description, false).unwrap(), 0));
    let mut committed = None;
    while let Some((writer, from)) = next_writer.take() {
        // Longer and longer, so that a commit is reached at last.
        let mut left = 1 + random.below(60 + 60 * u64::from(counts[0]));
        let mut half = None;
        let done = case.go_on(writer, from, |step, writer| {
            let every = writer.header().steps_per_shard;
            if let Some(step) = step
                && ((step + 1) % every == 0 || step + 1 == case.num_steps())
            {
                committed = committed.max(Some(step));
                if half.take().is_some() {
                    half_commit(random, &before, &path, &crashed);
                    counts[1] += 1;
                    case.check(&crashed, true);
                    resume_and_finish(case, &crashed);
                    assert!(tree_of(&crashed) == whole, "a commit was killed at step {step}");
                    std::fs::remove_dir_all(&crashed).unwrap();
                    std::fs::remove_dir_all(&before).unwrap();
                }
            }
            left -= 1;
            if left == 1 && half.is_none() && random.one_in(2) {
                // The last put but one: what follows is compared with this moment, whatever commits next.
                half = Some(());
                copy_folder(&path, &before);
                left += 1 + case.spans.len() as u64 * case.spans[0].len() as u64 * u64::from(every);
            }
            left == 0
        });
        std::fs::remove_dir_all(&before).ok();
        if let Some(writer) = done {
            writer.finish().unwrap();
            break;
        }
        let finished = case.check(&path, random.one_in(3));
        let (writer, next) = StoreWriter::resume(&path, &case.description).unwrap();
        // What is finished lags behind what was committed by open windows and open shards, and by no more.
        let lag = longest + 2 * longest.max(writer.header().steps_per_shard);
        assert!(finished <= next && committed.is_none_or(|step| finished + lag > step), "{finished} {next}");
        // Of a complete store nothing is carried on.
        let carried = committed.filter(|step| step + 1 < case.num_steps());
        assert_eq!(writer.carry().as_u64().map(|step| step as u32), carried);
        assert_eq!(case.check(&path, false), finished, "a resume changes nothing that is finished");
        counts[0] += 1;
        next_writer = Some((writer, next));
    }
    assert!(tree_of(&path) == whole);
    std::fs::remove_dir_all(&path).unwrap();
    counts
}

#[test]
fn random_partitions_survive_random_interruptions() {
    let (mut shards, mut totals) = (BTreeSet::new(), [0; 2]);
    let num_cases: u64 = std::env::var("CHRONOXEL_CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(8);
    for seed in 0..num_cases {
        let mut random = Random(seed);
        let case = case(&mut random);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("whole.cxl");
        let writer = StoreWriter::create(&path, &case.description, false).unwrap();
        let writer = case.go_on(writer, 0, |_, _| false).unwrap();
        shards.insert(writer.header().steps_per_shard);
        writer.finish().unwrap();
        assert_eq!(case.check(&path, true), case.num_steps(), "seed {seed}");
        let whole = tree_of(&path);
        for _ in 0..2 {
            let counts = check_interrupted(&case, &mut random, folder.path(), &whole);
            (0..2).for_each(|what| totals[what] += counts[what]);
        }
    }
    assert!(shards.contains(&1) && shards.len() >= 4, "{shards:?}");
    assert!(totals[0] > 30 && totals[1] > 10, "{totals:?} resumes and killed commits");
}
