//! One line of text: its size, and its pixels.

use std::sync::LazyLock;

use ab_glyph::{Font, FontRef, Glyph, PxScale, ScaleFont, point};
use chronoxel_core::Image8;

use super::canvas::Rect;
use super::{Label, Style};

static FONT: LazyLock<FontRef<'static>> = LazyLock::new(|| {
    FontRef::try_from_slice(dejavu::sans::regular()).expect("the font that is built in is a font")
});

/// Width of the rim around text, in ems.
const RIM_EMS: f32 = 0.16;

/// The glyphs of a line of text on a baseline at 0, and how far they advance.
fn laid_out(text: &str, em: f32) -> (Vec<Glyph>, f32) {
    let units_per_em = FONT.units_per_em().unwrap_or(1000.0);
    let scale = PxScale::from(em * FONT.height_unscaled() / units_per_em);
    let font = FONT.as_scaled(scale);
    let (mut glyphs, mut advance, mut previous) = (Vec::new(), 0.0, None);
    for id in text.chars().filter(|c| !c.is_control()).map(|c| font.glyph_id(c)) {
        if let Some(previous) = previous.replace(id) {
            advance += font.kern(previous, id);
        }
        glyphs.push(id.with_scale_and_position(scale, point(advance, 0.0)));
        advance += font.h_advance(id);
    }
    (glyphs, advance)
}

/// Width and height of a line of text; the height is that of digits and capitals.
pub(super) fn measured(text: &str, em: f32) -> [f32; 2] {
    [laid_out(text, em).1, 0.73 * em]
}

/// The text, cut with an ellipsis where it is wider than `max_width` pixels.
pub(super) fn fitted(text: &str, em: f32, max_width: f32) -> String {
    if measured(text, em)[0] <= max_width {
        return text.to_owned();
    }
    let mut kept: Vec<char> = text.chars().take(400).collect();
    while !kept.is_empty() {
        kept.pop();
        let shorter = kept.iter().collect::<String>().trim_end().to_owned() + "…";
        if measured(&shorter, em)[0] <= max_width {
            return shorter;
        }
    }
    String::new()
}

/// Writes a line of text into a box that [`measured`] gave the size of, with a rim of the background's colour.
pub(super) fn draw_text(image: &mut Image8, text: &str, rect: Rect, style: &Style) -> Label {
    let (glyphs, advance) = laid_out(text, style.em);
    let rim = RIM_EMS * style.em;
    // Whole pixels, so that equal labels look equal and digits stay crisp.
    let (left, baseline) = (rect.x0.round() as i64, rect.y1.round() as i64);
    let margin = rim.ceil() as i64 + 2;
    let width = advance.ceil() as i64 + 2 * margin;
    let (above, below) = ((1.1 * style.em).ceil() as i64 + margin, (0.4 * style.em).ceil() as i64 + margin);
    let mut mask = Mask::new(width as usize, (above + below) as usize);
    for outlined in glyphs.into_iter().filter_map(|glyph| FONT.outline_glyph(glyph)) {
        let bounds = outlined.px_bounds();
        let (x0, y0) = (bounds.min.x as i64 + margin, bounds.min.y as i64 + above);
        outlined.draw(|x, y, coverage| mask.add(x0 + i64::from(x), y0 + i64::from(y), coverage));
    }
    let origin = [left - margin, baseline - above];
    mask.widened(rim).paint(image, origin, style.paper, 0.75);
    mask.paint(image, origin, style.ink, 1.0);
    Label { text: text.to_owned(), rect }
}

/// How much each pixel of a box is covered.
struct Mask {
    width: usize,
    height: usize,
    coverage: Vec<f32>,
}

impl Mask {
    fn new(width: usize, height: usize) -> Self {
        Self { width, height, coverage: vec![0.0; width * height] }
    }

    fn add(&mut self, x: i64, y: i64, coverage: f32) {
        let inside = |v: i64, n: usize| usize::try_from(v).ok().filter(|v| *v < n);
        if let (Some(x), Some(y)) = (inside(x, self.width), inside(y, self.height)) {
            let pixel = &mut self.coverage[y * self.width + x];
            *pixel = (*pixel + coverage).min(1.0);
        }
    }

    /// Every covered pixel grown to a disc with a soft edge.
    fn widened(&self, radius: f32) -> Self {
        let mut wide = Self::new(self.width, self.height);
        let reach = radius.ceil() as i64;
        let disc: Vec<(i64, i64, f32)> = (-reach..=reach)
            .flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)))
            .map(|(dx, dy)| {
                let distance = ((dx * dx + dy * dy) as f32).sqrt();
                (dx, dy, (radius + 0.5 - distance).clamp(0.0, 1.0))
            })
            .filter(|(_, _, weight)| *weight > 0.0)
            .collect();
        for (i, &coverage) in self.coverage.iter().enumerate().filter(|(_, coverage)| **coverage > 0.0) {
            let (x, y) = ((i % self.width) as i64, (i / self.width) as i64);
            for (dx, dy, weight) in &disc {
                let (x, y) = (x + dx, y + dy);
                if (0..self.width as i64).contains(&x) && (0..self.height as i64).contains(&y) {
                    let pixel = &mut wide.coverage[y as usize * self.width + x as usize];
                    *pixel = pixel.max(coverage * weight);
                }
            }
        }
        wide
    }

    fn paint(&self, image: &mut Image8, [left, top]: [i64; 2], color: [u8; 3], opacity: f32) {
        for (i, &coverage) in self.coverage.iter().enumerate().filter(|(_, coverage)| **coverage > 0.0) {
            let (x, y) = ((i % self.width) as i64, (i / self.width) as i64);
            image.blend(left + x, top + y, color, coverage * opacity);
        }
    }
}
