//! Sequences made wrong on purpose: the run tells what is wrong with them, and a good one is told nothing.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use bundlesdf::{MotionKind, Schedule, VideoRun, Warning, WarningKind};
use nalgebra::{Point3, Vector3};
use rgbd_io::{Image, RgbdFrame};
use rgbd_synth::{Masks, Sequence};
use support::{Video, bundlesdf, frames, run, run_args, video_folder, without_field};

fn track(frames: Vec<RgbdFrame>) -> VideoRun {
    run(Video::of(frames), &without_field(), Schedule::Lockstep)
}

/// The run's only warning.
fn only(run: &VideoRun, kind: WarningKind) -> &Warning {
    let kinds: Vec<_> = run.warnings.iter().map(|w| w.kind).collect();
    assert_eq!(kinds, [kind], "{:?}", run.warnings);
    let warning = &run.warnings[0];
    assert!(!warning.remedy.is_empty() && !warning.message.contains('\n'));
    warning
}

/// What is told about the sequence with this change to every frame.
fn told(change: impl Fn(usize, &mut RgbdFrame)) -> Vec<Warning> {
    let mut video = frames(Masks::Every);
    video.iter_mut().enumerate().for_each(|(i, f)| change(i, f));
    track(video).warnings
}

fn kinds(warnings: &[Warning]) -> Vec<WarningKind> {
    warnings.iter().map(|w| w.kind).collect()
}

#[test]
fn good_videos_are_told_nothing() {
    assert_eq!(track(frames(Masks::Every)).warnings, []);
    // At full resolution, with everything the suite makes hard but the fault itself.
    let demo = Sequence::demo().with_masks(Masks::Every);
    let run = track((0..17).map(|i| demo.render(i).frame).collect());
    assert_eq!(run.warnings, []);
}

#[test]
fn depth_in_millimetres_is_told() {
    let warnings = told(|_, f| f.depth = f.depth.map(|d| d * 1000.0));
    let warning = warnings.iter().find(|w| w.kind == WarningKind::DepthUnits).unwrap();
    assert!(warning.remedy.contains("--depth-scale") && warning.frame == "000000");
}

#[test]
fn depth_that_is_not_registered_is_told() {
    let shifted =
        |dx: usize| {
            move |_: usize, f: &mut RgbdFrame| {
                let depth = f.depth.clone();
                f.depth = Image::from_fn(depth.width(), depth.height(), |x, y| {
                    if x >= dx { depth[(x - dx, y)] } else { 0.0 }
                });
            }
        };
    for dx in [8, 11] {
        let warnings = told(shifted(dx));
        let warning = warnings.iter().find(|w| w.kind == WarningKind::DepthNotRegistered);
        let warning = warning.unwrap_or_else(|| panic!("{dx}: {warnings:?}"));
        assert!(warning.remedy.contains("aligned"), "{warning}");
    }
}

#[test]
fn intrinsics_of_another_resolution_are_told() {
    let of_vga = told(|_, f| f.intrinsics = f.intrinsics.scaled(2.0, 2.0));
    assert!(kinds(&of_vga).contains(&WarningKind::ForeignIntrinsics), "{of_vga:?}");
    let wide = told(|_, f| f.intrinsics.fx *= 0.1);
    assert!(kinds(&wide).contains(&WarningKind::ForeignIntrinsics), "{wide:?}");
}

#[test]
fn inverted_masks_are_told() {
    let warnings = told(|_, f| f.mask = f.mask.as_ref().map(|m| m.map(|v| 255 - *v)));
    assert!(kinds(&warnings).contains(&WarningKind::MaskInverted), "{warnings:?}");
}

#[test]
fn an_object_beyond_the_limits_is_told() {
    for (key, kind) in [("min_depth", WarningKind::TooNear), ("max_depth", WarningKind::TooFar)] {
        let mut config = without_field();
        match kind {
            WarningKind::TooNear => config.preprocess.min_depth = 0.9,
            _ => config.preprocess.max_depth = 0.3,
        }
        let run = run(Video::of(frames(Masks::Every)), &config, Schedule::Lockstep);
        assert!(only(&run, kind).message.contains(key));
    }
}

#[test]
fn too_little_overlap_is_told() {
    // Every tenth frame of a fast motion.
    let sequence = Sequence::tiny().with_masks(Masks::Every);
    let run = track((0..12).map(|i| sequence.render(i * 14).frame).collect());
    let warning = run.warnings.iter().find(|w| w.kind == WarningKind::LittleOverlap);
    assert!(warning.unwrap_or_else(|| panic!("{:?}", run.warnings)).remedy.contains("slowly"));
}

#[test]
fn motion_blur_is_told() {
    let warnings = told(|i, f| {
        // The first frames are sharp.
        if i < 8 {
            return;
        }
        let sharp = f.color.clone();
        f.color = Image::from_fn(sharp.width(), sharp.height(), |x, y| {
            let span: Vec<_> =
                (0..9).map(|i| sharp[((x + i).saturating_sub(4).min(sharp.width() - 1), y)]).collect();
            std::array::from_fn(|k| (span.iter().map(|c| u32::from(c[k])).sum::<u32>() / 9) as u8)
        });
    });
    assert!(kinds(&warnings).contains(&WarningKind::MotionBlur), "{warnings:?}");
}

#[test]
fn an_object_without_texture_and_with_symmetry_is_told() {
    let video = Sequence::named("symmetric").unwrap().with_masks(Masks::Every);
    let mut frames: Vec<_> = (0..60).map(|i| video.render(i * 2).frame).collect();
    let run = track(frames.clone());
    frames.truncate(18);
    let told = track(frames).warnings;
    let warning = told.iter().find(|w| w.kind == WarningKind::UnobservableMotion);
    assert!(warning.unwrap_or_else(|| panic!("{told:?}")).remedy.contains("labels"));
    // Frame by frame, the result names the motion: the turn about the can's axis.
    let axis = run.frames[0].cam_from_obj.inverse() * video.cam_from_obj(0) * Vector3::y();
    let centre = run.frames[0].cam_from_obj.inverse() * video.cam_from_obj(0) * Point3::origin();
    let mut held = 0;
    for motion in run.frames.iter().filter_map(|f| f.uncertainty.as_ref()).flat_map(|u| &u.held) {
        assert_eq!(motion.kind, MotionKind::Turn);
        let (direction, through) = (Vector3::from(motion.direction), Point3::from(motion.through));
        let off = direction.dot(&axis).abs().min(1.0).acos().to_degrees();
        let beside = (centre - through).cross(&direction).norm();
        assert!(off < 2.0 && beside < 0.002, "{off} degrees, {beside} m");
        held += 1;
    }
    assert!(2 * held > run.frames.len(), "{held}");
}

#[test]
fn frame_drops_are_told_and_every_warning_is_in_the_report() {
    let (dir, video, config) = video_folder(20, Masks::Every);
    for gone in [9, 10, 11, 14, 15] {
        for (folder, kind) in [("rgb", "png"), ("depth", "png"), ("masks", "png")] {
            std::fs::remove_file(video.join(folder).join(format!("{gone:06}.{kind}"))).unwrap();
        }
    }
    let out = dir.path().join("out");
    let output = bundlesdf(&run_args(&video, &out, &config));
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{text}");
    assert!(text.lines().any(|l| l.starts_with("warning: ") && l.contains("missing")), "{text}");
    let report = support::report(&out);
    let warnings = report["warnings"].as_array().unwrap();
    let drops = warnings.iter().find(|w| w["kind"] == "frame-drops").unwrap();
    assert_eq!(drops["frames"], 2, "two gaps");
    assert!(drops["remedy"].as_str().unwrap().len() > 10);
}

/// Reads, changes and writes back every depth file of a folder.
fn change_depth(video: &std::path::Path, change: impl Fn(&Image<f32>) -> Image<f32>) {
    for entry in std::fs::read_dir(video.join("depth")).unwrap() {
        let path = entry.unwrap().path();
        let depth = rgbd_io::read_depth_u16(&path).unwrap().map(|raw| f32::from(*raw) * 1e-3);
        rgbd_io::write_png_depth(&path, &change(&depth)).unwrap();
    }
}

#[test]
fn check_tells_of_depth_that_is_not_registered() {
    let (_dir, video, _) = video_folder(12, Masks::Every);
    let check =
        || String::from_utf8_lossy(&bundlesdf(&["check", video.to_str().unwrap()]).stdout).into_owned();
    assert!(!check().contains("shifted"), "{}", check());
    change_depth(&video, |depth| {
        let moved = |x: usize, y: usize| if x >= 9 { depth[(x - 9, y)] } else { 0.0 };
        Image::from_fn(depth.width(), depth.height(), moved)
    });
    assert!(check().contains("depth fits colour better when shifted by"), "{}", check());
}

#[test]
fn check_tells_of_gaps_between_frames() {
    let (_dir, video, _) = video_folder(14, Masks::Every);
    for gone in [8, 9] {
        std::fs::remove_file(video.join(format!("rgb/{gone:06}.png"))).unwrap();
    }
    let text = String::from_utf8_lossy(&bundlesdf(&["check", video.to_str().unwrap()]).stdout).into_owned();
    assert!(text.contains("2 missing before 000010"), "{text}");
}
