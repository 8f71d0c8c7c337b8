//! The options of `render`, `movie` and `play` that are about cells, and which method draws a store.

use std::path::Path;

use chronoxel_core::Lighting;
use chronoxel_render::{GpuOptions, GpuRenderer};
use chronoxel_store::CellStore;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::{
    WrongUsage,
    args::{Common, StepRange},
    view::{Backend, ChosenBackend, Legend, Method, Switch, ViewArgs, cpu_adapter},
};
use crate::{
    progress::{Counted, Progress},
    session::{CellPicture, CellSession, CellShot, Importance},
};

/// How cells are drawn.
#[derive(Debug, Clone, Args)]
pub struct CellArgs {
    /// Fragments that a pixel puts into order where cells are drawn: 2, 6 or 16 [default: 6]
    #[arg(long, value_name = "K", value_parser = parse_k)]
    pub k: Option<usize>,
    /// Draw this fraction of the faces within the mesh, from 0 to 1, those that matter most, beside its boundary [default: 1]
    #[arg(long, value_name = "F", value_parser = parse_fraction)]
    pub lod: Option<f64>,
    /// Steps over which the variation counts that says which faces matter, as 0:64 [default: all]
    #[arg(long, value_name = "A:B[:S]", allow_hyphen_values = true)]
    pub lod_steps: Option<StepRange>,
    /// What says which faces matter [default: variation]
    #[arg(long, value_name = "WHAT")]
    pub lod_by: Option<LodBy>,
}

/// What says which faces matter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LodBy {
    /// How much the values at their points vary over time.
    Variation,
    /// The histogram of one step, for comparison: the first of --lod-steps.
    Static,
}

/// Which method draws a store, and why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChosenMethod {
    /// The method.
    pub method: Method,
    /// In words.
    pub name: &'static str,
    /// Why it was chosen.
    pub reason: &'static str,
}

/// What a picture of cells consists of, as printed.
#[derive(Debug, Serialize)]
pub struct CellReport {
    tetrahedra: usize,
    points: usize,
    faces: usize,
    faces_chosen: usize,
    faces_drawn: usize,
    fragments: u64,
    misordered: u64,
    k: usize,
    lod: f64,
    lod_by: Option<&'static str>,
    /// Time to find out which faces matter.
    importance_ms: f64,
}

fn wrong(text: String) -> anyhow::Error {
    WrongUsage(text).into()
}

impl ViewArgs {
    /// Which method draws a store.
    ///
    /// # Errors
    /// If options contradict the method, or the store does not have what the method draws.
    pub fn choose_method(&self, store: &Path) -> anyhow::Result<ChosenMethod> {
        if let Some(method) = self.method {
            self.check_options(method)?;
        }
        let has_cells_alone = CellStore::find(store).is_some_and(|found| found == store);
        let (method, reason) = match self.method {
            Some(method) => (method, "asked for"),
            None if has_cells_alone => (Method::Cells, "the store has nothing else"),
            None => (Method::Raycast, "the default"),
        };
        self.check_options(method)?;
        anyhow::ensure!(
            method == Method::Cells || !has_cells_alone,
            "{}: the store has cells alone: use --method cells, or encode its source with --as bricks or --as both",
            store.display()
        );
        let name = match method {
            Method::Raycast => "raycast",
            Method::Slices => "slices",
            Method::Cells => "cells",
        };
        Ok(ChosenMethod { method, name, reason })
    }

    /// Refuses options that mean nothing to a method.
    fn check_options(&self, method: Method) -> anyhow::Result<()> {
        let cells = &self.cells;
        let of_bricks = [
            ("--step", self.step.is_some()),
            ("--interpolation", self.interpolation.is_some()),
            ("--level-borders", self.level_borders.is_some()),
            ("--level", self.level.is_some()),
            ("--metric", self.coherence.metric.is_some()),
            ("--spatial-tolerance", self.coherence.spatial_tolerance > 0.0),
            ("--temporal-tolerance", self.coherence.temporal_tolerance > 0.0),
        ];
        let of_cells = [
            ("--k", cells.k.is_some()),
            ("--lod", cells.lod.is_some()),
            ("--lod-steps", cells.lod_steps.is_some()),
            ("--lod-by", cells.lod_by.is_some()),
        ];
        let first = |options: &[(&'static str, bool)]| options.iter().find(|(_, given)| *given).map(|o| o.0);
        match method {
            Method::Cells => match first(&of_bricks) {
                Some(option) => {
                    Err(wrong(format!("{option} is for bricks: leave it out with --method cells")))
                }
                None => Ok(()),
            },
            Method::Raycast | Method::Slices => match first(&of_cells) {
                Some(option) => Err(wrong(format!("{option} is for cells: add --method cells"))),
                None => Ok(()),
            },
        }
    }

    /// Opens a store of cells to be drawn: what draws is chosen, and which faces matter is measured if some are to be left out.
    ///
    /// * `has_target`: whether a frame rate is held by leaving out faces
    ///
    /// # Errors
    /// If the store cannot be opened or drawn as asked, or options contradict each other.
    pub fn open_cells(
        &self,
        store: &Path,
        common: &Common,
        has_target: bool,
    ) -> anyhow::Result<(CellSession, ChosenBackend, CellReport)> {
        let CellArgs { k, lod, lod_steps, lod_by } = &self.cells;
        let leaves_out = has_target || lod.is_some_and(|f| f < 1.0);
        if has_target && lod.is_some() {
            return Err(wrong(
                "--lod is a fixed fraction: leave it out with --target-fps, which chooses it".into(),
            ));
        }
        if let Some(option) = [("--lod-steps", lod_steps.is_some()), ("--lod-by", lod_by.is_some())]
            .iter()
            .find(|o| o.1 && !leaves_out)
        {
            return Err(wrong(format!("{} says which faces matter: add --lod below 1", option.0)));
        }
        let mut session =
            CellSession::open(store, self.variable.as_deref(), common.memory.0, k.unwrap_or(DEFAULT_K))?;
        let backend = self.choose_cell_backend(&mut session)?;
        let mut report = CellReport::of(&session);
        if leaves_out {
            let start = std::time::Instant::now();
            report.lod_by = Some(self.measure_importance(&mut session, common)?);
            report.importance_ms = start.elapsed().as_secs_f64() * 1e3;
            session.set_detail(lod.unwrap_or(1.0))?;
        }
        Ok((session, backend, report))
    }

    fn measure_importance(&self, session: &mut CellSession, common: &Common) -> anyhow::Result<&'static str> {
        let CellArgs { lod_steps, lod_by, .. } = &self.cells;
        let num_finished = session.store().header().num_steps_finished as usize;
        let steps = match lod_steps {
            Some(range) => range.resolve_for("--lod-steps", num_finished)?,
            None => (0..num_finished).collect(),
        };
        let (importance, name) = match lod_by.unwrap_or(LodBy::Variation) {
            LodBy::Variation => (Importance::Variation(steps), "variation"),
            LodBy::Static => (Importance::Static(steps[0]), "static"),
        };
        let num_steps = match &importance {
            Importance::Variation(steps) => steps.len() as u64,
            Importance::Static(_) => 1,
        };
        let start = std::time::Instant::now();
        let mut bar: Option<Progress> = None;
        let mut num_done = 0;
        session.measure_importance(&importance, &mut || {
            num_done += 1;
            if bar.is_none() && start.elapsed().as_secs_f64() > QUIET_SECS {
                let is_quiet = common.quiet || common.json;
                let shown = Progress::new("which faces matter", num_steps, Counted::Items("steps"), is_quiet);
                shown.advance(num_done - 1);
                bar = Some(shown);
            }
            if let Some(bar) = &bar {
                bar.advance(1);
            }
            crate::interrupt::check()
        })?;
        if let Some(bar) = bar {
            bar.finish();
        }
        Ok(name)
    }

    fn choose_cell_backend(&self, session: &mut CellSession) -> anyhow::Result<ChosenBackend> {
        let options = GpuOptions { memory_bytes: self.gpu_memory.0, ..GpuOptions::default() };
        let cpu = |reason: String| ChosenBackend { name: "cpu", adapter: cpu_adapter(), reason };
        let mut gpu = |reason: String| {
            let info = session.use_gpu(&options)?;
            let adapter = format!("{} ({}, {}, {})", info.name, info.kind, info.backend, info.driver);
            anyhow::Ok(ChosenBackend { name: "gpu", adapter, reason })
        };
        match self.backend {
            Backend::Cpu => Ok(cpu("asked for".into())),
            Backend::Gpu => gpu("asked for".into()),
            Backend::Auto => match GpuRenderer::adapter(&options) {
                Ok(info) if info.is_software => Ok(cpu(format!(
                    "{} is a program on the CPU, slower than the CPU's own renderer of cells",
                    info.name
                ))),
                Ok(info) => {
                    Ok(gpu(format!("{} is there", info.name)).unwrap_or_else(|e| cpu(format!("{e:#}"))))
                }
                Err(error) => Ok(cpu(error.to_string())),
            },
        }
    }

    /// What the pictures show of an open store of cells.
    ///
    /// # Errors
    /// If a camera or transfer-function file cannot be read or used.
    pub fn cell_shot(&self, session: &CellSession) -> anyhow::Result<CellShot> {
        Ok(CellShot {
            camera: self.camera.around(session.bounds(), self.size, 0.0)?,
            transfer: session.resolve(&self.transfer.function()?)?,
            size: self.size,
            lighting: (self.lighting == Switch::On).then(Lighting::default),
            opacity_unit: self.transfer.opacity_unit.unwrap_or(session.opacity_unit()),
        })
    }
}

/// What is written beside a picture of cells.
pub fn legend<'a>(session: &'a CellSession, shot: &'a CellShot) -> Legend<'a> {
    let header = session.store().header();
    let variable = &header.variables[session.variable()];
    Legend {
        camera: &shot.camera,
        transfer: &shot.transfer,
        bounds: session.bounds(),
        name: &variable.name,
        units: &variable.units,
        range: session.variable_range(),
        times: &header.times,
    }
}

impl CellReport {
    /// Of a session that has drawn nothing yet.
    fn of(session: &CellSession) -> Self {
        let mesh = session.mesh();
        Self {
            tetrahedra: mesh.num_tetrahedra(),
            points: mesh.num_points(),
            faces: mesh.num_faces(),
            faces_chosen: mesh.num_faces(),
            faces_drawn: 0,
            fragments: 0,
            misordered: 0,
            k: session.k(),
            lod: 1.0,
            lod_by: None,
            importance_ms: 0.0,
        }
    }

    /// Adds a picture: counts add up, faces are those of the last one.
    pub fn add<I>(&mut self, picture: &CellPicture<I>, lod: f64) {
        self.faces_chosen = picture.num_chosen;
        self.faces_drawn = picture.stats.num_faces;
        self.fragments += picture.stats.num_fragments;
        self.misordered += picture.stats.num_misordered;
        self.lod = lod;
    }

    /// Fragments of all pictures.
    pub fn num_fragments(&self) -> u64 {
        self.fragments
    }

    /// What must be said of pictures that are not right everywhere.
    pub fn warning(&self) -> Option<String> {
        crate::session::warning_of(self.misordered, self.fragments, self.k)
    }

    /// For people.
    pub fn text(&self) -> String {
        let by = self.lod_by.map_or(String::new(), |by| format!(" by {by} ({:.0} ms)", self.importance_ms));
        format!(
            "{} tetrahedra; {} of {} faces chosen{by}, {} in the picture; {:.1} million fragments, {} out of order at k = {}",
            self.tetrahedra,
            self.faces_chosen,
            self.faces,
            self.faces_drawn,
            self.fragments as f64 / 1e6,
            self.misordered,
            self.k
        )
    }
}

/// Fragments that a pixel puts into order, where nothing else is asked for.
const DEFAULT_K: usize = 6;
/// What takes longer shows how far it is.
const QUIET_SECS: f64 = 1.0;

fn parse_k(text: &str) -> Result<usize, String> {
    match text {
        "2" => Ok(2),
        "6" => Ok(6),
        "16" => Ok(16),
        _ => Err(format!("{text:?} fragments cannot be put into order; use 2, 6 or 16")),
    }
}

fn parse_fraction(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(fraction) if (0.0..=1.0).contains(&fraction) => Ok(fraction),
        _ => Err(format!("{text:?} is not a fraction from 0 to 1, such as 0.25")),
    }
}
