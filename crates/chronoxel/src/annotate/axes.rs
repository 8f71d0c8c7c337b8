//! The box of a grid with ticks, numbers and names of its axes.

use chronoxel_core::{Camera, Image8, Projection};

use super::canvas::{Rect, draw_line};
use super::text::{draw_text, fitted, measured};
use super::ticks::{Ticks, title};
use super::{Label, Style};

/// The edges of a box in the world.
///
/// The edges behind the box are drawn before the volume is composited over the picture, those of its outline
/// after; the edges in front of the box are left out, so that nothing crosses the volume.
#[derive(Debug, Clone, Copy)]
pub struct AxesBox<'a> {
    /// The camera that took the picture.
    pub camera: &'a Camera,
    /// Lowest and highest corner, world units.
    pub bounds: [[f64; 3]; 2],
    /// Names of the axes.
    pub names: [&'a str; 3],
    /// Units of the world; empty where they are not known.
    pub units: &'a str,
}

/// Where an edge lies among the faces that it joins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Behind,
    Outline,
    InFront,
}

/// One of the twelve edges: along an axis, at the low or high side of the other two.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Edge {
    axis: usize,
    sides: [usize; 2],
    /// Its ends in the picture, that of the lower coordinate first.
    ends: [[f64; 2]; 2],
    place: Place,
}

impl AxesBox<'_> {
    /// Draws the edges behind the box; to be called before the volume is composited.
    pub fn draw_behind(&self, image: &mut Image8, style: &Style) {
        for edge in self.edges(image).iter().filter(|edge| edge.place == Place::Behind) {
            draw_line(image, edge.ends[0], edge.ends[1], style.line_width, style.ink, 0.55);
        }
    }

    /// Draws the outline, ticks, numbers and names, keeping clear of `occupied`; returns what was written.
    pub fn draw_outline(&self, image: &mut Image8, style: &Style, occupied: &[Rect]) -> Vec<Label> {
        let edges = self.edges(image);
        for edge in edges.iter().filter(|edge| edge.place == Place::Outline) {
            draw_line(image, edge.ends[0], edge.ends[1], style.line_width, style.ink, 0.9);
        }
        let mut writer = Writer::new(image, style, occupied);
        let centre = self.centre(&edges);
        let rulers: Vec<Ruler> =
            (0..3).filter_map(|axis| self.ruler(&edges, axis, centre, writer.image, style)).collect();
        let reaches: Vec<f64> = rulers.iter().map(|ruler| ruler.write_numbers(self, &mut writer)).collect();
        for (ruler, reach) in rulers.iter().zip(reaches) {
            ruler.write_name(self, &mut writer, reach);
        }
        writer.labels
    }

    /// The twelve edges, as far as they lie before the camera.
    fn edges(&self, image: &Image8) -> Vec<Edge> {
        let mut edges = Vec::with_capacity(12);
        for (axis, others) in OTHERS.into_iter().enumerate() {
            for sides in [[0, 0], [1, 0], [1, 1], [0, 1]] {
                let (from, to) = (self.edge_point(axis, sides, 0.0), self.edge_point(axis, sides, 1.0));
                let Some(ends) = self.projected_segment(from, to, image) else { continue };
                let facing = [0, 1].map(|i| self.faces_camera(others[i], sides[i]));
                let place = match facing {
                    [false, false] => Place::Behind,
                    [true, true] => Place::InFront,
                    _ => Place::Outline,
                };
                edges.push(Edge { axis, sides, ends, place });
            }
        }
        edges
    }

    /// The point of an edge at a fraction of its length.
    fn edge_point(&self, axis: usize, sides: [usize; 2], fraction: f64) -> [f64; 3] {
        let mut point = [0.0; 3];
        point[axis] = self.bounds[0][axis] * (1.0 - fraction) + self.bounds[1][axis] * fraction;
        for (other, side) in OTHERS[axis].into_iter().zip(sides) {
            point[other] = self.bounds[side][other];
        }
        point
    }

    /// Whether the outer side of a face is seen.
    fn faces_camera(&self, axis: usize, side: usize) -> bool {
        let outward = if side == 1 { 1.0 } else { -1.0 };
        let towards = match self.camera.projection() {
            Projection::Perspective { .. } => self.camera.position()[axis] - self.bounds[side][axis],
            Projection::Orthographic { .. } => -self.camera.axes()[2][axis],
        };
        outward * towards > 1e-12
    }

    /// A segment in the picture, cut where it passes behind a perspective camera.
    fn projected_segment(&self, from: [f64; 3], to: [f64; 3], image: &Image8) -> Option<[[f64; 2]; 2]> {
        let forward = self.camera.axes()[2];
        let depth =
            |p: [f64; 3]| (0..3).map(|a| (p[a] - self.camera.position()[a]) * forward[a]).sum::<f64>();
        let (mut ends, depths) = ([from, to], [depth(from), depth(to)]);
        if matches!(self.camera.projection(), Projection::Perspective { .. }) {
            let near = 1e-4 * depths[0].abs().max(depths[1].abs());
            for i in 0..2 {
                if depths[i] < near {
                    let t = (near - depths[i]) / (depths[1 - i] - depths[i]);
                    if !(0.0..=1.0).contains(&t) {
                        return None;
                    }
                    let other = [to, from][i];
                    let start = [from, to][i];
                    ends[i] = std::array::from_fn(|a| start[a] + t * (other[a] - start[a]));
                }
            }
        }
        let size = [image.width, image.height];
        let flat = |p: [f64; 3]| self.camera.project(p, size).map(|[x, y, _]| [x, y]);
        Some([flat(ends[0])?, flat(ends[1])?])
    }

    /// The middle of the outline in the picture.
    fn centre(&self, edges: &[Edge]) -> [f64; 2] {
        let ends: Vec<[f64; 2]> = edges.iter().flat_map(|edge| edge.ends).collect();
        let num = ends.len().max(1) as f64;
        [0, 1].map(|a| ends.iter().map(|end| end[a]).sum::<f64>() / num)
    }

    /// The edge that carries an axis' numbers: of the outline, long enough, and low or left in the picture.
    fn ruler(
        &self,
        edges: &[Edge],
        axis: usize,
        centre: [f64; 2],
        image: &Image8,
        style: &Style,
    ) -> Option<Ruler> {
        let size = [image.width as f64, image.height as f64];
        let inside = |p: &[f64; 2]| (0..2).all(|a| (0.0..=size[a]).contains(&p[a]));
        let long = |edge: &&Edge| distance(edge.ends[0], edge.ends[1]) > 2.5 * f64::from(style.em);
        let score = |edge: &Edge| {
            let middle = middle(edge.ends[0], edge.ends[1]);
            let visible = edge.ends.iter().filter(|end| inside(end)).count() as f64;
            visible * 10.0 * (size[0] + size[1]) + middle[1] - 0.4 * middle[0]
        };
        let edge = edges
            .iter()
            .filter(|edge| edge.axis == axis && edge.place == Place::Outline)
            .filter(long)
            .max_by(|a, b| score(a).total_cmp(&score(b)))?;
        Some(Ruler { edge: *edge, normal: outward_normal(edge.ends, centre) })
    }
}

/// The other two axes of each axis.
const OTHERS: [[usize; 2]; 3] = [[1, 2], [0, 2], [0, 1]];

/// The edge that an axis is read from.
struct Ruler {
    edge: Edge,
    /// Unit vector in the picture, away from the box.
    normal: [f64; 2],
}

impl Ruler {
    /// Draws ticks and numbers; returns how far they reach from the edge, in pixels.
    fn write_numbers(&self, axes: &AxesBox<'_>, writer: &mut Writer<'_>) -> f64 {
        let em = f64::from(writer.style.em);
        let ticks = self.ticks(axes, writer);
        let mut reach = 0.8 * em;
        for (point, text) in self.tick_points(axes, &ticks, writer.image).into_iter().zip(&ticks.labels) {
            let rect = self.beside(point, 0.75 * em, measured(text, writer.style.em));
            if !writer.fits(&rect, 0.6 * writer.style.em) {
                continue;
            }
            let end = along(point, self.normal, 0.4 * em);
            draw_line(writer.image, point, end, writer.style.line_width, writer.style.ink, 0.9);
            writer.write(text, rect);
            reach = reach.max(0.75 * em + thickness(self.normal, measured(text, writer.style.em)));
        }
        reach
    }

    /// Writes the axis' name beyond the numbers, at the first place along the edge where it fits.
    fn write_name(&self, axes: &AxesBox<'_>, writer: &mut Writer<'_>, reach: f64) {
        let em = f64::from(writer.style.em);
        let exponent = self.ticks(axes, writer).exponent;
        let text = title(axes.names[self.edge.axis], axes.units, exponent);
        let text = fitted(&text, writer.style.em, 0.5 * writer.image.width as f32);
        let size = measured(&text, writer.style.em);
        let candidates = self.name_places(reach, size, em);
        let slack = 1.5 * writer.style.em;
        if let Some(rect) = candidates.into_iter().find(|rect| writer.fits(rect, slack)) {
            writer.write(&text, rect);
        }
    }

    /// Where a name may stand, best first: beyond the numbers, else before or after the ends of the edge.
    fn name_places(&self, reach: f64, size: [f32; 2], em: f64) -> Vec<Rect> {
        let [from, to] = self.edge.ends;
        let mut places = Vec::new();
        for gap in [0.6, 0.3, 1.2, 2.0, 3.0] {
            for fraction in [0.5, 0.4, 0.6, 0.3, 0.7, 0.15, 0.85] {
                let point = [0, 1].map(|a| from[a] + fraction * (to[a] - from[a]));
                places.push(self.beside(point, reach + gap * em, size));
            }
        }
        let length = distance(from, to);
        let forward = [0, 1].map(|a| (to[a] - from[a]) / length);
        let backward = forward.map(|c| -c);
        for gap in [0.9, 1.6, 2.6] {
            for (end, direction) in [(to, forward), (from, backward)] {
                let beyond = gap * em + 0.5 * thickness(direction, size);
                places.push(Rect::around(along(end, direction, beyond).map(|c| c as f32), size));
            }
        }
        places
    }

    /// As many ticks as the edge has room for.
    fn ticks(&self, axes: &AxesBox<'_>, writer: &Writer<'_>) -> Ticks {
        let em = f64::from(writer.style.em);
        let [low, high] = [0, 1].map(|side| axes.bounds[side][self.edge.axis]);
        let room = (distance(self.edge.ends[0], self.edge.ends[1]) / (1.8 * em)) as usize;
        for max_ticks in (2..=room.clamp(2, 8)).rev() {
            let ticks = Ticks::new(low, high, max_ticks);
            let points = self.tick_points(axes, &ticks, writer.image);
            let rects: Vec<Rect> = points
                .into_iter()
                .zip(&ticks.labels)
                .map(|(point, text)| self.beside(point, 0.75 * em, measured(text, writer.style.em)))
                .map(|rect| rect.grown(0.35 * writer.style.em))
                .collect();
            if rects.windows(2).all(|pair| !pair[0].intersects(&pair[1])) {
                return ticks;
            }
        }
        Ticks::new(low, high, 2)
    }

    /// Ticks in the picture.
    fn tick_points(&self, axes: &AxesBox<'_>, ticks: &Ticks, image: &Image8) -> Vec<[f64; 2]> {
        let [low, high] = [0, 1].map(|side| axes.bounds[side][self.edge.axis]);
        let size = [image.width, image.height];
        let point = |value: &f64| {
            let fraction = if high > low { (value - low) / (high - low) } else { 0.0 };
            let world = axes.edge_point(self.edge.axis, self.edge.sides, fraction);
            axes.camera.project(world, size).map_or([f64::NAN; 2], |[x, y, _]| [x, y])
        };
        ticks.values.iter().map(point).collect()
    }

    /// A box of text whose near side is `gap` pixels away from a point of the edge.
    fn beside(&self, point: [f64; 2], gap: f64, size: [f32; 2]) -> Rect {
        let centre = along(point, self.normal, gap + 0.5 * thickness(self.normal, size));
        Rect::around(centre.map(|c| c as f32), size)
    }
}

/// Writes text where nothing else is.
struct Writer<'a> {
    image: &'a mut Image8,
    style: &'a Style,
    occupied: Vec<Rect>,
    labels: Vec<Label>,
}

impl<'a> Writer<'a> {
    fn new(image: &'a mut Image8, style: &'a Style, occupied: &[Rect]) -> Self {
        Self { image, style, occupied: occupied.to_vec(), labels: Vec::new() }
    }

    /// Where a box lies once it is moved into the picture by at most `slack` pixels.
    fn placed(&self, rect: &Rect, slack: f32) -> Option<Rect> {
        let inside = Rect::of_picture(self.image).grown(-0.4 * self.style.em);
        let moved = rect.moved_into(&inside);
        let shift = (moved.x0 - rect.x0).abs().max((moved.y0 - rect.y0).abs());
        (shift <= slack && inside.contains(&moved.grown(-0.01))).then_some(moved)
    }

    fn fits(&self, rect: &Rect, slack: f32) -> bool {
        let free = |moved: Rect| {
            let around = moved.grown(0.2 * self.style.em);
            self.occupied.iter().all(|taken| !taken.intersects(&around))
        };
        self.placed(rect, slack).is_some_and(free)
    }

    fn write(&mut self, text: &str, rect: Rect) {
        let Some(rect) = self.placed(&rect, f32::INFINITY) else { return };
        self.occupied.push(rect);
        self.labels.push(draw_text(self.image, text, rect, self.style));
    }
}

/// How far a box of text extends along a unit vector.
fn thickness(direction: [f64; 2], [width, height]: [f32; 2]) -> f64 {
    direction[0].abs() * f64::from(width) + direction[1].abs() * f64::from(height)
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn middle(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])]
}

fn along(point: [f64; 2], direction: [f64; 2], length: f64) -> [f64; 2] {
    [point[0] + length * direction[0], point[1] + length * direction[1]]
}

/// The unit normal of a segment that points away from `centre`.
fn outward_normal([from, to]: [[f64; 2]; 2], centre: [f64; 2]) -> [f64; 2] {
    let length = distance(from, to);
    let normal = [(to[1] - from[1]) / length, (from[0] - to[0]) / length];
    let middle = middle(from, to);
    let away = normal[0] * (middle[0] - centre[0]) + normal[1] * (middle[1] - centre[1]);
    if away < 0.0 { normal.map(|c| -c) } else { normal }
}
