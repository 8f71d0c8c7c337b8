//! Cameras: where a picture is taken from, and the ray of each pixel.

use serde_json::Value;

use crate::CoreError;

/// How a camera maps the world to the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projection {
    /// Rays from one point; the angle between the picture's lower and upper edge, in degrees.
    Perspective {
        /// Between 0.001 and 179.
        fov_y_deg: f64,
    },
    /// Parallel rays; world length between the picture's lower and upper edge.
    Orthographic {
        /// Finite and positive.
        height: f64,
    },
}

/// A camera that was checked: in a right-handed world it looks from `position` towards `look_at`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    position: [f64; 3],
    look_at: [f64; 3],
    up: [f64; 3],
    projection: Projection,
    right_unit: [f64; 3],
    up_unit: [f64; 3],
    forward_unit: [f64; 3],
}

/// A ray in the world; it starts at `origin`, and nothing behind that is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Where it starts.
    pub origin: [f64; 3],
    /// Unit vector.
    pub direction: [f64; 3],
}

impl Camera {
    /// A camera.
    ///
    /// * `up`: any vector that is not parallel to the direction of view
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if a number is not finite, `position` and `look_at` coincide, `up` is
    /// parallel to the direction of view, or the angle or height is out of range.
    pub fn new(
        position: [f64; 3],
        look_at: [f64; 3],
        up: [f64; 3],
        projection: Projection,
    ) -> Result<Self, CoreError> {
        for (field, vector) in
            [("camera's position", position), ("camera's look_at", look_at), ("camera's up", up)]
        {
            if vector.iter().any(|c| c.is_nan() || c.abs() > 1e150) {
                return Err(CoreError::invalid(field, format!("{vector:?}"), "each must be finite"));
            }
        }
        let Some(forward_unit) = unit(sub(look_at, position)) else {
            let value = format!("{look_at:?}");
            return Err(CoreError::invalid("camera's look_at", value, "it must differ from the position"));
        };
        let right = unit(up).map(|up| cross(forward_unit, up)).filter(|r| dot(*r, *r) > 1e-20).and_then(unit);
        let Some(right_unit) = right else {
            let remedy = "it must not be zero or parallel to the direction of view";
            return Err(CoreError::invalid("camera's up", format!("{up:?}"), remedy));
        };
        check_projection(projection)?;
        let up_unit = cross(right_unit, forward_unit);
        Ok(Self { position, look_at, up, projection, right_unit, up_unit, forward_unit })
    }

    /// A camera on a sphere around a box, all of which is in view at zoom 1 from everywhere on the sphere.
    ///
    /// With y up it stands at `centre + distance · (sin az · cos el, sin el, cos az · cos el)`: at azimuth 0 and
    /// elevation 0, x runs to the right and y up.
    ///
    /// * `bounds`: lowest and highest corner, world units
    /// * `zoom`: magnification of the picture, > 0
    /// * `fov_y_deg`: angle of view before the zoom; `None` for an orthographic camera
    /// * `aspect`: width over height of the picture
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if an argument is not finite or out of range.
    pub fn orbit(
        bounds: [[f64; 3]; 2],
        azimuth_deg: f64,
        elevation_deg: f64,
        zoom: f64,
        fov_y_deg: Option<f64>,
        aspect: f64,
    ) -> Result<Self, CoreError> {
        for (field, value) in [("camera's azimuth", azimuth_deg), ("camera's elevation", elevation_deg)] {
            if !value.is_finite() {
                return Err(CoreError::invalid(field, value, "it must be a finite number of degrees"));
            }
        }
        for (field, value) in [("camera's zoom", zoom), ("picture's aspect", aspect)] {
            if !(1e-6..=1e6).contains(&value) {
                return Err(CoreError::invalid(field, value, "use a number between 1e-6 and 1e6"));
            }
        }
        let centre: [f64; 3] = std::array::from_fn(|a| 0.5 * (bounds[0][a] + bounds[1][a]));
        let extent = sub(bounds[1], bounds[0]);
        let radius = Some(0.5 * dot(extent, extent).sqrt()).filter(|r| *r > 0.0).unwrap_or(1.0);
        let (distance, projection) = match fov_y_deg {
            None => {
                (2.0 * radius, Projection::Orthographic { height: 2.0 * radius / (aspect.min(1.0) * zoom) })
            }
            Some(fov_y_deg) => {
                check_projection(Projection::Perspective { fov_y_deg })?;
                let tan_half = (0.5 * fov_y_deg).to_radians().tan();
                let zoomed = 2.0 * (tan_half / zoom).atan().to_degrees();
                let half_angle = (tan_half * aspect.min(1.0)).atan();
                (radius / half_angle.sin(), Projection::Perspective { fov_y_deg: zoomed })
            }
        };
        let ((sin_az, cos_az), (sin_el, cos_el)) =
            (azimuth_deg.to_radians().sin_cos(), elevation_deg.to_radians().sin_cos());
        let outward = [sin_az * cos_el, sin_el, cos_az * cos_el];
        let up = [-sin_az * sin_el, cos_el, -cos_az * sin_el];
        let position = std::array::from_fn(|a| centre[a] + distance * outward[a]);
        Self::new(position, centre, up, projection)
    }

    /// The camera after a turn about the axis through `look_at` along `up`: to the right around what it sees, for
    /// positive angles, as a growing azimuth.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if the angle is not finite.
    pub fn turned(&self, angle_deg: f64) -> Result<Self, CoreError> {
        let length = dot(self.up, self.up).sqrt();
        let axis = self.up.map(|c| c / length);
        let arm = sub(self.position, self.look_at);
        let (sin, cos) = angle_deg.to_radians().sin_cos();
        let across = cross(axis, arm);
        let along = dot(axis, arm) * (1.0 - cos);
        let turned: [f64; 3] =
            std::array::from_fn(|a| self.look_at[a] + arm[a] * cos + across[a] * sin + axis[a] * along);
        Self::new(turned, self.look_at, self.up, self.projection)
    }

    /// A camera from the text of a camera file:
    /// `{"position":[x,y,z],"look_at":[x,y,z],"up":[x,y,z],"fov_y_deg":30}`, or with `"ortho_height"` in place of the
    /// angle. `up` may be left out: y.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] naming the field and the value that cannot be used.
    pub fn from_json(text: &str) -> Result<Self, CoreError> {
        let value: Value = serde_json::from_str(text)
            .map_err(|e| CoreError::invalid("camera file", e, "it must be a JSON object"))?;
        let up = match value.get("up") {
            None => [0.0, 1.0, 0.0],
            Some(_) => vector_of(&value, "up", "camera's up")?,
        };
        let number = |key: &str, field| match value.get(key) {
            None => Ok(None),
            Some(v) => v.as_f64().map(Some).ok_or_else(|| {
                let text: String = v.to_string().chars().take(60).collect();
                CoreError::invalid(field, text, "give a number")
            }),
        };
        let angle = number("fov_y_deg", "camera's fov_y_deg")?;
        let height = number("ortho_height", "camera's ortho_height")?;
        let projection = match (angle, height) {
            (Some(fov_y_deg), None) => Projection::Perspective { fov_y_deg },
            (None, Some(height)) => Projection::Orthographic { height },
            (None, None) => {
                Err(CoreError::invalid("camera's fov_y_deg", "missing", "give fov_y_deg or ortho_height"))?
            }
            (Some(_), Some(height)) => Err(CoreError::invalid(
                "camera's ortho_height",
                format!("{height} beside fov_y_deg"),
                "give one of the two",
            ))?,
        };
        let position = vector_of(&value, "position", "camera's position")?;
        let look_at = vector_of(&value, "look_at", "camera's look_at")?;
        Self::new(position, look_at, up, projection)
    }

    /// Where it stands, world units.
    pub fn position(&self) -> [f64; 3] {
        self.position
    }

    /// The point at the centre of its picture.
    pub fn look_at(&self) -> [f64; 3] {
        self.look_at
    }

    /// The vector that points up in its picture, as given.
    pub fn up(&self) -> [f64; 3] {
        self.up
    }

    /// Its projection.
    pub fn projection(&self) -> Projection {
        self.projection
    }

    /// Unit vectors to the right, up and forward; the third is the direction of view.
    pub fn axes(&self) -> [[f64; 3]; 3] {
        [self.right_unit, self.up_unit, self.forward_unit]
    }

    /// Half the height of the picture: in the world, or at distance 1 for a perspective.
    pub fn half_height(&self) -> f64 {
        match self.projection {
            Projection::Perspective { fov_y_deg } => (0.5 * fov_y_deg).to_radians().tan(),
            Projection::Orthographic { height } => 0.5 * height,
        }
    }

    /// The rays of a picture.
    ///
    /// * `size`: width and height of the picture in pixels, at least 1
    pub fn rays(&self, size: [usize; 2]) -> PictureRays {
        let [width, height] = size.map(|n| n as f64);
        let scale = self.half_height();
        let (right, up) = (scale * width / height, scale);
        PictureRays {
            position: self.position,
            forward: self.forward_unit,
            corner: std::array::from_fn(|a| up * self.up_unit[a] - right * self.right_unit[a]),
            per_column: self.right_unit.map(|c| 2.0 * right / width * c),
            per_row: self.up_unit.map(|c| -2.0 * up / height * c),
            is_perspective: matches!(self.projection, Projection::Perspective { .. }),
        }
    }

    /// One of [`Self::rays`].
    pub fn ray(&self, point: [f64; 2], size: [usize; 2]) -> Ray {
        self.rays(size).ray(point)
    }

    /// Where a point of the world lies in the picture, as `[x, y, depth]`: x and y as in [`Self::ray`], depth along
    /// the direction of view. `None` unless it lies in front of a perspective camera; it may lie outside the picture.
    pub fn project(&self, world: [f64; 3], size: [usize; 2]) -> Option<[f64; 3]> {
        let [width, height] = size.map(|n| n as f64);
        let from_camera = sub(world, self.position);
        let depth = dot(from_camera, self.forward_unit);
        let scale = match self.projection {
            Projection::Perspective { .. } if depth <= 0.0 => return None,
            Projection::Perspective { .. } => self.half_height() * depth,
            Projection::Orthographic { .. } => self.half_height(),
        };
        let right = dot(from_camera, self.right_unit) / (scale * width / height);
        let up = dot(from_camera, self.up_unit) / scale;
        Some([0.5 * width * (right + 1.0), 0.5 * height * (1.0 - up), depth])
    }
}

/// The rays of a picture of some size, see [`Camera::rays`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureRays {
    /// Where the camera stands.
    pub position: [f64; 3],
    /// The direction of view, a unit vector.
    pub forward: [f64; 3],
    /// From the centre of the picture to its top left corner: at distance 1, or in the world.
    pub corner: [f64; 3],
    /// From a column of the picture to the next.
    pub per_column: [f64; 3],
    /// From a row of the picture to the next.
    pub per_row: [f64; 3],
    is_perspective: bool,
}

impl PictureRays {
    /// The ray through a point of the picture: `(column + ½, row + ½)` is the centre of a pixel, rows counted from
    /// the top.
    #[inline]
    pub fn ray(&self, [x, y]: [f64; 2]) -> Ray {
        let offset: [f64; 3] =
            std::array::from_fn(|a| self.corner[a] + x * self.per_column[a] + y * self.per_row[a]);
        if !self.is_perspective {
            let origin = std::array::from_fn(|a| self.position[a] + offset[a]);
            return Ray { origin, direction: self.forward };
        }
        let through: [f64; 3] = std::array::from_fn(|a| self.forward[a] + offset[a]);
        let inverse_length = 1.0 / dot(through, through).sqrt();
        Ray { origin: self.position, direction: through.map(|c| c * inverse_length) }
    }
}

fn check_projection(projection: Projection) -> Result<(), CoreError> {
    match projection {
        Projection::Perspective { fov_y_deg } if !(0.001..=179.0).contains(&fov_y_deg) => {
            Err(CoreError::invalid("camera's fov_y_deg", fov_y_deg, "use an angle between 0.001 and 179"))
        }
        Projection::Orthographic { height } if !(height > 0.0 && height < 1e150) => {
            Err(CoreError::invalid("camera's ortho_height", height, "it must be finite and positive"))
        }
        _ => Ok(()),
    }
}

fn vector_of(value: &Value, key: &str, field: &'static str) -> Result<[f64; 3], CoreError> {
    let list = value.get(key);
    let numbers: Option<Vec<f64>> =
        list.and_then(Value::as_array).and_then(|l| l.iter().map(Value::as_f64).collect());
    numbers.and_then(|n| <[f64; 3]>::try_from(n).ok()).ok_or_else(|| {
        let text = list.map_or("missing".to_owned(), |l| l.to_string().chars().take(60).collect());
        CoreError::invalid(field, text, "give a list of three numbers")
    })
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(a: [f64; 3]) -> Option<[f64; 3]> {
    let length = dot(a, a).sqrt();
    (length > 0.0).then(|| a.map(|c| c / length))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOX: [[f64; 3]; 2] = [[-1.0, 0.0, 2.0], [3.0, 2.0, 4.0]];

    fn close(a: [f64; 3], b: [f64; 3]) -> bool {
        (0..3).all(|i| (a[i] - b[i]).abs() < 1e-12)
    }

    #[test]
    fn a_turned_camera_is_the_orbit_of_the_sum_of_the_angles() {
        let bounds = [[1.0, 2.0, 3.0], [4.0, 4.0, 8.0]];
        let orbit = |azimuth| Camera::orbit(bounds, azimuth, 25.0, 1.0, Some(30.0), 1.0).unwrap();
        let upright =
            |c: Camera| Camera::new(c.position(), c.look_at(), [0.0, 2.0, 0.0], c.projection()).unwrap();
        let turned = upright(orbit(20.0)).turned(95.0).unwrap();
        for (a, b) in turned.position().into_iter().zip(orbit(115.0).position()) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        assert!(turned.turned(f64::NAN).is_err());
    }

    #[test]
    fn orbit_at_zero_looks_along_minus_z_with_x_right_and_y_up() {
        for fov in [Some(30.0), None] {
            let camera = Camera::orbit(BOX, 0.0, 0.0, 1.0, fov, 1.0).unwrap();
            let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]];
            assert!((0..3).all(|i| close(camera.axes()[i], axes[i])));
            let top_left = camera.ray([0.5, 0.5], [4, 4]);
            let towards = match fov {
                Some(_) => top_left.direction,
                None => sub(top_left.origin, camera.position()),
            };
            assert!(towards[0] < 0.0 && towards[1] > 0.0);
        }
    }

    #[test]
    fn orbit_angles_are_those_of_the_formula() {
        let camera = Camera::orbit(BOX, 90.0, 30.0, 1.0, Some(40.0), 1.0).unwrap();
        // Half diagonal of a 4 x 2 x 2 box, and the sphere that fills 40 degrees.
        let distance = 6f64.sqrt() / 20f64.to_radians().sin();
        let expected = [1.0 + distance * 0.75f64.sqrt(), 1.0 + distance * 0.5, 3.0];
        assert!(close(camera.position(), expected), "{:?} {expected:?}", camera.position());
        assert!(Camera::orbit(BOX, 10.0, 90.0, 1.0, None, 1.0).is_ok(), "straight from above");
    }

    #[test]
    fn the_whole_box_is_in_view() {
        let corners = (0..8).map(|i| std::array::from_fn(|a| BOX[i >> a & 1][a]));
        for corner in corners {
            for (fov, size) in [(Some(30.0), [300, 200]), (Some(100.0), [100, 400]), (None, [100, 300])] {
                for azimuth in [0.0, 35.0, 140.0, 260.0] {
                    let aspect = size[0] as f64 / size[1] as f64;
                    let camera = Camera::orbit(BOX, azimuth, 20.0, 1.0, fov, aspect).unwrap();
                    let [x, y, depth] = camera.project(corner, size).unwrap();
                    assert!(depth > 0.0 && (0.0..=size[0] as f64).contains(&x), "{x} {y} {size:?}");
                    assert!((0.0..=size[1] as f64).contains(&y));
                }
            }
        }
    }

    #[test]
    fn rays_and_projection_are_inverse() {
        for fov in [Some(25.0), None] {
            let camera = Camera::orbit(BOX, 50.0, -35.0, 2.0, fov, 1.5).unwrap();
            let ray = camera.ray([10.5, 77.25], [300, 200]);
            let point = std::array::from_fn(|a| ray.origin[a] + 7.5 * ray.direction[a]);
            let found = camera.project(point, [300, 200]).unwrap();
            assert!((found[0] - 10.5).abs() < 1e-9 && (found[1] - 77.25).abs() < 1e-9);
        }
        let camera = Camera::orbit(BOX, 0.0, 0.0, 1.0, Some(30.0), 1.0).unwrap();
        let behind = std::array::from_fn(|a| 2.0 * camera.position()[a] - camera.look_at()[a]);
        assert_eq!(camera.project(behind, [10, 10]), None);
    }

    #[test]
    fn zoom_magnifies() {
        for fov in [Some(30.0), None] {
            let x = |zoom| {
                let camera = Camera::orbit(BOX, 20.0, 10.0, zoom, fov, 1.0).unwrap();
                camera.project(BOX[1], [2, 2]).unwrap()[0] - 1.0
            };
            assert!((x(3.0) / x(1.0) - 3.0).abs() < 1e-9);
        }
    }

    #[test]
    fn camera_files() {
        let text = r#"{"position":[0,0,9],"look_at":[0,0,0],"up":[0,2,0],"fov_y_deg":30}"#;
        let camera = Camera::from_json(text).unwrap();
        assert_eq!(camera.projection(), Projection::Perspective { fov_y_deg: 30.0 });
        let ortho = text.replace("\"fov_y_deg\":30", "\"ortho_height\":5");
        assert_eq!(Camera::from_json(&ortho).unwrap().projection(), Projection::Orthographic { height: 5.0 });
        for (from, to, field) in [
            ("[0,0,9]", "[0,0,0]", "look_at"),
            ("[0,2,0]", "[0,0,-3]", "up"),
            ("[0,2,0]", "[0,0]", "up"),
            ("[0,0,9]", "\"here\"", "position"),
            ("[0,0,9]", "[0,0,1e999]", "camera file"),
            ("30", "180", "fov_y_deg"),
            ("30", "\"a\"", "fov_y_deg"),
            ("\"fov_y_deg\":30", "\"x\":1", "fov_y_deg"),
            ("30", "30,\"ortho_height\":2", "ortho_height"),
            ("\"fov_y_deg\":30", "\"ortho_height\":-2", "ortho_height"),
            ("{", "", "camera file"),
        ] {
            let message = Camera::from_json(&text.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(message.contains(field) && !message.contains('\n'), "{to}: {message}");
        }
    }
}
