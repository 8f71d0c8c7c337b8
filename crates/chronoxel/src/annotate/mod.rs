//! What is written on a picture: an axes box, a colour bar, the time.
//!
//! Everything is antialiased and scales with the picture. Text is set in DejaVu Sans (Bitstream Vera licence), so
//! units with Greek letters and raised digits come out right. The same input gives the same pixels everywhere.

mod axes;
mod canvas;
mod color_bar;
#[cfg(test)]
mod tests;
mod text;
mod ticks;
mod time_label;

use chronoxel_core::Background;

pub use axes::AxesBox;
pub use canvas::Rect;
pub use color_bar::ColorBar;
pub use time_label::TimeLabel;

/// Colours and sizes of annotations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Style {
    /// sRGB of lines and text.
    pub ink: [u8; 3],
    /// sRGB of the rim around text, which keeps it legible over anything.
    pub paper: [u8; 3],
    /// Size of the font (its em), in pixels.
    pub em: f32,
    /// Width of lines, in pixels.
    pub line_width: f32,
}

impl Style {
    /// The style that suits a picture of a size before a background: light on dark, dark on light or on nothing.
    pub fn for_picture(size: [usize; 2], background: Background) -> Self {
        let dark = match background {
            Background::Color([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b < 0.5,
            Background::Transparent => false,
        };
        let paper = match background {
            Background::Color(color) => color.map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8),
            Background::Transparent => [255; 3],
        };
        let shorter = size[0].min(size[1]) as f32;
        let em = (0.0215 * shorter + 0.6).max(9.0);
        let ink = if dark { [236, 236, 236] } else { [26, 26, 26] };
        Self { ink, paper, em, line_width: (em / 13.0).max(1.0) }
    }
}

/// A piece of text that was written, and where.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    /// The text as written.
    pub text: String,
    /// The box around it, in pixels.
    pub rect: Rect,
}
