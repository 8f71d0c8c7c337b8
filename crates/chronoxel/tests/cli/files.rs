//! Files that tests write and compare.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use chronoxel::movie::read_png;
use chronoxel_core::Image8;

/// Every file and folder below a folder; files with their bytes.
pub fn tree(folder: &Path) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            let bytes = match path.is_dir() {
                true => {
                    folders.push(path.clone());
                    None
                }
                false => Some(fs::read(&path).unwrap()),
            };
            found.insert(path.strip_prefix(folder).unwrap().to_owned(), bytes);
        }
    }
    found
}

/// Whether two folders hold the same, byte for byte; a message that names the first difference if not.
#[track_caller]
pub fn assert_same_folders(a: &Path, b: &Path) {
    let (left, right) = (tree(a), tree(b));
    let names = |tree: &BTreeMap<PathBuf, Option<Vec<u8>>>| tree.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&left), names(&right), "{} and {}", a.display(), b.display());
    for (name, bytes) in &left {
        assert!(*bytes == right[name], "{} differs in {} and {}", name.display(), a.display(), b.display());
    }
}

/// A copy of a folder.
pub fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for (name, bytes) in tree(from) {
        match bytes {
            None => fs::create_dir_all(to.join(name)).unwrap(),
            Some(bytes) => {
                fs::create_dir_all(to.join(&name).parent().unwrap()).unwrap();
                fs::write(to.join(name), bytes).unwrap();
            }
        }
    }
}

/// Names of everything directly in a folder, sorted.
pub fn names_in(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// A fixture of the readers' tests.
pub fn fixture(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../chronoxel-ingest/tests/fixtures").join(name);
    path.to_str().unwrap().to_owned()
}

/// A `.npy` file, version 1.0: a header in the words of the format's page, and the bytes.
pub fn npy_bytes(descr: &str, shape: &str, samples: &[u8]) -> Vec<u8> {
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}");
    let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
    header.push_str(&" ".repeat(padded - header.len() - 1));
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    bytes.extend(samples);
    bytes
}

/// Writes `[z, y, x]` samples of 32 bits from a function of the place.
pub fn write_f32(path: &Path, [nx, ny, nz]: [usize; 3], f: impl Fn([usize; 3]) -> f32) {
    let place = |i: usize| [i % nx, i / nx % ny, i / (nx * ny)];
    let samples: Vec<u8> = (0..nx * ny * nz).flat_map(|i| f(place(i)).to_le_bytes()).collect();
    fs::write(path, npy_bytes("<f4", &format!("{nz}, {ny}, {nx}"), &samples)).unwrap();
}

/// Writes `[t, z, y, x]` samples of 8 bits from a function of the step and the place.
pub fn write_u8_steps(
    path: &Path,
    num_steps: usize,
    [nx, ny, nz]: [usize; 3],
    f: impl Fn(usize, [usize; 3]) -> u8,
) {
    let place = |i: usize| [i % nx, i / nx % ny, i / (nx * ny)];
    let steps = (0..num_steps).flat_map(|step| (0..nx * ny * nz).map(move |i| (step, i)));
    let samples: Vec<u8> = steps.map(|(step, i)| f(step, place(i))).collect();
    fs::write(path, npy_bytes("|u1", &format!("{num_steps}, {nz}, {ny}, {nx}"), &samples)).unwrap();
}

/// Numbers that look random, of 64 bits: SplitMix64.
pub fn noise(seed: u64) -> u64 {
    let mut z = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}

/// A picture.
pub fn picture(path: impl AsRef<Path>) -> Image8 {
    read_png(path.as_ref()).unwrap()
}

/// The mean difference of two pictures of one size, over pixels and channels, in steps of 1 / 255.
pub fn mean_difference(a: &Image8, b: &Image8) -> f64 {
    assert_eq!([a.width, a.height], [b.width, b.height]);
    let pairs = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    let sum: u64 = pairs.map(|(&a, &b)| u64::from(a.abs_diff(b))).sum();
    sum as f64 / (4 * a.pixels.len()) as f64
}
