//! Plots as SVG: panels above each other that share an axis, each with lines over the numbers of their values.

use std::fmt::Write as _;

/// A plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Plot {
    /// Name of its file, without extension.
    pub file: String,
    /// What it shows.
    pub title: String,
    /// What the values are counted by.
    pub x_label: String,
    /// From one value to the next, in what they are counted by.
    pub x_step: f64,
    /// From top to bottom.
    pub panels: Vec<Panel>,
}

/// Lines that share an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// What is measured, with its unit.
    pub label: String,
    /// The lines.
    pub lines: Vec<Line>,
    /// A value to compare with, and what it is.
    pub mark: Option<(f64, String)>,
    /// Whether equal steps are equal factors: values must be positive.
    pub is_log: bool,
}

/// Values in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// What it is, where there are several.
    pub name: String,
    /// One after the other.
    pub values: Vec<f64>,
}

const WIDTH: f64 = 800.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 52.0;
const PANEL: f64 = 170.0;
const GAP: f64 = 36.0;
const BOTTOM: f64 = 44.0;
const COLORS: [&str; 4] = ["#1f5fa8", "#c2410c", "#3f7d20", "#7a3e9d"];

impl Plot {
    /// The plot as an SVG file.
    pub fn to_svg(&self) -> String {
        let height = TOP + self.panels.len() as f64 * (PANEL + GAP) + BOTTOM - GAP;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" viewBox=\"0 0 {WIDTH} {height}\" \
             font-family=\"DejaVu Sans, Arial, sans-serif\" font-size=\"12\">\n\
             <rect width=\"{WIDTH}\" height=\"{height}\" fill=\"white\"/>\n"
        );
        text(&mut svg, [LEFT, 22.0], "start", &self.title);
        let lines = self.panels.iter().flat_map(|panel| &panel.lines);
        let last = lines.map(|line| line.values.len()).max().unwrap_or(0).saturating_sub(1).max(1) as f64;
        for (number, panel) in self.panels.iter().enumerate() {
            panel.draw(&mut svg, TOP + number as f64 * (PANEL + GAP), [last, self.x_step]);
        }
        let middle = (LEFT + WIDTH - RIGHT) / 2.0;
        text(&mut svg, [middle, height - 8.0], "middle", &self.x_label);
        svg + "</svg>\n"
    }
}

impl Panel {
    /// Draws it.
    ///
    /// * `last`: number of the last value, and how much of what is counted lies between two
    fn draw(&self, svg: &mut String, top: f64, [last, x_step]: [f64; 2]) {
        let bottom = top + PANEL;
        let [low, high] = self.range();
        let scale = |v: f64| if self.is_log { v.log10() } else { v };
        let y = |v: f64| bottom - (scale(v) - scale(low)) / (scale(high) - scale(low)) * PANEL;
        let x = |i: f64| LEFT + i / last * (WIDTH - LEFT - RIGHT);
        let line = |svg: &mut String, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2], style: &str| {
            writeln!(svg, "<path d=\"M{x1:.1} {y1:.1}L{x2:.1} {y2:.1}\" {style}/>").expect("to memory");
        };
        for tick in self.ticks([low, high]) {
            line(svg, [LEFT, y(tick)], [WIDTH - RIGHT, y(tick)], "stroke=\"#dddddd\"");
            text(svg, [LEFT - 6.0, y(tick) + 4.0], "end", &number(tick));
        }
        for tick in linear_ticks([0.0, last * x_step], 8) {
            let at = x(tick / x_step);
            line(svg, [at, bottom], [at, bottom + 4.0], "stroke=\"black\"");
            text(svg, [at, bottom + 17.0], "middle", &number(tick));
        }
        let frame = [LEFT, top, WIDTH - LEFT - RIGHT, PANEL].map(|v| format!("{v:.1}"));
        let [left, above, wide, high] = frame;
        writeln!(
            svg,
            "<rect x=\"{left}\" y=\"{above}\" width=\"{wide}\" height=\"{high}\" fill=\"none\" stroke=\"black\"/>"
        )
        .expect("to memory");
        let middle = (top + bottom) / 2.0;
        writeln!(svg, "<g transform=\"translate(16 {middle:.1}) rotate(-90)\">").expect("to memory");
        text(svg, [0.0, 0.0], "middle", &self.label);
        svg.push_str("</g>\n");
        if let Some((value, name)) = &self.mark {
            line(
                svg,
                [LEFT, y(*value)],
                [WIDTH - RIGHT, y(*value)],
                "stroke=\"#555555\" stroke-dasharray=\"6 4\"",
            );
            text(svg, [WIDTH - RIGHT - 4.0, y(*value) - 4.0], "end", name);
        }
        for (number, Line { name, values }) in self.lines.iter().enumerate() {
            let color = COLORS[number % COLORS.len()];
            let places =
                values.iter().enumerate().filter(|(_, v)| v.is_finite() && (!self.is_log || **v > 0.0));
            let points: Vec<String> =
                places.map(|(i, v)| format!("{:.1},{:.1}", x(i as f64), y(*v))).collect();
            writeln!(
                svg,
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.3\"/>",
                points.join(" ")
            )
            .expect("to memory");
            if self.lines.len() > 1 {
                let place = [LEFT + 10.0 + 120.0 * number as f64, top - 6.0];
                line(
                    svg,
                    [place[0], place[1] - 4.0],
                    [place[0] + 20.0, place[1] - 4.0],
                    &format!("stroke=\"{color}\" stroke-width=\"2\""),
                );
                text(svg, [place[0] + 26.0, place[1]], "start", name);
            }
        }
    }

    /// Smallest and largest value on the axis.
    fn range(&self) -> [f64; 2] {
        let values = self.lines.iter().flat_map(|line| line.values.iter().copied());
        let values = values.chain(self.mark.iter().map(|(value, _)| *value));
        let usable = values.filter(|v| v.is_finite() && (!self.is_log || *v > 0.0));
        let [low, high] =
            usable.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)]);
        match (self.is_log, low <= high) {
            (_, false) => [1.0, 10.0],
            (true, _) => [low / 1.2, high * 1.2],
            (false, _) => [low.min(0.0), if high > 0.0 { 1.08 * high } else { 1.0 }],
        }
    }

    fn ticks(&self, range: [f64; 2]) -> Vec<f64> {
        if !self.is_log {
            return linear_ticks(range, 5);
        }
        let decades = (range[1] / range[0]).log10();
        let factors: &[f64] = if decades < 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let powers = range[0].log10().floor() as i32..=range[1].log10().ceil() as i32;
        let ticks = powers.flat_map(|power| factors.iter().map(move |factor| factor * 10f64.powi(power)));
        ticks.filter(|tick| (range[0]..=range[1]).contains(tick)).collect()
    }
}

/// At most `most` round numbers and one more, evenly over a range.
fn linear_ticks([low, high]: [f64; 2], most: usize) -> Vec<f64> {
    let rough = (high - low) / most as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|f| f * power).find(|step| *step >= rough * 0.999);
    let step = step.unwrap_or(10.0 * power);
    let first = (low / step).ceil() as i64;
    (first..).map(|i| i as f64 * step).take_while(|tick| *tick <= high * (1.0 + 1e-9)).collect()
}

/// A number of an axis without needless digits.
fn number(value: f64) -> String {
    let rounded = (value * 1e6).round() / 1e6;
    format!("{rounded}")
}

fn text(svg: &mut String, [x, y]: [f64; 2], anchor: &str, text: &str) {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>")
        .expect("to memory");
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(values: &[f64], is_log: bool) -> Panel {
        let line = Line { name: "a < b".to_owned(), values: values.to_vec() };
        Panel { label: "rate (1/s)".to_owned(), lines: vec![line.clone(), line], mark: None, is_log }
    }

    #[test]
    fn ticks_are_round() {
        assert_eq!(linear_ticks([0.0, 23.0], 5), [0.0, 5.0, 10.0, 15.0, 20.0]);
        assert_eq!(linear_ticks([0.0, 399.0], 8), [0.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0]);
        let log = panel(&[0.3, 20.0], true);
        assert_eq!(
            log.ticks(log.range()).into_iter().map(number).collect::<Vec<_>>(),
            ["0.5", "1", "2", "5", "10", "20"]
        );
    }

    #[test]
    fn values_lie_between_the_axes() {
        let panels =
            vec![panel(&[0.0, 5.0, 10.0], false), panel(&[1.0, 0.0, f64::NAN], true), panel(&[], false)];
        let plot = Plot {
            file: "plot".to_owned(),
            title: "a & b".to_owned(),
            x_label: "frame".to_owned(),
            x_step: 5.0,
            panels,
        };
        let svg = plot.to_svg();
        // Three values, 5 apart.
        assert!(svg.contains(&format!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">10<",
            WIDTH - RIGHT,
            TOP + PANEL + 17.0
        )));
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
        assert!(svg.contains("a &amp; b") && svg.contains("a &lt; b") && svg.contains("rate (1/s)"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        // The first panel's line runs from its lower left corner to the right edge, 1/1.08 of the way up.
        let top = TOP + PANEL * (1.0 - 1.0 / 1.08);
        assert!(svg.contains(&format!("points=\"{LEFT:.1},{:.1} ", TOP + PANEL)), "{svg}");
        assert!(svg.contains(&format!("{:.1},{top:.1}\"", WIDTH - RIGHT)), "{svg}");
    }
}
