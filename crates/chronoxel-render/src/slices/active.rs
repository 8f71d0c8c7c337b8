//! The active edge list of ellsworth2000, section 4.2: which edges of a box a plane crosses, in the order of the
//! polygon.
//!
//! The corners are numbered from the first that the planes pass: bit `i` is set in those beyond it along axis `i`, so
//! that the last has all three. Axes are such that those of the first corner appear counter-clockwise as seen from the
//! eye. A corner is passed after all that have fewer of its bits; then the edges that lead to it have been
//! processed and stand side by side in the list, and those that lead on take their place.

/// Most edges that a plane can cross.
pub(super) const MAX_EDGES: usize = 6;

/// An edge: the corner where it begins, and the axis that it leads along.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Edge {
    pub(super) corner: u8,
    pub(super) axis: u8,
}

/// The edges that the plane between the corners passed and the others crosses: a ring, each place knowing the next.
#[derive(Debug, Clone, Default)]
pub(super) struct ActiveEdges {
    /// Passing corners takes up no more than six places in all.
    next: [u8; MAX_EDGES],
    num_places: u8,
    head: u8,
    len: u8,
    /// The place of each active edge, `[axis][corner]`.
    places: [[u8; 8]; 3],
}

impl ActiveEdges {
    /// Passes a corner, see figure 3 of the paper; `put` is told of each edge that becomes active, and its place.
    #[inline]
    pub(super) fn pass(&mut self, corner: u8, mut put: impl FnMut(usize, Edge)) {
        let mut put = |active: &mut Self, place: u8, axis: u8| {
            active.places[usize::from(axis)][usize::from(corner)] = place;
            put(usize::from(place), Edge { corner, axis });
        };
        match 3 - corner.count_ones() {
            3 => self.begin(&mut put),
            2 => self.replace_one_by_two(corner, &mut put),
            1 => self.replace_two_by_one(corner, &mut put),
            _ => self.len = 0,
        }
    }

    /// How many edges are active.
    #[inline]
    pub(super) fn len(&self) -> usize {
        usize::from(self.len)
    }

    /// The places of the active edges in the order of the polygon, counter-clockwise as seen from the eye.
    #[inline]
    pub(super) fn places(&self) -> impl Iterator<Item = usize> {
        let mut place = usize::from(self.head);
        (0..self.len).map(move |_| {
            let next = usize::from(self.next[place]);
            std::mem::replace(&mut place, next)
        })
    }

    #[inline]
    fn begin(&mut self, put: &mut impl FnMut(&mut Self, u8, u8)) {
        for axis in 0..3 {
            put(self, axis, axis);
            self.next[usize::from(axis)] = (axis + 1) % 3;
        }
        (self.head, self.num_places, self.len) = (0, 3, 3);
    }

    /// Of the two new edges, that along the axis before the old one's comes first: it shares a face with the edge that
    /// stands before the old one in the ring.
    #[inline]
    fn replace_one_by_two(&mut self, corner: u8, put: &mut impl FnMut(&mut Self, u8, u8)) {
        let axis = corner.trailing_zeros() as u8;
        let (first, second) = (self.places[usize::from(axis)][0], self.num_places);
        put(self, first, (axis + 2) % 3);
        put(self, second, (axis + 1) % 3);
        self.next[usize::from(second)] = self.next[usize::from(first)];
        self.next[usize::from(first)] = second;
        self.num_places += 1;
        self.len += 1;
    }

    #[inline]
    fn replace_two_by_one(&mut self, corner: u8, put: &mut impl FnMut(&mut Self, u8, u8)) {
        let axis = (!corner).trailing_zeros() as u8;
        let [a, b] = [(axis + 1) % 3, (axis + 2) % 3];
        let kept = self.places[usize::from(b)][1 << a];
        let dropped = self.places[usize::from(a)][1 << b];
        put(self, kept, axis);
        self.next[usize::from(kept)] = self.next[usize::from(dropped)];
        self.head = kept;
        self.len -= 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The corners that an edge joins.
    fn ends(edge: Edge) -> [u8; 2] {
        [edge.corner, edge.corner | 1 << edge.axis]
    }

    /// Whether two edges lie in one face: their corners agree in a bit.
    fn share_a_face(a: Edge, b: Edge) -> bool {
        let corners = [ends(a), ends(b)].concat();
        (0..3).any(|axis| corners.iter().all(|c| c >> axis & 1 == corners[0] >> axis & 1))
    }

    /// Calls `check` with every order in which corners can be passed.
    fn orders(passed: &mut Vec<u8>, check: &mut impl FnMut(&[u8])) {
        let is_free = |corner: u8, passed: &[u8]| {
            let mut before = (0..3).filter(|axis| corner >> axis & 1 == 1).map(|axis| corner & !(1 << axis));
            !passed.contains(&corner) && before.all(|b| passed.contains(&b))
        };
        check(passed);
        for corner in 0..8 {
            if is_free(corner, passed) {
                passed.push(corner);
                orders(passed, check);
                passed.pop();
            }
        }
    }

    #[test]
    fn every_order_of_corners_keeps_a_ring_of_crossed_edges() {
        let mut num_orders = 0;
        orders(&mut Vec::new(), &mut |passed| {
            let mut active = ActiveEdges::default();
            let mut edges = [Edge::default(); MAX_EDGES];
            passed.iter().for_each(|&corner| active.pass(corner, |place, edge| edges[place] = edge));
            let ring: Vec<Edge> = active.places().map(|place| edges[place]).collect();
            let is_crossed = |e: Edge| passed.contains(&ends(e)[0]) && !passed.contains(&ends(e)[1]);
            let crossed = (0..24).map(|i| Edge { corner: i / 3, axis: i % 3 });
            let crossed = crossed.filter(|&e| e.corner >> e.axis & 1 == 0 && is_crossed(e));
            assert!(ring.iter().all(|&e| is_crossed(e)), "{passed:?}: {ring:?}");
            assert_eq!(ring.len(), crossed.count(), "{passed:?}: {ring:?}");
            for (i, &edge) in ring.iter().enumerate() {
                assert!(!ring[..i].contains(&edge), "{passed:?}: {ring:?}");
                assert!(share_a_face(edge, ring[(i + 1) % ring.len()]), "{passed:?}: {ring:?}");
            }
            num_orders += usize::from(passed.len() == 8);
        });
        // The total orders of the subsets of three that extend inclusion: OEIS A046873.
        assert_eq!(num_orders, 48);
    }
}
