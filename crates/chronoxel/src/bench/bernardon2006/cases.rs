//! The data of table 1, as far as it can be had: meshes in files, whose names say which they are, and stand-ins.

use std::collections::HashMap;

use chronoxel_core::{SampleType, Samples, TimeAxis};
use chronoxel_ingest::{
    MeshSeries, Variable,
    mesh::{CellKind, CellList, MemoryMesh},
    sources::{self, SourceOptions},
};

use super::Size;
use crate::interrupt;

/// Steps over which a field fades to zero, as the paper has it.
const FADE_STEPS: usize = 64;
/// Steps of the paper's dipole and of its springs.
const TORSO_STEPS: usize = 360;
const SPRING_STEPS: usize = 192;

/// A row of table 1.
pub struct Case {
    pub label: String,
    pub mesh: Box<dyn MeshSeries>,
    /// The variable that counts.
    pub variable: usize,
    /// Entries of a table, as the paper chose them.
    pub entries: usize,
    /// The name of its row in the paper's table, if it has one there.
    pub paper: Option<&'static str>,
    /// Whether levels of detail are compared on it.
    pub has_detail: bool,
    /// Whether bricks are compared with it.
    pub has_bricks: bool,
}

/// A mesh and the values at its points, before it is a series.
struct Still {
    points: Vec<[f64; 3]>,
    tetrahedra: Vec<[u32; 4]>,
    values: Vec<f32>,
}

/// What a source gives.
///
/// # Errors
/// If it cannot be read or is no mesh.
pub fn of_source(name: &str, options: &SourceOptions, size: Size) -> anyhow::Result<Vec<Case>> {
    let inputs: Vec<String> = match name.starts_with("sim:") {
        true => vec![name.to_owned()],
        false => name.split(',').map(str::to_owned).collect(),
    };
    // A variable that is wished for need not be in every source.
    let of_file = SourceOptions { variables: Vec::new(), ..options.clone() };
    let mesh = sources::open_mesh(&inputs, &of_file)?;
    let names: Vec<&str> = mesh.variables().iter().map(|v| v.name.as_str()).collect();
    let wished = options.variables.iter().find_map(|wished| names.iter().position(|name| name == wished));
    let variable = wished.or_else(|| names.iter().position(|name| *name == "density")).unwrap_or(0);
    let label = label_of(name);
    let known = label.to_lowercase().replace(['_', '-', ' '], "");
    let is_known = |name: &str| !name.is_empty() && known.contains(name);
    if is_known("spx") {
        return spx(still(mesh, variable)?, size);
    }
    if is_known("torso") {
        return Ok(vec![torso(still(mesh, variable)?, size)?]);
    }
    let is_bluntfin = is_known("bluntfin");
    let case = |label, mesh, variable| Case {
        label,
        mesh,
        variable,
        entries: 256,
        paper: is_bluntfin.then_some("BLUNT"),
        has_detail: !is_bluntfin,
        has_bricks: true,
    };
    if mesh.times().num_steps() > 1 {
        return Ok(vec![case(label, mesh, variable)]);
    }
    let name = if is_bluntfin { "BLUNT".to_owned() } else { format!("{label}, fading") };
    let fading = series(still(mesh, variable)?, FADE_STEPS, |still, step| {
        let left = 1.0 - step as f32 / (FADE_STEPS - 1) as f32;
        still.values.iter().map(|value| value * left).collect()
    })?;
    Ok(vec![case(name, fading, 0)])
}

/// The name of a file, or a simulation whole.
fn label_of(name: &str) -> String {
    let first = name.split(',').next().unwrap_or(name);
    match first.starts_with("sim:") {
        true => first.to_owned(),
        false => first.rsplit('/').next().unwrap_or(first).to_owned(),
    }
}

/// SPX cut into eight once and twice, fading, and as springs.
fn spx(spx: Still, size: Size) -> anyhow::Result<Vec<Case>> {
    let fading = |still: Still| {
        series(still, FADE_STEPS, |still, step| {
            let left = 1.0 - step as f32 / (FADE_STEPS - 1) as f32;
            still.values.iter().map(|value| value * left).collect()
        })
    };
    let case = |label: &str, mesh, paper| Case {
        label: label.to_owned(),
        mesh,
        variable: 0,
        entries: 256,
        paper: Some(paper),
        has_detail: true,
        has_bricks: false,
    };
    let once = cut_in_eight(&spx);
    let mut cases = Vec::new();
    if size == Size::Full {
        let twice = cut_in_eight(&once);
        cases.push(case("SPX2", fading(twice)?, "SPX2"));
    }
    let forces = Forces::of(&once, SPRING_STEPS)?;
    let springs =
        Still { points: once.points.clone(), tetrahedra: once.tetrahedra.clone(), values: Vec::new() };
    let springs = series(springs, SPRING_STEPS, |_, step| forces.steps[step].clone())?;
    cases.insert(0, case("SPX1", fading(once)?, "SPX1"));
    cases.push(Case { has_detail: false, ..case("SPXF stand-in", springs, "SPXF") });
    Ok(cases)
}

/// The potential of a dipole that turns once about an upright axis in the middle of the torso.
fn torso(torso: Still, size: Size) -> anyhow::Result<Case> {
    let bounds = torso.points.iter().fold([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], |[low, high], p| {
        [std::array::from_fn(|a| low[a].min(p[a])), std::array::from_fn(|a| high[a].max(p[a]))]
    });
    let middle: [f64; 3] = std::array::from_fn(|a| 0.5 * (bounds[0][a] + bounds[1][a]));
    let extent = (0..3).map(|a| bounds[1][a] - bounds[0][a]).fold(0.0, f64::max);
    // Nearer to the dipole than this the potential does not grow further.
    let core = (0.05 * extent).powi(2);
    let num_steps = if size == Size::Tiny { 80 } else { TORSO_STEPS };
    let mesh = series(torso, num_steps, |still, step| {
        let angle = std::f64::consts::TAU * step as f64 / num_steps as f64;
        let dipole = [angle.cos(), angle.sin(), 0.3];
        let potential = |p: &[f64; 3]| {
            let from: [f64; 3] = std::array::from_fn(|a| p[a] - middle[a]);
            let squared = (0..3).map(|a| from[a] * from[a]).sum::<f64>() + core;
            let along: f64 = (0..3).map(|a| from[a] * dipole[a]).sum();
            (along * extent * extent / squared.powf(1.5)) as f32
        };
        still.points.iter().map(potential).collect()
    })?;
    Ok(Case {
        label: "TORSO, dipole made".to_owned(),
        mesh,
        variable: 0,
        entries: 256,
        paper: Some("TORSO"),
        has_detail: true,
        has_bricks: false,
    })
}

/// A turbulent field on a lattice of tetrahedra.
///
/// # Errors
/// If the simulation cannot be run, or Ctrl-C was pressed.
pub fn turbulent(size: Size) -> anyhow::Result<Case> {
    let (edge, num_steps) = match size {
        Size::Tiny => (8, 66),
        Size::Small => (32, 64),
        Size::Full => (60, 150),
    };
    let source = format!("sim:vortex?dims={edge}&steps={num_steps}");
    let mut series = sources::open(&[source], &SourceOptions::default())?;
    let grid = *series.grid();
    let mut steps = Vec::with_capacity(num_steps);
    for step in 0..num_steps {
        interrupt::check()?;
        steps.push(series.open_step(0, step)?.read_slices(edge)?);
    }
    let place = |n: usize| -> [f64; 3] {
        let at = [n % edge, n / edge % edge, n / edge / edge];
        std::array::from_fn(|a| grid.origin[a] + at[a] as f64 * grid.spacing[a])
    };
    let points = (0..grid.num_samples()).map(place).collect();
    let mesh = MemoryMesh::curvilinear(grid.dims, points, series.times().clone())?;
    let mesh = mesh.with_variable(series.variables()[0].clone(), steps)?;
    Ok(Case {
        label: format!("TJET stand-in, vortex of {edge}³"),
        mesh: Box::new(mesh),
        variable: 0,
        entries: if size == Size::Tiny { 256 } else { 1024 },
        paper: Some("TJET"),
        has_detail: size == Size::Tiny,
        has_bricks: false,
    })
}

/// The first step of a mesh.
fn still(mut mesh: Box<dyn MeshSeries>, variable: usize) -> anyhow::Result<Still> {
    let points = mesh.points()?;
    let mut tetrahedra = Vec::new();
    mesh.for_each_tetrahedron(&mut |corners| {
        tetrahedra.push(corners);
        Ok(())
    })?;
    let values = mesh.read_values(variable, 0)?;
    let values = (0..values.len()).map(|i| values.get(i) as f32).collect();
    Ok(Still { points, tetrahedra, values })
}

fn series(
    still: Still,
    num_steps: usize,
    values: impl Fn(&Still, usize) -> Vec<f32>,
) -> anyhow::Result<Box<dyn MeshSeries>> {
    let mut cells = CellList::default();
    still.tetrahedra.iter().for_each(|corners| cells.push(CellKind::Tetrahedron, corners));
    let steps = (0..num_steps).map(|step| Samples::F32(values(&still, step))).collect();
    let times = TimeAxis::regular(num_steps, 1.0, "")?;
    let variable = Variable {
        name: "field".to_owned(),
        units: String::new(),
        sample_type: SampleType::F32,
        fill_value: None,
    };
    // What was kept when the source was read is kept here.
    let mesh = MemoryMesh::unstructured(still.points, cells, times)?.with_flat_threshold(0.0);
    Ok(Box::new(mesh.with_variable(variable, steps)?))
}

/// Cuts each tetrahedron into eight at the middles of its edges, where values are the means of the ends'.
fn cut_in_eight(still: &Still) -> Still {
    let (mut points, mut values) = (still.points.clone(), still.values.clone());
    let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
    let mut middle = |a: u32, b: u32| {
        *middles.entry([a.min(b), a.max(b)]).or_insert_with(|| {
            let [p, q] = [a, b].map(|i| points[i as usize]);
            points.push(std::array::from_fn(|axis| 0.5 * (p[axis] + q[axis])));
            values.push(0.5 * (values[a as usize] + values[b as usize]));
            points.len() as u32 - 1
        })
    };
    let mut tetrahedra = Vec::with_capacity(8 * still.tetrahedra.len());
    for &[a, b, c, d] in &still.tetrahedra {
        let [ab, ac, ad, bc, bd, cd] =
            [[a, b], [a, c], [a, d], [b, c], [b, d], [c, d]].map(|[p, q]| middle(p, q));
        tetrahedra.extend([[a, ab, ac, ad], [ab, b, bc, bd], [ac, bc, c, cd], [ad, bd, cd, d]]);
        // The octahedron that is left, about one of its diagonals.
        tetrahedra.extend([[ab, ac, ad, bd], [ab, ac, bc, bd], [ac, ad, bd, cd], [ac, bc, bd, cd]]);
    }
    Still { points, tetrahedra, values }
}

/// Masses at the points of a mesh, springs along its edges, and a push from above: the magnitudes of the forces on the masses.
struct Forces {
    steps: Vec<Vec<f32>>,
}

impl Forces {
    fn of(still: &Still, num_steps: usize) -> anyhow::Result<Self> {
        let mut springs: Vec<[u32; 2]> = still
            .tetrahedra
            .iter()
            .flat_map(|&[a, b, c, d]| [[a, b], [a, c], [a, d], [b, c], [b, d], [c, d]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        springs.sort_unstable();
        springs.dedup();
        let mut points = still.points.clone();
        let mut velocities = vec![[0.0f64; 3]; points.len()];
        let difference = |points: &[[f64; 3]], [a, b]: [u32; 2]| -> ([f64; 3], f64) {
            let d: [f64; 3] = std::array::from_fn(|i| points[b as usize][i] - points[a as usize][i]);
            (d, d.iter().map(|x| x * x).sum::<f64>().sqrt())
        };
        let rest: Vec<f64> = springs.iter().map(|&spring| difference(&points, spring).1).collect();
        let top = points.iter().map(|p| p[2]).fold(f64::NEG_INFINITY, f64::max);
        let bottom = points.iter().map(|p| p[2]).fold(f64::INFINITY, f64::min);
        let mean_rest = rest.iter().sum::<f64>() / rest.len().max(1) as f64;
        // In units in which springs have stiffness 1 and masses are 1: a dozen springs at a mass swing in twice this time and more.
        let (time_step, damping) = (0.1, 0.02);
        let mut steps = Vec::with_capacity(num_steps);
        for step in 0..num_steps {
            interrupt::check()?;
            let mut forces = vec![[0.0f64; 3]; points.len()];
            for (&spring, &rest) in springs.iter().zip(&rest) {
                let (d, length) = difference(&points, spring);
                let pull = (length - rest) / length.max(1e-12);
                for axis in 0..3 {
                    forces[spring[0] as usize][axis] += pull * d[axis];
                    forces[spring[1] as usize][axis] -= pull * d[axis];
                }
            }
            for (force, point) in forces.iter_mut().zip(&still.points) {
                let height = (point[2] - bottom) / (top - bottom).max(1e-12);
                // A push of 16 steps on what lies at the top.
                if height > 0.9 && step < 16 {
                    force[2] -= 0.3 * mean_rest;
                }
            }
            steps.push(forces.iter().map(|f| f.iter().map(|x| x * x).sum::<f64>().sqrt() as f32).collect());
            for ((point, velocity), force) in points.iter_mut().zip(&mut velocities).zip(&forces) {
                for axis in 0..3 {
                    velocity[axis] = (1.0 - damping) * velocity[axis] + time_step * force[axis];
                    point[axis] += time_step * velocity[axis];
                }
            }
        }
        Ok(Self { steps })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cutting_in_eight_keeps_the_volume_and_shares_points() {
        let still = Still {
            points: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]],
            tetrahedra: vec![[0, 1, 2, 3], [1, 2, 3, 4]],
            values: vec![0.0, 2.0, 4.0, 6.0, 8.0],
        };
        let cut = cut_in_eight(&still);
        // Five corners and nine edges.
        assert_eq!((cut.points.len(), cut.tetrahedra.len()), (14, 16));
        let volume = |still: &Still| -> f64 {
            let of = |corners: &[u32; 4]| {
                let [a, b, c, d] = corners.map(|i| still.points[i as usize]);
                let from = |p: [f64; 3]| -> [f64; 3] { std::array::from_fn(|i| p[i] - a[i]) };
                let [u, v, w] = [b, c, d].map(from);
                let cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
                (0..3).map(|i| cross[i] * w[i]).sum::<f64>().abs() / 6.0
            };
            still.tetrahedra.iter().map(of).sum()
        };
        assert!((volume(&cut) - volume(&still)).abs() < 1e-12);
        assert!(
            cut.values
                .iter()
                .zip(&cut.points)
                .take(4)
                .all(|(v, p)| { (f64::from(*v) - (2.0 * p[0] + 4.0 * p[1] + 6.0 * p[2])).abs() < 1e-6 })
        );
    }
}
