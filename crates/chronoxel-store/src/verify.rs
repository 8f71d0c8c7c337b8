//! Verification: every byte of every file is under a checksum or follows from the header, and everything the
//! spans say is held against what is stored.

use std::{
    collections::{HashMap, HashSet},
    path::Path,
};

use chronoxel_core::TimeNode;

use crate::{
    Header, Store, StoreError,
    arrays::{Child, SpanChunkId},
    cells::NESTED_FOLDER,
    files,
    header::Totals,
    journal, layout,
    store::{read_header, read_nodes},
    verify_shard::ShardCheck,
    verify_statistics::{Families, GatheredRanges, StatisticsCheck},
    writer::nodes_file,
};

/// Problems kept at most; the rest are only counted.
const MAX_PROBLEMS: usize = 1000;

/// What a verification found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VerifyReport {
    /// One line each, naming file, field and value; at most 1,000 of them.
    pub problems: Vec<String>,
    /// All problems, those that are not listed included.
    pub num_problems: u64,
    /// Spans that were checked.
    pub num_spans: u64,
    /// Payloads that were decoded, each for every step of its span.
    pub num_payloads: u64,
    /// Statistics that were checked, each of an octree node over a time node.
    pub num_statistics: u64,
    seen: HashSet<String>,
}

impl VerifyReport {
    /// Whether nothing is wrong.
    pub fn is_ok(&self) -> bool {
        self.num_problems == 0
    }

    pub(crate) fn add(&mut self, problem: impl ToString) {
        let problem = problem.to_string();
        if self.problems.len() >= MAX_PROBLEMS {
            self.num_problems += 1;
        } else if self.seen.insert(problem.clone()) {
            self.num_problems += 1;
            self.problems.push(problem);
        }
    }
}

/// What is counted while the spans are walked, to be held against the header.
#[derive(Debug, Default)]
pub(crate) struct Counted {
    pub totals: Totals,
    /// Smallest and largest source sample of each variable.
    pub ranges: Vec<[Option<f64>; 2]>,
}

/// Checks everything there is to check in a store. `progress(done, total)` is called as it goes on.
///
/// Checked are: the header's checksum, the metadata of every group and array byte for byte, the nodes, missing and
/// unexpected files (but for the journal of a writer that did not finish), the index and every inner chunk of every shard, that chunks fill their shard end to end and belong
/// to a span each, that the spans of each node partition time, that shared payloads and masks exist, that decoded
/// samples lie within the drawn range, statistics of spans and of the time tree, and totals. Of a store that is not complete the finished steps are checked.
pub fn verify(store: &Store, progress: &(dyn Fn(u64, u64) + Sync)) -> VerifyReport {
    let mut report = VerifyReport::default();
    check_header(store, &mut report);
    let header = store.header();
    let num_shards: u64 = header.each_window().map(|(_, _, w)| u64::from(header.num_shards(w))).sum();
    let num_steps = u64::from(header.num_steps_finished);
    let num_covers = (header.variables.len() * header.levels.len()) as u64 * num_steps;
    let num_chunks =
        |(_, time_level)| header.num_statistics_chunks_over(time_level, header.num_steps_finished);
    let num_chunks: u64 = header.each_time_level().map(num_chunks).map(u64::from).sum();
    let (total, mut done) = (num_shards + num_covers + num_chunks, 0);
    let mut counted = Counted { ranges: vec![[None; 2]; header.variables.len()], ..Counted::default() };
    for (variable, level) in
        (0..header.variables.len()).flat_map(|v| (0..header.levels.len() as u8).map(move |level| (v, level)))
    {
        check_covers(store, variable, level, &mut report);
        done += num_steps;
        progress(done, total);
        for &window in &header.variables[variable].windows {
            for shard in 0..header.num_shards(window) {
                let id = SpanChunkId { variable: variable as u16, level, window, shard };
                ShardCheck { store, id }.run(&mut report, &mut counted);
                done += 1;
                progress(done, total);
            }
        }
    }
    let families = Families::of(store);
    for (variable, time_level) in header.each_time_level() {
        let check = StatisticsCheck { store, families: &families, variable, time_level };
        for chunk in 0..header.num_statistics_chunks_over(time_level, header.num_steps_finished) {
            check.run(chunk, &mut report);
            done += 1;
            progress(done, total);
        }
    }
    check_files(store, &mut report, &mut counted);
    if store.is_complete() {
        check_totals(store, &counted, &mut report);
    }
    report
}

/// Checks that at each step a span of each node holds it, and that the finest say what the statistics of their steps do.
fn check_covers(store: &Store, variable: usize, level: u8, report: &mut VerifyReport) {
    let mut gathered = GatheredRanges::new(store.header().num_nodes(level));
    for step in 0..store.header().num_steps_finished {
        let spans = match store.spans(variable, level, step) {
            Ok(spans) => spans,
            Err(error) => {
                report.add(error);
                gathered = GatheredRanges::new(store.header().num_nodes(level));
                continue;
            }
        };
        let at = TimeNode::of_step(step);
        if level > 0 || !store.has_statistics(at) {
            continue;
        }
        // What cannot be read is reported where its own chunk is checked.
        let row = store.statistics(variable, at).ok();
        for (node, problem) in gathered.add(step, &spans, row.as_deref()) {
            report.add(store.brick_error(store.path(), variable, level, node as u32, step, problem));
        }
    }
}

fn check_header(store: &Store, report: &mut VerifyReport) {
    let (root, header) = (store.path(), store.header());
    match read_header(root) {
        Ok(found) if found == *header => {}
        Ok(_) => report.add(StoreError::corrupt(
            &root.join("zarr.json"),
            "header",
            "changed",
            "open the store anew",
        )),
        Err(error) => report.add(error),
    }
    for geometry in header.geometry() {
        let num_nodes = header.num_nodes(geometry.level);
        match read_nodes(root, geometry.level, num_nodes, geometry.bricks) {
            Ok(nodes) if nodes == store.tree().nodes(geometry.level) => {}
            Ok(_) => {
                let path = root.join(nodes_file(geometry.level));
                report.add(StoreError::corrupt(&path, "nodes", "changed", "open the store anew"));
            }
            Err(error) => report.add(error),
        }
    }
}

/// Checks that no file is there that should not be, that all metadata is there that should be, byte for byte, and
/// sums up the files of the data. Missing files of data are found by those who need them.
fn check_files(store: &Store, report: &mut VerifyReport, counted: &mut Counted) {
    let (root, header) = (store.path(), store.header());
    let (listed, children) = match (files::list(root), header.children()) {
        (Ok(listed), Ok(children)) => (listed, children),
        (Err(error), _) | (_, Err(error)) => return report.add(error),
    };
    // A store of cells is verified by itself.
    let listed = listed.without(&root.join(NESTED_FOLDER));
    let unexpected = |path: &Path, what: &'static str| {
        StoreError::corrupt(path, what, "unexpected", "it is no part of the store: remove it")
    };
    let in_journal =
        |path: &Path| path.strip_prefix(root).is_ok_and(|path| path.starts_with(journal::FOLDER));
    let folders = data_folders(header);
    let metadata: HashSet<String> = children.iter().map(Child::file).collect();
    let nodes: HashSet<String> = (0..header.levels.len()).map(|level| nodes_file(level as u8)).collect();
    // The folders that hold data, at any depth.
    let mut used: HashSet<String> = HashSet::new();
    for (path, len) in listed.files.iter().filter(|(path, _)| !in_journal(path)) {
        let relative = relative_name(root, path);
        if is_data_file(&folders, &relative) {
            counted.totals.data_bytes += len;
            let above = relative.match_indices('/').map(|(at, _)| relative[..at].to_owned());
            used.extend(above);
        } else if relative != "zarr.json" && !metadata.contains(&relative) && !nodes.contains(&relative) {
            report.add(unexpected(path, "file"));
        }
    }
    if header.sparse && store.is_complete() {
        let empty = listed.empty_folders.iter().filter(|path| !in_journal(path));
        empty.for_each(|path| report.add(unexpected(path, "empty folder")));
    }
    for child in children {
        check_child(store, &child, !child.if_used || used.contains(&child.folder), report);
    }
}

/// Checks the metadata of a folder.
fn check_child(store: &Store, child: &Child, is_due: bool, report: &mut VerifyReport) {
    let file = store.path().join(child.file());
    let corrupt = |field: &str, value: &str, problem: &str| StoreError::corrupt(&file, field, value, problem);
    match files::read_whole(&file, child.text.len() as u64) {
        Ok(None) if is_due => report.add(corrupt("file", "absent", "it must follow from the header")),
        Ok(None) => {}
        // A writer makes metadata before the data, and may have been killed between the two.
        Ok(Some(_)) if !is_due && store.is_complete() => {
            report.add(corrupt("file", "unexpected", "there is no data in its folder: remove that"));
        }
        Ok(Some(found)) if found == child.text.as_bytes() => {}
        Ok(Some(_)) => report.add(corrupt("text", "different", "it must follow from the header")),
        Err(error) => report.add(error),
    }
}

/// Folders of the arrays that hold data, each with the number of its shards.
fn data_folders(header: &Header) -> HashMap<String, u32> {
    let of_window = |key: (u16, u8, u32)| {
        let kinds = header.data_kinds(key).into_iter();
        kinds.map(move |kind| (header.data_folder(key, kind), header.num_shards(key.2)))
    };
    let of_time_level = |(variable, time_level): (u16, u8)| {
        (header.statistics_folder(variable, time_level), header.num_statistics_chunks(time_level))
    };
    header.each_window().flat_map(of_window).chain(header.each_time_level().map(of_time_level)).collect()
}

/// Whether a file is a shard or a chunk of spans of one of these folders.
fn is_data_file(folders: &HashMap<String, u32>, relative: &str) -> bool {
    let Some((folder, name)) = relative.rsplit_once('/') else { return false };
    let shard = layout::shard_of(name);
    shard.zip(folders.get(folder)).is_some_and(|(shard, num_shards)| shard < *num_shards)
}

pub(crate) fn relative_name(root: &Path, path: &Path) -> String {
    let relative = path.strip_prefix(root).unwrap_or(path);
    let parts: Vec<_> = relative.components().map(|c| c.as_os_str().to_string_lossy()).collect();
    parts.join("/")
}

fn check_totals(store: &Store, counted: &Counted, report: &mut VerifyReport) {
    let (path, header) = (store.path().join("zarr.json"), store.header());
    if header.totals != counted.totals {
        let problem = format!("the spans and files give {:?}", counted.totals);
        report.add(StoreError::corrupt(&path, "totals", format!("{:?}", header.totals), problem));
    }
    for (entry, range) in header.variables.iter().zip(&counted.ranges) {
        if [entry.min, entry.max] != *range {
            let value = format!("{:?}", [entry.min, entry.max]);
            let problem = format!("the spans give {range:?}");
            report.add(StoreError::corrupt(&path, format!("min and max of {}", entry.name), value, problem));
        }
    }
}
