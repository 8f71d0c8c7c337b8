//! The discrete cosine transform over the steps of a window.

/// Samples transformed at a time: their sums stay in registers.
const LANES: usize = 16;

/// The orthonormal DCT-II of windows of one length (lum2001, section 3.3).
///
/// `C(u) = alpha(u) * sum over t of f(t) * cos((2t + 1) u pi / 2N)`, with `alpha(0) = sqrt(1/N)` and
/// `alpha(u) = sqrt(2/N)` beyond: the sum of squares of the coefficients is that of the samples. Sums are in `f32`, in the
/// order of the steps; the cosines are those of `libm`, so that the result is the same on every machine.
#[derive(Debug, Clone, PartialEq)]
pub struct Dct {
    num_steps: usize,
    /// `[u, t]`.
    matrix: Vec<f32>,
    /// `[t, u]`.
    transposed: Vec<f32>,
}

impl Dct {
    /// The transform of windows of `num_steps` steps, at least 1.
    pub fn new(num_steps: usize) -> Self {
        let n = num_steps.max(1);
        // The cosines of multiples of pi / 2N; all angles below are among them.
        let quarter: Vec<f64> = (0..=n)
            .map(|k| if k == n { 0.0 } else { libm::cos(std::f64::consts::FRAC_PI_2 * k as f64 / n as f64) })
            .collect();
        let cosine = |k: usize| match (k % (4 * n)) / n {
            0 => quarter[k % n],
            1 => -quarter[n - k % n],
            2 => -quarter[k % n],
            _ => quarter[n - k % n],
        };
        let alpha = [(1.0 / n as f64).sqrt(), (2.0 / n as f64).sqrt()];
        let entry = |u: usize, t: usize| (alpha[usize::from(u > 0)] * cosine((2 * t + 1) * u)) as f32;
        let matrix = (0..n * n).map(|at| entry(at / n, at % n)).collect();
        let transposed = (0..n * n).map(|at| entry(at % n, at / n)).collect();
        Self { num_steps: n, matrix, transposed }
    }

    /// Length of the windows.
    pub fn num_steps(&self) -> usize {
        self.num_steps
    }

    /// The coefficients `[u, sample]` of samples `[t, sample]`.
    pub fn forward(&self, values: &[f32]) -> Vec<f32> {
        transform(&self.matrix, self.num_steps, values)
    }

    /// The samples `[t, sample]` of coefficients `[u, sample]`.
    pub fn inverse(&self, coefficients: &[f32]) -> Vec<f32> {
        transform(&self.transposed, self.num_steps, coefficients)
    }
}

/// `result[row, sample] = sum over column of matrix[row, column] * values[column, sample]`.
fn transform(matrix: &[f32], num_rows: usize, values: &[f32]) -> Vec<f32> {
    let num_samples = values.len() / num_rows;
    let mut result = vec![0.0; num_rows * num_samples];
    let mut columns = vec![[0f32; LANES]; num_rows];
    for start in (0..num_samples).step_by(LANES) {
        let len = LANES.min(num_samples - start);
        for (t, column) in columns.iter_mut().enumerate() {
            column[..len].copy_from_slice(&values[t * num_samples + start..][..len]);
        }
        for (u, row) in matrix.chunks_exact(num_rows).enumerate() {
            let mut sums = [0f32; LANES];
            for (factor, column) in row.iter().zip(&columns) {
                (0..LANES).for_each(|lane| sums[lane] += factor * column[lane]);
            }
            result[u * num_samples + start..][..len].copy_from_slice(&sums[..len]);
        }
    }
    result
}
