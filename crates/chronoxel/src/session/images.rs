//! Partial images that are kept while the camera stands still: what did not change since the last picture is not drawn again, but composited
//! (shen1999, as told in ellsworth2000, section 3).

use std::{collections::HashSet, ops::Range, sync::Arc, time::Instant};

use chronoxel_core::{ByteLru, NodeId};
use chronoxel_render::{DrawBrick, DrawHow, PartialImage};
use chronoxel_store::StoreError;
use chronoxel_stream::{DrawItem, How};

use super::{Drawing, Session, View, bricks::BrickKey};

/// What makes two boxes of one view look the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct BoxKey {
    node: NodeId,
    /// Its lowest corner, by bits: an octant of the node may be drawn alone.
    low: [u64; 3],
    look: Look,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Look {
    Constant(u64),
    Color([u32; 4]),
    Samples(BrickKey),
}

impl BoxKey {
    /// Of what a draw list says.
    ///
    /// * `brick`: of a box that is drawn from a payload
    pub fn new(item: &DrawItem, brick: Option<BrickKey>) -> Option<Self> {
        let look = match item.how {
            How::Skip => return None,
            How::Constant(value) => Look::Constant(value.to_bits()),
            How::ConstantColor(color) => Look::Color(color.map(f32::to_bits)),
            How::Payload => Look::Samples(brick?),
        };
        Some(Self { node: item.node, low: item.region[0].map(f64::to_bits), look })
    }
}

/// Most boxes that one image is of: the more, the cheaper to composite, and the more is drawn again when one changes.
const MOST_BOXES: usize = 8;

/// The images of the view drawn last.
pub(super) struct Images {
    budget_bytes: usize,
    view: Option<View>,
    /// By the first of the boxes that they are of.
    runs: ByteLru<BoxKey, Arc<Run>>,
    /// Boxes of the picture before.
    before: HashSet<BoxKey>,
    step_before: Option<u32>,
}

/// What some consecutive boxes of a draw list add to a picture.
struct Run {
    boxes: Vec<BoxKey>,
    image: Arc<PartialImage>,
}

/// A part of a picture: some consecutive entries of its draw list. Between parts nothing is drawn.
#[derive(Debug, Clone)]
pub(super) enum Part {
    /// To be drawn.
    Draw(Range<usize>),
    /// To be drawn and recorded.
    Record(Range<usize>),
    /// To be composited: so many boxes.
    Composite(usize, Arc<PartialImage>),
}

/// An entry of a draw list that is drawn.
#[derive(Clone, Copy)]
struct Drawn {
    entry: usize,
    key: BoxKey,
    /// Whether it is likely to look the same in the next picture.
    stays: bool,
}

impl Images {
    /// None yet, and never more than `budget_bytes` of them.
    pub fn new(budget_bytes: usize) -> Self {
        Self {
            budget_bytes,
            view: None,
            runs: ByteLru::new(budget_bytes),
            before: HashSet::new(),
            step_before: None,
        }
    }

    /// Whether any may be kept.
    pub fn are_kept(&self) -> bool {
        self.budget_bytes > 0
    }

    /// The most bytes that they took so far in this view.
    pub fn peak_bytes(&self) -> usize {
        self.runs.counts().peak_bytes
    }

    /// What to do with the draw list of a step.
    ///
    /// A box is recorded where it will look the same at the step that is likely to come next, or looked the same in the picture
    /// before.
    ///
    /// * `keys`: of its entries, `None` where nothing is drawn
    pub fn plan(&mut self, view: &View, step: u32, items: &[DrawItem], keys: &[Option<BoxKey>]) -> Vec<Part> {
        if self.view.as_ref() != Some(view) {
            *self = Self { view: Some(view.clone()), ..Self::new(self.budget_bytes) };
        }
        let stays = |entry: usize, key: &BoxKey| match next_step(self.step_before, step) {
            Some(next) if items[entry].steps.contains(&next) => true,
            _ => self.before.contains(key),
        };
        let drawn = keys
            .iter()
            .enumerate()
            .filter_map(|(entry, key)| key.map(|key| Drawn { entry, key, stays: stays(entry, &key) }));
        let drawn: Vec<Drawn> = drawn.collect();
        self.before = drawn.iter().map(|drawn| drawn.key).collect();
        self.step_before = Some(step);
        self.parts(&drawn)
    }

    fn parts(&mut self, drawn: &[Drawn]) -> Vec<Part> {
        let mut parts = Vec::new();
        let mut rest = drawn;
        while let Some(first) = rest.first() {
            if let Some(run) = self.run_at(rest) {
                parts.push(Part::Composite(run.boxes.len(), Arc::clone(&run.image)));
                rest = &rest[run.boxes.len()..];
                continue;
            }
            let most = if first.stays { MOST_BOXES } else { usize::MAX };
            let goes_on = |n: &usize| rest[*n].stays == first.stays && self.run_at(&rest[*n..]).is_none();
            let num_more = (1..rest.len().min(most)).take_while(goes_on).count();
            let entries = first.entry..rest[num_more].entry + 1;
            parts.push(if first.stays { Part::Record(entries) } else { Part::Draw(entries) });
            rest = &rest[num_more + 1..];
        }
        parts
    }

    /// The image of the first of some boxes and those that follow, if there is one.
    fn run_at(&mut self, drawn: &[Drawn]) -> Option<Arc<Run>> {
        let run = self.runs.get(&drawn[0].key)?;
        let same =
            run.boxes.len() <= drawn.len() && run.boxes.iter().zip(drawn).all(|(key, d)| *key == d.key);
        same.then_some(run)
    }

    /// Keeps an image.
    ///
    /// * `keys`: of the entries that it is of
    pub fn keep(&mut self, keys: &[Option<BoxKey>], image: PartialImage) {
        let boxes: Vec<BoxKey> = keys.iter().copied().flatten().collect();
        let num_bytes = image.num_bytes() + size_of::<Run>() + size_of_val(boxes.as_slice());
        if let Some(first) = boxes.first() {
            self.runs.insert(*first, Arc::new(Run { boxes, image: Arc::new(image) }), num_bytes);
        }
    }
}

/// The step that comes after two others at the same stride.
fn next_step(before: Option<u32>, step: u32) -> Option<u32> {
    let stride = before.map_or(1, |before| i64::from(step) - i64::from(before));
    if stride == 0 { None } else { u32::try_from(i64::from(step) + stride).ok() }
}

impl Session {
    /// Draws a draw list, composites what of it is kept, and keeps what of it is likely to be of use.
    pub(super) fn draw_parts(
        &mut self,
        view: &View,
        step: u32,
        items: &[DrawItem],
        drawing: &mut Drawing<'_>,
    ) -> anyhow::Result<()> {
        let keys = items.iter().map(|item| self.box_key(item)).collect::<Result<Vec<_>, _>>()?;
        drawing.bricks.skipped += keys.iter().filter(|key| key.is_none()).count();
        let parts = self.images.plan(view, step, items, &keys);
        let one_by_one = parts.into_iter().flat_map(|part| match part {
            Part::Draw(entries) => entries.map(|entry| Part::Draw(entry..entry + 1)).collect(),
            part => vec![part],
        });
        let mut rest: &[Part] = &one_by_one.collect::<Vec<_>>();
        while !rest.is_empty() {
            let is_payload = |entry: usize| items[entry].how == How::Payload;
            let num_payloads = |part: &Part| match part {
                Part::Draw(entries) | Part::Record(entries) => {
                    entries.clone().filter(|&entry| is_payload(entry)).count()
                }
                Part::Composite(..) => 0,
            };
            let (portion, after) = rest.split_at(self.num_in_portion(rest.iter().map(num_payloads)));
            rest = after;
            self.draw_portion(portion, items, &keys, drawing)?;
        }
        Ok(())
    }

    fn draw_portion(
        &mut self,
        parts: &[Part],
        items: &[DrawItem],
        keys: &[Option<BoxKey>],
        drawing: &mut Drawing<'_>,
    ) -> anyhow::Result<()> {
        let start = Instant::now();
        let drawn_in = |entries: &Range<usize>| entries.clone().filter(|&entry| keys[entry].is_some());
        let to_fetch = parts.iter().flat_map(|part| match part {
            Part::Draw(entries) | Part::Record(entries) => drawn_in(entries).collect(),
            Part::Composite(..) => Vec::new(),
        });
        let to_fetch: Vec<DrawItem> = to_fetch.map(|entry| items[entry].clone()).collect();
        let mut fetched = self.fetch(&to_fetch, &mut drawing.bricks, &mut drawing.faults)?.into_iter();
        let (mut bricks, mut runs, mut recorded) = (Vec::new(), Vec::new(), Vec::new());
        for part in parts {
            let first = bricks.len();
            match part {
                Part::Draw(entries) => bricks.extend(fetched.by_ref().take(drawn_in(entries).count())),
                Part::Record(entries) => {
                    bricks.extend(fetched.by_ref().take(drawn_in(entries).count()));
                    runs.push(first..bricks.len());
                    recorded.push(entries.clone());
                }
                Part::Composite(num_boxes, image) => {
                    drawing.bricks.composited += num_boxes;
                    let how = DrawHow::Partial(Arc::clone(image));
                    bricks.push(DrawBrick { node: self.tree.root(), region: [[0.0; 3], [1.0; 3]], how });
                }
            }
        }
        drawing.fetch_ms += start.elapsed().as_secs_f64() * 1e3;
        if !drawing.faults.warnings.is_empty() {
            // Another brick stands in for a damaged one: every picture must say so.
            return Ok(drawing.frame.draw(&bricks)?);
        }
        let images = drawing.frame.draw_recording(&bricks, &runs)?;
        for (entries, image) in recorded.into_iter().zip(images) {
            if let Some(image) = image {
                self.images.keep(&keys[entries], image);
            }
        }
        Ok(())
    }

    fn box_key(&mut self, item: &DrawItem) -> Result<Option<BoxKey>, StoreError> {
        let brick = match item.how {
            How::Payload => self.brick_key(item)?,
            _ => None,
        };
        Ok(BoxKey::new(item, brick))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_go_on_at_their_stride() {
        assert_eq!(next_step(None, 0), Some(1));
        assert_eq!(next_step(Some(4), 6), Some(8));
        assert_eq!(next_step(Some(4), 3), Some(2));
        assert_eq!((next_step(Some(1), 0), next_step(Some(5), 5)), (None, None));
    }
}
