//! Every way in which a folder can be wrong: an error of one line that names the file and the remedy, and the
//! same finding in an inspection.
#![cfg(feature = "codecs")]
#![allow(clippy::unwrap_used, clippy::panic)]

mod support;

use std::fs;
use std::path::Path;

use rgbd_io::{CustomFolder, CustomOptions, FrameSource, Image, Mask, MaskSource, Severity, inspect};

/// A change of a valid folder of three frames (masks for all) and what the error must say.
struct Case {
    name: &'static str,
    damage: fn(&Path),
    options: CustomOptions,
    says: &'static [&'static str],
}

fn case(name: &'static str, damage: fn(&Path), says: &'static [&'static str]) -> Case {
    Case { name, damage, options: CustomOptions::default(), says }
}

fn with(options: CustomOptions, case: Case) -> Case {
    Case { options, ..case }
}

fn remove(dir: &Path, name: &str) {
    let path = dir.join(name);
    if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) }.unwrap();
}

fn copy(dir: &Path, from: &str, to: &str) {
    fs::copy(dir.join(from), dir.join(to)).unwrap();
}

fn halve(dir: &Path, name: &str) {
    let bytes = fs::read(dir.join(name)).unwrap();
    fs::write(dir.join(name), &bytes[..bytes.len() / 2]).unwrap();
}

fn k(dir: &Path, text: &str) {
    fs::write(dir.join("cam_K.txt"), text).unwrap();
}

fn depth_of(dir: &Path, metres: f32) {
    rgbd_io::write_png_depth(&dir.join("depth/0000.png"), &Image::filled(40, 30, metres)).unwrap();
}

fn mask_of(dir: &Path, mask: &Mask) {
    rgbd_io::write_png_mask(&dir.join("masks/0000.png"), mask).unwrap();
}

fn all() -> CustomOptions {
    CustomOptions { masks: MaskSource::All, ..Default::default() }
}

fn folder_cases() -> Vec<Case> {
    vec![
        case("no folder", |d| fs::remove_dir_all(d).unwrap(), &["no such folder", "cam_K.txt"]),
        case("no rgb", |d| remove(d, "rgb"), &["rgb:", "no such folder", "rgb/0000.png"]),
        case(
            "empty rgb",
            |d| ["0000", "0001", "0002"].iter().for_each(|i| remove(d, &format!("rgb/{i}.png"))),
            &["rgb:", "no .png or .jpg", "put the colour images"],
        ),
        case(
            "two of a name",
            |d| copy(d, "rgb/0001.png", "rgb/0001.jpg"),
            &["0001.png", "same frame", "keep one"],
        ),
        case("no depth folder", |d| remove(d, "depth"), &["depth:", "no such folder", "16-bit PNG"]),
        case(
            "depth as exr",
            |d| {
                remove(d, "depth");
                fs::create_dir(d.join("depth")).unwrap();
                fs::write(d.join("depth/0000.exr"), "v/1").unwrap();
            },
            &["no .png files but 1 such as 0000.exr", "16-bit PNG"],
        ),
        case(
            "no first depth",
            |d| remove(d, "depth/0000.png"),
            &["depth/0000.png", "is missing", "export the depth"],
        ),
        case("no camera", |d| remove(d, "cam_K.txt"), &["cam_K.txt", "is missing", "fx 0 cx"]),
        case("short camera", |d| k(d, "500 0 320 0"), &["cam_K.txt", "4 numbers instead of 9", "fx 0 cx"]),
        case("empty camera", |d| k(d, ""), &["cam_K.txt", "0 numbers", "fx 0 cx"]),
        case("nan camera", |d| k(d, "nan 0 20 0 40 15 0 0 1"), &["cam_K.txt", "finite", "fx 0 cx"]),
        case("infinite camera", |d| k(d, "40 0 20 0 inf 15 0 0 1"), &["cam_K.txt", "finite", "fx 0 cx"]),
        case("negative camera", |d| k(d, "-40 0 20 0 40 15 0 0 1"), &["cam_K.txt", "positive", "fx 0 cx"]),
        case(
            "camera of 80x60",
            |d| k(d, "80 0 40.5 0 80 30.5 0 0 1"),
            &["cam_K.txt", "outside", "81x61", "0.493"],
        ),
        case("point left", |d| k(d, "40 0 -3 0 40 15 0 0 1"), &["cam_K.txt", "outside", "crop's corner"]),
        case(
            "camera is a folder",
            |d| {
                remove(d, "cam_K.txt");
                fs::create_dir(d.join("cam_K.txt")).unwrap()
            },
            &["cam_K.txt", "isn't a file"],
        ),
        with(
            CustomOptions { depth_scale: f64::NAN, ..Default::default() },
            case("nan scale", |_| (), &["NaN", "--depth-scale"]),
        ),
        with(
            CustomOptions { depth_scale: -1.0, ..Default::default() },
            case("negative scale", |_| (), &["-1", "--depth-scale"]),
        ),
    ]
}

fn depth_cases() -> Vec<Case> {
    vec![
        case(
            "8-bit depth",
            |d| fs::write(d.join("depth/0000.png"), support::png_grey8(40, 30, 9)).unwrap(),
            &["depth/0000.png", "8-bit", "16-bit PNG in millimetres"],
        ),
        case(
            "colour depth",
            |d| copy(d, "rgb/0000.png", "depth/0000.png"),
            &["depth/0000.png", "colour image", "16-bit PNG"],
        ),
        case("truncated depth", |d| halve(d, "depth/0000.png"), &["depth/0000.png", "truncated", "again"]),
        case(
            "empty depth",
            |d| fs::write(d.join("depth/0000.png"), "").unwrap(),
            &["depth/0000.png", "0 bytes", "again"],
        ),
        case(
            "depth of another size",
            |d| rgbd_io::write_png_depth(&d.join("depth/0000.png"), &Image::filled(20, 15, 0.5)).unwrap(),
            &["depth/0000.png", "20x15", "40x30", "register depth to colour"],
        ),
        case("no depth in it", |d| depth_of(d, 0.0), &["depth/0000.png", "no depth", "start at a frame"]),
        case(
            "no depth on the object",
            |d| {
                let mask = support::mask();
                let hole = Image::from_fn(40, 30, |x, y| if mask[(x, y)] > 0 { 0.0 } else { 1.0 });
                rgbd_io::write_png_depth(&d.join("depth/0000.png"), &hole).unwrap();
            },
            &["depth/0000.png", "no depth inside", "belong to this frame"],
        ),
        case("depth in metres", |d| depth_of(d, 0.002), &["depth/0000.png", "metres", "--depth-scale 1"]),
        case("depth in 0.1 mm", |d| depth_of(d, 32.0), &["depth/0000.png", "tenths", "--depth-scale 0.0001"]),
        with(
            CustomOptions { depth_scale: 1.0, ..Default::default() },
            case(
                "millimetres read as metres",
                |_| (),
                &["depth/0000.png", "millimetres", "--depth-scale 0.001"],
            ),
        ),
    ]
}

fn image_cases() -> Vec<Case> {
    vec![
        case("truncated colour", |d| halve(d, "rgb/0000.png"), &["rgb/0000.png", "truncated", "again"]),
        case(
            "empty colour",
            |d| fs::write(d.join("rgb/0000.png"), "").unwrap(),
            &["rgb/0000.png", "0 bytes", "again"],
        ),
        case(
            "text as colour",
            |d| fs::write(d.join("rgb/0000.png"), "hello").unwrap(),
            &["rgb/0000.png", "isn't a PNG or JPEG", "convert"],
        ),
        case(
            "colour is a folder",
            |d| {
                remove(d, "rgb/0000.png");
                fs::create_dir(d.join("rgb/0000.png")).unwrap()
            },
            &["rgb/0000.png", "isn't a file"],
        ),
        case(
            "a gigapixel header",
            |d| {
                let png = support::with_header_size(support::png_grey8(40, 30, 1), 60_000, 60_000);
                fs::write(d.join("rgb/0000.png"), png).unwrap();
            },
            &["rgb/0000.png", "60000x60000", "resize"],
        ),
        case(
            "a header of more pixels than the file can hold",
            |d| {
                let png = support::with_header_size(support::png_grey8(40, 30, 1), 7_000, 7_000);
                fs::write(d.join("rgb/0000.png"), png).unwrap();
            },
            &["rgb/0000.png", "7000x7000", "can't hold", "export or copy"],
        ),
        case(
            "no pixels",
            |d| {
                let png = support::with_header_size(support::png_grey8(40, 30, 1), 0, 30);
                fs::write(d.join("rgb/0000.png"), png).unwrap();
            },
            &["rgb/0000.png", "again"],
        ),
        case(
            "a file of 600 MiB",
            |d| fs::File::create(d.join("rgb/0000.png")).unwrap().set_len(600 << 20).unwrap(),
            &["rgb/0000.png", "600 MiB", "resize"],
        ),
        case(
            "no first mask",
            |d| remove(d, "masks"),
            &["masks/0000.png", "first frame needs a mask", "rgb/0000.png in an image editor", "white"],
        ),
        case(
            "empty mask",
            |d| mask_of(d, &Mask::filled(40, 30, 0)),
            &["masks/0000.png", "no pixel", "paint the object white"],
        ),
        case(
            "mask of another shape",
            |d| mask_of(d, &Mask::filled(40, 40, 1)),
            &["masks/0000.png", "40x40", "40x30", "colour image's size"],
        ),
        case("unreadable mask", |d| halve(d, "masks/0000.png"), &["masks/0000.png", "truncated"]),
        with(
            all(),
            case(
                "a mask missing",
                |d| remove(d, "masks/0002.png"),
                &["masks/0002.png", "is missing", "every frame"],
            ),
        ),
        with(
            all(),
            case("masks missing", |d| remove(d, "masks"), &["masks", "no such folder", "every colour image"]),
        ),
        with(
            CustomOptions { first_mask: Some("/no/such/mask.png".into()), ..Default::default() },
            case("first mask elsewhere", |_| (), &["/no/such/mask.png", "check the path"]),
        ),
    ]
}

#[test]
fn every_error_names_the_file_and_the_remedy() {
    for case in folder_cases().into_iter().chain(depth_cases()).chain(image_cases()) {
        let dir = tempfile::tempdir().unwrap();
        support::write(dir.path(), 3, 3);
        (case.damage)(dir.path());
        let Err(error) = CustomFolder::open(dir.path(), &case.options) else { panic!("{} opens", case.name) };
        let message = error.to_string();
        for word in case.says {
            assert!(message.contains(word), "{}: \"{word}\" not in: {message}", case.name);
        }
        assert!(!message.contains('\n') && !error.remedy.is_empty(), "{}: {message}", case.name);

        let seen = inspect(dir.path(), &case.options);
        assert!(seen.has_errors(), "{}: {seen}", case.name);
        let same = seen.findings.iter().any(|f| f.severity == Severity::Error && f.remedy == error.remedy);
        assert!(same, "{}: {message}\n{seen}", case.name);
    }
}

#[test]
fn a_bad_later_frame_is_its_own_error() {
    let dir = tempfile::tempdir().unwrap();
    support::write(dir.path(), 6, 1);
    remove(dir.path(), "depth/0001.png");
    halve(dir.path(), "depth/0002.png");
    halve(dir.path(), "rgb/0003.png");
    rgbd_io::write_png_rgb(&dir.path().join("rgb/0004.png"), &Image::filled(20, 15, [0; 3])).unwrap();
    let folder = CustomFolder::open(dir.path(), &CustomOptions::default()).unwrap();
    for (i, words) in [
        (1, ["depth/0001.png", "is missing"]),
        (2, ["depth/0002.png", "truncated"]),
        (3, ["rgb/0003.png", "truncated"]),
        (4, ["rgb/0004.png", "20x15"]),
        (6, ["6 frames", "index 6"]),
    ] {
        let message = folder.frame(i).unwrap_err().to_string();
        assert!(words.iter().all(|w| message.contains(w)), "{i}: {message}");
    }
    assert!(folder.frame(0).is_ok() && folder.frame(5).is_ok());
    assert!(folder.has_depth(0) && !folder.has_depth(1) && !folder.has_depth(9));

    // Deleted after the folder was listed.
    remove(dir.path(), "depth/0005.png");
    assert!(folder.frame(5).unwrap_err().to_string().contains("is missing"));
}

#[test]
fn a_truncated_jpeg_is_not_taken_for_grey() {
    use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder};
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    let color = Image::from_fn(64, 64, |x, y| [(x * 4) as u8, (y * 4) as u8, (x * y) as u8]);
    let mut jpeg = Vec::new();
    let bytes = color.pixels().as_flattened();
    JpegEncoder::new_with_quality(&mut jpeg, 95).write_image(bytes, 64, 64, ExtendedColorType::Rgb8).unwrap();
    fs::write(&path, &jpeg).unwrap();
    let back = rgbd_io::read_color(&path).unwrap();
    let off =
        back.pixels().as_flattened().iter().zip(bytes).map(|(a, b)| u32::from(a.abs_diff(*b))).sum::<u32>();
    assert!(off < 20 * bytes.len() as u32, "mean error {}", f64::from(off) / bytes.len() as f64);
    // Some cameras pad the file.
    fs::write(&path, [jpeg.as_slice(), &[0; 100]].concat()).unwrap();
    assert!(rgbd_io::read_color(&path).is_ok());
    for part in [1, 2, 3] {
        fs::write(&path, &jpeg[..jpeg.len() * part / 4]).unwrap();
        let message = rgbd_io::read_color(&path).unwrap_err().to_string();
        assert!(message.contains("a.jpg") && message.contains("again"), "{message}");
    }
    fs::write(&path, &jpeg).unwrap();
    assert!(rgbd_io::read_mask(&path).unwrap_err().to_string().contains("save the mask as PNG"));
}
