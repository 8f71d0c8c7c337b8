//! Spans on disk: sixteen numbers each, `[row, node, field]`, all NaN where there is no span.

use std::collections::BTreeMap;

use chronoxel_core::{PayloadAddress, SpanKind, SpanRecord, SpanStatistics};

use crate::{chunk, header::VariableEntry, layout};

/// Names of the fields, in order.
pub const FIELDS: [&str; NUM_FIELDS] = [
    "start",
    "len",
    "kind",
    "class",
    "payload_row",
    "payload_node",
    "value",
    "drawn_min",
    "drawn_max",
    "mask_row",
    "mask_node",
    "count",
    "min",
    "max",
    "mean",
    "std",
];

/// Number of fields of a span.
pub(crate) const NUM_FIELDS: usize = 16;

/// The spans of one chunk that were put so far, by their place: row in the chunk × number of nodes + node.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct OpenSpans(pub BTreeMap<u32, [f64; NUM_FIELDS]>);

impl OpenSpans {
    pub fn set(&mut self, place: u32, record: &SpanRecord) {
        self.0.insert(place, fields_of(record));
    }

    pub fn starts(&self) -> impl Iterator<Item = f64> + '_ {
        self.0.values().map(|fields| fields[0])
    }

    pub fn into_chunk(self, num_rows: u32, num_nodes: usize) -> SpanChunk {
        let mut fields = vec![[f64::NAN; NUM_FIELDS]; num_rows as usize * num_nodes];
        self.0.into_iter().for_each(|(place, span)| fields[place as usize] = span);
        SpanChunk { num_nodes, fields }
    }
}

/// One chunk of spans: `[row, node, field]`, the rows of one shard.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SpanChunk {
    num_nodes: usize,
    /// `[row, node]`.
    fields: Vec<[f64; NUM_FIELDS]>,
}

/// In which order the numbers of a chunk are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SpanOrder {
    /// `[row, node, field]`.
    BySpan,
    /// `[field, row, node]`.
    ByField,
}

impl SpanChunk {
    /// Bytes of a chunk before compression.
    pub fn size(num_rows: u32, num_nodes: usize) -> usize {
        8 * NUM_FIELDS * num_nodes * num_rows as usize
    }

    pub fn num_bytes(&self) -> usize {
        8 * NUM_FIELDS * self.fields.len()
    }

    pub fn fields(&self, row_in_shard: u32, node: usize) -> &[f64; NUM_FIELDS] {
        &self.fields[row_in_shard as usize * self.num_nodes + node]
    }

    pub fn encode(&self, order: SpanOrder, zstd_level: i32) -> std::io::Result<Vec<u8>> {
        match order {
            SpanOrder::BySpan => {
                let bytes: Vec<u8> = self.fields.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
                chunk::encode_once(&bytes, zstd_level)
            }
            SpanOrder::ByField => chunk::encode_by_field(&self.fields, zstd_level),
        }
    }

    pub fn decode(order: SpanOrder, num_rows: u32, num_nodes: usize, stored: &[u8]) -> Result<Self, String> {
        let num_spans = num_rows as usize * num_nodes;
        let fields = match order {
            SpanOrder::BySpan => {
                let bytes = chunk::decode(stored, Self::size(num_rows, num_nodes))?;
                let (values, _) = bytes.as_chunks();
                let value = |at: usize| f64::from_le_bytes(values[at]);
                let span = |span: usize| std::array::from_fn(|field| value(span * NUM_FIELDS + field));
                (0..num_spans).map(span).collect()
            }
            SpanOrder::ByField => chunk::decode_by_field(stored, num_spans)?,
        };
        Ok(Self { num_nodes, fields })
    }
}

fn fields_of(record: &SpanRecord) -> [f64; NUM_FIELDS] {
    let nan = f64::NAN;
    let (kind, class, at, value) = match record.kind {
        SpanKind::Empty => (0.0, nan, None, nan),
        SpanKind::Constant(value) => (1.0, nan, None, value),
        SpanKind::Coded { class, at } => (2.0, f64::from(class), Some(at), nan),
    };
    let place = |at: Option<PayloadAddress>| at.map_or([nan; 2], |at| [at.row, at.node].map(f64::from));
    let ([payload_row, payload_node], [mask_row, mask_node]) = (place(at), place(record.mask));
    let SpanStatistics { count, min, max, mean, std } = record.statistics;
    let fields = [
        f64::from(record.start),
        f64::from(record.len),
        kind,
        class,
        payload_row,
        payload_node,
        value,
        record.drawn_range[0],
        record.drawn_range[1],
        mask_row,
        mask_node,
        count as f64,
        min,
        max,
        mean,
        std,
    ];
    // One NaN of the many, so that equal spans have equal bytes.
    fields.map(|v| if v.is_nan() { nan } else { v })
}

/// Where a span's fields were found, and what bounds them.
pub(crate) struct SpanContext<'a> {
    pub variable: &'a VariableEntry,
    pub window: u32,
    pub row: u32,
    pub num_nodes: usize,
    pub num_steps: u32,
}

/// The span in a set of fields; `None` where there is none, else what is wrong.
pub(crate) fn record_of(
    fields: &[f64; NUM_FIELDS],
    context: &SpanContext,
) -> Result<Option<SpanRecord>, String> {
    if fields.iter().all(|v| v.is_nan()) {
        return Ok(None);
    }
    let (start, len) = (whole(fields, 0)?, whole(fields, 1)?);
    if layout::row(start, context.window) != context.row {
        return Err(format!("start {start} belongs to another row"));
    }
    let end = u64::from(start) + u64::from(len);
    if len == 0 || len > context.window || end > u64::from(context.num_steps) {
        return Err(format!("len is {len} at step {start} of {}", context.num_steps));
    }
    let kind = kind_of(fields, context)?;
    let mask = match fields[9].is_nan() && fields[10].is_nan() {
        true => None,
        false => Some(address(fields, 9, context)?),
    };
    let empty = kind == SpanKind::Empty;
    let drawn_range = [fields[7], fields[8]];
    let sound = drawn_range[0].is_finite() && drawn_range[1].is_finite() && drawn_range[0] <= drawn_range[1];
    if empty != drawn_range.iter().all(|v| v.is_nan()) || (!empty && !sound) {
        return Err(format!("the drawn range is {} to {}", fields[7], fields[8]));
    }
    if empty && mask.is_some() {
        return Err("an empty span has a mask".into());
    }
    let statistics = statistics_of(fields)?;
    Ok(Some(SpanRecord { start, len, window: context.window, kind, mask, drawn_range, statistics }))
}

fn kind_of(fields: &[f64; NUM_FIELDS], context: &SpanContext) -> Result<SpanKind, String> {
    let absent = |at: std::ops::Range<usize>| match at.clone().find(|&at| !fields[at].is_nan()) {
        None => Ok(()),
        Some(at) => Err(format!("{} is {} in a span of kind {}", FIELDS[at], fields[at], fields[2])),
    };
    match fields[2] {
        0.0 => absent(3..7).map(|()| SpanKind::Empty),
        1.0 => {
            absent(3..6)?;
            let value = fields[6];
            match value.is_finite() {
                true => Ok(SpanKind::Constant(value)),
                false => Err(format!("the constant value is {value}")),
            }
        }
        2.0 => {
            absent(6..7)?;
            let class = whole(fields, 3)?;
            let classes = &context.variable.classes;
            if !classes.get(class as usize).is_some_and(|c| c.fits_window(context.window)) {
                return Err(format!(
                    "class is {class}, which windows of {} steps do not have",
                    context.window
                ));
            }
            Ok(SpanKind::Coded { class: class as u8, at: address(fields, 4, context)? })
        }
        kind => Err(format!("kind is {kind}")),
    }
}

fn address(fields: &[f64; NUM_FIELDS], at: usize, context: &SpanContext) -> Result<PayloadAddress, String> {
    let (row, node) = (whole(fields, at)?, whole(fields, at + 1)?);
    if row > context.row || node as usize >= context.num_nodes {
        return Err(format!("{} {row}, {} {node} lie outside the array", FIELDS[at], FIELDS[at + 1]));
    }
    Ok(PayloadAddress { row, node })
}

fn statistics_of(fields: &[f64; NUM_FIELDS]) -> Result<SpanStatistics, String> {
    let [.., count, min, max, mean, std] = *fields;
    if !(count >= 0.0 && count.fract() == 0.0 && count <= (1u64 << 53) as f64) {
        return Err(format!("count is {count}"));
    }
    let values = [min, max, mean, std];
    let sound = match count == 0.0 {
        true => values.iter().all(|v| v.is_nan()),
        false => values.iter().all(|v| v.is_finite()) && min <= max && std >= 0.0,
    };
    match sound {
        true => Ok(SpanStatistics { count: count as u64, min, max, mean, std }),
        false => Err(format!("statistics of {count} samples are {values:?}")),
    }
}

fn whole(fields: &[f64; NUM_FIELDS], at: usize) -> Result<u32, String> {
    let value = fields[at];
    match value >= 0.0 && value <= f64::from(u32::MAX) && value.fract() == 0.0 {
        true => Ok(value as u32),
        false => Err(format!("{} is {value}, not a whole number", FIELDS[at])),
    }
}
