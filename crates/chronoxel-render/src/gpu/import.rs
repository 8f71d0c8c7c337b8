//! Shaders as they lie on disk, with what they import.

use std::borrow::Cow;

/// Files that others import, by the name in quotes after `#import`.
pub(super) const SHARED: &[(&str, &str)] = &[
    ("shared/classification.wgsl", include_str!("shaders/shared/classification.wgsl")),
    ("shared/compositing.wgsl", include_str!("shaders/shared/compositing.wgsl")),
    ("shared/decode.wgsl", include_str!("shaders/shared/decode.wgsl")),
    ("shared/lighting.wgsl", include_str!("shaders/shared/lighting.wgsl")),
    ("shared/locate.wgsl", include_str!("shaders/shared/locate.wgsl")),
    ("shared/missing.wgsl", include_str!("shaders/shared/missing.wgsl")),
    ("shared/opacity.wgsl", include_str!("shaders/shared/opacity.wgsl")),
    ("shared/prefix.wgsl", include_str!("shaders/shared/prefix.wgsl")),
    ("shared/sampling.wgsl", include_str!("shaders/shared/sampling.wgsl")),
    ("shared/sight.wgsl", include_str!("shaders/shared/sight.wgsl")),
];

/// Packs pictures into 8 bits.
pub(super) const BYTES: &str = include_str!("shaders/bytes.wgsl");
/// Decodes slots.
pub(super) const DECODE: &str = include_str!("shaders/decode.wgsl");
/// Casts rays.
pub(super) const RAYCAST: &str = include_str!("shaders/raycast.wgsl");
/// Draws slices.
pub(super) const SLICES: &str = include_str!("shaders/slices.wgsl");

/// Makes lists of the faces of each tile.
pub(super) const CELL_BIN: &str = include_str!("shaders/cells/bin.wgsl");
/// Finds gradients on a mesh.
pub(super) const CELL_GRADIENTS: &str = include_str!("shaders/cells/gradients.wgsl");
/// Finds the order of the faces of a mesh.
pub(super) const CELL_ORDER: &str = include_str!("shaders/cells/order.wgsl");
/// Projects the points of a mesh.
pub(super) const CELL_PLACE: &str = include_str!("shaders/cells/place.wgsl");
/// Sums numbers.
pub(super) const CELL_SCAN: &str = include_str!("shaders/cells/scan.wgsl");
/// Sorts pairs.
pub(super) const CELL_SORT: &str = include_str!("shaders/cells/sort.wgsl");
/// Draws tiles of a mesh.
pub(super) const CELL_TILES: &str = include_str!("shaders/cells/tiles.wgsl");
/// Places values on a mesh.
pub(super) const CELL_VALUES: &str = include_str!("shaders/cells/values.wgsl");

/// A shader with each line `#import "file"` replaced by the file, which imports nothing itself.
///
/// # Panics
/// If there is no such file: shaders are part of the program.
pub(super) fn with_imports(source: &str) -> String {
    let line = |line| -> Cow<'_, str> {
        let Some(file) = imported(line) else { return Cow::Borrowed(line) };
        let text = SHARED.iter().find(|(name, _)| *name == file).map(|(_, text)| *text);
        Cow::Borrowed(text.unwrap_or_else(|| panic!("no shader file {file:?}")))
    };
    source.lines().flat_map(|l| [line(l), Cow::Borrowed("\n")]).collect()
}

/// The file that a line imports.
fn imported(line: &str) -> Option<&str> {
    line.strip_prefix("#import \"")?.strip_suffix('"')
}
