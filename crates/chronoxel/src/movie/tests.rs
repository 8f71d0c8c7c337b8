//! Every format is written and read back with a decoder that is not ours.

use std::fs::{self, File};
use std::path::Path;
use std::process::Command;

use chronoxel_core::{Image8, compare};
use tempfile::tempdir;

use super::mp4::Mp4;
use super::*;

/// A smooth picture on black with a square whose place depends on `phase`.
pub(crate) fn picture(width: usize, height: usize, phase: usize) -> Image8 {
    let mut image = Image8::filled(width, height, [0, 0, 0, 255]);
    for y in height / 4..height / 2 {
        for x in 0..width / 2 {
            let column = (x + phase).min(width - 1);
            image.pixels[y * width + column] = [(x * 255 / width) as u8, (y * 255 / height) as u8, 90, 255];
        }
    }
    image
}

fn options(size: [usize; 2], fps: f64, num_frames: usize) -> MovieOptions {
    MovieOptions { size, fps, num_frames }
}

/// Writes `images` as a movie of 20 pictures per second.
fn write_movie(output: &Path, images: &[Image8]) -> Result<()> {
    let size = [images[0].width, images[0].height];
    let mut sink = create(output.to_str().unwrap(), options(size, 20.0, images.len()))?;
    for (step, image) in images.iter().enumerate() {
        sink.write_frame(&Frame { image, step: 10 * step, time: 0.5 * step as f64 })?;
    }
    sink.finish()
}

fn names_in(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn ffmpeg_is_here() -> bool {
    let here = ["ffmpeg", "ffprobe"].iter().all(|p| Command::new(p).arg("-version").output().is_ok());
    if !here {
        println!("skipped: ffmpeg and ffprobe are not on the PATH");
    }
    here
}

#[test]
fn png_round_trip_keeps_every_pixel() {
    let folder = tempdir().unwrap();
    let mut image = picture(7, 5, 1);
    for (name, alpha) in [("opaque.png", 255), ("clear.png", 3)] {
        image.pixels[4] = [1, 2, 3, alpha];
        let path = folder.path().join("new/folder").join(name);
        write_png(&path, &image).unwrap();
        assert_eq!(read_png(&path).unwrap(), image);
    }
    assert_eq!(names_in(&folder.path().join("new/folder")), ["clear.png", "opaque.png"]);
}

#[test]
fn png_of_other_kinds_are_read() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("gray16.png");
    let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 2, 1);
    encoder.set_depth(png::BitDepth::Sixteen);
    encoder.write_header().unwrap().write_image_data(&[0x80, 0x00, 0xff, 0xff]).unwrap();
    assert_eq!(read_png(&path).unwrap().pixels, [[128, 128, 128, 255], [255; 4]]);
    let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 2, 1);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_palette(vec![9, 8, 7, 1, 2, 3]);
    encoder.set_trns(vec![255, 0]);
    encoder.write_header().unwrap().write_image_data(&[0, 1]).unwrap();
    assert_eq!(read_png(&path).unwrap().pixels, [[9, 8, 7, 255], [1, 2, 3, 0]]);
}

#[test]
fn damaged_pictures_are_one_line_errors() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("a.png");
    write_png(&path, &picture(40, 40, 0)).unwrap();
    let whole = fs::read(&path).unwrap();
    for damaged in [&whole[..0], &whole[..20], &whole[..whole.len() / 2], b"GIF89a, not a picture"] {
        fs::write(&path, damaged).unwrap();
        let error = format!("{:#}", read_png(&path).unwrap_err());
        assert!(error.contains("a.png") && !error.contains('\n'), "{error}");
    }
    for size in [[0x7fu8, 0xff, 0xff, 0xff], [0, 0, 0x3f, 0xff]] {
        fs::write(&path, [&whole[..16], &size, &size, &whole[24..]].concat()).unwrap();
        fix_header_checksum(&path);
        let error = format!("{:#}", read_png(&path).unwrap_err());
        assert!(error.contains("limits") || error.contains("more than its"), "{error}");
    }
    assert!(format!("{:#}", read_png(&folder.path().join("no.png")).unwrap_err()).contains("no.png"));
}

/// Gives the header of a PNG the checksum that belongs to it.
fn fix_header_checksum(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    let crc = bytes[12..29].iter().fold(!0u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |c, _| (c >> 1) ^ if c & 1 == 1 { 0xedb8_8320 } else { 0 })
    });
    bytes[29..33].copy_from_slice(&(!crc).to_be_bytes());
    fs::write(path, bytes).unwrap();
}

#[test]
fn numbered_pictures_appear_together() {
    let folder = tempdir().unwrap();
    let images = [picture(6, 4, 0), picture(6, 4, 1)];
    write_movie(&folder.path().join("f/{frame:03}_{step}_{time}.png"), &images).unwrap();
    assert_eq!(names_in(&folder.path().join("f")), ["000_0_0.png", "001_10_0.5.png"]);
    assert_eq!(read_png(&folder.path().join("f/001_10_0.5.png")).unwrap(), images[1]);
    let error = write_movie(&folder.path().join("g/{time:.0}x.png"), &images).unwrap_err().to_string();
    assert!(error.contains("0x.png") && error.contains("{frame}"), "{error}");
    assert_eq!(names_in(folder.path()), ["f"]);
}

#[test]
fn apng_frames_are_exact_and_timed() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("m.apng");
    let images = [picture(20, 16, 0), picture(20, 16, 3), picture(20, 16, 3), picture(20, 16, 6)];
    write_movie(&path, &images).unwrap();
    let mut reader =
        png::Decoder::new(std::io::BufReader::new(File::open(&path).unwrap())).read_info().unwrap();
    assert_eq!(reader.info().animation_control.unwrap().num_frames, 4);
    let mut canvas = Image8::filled(20, 16, [0; 4]);
    for image in &images {
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut bytes).unwrap();
        let control = reader.info().frame_control.unwrap();
        assert_eq!((control.delay_num, control.delay_den), (1, 20));
        for (i, pixel) in bytes.chunks(4).take((control.width * control.height) as usize).enumerate() {
            let (x, y) =
                (i as u32 % control.width + control.x_offset, i as u32 / control.width + control.y_offset);
            canvas.pixels[(y * 20 + x) as usize] = pixel.try_into().unwrap();
        }
        assert_eq!(&canvas, image);
    }
}

/// The pictures of a GIF as a player shows them (none of ours is disposed of unless it is transparent).
fn shown_gif(path: &Path) -> (Vec<Image8>, Vec<u16>) {
    let mut settings = ::gif::DecodeOptions::new();
    settings.set_color_output(::gif::ColorOutput::RGBA);
    let mut decoder = settings.read_info(File::open(path).unwrap()).unwrap();
    let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
    let (mut canvas, mut images, mut delays) =
        (Image8::filled(width, height, [0; 4]), Vec::new(), Vec::new());
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        if frame.dispose == ::gif::DisposalMethod::Background {
            canvas.pixels.fill([0; 4]);
        }
        for (i, pixel) in frame.buffer.chunks(4).enumerate() {
            let (x, y) = (i % usize::from(frame.width), i / usize::from(frame.width));
            let at = (y + usize::from(frame.top)) * width + x + usize::from(frame.left);
            canvas.pixels[at] = pixel.try_into().unwrap();
        }
        images.push(canvas.clone());
        delays.push(frame.delay);
    }
    (images, delays)
}

#[test]
fn gif_of_few_colours_is_exact() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("m.gif");
    let images = [picture(20, 16, 0), picture(20, 16, 3), picture(20, 16, 3)];
    write_movie(&path, &images).unwrap();
    let (shown, delays) = shown_gif(&path);
    assert_eq!(shown, images);
    assert_eq!(delays, [5, 5, 5]);
}

#[test]
fn gif_of_many_colours_looks_the_same() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("m.gif");
    let mut image = Image8::filled(128, 128, [0, 0, 0, 255]);
    for (i, pixel) in image.pixels.iter_mut().enumerate() {
        let (x, y) = ((i % 128) as f64 / 128.0, (i / 128) as f64 / 128.0);
        let light = (1.0 - 4.0 * ((x - 0.5).powi(2) + (y - 0.5).powi(2))).max(0.0);
        let color = [light * (0.3 + 0.7 * x), light * y, light * (1.0 - 0.8 * x)];
        *pixel = [color[0], color[1], color[2], 1.0].map(|c| (255.0 * c) as u8);
    }
    write_movie(&path, std::slice::from_ref(&image)).unwrap();
    let found = compare(&shown_gif(&path).0[0], &image).unwrap();
    // The best that Pillow 13 reaches on this picture: 38.04 dB (maximum coverage), SSIM 0.9404 (median cut);
    // the NeuQuant of the gif crate has 36.37 dB and 0.932.
    assert!(found.psnr_db > 38.04 && found.ssim.unwrap() > 0.9404, "{found:?}");
}

#[test]
fn gif_keeps_a_transparent_background() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("m.gif");
    let mut images = [picture(8, 8, 0), picture(8, 8, 2)];
    images.iter_mut().for_each(|image| image.pixels[..16].fill([0; 4]));
    write_movie(&path, &images).unwrap();
    assert_eq!(shown_gif(&path).0, images);
}

#[test]
fn mp4_has_the_announced_frames_and_nearly_the_pixels() {
    if !ffmpeg_is_here() {
        return;
    }
    let folder = tempdir().unwrap();
    let path = folder.path().join("-odd name: 100%.mp4");
    let images: Vec<Image8> = (0..6).map(|i| picture(97, 65, 4 * i)).collect();
    write_movie(&path, &images).unwrap();
    let path = folder.path().join("-odd name: 100%.mp4");
    let entries = "stream=codec_name,pix_fmt,width,height,nb_read_frames,r_frame_rate,color_space";
    let probed = Command::new("ffprobe")
        .args(["-v", "error", "-count_frames", "-of", "default=nw=1", "-show_entries", entries])
        .arg(&path)
        .output()
        .unwrap();
    let told = String::from_utf8(probed.stdout).unwrap();
    for expected in [
        "codec_name=h264",
        "pix_fmt=yuv420p",
        "width=98",
        "height=66",
        "nb_read_frames=6",
        "r_frame_rate=20/1",
        "color_space=bt709",
    ] {
        assert!(told.lines().any(|line| line == expected), "no {expected} in {told}");
    }
    let decoded = folder.path().join("5.png");
    let args = ["-v", "error", "-vf", "select=eq(n\\,5),format=rgb24,crop=97:65:0:0", "-frames:v", "1"];
    Command::new("ffmpeg").arg("-i").arg(&path).args(args).arg(&decoded).status().unwrap();
    let found = compare(&read_png(&decoded).unwrap(), &images[5]).unwrap();
    assert!(found.psnr_db > 28.0, "{found:?}");
    assert_eq!(names_in(folder.path()), ["-odd name: 100%.mp4", "5.png"]);
}

#[test]
fn a_missing_ffmpeg_is_named_with_its_remedy() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("sub/m.mp4");
    let error = Mp4::create_with("ffmpeg-that-is-not-there", &path, options([4, 4], 10.0, 1)).err().unwrap();
    let text = error.to_string();
    assert!(text.contains("m.mp4") && text.contains("install it") && text.contains(".gif"), "{text}");
    assert!(names_in(folder.path()).is_empty());
}

#[cfg(unix)]
#[test]
fn what_a_failing_ffmpeg_says_is_told() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempdir().unwrap();
    let program = folder.path().join("fake");
    fs::write(&program, "#!/bin/sh\ncat >/dev/null\necho 'Unknown encoder x' >&2\nexit 1\n").unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    let path = folder.path().join("m.mp4");
    let mut sink: Box<dyn FrameSink> =
        Box::new(Mp4::create_with(program.to_str().unwrap(), &path, options([4, 4], 10.0, 1)).unwrap());
    sink.write_frame(&Frame { image: &picture(4, 4, 0), step: 0, time: 0.0 }).unwrap();
    let text = sink.finish().unwrap_err().to_string();
    assert!(text.contains("m.mp4") && text.contains("Unknown encoder x"), "{text}");
    assert_eq!(names_in(folder.path()), ["fake"]);
}

#[test]
fn nothing_is_left_of_a_movie_that_was_not_finished() {
    let folder = tempdir().unwrap();
    let mut names = vec!["new/m.gif", "new/m.apng", "new/{frame}.png"];
    if ffmpeg_is_here() {
        names.push("new/m.mp4");
    }
    for name in names {
        let output = folder.path().join(name);
        let start = || {
            let mut sink = create(output.to_str().unwrap(), options([8, 8], 5.0, 3)).unwrap();
            for phase in 0..2 {
                sink.write_frame(&Frame { image: &picture(8, 8, phase), step: phase, time: 0.0 }).unwrap();
            }
            sink
        };
        drop(start());
        assert!(names_in(folder.path()).is_empty(), "{name} was dropped");
        let error = start().finish().unwrap_err().to_string();
        assert!(error.contains("2 of its 3"), "{error}");
        assert!(names_in(folder.path()).is_empty(), "{name} was too short");
        let error = start().write_frame(&Frame { image: &picture(9, 8, 0), step: 2, time: 0.0 }).unwrap_err();
        assert!(error.to_string().contains("9x8"), "{error}");
        assert!(names_in(folder.path()).is_empty(), "{name} got a picture of another size");
    }
}

#[test]
fn a_movie_that_fails_leaves_the_one_before() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("m.gif");
    fs::write(&path, "the movie before").unwrap();
    drop(create(path.to_str().unwrap(), options([8, 8], 5.0, 3)).unwrap());
    assert_eq!(fs::read_to_string(&path).unwrap(), "the movie before");
    assert_eq!(names_in(folder.path()), ["m.gif"]);
}

#[test]
fn outputs_that_make_no_sense_are_refused() {
    let folder = tempdir().unwrap();
    let tell = |name: &str, options| {
        let output = folder.path().join(name);
        format!("{:#}", create(output.to_str().unwrap(), options).err().unwrap())
    };
    let good = options([8, 8], 5.0, 3);
    assert!(tell("m.png", good).contains("{frame:04}"));
    assert!(tell("m.avi", good).contains(".mp4"));
    assert!(tell("{frame}.jpg", good).contains(".png"));
    assert!(tell("m.gif", MovieOptions { fps: f64::NAN, ..good }).contains("fps"));
    assert!(tell("m.gif", MovieOptions { size: [0, 8], ..good }).contains("0x8"));
    assert!(tell("m.gif", MovieOptions { num_frames: 0, ..good }).contains("step"));
    fs::create_dir(folder.path().join("d.gif")).unwrap();
    assert!(tell("d.gif", good).contains("folder"));
    fs::write(folder.path().join("file"), "").unwrap();
    assert!(tell("file/m.gif", good).contains("file"));
}

#[test]
fn delays_are_exact_fractions() {
    assert_eq!(delay_fraction(24.0), (1, 24));
    assert_eq!(delay_fraction(0.5), (2, 1));
    assert_eq!(delay_fraction(12.5), (2, 25));
    assert_eq!(delay_fraction(30000.0 / 1001.0), (1001, 30000));
    assert_eq!(delay_fraction(0.01), (100, 1));
    assert_eq!(delay_fraction(1000.0), (1, 1000));
}
