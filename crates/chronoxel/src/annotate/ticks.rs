//! Where ticks lie and how their numbers are written.

/// Ticks of an axis or a colour bar: round values and one way of writing them all.
#[derive(Debug, Clone, PartialEq)]
pub struct Ticks {
    /// Values of the ticks, ascending, inside the range.
    pub values: Vec<f64>,
    /// The text of each tick, in units of `10^exponent`.
    pub labels: Vec<String>,
    /// The power of ten to be written once beside the units; 0 where none is needed.
    pub exponent: i32,
}

impl Ticks {
    /// At most `max_ticks` (at least 2) multiples of 1, 2 or 5 times a power of ten in `[low, high]`.
    ///
    /// A range that is empty or not finite gets the one tick `low`, or none.
    pub fn new(low: f64, high: f64, max_ticks: usize) -> Self {
        if !low.is_finite() || !high.is_finite() {
            return Self { values: Vec::new(), labels: Vec::new(), exponent: 0 };
        }
        let extent = high - low;
        let distinguishable =
            extent > 1e-9 * low.abs().max(high.abs()) && (1e-300..f64::INFINITY).contains(&extent);
        let values = if distinguishable { multiples(low, high, max_ticks.max(2)) } else { vec![low] };
        let largest = values.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let exponent = common_exponent(largest);
        let power = 10f64.powi(exponent);
        let decimals = match values[..] {
            [first, second, ..] => decimals_of_step((second - first) / power),
            [only] => decimals_of_value(only / power),
            [] => 0,
        };
        let labels = values.iter().map(|v| fixed(v / power, decimals)).collect();
        Self { values, labels, exponent }
    }
}

/// Multiples of a round step in `[low, high]`, as many as there may be up to `max_ticks`.
fn multiples(low: f64, high: f64, max_ticks: usize) -> Vec<f64> {
    let mut power = ((high - low) / max_ticks as f64).log10().floor() as i32;
    loop {
        for mantissa in [1.0, 2.0, 5.0] {
            // Dividing by a positive power keeps 0.1, 0.2, … the doubles nearest to them.
            let at = |k: f64| {
                if power < 0 { k * mantissa / 10f64.powi(-power) } else { k * mantissa * 10f64.powi(power) }
            };
            let step = at(1.0);
            let first = (low / step - 1e-9).ceil();
            let last = (high / step + 1e-9).floor();
            let count = last - first + 1.0;
            if count <= max_ticks as f64 {
                return (0..count.max(0.0) as usize).map(|k| at(first + k as f64) + 0.0).collect();
            }
        }
        power += 1;
    }
}

/// The power of ten to take out of numbers as large as `largest`: a multiple of 3, or 0 where plain
/// numbers read well.
fn common_exponent(largest: f64) -> i32 {
    if largest == 0.0 || (1e-2..1e5).contains(&largest) {
        return 0;
    }
    let power = (largest.log10() + 1e-9).floor() as i32;
    power.div_euclid(3) * 3
}

/// Decimals with which multiples of `step` are written exactly (at most 9).
fn decimals_of_step(step: f64) -> usize {
    let exact = |&d: &usize| {
        let scaled = step * 10f64.powi(d as i32);
        scaled >= 0.999 && (scaled - scaled.round()).abs() < 1e-6 * scaled
    };
    (0..9).find(exact).unwrap_or(9)
}

/// Decimals that show a number to one part in ten thousand (at most 9).
fn decimals_of_value(value: f64) -> usize {
    let shown = |&d: &usize| {
        let scaled = value * 10f64.powi(d as i32);
        (scaled - scaled.round()).abs() <= 1e-4 * scaled.abs()
    };
    (0..9).find(shown).unwrap_or(9)
}

/// A number with fixed decimals and a true minus sign; never `−0`.
pub(super) fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(digits) if digits.chars().any(|c| ('1'..='9').contains(&c)) => format!("−{digits}"),
        Some(digits) => digits.to_owned(),
        None => text,
    }
}

/// `10^exponent` with a raised exponent: `10⁻³`.
pub(super) fn power_of_ten(exponent: i32) -> String {
    let raise = |c: char| match c {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32(u32::from('⁰') + u32::from(digit) - u32::from('0')).unwrap_or(digit),
    };
    format!("10{}", exponent.to_string().chars().map(raise).collect::<String>())
}

/// A name with its units and power of ten, as a journal prints it: `density (10³ kg/m³)`.
pub(super) fn title(name: &str, units: &str, exponent: i32) -> String {
    let (name, units) = (name.trim(), units.trim());
    match (exponent, units) {
        (0, "") => name.to_owned(),
        (0, units) => format!("{name} ({units})"),
        (e, "") => format!("{name} (×{})", power_of_ten(e)),
        (e, units) => format!("{name} ({} {units})", power_of_ten(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(low: f64, high: f64, max: usize) -> String {
        Ticks::new(low, high, max).labels.join(" ")
    }

    #[test]
    fn a_single_round_tick_is_written_short() {
        assert_eq!(Ticks::new(0.020_833, 1.979, 2).labels, ["1"]);
    }

    #[test]
    fn round_numbers_in_the_range() {
        assert_eq!(labels(0.0, 1.0, 6), "0.0 0.2 0.4 0.6 0.8 1.0");
        assert_eq!(labels(0.0, 127.0, 6), "0 50 100");
        assert_eq!(labels(0.0, 127.0, 7), "0 20 40 60 80 100 120");
        assert_eq!(labels(-1.0, 1.0, 5), "−1.0 −0.5 0.0 0.5 1.0");
        assert_eq!(labels(0.13, 0.87, 4), "0.2 0.4 0.6 0.8");
        assert_eq!(labels(998.0, 1003.0, 6), "998 999 1000 1001 1002 1003");
    }

    #[test]
    fn large_and_small_numbers_share_one_power_of_ten() {
        let ticks = Ticks::new(0.0, 2.0e6, 5);
        assert_eq!((ticks.labels.join(" ").as_str(), ticks.exponent), ("0.0 0.5 1.0 1.5 2.0", 6));
        let ticks = Ticks::new(0.0, 3.0e-7, 4);
        assert_eq!((ticks.labels.join(" ").as_str(), ticks.exponent), ("0 100 200 300", -9));
        assert_eq!(Ticks::new(0.0, 1000.0, 5).exponent, 0);
        assert_eq!(Ticks::new(0.0, 1e-300, 5).labels.len(), 3);
    }

    #[test]
    fn ranges_that_are_no_ranges_do_not_hang() {
        assert_eq!(Ticks::new(3.0, 3.0, 5).values, [3.0]);
        assert!(Ticks::new(f64::NAN, 1.0, 5).values.is_empty());
        assert!(Ticks::new(0.0, f64::INFINITY, 5).values.is_empty());
        assert_eq!(Ticks::new(5.0, 1.0, 5).values, [5.0]);
        assert!(Ticks::new(-1e300, 1e300, 5).values.len() <= 5);
        assert_eq!(Ticks::new(0.0, 0.0, 5).labels, ["0"]);
        assert_eq!(Ticks::new(2.5, 2.5, 5).labels, ["2.5"]);
        assert_eq!(Ticks::new(f64::MIN, f64::MAX, 5).values.len(), 1);
        assert!(Ticks::new(0.0, 5e-324, 5).values.len() <= 5);
    }

    #[test]
    fn titles_carry_units_and_powers() {
        assert_eq!(title("density", "kg/m³", 0), "density (kg/m³)");
        assert_eq!(title("density", "kg/m³", -3), "density (10⁻³ kg/m³)");
        assert_eq!(title("x", "", 12), "x (×10¹²)");
        assert_eq!(title("x", " ", 0), "x");
    }
}
