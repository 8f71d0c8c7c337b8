//! Level of detail: which faces are worth drawing (bernardon2006, section 3.4).

use rayon::prelude::*;

use super::CellMesh;

/// Faces of a mesh that are drawn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FaceChoice {
    /// Numbers of the faces, rising.
    pub(crate) faces: Vec<u32>,
}

impl FaceChoice {
    /// The faces of largest importance, the first of equal ones, and the boundary: `fraction` of all in all, but never fewer than
    /// the boundary.
    ///
    /// * `importance`: one per face of the mesh
    /// * `fraction`: of the faces, in [0, 1]
    ///
    /// # Panics
    /// If there is another number of importances than faces.
    pub fn new(mesh: &CellMesh, importance: &[f32], fraction: f64) -> Self {
        assert_eq!(importance.len(), mesh.num_faces(), "one importance per face");
        let (mut faces, mut inner): (Vec<u32>, Vec<u32>) =
            (0..mesh.faces.len() as u32).partition(|&f| mesh.faces[f as usize].is_boundary);
        let wanted = (fraction.clamp(0.0, 1.0) * mesh.faces.len() as f64).round() as usize;
        let num = wanted.saturating_sub(faces.len()).min(inner.len());
        let order =
            |a: &u32, b: &u32| importance[*b as usize].total_cmp(&importance[*a as usize]).then(a.cmp(b));
        if num < inner.len() {
            inner.select_nth_unstable_by(num, order);
            inner.truncate(num);
        }
        faces.extend(inner);
        faces.sort_unstable();
        Self { faces }
    }

    /// Faces drawn at random, each with a chance that grows with its importance (Efraimidis and Spirakis 2006), and the boundary: as
    /// many as [`Self::new`] takes.
    ///
    /// Where the most important faces lie side by side, this leaves some for the rest.
    ///
    /// * `importance`: one per face of the mesh, at least 0
    /// * `seed`: of the numbers drawn
    ///
    /// # Panics
    /// As [`Self::new`].
    pub fn sampled(mesh: &CellMesh, importance: &[f32], fraction: f64, seed: u64) -> Self {
        let mean = importance.iter().map(|&i| f64::from(i)).sum::<f64>() / importance.len().max(1) as f64;
        let floor = (LEAST_CHANCE * mean).max(1e-30);
        let key = |(number, &weight): (u64, &f32)| {
            // A number in (0, 1); of an exponential distribution, the faster the rarer.
            let uniform = ((scrambled(number ^ seed) >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
            (f64::from(weight).max(floor) / -uniform.ln()) as f32
        };
        let keys: Vec<f32> = (0u64..).zip(importance).map(key).collect();
        Self::new(mesh, &keys, fraction)
    }

    /// Faces that are drawn.
    pub fn num_faces(&self) -> usize {
        self.faces.len()
    }
}

/// Chances of [`FaceChoice::sampled`] are at least this much of the mean, so that still regions keep some faces.
const LEAST_CHANCE: f64 = 0.25;

/// How much the values at the points of a mesh vary over time: sums over the steps that were added.
#[derive(Debug, Clone)]
pub struct Variation {
    num_steps: u32,
    /// Mean, and sum of squared differences from it, of each point.
    moments: Vec<[f64; 2]>,
}

/// Means are taken as at least this fraction of the range of the values, so that dividing by them means something.
const LEAST_MEAN: f64 = 1e-3;

impl Variation {
    /// No steps yet.
    pub fn new(num_points: usize) -> Self {
        Self { num_steps: 0, moments: vec![[0.0; 2]; num_points] }
    }

    /// Adds a step. Missing values count as the mean so far.
    ///
    /// # Panics
    /// If there is another number of values than points.
    pub fn push(&mut self, values: &[f32]) {
        assert_eq!(values.len(), self.moments.len(), "one value per point");
        self.num_steps += 1;
        let num = f64::from(self.num_steps);
        let moments = self.moments.par_iter_mut().with_min_len(1 << 14);
        moments.zip(values).filter(|(_, v)| v.is_finite()).for_each(|([mean, squares], &value)| {
            let difference = f64::from(value) - *mean;
            *mean += difference / num;
            *squares += difference * (f64::from(value) - *mean);
        });
    }

    /// The coefficient of variation of each point: standard deviation over `max(|mean|, 0.001 · range)`.
    ///
    /// * `value_range`: smallest and largest value of the series
    pub fn coefficients(&self, value_range: [f64; 2]) -> Vec<f32> {
        let guard = (LEAST_MEAN * (value_range[1] - value_range[0])).max(f64::MIN_POSITIVE);
        let num = f64::from(self.num_steps.max(1));
        let of =
            |[mean, squares]: &[f64; 2]| ((squares.max(0.0) / num).sqrt() / mean.abs().max(guard)) as f32;
        self.moments.iter().map(of).collect()
    }

    /// The importance of each face of a mesh: the sum of the coefficients of its points.
    ///
    /// # Panics
    /// If the mesh has another number of points.
    pub fn importance(&self, mesh: &CellMesh, value_range: [f64; 2]) -> Vec<f32> {
        assert_eq!(mesh.num_points(), self.moments.len(), "one value per point");
        let of_points = self.coefficients(value_range);
        let of_face = |face: &super::mesh::Face| face.points.iter().map(|&p| of_points[p as usize]).sum();
        mesh.faces.par_iter().with_min_len(1 << 14).map(of_face).collect()
    }
}

/// Classes of the histogram of [`static_importance`].
const NUM_CLASSES: usize = 256;

/// Importance by the values of one step, for comparison: samples stratified over its histogram (Callahan et al. 2005).
///
/// The faces are sorted into classes by their mean values, and drawn at random from each in turn: whatever number is
/// chosen, all classes have about as many faces in it, as long as they last.
///
/// * `values`: one per point
/// * `seed`: of the order in which the faces of a class come
///
/// # Panics
/// If there is another number of values than points.
pub fn static_importance(mesh: &CellMesh, values: &[f32], seed: u64) -> Vec<f32> {
    assert_eq!(values.len(), mesh.num_points(), "one value per point");
    let mean = |face: &super::mesh::Face| face.points.iter().map(|&p| values[p as usize]).sum::<f32>() / 3.0;
    let means: Vec<f32> = mesh.faces.iter().map(mean).collect();
    let finite = || means.iter().copied().filter(|m| m.is_finite());
    let (low, high) = (finite().fold(f32::INFINITY, f32::min), finite().fold(f32::NEG_INFINITY, f32::max));
    let scale = if high > low { NUM_CLASSES as f32 / (high - low) } else { 0.0 };
    let mut classes = vec![Vec::new(); NUM_CLASSES];
    for (number, &mean) in (0u32..).zip(&means) {
        // Missing values, as NaN, come to the first class.
        classes[(((mean - low) * scale) as usize).min(NUM_CLASSES - 1)].push(number);
    }
    let mut importance = vec![0.0; means.len()];
    for class in &mut classes {
        class.sort_by_key(|&number| (scrambled(u64::from(number) ^ seed), number));
        for (place, &number) in class.iter().enumerate() {
            importance[number as usize] = -(place as f32);
        }
    }
    importance
}

/// A number that has nothing to do with its neighbours' (splitmix64).
fn scrambled(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mesh() -> CellMesh {
        let points = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0; 3]];
        CellMesh::new(points, &[[0, 1, 2, 3], [1, 2, 3, 4]]).unwrap()
    }

    #[test]
    fn coefficients_of_variation_are_those_of_the_formula() {
        let mut variation = Variation::new(5);
        variation.push(&[1.0, 4.0, -2.0, 1.0, 0.0]);
        variation.push(&[3.0, 4.0, -4.0, -1.0, 0.0]);
        let found = variation.coefficients([-4.0, 4.0]);
        // Deviation over mean: 1 / 2, 0, 1 / 3; a mean of 0 is guarded by 0.008.
        for (found, expected) in found.iter().zip([0.5, 0.0, 1.0 / 3.0, 125.0, 0.0]) {
            assert!((found - expected).abs() < 1e-4, "{found} {expected}");
        }
        let importance = variation.importance(&mesh(), [-4.0, 4.0]);
        let at = mesh().faces.iter().position(|f| f.points == [0, 1, 2]).unwrap();
        assert!((importance[at] - (0.5 + 1.0 / 3.0)).abs() < 1e-6);
    }

    #[test]
    fn the_boundary_is_kept_and_the_rest_comes_by_importance() {
        let mesh = mesh();
        let importance = vec![1.0; mesh.num_faces()];
        assert_eq!(FaceChoice::new(&mesh, &importance, 0.0).num_faces(), 6);
        assert_eq!(FaceChoice::new(&mesh, &importance, 1.0).num_faces(), 7);
    }

    #[test]
    fn static_importance_takes_from_all_classes() {
        let mesh = mesh();
        let importance = static_importance(&mesh, &[0.0, 0.0, 0.0, 0.0, 9.0], 7);
        // Three faces have the point of value 9, four do not: each class has a first.
        assert_eq!(importance.iter().filter(|i| **i == 0.0).count(), 2);
    }
}
