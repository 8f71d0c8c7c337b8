//! Bytes flipped in every file of a store: found by `verify`, survived by `render`, never shown or exported in silence.

use std::{fs, path::Path};

use tempfile::tempdir;

use crate::{
    command::{at, done, one_object, run},
    files::{mean_difference, names_in, noise, picture, tree, write_f32},
};

/// Places flipped in each file.
const NUM_FLIPS: u64 = 3;
/// A brick drawn from its parent changes the picture by less than this, of 255 in the mean.
const LARGEST_CHANGE: f64 = 6.0;

fn store_in(folder: &Path) {
    // Smooth, so that a parent is a good stand-in; a ball of missing samples, so that there are masks.
    write_f32(&folder.join("blob.npy"), [36, 30, 28], |place| {
        let [x, y, z] = place.map(|i| i as f32 - 14.0);
        match x * x + y * y + z * z {
            d if d < 20.0 => f32::NAN,
            d => (-d / 150.0).exp() + 0.01 * x,
        }
    });
    done(folder, "encode blob.npy -o run.cxl --brick 16 -q");
    done(folder, "render run.cxl -o whole.png --size 60x50 -q");
}

#[test]
fn flipped_bytes_are_found_and_never_shown_in_silence() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let whole = picture(folder.join("whole.png"));
    done(folder, "export run.cxl -o whole.npy -q");
    let exact = fs::read(folder.join("whole.npy")).unwrap();
    let (mut num_stood_in, mut num_failed, mut num_not_exported) = (0, 0, 0);
    for (number, (name, bytes)) in tree(&folder.join("run.cxl")).into_iter().enumerate() {
        let Some(bytes) = bytes else { continue };
        let path = folder.join("run.cxl").join(&name);
        let name = name.to_str().unwrap().to_owned();
        for flip in 0..NUM_FLIPS {
            let random = noise(number as u64 * 1000 + flip);
            let place = (random % bytes.len() as u64) as usize;
            let mut damaged = bytes.clone();
            damaged[place] ^= 1 << (random >> 61);
            fs::write(&path, &damaged).unwrap();
            let what = format!("{name}, byte {place} of {}", bytes.len());

            let verified = run(folder, "verify run.cxl --json");
            assert_eq!(verified.status, 1, "{what}: {verified:#?}");
            if verified.stdout.is_empty() {
                assert!(verified.stderr.contains(&name), "{what}: {verified:#?}");
            } else {
                let problems = at(&one_object(&verified), "problems").to_string();
                assert!(problems.contains(&name), "{what}: {problems}");
            }

            let exported = run(folder, "export run.cxl -o part.npy -q");
            if exported.status == 0 {
                assert!(fs::read(folder.join("part.npy")).unwrap() == exact, "{what}: exported otherwise");
                fs::remove_file(folder.join("part.npy")).unwrap();
            } else {
                assert_eq!(exported.status, 1, "{what}: {exported:#?}");
                assert!(exported.stderr.contains(&name), "{what}: {exported:#?}");
                assert_eq!(names_in(folder), ["blob.npy", "run.cxl", "whole.npy", "whole.png"]);
                num_not_exported += 1;
            }

            let drawn = run(folder, "render run.cxl -o part.png --size 60x50 -q");
            if drawn.status == 0 {
                let change = mean_difference(&picture(folder.join("part.png")), &whole);
                let warned = drawn.stderr.contains("chronoxel: warning: ");
                assert!(warned || change == 0.0, "{what}: {change}");
                assert!(change < LARGEST_CHANGE, "{what}: {change}, {drawn:#?}");
                if warned {
                    num_stood_in += 1;
                    let names_it =
                        drawn.stderr.contains(&name) && drawn.stderr.lines().all(|l| l.contains("level"));
                    assert!(names_it, "{what}: {drawn:#?}");
                }
                fs::remove_file(folder.join("part.png")).unwrap();
            } else {
                assert_eq!(drawn.status, 1, "{what}: {drawn:#?}");
                assert!(drawn.stderr.contains(&name), "{what}: {drawn:#?}");
                assert!(!folder.join("part.png").exists());
                num_failed += 1;
            }
        }
        fs::write(&path, &bytes).unwrap();
    }
    let counts = [num_stood_in, num_failed, num_not_exported];
    assert!(counts.iter().all(|&count| count > 0), "stood in, failed, not exported: {counts:?}");
}
