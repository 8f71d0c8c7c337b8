//! What of the volume a camera can see, in voxel coordinates.

/// From where the volume is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Eye {
    /// A perspective eye at a point, in voxel coordinates.
    At([f64; 3]),
    /// An orthographic view along a direction, in voxel coordinates.
    Along([f64; 3]),
}

impl Eye {
    /// For each axis, whether the eye is on the high side of the plane `mid`.
    fn high_side(&self, mid: [f64; 3]) -> [bool; 3] {
        std::array::from_fn(|a| match self {
            Self::At(eye) => eye[a] >= mid[a],
            Self::Along(direction) => direction[a] < 0.0,
        })
    }

    /// The octants around `mid`, front to back (bit 0 of an octant is x, bit 1 y, bit 2 z).
    ///
    /// The octant that holds the eye comes first, then those across one plane, two and three: no ray
    /// from the eye meets them in another order.
    pub fn octants_front_to_back(&self, mid: [f64; 3]) -> [u8; 8] {
        let near = self.high_side(mid).iter().rev().fold(0u8, |bits, &high| bits << 1 | u8::from(high));
        [0u8, 1, 2, 4, 3, 5, 6, 7].map(|across| near ^ across)
    }
}

/// The visible part of space: an eye and the half-spaces that bound the picture.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewVolume {
    /// Where from.
    pub eye: Eye,
    /// Half-spaces `n · p + d >= 0` as `[nx, ny, nz, d]`, in voxel coordinates.
    pub planes: Vec<[f64; 4]>,
}

impl ViewVolume {
    /// Whether a box may be visible: false only where it lies wholly outside one of the half-spaces.
    pub fn may_see(&self, [low, high]: [[f64; 3]; 2]) -> bool {
        self.planes.iter().all(|plane| {
            let farthest: f64 =
                (0..3).map(|a| plane[a] * if plane[a] >= 0.0 { high[a] } else { low[a] }).sum();
            farthest + plane[3] >= 0.0
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two octants are in the right order if no separating plane has the eye on the later one's side.
    fn hides(eye: [f64; 3], mid: [f64; 3], first: u8, second: u8) -> bool {
        (0..3).any(|a| {
            let (f, s) = (first >> a & 1, second >> a & 1);
            f != s && f == u8::from(eye[a] >= mid[a])
        })
    }

    #[test]
    fn octants_come_front_to_back_for_eyes_everywhere() {
        let mid = [8.0, 8.0, 8.0];
        for i in 0..216 {
            let eye = [i % 6, i / 6 % 6, i / 36].map(|k| f64::from(k) * 4.0 - 2.0);
            let order = Eye::At(eye).octants_front_to_back(mid);
            for (n, &first) in order.iter().enumerate() {
                assert!(order[n + 1..].iter().all(|&second| hides(eye, mid, first, second)));
            }
        }
    }

    #[test]
    fn orthographic_order_follows_the_direction() {
        let order = Eye::Along([1.0, -1.0, 1.0]).octants_front_to_back([0.0; 3]);
        assert_eq!((order[0], order[7]), (0b010, 0b101));
    }

    #[test]
    fn boxes_outside_a_half_space_are_not_seen() {
        let view = ViewVolume { eye: Eye::At([0.0; 3]), planes: vec![[1.0, 0.0, 0.0, -4.0]] };
        assert!(!view.may_see([[0.0; 3], [3.9, 9.0, 9.0]]));
        assert!(view.may_see([[0.0; 3], [4.1, 9.0, 9.0]]));
    }
}
