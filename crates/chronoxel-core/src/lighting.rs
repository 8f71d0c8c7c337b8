//! Two-sided local lighting of a sample by its gradient.

use crate::CoreError;

/// Coefficients of the lighting; the defaults are VTK's, so that pictures compare.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lighting {
    /// `ka`: light that reaches every sample.
    pub ambient: f32,
    /// `kd`: weight of the light that a surface facing the lamp scatters.
    pub diffuse: f32,
    /// `ks`: weight of the highlight.
    pub specular: f32,
    /// `p`: sharpness of the highlight, from 1 to 128.
    pub specular_power: u32,
}

impl Default for Lighting {
    fn default() -> Self {
        Self { ambient: 0.1, diffuse: 0.7, specular: 0.2, specular_power: 10 }
    }
}

impl Lighting {
    /// Checks the coefficients.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if a coefficient is negative or not finite, or the power is not in 1..=128.
    pub fn check(&self) -> Result<(), CoreError> {
        let coefficients = [self.ambient, self.diffuse, self.specular];
        if let Some(k) = coefficients.iter().find(|k| !(k.is_finite() && **k >= 0.0)) {
            return Err(CoreError::invalid("lighting coefficient", k, "it must be finite and not negative"));
        }
        if !(1..=128).contains(&self.specular_power) {
            return Err(CoreError::invalid("specular power", self.specular_power, "use 1 to 128"));
        }
        Ok(())
    }

    /// The two terms of `rgb · (ka + kd |N·L|) + ks |N·H|^p`: the factor of `rgb`, and the highlight added.
    ///
    /// With a headlight, `L` and `H` both point along the ray back to the eye, and the two cosines are one.
    ///
    /// * `gradient`: world units, any length; where it is zero the sample is unlit: `(1, 0)`
    /// * `direction`: unit vector along the ray
    pub fn headlight_terms(&self, gradient: [f64; 3], direction: [f64; 3]) -> (f64, f64) {
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let length = dot(gradient, gradient).sqrt();
        if length == 0.0 {
            return (1.0, 0.0);
        }
        let cosine = (dot(gradient, direction) / length).abs();
        let scattered = f64::from(self.ambient) + f64::from(self.diffuse) * cosine;
        (scattered, f64::from(self.specular) * cosine.powi(self.specular_power as i32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terms_at_known_angles() {
        let lighting = Lighting::default();
        let terms = |gradient| lighting.headlight_terms(gradient, [0.0, 0.0, -1.0]);
        let close = |(a, b): (f64, f64), (c, d): (f64, f64)| (a - c).abs() < 1e-6 && (b - d).abs() < 1e-6;
        assert!(close(terms([0.0, 0.0, 5.0]), (0.8, 0.2)));
        assert!(close(terms([0.0, 0.0, -5.0]), (0.8, 0.2)), "two-sided");
        assert!(close(terms([3.0, 0.0, 0.0]), (0.1, 0.0)));
        // 60 degrees: cosine 1/2, 2^-10.
        assert!(close(terms([3f64.sqrt(), 0.0, 1.0]), (0.45, 0.2 / 1024.0)));
        assert_eq!(terms([0.0; 3]), (1.0, 0.0));
    }

    #[test]
    fn coefficients_are_checked() {
        assert!(Lighting::default().check().is_ok());
        assert!(Lighting { ambient: f32::NAN, ..Default::default() }.check().is_err());
        assert!(Lighting { specular_power: 0, ..Default::default() }.check().is_err());
    }
}
