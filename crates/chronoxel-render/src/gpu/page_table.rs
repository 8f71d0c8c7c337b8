//! The page table: the nodes of the active cut, with child pointers, and what is in each.

use crate::RenderError;

/// A box of the octree, in cells: bricks of level 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct CellBox {
    pub low: [u32; 3],
    /// It has `2^level` cells along an edge.
    pub level: u32,
}

/// Most levels of the tree: cells are counted in 31 bits.
const MAX_LEVEL: u32 = 30;

impl CellBox {
    /// The box of a region.
    ///
    /// * `region`: lowest and highest corner, level-0 voxels
    /// * `edge`: samples along an edge of a brick
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] unless it is a box of the octree.
    pub fn of_region(region: [[f64; 3]; 2], edge: usize) -> Result<Self, RenderError> {
        let refused = || {
            let remedy =
                "give a box of the octree: as many bricks of level 0 as a power of two, and aligned so";
            RenderError::invalid("brick's region", format!("{region:?}"), remedy)
        };
        let [low, high] = region.map(|corner| corner.map(|c| c / edge as f64));
        let most = f64::from(1u32 << MAX_LEVEL);
        let is_cell = |c: f64| c.fract() == 0.0 && (0.0..=most).contains(&c);
        let size = high[0] - low[0];
        let is_cube = (0..3).all(|a| high[a] - low[a] == size && is_cell(low[a]) && is_cell(high[a]));
        let num_cells = size as u32;
        if !(is_cube
            && num_cells.is_power_of_two()
            && low.iter().all(|c| (*c as u32).is_multiple_of(num_cells)))
        {
            return Err(refused());
        }
        Ok(Self { low: low.map(|c| c as u32), level: num_cells.trailing_zeros() })
    }
}

/// What a box holds, if it is not empty.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Entry {
    /// A number in the list of constants.
    Constant(u32),
    /// A number in the list of bricks.
    Brick(u32),
}

/// `KIND_` of `shared/locate.wgsl`, in the two highest bits of a word.
const KIND_CONSTANT: u32 = 1;
const KIND_BRICK: u32 = 2;
const KIND_NODE: u32 = 3;
const NUMBER: u32 = (1 << 30) - 1;

impl Entry {
    fn word(self) -> u32 {
        match self {
            Self::Constant(number) => KIND_CONSTANT << 30 | number,
            Self::Brick(number) => KIND_BRICK << 30 | number,
        }
    }
}

/// Nodes, eight words each: what is in each octant, bit 0 being x, bit 1 y, bit 2 z.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PageTable {
    pub words: Vec<u32>,
    /// The node at the front has `2^root_level` cells along an edge; at least 1.
    pub root_level: u32,
}

impl PageTable {
    /// The table of boxes that do not overlap; what lies in none is empty. The order of the boxes does not matter.
    ///
    /// * `num_cells`: those of the grid, which the table covers
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if two boxes overlap.
    pub fn new(boxes: &[(CellBox, Entry)], num_cells: [u32; 3]) -> Result<Self, RenderError> {
        let level_of = |cells: u32| cells.next_power_of_two().trailing_zeros();
        let of_boxes = boxes.iter().map(|(b, _)| b.low.map(|c| level_of(c + (1 << b.level))));
        let root_level = of_boxes.flatten().chain(num_cells.map(level_of)).fold(1, u32::max);
        let mut table = Self { words: vec![0; 8], root_level };
        for (place, entry) in boxes {
            table.insert(place, *entry)?;
        }
        Ok(table)
    }

    fn insert(&mut self, place: &CellBox, entry: Entry) -> Result<(), RenderError> {
        let overlaps = || {
            let remedy = "boxes of a draw list must not overlap";
            Err(RenderError::invalid(
                "brick's region",
                format!("{:?} x 2^{}", place.low, place.level),
                remedy,
            ))
        };
        // A box of the whole tree is its eight octants.
        if place.level == self.root_level {
            return match self.words.iter().any(|word| *word != 0) {
                true => overlaps(),
                false => {
                    self.words.fill(entry.word());
                    Ok(())
                }
            };
        }
        let (mut node, mut level) = (0, self.root_level - 1);
        loop {
            let at = 8 * node + octant(place.low, level);
            let word = self.words[at];
            if level == place.level {
                if word != 0 {
                    return overlaps();
                }
                self.words[at] = entry.word();
                return Ok(());
            }
            node = match word >> 30 {
                KIND_NODE => (word & NUMBER) as usize,
                0 => {
                    let new = self.words.len() / 8;
                    self.words.extend([0; 8]);
                    self.words[at] = KIND_NODE << 30 | new as u32;
                    new
                }
                _ => return overlaps(),
            };
            level -= 1;
        }
    }
}

fn octant(cell: [u32; 3], level: u32) -> usize {
    (0..3).map(|a| (cell[a] as usize >> level & 1) << a).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    impl PageTable {
        /// What is at a cell, and the box around it that holds the same. Twin of `shared/locate.wgsl`.
        pub(in crate::gpu) fn locate(&self, cell: [u32; 3]) -> (Option<Entry>, CellBox) {
            let mut level = self.root_level - 1;
            let mut word = self.words[octant(cell, level)];
            while word >> 30 == KIND_NODE && level > 0 {
                level -= 1;
                word = self.words[8 * (word & NUMBER) as usize + octant(cell, level)];
            }
            let entry = match word >> 30 {
                KIND_CONSTANT => Some(Entry::Constant(word & NUMBER)),
                KIND_BRICK => Some(Entry::Brick(word & NUMBER)),
                _ => None,
            };
            (entry, CellBox { low: cell.map(|c| c >> level << level), level })
        }
    }

    /// Boxes of several levels over 8³ cells, some absent.
    fn boxes() -> Vec<(CellBox, Entry)> {
        let mut boxes = Vec::new();
        let mut insert = |low, level| {
            let number = boxes.len() as u32;
            let entry = if number.is_multiple_of(3) { Entry::Constant(number) } else { Entry::Brick(number) };
            boxes.push((CellBox { low, level }, entry));
        };
        insert([4, 0, 0], 2);
        for i in 0..8 {
            insert([i & 1, i >> 1 & 1, i >> 2].map(|b| 2 * b), 1);
        }
        for i in 0..64 {
            if i % 5 != 0 {
                insert([4 + i % 4, 4 + i / 4 % 4, i / 16], 0);
            }
        }
        boxes
    }

    #[test]
    fn every_cell_is_in_the_box_that_holds_it() {
        let boxes = boxes();
        let table = PageTable::new(&boxes, [8, 8, 8]).unwrap();
        for i in 0..512u32 {
            let cell = [i % 8, i / 8 % 8, i / 64];
            let holds = |b: &CellBox| (0..3).all(|a| cell[a] >> b.level << b.level == b.low[a]);
            let expected = boxes.iter().find(|(b, _)| holds(b));
            let (entry, found) = table.locate(cell);
            assert!(holds(&found));
            match expected {
                Some((place, expected)) => assert_eq!((entry, found), (Some(*expected), *place)),
                None => assert_eq!(entry, None),
            }
        }
    }

    #[test]
    fn a_box_of_all_is_found_everywhere() {
        let boxes = [(CellBox { low: [0; 3], level: 2 }, Entry::Brick(7))];
        let table = PageTable::new(&boxes, [3, 3, 3]).unwrap();
        assert_eq!(table.locate([3, 1, 2]).0, Some(Entry::Brick(7)));
    }

    #[test]
    fn boxes_that_overlap_are_refused() {
        let inner = CellBox { low: [2, 2, 2], level: 1 };
        for other in [CellBox { low: [0; 3], level: 2 }, CellBox { low: [2, 3, 2], level: 0 }] {
            let boxes = [(inner, Entry::Brick(0)), (other, Entry::Constant(0))];
            assert!(PageTable::new(&boxes, [8; 3]).is_err(), "{other:?}");
        }
    }

    #[test]
    fn regions_that_are_no_boxes_of_the_octree_are_refused() {
        let of = |low, high| CellBox::of_region([low, high], 16);
        assert_eq!(of([32.0; 3], [64.0; 3]).unwrap(), CellBox { low: [2; 3], level: 1 });
        assert!(of([16.0; 3], [48.0; 3]).is_err(), "not aligned");
        assert!(of([0.0; 3], [48.0; 3]).is_err(), "not a power of two");
        assert!(of([0.0; 3], [32.0, 32.0, 16.0]).is_err(), "not a cube");
        assert!(of([-16.0; 3], [0.0; 3]).is_err(), "outside");
        assert!(of([0.0; 3], [f64::NAN; 3]).is_err());
    }
}
