//! Playing: pictures are those of `render`, budgets hold, what rests is finished, what is late is said.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use chronoxel::player::{Late, Player, PlayerOptions};
use chronoxel::session::{Picture, Session, View, orbit_camera};
use chronoxel_core::{Camera, ColorMap, Image, Projection, TransferFunction};
use chronoxel_ingest::{Codec, EncodeOptions, encode, sources};
use chronoxel_render::GpuPicture;

/// 12 steps of 8³ bricks in windows of 4 steps, which begin out of phase: encoded once for all tests.
fn store() -> &'static Path {
    static STORE: OnceLock<PathBuf> = OnceLock::new();
    STORE.get_or_init(|| encoded(Path::new(env!("CARGO_TARGET_TMPDIR"))))
}

fn encoded(folder: &Path) -> PathBuf {
    let store = folder.join("player.cxl");
    // Of an earlier run.
    let _ = std::fs::remove_dir_all(&store);
    let mut series = sources::open(&["sim:vortex?dims=40&steps=12".to_owned()], &Default::default()).unwrap();
    let options =
        EncodeOptions { brick_edge: 8, codec: Codec::Palette, window: Some(4), ..EncodeOptions::default() };
    encode(series.as_mut(), &store, &options, &mut |_| {}).unwrap();
    store
}

fn view_of(session: &Session, azimuth: f64) -> View {
    let grid = session.store().header().grid;
    let size = [56, 42];
    let transfer = TransferFunction::built_in("filled", ColorMap::Viridis).unwrap();
    View {
        camera: orbit_camera(&grid, [azimuth, 20.0], 1.3, Some(30.0), size).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: None,
        opacity_unit: grid.smallest_spacing(),
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    }
}

fn player(store: &Path, memory_bytes: u64, order: &[u32], options: PlayerOptions) -> Player {
    Player::new(Session::open(store, None, memory_bytes).unwrap(), order.to_vec(), options).unwrap()
}

fn image(picture: Picture<GpuPicture>) -> Image {
    match picture.image {
        GpuPicture::Floats(image) => image,
        other => panic!("{other:?} came back"),
    }
}

#[test]
fn every_step_looks_as_it_is_rendered() {
    let store = store();
    let forwards: Vec<u32> = (0..12).collect();
    let backwards: Vec<u32> = (0..12).rev().collect();
    let strided: Vec<u32> = (0..12).step_by(5).collect();
    let options = PlayerOptions { redraws: true, ..PlayerOptions::default() };
    for order in [forwards, backwards, strided] {
        let mut rendered = Session::open(store, None, 1 << 30).unwrap();
        let mut player = player(store, 8 << 20, &order, options);
        // Twice round.
        for (place, step) in order.iter().chain(&order).enumerate() {
            let view = view_of(&rendered, 30.0 + place as f64);
            let played = player.next(&view).unwrap();
            let picture = played.picture.unwrap();
            assert_eq!((played.place, played.num_dropped, played.num_stand_ins), (place, 0, 0));
            assert!(picture.warnings.is_empty(), "{:?}", picture.warnings);
            assert!(image(picture) == rendered.draw(&view, *step as usize).unwrap().image, "step {step}");
        }
        assert_eq!(player.session().num_read_in_drawing(), 0, "drawing had to read");
    }
}

#[test]
fn budgets_hold_when_the_slider_is_dragged_and_the_camera_jumps() {
    let store = store();
    let order: Vec<u32> = (0..12).collect();
    let options = PlayerOptions { redraws: true, ..PlayerOptions::default() };
    let mut player = player(store, 1 << 20, &order, options);
    let mut random = 1u64;
    for _ in 0..60 {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let view = view_of(player.session(), (random >> 33) as f64 % 360.0);
        let played = player.frame(&view, (random >> 50) as usize % 12).unwrap();
        assert!(image(played.picture.unwrap()).pixels.iter().any(|p| p[3] > 0.1), "nothing is shown");
        let [peak, budget] = player.payload_bytes();
        assert!(peak <= budget, "{peak} of {budget} bytes");
    }
    // So little memory that the finest level does not fit.
    assert!(player.session().num_read_in_drawing() == 0);
}

#[test]
fn what_rests_is_refined_to_full_quality_and_then_not_drawn() {
    let store = store();
    let order: Vec<u32> = (0..12).collect();
    // A target that nothing can meet: while it moves, it is coarse.
    let options = PlayerOptions { target_fps: Some(100_000.0), ..PlayerOptions::default() };
    let mut player = player(store, 64 << 20, &order, options);
    let mut coarsest = usize::MAX;
    for azimuth in 0..8 {
        let view = view_of(player.session(), f64::from(azimuth) * 10.0);
        coarsest = coarsest.min(player.frame(&view, 5).unwrap().num_nodes);
    }
    let view = view_of(player.session(), 200.0);
    let mut last = None;
    for _ in 0..500 {
        match player.frame(&view, 5).unwrap().picture {
            Some(picture) => last = Some(image(picture)),
            None => break,
        }
    }
    let rendered = Session::open(store, None, 1 << 30).unwrap().draw(&view, 5).unwrap().image;
    assert!(last.unwrap() == rendered, "the picture at rest is not that of render");
    let idle = player.frame(&view, 5).unwrap();
    assert!(idle.picture.is_none() && idle.is_settled);
    assert!(coarsest < 8, "{coarsest} nodes however fast it has to be");
    // Anything that changes is drawn.
    assert!(player.frame(&view, 6).unwrap().picture.is_some());
}

/// What is expected decides how much may be drawn: where the eye is within the volume, too, and sees parts of bricks.
#[test]
fn samples_are_expected_before_they_are_taken() {
    let store = store();
    let options = PlayerOptions { redraws: true, ..PlayerOptions::default() };
    let mut player = player(store, 64 << 20, &[5], options);
    let bounds = player.session().store().header().grid.bounds();
    let at = |shares: [f64; 3]| -> [f64; 3] {
        std::array::from_fn(|a| bounds[0][a] + shares[a] * (bounds[1][a] - bounds[0][a]))
    };
    for (eye, goal) in [
        ([0.5, -4.0, 0.5], [0.5; 3]),
        ([0.4, -0.3, 0.3], [0.6, 0.5, 0.5]),
        ([0.31, 0.33, 0.52], [0.9, 0.8, 0.6]),
        ([0.77, 0.52, 0.48], [0.8, 0.6, 0.45]),
    ] {
        let projection = Projection::Perspective { fov_y_deg: 30.0 };
        let camera = Camera::new(at(eye), at(goal), [0.0, 0.0, 1.0], projection).unwrap();
        // So thin that no ray ends early.
        let view = View { camera, opacity_unit: 1e9, ..view_of(player.session(), 0.0) };
        let played = player.next(&view).unwrap();
        let decoded = 0.25 * 11f64.powi(3) * played.num_drawn as f64;
        let (expected, taken) = (played.expected_cost - decoded, played.picture.unwrap().samples as f64);
        println!("{eye:?}: {expected:.0} expected, {taken} taken in {} bricks", played.num_drawn);
        assert!(taken > 1000.0 && (0.7..1.5).contains(&(expected / taken)), "{eye:?}: {expected} {taken}");
    }
}

#[test]
fn late_steps_are_left_out_or_waited_for() {
    let store = store();
    let order: Vec<u32> = (0..12).collect();
    let throttle = Some(2_000_000.0);
    let wait = PlayerOptions { throttle, redraws: true, ..PlayerOptions::default() };
    let mut waits = player(store, 64 << 20, &order, wait);
    let view = view_of(waits.session(), 30.0);
    let waited: f64 = (0..12).map(|_| waits.next(&view).unwrap().wait_ms).sum();
    assert!(waited > 1.0, "{waited} ms");
    // Frames go on at their own pace, and steps are left out for which there is no time.
    let drop = PlayerOptions { late: Late::Drop, ..wait };
    let mut drops = player(store, 64 << 20, &order, drop);
    let (mut late, mut dropped) = (0, 0);
    for frame in 0..100_000 {
        let played = drops.next(&view).unwrap();
        assert!(played.picture.is_some(), "nothing is shown");
        assert!(frame == 0 || played.place == 0 || played.num_stand_ins == 0, "what is shown is incomplete");
        (late, dropped) = (late + usize::from(played.is_late), played.num_dropped);
        if dropped > 0 {
            break;
        }
    }
    assert!(late > 0 && dropped > 0, "{late} late, {dropped} left out");
}

#[test]
fn a_damaged_brick_is_stood_in_for_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let shards = shards_of_stages(&store);
    assert!(!shards.is_empty());
    for shard in shards {
        let mut bytes = std::fs::read(&shard).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle / 2..middle].fill(0);
        std::fs::write(&shard, bytes).unwrap();
    }
    let options = PlayerOptions { redraws: true, ..PlayerOptions::default() };
    let mut player = player(&store, 64 << 20, &[3, 4], options);
    let view = view_of(player.session(), 30.0);
    let mut warnings = Vec::new();
    for _ in 0..4 {
        let played = player.next(&view).unwrap();
        warnings.extend(played.picture.unwrap().warnings);
    }
    assert!(warnings.iter().any(|w| w.contains("brick") && w.contains("level 0")), "{warnings:?}");
    // What cannot be read is not waited for: at rest nothing more is done.
    let rests = PlayerOptions::default();
    let mut player = Player::new(Session::open(&store, None, 64 << 20).unwrap(), vec![3], rests).unwrap();
    assert!((0..200).any(|_| player.frame(&view, 0).unwrap().picture.is_none()), "never at rest");
}

/// Shards of payloads below a folder.
fn shards_of_stages(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        if entry.is_dir() {
            found.extend(shards_of_stages(&entry));
        } else if entry.components().any(|part| part.as_os_str() == "S0")
            && entry.components().any(|part| part.as_os_str() == "L0")
            && entry.extension().is_some_and(|e| e != "json")
        {
            found.push(entry);
        }
    }
    found
}

#[test]
fn orders_that_cannot_be_played_are_refused() {
    let store = store();
    let open = || Session::open(store, None, 1 << 30).unwrap();
    for (order, problem) in [(vec![], "no steps"), (vec![3, 12], "step 12 is not in the store")] {
        let error = Player::new(open(), order, PlayerOptions::default()).err().unwrap();
        assert!(error.to_string().contains(problem), "{error}");
    }
}

/// A disc of one value, without data around it, for two steps; then a spot that grows in it, while the coarse levels stay in their window.
#[test]
fn holes_and_late_changes_are_refined_whatever_the_values() {
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("disc.npy");
    let value = |step: usize, i: usize| {
        let [x, y, z] = [i % 32, i / 32 % 32, i / 1024].map(|k| k as f32 - 15.5);
        match x * x + y * y + z * z {
            r if r > 150.0 => f32::NAN,
            r if step >= 2 && r < 20.0 => 3.0,
            _ => 2.0,
        }
    };
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 32, 32, 32), }";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    let padded = format!("{header:<117}\n");
    bytes.extend((padded.len() as u16).to_le_bytes());
    bytes.extend(padded.as_bytes());
    let samples = (0..4).flat_map(|step| (0..32usize.pow(3)).map(move |i| value(step, i)));
    bytes.extend(samples.flat_map(f32::to_le_bytes));
    std::fs::write(&source, bytes).unwrap();
    let store = folder.path().join("disc.cxl");
    let mut series = sources::open(&[source.to_string_lossy().into_owned()], &Default::default()).unwrap();
    let options =
        EncodeOptions { brick_edge: 8, codec: Codec::Vq, window: Some(4), ..EncodeOptions::default() };
    encode(series.as_mut(), &store, &options, &mut |_| {}).unwrap();
    let mut rendered = Session::open(&store, None, 1 << 30).unwrap();
    let options = PlayerOptions { redraws: true, ..PlayerOptions::default() };
    let mut player = player(&store, 64 << 20, &[0, 1, 2, 3], options);
    let view = view_of(&rendered, 30.0);
    for step in 0..4 {
        let played = player.next(&view).unwrap().picture.unwrap();
        assert!(image(played) == rendered.draw(&view, step).unwrap().image, "step {step}");
    }
}
