//! The colour bar: which colour a value has, and how opaque it is drawn.

use chronoxel_core::{Image8, ResolvedTransfer};

use super::canvas::{Rect, draw_line, draw_outline, fill_rect};
use super::text::{draw_text, fitted, measured};
use super::ticks::{Ticks, title};
use super::{Label, Style};

/// A colour bar along the right edge of a picture.
///
/// The strip shows the colours as they are, whatever their opacity; the profile on its left is as wide as the
/// opacity of each value, in parts of the largest one.
#[derive(Debug, Clone, Copy)]
pub struct ColorBar<'a> {
    /// The transfer function that was drawn.
    pub transfer: &'a ResolvedTransfer,
    /// The values at the lower and the upper end.
    pub range: [f64; 2],
    /// The variable's name.
    pub name: &'a str,
    /// Its units; empty where they are not known.
    pub units: &'a str,
}

/// Where the parts of a colour bar lie.
struct Layout {
    strip: Rect,
    profile_width: f32,
    title: Rect,
    title_text: String,
    ticks: Ticks,
}

impl ColorBar<'_> {
    /// Draws it; returns what was written.
    pub fn draw(&self, image: &mut Image8, style: &Style) -> Vec<Label> {
        let layout = self.layout(image, style);
        self.draw_colors(image, style, &layout);
        let strip = layout.strip;
        draw_outline(image, &strip, style.line_width, style.ink);
        let mut labels = vec![draw_text(image, &layout.title_text, layout.title, style)];
        for (value, text) in layout.ticks.values.iter().zip(&layout.ticks.labels) {
            let y = f64::from(strip.y1) - self.fraction(*value) * f64::from(strip.y1 - strip.y0);
            let x = f64::from(strip.x1);
            let length = f64::from(0.32 * style.em);
            draw_line(image, [x, y], [x + length, y], style.line_width, style.ink, 1.0);
            let [width, height] = measured(text, style.em);
            let left = strip.x1 + 0.6 * style.em;
            let rect =
                Rect { x0: left, x1: left + width, y0: y as f32 - 0.5 * height, y1: y as f32 + 0.5 * height };
            labels.push(draw_text(image, text, rect, style));
        }
        labels
    }

    /// The areas that [`Self::draw`] covers, its title and the bar with its numbers, for others to keep clear of.
    pub fn areas(&self, image: &Image8, style: &Style) -> [Rect; 2] {
        let Layout { strip, profile_width, title, ticks, .. } = self.layout(image, style);
        let bar = Rect {
            x0: strip.x0 - profile_width,
            x1: strip.x1 + 0.6 * style.em + widest_label(&ticks, style),
            y0: strip.y0 - 0.5 * style.em,
            y1: strip.y1 + 0.5 * style.em,
        };
        [title, bar].map(|rect| rect.grown(0.4 * style.em))
    }

    fn layout(&self, image: &Image8, style: &Style) -> Layout {
        let (width, height) = (image.width as f32, image.height as f32);
        let em = style.em;
        let bar_height = (0.52 * height).round();
        let max_ticks = ((bar_height / (2.2 * em)) as usize).clamp(2, 7);
        let ticks = Ticks::new(self.range[0], self.range[1], max_ticks);
        let title_text =
            fitted(&title(self.name, self.units, ticks.exponent), em, (0.7 * width).min(width - 2.0 * em));
        let right = width - em;
        let x1 = (right - widest_label(&ticks, style) - 0.6 * em).round();
        let y0 = (0.5 * (height - bar_height) + 0.8 * em).round();
        let strip = Rect { x0: x1 - (1.1 * em).round(), x1, y0, y1: y0 + bar_height };
        let profile_width = (1.3 * em).round();
        let body_centre = 0.5 * (strip.x0 - profile_width + right);
        let [title_width, title_height] = measured(&title_text, em);
        let inside = Rect { x0: em, y0: em, x1: right, y1: height };
        let title = Rect::around([body_centre, y0 - 1.3 * em], [title_width, title_height]);
        Layout { strip, profile_width, title: title.moved_into(&inside), title_text, ticks }
    }

    /// How far up the bar a value lies, 0 to 1.
    fn fraction(&self, value: f64) -> f64 {
        let extent = self.range[1] - self.range[0];
        if extent > 0.0 { ((value - self.range[0]) / extent).clamp(0.0, 1.0) } else { 0.5 }
    }

    fn draw_colors(&self, image: &mut Image8, style: &Style, layout: &Layout) {
        let strip = layout.strip;
        let num_rows = (strip.y1 - strip.y0) as usize;
        let value = |row: usize| {
            let up = 1.0 - (row as f64 + 0.5) / num_rows as f64;
            self.range[0] + up * (self.range[1] - self.range[0])
        };
        let rows: Vec<[f64; 4]> = (0..num_rows).map(|row| self.transfer.evaluate(value(row))).collect();
        let largest = rows.iter().map(|row| row[3]).fold(0.0, f64::max);
        for (row, [r, g, b, opacity]) in rows.into_iter().enumerate() {
            let color = [r, g, b].map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8);
            let (y0, y1) = (strip.y0 + row as f32, strip.y0 + row as f32 + 1.0);
            fill_rect(image, &Rect { y0, y1, ..strip }, color, 1.0);
            let share = if largest > 0.0 { (opacity / largest) as f32 } else { 0.0 };
            let x0 = strip.x0 - share * layout.profile_width;
            fill_rect(image, &Rect { x0, x1: strip.x0, y0, y1 }, color, 1.0);
            if share > 0.0 {
                let edge = style.line_width * 0.8;
                fill_rect(image, &Rect { x0: x0 - edge, x1: x0, y0, y1 }, style.ink, 0.55);
            }
        }
    }
}

/// Width of the widest label of a colour bar.
fn widest_label(ticks: &Ticks, style: &Style) -> f32 {
    ticks.labels.iter().map(|label| measured(label, style.em)[0]).fold(0.0, f32::max)
}
