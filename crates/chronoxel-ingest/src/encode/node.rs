//! One node over one window of time: what its steps are, and the pieces that it is coded as.

use chronoxel_core::{BitMask, BrickLayout, SpanStatistics};

use super::analyse::Analysis;
use super::coding::{Choice, is_whole};
use super::pad::pad;
use super::real::Real;

/// The steps of a node's window, of which at least one has data.
pub struct NodeSteps<T> {
    /// For each step the samples of the full brick, masked ones padded; `None` where all are masked.
    pub samples: Vec<Option<Vec<T>>>,
    /// For each step what is masked, if anything is and not everything.
    pub masks: Vec<Option<BitMask>>,
    /// For each step.
    pub analyses: Vec<Analysis>,
    /// Steps that the window lacks at its start; step `i` has place `lead + i`.
    pub lead: u32,
    /// Whether every unmasked sample of every step is an integer below 2^53.
    pub whole_numbers: bool,
    /// Core samples inside the grid.
    pub core: Vec<u32>,
}

/// Consecutive steps of a node's window that are alike: places `place .. place + width` of it, as far as they exist.
#[derive(Debug, Clone, PartialEq)]
pub struct Section<T> {
    /// Its steps, counted from the window's first that exists.
    pub steps: std::ops::Range<usize>,
    /// Its first place.
    pub place: u32,
    /// Its places: a power of two.
    pub width: u32,
    /// What it holds.
    pub content: SectionContent<T>,
}

/// What a section holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SectionContent<T> {
    /// No data at all.
    Empty,
    /// One value wherever there is data, under one mask.
    Constant(T),
    /// Samples that differ.
    Samples,
}

/// Consecutive steps of a node, coded as one span.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// The first of its steps, counted from the window's first that exists.
    pub start: usize,
    /// Number of its steps.
    pub len: usize,
    /// Its window length: a power of two, at least `len`.
    pub window: u32,
    /// What it holds.
    pub choice: Choice,
    /// Range of the decoded samples; NaN where there are none.
    pub drawn_range: [f64; 2],
}

impl<T: Real> NodeSteps<T> {
    /// * `samples`: for each step the samples of the full brick, masked ones NaN; `None` where all are masked
    pub fn new(
        mut samples: Vec<Option<Vec<T>>>,
        analyses: Vec<Analysis>,
        lead: u32,
        core: Vec<u32>,
        layout: &BrickLayout,
    ) -> Self {
        let all = || samples.iter().flatten().flatten();
        let whole_numbers = all().all(|v| v.is_masked() || is_whole(v.to_f64()));
        let masks = samples.iter_mut().zip(&analyses).map(|(samples, analysis)| {
            let samples = samples.as_mut().filter(|_| analysis.num_masked > 0)?;
            let mask = BitMask::from_flags(samples.iter().map(|v| v.is_masked()));
            pad(samples, layout.full_edge(), whole_numbers);
            Some(mask)
        });
        let masks = masks.collect();
        Self { samples, masks, analyses, lead, whole_numbers, core }
    }

    /// The steps at places `place .. place + width`.
    pub fn steps_at(&self, place: u32, width: u32) -> std::ops::Range<usize> {
        let index = |place: u32| (place.saturating_sub(self.lead) as usize).min(self.samples.len());
        index(place)..index(place + width)
    }

    /// The window as sections, halved until every step of each has data or none has, and with `one_mask` the same mask.
    pub fn sections(&self, window: u32, one_mask: bool) -> Vec<Section<T>> {
        let mut sections = Vec::new();
        self.add_sections(0, window, one_mask, &mut sections);
        sections
    }

    fn add_sections(&self, place: u32, width: u32, one_mask: bool, out: &mut Vec<Section<T>>) {
        let steps = self.steps_at(place, width);
        if steps.is_empty() {
            return;
        }
        let same_mask = steps.clone().all(|step| self.masks[step] == self.masks[steps.start]);
        let num_empty = steps.clone().filter(|&step| self.samples[step].is_none()).count();
        let constant = if num_empty == 0 && same_mask { self.constant(steps.clone()) } else { None };
        let content = match constant {
            _ if num_empty == steps.len() => SectionContent::Empty,
            Some(value) => SectionContent::Constant(value),
            None if num_empty == 0 && (same_mask || !one_mask) => SectionContent::Samples,
            None => {
                self.add_sections(place, width / 2, one_mask, out);
                return self.add_sections(place + width / 2, width / 2, one_mask, out);
            }
        };
        out.push(Section { steps, place, width, content });
    }

    /// The samples of steps that all have data.
    pub fn samples_of(&self, steps: std::ops::Range<usize>) -> Vec<&[T]> {
        self.samples[steps].iter().flatten().map(Vec::as_slice).collect()
    }

    /// Samples that tables of some steps with one mask are trained on: of the core, where any of it has data.
    pub fn trained(&self, first: usize) -> Vec<u32> {
        let Some(mask) = &self.masks[first] else { return self.core.clone() };
        let trained: Vec<u32> = self.core.iter().copied().filter(|&i| !mask.get(i as usize)).collect();
        if !trained.is_empty() {
            return trained;
        }
        let num_samples = self.samples[first].as_ref().map_or(0, Vec::len) as u32;
        (0..num_samples).filter(|&i| !mask.get(i as usize)).collect()
    }

    /// Statistics of the source over some steps.
    pub fn statistics(&self, steps: std::ops::Range<usize>) -> SpanStatistics {
        let none = SpanStatistics { count: 0, min: f64::NAN, max: f64::NAN, mean: f64::NAN, std: f64::NAN };
        self.analyses[steps].iter().map(|a| a.statistics).fold(none, SpanStatistics::merged)
    }

    /// The one value of all unmasked samples of some steps, if they have the same bits.
    pub fn constant(&self, steps: std::ops::Range<usize>) -> Option<T> {
        let value = |step: usize| {
            let samples = self.samples[step].as_ref().filter(|_| self.analyses[step].is_constant)?;
            // Pads are within the range, so they are that value too; but for the sign of zero.
            let unmasked = |i: &usize| self.masks[step].as_ref().is_none_or(|mask| !mask.get(*i));
            (0..samples.len()).find(unmasked).map(|i| samples[i])
        };
        let first = value(steps.start)?;
        steps.into_iter().all(|step| value(step).is_some_and(|v| v.same_bits(first))).then_some(first)
    }
}

impl<T: Real> Section<T> {
    /// The piece of a section without samples that differ.
    pub fn piece(&self) -> Option<Piece> {
        let (choice, drawn_range) = match self.content {
            SectionContent::Empty => (Choice::Empty, [f64::NAN; 2]),
            SectionContent::Constant(value) => (Choice::Constant(value.to_f64()), [value.to_f64(); 2]),
            SectionContent::Samples => return None,
        };
        Some(Piece {
            start: self.steps.start,
            len: self.steps.len(),
            window: self.width,
            choice,
            drawn_range,
        })
    }
}
