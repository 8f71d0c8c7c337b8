//! The ray caster on the CPU: object order, tile by tile.
//!
//! The screen is cut into tiles, which threads take one after another. A tile goes through the bricks that its part of
//! the screen may see, front to back, and through each with packets of eight rays. Where a sample lies and which brick
//! owns it follow from the ray alone, so that neither tiles nor threads nor skipping change a pixel.

mod blocks;
mod kernel;
mod lanes;
mod light;
mod partial;
pub(crate) mod table;
mod tile;

use std::collections::HashMap;
use std::ops::Range;
use std::time::Instant;

use chronoxel_core::{Image, UniformGrid};
use rayon::prelude::*;

use crate::prepared::BLOCK_EDGE;
use crate::scene::MAX_LEVELS;
use crate::{DrawBrick, DrawHow, PreparedBrick, RenderError, RenderStats, Scene};

#[cfg(feature = "gpu")]
pub(crate) use kernel::LEAST_TRANSMITTANCE;
pub use kernel::kernel_name;
use kernel::{BrickJob, LevelBox, March};
use light::LightJob;
pub use partial::PartialImage;
use table::Table;
use tile::{PixelBlock, RaySetup, Tile, Work};

/// How the ray caster goes about it; the picture is the same for every choice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CpuOptions {
    /// Pixels along the edge of a tile, rounded up to a multiple of 8.
    pub tile_edge: usize,
    /// Use plain Rust even where the CPU has AVX2.
    pub plain: bool,
}

impl Default for CpuOptions {
    fn default() -> Self {
        Self { tile_edge: 16, plain: false }
    }
}

/// Draws a scene from its bricks, in the threads of rayon's current pool.
///
/// * `bricks`: boxes that do not overlap, front to back
///
/// # Errors
/// [`RenderError`] if the scene cannot be drawn, or a brick does not fit it.
pub fn render(scene: &Scene, bricks: &[DrawBrick]) -> Result<(Image, RenderStats), RenderError> {
    render_with(scene, bricks, &CpuOptions::default())
}

/// [`render`], with a choice of how.
///
/// # Errors
/// As [`render`].
pub fn render_with(
    scene: &Scene,
    bricks: &[DrawBrick],
    options: &CpuOptions,
) -> Result<(Image, RenderStats), RenderError> {
    let mut frame = Frame::new(scene, *options)?;
    frame.draw(bricks)?;
    Ok(frame.finish())
}

/// A picture that is drawn in portions, front to back: for volumes whose bricks do not fit memory at once.
pub struct Frame<'a> {
    scene: &'a Scene,
    options: CpuOptions,
    /// Red, green and blue multiplied by alpha, and transmittance, of every pixel so far.
    gathered: Image,
    is_begun: bool,
    stats: RenderStats,
}

impl<'a> Frame<'a> {
    /// A picture on which nothing is drawn yet.
    ///
    /// # Errors
    /// [`RenderError`] if the scene cannot be drawn.
    pub fn new(scene: &'a Scene, options: CpuOptions) -> Result<Self, RenderError> {
        scene.check()?;
        let [width, height] = scene.size;
        let gathered = Image { width, height, pixels: vec![[0.0, 0.0, 0.0, 1.0]; width * height] };
        Ok(Self { scene, options, gathered, is_begun: false, stats: RenderStats::default() })
    }

    /// Draws bricks behind those drawn before. Portions do not change a pixel.
    ///
    /// * `bricks`: boxes that do not overlap, front to back
    ///
    /// # Errors
    /// [`RenderError`] if a brick does not fit the scene.
    pub fn draw(&mut self, bricks: &[DrawBrick]) -> Result<(), RenderError> {
        self.draw_recording(bricks, &[]).map(drop)
    }

    /// [`Self::draw`], and keeps what runs of the bricks add to the picture, each as one partial image.
    ///
    /// A later picture of the same view may then composite the image in place of the run: as [`DrawHow::Partial`] of
    /// its first brick, the others being [`DrawHow::Skip`]. Recorded or composited, a run gives the same bits, whatever
    /// the tiles; drawn without being recorded, it gives others: by rounding, and by up to 1/512 where rays end, because
    /// those of a run end as if nothing were in front.
    ///
    /// A run that can be seen anywhere is drawn everywhere. There is no image of a run that is hidden altogether, because
    /// every ray that crosses it has ended in front: it is not drawn. A run that shows nothing, or none of which lies in
    /// the picture, has an empty image.
    ///
    /// * `runs`: indices of consecutive bricks, at least one each; ascending, not overlapping
    ///
    /// # Errors
    /// [`RenderError`] if a brick does not fit the scene, or the runs do not fit the list.
    pub fn draw_recording(
        &mut self,
        bricks: &[DrawBrick],
        runs: &[Range<usize>],
    ) -> Result<Vec<Option<PartialImage>>, RenderError> {
        let start = Instant::now();
        let run_of_each = run_of_each(bricks.len(), runs)?;
        let tables = Tables::new(self.scene, bricks)?;
        let mut jobs = Vec::with_capacity(bricks.len());
        for (brick, run) in bricks.iter().zip(run_of_each) {
            let job = Job::new(self.scene, brick, &tables, &self.options)?;
            match job.as_ref().map(|job| &job.work) {
                None => self.stats.bricks_skipped += 1,
                Some(Work::March(..)) => self.stats.bricks_drawn += 1,
                Some(Work::Constant(_)) => self.stats.bricks_constant += 1,
                Some(Work::Partial(_)) => self.stats.bricks_composited += 1,
            }
            jobs.extend(job.map(|job| Job { run, ..job }));
        }
        let mut drawn = self.draw_tiles(&jobs);
        self.is_begun = true;
        drawn.iter().for_each(|block| block.copy_to(&mut self.gathered));
        let hidden = partial::take_hidden(runs.len(), drawn.iter_mut().map(|b| (b.corner, &mut b.recorded)));
        drawn.extend(self.draw_hidden(&jobs, hidden));
        self.stats.num_samples += drawn.iter().map(|block| block.num_samples).sum::<u64>();
        let recorded: Vec<_> = drawn.into_iter().map(|block| block.recorded).collect();
        let images = partial::assemble(self.scene.size, runs.len(), &recorded);
        self.stats.render_ms += start.elapsed().as_secs_f64() * 1e3;
        Ok(images)
    }

    fn tile_edge(&self) -> usize {
        self.options.tile_edge.clamp(8, 1024).next_multiple_of(8)
    }

    /// Records runs in tiles where all of them is hidden.
    ///
    /// * `hidden`: corners of tiles, and the run that is drawn there
    fn draw_hidden(&self, jobs: &[Job], hidden: Vec<([usize; 2], u32)>) -> Vec<PixelBlock> {
        let (edge, size, setup) = (self.tile_edge(), self.scene.size, RaySetup::new(self.scene));
        let of_runs: HashMap<_, _> =
            jobs.chunk_by(|a, b| a.run == b.run).map(|run| (run[0].run, run)).collect();
        let draw = |tile: &mut Tile, (corner, run): ([usize; 2], u32)| {
            tile.begin(Some(&setup), corner, size, edge, None);
            tile.record(run, of_runs[&Some(run)].iter());
            tile.end()
        };
        hidden.into_par_iter().with_max_len(8).map_init(Tile::default, draw).collect()
    }

    /// Draws jobs behind what was drawn before, tile by tile.
    fn draw_tiles(&self, jobs: &[Job]) -> Vec<PixelBlock> {
        let (edge, size) = (self.tile_edge(), self.scene.size);
        let setup = RaySetup::new(self.scene);
        let gathered = self.is_begun.then_some(&self.gathered);
        let job = |i: &u32| &jobs[*i as usize];
        bin(jobs, size, edge)
            .into_par_iter()
            .with_max_len(1)
            .map_init(Tile::default, |tile, (corner, list)| {
                let needs_rays = list.iter().any(|i| !matches!(job(i).work, Work::Partial(_)));
                tile.begin(needs_rays.then_some(&setup), corner, size, edge, gathered);
                for run in list.chunk_by(|a, b| job(a).run.is_some() && job(a).run == job(b).run) {
                    match job(&run[0]).run {
                        Some(number) => tile.record(number, run.iter().map(job)),
                        None => tile.draw(job(&run[0])),
                    }
                }
                tile.end()
            })
            .collect()
    }

    /// The picture, and what it took.
    pub fn finish(self) -> (Image, RenderStats) {
        let mut image = self.gathered;
        image.pixels.iter_mut().for_each(|pixel| pixel[3] = 1.0 - pixel[3]);
        (image, self.stats)
    }
}

/// For each brick of a list, the number of the run that it is recorded with.
fn run_of_each(num_bricks: usize, runs: &[Range<usize>]) -> Result<Vec<Option<u32>>, RenderError> {
    let (mut of_each, mut end) = (vec![None; num_bricks], 0);
    for (i, run) in runs.iter().enumerate() {
        if run.start < end || run.is_empty() || run.end > num_bricks {
            let remedy = "runs must have bricks, ascend, not overlap, and end within the list";
            return Err(RenderError::invalid("run to record", format!("{run:?}"), remedy));
        }
        of_each[run.clone()].fill(Some(i as u32));
        end = run.end;
    }
    Ok(of_each)
}

/// One table per level that is drawn: opacities are those of the level's step length.
struct Tables {
    of_level: Vec<Option<Table>>,
}

impl Tables {
    fn new(scene: &Scene, bricks: &[DrawBrick]) -> Result<Self, RenderError> {
        let mut of_level: Vec<Option<Table>> = Vec::new();
        for brick in bricks {
            if brick.node.level >= MAX_LEVELS {
                return Err(RenderError::invalid("brick's level", brick.node.level, "it must be below 32"));
            }
            let level = usize::from(brick.node.level);
            of_level.resize_with(of_level.len().max(level + 1), || None);
            if of_level[level].is_none() && matches!(brick.how, DrawHow::Samples(_)) {
                let dt = scene.step_length_at(brick.node.level);
                of_level[level] = Some(Table::new(&scene.transfer, dt, scene.opacity_unit));
            }
        }
        Ok(Self { of_level })
    }
}

/// A brick on its way to the screen.
struct Job<'a> {
    /// Columns and rows of the picture that it may touch, half-open.
    pixels: [[usize; 2]; 2],
    region: LevelBox,
    work: Work<'a>,
    /// The number of the run that it is recorded with.
    run: Option<u32>,
}

impl<'a> Job<'a> {
    fn new(
        scene: &'a Scene,
        brick: &'a DrawBrick,
        tables: &'a Tables,
        options: &CpuOptions,
    ) -> Result<Option<Self>, RenderError> {
        let [low, high] = brick.region;
        let is_box = (0..3).all(|a| low[a] < high[a] && low[a].is_finite() && high[a].is_finite());
        if !is_box {
            let remedy = "the lower corner must lie below the upper one";
            return Err(RenderError::invalid("brick's region", format!("{:?}", brick.region), remedy));
        }
        let mut level = brick.node.level;
        if matches!(brick.how, DrawHow::Constant(_) | DrawHow::ConstantColor(..)) {
            level = level.min(scene.finest_level);
        }
        let constant = |color: [f64; 4]| {
            let sample = table::premultiplied(color, scene.step_length_at(level), scene.opacity_unit);
            (sample[3] > 0.0).then_some(Work::Constant(sample))
        };
        let mut region = brick.region;
        let work = match &brick.how {
            DrawHow::Skip => None,
            DrawHow::Constant(value) => constant(scene.transfer.evaluate(*value)),
            DrawHow::Partial(image) => return Self::of_image(scene, image),
            DrawHow::ConstantColor([r, g, b], opacity) => constant([*r, *g, *b, *opacity].map(f64::from)),
            DrawHow::Samples(prepared) => {
                let table =
                    tables.of_level[usize::from(level)].as_ref().expect("made for every level sampled");
                check_fits(scene, prepared)?;
                visible_blocks(prepared, table).map(|visible| {
                    region = visible_region(brick, prepared, &visible);
                    march_of(scene, brick, prepared, table, visible, options)
                })
            }
        };
        let Some(work) = work else { return Ok(None) };
        let (Some(level_box), Some(pixels)) =
            (level_box(&scene.grid, region, level), pixels_of(scene, region))
        else {
            return Ok(None);
        };
        Ok(Some(Self { pixels, region: level_box, work, run: None }))
    }

    /// A partial image, which lies where it was recorded.
    fn of_image(scene: &Scene, image: &'a PartialImage) -> Result<Option<Self>, RenderError> {
        if image.size() != scene.size {
            let [width, height] = image.size();
            let remedy = "composite partial images only in the view that they were recorded in";
            return Err(RenderError::invalid("partial image's picture", format!("{width}x{height}"), remedy));
        }
        let pixels = image.pixels();
        let has_any = pixels.iter().all(|[from, to]| from < to);
        let region = LevelBox { scale: 1.0, low: [f32::NEG_INFINITY; 3], high: [f32::INFINITY; 3] };
        Ok(has_any.then_some(Self { pixels, region, work: Work::Partial(image), run: None }))
    }
}

/// Checks that a brick was prepared for the scene.
fn check_fits(scene: &Scene, prepared: &PreparedBrick) -> Result<(), RenderError> {
    let layout = prepared.layout();
    if *layout != scene.layout {
        let remedy = "prepare bricks with the scene's layout";
        return Err(RenderError::invalid("brick's layout", format!("{layout:?}"), remedy));
    }
    Ok(())
}

/// One flag per block: whether it can be seen. `None` where nothing of the brick can.
fn visible_blocks(prepared: &PreparedBrick, table: &Table) -> Option<Vec<u8>> {
    let index_from_sample = table.index_from_sample(prepared);
    if table.is_transparent_over(prepared.range, index_from_sample) {
        return None;
    }
    let is_visible = |range: &[i16; 2]| u8::from(!table.is_transparent_over(*range, index_from_sample));
    let visible: Vec<u8> = prepared.block_ranges.iter().map(is_visible).collect();
    visible.contains(&1).then_some(visible)
}

/// The part of a brick's region around the blocks that can be seen, a little larger so that rounding loses nothing.
fn visible_region(brick: &DrawBrick, prepared: &PreparedBrick, visible: &[u8]) -> [[f64; 3]; 2] {
    let edge = prepared.layout().edge;
    let [first, last] = blocks::extent(visible, edge / BLOCK_EDGE);
    let scale = (1u64 << brick.node.level) as f64;
    let origin = brick.node.brick().map(|b| f64::from(b) * edge as f64);
    let voxel = |a: usize, block: usize| origin[a] + (block * BLOCK_EDGE) as f64;
    let [low, high] = brick.region;
    [
        std::array::from_fn(|a| low[a].max((voxel(a, first[a]) - 1.0 / 16.0) * scale)),
        std::array::from_fn(|a| high[a].min((voxel(a, last[a] + 1) + 1.0 / 16.0) * scale)),
    ]
}

/// The kernel's work on a brick.
fn march_of<'a>(
    scene: &'a Scene,
    brick: &DrawBrick,
    prepared: &'a PreparedBrick,
    table: &'a Table,
    visible: Vec<u8>,
    options: &CpuOptions,
) -> Work<'a> {
    let layout = prepared.layout();
    let light = scene.lighting.map(|lighting| LightJob {
        lighting,
        world_from_difference: scene.grid.spacing.map(|s| (scene.grid.smallest_spacing() / s) as f32),
        unit_from_step: (1.0 / scene.step_voxels) as f32,
    });
    let along_edge = layout.edge / BLOCK_EDGE;
    let job = BrickJob {
        samples: &prepared.samples,
        full_edge: layout.full_edge(),
        low_apron: layout.low,
        origin: brick.node.brick().map(|b| (f64::from(b) * layout.edge as f64) as f32),
        index_from_sample: table.index_from_sample(prepared),
        table: &table.entries,
        blocks: None,
        blocks_along_edge: along_edge,
        mask: prepared.mask.as_ref(),
        light,
    };
    let march: March = kernel::march_for(&job, options.plain);
    Work::March(march, job, blocks::distances(visible, along_edge))
}

/// A box in voxels of its level, open at the grid's faces; `None` where it lies on or beyond the far ones.
fn level_box(grid: &UniformGrid, [low, high]: [[f64; 3]; 2], level: u8) -> Option<LevelBox> {
    let scale = 1.0 / (1u64 << level) as f64;
    let last = grid.dims.map(|n| (n - 1) as f64);
    if (0..3).any(|a| low[a] >= last[a] || high[a] <= 0.0) {
        return None;
    }
    let plane = |c: f64, a: usize| match c {
        c if c <= 0.0 => f32::NEG_INFINITY,
        c if c >= last[a] => f32::INFINITY,
        c => (c * scale) as f32,
    };
    Some(LevelBox {
        scale: scale as f32,
        low: std::array::from_fn(|a| plane(low[a], a)),
        high: std::array::from_fn(|a| plane(high[a], a)),
    })
}

/// Columns and rows that a box may touch: all where it reaches behind the camera.
fn pixels_of(scene: &Scene, region: [[f64; 3]; 2]) -> Option<[[usize; 2]; 2]> {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let last = scene.grid.dims.map(|n| (n - 1) as f64);
    for corner in 0..8 {
        let voxel = std::array::from_fn(|a| region[corner >> a & 1][a].clamp(0.0, last[a]));
        let Some([x, y, _]) = scene.camera.project(scene.grid.world_from_voxel(voxel), scene.size) else {
            return Some([[0, scene.size[0]], [0, scene.size[1]]]);
        };
        for (a, c) in [x, y].into_iter().enumerate() {
            low[a] = low[a].min(c);
            high[a] = high[a].max(c);
        }
    }
    let range = |a: usize| {
        let size = scene.size[a] as f64;
        [(low[a].floor() - 1.0).clamp(0.0, size) as usize, (high[a].ceil() + 1.0).clamp(0.0, size) as usize]
    };
    let pixels = [range(0), range(1)];
    pixels.iter().all(|[from, to]| from < to).then_some(pixels)
}

/// Tiles that some job touches: their first pixel, and their jobs in order.
fn bin(jobs: &[Job], size: [usize; 2], edge: usize) -> Vec<([usize; 2], Vec<u32>)> {
    let along = size.map(|n| n.div_ceil(edge));
    let mut lists = vec![Vec::new(); along[0] * along[1]];
    for (i, job) in jobs.iter().enumerate() {
        let [columns, rows] = job.pixels.map(|[from, to]| from / edge..=(to - 1) / edge);
        for row in rows {
            for column in columns.clone() {
                lists[row * along[0] + column].push(i as u32);
            }
        }
    }
    let corner = |i: usize| [i % along[0] * edge, i / along[0] * edge];
    lists.into_iter().enumerate().filter(|(_, list)| !list.is_empty()).map(|(i, l)| (corner(i), l)).collect()
}
