//! A run of samples as a reader hands them over.

/// Samples in `[z, y, x]` order (x fastest), without rounding: `F32` where the source type fits it.
#[derive(Debug, Clone, PartialEq)]
pub enum Samples {
    /// From 8- and 16-bit integers and `f32`.
    F32(Vec<f32>),
    /// From wider integers (up to 53 bits) and `f64`.
    F64(Vec<f64>),
}

impl Samples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(v) => v.len(),
            Self::F64(v) => v.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The sample at `index` as an `f64`.
    pub fn get(&self, index: usize) -> f64 {
        match self {
            Self::F32(v) => f64::from(v[index]),
            Self::F64(v) => v[index],
        }
    }

    /// All samples as `f64`.
    pub fn to_f64(&self) -> Vec<f64> {
        match self {
            Self::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::F64(v) => v.clone(),
        }
    }
}
