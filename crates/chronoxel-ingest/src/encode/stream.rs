//! One step of one variable streaming past: slabs are read ahead, marked, filtered into the levels above, and each
//! layer of bricks is handed on as soon as its last slice is there.

use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;

use chronoxel_core::{BrickLayout, LevelGeometry, Samples};
use rayon::prelude::*;

use super::mark::{Marks, mark};
use super::pyramid;
use super::real::Real;
use super::window::{Slab, Window};
use crate::{SourceError, StepReader};

/// What to stream, and in which portions.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamPlan {
    /// The levels to filter, finest first; level 0 alone for a plain read.
    pub levels: Vec<LevelGeometry>,
    /// The shape of the bricks.
    pub layout: BrickLayout,
    /// Slices read at once. Changes memory and speed, never what comes out.
    pub slab_slices: usize,
}

impl StreamPlan {
    /// Lengths of the slabs to read. None crosses the end of a layer of finest bricks, so that the order in which
    /// layers of all levels become complete does not depend on `slab_slices`.
    fn slab_lengths(&self) -> Vec<usize> {
        let finest = Window::<f32>::new(self.levels[0]);
        let mut lengths = Vec::new();
        let mut done = 0;
        for layer in 0..finest.geometry.bricks[2] {
            let end = finest.slices_for(&self.layout, layer);
            while done < end {
                lengths.push(self.slab_slices.min(end - done));
                done += lengths[lengths.len() - 1];
            }
        }
        lengths
    }
}

/// A layer of bricks that can be cut.
pub struct Layer<'a, T> {
    /// The slices of its level.
    pub window: &'a Window<T>,
    /// z of the layer, counted in bricks.
    pub z: usize,
}

/// Streams a step to its end.
///
/// Layers come in an order that depends on the sizes of the grid alone: whenever a layer of level 0 is complete, it and
/// all layers of the other levels that are complete by then, finest first.
///
/// # Errors
/// Of the reader, or of `on_layer`.
pub fn stream<'a, T: Real, E: From<SourceError>>(
    reader: Box<dyn StepReader + 'a>,
    plan: &StreamPlan,
    fill_value: Option<f64>,
    on_layer: &mut dyn FnMut(Layer<'_, T>) -> Result<(), E>,
) -> Result<Marks, E> {
    let lengths = plan.slab_lengths();
    thread::scope(|scope| {
        // Of capacity zero: the reader holds one slab, and no more are on their way.
        let (sender, slabs) = sync_channel(0);
        let planned = lengths.clone();
        scope.spawn(move || {
            let mut reader = reader;
            for length in planned {
                let slab = reader.read_slices(length);
                let is_last = slab.is_err();
                if sender.send(slab).is_err() || is_last {
                    return;
                }
            }
        });
        let mut step = Step::<T>::new(plan, fill_value);
        for length in lengths {
            step.push(receive(&slabs)?, length);
            step.hand_on(on_layer)?;
        }
        Ok(step.marks)
    })
}

fn receive(slabs: &Receiver<Result<Samples, SourceError>>) -> Result<Samples, SourceError> {
    slabs.recv().expect("the reader sends every slab or an error")
}

struct Step<'a, T> {
    plan: &'a StreamPlan,
    fill_value: Option<f64>,
    windows: Vec<Window<T>>,
    marks: Marks,
}

impl<'a, T: Real> Step<'a, T> {
    fn new(plan: &'a StreamPlan, fill_value: Option<f64>) -> Self {
        let windows = plan.levels.iter().map(|&level| Window::new(level)).collect();
        Self { plan, fill_value, windows, marks: Marks::NONE }
    }

    /// Marks a slab and filters all levels as far as they go.
    fn push(&mut self, samples: Samples, num_slices: usize) {
        let finest = &mut self.windows[0];
        let slice_len = finest.slice_len();
        assert_eq!(samples.len(), slice_len * num_slices, "a reader hands over what it was asked for");
        let mut samples = T::from_samples(samples).expect("the kind of samples follows from their type");
        let fill_value = self.fill_value;
        let marks: Vec<Marks> =
            samples.par_chunks_mut(slice_len).map(|slice| mark(slice, fill_value)).collect();
        let masked = marks.iter().map(|m| m.num_masked > 0).collect();
        self.marks = marks.into_iter().fold(self.marks, Marks::merged);
        finest.push(Slab { first: finest.num_slices(), samples, masked });
        for level in 1..self.windows.len() {
            let (below, above) = self.windows.split_at_mut(level);
            pyramid::advance(&below[level - 1], &mut above[0]);
        }
    }

    fn hand_on<E>(&mut self, on_layer: &mut dyn FnMut(Layer<'_, T>) -> Result<(), E>) -> Result<(), E> {
        let layout = &self.plan.layout;
        if self.windows[0].layer_is_complete(layout) {
            for window in &mut self.windows {
                while window.layer_is_complete(layout) {
                    on_layer(Layer { window, z: window.next_layer })?;
                    window.next_layer += 1;
                }
            }
        }
        for level in 0..self.windows.len() {
            let next_above = self.windows.get(level + 1).and_then(|above| {
                (above.num_slices() < above.geometry.field_dims[2]).then(|| above.num_slices())
            });
            self.windows[level].forget(layout, next_above);
        }
        Ok(())
    }
}
