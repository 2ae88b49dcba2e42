//! Reading what was written, and looking it over.
#![cfg(feature = "codecs")]
#![allow(clippy::unwrap_used, clippy::print_stderr)]

mod support;

use std::fs;
use std::path::Path;
use std::sync::Arc;

use nalgebra::Isometry3;
use proptest::prelude::*;
use rgbd_io::{
    CustomFolder, CustomOptions, CustomWriter, FrameSource, Image, Inspection, Intrinsics, Mask, MaskSource,
    ReadAhead, Severity, inspect,
};

fn options(masks: MaskSource) -> CustomOptions {
    CustomOptions { masks, ..Default::default() }
}

#[test]
fn a_written_folder_reads_back() {
    let dir = tempfile::tempdir().unwrap();
    support::write(dir.path(), 4, 4);
    let folder = CustomFolder::open(dir.path(), &options(MaskSource::All)).unwrap();
    assert_eq!((folder.len(), folder.size(), folder.id(3), folder.id(4)), (4, support::SIZE, "0003", ""));
    assert_eq!(folder.intrinsics(), support::camera());
    for i in 0..4 {
        let frame = folder.frame(i).unwrap();
        assert_eq!(frame.id, format!("{i:04}"));
        assert_eq!(frame.color, support::color(i));
        assert_eq!(frame.mask, Some(support::mask()));
        assert_eq!(frame.intrinsics, support::camera());
        for (read, written) in frame.depth.pixels().iter().zip(support::depth().pixels()) {
            assert!((read - written).abs() <= 5.1e-4 && (*read == 0.0) == (*written == 0.0));
        }
    }
    assert_eq!(folder.color(2).unwrap(), support::color(2));
}

#[test]
fn masks_come_from_where_the_options_say() {
    let dir = tempfile::tempdir().unwrap();
    support::write(dir.path(), 4, 4);
    let masks = |o: &CustomOptions| -> Vec<Option<Mask>> {
        let folder = CustomFolder::open(dir.path(), o).unwrap();
        (0..folder.len()).map(|i| folder.frame(i).unwrap().mask).collect()
    };
    let some = Some(support::mask());
    assert_eq!(masks(&options(MaskSource::First)), [some.clone(), None, None, None]);
    assert_eq!(masks(&options(MaskSource::None)), [None, None, None, None]);
    let strided = CustomOptions { stride: 2, ..options(MaskSource::All) };
    assert_eq!(masks(&strided), [some.clone(), some.clone()]);
    assert_eq!(masks(&CustomOptions { stride: 0, ..options(MaskSource::All) }).len(), 4);

    fs::rename(dir.path().join("masks"), dir.path().join("other")).unwrap();
    assert_eq!(masks(&options(MaskSource::Folder("other".into()))), vec![some.clone(); 4]);
    assert_eq!(masks(&options(MaskSource::Folder(dir.path().join("other")))), vec![some.clone(); 4]);
    let named = CustomOptions { first_mask: Some(dir.path().join("other/0003.png")), ..Default::default() };
    assert_eq!(masks(&named), [some.clone(), None, None, None]);
    fs::rename(dir.path().join("other"), dir.path().join("mask")).unwrap();
    assert_eq!(masks(&options(MaskSource::First))[0], some);

    // Half the size: resized, every object pixel twice each way.
    let small = Mask::from_fn(20, 15, |x, y| u8::from((5..9).contains(&x) && y == 7));
    rgbd_io::write_png_mask(&dir.path().join("mask/0000.png"), &small).unwrap();
    let read = masks(&options(MaskSource::First))[0].clone().unwrap();
    let expected = Mask::from_fn(40, 30, |x, y| if small[(x / 2, y / 2)] != 0 { 255 } else { 0 });
    assert_eq!(read, expected);
}

#[test]
fn frames_are_sorted_by_number_and_jpeg_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let writer = CustomWriter::create(dir.path(), &support::camera()).unwrap();
    for i in [10, 9, 100, 1] {
        let mask = support::mask();
        writer.write_frame(&i.to_string(), &support::color(i), &support::depth(), Some(&mask)).unwrap();
    }
    fs::rename(dir.path().join("rgb/9.png"), dir.path().join("rgb/9.PNG")).unwrap();
    fs::write(dir.path().join("rgb/._9.png"), "companion").unwrap();
    fs::write(dir.path().join("rgb/index.txt"), "1 9 10 100").unwrap();
    let folder = CustomFolder::open(dir.path(), &CustomOptions::default()).unwrap();
    let ids: Vec<&str> = (0..folder.len()).map(|i| folder.id(i)).collect();
    assert_eq!(ids, ["1", "9", "10", "100"]);
    assert_eq!(folder.frame(1).unwrap().color, support::color(9));
}

#[test]
fn many_threads_read_one_folder() {
    let dir = tempfile::tempdir().unwrap();
    support::write(dir.path(), 6, 1);
    let folder = Arc::new(CustomFolder::open(dir.path(), &CustomOptions::default()).unwrap());
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope
                .spawn(|| (0..6).for_each(|i| assert_eq!(folder.frame(i).unwrap().color, support::color(i))));
        }
    });
    fs::remove_file(dir.path().join("depth/0002.png")).unwrap();
    let read: Vec<_> = ReadAhead::new(folder as Arc<dyn FrameSource>, (0..6).rev(), 2).collect();
    for (i, frame) in read {
        assert_eq!(frame.is_ok(), i != 2);
    }
}

#[test]
fn writers_refuse_what_would_not_read_back() {
    let dir = tempfile::tempdir().unwrap();
    assert!(CustomWriter::create(dir.path(), &Intrinsics { fx: f64::NAN, ..support::camera() }).is_err());
    let writer = CustomWriter::create(dir.path(), &support::camera()).unwrap();
    let (color, depth) = (support::color(0), support::depth());
    for id in ["", "../a", "a/b", ".hidden"] {
        assert!(writer.write_frame(id, &color, &depth, None).is_err(), "{id}");
        assert!(writer.write_truth_pose(id, &Isometry3::identity()).is_err(), "{id}");
    }
    assert!(writer.write_frame("a", &color, &Image::filled(2, 2, 1.0), None).is_err());
    assert!(writer.write_frame("a", &color, &depth, Some(&Mask::filled(2, 2, 1))).is_err());
    assert!(writer.write_frame("a", &Image::default(), &Image::default(), None).is_err());
    writer.write_truth_pose("a", &Isometry3::translation(0.1, 0.2, 0.3)).unwrap();
    let poses = rgbd_io::poses::read_pose_folder(&dir.path().join("gt_poses")).unwrap();
    assert_eq!(poses, [("a".to_owned(), Isometry3::translation(0.1, 0.2, 0.3))]);

    let odd = [f32::NAN, f32::INFINITY, -1.0, 0.0004, 0.0006, 65.534, 65.536, 1e30];
    let path = dir.path().join("odd.png");
    rgbd_io::write_png_depth(&path, &Image::from_vec(8, 1, odd.to_vec()).unwrap()).unwrap();
    assert_eq!(rgbd_io::read_depth_u16(&path).unwrap().pixels(), [0, 0, 0, 0, 1, 65534, 0, 0]);
}

/// Whether a finding of this severity says this.
fn finds(seen: &Inspection, severity: Severity, word: &str) -> bool {
    seen.findings.iter().any(|f| f.severity == severity && f.message.contains(word) && !f.remedy.is_empty())
}

#[test]
fn an_inspection_measures_a_good_folder() {
    let dir = tempfile::tempdir().unwrap();
    support::write(dir.path(), 30, 1);
    let seen = inspect(dir.path(), &CustomOptions::default());
    assert!(seen.findings.iter().all(|f| f.severity == Severity::Info), "{seen}");
    assert_eq!((seen.frames, seen.depth_files, seen.mask_files, seen.sampled), (30, 30, 1, 12));
    assert_eq!(seen.size, Some(support::SIZE));
    assert_eq!(seen.depth_units, Some("millimetres"));
    assert!((seen.mask_coverage.unwrap() - 24.0 * 18.0 / 1200.0).abs() < 1e-9);
    assert!((seen.missing_depth.unwrap() - 1.0 / 40.0).abs() < 1e-9);
    assert_eq!(seen.missing_depth_in_mask, Some(0.0));
    let object = seen.depth_in_mask.unwrap();
    assert!((object.p50 - 0.534).abs() < 0.003 && object.p05 > 0.515 && object.p95 < 0.555, "{object:?}");
    assert!((seen.fov_degrees.unwrap()[0] - 2.0 * 0.5_f64.atan().to_degrees()).abs() < 1e-9);
    let text = seen.to_string();
    assert!(text.ends_with("ready") && text.lines().count() < 24, "{text}");
}

#[test]
fn an_inspection_notices() {
    type Check = (&'static str, fn(&Path), Severity, &'static str);
    let checks: [Check; 9] = [
        (
            "another resolution",
            |d| fs::write(d.join("cam_K.txt"), "80 0 39 0 80 29 0 0 1").unwrap(),
            Severity::Warning,
            "far from the centre",
        ),
        (
            "field of view",
            |d| fs::write(d.join("cam_K.txt"), "2 0 20 0 2 15 0 0 1").unwrap(),
            Severity::Warning,
            "angle of view",
        ),
        (
            "inverted mask",
            |d| {
                let inverted = support::mask().map(|v| 255 - v);
                rgbd_io::write_png_mask(&d.join("masks/0000.png"), &inverted).unwrap();
            },
            Severity::Error,
            "inverted",
        ),
        (
            "holes",
            |d| {
                let holes = Image::from_fn(40, 30, |x, _| if x % 4 == 0 { 0.5 } else { 0.0 });
                rgbd_io::write_png_depth(&d.join("depth/0000.png"), &holes).unwrap();
            },
            Severity::Warning,
            "75 % of the mask has no depth",
        ),
        (
            "far",
            |d| rgbd_io::write_png_depth(&d.join("depth/0000.png"), &Image::filled(40, 30, 4.2)).unwrap(),
            Severity::Warning,
            "4.20 m away",
        ),
        (
            "near",
            |d| rgbd_io::write_png_depth(&d.join("depth/0000.png"), &Image::filled(40, 30, 0.06)).unwrap(),
            Severity::Warning,
            "0.060 m away",
        ),
        (
            "unregistered",
            |d| {
                let shifted = Image::from_fn(40, 30, |x, _| if x > 20 { 0.5 } else { 1.5 });
                rgbd_io::write_png_depth(&d.join("depth/0000.png"), &shifted).unwrap();
            },
            Severity::Warning,
            "25 cm",
        ),
        (
            "count",
            |d| fs::remove_file(d.join("depth/0004.png")).unwrap(),
            Severity::Warning,
            "1 of 8 frames have no depth file (0004)",
        ),
        ("later", |d| fs::write(d.join("depth/0007.png"), "").unwrap(), Severity::Error, "0 bytes"),
    ];
    for (name, damage, severity, word) in checks {
        let dir = tempfile::tempdir().unwrap();
        support::write(dir.path(), 8, 1);
        assert!(!finds(&inspect(dir.path(), &CustomOptions::default()), severity, word), "{name} before");
        damage(dir.path());
        let seen = inspect(dir.path(), &CustomOptions::default());
        assert!(finds(&seen, severity, word), "{name}: {seen}");
    }
}

#[test]
fn a_small_mask_label_is_still_object() {
    use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.png");
    let write = |bytes: &[u8], kind| {
        let mut png = Vec::new();
        PngEncoder::new(&mut png).write_image(bytes, 2, 1, kind).unwrap();
        fs::write(&path, png).unwrap();
        rgbd_io::read_mask(&path).unwrap().into_pixels()
    };
    assert_eq!(write(&[0, 1], ExtendedColorType::L8), [0, 255]);
    assert_eq!(write(&[0, 0, 0, 0, 0, 1], ExtendedColorType::Rgb8), [0, 255]);
    // An opaque black background, and a transparent white one.
    assert_eq!(write(&[0, 0, 0, 255, 9, 0, 0, 255], ExtendedColorType::Rgba8), [0, 255]);
    assert_eq!(write(&[255, 255, 255, 0, 255, 255, 255, 255], ExtendedColorType::Rgba8), [0, 255]);
    let one: Vec<u8> = [0_u16, 1].iter().flat_map(|v| v.to_ne_bytes()).collect();
    assert_eq!(write(&one, ExtendedColorType::L16), [0, 255]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Any damage to any file of a folder gives frames or errors, never a panic.
    #[test]
    fn damaged_files_never_panic(
        which in 0usize..4,
        keep in 0.0..1.3_f64,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
    ) {
        let dir = tempfile::tempdir().unwrap();
        support::write(dir.path(), 1, 1);
        let path = dir.path().join(["rgb/0000.png", "depth/0000.png", "masks/0000.png", "cam_K.txt"][which]);
        let mut bytes = fs::read(&path).unwrap();
        for (index, value) in changes {
            let i = index.index(bytes.len());
            bytes[i] = value;
        }
        bytes.truncate((bytes.len() as f64 * keep) as usize);
        fs::write(&path, bytes).unwrap();
        if let Ok(folder) = CustomFolder::open(dir.path(), &CustomOptions::default()) {
            let frame = folder.frame(0).unwrap();
            prop_assert_eq!(frame.color.size(), frame.depth.size());
            prop_assert!(folder.intrinsics().is_valid());
        }
        prop_assert!(!inspect(dir.path(), &CustomOptions::default()).to_string().is_empty());
    }

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400), png in any::<bool>()) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.png");
        let magic: &[u8] = if png { b"\x89PNG\r\n\x1a\n" } else { b"\xff\xd8\xff" };
        fs::write(&path, [magic, &bytes].concat()).unwrap();
        prop_assert!(rgbd_io::read_color(&path).is_err());
        prop_assert!(rgbd_io::read_depth_u16(&path).is_err());
        prop_assert!(rgbd_io::read_mask(&path).is_err());
    }
}

/// Real recordings, where they are at hand.
#[test]
fn real_recordings_open() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    for (name, masks) in [
        ("mustard0", MaskSource::First),
        ("visp_cube", MaskSource::Folder("masks_derived".into())),
        ("visp_dragon", MaskSource::Folder("masks_derived".into())),
    ] {
        let dir = root.join(name);
        if !dir.is_dir() {
            eprintln!("skipped: {name} isn't at hand");
            continue;
        }
        let options = options(masks);
        let seen = inspect(&dir, &options);
        assert!(!seen.has_errors(), "{seen}");
        assert_eq!(seen.depth_units, Some("millimetres"));
        let folder = CustomFolder::open(&dir, &options).unwrap();
        assert_eq!(folder.size(), (640, 480));
        let last = folder.len() - 1;
        let frame = folder.frame(last).unwrap();
        assert_eq!(frame.mask.is_some(), options.masks != MaskSource::First);
        let poses = rgbd_io::poses::read_pose_folder(&dir.join("gt_poses")).unwrap();
        assert_eq!(poses.len(), folder.len());
        assert_eq!(poses[last].0, folder.id(last));
        // No mask in the folder's own place for two of them.
        let plain = CustomFolder::open(&dir, &CustomOptions::default());
        assert_eq!(plain.is_ok(), name == "mustard0");
    }
}
