//! The fast renderer: tiles of the picture in parallel, see [`super::tile`].

use std::sync::Arc;
use std::time::Instant;

use chronoxel_core::image::check_size;
use chronoxel_core::{Camera, Image, Lighting, ResolvedTransfer};
use rayon::prelude::*;

use super::gradient::unit_gradients;
use super::lanes::{Plain, Wide};
use super::mesh::{dot, sub};
use super::tile::{Corner, Look, TILE_HEIGHT, TILE_WIDTH, Tile, TileCounts};
use super::{CellMesh, CellTable, CellView, FaceChoice};
use crate::RenderError;

/// Everything about a picture but the mesh and its values.
#[derive(Debug, Clone, PartialEq)]
pub struct CellScene {
    /// Where it is seen from.
    pub camera: Camera,
    /// Colour and opacity of a value.
    pub transfer: ResolvedTransfer,
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// How segments are lit; `None` draws their own colours.
    pub lighting: Option<Lighting>,
    /// Path length that the transfer function's opacities refer to, world units.
    pub opacity_unit: f64,
    /// Smallest and largest value that are told apart: those of the variable, over all steps.
    pub value_range: [f64; 2],
}

impl CellScene {
    /// Checks that a mesh with values can be drawn.
    ///
    /// * `num_values`: of the mesh's points
    pub(crate) fn check(&self, mesh: &CellMesh, num_values: usize) -> Result<(), RenderError> {
        check_size(self.size)?;
        if !(self.opacity_unit.is_finite() && self.opacity_unit > 0.0) {
            let remedy = "it must be a finite and positive length";
            return Err(RenderError::invalid("opacity unit", self.opacity_unit, remedy));
        }
        let [low, high] = self.value_range;
        if !(low.is_finite() && high.is_finite() && low <= high && (high - low).is_finite()) {
            let value = format!("{:?}", self.value_range);
            return Err(RenderError::invalid("range of the values", value, "it must be finite and rising"));
        }
        if num_values != mesh.num_points() {
            let remedy = "give one value per point of the mesh";
            return Err(RenderError::invalid("number of values", num_values, remedy));
        }
        Ok(self.lighting.map_or(Ok(()), |lighting| lighting.check())?)
    }
}

/// How the renderer goes about it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellOptions {
    /// Fragments that a pixel can put into order: 2, 6 or 16.
    pub k: usize,
    /// Use plain Rust even where the CPU has AVX2; the picture is the same.
    pub plain: bool,
}

impl Default for CellOptions {
    fn default() -> Self {
        Self { k: 6, plain: false }
    }
}

/// What it took to make a picture.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CellStats {
    /// Faces that cover a pixel's centre, parts of faces at the camera counted one by one.
    pub num_faces: usize,
    /// Pixels covered by faces, up to where rays ended.
    pub num_fragments: u64,
    /// Fragments that came after one behind them had been drawn: they were left out.
    pub num_misordered: u64,
    /// Whether faces were sorted, projected and binned for this picture.
    pub view_changed: bool,
    /// Whether the transfer function was integrated for this picture.
    pub table_changed: bool,
    /// Wall-clock time of all of it.
    pub render_ms: f64,
}

/// Draws pictures of one mesh, and keeps what the next one can use.
///
/// A new step costs its values and its pixels; a new camera also the lists of the tiles, and a sort if it turned or, in a
/// perspective, moved; a new transfer function also a table.
pub struct CellRenderer {
    mesh: Arc<CellMesh>,
    options: CellOptions,
    choice: Option<FaceChoice>,
    view: Option<CellView>,
    table: Option<(TableKey, CellTable)>,
    corners: Vec<Corner>,
}

/// Checks that pixels can put so many fragments into order.
pub(crate) fn check_k(k: usize) -> Result<(), RenderError> {
    if [2, 6, 16].contains(&k) { Ok(()) } else { Err(RenderError::invalid("k", k, "use 2, 6 or 16")) }
}

/// What a table depends on: transfer function, range of values, and the lengths of the opacity's unit and the longest segment.
pub(crate) type TableKey = (ResolvedTransfer, [f64; 2], [f64; 2]);

impl CellRenderer {
    /// A renderer of a mesh.
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if `k` is none of 2, 6 and 16.
    pub fn new(mesh: Arc<CellMesh>, options: CellOptions) -> Result<Self, RenderError> {
        check_k(options.k)?;
        Ok(Self { mesh, options, choice: None, view: None, table: None, corners: Vec::new() })
    }

    /// The mesh.
    pub fn mesh(&self) -> &Arc<CellMesh> {
        &self.mesh
    }

    /// Draws only some of the faces from now on, or all.
    pub fn choose(&mut self, choice: Option<FaceChoice>) {
        if let Some(view) = &mut self.view {
            view.choose(choice.as_ref());
        }
        self.choice = choice;
    }

    /// Bytes held in memory beside the mesh.
    pub fn num_bytes(&self) -> usize {
        self.view.as_ref().map_or(0, CellView::num_bytes)
            + self.table.as_ref().map_or(0, |(_, table)| table.num_bytes())
            + size_of_val(self.corners.as_slice())
    }

    /// Draws a step, in the threads of rayon's current pool. The picture is the same for any number of them.
    ///
    /// * `values`: one per point; where one is NaN, the segments around it are not drawn
    ///
    /// # Errors
    /// [`RenderError`] if the scene cannot be drawn, or there is another number of values than points.
    pub fn render(&mut self, scene: &CellScene, values: &[f32]) -> Result<(Image, CellStats), RenderError> {
        let start = Instant::now();
        scene.check(&self.mesh, values.len())?;
        let Self { mesh, options, choice, view, table, corners } = self;
        let mut view_changed = view.is_none();
        let view =
            view.get_or_insert_with(|| CellView::new(mesh, &scene.camera, scene.size, choice.as_ref()));
        view_changed |= view.look(mesh, &scene.camera, scene.size);
        let longest = mesh.longest_segment(choice.is_some());
        let key = (scene.transfer.clone(), scene.value_range, [scene.opacity_unit, longest]);
        table.take_if(|(of, _)| *of != key);
        let table_changed = table.is_none();
        let (_, table) = table.get_or_insert_with(|| {
            (key, CellTable::new(&scene.transfer, scene.value_range, scene.opacity_unit, longest))
        });
        place_corners(corners, view, table, values);
        let cosines = scene.lighting.map(|_| cosines(mesh, view, values));
        let light = scene.lighting.map(light_table);
        let look = Look {
            is_perspective: view.is_perspective(),
            table: &table.entries,
            per_half_longest: (2.0 / table.longest) as f32,
            light: light.as_deref(),
        };
        let job = Job { view, corners, cosines: cosines.as_deref(), look };
        let (image, counts) = draw(&job, *options)?;
        let stats = CellStats {
            num_faces: view.bins.iter().map(|bin| bin.num_faces).sum(),
            num_fragments: counts.fragments,
            num_misordered: counts.misordered,
            view_changed,
            table_changed,
            render_ms: start.elapsed().as_secs_f64() * 1e3,
        };
        Ok((image, stats))
    }
}

/// Points of the picture with their values as indices of the table; those of the cuts after those of the mesh.
fn place_corners(corners: &mut Vec<Corner>, view: &CellView, table: &CellTable, values: &[f32]) {
    let index = |value: f32| {
        let index = (f64::from(value) - table.first_value) * table.nodes_per_value;
        // Infinite values are clamped later, but must not be multiplied by weights of 0.
        if index.is_nan() { f32::NAN } else { index.clamp(-1e6, 1e6) as f32 }
    };
    let place = |(&[x, y, w], value): (&[f32; 3], f32)| Corner { x, y, w, value: index(value) };
    view.points[..values.len()]
        .par_iter()
        .zip(values)
        .with_min_len(1 << 12)
        .map(|(point, value)| place((point, *value)))
        .collect_into_vec(corners);
    let of_cut = |cut: &super::view::Cut| {
        let [a, b] = cut.ends.map(|p| values[p as usize]);
        a + (b - a) * cut.weight
    };
    corners.extend(view.points[values.len()..].iter().zip(view.cuts.iter().map(of_cut)).map(place));
}

/// Cosines between gradient and ray at the points, and at the cuts; where there is no gradient it faces the lamp.
fn cosines(mesh: &CellMesh, view: &CellView, values: &[f32]) -> Vec<f32> {
    let (eye, forward) = (view.camera().position(), view.camera().axes()[2]);
    let is_perspective = view.is_perspective();
    let gradients = unit_gradients(mesh, values);
    let cosine = |(point, gradient): (&[f64; 3], &[f32; 3])| {
        let gradient = gradient.map(f64::from);
        if gradient == [0.0; 3] {
            return 1.0;
        }
        let mut ray = forward;
        if is_perspective {
            ray = sub(*point, eye);
            let length = dot(ray, ray).sqrt();
            ray = if length > 0.0 { ray.map(|c| c / length) } else { forward };
        }
        dot(gradient, ray) as f32
    };
    let mut cosines: Vec<f32> =
        mesh.points.par_iter().zip(&gradients).with_min_len(1 << 12).map(cosine).collect();
    let of_cut = |cut: &super::view::Cut| {
        let [a, b] = cut.ends.map(|p| cosines[p as usize]);
        a + (b - a) * cut.weight
    };
    let of_cuts: Vec<f32> = view.cuts.iter().map(of_cut).collect();
    cosines.extend(of_cuts);
    cosines
}

/// What light does, for each sum of two cosines of 8 bits.
pub(crate) fn light_table(lighting: Lighting) -> Vec<[f32; 4]> {
    let entry = |sum: usize| {
        let cosine = sum as f64 / 510.0;
        let across = (1.0 - cosine * cosine).max(0.0).sqrt();
        let (scattered, highlight) = lighting.headlight_terms([cosine, across, 0.0], [1.0, 0.0, 0.0]);
        [scattered as f32, highlight as f32, 0.0, 0.0]
    };
    (0..=510).map(entry).collect()
}

/// What a picture is drawn from.
struct Job<'a> {
    view: &'a CellView,
    corners: &'a [Corner],
    cosines: Option<&'a [f32]>,
    look: Look<'a>,
}

/// Draws a tile.
type DrawTile<const K: usize> = unsafe fn(&Job, usize, &mut Tile<K>);

fn draw(job: &Job, options: CellOptions) -> Result<(Image, TileCounts), RenderError> {
    match options.k {
        2 => draw_with::<2>(job, tile_drawer::<2>(options.plain)),
        6 => draw_with::<6>(job, tile_drawer::<6>(options.plain)),
        _ => draw_with::<16>(job, tile_drawer::<16>(options.plain)),
    }
}

fn tile_drawer<const K: usize>(plain: bool) -> DrawTile<K> {
    #[cfg(target_arch = "x86_64")]
    if !plain && is_x86_feature_detected!("avx2") && is_x86_feature_detected!("popcnt") {
        let has_more_registers = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl");
        return if has_more_registers { draw_tile_avx512vl::<K> } else { draw_tile_avx2::<K> };
    }
    let _ = plain;
    draw_tile::<Plain, K>
}

fn draw_with<const K: usize>(job: &Job, draw_tile: DrawTile<K>) -> Result<(Image, TileCounts), RenderError> {
    let [width, height] = job.view.size();
    let mut image = Image::new(width, height)?;
    let [across, down] = job.view.num_tiles();
    let rays = job.view.camera().rays([width, height]);
    let forward = job.view.camera().axes()[2];
    let is_perspective = job.look.is_perspective;
    let per_depth = |[x, y]: [usize; 2]| {
        let ray = rays.ray([x as f64 + 0.5, y as f64 + 0.5]);
        if is_perspective { (1.0 / dot(ray.direction, forward)) as f32 } else { 1.0 }
    };
    let drawn: Vec<(Vec<[f32; 4]>, TileCounts)> = (0..across * down)
        .into_par_iter()
        .with_max_len(1)
        .map_init(Tile::new, |tile, number| {
            let is_empty = job.view.bins.iter().all(|bin| bin.starts[number] == bin.starts[number + 1]);
            if is_empty {
                return (Vec::new(), TileCounts::default());
            }
            tile.begin([number % across * TILE_WIDTH, number / across * TILE_HEIGHT], per_depth);
            // SAFETY: `tile_drawer` has checked that the CPU has the instructions.
            unsafe { draw_tile(job, number, tile) };
            (tile.pixels(), tile.counts)
        })
        .collect();
    let mut counts = TileCounts::default();
    for (number, (pixels, of_tile)) in drawn.iter().enumerate() {
        counts.fragments += of_tile.fragments;
        counts.misordered += of_tile.misordered;
        let [x, y] = [number % across * TILE_WIDTH, number / across * TILE_HEIGHT];
        let columns = TILE_WIDTH.min(width - x);
        for (row, line) in pixels.chunks_exact(TILE_WIDTH).take(height - y).enumerate() {
            image.pixels[(y + row) * width + x..][..columns].copy_from_slice(&line[..columns]);
        }
    }
    Ok((image, counts))
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,popcnt")]
unsafe fn draw_tile_avx2<const K: usize>(job: &Job, number: usize, tile: &mut Tile<K>) {
    // SAFETY: AVX2 is there, as the target features say.
    unsafe { draw_tile::<super::lanes::Avx2, K>(job, number, tile) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,popcnt,avx512f,avx512vl")]
unsafe fn draw_tile_avx512vl<const K: usize>(job: &Job, number: usize, tile: &mut Tile<K>) {
    // SAFETY: AVX2 is there, as the target features say.
    unsafe { draw_tile::<super::lanes::Avx2, K>(job, number, tile) }
}

/// Draws the faces of a tile.
///
/// # Safety
/// The CPU has the instructions of `W`.
#[inline(always)]
unsafe fn draw_tile<W: Wide, const K: usize>(job: &Job, number: usize, tile: &mut Tile<K>) {
    for bin in &job.view.bins {
        for &[a, b, c, net] in &bin.list[bin.starts[number] as usize..bin.starts[number + 1] as usize] {
            let points = [a, b, c].map(|p| p as usize);
            let corners = points.map(|p| job.corners[p]);
            let cosines = job.cosines.map_or([0.0; 3], |cosines| points.map(|p| cosines[p]));
            // SAFETY: as this function.
            unsafe { tile.draw::<W>(&job.look, corners, net as i32, cosines) };
        }
        if tile.is_done() {
            return;
        }
    }
    // SAFETY: as this function.
    unsafe { tile.flush::<W>(&job.look) };
}
