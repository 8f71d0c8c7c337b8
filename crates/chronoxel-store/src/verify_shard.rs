//! Verification of the rows of one shard: their spans, payloads and masks.

use chronoxel_codec::{Payload, decoded_range};
use chronoxel_core::{PayloadAddress, SpanKind, SpanRecord};
use rayon::prelude::*;

use crate::{
    Store, StoreError,
    arrays::{ArrayKind, ShardId, SpanChunkId},
    spans::{SpanChunk, SpanContext, record_of},
    verify::{Counted, VerifyReport},
};

/// Payloads that are in memory at once.
const NUM_AT_ONCE: usize = 64;

/// One chunk of spans, and the shards of the same rows.
pub(crate) struct ShardCheck<'a> {
    pub store: &'a Store,
    pub id: SpanChunkId,
}

/// A span and its place.
struct Placed {
    row: u32,
    node: u32,
    record: SpanRecord,
}

impl ShardCheck<'_> {
    pub fn run(&self, report: &mut VerifyReport, counted: &mut Counted) {
        let header = self.store.header();
        let file_error = |value: &str, problem: &str| {
            StoreError::corrupt(&self.store.root.join(header.span_file(&self.id)), "file", value, problem)
        };
        let chunk = match self.store.span_chunk(&self.id) {
            Ok(chunk) => chunk,
            Err(error) => return report.add(error),
        };
        let Some(chunk) = chunk.as_ref() else {
            if self.is_settled() && header.sparse {
                // A lost chunk shows as steps without a span; here, no payload may be there without one.
                self.check_shards(&[], report, counted);
            } else if self.store.is_complete() {
                report.add(file_error("absent", "the spans of its rows are lost"));
            }
            return;
        };
        let finished = header.num_steps_finished;
        let all = self.spans_in(chunk, report);
        if all.is_empty() && header.sparse {
            report.add(file_error("unexpected", "it holds no span: remove it"));
        }
        let num_all = all.len();
        let spans: Vec<Placed> = all.into_iter().filter(|span| span.record.start < finished).collect();
        for span in &spans {
            self.check_references(span, report);
            self.check_statistics(span, report);
            self.count(span, counted);
        }
        for batch in spans.chunks(NUM_AT_ONCE) {
            self.check_payloads(batch, report);
        }
        if spans.len() == num_all {
            self.check_shards(&spans, report, counted);
        }
    }

    /// Whether every span that starts in these rows belongs to the finished steps.
    fn is_settled(&self) -> bool {
        let header = self.store.header();
        let rows = u64::from(header.rows_per_shard(self.id.window));
        let last_row = (u64::from(self.id.shard) + 1) * rows - 1;
        let last_start = last_row * u64::from(self.id.window);
        self.store.is_complete() || last_start < u64::from(header.num_steps_finished)
    }

    fn spans_in(&self, chunk: &SpanChunk, report: &mut VerifyReport) -> Vec<Placed> {
        let header = self.store.header();
        let rows = header.rows_per_shard(self.id.window);
        let num_nodes = header.num_nodes(self.id.level);
        let mut spans = Vec::new();
        for row_in_shard in 0..rows {
            let row = self.id.shard * rows + row_in_shard;
            for node in 0..num_nodes as u32 {
                let context = self.context(row);
                match record_of(chunk.fields(row_in_shard, node as usize), &context) {
                    Ok(Some(record)) => spans.push(Placed { row, node, record }),
                    Ok(None) => {}
                    Err(problem) => self.add(report, node, row, problem),
                }
            }
        }
        spans
    }

    fn context(&self, row: u32) -> SpanContext<'_> {
        let header = self.store.header();
        SpanContext {
            variable: &header.variables[usize::from(self.id.variable)],
            window: self.id.window,
            row,
            num_nodes: header.num_nodes(self.id.level),
            num_steps: header.num_steps(),
        }
    }

    fn error(&self, node: u32, step: u32, problem: String) -> StoreError {
        let path = self.store.root.join(self.store.header().span_file(&self.id));
        self.store.brick_error(&path, usize::from(self.id.variable), self.id.level, node, step, problem)
    }

    fn add(&self, report: &mut VerifyReport, node: u32, step: u32, problem: String) {
        report.add(self.error(node, step, problem));
    }

    /// The span at an address of this window, if it can be read.
    fn span_at(&self, at: PayloadAddress) -> Option<SpanRecord> {
        let rows = self.store.header().rows_per_shard(self.id.window);
        let chunk = self.store.span_chunk(&SpanChunkId { shard: at.row / rows, ..self.id }).ok()?;
        let chunk = chunk.as_ref().as_ref()?;
        record_of(chunk.fields(at.row % rows, at.node as usize), &self.context(at.row)).ok()?
    }

    /// Checks that shared payloads and masks are those of a span that has them at its own place.
    fn check_references(&self, span: &Placed, report: &mut VerifyReport) {
        let own = PayloadAddress { row: span.row, node: span.node };
        if let SpanKind::Coded { class, at } = span.record.kind
            && at != own
            && self.span_at(at).map(|other| other.kind) != Some(SpanKind::Coded { class, at })
        {
            let problem =
                format!("row {}, node {} has no payload of class {class} to share", at.row, at.node);
            self.add(report, span.node, span.record.start, problem);
        }
        if let Some(at) = span.record.mask
            && at != own
            && self.span_at(at).and_then(|other| other.mask) != Some(at)
        {
            let problem = format!("row {}, node {} has no mask to share", at.row, at.node);
            self.add(report, span.node, span.record.start, problem);
        }
    }

    fn check_statistics(&self, span: &Placed, report: &mut VerifyReport) {
        let statistics = &span.record.statistics;
        let most = self.store.layout().num_core() as u64 * u64::from(span.record.len);
        let [min, max, mean, std] = [statistics.min, statistics.max, statistics.mean, statistics.std];
        let slack = 1e-9 * (max - min).max(min.abs()).max(max.abs());
        let unsound = statistics.count > 0
            && (mean < min - slack || mean > max + slack || std > (max - min) / 2.0 * (1.0 + 1e-9) + slack);
        if statistics.count > most || unsound {
            self.add(report, span.node, span.record.start, format!("impossible statistics {statistics:?}"));
        }
        if let SpanKind::Constant(value) = span.record.kind
            && span.record.drawn_range != [value; 2]
        {
            let problem = format!("constant {value}, drawn range {:?}", span.record.drawn_range);
            self.add(report, span.node, span.record.start, problem);
        }
        if span.record.kind == SpanKind::Empty && statistics.count > 0 {
            let problem = format!("{} source samples in an empty span", statistics.count);
            self.add(report, span.node, span.record.start, problem);
        }
    }

    /// Reads and decodes the payloads and masks of some spans.
    fn check_payloads(&self, spans: &[Placed], report: &mut VerifyReport) {
        let (variable, level, layout) = (usize::from(self.id.variable), self.id.level, self.store.layout());
        let records: Vec<SpanRecord> = spans.iter().map(|span| span.record).collect();
        let payloads = self.store.read_payloads(variable, level, &records);
        let checked: Vec<[Result<u64, StoreError>; 2]> = payloads
            .into_par_iter()
            .zip(spans)
            .map(|(payload, span)| {
                let decoded = payload.and_then(|payload| match payload {
                    None => Ok(0),
                    Some(payload) => match range_problem(&payload, layout, span) {
                        None => Ok(1),
                        Some(problem) => Err(self.error(span.node, span.record.start, problem)),
                    },
                });
                [decoded, self.store.read_mask(variable, level, &span.record).map(|_| 0)]
            })
            .collect();
        report.num_spans += spans.len() as u64;
        for result in checked.into_iter().flatten() {
            match result {
                Ok(num) => report.num_payloads += num,
                Err(error) => report.add(error),
            }
        }
    }

    fn count(&self, span: &Placed, counted: &mut Counted) {
        let own = PayloadAddress { row: span.row, node: span.node };
        let totals = &mut counted.totals;
        match span.record.kind {
            SpanKind::Empty => totals.empty += 1,
            SpanKind::Constant(_) => totals.constant += 1,
            SpanKind::Coded { at, .. } if at != own => totals.shared += 1,
            SpanKind::Coded { class, .. } => {
                totals.coded += 1;
                let [core, apron] = self.store.header().payload_bytes(usize::from(self.id.variable), class);
                totals.core_bytes += core;
                totals.apron_bytes += apron;
            }
        }
        totals.masked += u64::from(span.record.mask.is_some());
        totals.masks += u64::from(span.record.mask == Some(own));
        if span.record.statistics.count > 0 {
            let [min, max] = &mut counted.ranges[usize::from(self.id.variable)];
            let [low, high] = [span.record.statistics.min, span.record.statistics.max];
            *min = Some(min.map_or(low, |min| min.min(low)));
            *max = Some(max.map_or(high, |max| max.max(high)));
        }
    }

    /// Checks that each shard of these rows holds the chunks of its spans and nothing else, end to end.
    fn check_shards(&self, spans: &[Placed], report: &mut VerifyReport, counted: &mut Counted) {
        let header = self.store.header();
        for array in header.arrays_of(self.id.variable, self.id.level, self.id.window) {
            let id = ShardId { array, shard: self.id.shard };
            let due = self.slots_due(&id, spans);
            let corrupt = |field: &str, value: &dyn ToString, problem: &str| {
                let path = self.store.root.join(header.shard_file(&id));
                StoreError::corrupt(&path, field, value.to_string(), problem)
            };
            let shard = match self.store.shard(&id) {
                Ok(Some(shard)) => shard,
                Ok(None) if due.contains(&true) => {
                    report.add(corrupt("file", &"absent", "the payloads of its rows are lost"));
                    continue;
                }
                Ok(None) => continue,
                Err(error) => {
                    report.add(error);
                    continue;
                }
            };
            if let Some(slot) = (0..due.len()).find(|&slot| due[slot] != shard.extent(slot).is_some()) {
                report.add(corrupt("inner chunk", &slot, "it is missing, or there without a span"));
            }
            if !due.contains(&true) {
                report.add(corrupt("file", &"unexpected", "no span has bytes in it: remove it"));
            }
            if let Some(gap) = shard.gap() {
                report.add(corrupt("index", &"inconsistent", &gap));
            }
            let bytes: u64 = (0..due.len()).filter_map(|slot| shard.extent(slot)).map(|[_, len]| len).sum();
            match array.kind {
                ArrayKind::Mask => counted.totals.mask_bytes += bytes,
                ArrayKind::Stage { .. } => counted.totals.payload_bytes += bytes,
            }
        }
    }

    /// For each slot of a shard, whether a span has its bytes there.
    fn slots_due(&self, id: &ShardId, spans: &[Placed]) -> Vec<bool> {
        let header = self.store.header();
        let (rows, num_nodes) = (header.rows_per_shard(self.id.window), header.num_nodes(self.id.level));
        let mut due = vec![false; header.num_slots(&id.array)];
        for span in spans {
            let own = PayloadAddress { row: span.row, node: span.node };
            let stored = match id.array.kind {
                ArrayKind::Mask => span.record.mask == Some(own),
                ArrayKind::Stage { class, .. } => span.record.kind == SpanKind::Coded { class, at: own },
            };
            due[(span.row % rows) as usize * num_nodes + span.node as usize] |= stored;
        }
        due
    }
}

/// What is wrong with the decoded samples of a span, if anything is.
fn range_problem(payload: &Payload, layout: &chronoxel_core::BrickLayout, span: &Placed) -> Option<String> {
    let [low, high] = span.record.drawn_range;
    match decoded_range(payload, layout, span.record.len) {
        Ok([min, max]) if min >= low && max <= high => None,
        Ok([min, max]) => Some(format!("decoded samples {min} to {max}, drawn range {low} to {high}")),
        Err(error) => Some(error.to_string()),
    }
}
