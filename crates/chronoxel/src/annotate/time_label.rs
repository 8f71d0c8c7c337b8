//! The time and the step, in a corner.

use chronoxel_core::{Image8, TimeAxis};

use super::canvas::Rect;
use super::text::{draw_text, fitted, measured};
use super::ticks::{fixed, power_of_ten};
use super::{Label, Style};

/// How the times of one series are written: all with the same decimals, so that the text of a movie stands still.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeLabel {
    decimals: usize,
    exponent: i32,
    units: String,
}

impl TimeLabel {
    /// Enough decimals to tell all steps of the axis apart, a hundredth of the shortest step at the most.
    pub fn new(axis: &TimeAxis) -> Self {
        let largest = axis.times.iter().fold(0.0, |m: f64, t| m.max(t.abs()));
        let plain = largest == 0.0 || (1e-2..1e6).contains(&largest);
        let exponent = if plain { 0 } else { (largest.log10() + 1e-9).floor() as i32 };
        let scaled: Vec<f64> = axis.times.iter().map(|t| t / 10f64.powi(exponent)).collect();
        let shortest = scaled.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
        let tolerance = if shortest.is_finite() { shortest * 0.01 } else { largest.max(1.0) * 1e-4 };
        let tells = |&decimals: &usize| {
            let power = 10f64.powi(decimals as i32);
            scaled.iter().all(|t| ((t * power).round() / power - t).abs() <= tolerance)
        };
        let decimals = (0..9).find(tells).unwrap_or(9);
        Self { decimals, exponent, units: axis.units.trim().to_owned() }
    }

    /// `t = 3.2 s · step 17`.
    pub fn text(&self, time: f64, step: usize) -> String {
        let number = fixed(time / 10f64.powi(self.exponent), self.decimals);
        let power =
            if self.exponent == 0 { String::new() } else { format!(" × {}", power_of_ten(self.exponent)) };
        let space = if self.units.is_empty() { "" } else { " " };
        format!("t = {number}{power}{space}{} · step {step}", self.units)
    }

    /// Writes it into the upper left corner.
    pub fn draw(&self, image: &mut Image8, style: &Style, time: f64, step: usize) -> Label {
        let margin = style.em;
        let text = fitted(&self.text(time, step), style.em, image.width as f32 - 2.0 * margin);
        let [width, height] = measured(&text, style.em);
        let rect = Rect { x0: margin, y0: margin, x1: margin + width, y1: margin + height };
        draw_text(image, &text, rect, style)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(times: &[f64], units: &str) -> Vec<String> {
        let axis = TimeAxis::new(times.to_vec(), units).unwrap();
        let label = TimeLabel::new(&axis);
        times.iter().enumerate().map(|(step, time)| label.text(*time, step)).collect()
    }

    #[test]
    fn decimals_tell_the_steps_apart() {
        assert_eq!(texts(&[0.0, 1.6, 3.2], "s")[2], "t = 3.2 s · step 2");
        assert_eq!(texts(&[0.0, 0.25, 0.5], "s")[0], "t = 0.00 s · step 0");
        assert_eq!(texts(&[0.0, 1.0], "")[1], "t = 1 · step 1");
        assert_eq!(texts(&[-2.0, 500.0], "hours since 2000")[0], "t = −2 hours since 2000 · step 0");
        assert_eq!(texts(&[0.0, 1.0 / 3.0], "s")[1], "t = 0.33 s · step 1");
    }

    #[test]
    fn small_and_large_times_have_a_power() {
        assert_eq!(texts(&[0.0, 2.5e-7], "s")[1], "t = 2.5 × 10⁻⁷ s · step 1");
        assert_eq!(texts(&[3e9, 4e9], "yr")[0], "t = 3 × 10⁹ yr · step 0");
    }
}
