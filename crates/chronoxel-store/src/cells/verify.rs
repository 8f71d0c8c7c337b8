//! Verification of a store of cells: every byte of every file is under a checksum or follows from the header, and what the
//! spans say is held against what is stored.

use std::{
    collections::{HashMap, HashSet},
    path::Path,
};

use chronoxel_core::SpanStatistics;

use super::{
    BLOCK_STEPS, CellHeader, CellSpanRecord, CellStore, CellTotals,
    arrays::{CellArray, GeometryArray},
    header::group_text,
};
use crate::{StoreError, VerifyReport, files, journal, layout, verify::relative_name};

/// Checks everything there is to check in a store of cells. `progress(done, total)` is called as it goes on.
///
/// Checked are: the header's checksum, the metadata of every group and array byte for byte, the geometry, missing and unexpected files (but for
/// those of a writer that did not finish), every chunk of every shard, that each belongs to a span, that the spans partition
/// time, that decoded values lie within the drawn range and reach its ends, and totals. Of a store that is not complete the finished steps are checked.
pub fn verify_cells(store: &CellStore, progress: &(dyn Fn(u64, u64) + Sync)) -> VerifyReport {
    let mut report = VerifyReport::default();
    let header = store.header();
    check_header(store, &mut report);
    if let Err(error) = store.read_geometry() {
        report.add(error);
    }
    let num_blocks = header.num_steps_finished.div_ceil(BLOCK_STEPS);
    let total = u64::from(num_blocks) * header.variables.len() as u64;
    let mut counted = CellTotals::default();
    for (variable, entry) in header.variables.iter().enumerate() {
        let mut range = [None::<f64>; 2];
        let mut masks = HashSet::new();
        for block in 0..num_blocks {
            let check = BlockCheck { store, variable, block };
            check.run(&mut report, &mut counted, &mut range, &mut masks);
            progress(variable as u64 * u64::from(num_blocks) + u64::from(block) + 1, total);
        }
        if range != [entry.min, entry.max] {
            let value = format!("{:?}", [entry.min, entry.max]);
            let (path, field) = (store.path().join("zarr.json"), format!("min and max of {}", entry.name));
            report.add(StoreError::corrupt(&path, field, value, format!("the spans give {range:?}")));
        }
    }
    check_files(store, &mut report, &mut counted);
    check_totals(store, &counted, &mut report);
    report
}

fn check_header(store: &CellStore, report: &mut VerifyReport) {
    let path = store.path().join("zarr.json");
    let found = group_text(store.path())
        .and_then(|text| CellHeader::from_text(&path, text.as_deref().unwrap_or_default()));
    match found {
        Ok(found) if found == *store.header() => {}
        Ok(_) => report.add(StoreError::corrupt(&path, "header", "changed", "open the store anew")),
        Err(error) => report.add(error),
    }
}

/// The spans of a block of a variable, and the shards they lie in.
struct BlockCheck<'a> {
    store: &'a CellStore,
    variable: usize,
    block: u32,
}

impl BlockCheck<'_> {
    fn run(
        &self,
        report: &mut VerifyReport,
        counted: &mut CellTotals,
        range: &mut [Option<f64>; 2],
        masks: &mut HashSet<u32>,
    ) {
        let spans = match self.store.spans(self.variable, self.block) {
            Ok(spans) => spans,
            Err(error) => return report.add(error),
        };
        for span in spans.iter() {
            counted.spans += 1;
            counted.masked += u64::from(span.mask.is_some());
            report.num_spans += 1;
            if let Some(row) = span.mask {
                if row == span.start {
                    masks.insert(row);
                } else if !masks.contains(&row) {
                    report.add(self.error(
                        CellArray::Mask,
                        span.start,
                        format!("no mask lies at step {row}"),
                    ));
                }
            }
            if let Err(error) = self.check_span(span) {
                report.add(error);
            }
            report.num_payloads += 1;
            if span.statistics.count > 0 {
                let SpanStatistics { min, max, .. } = span.statistics;
                *range = [
                    Some(range[0].map_or(min, |low: f64| low.min(min))),
                    Some(range[1].map_or(max, |high: f64| high.max(max))),
                ];
            }
        }
        self.check_shards(&spans, report, counted);
    }

    fn error(&self, array: CellArray, step: u32, problem: String) -> StoreError {
        self.store.chunk_error(self.variable, array, step, problem)
    }

    /// Decodes a span and holds it against its record.
    fn check_span(&self, span: &CellSpanRecord) -> Result<(), StoreError> {
        let array = CellArray::Stage { class: span.class, stage: 0 };
        let wrong = |problem: String| Err(self.error(array, span.start, problem));
        let payload = self.store.read_span(self.variable, span)?;
        let num_points = self.store.header().num_points as usize;
        let num_missing = payload.missing.as_ref().map_or(0, |mask| mask.num_set());
        let count = (num_points - num_missing) as u64 * u64::from(span.len);
        if count != span.statistics.count {
            return wrong(format!("{count} values are there where the span says {}", span.statistics.count));
        }
        if num_missing == 0 && payload.missing.is_some() {
            return wrong("its mask is empty".into());
        }
        let mut values = vec![0.0; num_points];
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for step in span.start..span.start + span.len {
            if let Err(error) = payload.decode(step, &mut values) {
                return wrong(error.to_string());
            }
            let present = values.iter().filter(|v| !v.is_nan());
            present.for_each(|&v| (low, high) = (low.min(v), high.max(v)));
        }
        let found = [low, high].map(f64::from);
        if count > 0 && found != [span.drawn_min, span.drawn_max] {
            let stated = [span.drawn_min, span.drawn_max];
            return wrong(format!("its values go from {found:?} where the span says {stated:?}"));
        }
        Ok(())
    }

    /// Checks that the shards of the block hold the chunks of its spans and nothing else.
    fn check_shards(&self, spans: &[CellSpanRecord], report: &mut VerifyReport, counted: &mut CellTotals) {
        let header = self.store.header();
        let mut due: HashMap<CellArray, HashSet<usize>> = HashMap::new();
        for span in spans {
            let num_stages =
                header.variables[self.variable].classes[usize::from(span.class)].stages.len() as u8;
            let stages = (0..num_stages).map(|stage| CellArray::Stage { class: span.class, stage });
            let mask = (span.mask == Some(span.start)).then_some(CellArray::Mask);
            for array in stages.chain(mask) {
                due.entry(array).or_default().insert(header.slot(self.variable, array, span.start));
            }
        }
        for array in header.arrays_of(self.variable) {
            // What is missing was found by those who read it.
            let Ok(Some(shard)) = self.store.shard(self.variable, array, self.block) else { continue };
            let is_mask = array == CellArray::Mask;
            let chunk_bytes = header.chunk_bytes(self.variable, array) as u64;
            for slot in 0..header.num_slots(self.variable, array) {
                let Some([_, len]) = shard.extent(slot) else { continue };
                if !due.get(&array).is_some_and(|slots| slots.contains(&slot)) {
                    let problem = "it belongs to no span";
                    report.add(StoreError::corrupt(shard.path(), "inner chunk", slot, problem));
                } else if is_mask {
                    counted.masks += 1;
                    counted.mask_bytes += len;
                } else {
                    counted.stage_bytes += chunk_bytes;
                    counted.payload_bytes += len;
                }
            }
            if let Some(problem) = shard.gap() {
                report.add(StoreError::corrupt(shard.path(), "chunks", "not end to end", problem));
            }
        }
    }
}

/// Checks that all metadata is there, byte for byte, and no file that should not be, and sums up the files.
fn check_files(store: &CellStore, report: &mut VerifyReport, counted: &mut CellTotals) {
    let (root, header) = (store.path(), store.header());
    let (listed, children) = match (files::list(root), header.children()) {
        (Ok(listed), Ok(children)) => (listed, children),
        (Err(error), _) | (_, Err(error)) => return report.add(error),
    };
    let geometry: HashSet<String> = GeometryArray::ALL
        .iter()
        .flat_map(|array| (0..array.num_chunks(header)).map(|chunk| array.file(chunk)))
        .collect();
    let metadata: HashSet<String> = children.iter().map(|child| child.file()).collect();
    let folders: HashSet<&str> = children.iter().map(|child| child.folder.as_str()).collect();
    let num_finished = header.num_steps_finished.div_ceil(BLOCK_STEPS);
    let mut used: HashSet<String> = HashSet::new();
    for (path, len) in &listed.files {
        let relative = relative_name(root, path);
        let (folder, name) = relative.rsplit_once('/').unwrap_or(("", &relative));
        let block = layout::block_of(name).filter(|_| folders.contains(folder));
        if geometry.contains(&relative) {
            counted.geometry_bytes += len;
        } else if block.is_some_and(|block| block < num_finished) {
            counted.data_bytes += len;
            used.insert(folder.to_owned());
        } else if relative != "zarr.json" && !metadata.contains(&relative) && !is_unfinished(store, &relative)
        {
            let problem = "it is no part of the store: remove it";
            report.add(StoreError::corrupt(path, "file", "unexpected", problem));
        }
    }
    if store.is_complete() {
        for path in &listed.empty_folders {
            let problem = "it is no part of the store: remove it";
            report.add(StoreError::corrupt(path, "empty folder", "unexpected", problem));
        }
    }
    for child in children {
        let is_due = !child.if_used || used.contains(&child.folder);
        check_text(store, &root.join(child.file()), &child.text, is_due, report);
    }
}

/// Whether a file may lie in a store that a writer did not finish.
fn is_unfinished(store: &CellStore, relative: &str) -> bool {
    let of_variable = |folder: &str| store.header().variables.iter().any(|v| v.folder == folder);
    let first = relative.split('/').next().unwrap_or_default();
    !store.is_complete() && (first == journal::FOLDER || of_variable(first))
}

fn check_text(store: &CellStore, file: &Path, text: &str, is_due: bool, report: &mut VerifyReport) {
    let corrupt = |field: &str, value: &str, problem: &str| StoreError::corrupt(file, field, value, problem);
    match files::read_whole(file, text.len() as u64) {
        Ok(None) if is_due => report.add(corrupt("file", "absent", "it must follow from the header")),
        Ok(None) => {}
        Ok(Some(_)) if !is_due && store.is_complete() => {
            report.add(corrupt("file", "unexpected", "there is no data in its folder: remove that"));
        }
        Ok(Some(found)) if found == text.as_bytes() => {}
        Ok(Some(_)) => report.add(corrupt("text", "different", "it must follow from the header")),
        Err(error) => report.add(error),
    }
}

fn check_totals(store: &CellStore, counted: &CellTotals, report: &mut VerifyReport) {
    let totals = &store.header().totals;
    if totals != counted {
        let (path, value) = (store.path().join("zarr.json"), format!("{totals:?}"));
        report.add(StoreError::corrupt(&path, "totals", value, format!("spans and files give {counted:?}")));
    }
}
