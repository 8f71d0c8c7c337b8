//! Transfer functions: colour and opacity of a value, piecewise linear.

use crate::{ColorMap, CoreError};

/// A corner of a piecewise linear transfer function.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransferPoint {
    /// Where it lies, in the function's [`TransferDomain`].
    pub x: f64,
    /// sRGB components in [0, 1].
    pub color: [f32; 3],
    /// Opacity of a path of one unit length, in [0, 1].
    pub opacity: f32,
}

/// What the `x` of a transfer function's points counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TransferDomain {
    /// Data units.
    Data,
    /// [0, 1] over these two values.
    Range([f64; 2]),
    /// [0, 1] over the range of the variable drawn.
    Variable,
}

/// Colour and opacity over a domain, as the user gives them.
#[derive(Debug, Clone, PartialEq)]
pub struct TransferFunction {
    points: Vec<TransferPoint>,
    domain: TransferDomain,
}

/// Opacity per unit length that `ramp`, and functions that give no opacity, reach at the top.
pub(crate) const RAMP_OPACITY: f64 = 0.05;

impl TransferFunction {
    /// Names of the built-in functions.
    pub const BUILT_IN: [&str; 3] = ["ramp", "sparse", "filled"];

    /// A function from its points. Points of equal `x` make a step: the last of them holds at `x` itself.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if there is no point, a number is not finite, a colour or an opacity
    /// is outside [0, 1], `x` decreases, or the domain's range is empty.
    pub fn new(points: Vec<TransferPoint>, domain: TransferDomain) -> Result<Self, CoreError> {
        if points.is_empty() {
            return Err(CoreError::invalid(
                "transfer function's points",
                "an empty list",
                "give at least one",
            ));
        }
        let at = |value: String, i: usize| format!("{value} at point {i}");
        for (i, point) in points.iter().enumerate() {
            if !point.x.is_finite() {
                let value = at(point.x.to_string(), i);
                return Err(CoreError::invalid("transfer function's x", value, "it must be finite"));
            }
            if i > 0 && point.x < points[i - 1].x {
                let value = at(format!("{} after {}", point.x, points[i - 1].x), i);
                return Err(CoreError::invalid("transfer function's x", value, "x must not decrease"));
            }
            if let Some(c) = point.color.iter().find(|c| !(0.0..=1.0).contains(*c)) {
                let value = at(c.to_string(), i);
                return Err(CoreError::invalid("transfer function's color", value, "it must be in [0, 1]"));
            }
            if !(0.0..=1.0).contains(&point.opacity) {
                let value = at(point.opacity.to_string(), i);
                return Err(CoreError::invalid("transfer function's opacity", value, "it must be in [0, 1]"));
            }
        }
        if let TransferDomain::Range(range) = domain {
            check_range("transfer function's domain", range)?;
            if range[0] == range[1] {
                let value = format!("{range:?}");
                return Err(CoreError::invalid("transfer function's domain", value, "min must be below max"));
            }
        }
        Ok(Self { points, domain })
    }

    /// A built-in function over a colour map and the variable's range: with x in [0, 1], `ramp` has an
    /// opacity of 0.05 x, `filled` 0.02 + 0.08 x, and `sparse` triangles of height 0.08 at 0.55 ± 0.05 and
    /// 0.35 at 0.85 ± 0.10, and none elsewhere.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] for another name.
    pub fn built_in(name: &str, map: ColorMap) -> Result<Self, CoreError> {
        let opacity: &[(f64, f64)] = match name {
            "ramp" => &[(0.0, 0.0), (1.0, RAMP_OPACITY)],
            "filled" => &[(0.0, 0.02), (1.0, 0.10)],
            "sparse" => &[
                (0.0, 0.0),
                (0.50, 0.0),
                (0.55, 0.08),
                (0.60, 0.0),
                (0.75, 0.0),
                (0.85, 0.35),
                (0.95, 0.0),
                (1.0, 0.0),
            ],
            _ => {
                let remedy = "use ramp, sparse, filled or the path of a .json file";
                return Err(CoreError::invalid("transfer function", name, remedy));
            }
        };
        Self::new(merge(&map.points(), opacity), TransferDomain::Variable)
    }

    /// The points, `x` not decreasing.
    pub fn points(&self) -> &[TransferPoint] {
        &self.points
    }

    /// What `x` counts.
    pub fn domain(&self) -> TransferDomain {
        self.domain
    }

    /// The function with `x` in data units.
    ///
    /// * `variable_range`: smallest and largest value of the variable drawn. Where the two are equal, [0, 1]
    ///   is laid over the unit that follows, so that a constant variable has x = 0.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if the variable's range is needed and not finite or reversed, or an `x`
    /// overflows.
    pub fn resolve(&self, variable_range: [f64; 2]) -> Result<ResolvedTransfer, CoreError> {
        let [low, high] = match self.domain {
            TransferDomain::Data => [0.0, 1.0],
            TransferDomain::Range(range) => range,
            TransferDomain::Variable => {
                check_range("the variable's range", variable_range)?;
                if variable_range[0] < variable_range[1] {
                    variable_range
                } else {
                    [variable_range[0], variable_range[0] + 1.0]
                }
            }
        };
        let mut points = self.points.clone();
        if self.domain != TransferDomain::Data {
            for point in &mut points {
                point.x = low * (1.0 - point.x) + high * point.x;
            }
        }
        match points.iter().find(|p| !p.x.is_finite()) {
            Some(p) => Err(CoreError::invalid("transfer function's x", p.x, "use a smaller domain")),
            None => Ok(ResolvedTransfer { points }),
        }
    }
}

fn check_range(field: &'static str, range: [f64; 2]) -> Result<(), CoreError> {
    if range.iter().all(|x| x.is_finite()) && range[0] <= range[1] && (range[1] - range[0]).is_finite() {
        return Ok(());
    }
    Err(CoreError::invalid(field, format!("{range:?}"), "it must be finite, the smaller value first"))
}

/// The points of both a colour and an opacity function, each linear between its own points, steps kept.
pub(crate) fn merge(color: &[(f64, [f32; 3])], opacity: &[(f64, f64)]) -> Vec<TransferPoint> {
    let mut xs: Vec<f64> = color.iter().map(|p| p.0).chain(opacity.iter().map(|p| p.0)).collect();
    xs.sort_by(f64::total_cmp);
    xs.dedup();
    let mut points = Vec::with_capacity(xs.len());
    for x in xs {
        let left = TransferPoint {
            x,
            color: std::array::from_fn(|c| limit(color, x, Side::Left, |p| f64::from(p[c])) as f32),
            opacity: limit(opacity, x, Side::Left, |p| p) as f32,
        };
        let right = TransferPoint {
            x,
            color: std::array::from_fn(|c| limit(color, x, Side::Right, |p| f64::from(p[c])) as f32),
            opacity: limit(opacity, x, Side::Right, |p| p) as f32,
        };
        points.push(left);
        if right != left {
            points.push(right);
        }
    }
    points
}

#[derive(Clone, Copy, PartialEq)]
enum Side {
    Left,
    Right,
}

/// The value of a piecewise linear function as `x` is reached from one side; clamped outside.
fn limit<T: Copy>(points: &[(f64, T)], x: f64, side: Side, component: impl Fn(T) -> f64) -> f64 {
    let next = match side {
        Side::Left => points.partition_point(|p| p.0 < x),
        Side::Right => points.partition_point(|p| p.0 <= x),
    };
    let value = |i: usize| component(points[i].1);
    match next {
        0 => value(0),
        n if n == points.len() => value(n - 1),
        n => {
            let (x0, x1) = (points[n - 1].0, points[n].0);
            let w = (x - x0) / (x1 - x0);
            value(n - 1) * (1.0 - w) + value(n) * w
        }
    }
}

/// A transfer function with `x` in data units.
#[derive(Debug, Clone, PartialEq)]
pub struct ResolvedTransfer {
    points: Vec<TransferPoint>,
}

impl ResolvedTransfer {
    /// The points, `x` in data units, not decreasing; at least one.
    pub fn points(&self) -> &[TransferPoint] {
        &self.points
    }

    /// Colour (sRGB, not premultiplied) and opacity per unit length of a value.
    ///
    /// Clamped outside the points; at a step the point after it; NaN has colour and opacity 0.
    pub fn evaluate(&self, value: f64) -> [f64; 4] {
        if value.is_nan() {
            return [0.0; 4];
        }
        let of = |p: &TransferPoint| {
            let [r, g, b] = p.color.map(f64::from);
            [r, g, b, f64::from(p.opacity)]
        };
        let next = self.points.partition_point(|p| p.x <= value);
        if next == 0 || next == self.points.len() {
            return of(&self.points[next.saturating_sub(1)]);
        }
        let (left, right) = (&self.points[next - 1], &self.points[next]);
        let w = (value - left.x) / (right.x - left.x);
        let (a, b) = (of(left), of(right));
        std::array::from_fn(|i| a[i] * (1.0 - w) + b[i] * w)
    }

    /// Whether every value of the closed range has opacity 0, exactly. A range with a NaN is not.
    pub fn is_transparent_over(&self, [min, max]: [f64; 2]) -> bool {
        if min.is_nan() || max.is_nan() {
            return false;
        }
        let inside = self.points.iter().filter(|p| p.x > min && p.x <= max);
        self.evaluate(min)[3] == 0.0
            && self.evaluate(max)[3] == 0.0
            && inside.into_iter().all(|p| p.opacity == 0.0)
    }

    /// Whether every value of the closed range has the same colour and the same opacity, exactly: steps and corners inside count.
    ///
    /// A range with a NaN is not, nor is a reversed one.
    pub fn is_constant_over(&self, [min, max]: [f64; 2]) -> bool {
        if min.is_nan() || max.is_nan() || min >= max {
            return min == max;
        }
        let points = &self.points;
        let above_min = points.partition_point(|p| p.x <= min);
        let above_max = points.partition_point(|p| p.x <= max);
        let first = above_min.saturating_sub(1);
        // A segment that is left inside the range goes on to its end.
        let ends_at_point = above_max > 0 && points[above_max - 1].x == max;
        let last = (above_max + usize::from(!ends_at_point)).min(points.len());
        let look = |p: &TransferPoint| (p.color, p.opacity);
        // Of several points at one x, those between the first and the last never show.
        let shows = |i: &usize| {
            let is_at = |j: Option<usize>| j.and_then(|j| points.get(j)).is_some_and(|p| p.x == points[*i].x);
            !(is_at(i.checked_sub(1)) && is_at(i.checked_add(1)))
        };
        (above_min..last).filter(shows).all(|i| look(&points[i]) == look(&points[first]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolved(points: &[(f64, f32)]) -> ResolvedTransfer {
        let points =
            points.iter().map(|&(x, opacity)| TransferPoint { x, color: [opacity; 3], opacity }).collect();
        TransferFunction::new(points, TransferDomain::Data).unwrap().resolve([f64::NAN; 2]).unwrap()
    }

    #[test]
    fn built_in_opacities_are_those_of_their_formulas() {
        let at = |name, x: f64| {
            let function = TransferFunction::built_in(name, ColorMap::Turbo).unwrap();
            function.resolve([-10.0, 30.0]).unwrap().evaluate(-10.0 + 40.0 * x)[3]
        };
        for x in [0.0, 0.123, 0.5, 0.77, 1.0] {
            assert!((at("ramp", x) - 0.05 * x).abs() < 1e-8);
            assert!((at("filled", x) - 0.02 - 0.08 * x).abs() < 1e-8);
        }
        let sparse = [(0.3, 0.0), (0.5, 0.0), (0.525, 0.04), (0.55, 0.08), (0.58, 0.032), (0.7, 0.0)];
        for (x, opacity) in sparse.into_iter().chain([(0.8, 0.175), (0.85, 0.35), (0.95, 0.0), (1.0, 0.0)]) {
            assert!((at("sparse", x) - opacity).abs() < 1e-7, "{x} {}", at("sparse", x));
        }
        assert!(TransferFunction::built_in("foggy", ColorMap::Gray).is_err());
    }

    #[test]
    fn steps_clamping_and_nan() {
        let tf = resolved(&[(1.0, 0.25), (2.0, 0.5), (2.0, 1.0), (4.0, 0.0)]);
        let found = [0.0, 1.0, 1.5, 2.0, 3.0, 9.0].map(|v| tf.evaluate(v)[3]);
        assert_eq!(found, [0.25, 0.25, 0.375, 1.0, 0.5, 0.0]);
        assert_eq!(tf.evaluate(f64::NAN), [0.0; 4]);
    }

    #[test]
    fn transparency_is_exact() {
        let tf = resolved(&[(0.0, 0.0), (1.0, 0.0), (2.0, 0.1), (2.0, 0.0), (5.0, 0.0), (5.0, 0.3)]);
        assert!(tf.is_transparent_over([-3.0, 1.0]));
        assert!(!tf.is_transparent_over([-3.0, 1.0 + 1e-9]));
        assert!(tf.is_transparent_over([2.0, 4.999]));
        assert!(!tf.is_transparent_over([2.0, 5.0]));
        assert!(!tf.is_transparent_over([1.999, 3.0]));
        assert!(!tf.is_transparent_over([0.5, 3.0]), "the opacity lies between the ends");
        assert!(!tf.is_transparent_over([f64::NAN, 1.0]));
    }

    #[test]
    fn constancy_is_exact() {
        let tf = resolved(&[
            (0.0, 0.5),
            (1.0, 0.5),
            (2.0, 0.7),
            (3.0, 0.5),
            (3.0, 0.9),
            (3.0, 0.5),
            (4.0, 0.5),
            (5.0, 0.5),
            (5.0, 0.6),
        ]);
        for range in [[-9.0, 1.0], [0.2, 0.7], [1.7, 1.7], [3.0, 4.999], [3.5, 4.5], [5.0, 9.0], [6.0, 7.0]] {
            assert!(tf.is_constant_over(range), "{range:?}");
        }
        let varying =
            [[-9.0, 1.0 + 1e-15], [1.2, 1.3], [1.0, 3.0], [2.999, 3.5], [4.5, 5.0], [4.5, 6.0], [-1.0, 9.0]];
        for range in varying {
            assert!(!tf.is_constant_over(range), "{range:?}");
        }
        let spike = resolved(&[(0.0, 0.5), (3.0, 0.5), (3.0, 0.9), (3.0, 0.5), (4.0, 0.5)]);
        assert!(spike.is_constant_over([-1.0, 9.0]), "of three points at one x the second never shows");
        assert!(!tf.is_constant_over([f64::NAN, 1.0]) && !tf.is_constant_over([0.0, f64::NAN]));
        let colored = |color: [f32; 3]| TransferPoint { x: f64::from(color[0]), color, opacity: 0.5 };
        let colored = TransferFunction::new(vec![colored([0.0; 3]), colored([1.0; 3])], TransferDomain::Data);
        assert!(!colored.unwrap().resolve([0.0, 1.0]).unwrap().is_constant_over([0.1, 0.2]));
    }

    #[test]
    fn a_constant_variable_takes_the_lowest_colour() {
        let tf = TransferFunction::built_in("filled", ColorMap::Gray).unwrap().resolve([7.0, 7.0]).unwrap();
        assert!((tf.evaluate(7.0)[3] - 0.02).abs() < 1e-8);
    }

    #[test]
    fn unusable_functions_are_refused() {
        let point = |x, opacity| TransferPoint { x, color: [0.0; 3], opacity };
        let new = |points: &[TransferPoint]| TransferFunction::new(points.to_vec(), TransferDomain::Data);
        assert!(new(&[]).is_err());
        assert!(new(&[point(f64::INFINITY, 0.0)]).is_err());
        assert!(new(&[point(0.0, 1.5)]).is_err());
        assert!(new(&[point(0.0, f32::NAN)]).is_err());
        let message = new(&[point(1.0, 0.0), point(0.0, 0.0)]).unwrap_err().to_string();
        assert_eq!(message, "transfer function's x is 0 after 1 at point 1: x must not decrease");
        let filled = TransferFunction::built_in("filled", ColorMap::Gray).unwrap();
        assert!(filled.resolve([0.0, f64::INFINITY]).is_err());
        assert!(filled.resolve([1.0, 0.0]).is_err());
        assert!(filled.resolve([f64::MIN, f64::MAX]).is_err());
    }
}
