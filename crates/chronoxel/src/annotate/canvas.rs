//! Antialiased lines and rectangles on a picture.

use chronoxel_core::Image8;

/// A rectangle in pixels: left, top, right, bottom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rect {
    /// Left edge.
    pub x0: f32,
    /// Upper edge.
    pub y0: f32,
    /// Right edge.
    pub x1: f32,
    /// Lower edge.
    pub y1: f32,
}

impl Rect {
    /// A rectangle around a centre.
    pub(super) fn around([x, y]: [f32; 2], [width, height]: [f32; 2]) -> Self {
        Self { x0: x - 0.5 * width, y0: y - 0.5 * height, x1: x + 0.5 * width, y1: y + 0.5 * height }
    }

    /// The whole of a picture.
    pub(super) fn of_picture(image: &Image8) -> Self {
        Self { x0: 0.0, y0: 0.0, x1: image.width as f32, y1: image.height as f32 }
    }

    /// Whether two rectangles share an area.
    pub fn intersects(&self, other: &Self) -> bool {
        self.x0 < other.x1 && other.x0 < self.x1 && self.y0 < other.y1 && other.y0 < self.y1
    }

    /// Whether another lies wholly inside.
    pub fn contains(&self, other: &Self) -> bool {
        self.x0 <= other.x0 && self.y0 <= other.y0 && self.x1 >= other.x1 && self.y1 >= other.y1
    }

    /// Grown by a margin on every side.
    pub(super) fn grown(&self, margin: f32) -> Self {
        Self { x0: self.x0 - margin, y0: self.y0 - margin, x1: self.x1 + margin, y1: self.y1 + margin }
    }

    /// Moved by the least that brings it inside another, as far as it fits.
    pub(super) fn moved_into(&self, outer: &Self) -> Self {
        let shift = |low: f32, high: f32, min: f32, max: f32| (min - low).max(0.0f32.min(max - high));
        let (dx, dy) =
            (shift(self.x0, self.x1, outer.x0, outer.x1), shift(self.y0, self.y1, outer.y0, outer.y1));
        Self { x0: self.x0 + dx, y0: self.y0 + dy, x1: self.x1 + dx, y1: self.y1 + dy }
    }
}

/// Draws a line with round ends; each pixel is covered by how far its centre lies inside.
///
/// * `width`: pixels, > 0
/// * `opacity`: in [0, 1]
pub(super) fn draw_line(
    image: &mut Image8,
    from: [f64; 2],
    to: [f64; 2],
    width: f32,
    color: [u8; 3],
    opacity: f32,
) {
    let reach = f64::from(width) * 0.5 + 1.0;
    let size = [image.width as f64, image.height as f64];
    let Some((from, to)) = clipped(from, to, size, reach) else { return };
    let delta = [to[0] - from[0], to[1] - from[1]];
    let length_squared = delta[0] * delta[0] + delta[1] * delta[1];
    // Walk along the longer axis; across it, the line covers `reach` in its normal direction.
    let (along, across) = if delta[0].abs() >= delta[1].abs() { (0, 1) } else { (1, 0) };
    let slope = if delta[along] == 0.0 { 0.0 } else { delta[across] / delta[along] };
    let window = reach * (1.0 + slope * slope).sqrt() + 1.0;
    let (first, last) = (from[along].min(to[along]) - reach, from[along].max(to[along]) + reach);
    for step in first.floor() as i64..=last.ceil() as i64 {
        let position = (step as f64 + 0.5).clamp(from[along].min(to[along]), from[along].max(to[along]));
        let centre = from[across] + slope * (position - from[along]);
        for side in (centre - window).floor() as i64..=(centre + window).ceil() as i64 {
            let mut pixel = [0; 2];
            (pixel[along], pixel[across]) = (step, side);
            let point = pixel.map(|c| c as f64 + 0.5);
            let relative = [point[0] - from[0], point[1] - from[1]];
            let dot = relative[0] * delta[0] + relative[1] * delta[1];
            let t = if length_squared > 0.0 { (dot / length_squared).clamp(0.0, 1.0) } else { 0.0 };
            let away = [relative[0] - t * delta[0], relative[1] - t * delta[1]];
            let distance = (away[0] * away[0] + away[1] * away[1]).sqrt();
            let coverage = (f64::from(width) * 0.5 + 0.5 - distance).clamp(0.0, 1.0);
            image.blend(pixel[0], pixel[1], color, coverage as f32 * opacity);
        }
    }
}

/// The part of a segment within `margin` of a picture (Liang and Barsky 1984).
fn clipped(from: [f64; 2], to: [f64; 2], size: [f64; 2], margin: f64) -> Option<([f64; 2], [f64; 2])> {
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    for axis in 0..2 {
        let delta = to[axis] - from[axis];
        let bounds = [-margin - from[axis], size[axis] + margin - from[axis]];
        if !delta.is_finite() || !from[axis].is_finite() {
            return None;
        }
        if delta == 0.0 {
            if bounds[0] > 0.0 || bounds[1] < 0.0 {
                return None;
            }
            continue;
        }
        let (a, b) = (bounds[0] / delta, bounds[1] / delta);
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    let at = |t: f64| [from[0] + t * (to[0] - from[0]), from[1] + t * (to[1] - from[1])];
    (enter <= leave).then(|| (at(enter), at(leave)))
}

/// Fills a rectangle; pixels at its edges are covered in part.
pub(super) fn fill_rect(image: &mut Image8, rect: &Rect, color: [u8; 3], opacity: f32) {
    for y in rect.y0.max(0.0).floor() as i64..rect.y1.min(image.height as f32).ceil() as i64 {
        let high = (rect.y1 - y as f32).min(1.0) - (rect.y0 - y as f32).max(0.0);
        for x in rect.x0.max(0.0).floor() as i64..rect.x1.min(image.width as f32).ceil() as i64 {
            let wide = (rect.x1 - x as f32).min(1.0) - (rect.x0 - x as f32).max(0.0);
            image.blend(x, y, color, high.max(0.0) * wide.max(0.0) * opacity);
        }
    }
}

/// Draws the outline of a rectangle.
pub(super) fn draw_outline(image: &mut Image8, rect: &Rect, width: f32, color: [u8; 3]) {
    let half = 0.5 * width;
    let (outer, inner) = (rect.grown(half), rect.grown(-half));
    for side in [
        Rect { y1: inner.y0, ..outer },
        Rect { y0: inner.y1, ..outer },
        Rect { x1: inner.x0, y0: inner.y0, y1: inner.y1, ..outer },
        Rect { x0: inner.x1, y0: inner.y0, y1: inner.y1, ..outer },
    ] {
        fill_rect(image, &side, color, 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sum of coverages: the area of what was drawn.
    fn area(image: &Image8) -> f64 {
        image.pixels.iter().map(|p| f64::from(p[0]) / 255.0).sum()
    }

    #[test]
    fn a_line_covers_its_area() {
        for to in [[80.0, 20.0], [20.0, 80.0], [75.0, 75.0], [33.3, 81.7]] {
            let mut image = Image8::filled(100, 100, [0, 0, 0, 255]);
            draw_line(&mut image, [20.0, 20.0], to, 3.0, [255; 3], 1.0);
            let length = f64::hypot(to[0] - 20.0, to[1] - 20.0);
            // A band of the width, and the two round ends with it.
            let expected = 3.0 * length + std::f64::consts::PI * 1.5 * 1.5;
            assert!((area(&image) - expected).abs() < 0.02 * expected, "{} {expected}", area(&image));
        }
    }

    #[test]
    fn lines_far_outside_cost_nothing_and_draw_what_is_inside() {
        let mut image = Image8::filled(40, 40, [0, 0, 0, 255]);
        draw_line(&mut image, [-1e12, 20.0], [1e12, 20.0], 2.0, [255; 3], 1.0);
        assert!((area(&image) - 80.0).abs() < 1.0, "{}", area(&image));
        draw_line(&mut image, [f64::NAN, 0.0], [1.0, f64::INFINITY], 2.0, [255; 3], 1.0);
        draw_line(&mut image, [1e9, 1e9], [2e9, 1e9], 2.0, [255; 3], 1.0);
        assert!((area(&image) - 80.0).abs() < 1.0);
    }

    #[test]
    fn rectangles_cover_parts_of_pixels() {
        let mut image = Image8::filled(10, 10, [0, 0, 0, 255]);
        fill_rect(&mut image, &Rect { x0: 2.5, y0: 3.0, x1: 5.0, y1: 4.5 }, [255; 3], 1.0);
        assert!((area(&image) - 2.5 * 1.5).abs() < 0.02);
        fill_rect(&mut image, &Rect { x0: -9.0, y0: -9.0, x1: -1.0, y1: 99.0 }, [255; 3], 1.0);
        assert!((area(&image) - 2.5 * 1.5).abs() < 0.02);
    }

    #[test]
    fn rectangles_move_by_the_least() {
        let outer = Rect { x0: 0.0, y0: 0.0, x1: 10.0, y1: 10.0 };
        let moved = Rect { x0: -2.0, y0: 9.0, x1: 1.0, y1: 12.0 }.moved_into(&outer);
        assert_eq!(moved, Rect { x0: 0.0, y0: 7.0, x1: 3.0, y1: 10.0 });
        assert!(outer.contains(&moved) && !outer.contains(&moved.grown(0.1)));
    }
}
