//! Where everything lies: rows, shards, and the names of folders and files.

use chronoxel_core::{BrickLayout, SampleType, UniformGrid, octree::levels_of};

/// Longest window, in steps.
pub const MAX_WINDOW: u32 = 1024;
/// Most start rows in a shard.
pub const MAX_ROWS_PER_SHARD: u32 = 64;

/// The row of a span in the arrays of its level and window: `ceil(start / window)`.
pub const fn row(start: u32, window: u32) -> u32 {
    start.div_ceil(window)
}

/// Rows of an array: that of the last possible start, and those before it.
pub const fn num_rows(num_steps: u32, window: u32) -> u32 {
    row(num_steps.saturating_sub(1), window) + 1
}

/// G, the steps that a shard covers: the largest power of two, at most 64, whose steps of raw 8-bit
/// level-0 bricks take at most 1 MiB; 1 where a single step takes more.
pub fn steps_per_shard(grid: &UniformGrid, layout: &BrickLayout) -> u32 {
    let num_bricks: u128 = levels_of(grid, layout)[0].bricks.iter().map(|&n| n as u128).product();
    let step_bytes = num_bricks * layout.num_full() as u128;
    let fits = |steps: &u32| u128::from(*steps) * step_bytes <= 1 << 20;
    [64, 32, 16, 8, 4, 2].into_iter().find(fits).unwrap_or(1)
}

/// Rows of window length `window` that a shard holds: those of about G steps.
pub const fn rows_per_shard(steps_per_shard: u32, window: u32) -> u32 {
    if window >= steps_per_shard { 1 } else { steps_per_shard / window }
}

/// The number of the shard, or of the chunk of spans, in a file of this name: `c.{shard}.0.0`.
pub(crate) fn shard_of(name: &str) -> Option<u32> {
    let digits = name.strip_prefix("c.")?.strip_suffix(".0.0")?;
    digits.parse::<u32>().ok().filter(|shard| shard.to_string() == digits)
}

/// The number of the block of steps in a file of this name: `c.{block}.0`.
pub(crate) fn block_of(name: &str) -> Option<u32> {
    let digits = name.strip_prefix("c.")?.strip_suffix(".0")?;
    digits.parse::<u32>().ok().filter(|block| block.to_string() == digits)
}

/// Folder of a variable: its name where that is a safe file name on every system and no earlier
/// variable has it, else `variable-{index}`.
///
/// * `taken`: names of the store's own, in lower case
pub(crate) fn variable_folder<'a>(
    index: usize,
    name: &str,
    taken: &[&str],
    mut earlier: impl Iterator<Item = &'a str>,
) -> String {
    let safe = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    let first = |c: char| c.is_ascii_alphanumeric();
    let sound = (1..=64).contains(&name.len())
        && name.chars().all(safe)
        && name.starts_with(first)
        && !name.ends_with('.')
        && !taken.iter().any(|taken| name.eq_ignore_ascii_case(taken))
        && !name.to_ascii_lowercase().starts_with("variable-");
    match sound && !earlier.any(|other| other.eq_ignore_ascii_case(name)) {
        true => name.to_owned(),
        false => format!("variable-{index}"),
    }
}

/// Whether a fill value can occur in samples of the type: a NaN never can in integers.
pub(crate) fn fill_value_is_sound(sample_type: SampleType, fill_value: Option<f64>) -> bool {
    fill_value.is_none_or(|fill| !(sample_type.is_integer() && fill.is_nan()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_windows_out_of_phase_do_not_collide() {
        // Windows of 4 with phase 3: starts 0, 3, 7, 11 in rows 0, 1, 2, 3.
        assert_eq!([0, 3, 7, 11].map(|start| row(start, 4)), [0, 1, 2, 3]);
        assert_eq!([0, 4, 8].map(|start| row(start, 4)), [0, 1, 2]);
        assert_eq!((num_rows(12, 4), num_rows(13, 4), num_rows(1, 4)), (4, 4, 1));
        assert_eq!(num_rows(5, 1), 5);
    }

    #[test]
    fn only_small_volumes_share_shards() {
        let steps = |n, edge| {
            let grid = UniformGrid::new([n; 3], [0.0; 3], [1.0; 3]).unwrap();
            steps_per_shard(&grid, &BrickLayout::new(edge).unwrap())
        };
        // 35^3 = 42,875 bytes: 24 fit in 1 MiB, so 16; 8 bricks of it: 3, so 2; 64 bricks: none.
        assert_eq!([steps(32, 32), steps(64, 32), steps(128, 32)], [16, 2, 1]);
        assert_eq!(steps(8, 8), 64);
        assert_eq!([rows_per_shard(16, 1), rows_per_shard(16, 5), rows_per_shard(16, 32)], [16, 3, 1]);
    }

    #[test]
    fn odd_names_get_plain_folders() {
        let folder = |name, earlier: &[&'static str]| {
            variable_folder(3, name, &["nodes", "zarr.json"], earlier.iter().copied())
        };
        assert_eq!(folder("rho_2.5", &[]), "rho_2.5");
        for name in ["", "a/b", "..", "nodes", "NODES", "température", "variable-7", ".x", "a."] {
            assert_eq!(folder(name, &[]), "variable-3", "{name}");
        }
        assert_eq!(folder("U", &["u"]), "variable-3");
    }
}
