//! Comparison of pictures, held to what scikit-image finds (`fixtures/compare/make.py`).

use chronoxel_core::{Image8, compare};

/// A fixture, decoded to RGBA.
fn decoded(png: &[u8]) -> Image8 {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(png));
    decoder.set_transformations(png::Transformations::ALPHA);
    let mut reader = decoder.read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    Image8::from_rgba(info.width as usize, info.height as usize, &bytes).unwrap()
}

#[test]
fn figures_are_those_of_scikit_image() {
    let a = decoded(include_bytes!("fixtures/compare/a.png"));
    let b = decoded(include_bytes!("fixtures/compare/b.png"));
    let found = compare(&a, &b).unwrap();
    assert!((found.psnr_db - 21.748555857751303).abs() < 1e-10, "{found:?}");
    assert!((found.ssim.unwrap() - 0.8361551480278003).abs() < 1e-9, "{found:?}");
    // scikit-image has other digits of the primaries and the white point.
    assert!((found.luv_mean - 14.406941885388296).abs() < 2e-3, "{found:?}");
    assert!((found.luv_max - 101.57298596024815).abs() < 2e-2, "{found:?}");
    assert_eq!(found.differing_pixels, 1643);
}

#[test]
fn figures_are_symmetric() {
    let a = decoded(include_bytes!("fixtures/compare/a.png"));
    let b = decoded(include_bytes!("fixtures/compare/b.png"));
    let (there, back) = (compare(&a, &b).unwrap(), compare(&b, &a).unwrap());
    assert_eq!((there.psnr_db, there.luv_max), (back.psnr_db, back.luv_max));
    assert!((there.ssim.unwrap() - back.ssim.unwrap()).abs() < 1e-14);
}
