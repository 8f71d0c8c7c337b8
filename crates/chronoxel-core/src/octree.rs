//! The octree of bricks: which nodes exist, where they lie, who is whose child.
//!
//! Level 0 is the finest. Samples of level `l` lie at `2^l * i` in voxels of the source grid, so that
//! all levels share sample 0. A node covers `edge` samples of its level along each axis, and its
//! children cover the same samples at level `l - 1`. The tree may be adaptive: any subset of a
//! node's children may exist, and where one is missing the node itself is the finest data there is.

use crate::{BrickLayout, CoreError, UniformGrid};

/// One octree node: its level and its place among the bricks of that level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct NodeId {
    /// 0 is the finest level of the tree.
    pub level: u8,
    /// Interleaved bits of the brick's x, y, z: see [`NodeId::new`].
    pub morton: u64,
}

impl NodeId {
    /// The node of brick `(x, y, z)` of a level; each must be below 2^21.
    ///
    /// Bit `3 k` of the Morton index is bit `k` of x, bit `3 k + 1` that of y, `3 k + 2` that of z.
    pub fn new(level: u8, brick: [u32; 3]) -> Self {
        debug_assert!(brick.iter().all(|&b| b < 1 << 21));
        Self { level, morton: spread(brick[0]) | spread(brick[1]) << 1 | spread(brick[2]) << 2 }
    }

    /// The brick's place `(x, y, z)`, counted in bricks of its level.
    pub fn brick(self) -> [u32; 3] {
        [gather(self.morton), gather(self.morton >> 1), gather(self.morton >> 2)]
    }

    /// The node one level up.
    pub fn parent(self) -> Self {
        Self { level: self.level + 1, morton: self.morton >> 3 }
    }

    /// The child in octant `octant` (bit 0 is x, bit 1 y, bit 2 z); `None` at level 0.
    pub fn child(self, octant: u8) -> Option<Self> {
        let level = self.level.checked_sub(1)?;
        Some(Self { level, morton: self.morton << 3 | u64::from(octant) })
    }
}

fn spread(value: u32) -> u64 {
    let mut v = u64::from(value) & 0x1f_ffff;
    v = (v | v << 32) & 0x001f_0000_0000_ffff;
    v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

fn gather(value: u64) -> u32 {
    let mut v = value & 0x1249_2492_4924_9249;
    v = (v | v >> 2) & 0x10c3_0c30_c30c_30c3;
    v = (v | v >> 4) & 0x100f_00f0_0f00_f00f;
    v = (v | v >> 8) & 0x001f_0000_ff00_00ff;
    v = (v | v >> 16) & 0x001f_0000_0000_ffff;
    ((v | v >> 32) & 0x1f_ffff) as u32
}

/// Sizes of one level of the tree over a uniform grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LevelGeometry {
    /// The level; 0 is the finest.
    pub level: u8,
    /// Samples of the level that lie inside the grid, along x, y, z: `ceil(n / 2^l)`.
    pub dims: [usize; 3],
    /// Samples that filtering defines: `ceil((n - 1) / 2^l) + 1`, one more than `dims` where the last
    /// lies beyond the grid's far face. Beyond these, samples are replicated outwards.
    pub field_dims: [usize; 3],
    /// Bricks along x, y, z: `ceil(dims / edge)`.
    pub bricks: [usize; 3],
}

impl LevelGeometry {
    /// Core samples of brick `[x, y, z]` that lie inside the grid, as indices into the full brick, in its order.
    pub fn core_inside(&self, brick: [usize; 3], layout: &BrickLayout) -> Vec<u32> {
        let (full, low) = (layout.full_edge(), layout.low);
        let [nx, ny, nz] = std::array::from_fn(|a| (self.dims[a] - brick[a] * layout.edge).min(layout.edge));
        let rows = (0..nz).flat_map(|z| (0..ny).map(move |y| low + full * (low + y + full * (low + z))));
        rows.flat_map(|start| start as u32..(start + nx) as u32).collect()
    }
}

/// The levels of the full tree over a grid, finest first, up to the one that is a single brick.
pub fn levels_of(grid: &UniformGrid, layout: &BrickLayout) -> Vec<LevelGeometry> {
    let mut levels = Vec::new();
    loop {
        let level = levels.len() as u8;
        let step = 1usize << level;
        let dims = grid.dims.map(|n| n.div_ceil(step));
        let bricks = dims.map(|n| n.div_ceil(layout.edge));
        levels.push(LevelGeometry {
            level,
            dims,
            field_dims: grid.dims.map(|n| (n - 1).div_ceil(step) + 1),
            bricks,
        });
        if bricks == [1; 3] {
            return levels;
        }
    }
}

/// The nodes that exist: for each level, their Morton indices in increasing order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Octree {
    levels: Vec<Vec<u64>>,
}

impl Octree {
    /// The full tree over a grid: every brick of every level that holds a sample of the grid.
    pub fn full(levels: &[LevelGeometry]) -> Self {
        let levels = levels.iter().map(|geometry| {
            let [nx, ny, nz] = geometry.bricks.map(|n| n as u32);
            let mut nodes: Vec<u64> = (0..nz)
                .flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])))
                .map(|brick| NodeId::new(geometry.level, brick).morton)
                .collect();
            nodes.sort_unstable();
            nodes
        });
        Self { levels: levels.collect() }
    }

    /// A tree from lists of Morton indices, finest level first.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if a list is not strictly increasing, a node has no parent, or
    /// the coarsest level is not exactly one node.
    pub fn from_levels(levels: Vec<Vec<u64>>) -> Result<Self, CoreError> {
        if levels.last().is_none_or(|top| top.len() != 1) {
            return Err(CoreError::invalid("octree", "coarsest level", "it must have exactly one node"));
        }
        for (level, nodes) in levels.iter().enumerate() {
            if !nodes.is_sorted_by(|a, b| a < b) {
                return Err(CoreError::invalid(
                    "octree level",
                    level,
                    "nodes must be in increasing Morton order",
                ));
            }
            let orphan =
                |m: &&u64| levels.get(level + 1).is_some_and(|up| up.binary_search(&(**m >> 3)).is_err());
            if let Some(morton) = nodes.iter().find(orphan) {
                return Err(CoreError::invalid("octree node", morton, "every node needs its parent"));
            }
        }
        Ok(Self { levels })
    }

    /// Number of levels.
    pub fn num_levels(&self) -> usize {
        self.levels.len()
    }

    /// Morton indices of the nodes of a level, increasing.
    pub fn nodes(&self, level: u8) -> &[u64] {
        &self.levels[usize::from(level)]
    }

    /// The root: the one node of the coarsest level.
    pub fn root(&self) -> NodeId {
        let level = self.levels.len() - 1;
        NodeId { level: level as u8, morton: self.levels[level][0] }
    }

    /// Whether a node has no children: whether it is the finest data there is.
    pub fn is_leaf(&self, node: NodeId) -> bool {
        let Some(below) = usize::from(node.level).checked_sub(1) else { return true };
        let finer = &self.levels[below];
        finer.get(finer.partition_point(|m| m >> 3 < node.morton)).is_none_or(|m| m >> 3 != node.morton)
    }

    /// The rank of a node among those of its level, or `None` where it does not exist.
    pub fn rank(&self, node: NodeId) -> Option<usize> {
        self.levels.get(usize::from(node.level))?.binary_search(&node.morton).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn morton_index_interleaves_x_first() {
        assert_eq!(NodeId::new(0, [1, 0, 0]).morton, 1);
        assert_eq!(NodeId::new(0, [0, 1, 0]).morton, 2);
        assert_eq!(NodeId::new(0, [0, 0, 1]).morton, 4);
        assert_eq!(NodeId::new(0, [3, 5, 6]).morton, 0b110_101_011);
        for brick in [[0, 0, 0], [7, 1, 30], [(1 << 21) - 1, 12345, 1 << 20]] {
            assert_eq!(NodeId::new(2, brick).brick(), brick);
        }
    }

    #[test]
    fn parents_and_children_are_inverse() {
        let node = NodeId::new(1, [5, 2, 9]);
        for octant in 0..8 {
            let child = node.child(octant).unwrap();
            assert_eq!(child.parent(), node);
            let bits = [octant & 1, octant >> 1 & 1, octant >> 2 & 1].map(u32::from);
            assert_eq!(child.brick(), std::array::from_fn(|a| node.brick()[a] * 2 + bits[a]));
        }
        assert_eq!(NodeId::new(0, [0; 3]).child(0), None);
    }

    #[test]
    fn levels_halve_until_one_brick() {
        let grid = UniformGrid::new([129, 64, 1], [0.0; 3], [1.0; 3]).unwrap();
        let levels = levels_of(&grid, &BrickLayout::new(32).unwrap());
        let bricks: Vec<_> = levels.iter().map(|l| l.bricks).collect();
        assert_eq!(bricks, [[5, 2, 1], [3, 1, 1], [2, 1, 1], [1, 1, 1]]);
        assert_eq!(levels[1].dims, [65, 32, 1]);
        assert_eq!(levels[1].field_dims, [65, 33, 1]);
        let tree = Octree::full(&levels);
        assert_eq!(tree.nodes(0).len(), 10);
        assert_eq!(Octree::from_levels(tree.levels.clone()).unwrap(), tree);
    }

    #[test]
    fn orphans_are_refused() {
        assert!(Octree::from_levels(vec![vec![9], vec![0]]).is_err());
        assert!(Octree::from_levels(vec![vec![1, 3], vec![0]]).is_ok());
    }

    #[test]
    fn leaves_are_nodes_without_children() {
        let tree = Octree::from_levels(vec![vec![9, 17], vec![0, 1, 2], vec![0]]).unwrap();
        let leaves = |level: u8| tree.nodes(level).iter().map(move |&morton| NodeId { level, morton });
        let is_leaf: Vec<bool> = (0..3).flat_map(leaves).map(|node| tree.is_leaf(node)).collect();
        assert_eq!(is_leaf, [true, true, true, false, false, false]);
    }
}
