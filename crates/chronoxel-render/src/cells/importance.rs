//! Level of detail: which faces are worth drawing (bernardon2006, section 3.4).

use rayon::prelude::*;

use super::CellMesh;
use super::mesh::{cross, dot, sub};

/// Faces of a mesh that are drawn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FaceChoice {
    /// Numbers of the faces, rising.
    pub(crate) faces: Vec<u32>,
}

impl FaceChoice {
    /// Faces that are drawn.
    pub fn num_faces(&self) -> usize {
        self.faces.len()
    }
}

/// The faces of a mesh in an order of which every beginning is a choice: more detail keeps what less detail has.
///
/// The boundary is always drawn, since what is inside is counted there; fractions are those of the faces within.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FaceOrder {
    boundary: Vec<u32>,
    inner: Vec<u32>,
}

impl FaceOrder {
    /// The most important faces first, the first of equal ones (bernardon2006, section 3.4).
    ///
    /// * `importance`: one per face of the mesh
    ///
    /// # Panics
    /// If there is another number of importances than faces.
    pub fn by_importance(mesh: &CellMesh, importance: &[f32]) -> Self {
        assert_eq!(importance.len(), mesh.num_faces(), "one importance per face");
        let mut order = Self::unordered(mesh);
        let rank = |f: &u32| (OrderedLast(importance[*f as usize]), *f);
        order.inner.par_sort_unstable_by_key(rank);
        order
    }

    /// Faces all over the mesh, the denser the larger and the more important they are.
    ///
    /// Taking the most important faces alone, as the paper does, leaves regions without any, through which rays then go in one
    /// step from far apart. Here faces lie along a curve through the mesh (Morton 1966), each with a length of
    /// `sqrt(importance · area)`, and are taken where the numbers 1/2, 1/4, 3/4, 1/8 … (van der Corput 1935) of the whole length fall.
    /// So at every number the gaps between faces are about alike where they matter alike.
    ///
    /// * `importance`: one per face of the mesh, at least 0
    ///
    /// # Panics
    /// As [`Self::by_importance`].
    pub fn spread(mesh: &CellMesh, importance: &[f32]) -> Self {
        assert_eq!(importance.len(), mesh.num_faces(), "one importance per face");
        let mut order = Self::unordered(mesh);
        let curve = Curve::new(mesh.bounds());
        let place = |&face: &u32| {
            (curve.place(mesh.faces[face as usize].points.map(|p| mesh.points[p as usize])), face)
        };
        let mut along: Vec<(u64, u32)> = order.inner.par_iter().map(place).collect();
        along.par_sort_unstable();
        let sum: f64 = along.iter().map(|&(_, face)| f64::from(importance[face as usize])).sum();
        let floor = LEAST_IMPORTANCE * sum / along.len().max(1) as f64;
        let length = |&(_, face): &(u64, u32)| {
            let of_face = f64::from(importance[face as usize]).max(floor);
            // Where nothing varies all faces matter alike.
            let of_face = if floor > 0.0 { of_face } else { 1.0 };
            (of_face * twice_area(mesh, face)).sqrt()
        };
        let lengths: Vec<f64> = along.par_iter().map(length).collect();
        let total = lengths.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let (mut end, mut start) = (0.0, 0u64);
        let mut ranked: Vec<(u64, u32)> = Vec::with_capacity(along.len());
        for (&(_, face), length) in along.iter().zip(&lengths) {
            end += length;
            let stop = ((end / total * WHOLE) as u64).max(start + 1);
            ranked.push((corput_rank(start, stop), face));
            start = stop;
        }
        ranked.par_sort_unstable();
        order.inner = ranked.into_iter().map(|(_, face)| face).collect();
        order
    }

    fn unordered(mesh: &CellMesh) -> Self {
        let (boundary, inner) =
            (0..mesh.faces.len() as u32).partition(|&f| mesh.faces[f as usize].is_boundary);
        Self { boundary, inner }
    }

    /// The boundary, and a fraction of the faces within.
    ///
    /// * `fraction`: in [0, 1]; `None` is returned where all are drawn
    pub fn choose(&self, fraction: f64) -> Option<FaceChoice> {
        let num = (fraction.clamp(0.0, 1.0) * self.inner.len() as f64).round() as usize;
        if num == self.inner.len() {
            return None;
        }
        let mut faces = [self.boundary.as_slice(), &self.inner[..num]].concat();
        faces.par_sort_unstable();
        Some(FaceChoice { faces })
    }

    /// Faces of the boundary.
    pub fn num_boundary(&self) -> usize {
        self.boundary.len()
    }

    /// Faces within.
    pub fn num_inner(&self) -> usize {
        self.inner.len()
    }
}

/// A number that sorts by falling value.
#[derive(PartialEq)]
struct OrderedLast(f32);

impl Eq for OrderedLast {}

impl PartialOrd for OrderedLast {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for OrderedLast {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        other.0.total_cmp(&self.0)
    }
}

/// Importances of [`FaceOrder::spread`] are taken as at least this much of their mean, so that still regions keep some faces.
const LEAST_IMPORTANCE: f64 = 0.05;
/// The whole length along which faces are taken.
const WHOLE: f64 = (1u64 << 62) as f64;

/// When the first of the numbers of van der Corput falls behind `start` and not behind `stop`, as a number that rises with the time.
fn corput_rank(start: u64, stop: u64) -> u64 {
    // The number in between with the most zeros at its end; in the sequence, numbers come by their bits in reverse.
    let highest = 63 - (start ^ stop).leading_zeros();
    (stop >> highest << highest).reverse_bits()
}

/// A curve through a box.
struct Curve {
    low: [f64; 3],
    per_length: f64,
}

/// Bits of a place along an axis.
const PLACE_BITS: u32 = 20;

impl Curve {
    fn new([low, high]: [[f64; 3]; 2]) -> Self {
        let side = (0..3).map(|a| high[a] - low[a]).fold(f64::MIN_POSITIVE, f64::max);
        Self { low, per_length: f64::from((1u32 << PLACE_BITS) - 1) / side }
    }

    /// Where the centre of a triangle lies on the curve.
    fn place(&self, corners: [[f64; 3]; 3]) -> u64 {
        (0..3).fold(0, |code, axis| {
            let centre = corners.iter().map(|c| c[axis]).sum::<f64>() / 3.0;
            let along = ((centre - self.low[axis]) * self.per_length) as u64;
            (0..PLACE_BITS).fold(code, |code, bit| code | (along >> bit & 1) << (3 * bit + axis as u32))
        })
    }
}

fn twice_area(mesh: &CellMesh, face: u32) -> f64 {
    let [a, b, c] = mesh.faces[face as usize].points.map(|p| mesh.points[p as usize]);
    let normal = cross(sub(b, a), sub(c, a));
    dot(normal, normal).sqrt()
}

/// How much the values at the points of a mesh vary over time: sums over the steps that were added.
#[derive(Debug, Clone)]
pub struct Variation {
    num_steps: u32,
    /// Mean, and sum of squared differences from it, of each point.
    moments: Vec<[f64; 2]>,
}

/// Means are taken as at least this fraction of the range of the values, so that dividing by them means something.
const LEAST_MEAN: f64 = 1e-3;
/// The same for [`Variation::order`]: below it deviations count as they are. What is nearly zero all the time varies a lot by its
/// coefficient, and is not to be seen.
const LEAST_MEAN_OF_ORDER: f64 = 0.5;

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
        self.coefficients_above(LEAST_MEAN, value_range)
    }

    fn coefficients_above(&self, least_mean: f64, value_range: [f64; 2]) -> Vec<f32> {
        let guard = (least_mean * (value_range[1] - value_range[0])).max(f64::MIN_POSITIVE);
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
        Self::of_faces(mesh, &self.coefficients(value_range))
    }

    /// The faces of a mesh in the order in which they are worth drawing: [`FaceOrder::spread`] by coefficients of variation.
    ///
    /// # Panics
    /// As [`Self::importance`].
    pub fn order(&self, mesh: &CellMesh, value_range: [f64; 2]) -> FaceOrder {
        let of_points = self.coefficients_above(LEAST_MEAN_OF_ORDER, value_range);
        FaceOrder::spread(mesh, &Self::of_faces(mesh, &of_points))
    }

    fn of_faces(mesh: &CellMesh, of_points: &[f32]) -> Vec<f32> {
        assert_eq!(mesh.num_points(), of_points.len(), "one value per point");
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
    fn numbers_of_van_der_corput_come_in_their_order() {
        // 0.1, 0.01, 0.11, 0.001, 0.101, 0.011, 0.111 in binary; the last of eight equal parts ends with the whole.
        let ranks: Vec<u64> = (0..8).map(|i| corput_rank(i << 3, (i + 1) << 3)).collect();
        let mut order: Vec<usize> = (0..8).collect();
        order.sort_by_key(|&i| ranks[i]);
        assert_eq!(order, [7, 3, 1, 5, 0, 4, 2, 6]);
    }

    #[test]
    fn more_detail_keeps_what_less_has() {
        let mesh = mesh();
        let importance = vec![1.0; mesh.num_faces()];
        for order in [FaceOrder::spread(&mesh, &importance), FaceOrder::by_importance(&mesh, &importance)] {
            assert_eq!((order.num_boundary(), order.num_inner()), (6, 1));
            assert_eq!(order.choose(0.0).map(|choice| choice.num_faces()), Some(6));
            assert_eq!(order.choose(1.0), None);
        }
        let nothing = FaceOrder::spread(&mesh, &vec![0.0; mesh.num_faces()]);
        assert_eq!(nothing.num_inner(), 1);
    }

    #[test]
    fn static_importance_takes_from_all_classes() {
        let mesh = mesh();
        let importance = static_importance(&mesh, &[0.0, 0.0, 0.0, 0.0, 9.0], 7);
        // Three faces have the point of value 9, four do not: each class has a first.
        assert_eq!(importance.iter().filter(|i| **i == 0.0).count(), 2);
    }
}
