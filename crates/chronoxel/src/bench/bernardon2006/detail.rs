//! Pictures against pictures: some of the faces against all, by whose importance; few fragments in order against many; bricks against cells.

use std::{path::Path, sync::Arc};

use chronoxel_core::{Background, Image, Image8, ImageDifference, compare};
use chronoxel_ingest::{EncodeOptions, MeshSeries, VoxelOptions, encode_mesh};
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, FaceChoice, FaceOrder, Variation, static_importance,
};
use chronoxel_store::CellStore;
use serde_json::{Value, json};

use super::{Row, Size, object, speed::Steps};
use crate::{
    bench::{Line, Panel, Plot, Workplace},
    interrupt,
    session::{LevelBorders, Session, View},
};

/// Fractions of the faces within, as in figures 4 and 5.
const FRACTIONS: [f64; 3] = [0.05, 0.1, 0.25];
/// Twentieths of the faces are plotted.
const TWENTIETHS: usize = 20;
/// Of what is drawn at random.
const SEED: u64 = 7;

/// How a picture looks over black.
fn over_black(image: &Image) -> Image8 {
    Image8::from_image(image, Background::Color([0.0; 3]))
}

/// Differences of several pairs of pictures.
fn mean(differences: &[ImageDifference]) -> (f64, f64) {
    let num = differences.len().max(1) as f64;
    let luv = differences.iter().map(|d| d.luv_mean).sum::<f64>() / num;
    let psnr = differences.iter().map(|d| d.psnr_db.min(100.0)).sum::<f64>() / num;
    (luv, psnr)
}

/// The importance of faces over all steps of a store.
fn variation(store: &CellStore) -> anyhow::Result<Variation> {
    let num_points = store.header().num_points as usize;
    let mut variation = Variation::new(num_points);
    let (mut steps, mut values) = (Steps::new(store), vec![0.0; num_points]);
    for step in 0..store.header().num_steps_finished as usize {
        steps.decode(step, &mut values)?;
        variation.push(&values);
    }
    Ok(variation)
}

/// Rows of pictures with a part of the faces: by how values change in time, spread over the mesh as they are drawn elsewhere or the most
/// important ones alone as in the paper, and by the values of one step.
///
/// # Errors
/// If the store is damaged or Ctrl-C was pressed.
pub fn rows_of_fractions(
    label: &str,
    store: &CellStore,
    mesh: &Arc<CellMesh>,
    scenes: &[CellScene],
) -> anyhow::Result<Vec<Row>> {
    let num_steps = store.header().num_steps_finished as usize;
    let mut steps = Steps::new(store);
    let shown = [num_steps / 6, num_steps / 2, 5 * num_steps / 6].map(|step| {
        let mut values = vec![0.0; mesh.num_points()];
        steps.decode(step, &mut values).map(|()| values)
    });
    let shown: Vec<Vec<f32>> = shown.into_iter().collect::<Result<_, _>>()?;
    let mut first = vec![0.0; mesh.num_points()];
    steps.decode(0, &mut first)?;
    let (variation, value_range) = (variation(store)?, scenes[0].value_range);
    let orders = [
        ("spread", variation.order(mesh, value_range)),
        ("largest", FaceOrder::by_importance(mesh, &variation.importance(mesh, value_range))),
        ("one_step", FaceOrder::by_importance(mesh, &static_importance(mesh, &first, SEED))),
    ];
    let mut renderer = CellRenderer::new(Arc::clone(mesh), CellOptions::default())?;
    let mut draw = |choice: Option<FaceChoice>| -> anyhow::Result<Vec<Image8>> {
        interrupt::check()?;
        renderer.choose(choice);
        let mut pictures = Vec::new();
        for scene in scenes {
            for values in &shown {
                pictures.push(over_black(&renderer.render(scene, values)?.0));
            }
        }
        Ok(pictures)
    };
    let all = draw(None)?;
    let mut rows = Vec::new();
    for fraction in FRACTIONS {
        let mut here = object(json!({}));
        for (name, order) in &orders {
            let choice = order.choose(fraction);
            let num_faces = choice.as_ref().map_or(mesh.num_faces(), FaceChoice::num_faces);
            let pictures = draw(choice)?;
            let differences: Vec<ImageDifference> =
                all.iter().zip(&pictures).map(|(a, b)| compare(a, b)).collect::<Result<_, _>>()?;
            let (luv, psnr) = mean(&differences);
            here.insert(format!("luv_{name}"), json!(luv));
            here.insert(format!("psnr_{name}"), json!(psnr));
            here.insert("faces_share".to_owned(), json!(100.0 * num_faces as f64 / mesh.num_faces() as f64));
        }
        rows.push(Row { label: format!("{label}: {:.0} %", 100.0 * fraction), here, ..Row::default() });
    }
    Ok(rows)
}

/// Rows of fragments that came too late, for each k.
///
/// # Errors
/// If the store is damaged or Ctrl-C was pressed.
pub fn rows_of_k(
    label: &str,
    store: &CellStore,
    mesh: &Arc<CellMesh>,
    scenes: &[CellScene],
) -> anyhow::Result<Vec<Row>> {
    let mut values = vec![0.0; mesh.num_points()];
    Steps::new(store).decode(store.header().num_steps_finished as usize / 3, &mut values)?;
    let mut rows = Vec::new();
    let mut best: Vec<Image8> = Vec::new();
    for k in [16, 6, 2] {
        interrupt::check()?;
        let mut renderer = CellRenderer::new(Arc::clone(mesh), CellOptions { k, plain: false })?;
        let (mut fragments, mut misordered, mut pictures) = (0, 0, Vec::new());
        for scene in scenes {
            let (image, stats) = renderer.render(scene, &values)?;
            fragments += stats.num_fragments;
            misordered += stats.num_misordered;
            pictures.push(over_black(&image));
        }
        if best.is_empty() {
            best.clone_from(&pictures);
        }
        let differences: Vec<ImageDifference> =
            best.iter().zip(&pictures).map(|(a, b)| compare(a, b)).collect::<Result<_, _>>()?;
        let mut here = object(json!({ "k": k, "fragments": fragments, "misordered": misordered }));
        if k != 16 {
            here.insert("psnr_db".to_owned(), Value::from(mean(&differences).1));
        }
        rows.push(Row { label: format!("{label}: k = {k}"), here, ..Row::default() });
    }
    rows.reverse();
    Ok(rows)
}

/// The same mesh as bricks and as cells: rows for levels of bricks and for parts of the cells' faces, and both as a plot.
///
/// # Errors
/// If the mesh cannot be voxelised, a store is damaged, or Ctrl-C was pressed.
pub fn against_bricks(
    label: &str,
    (store, series): (&CellStore, &mut dyn MeshSeries),
    mesh: &Arc<CellMesh>,
    scene: &CellScene,
    (size, place, memory_bytes): (Size, &Workplace, u64),
) -> anyhow::Result<(Vec<Row>, Plot)> {
    let step = store.header().num_steps_finished as usize / 4;
    let mut values = vec![0.0; mesh.num_points()];
    Steps::new(store).decode(step, &mut values)?;
    let mut renderer = CellRenderer::new(Arc::clone(mesh), CellOptions::default())?;
    let all = over_black(&renderer.render(scene, &values)?.0);
    let path = place.path("bricks.cxl");
    let variable = store.header().variables[0].name.clone();
    let bricks = draw_bricks(series, &variable, &path, scene, step, (size, memory_bytes))?;
    place.remove(&path)?;
    let order = variation(store)?.order(mesh, scene.value_range);
    let mut rows = Vec::new();
    for (level, picture) in bricks.iter().enumerate() {
        let found = compare(&all, picture)?;
        let here = json!({ "luv": found.luv_mean, "psnr_db": found.psnr_db, "ssim": found.ssim });
        rows.push(Row {
            label: format!("{label}: bricks of level {level}, all cells"),
            here: object(here),
            ..Row::default()
        });
    }
    let [mut luv_bricks, mut luv_cells, mut psnr_bricks, mut psnr_cells] = [(); 4].map(|()| Vec::new());
    for twentieth in 0..=TWENTIETHS {
        interrupt::check()?;
        let fraction = twentieth as f64 / TWENTIETHS as f64;
        renderer.choose(order.choose(fraction));
        let picture = over_black(&renderer.render(scene, &values)?.0);
        let (from_bricks, from_cells) = (compare(&bricks[0], &picture)?, compare(&all, &picture)?);
        luv_bricks.push(from_bricks.luv_mean);
        luv_cells.push(from_cells.luv_mean);
        psnr_bricks.push(from_bricks.psnr_db);
        psnr_cells.push(from_cells.psnr_db);
        if twentieth % 5 == 0 || twentieth <= 2 {
            let here = json!({
                "luv": from_bricks.luv_mean,
                "psnr_db": from_bricks.psnr_db,
                "ssim": from_bricks.ssim,
                "luv_all": from_cells.luv_mean,
            });
            let label = format!("{label}: finest bricks, {:.0} % of the cells' faces", 100.0 * fraction);
            rows.push(Row { label, here: object(here), ..Row::default() });
        }
    }
    let line = |name: &str, values: Vec<f64>| Line { name: name.to_owned(), values };
    let panel = |label: &str, is_log, lines| Panel { label: label.to_owned(), lines, mark: None, is_log };
    let plot = Plot {
        file: "bricks-and-cells".to_owned(),
        title: format!("{label}: cells by level of detail, beside the finest bricks and beside all cells"),
        x_label: "faces drawn, percent of those within; the boundary is always kept".to_owned(),
        x_step: 100.0 / TWENTIETHS as f64,
        panels: vec![
            panel(
                "L*u*v* distance",
                true,
                vec![line("to bricks", luv_bricks), line("to all cells", luv_cells)],
            ),
            panel("PSNR (dB)", false, vec![line("to bricks", psnr_bricks), line("to all cells", psnr_cells)]),
        ],
    };
    Ok((rows, plot))
}

/// Pictures of a mesh as bricks, of each level as the finest.
fn draw_bricks(
    series: &mut dyn MeshSeries,
    variable: &str,
    path: &Path,
    scene: &CellScene,
    step: usize,
    (size, memory_bytes): (Size, u64),
) -> anyhow::Result<Vec<Image8>> {
    let max_depth = match size {
        Size::Tiny => 1,
        Size::Small => 4,
        Size::Full => 6,
    };
    let options = EncodeOptions {
        variables: vec![variable.to_owned()],
        memory_bytes,
        voxels: VoxelOptions { field_threshold: 0.0, max_depth },
        ..EncodeOptions::default()
    };
    let mut step = StepOf { series, step };
    encode_mesh(&mut step, path, &options, &mut |_| {})?;
    let mut session = Session::open(path, Some(variable), memory_bytes)?;
    let num_levels = session.store().tree().num_levels();
    let mut pictures = Vec::new();
    for level in 0..num_levels as u8 {
        let view = View {
            camera: scene.camera,
            transfer: scene.transfer.clone(),
            size: scene.size,
            step_voxels: 0.5,
            lighting: scene.lighting,
            opacity_unit: scene.opacity_unit,
            level,
            level_borders: LevelBorders::default(),
            coherence: None,
        };
        pictures.push(over_black(&session.draw(&view, 0)?.image));
    }
    Ok(pictures)
}

/// One step of a series, as a series.
struct StepOf<'a> {
    series: &'a mut dyn MeshSeries,
    step: usize,
}

mod step_of {
    use chronoxel_core::{Samples, TimeAxis};
    use chronoxel_ingest::{GridType, MeshCensus, MeshSeries, SourceError, Variable, mesh::VisitTetrahedron};

    use std::sync::LazyLock;

    use super::StepOf;

    static ONE: LazyLock<TimeAxis> = LazyLock::new(|| TimeAxis { times: vec![0.0], units: String::new() });

    impl MeshSeries for StepOf<'_> {
        fn grid_type(&self) -> GridType {
            self.series.grid_type()
        }

        fn dims(&self) -> Option<[usize; 3]> {
            self.series.dims()
        }

        fn num_points(&self) -> usize {
            self.series.num_points()
        }

        fn times(&self) -> &TimeAxis {
            &ONE
        }

        fn variables(&self) -> &[Variable] {
            self.series.variables()
        }

        fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
            self.series.points()
        }

        fn for_each_tetrahedron(
            &mut self,
            visit: &mut VisitTetrahedron<'_>,
        ) -> Result<MeshCensus, SourceError> {
            self.series.for_each_tetrahedron(visit)
        }

        fn read_values(&mut self, variable: usize, _: usize) -> Result<Samples, SourceError> {
            self.series.read_values(variable, self.step)
        }

        fn working_bytes(&self) -> u64 {
            self.series.working_bytes()
        }
    }
}
