//! From a finished results folder to assets, with true poses and the true mesh in place of a tracked one.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use bundlesdf::{
    Config, FieldSummary, KeyframeReport, OutputFolder, RunReport, Schedule, VideoInput,
    export::{ExportError, ExportOptions, Format, export},
    report::MeshReport,
};
use rgbd_synth::{Masks, Sequence, write_custom};
use serde_json::Value;

/// A results folder of the tiny sequence. The video covers one side of the object.
fn finished_run(dir: &Path) -> OutputFolder {
    let video = Sequence::tiny().with_masks(Masks::Every);
    let path = dir.join("video");
    write_custom(&video, &path).unwrap();
    let folder = OutputFolder::create(&dir.join("out"), false).unwrap();
    let mut ply = Vec::new();
    marching_cubes::write_ply(&video.mesh().simplified(8000), &mut ply).unwrap();
    fs::write(folder.path().join("mesh.ply"), ply).unwrap();
    let keyframes: Vec<KeyframeReport> = (0..video.len())
        .step_by(3)
        .map(|index| {
            let seen = video.render(index);
            folder.write_mask(&seen.frame.id, &seen.visible_mask).unwrap();
            let m = seen.cam_from_obj.to_homogeneous();
            KeyframeReport {
                index,
                id: seen.frame.id,
                cam_from_obj: std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)])),
                refined_by_field: true,
            }
        })
        .collect();
    folder.write_json("keyframes.json", &keyframes).unwrap();
    let input =
        VideoInput::Folder { path, masks: "first".into(), first_mask: None, stride: 1, depth_scale: 0.001 };
    let report = RunReport {
        version: String::new(),
        input: Some(input),
        schedule: Schedule::Lockstep,
        config: Config::default(),
        frames: Vec::new(),
        keyframes: keyframes.len(),
        field: FieldSummary::default(),
        tracking_hz_median: 0.0,
        wall_s: 0.0,
        mesh: MeshReport::default(),
        interrupted: false,
    };
    folder.write_report(&report).unwrap();
    folder
}

fn small() -> ExportOptions {
    ExportOptions { texture: Some(256), ..ExportOptions::default() }
}

fn read(folder: &OutputFolder, name: &str) -> Vec<u8> {
    fs::read(folder.path().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// The JSON part of a GLB; checks that every part of the binary one lies where it should.
fn glb_json(bytes: &[u8]) -> Value {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!(&bytes[..4], b"glTF");
    assert_eq!((word(4), word(8)), (2, bytes.len()));
    let json: Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
    let binary = word(20 + word(12));
    assert_eq!(20 + word(12) + 8 + binary, bytes.len());
    for view in json["bufferViews"].as_array().unwrap() {
        let end = view["byteOffset"].as_u64().unwrap() + view["byteLength"].as_u64().unwrap();
        assert!(end <= binary as u64 && view["byteOffset"].as_u64().unwrap() % 4 == 0);
    }
    json
}

#[test]
fn a_run_becomes_assets() {
    let dir = tempfile::tempdir().unwrap();
    let folder = finished_run(dir.path());
    let options = ExportOptions { faces: Some(3000), ..small() };
    let report = export(&folder, &options).unwrap();
    assert_eq!(
        report.files,
        ["mesh.glb", "textured.png", "textured.mtl", "textured.obj", "textured.ply", "mesh.stl"]
    );
    assert!(report.faces <= 3000 && report.faces > 2900 && report.frame == "object");
    // Most of the back was never in view, or only once: it is cut off.
    assert!(!report.watertight);
    let whole = Sequence::tiny().mesh().area();
    let mesh = marching_cubes::read_ply(&read(&folder, "textured.ply")).unwrap();
    assert!((0.25..0.9).contains(&(mesh.area() / whole)), "{}", mesh.area() / whole);
    assert_eq!(mesh.components().len(), 1);
    let json = glb_json(&read(&folder, "mesh.glb"));
    assert_eq!(json["images"][0]["mimeType"], "image/jpeg");
    assert_eq!(json["accessors"][3]["count"], 3 * report.faces as u64);
    assert!(String::from_utf8(read(&folder, "textured.obj")).unwrap().contains("mtllib textured.mtl"));
    assert_eq!(read(&folder, "mesh.stl").len(), 84 + 50 * report.faces);
    let written: Value = serde_json::from_slice(&read(&folder, "export.json")).unwrap();
    assert_eq!(written["faces"], report.faces as u64);
    // At 160 x 120 the outermost pixels, which are not trusted, are a good part of the object.
    assert!(written["texture"]["observed"].as_f64().unwrap() > 0.4, "{}", written["texture"]["observed"]);
    // Another export replaces the first: what it doesn't write is gone.
    let less = ExportOptions { texture: None, formats: vec![Format::Glb], ..small() };
    export(&folder, &less).unwrap();
    assert!(!folder.path().join("textured.png").exists() && !folder.path().join("mesh.stl").exists());
    assert!(
        glb_json(&read(&folder, "mesh.glb"))["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"].is_u64()
    );
    // And a new run in the folder leaves nothing of it.
    OutputFolder::create(folder.path(), true).unwrap();
    assert!(!folder.path().join("mesh.glb").exists() && !folder.path().join("export.json").exists());
}

#[test]
fn a_closed_canonical_mesh_stands_in_its_box() {
    let dir = tempfile::tempdir().unwrap();
    let folder = finished_run(dir.path());
    let options = ExportOptions { canonical: true, close: true, faces: Some(4000), ..small() };
    let report = export(&folder, &options).unwrap();
    assert!(report.watertight && report.frame == "canonical");
    let frame: Value = serde_json::from_slice(&read(&folder, "canonical.json")).unwrap();
    let mesh = marching_cubes::read_ply(&read(&folder, "textured.ply")).unwrap();
    let (low, high) = mesh.bounds().unwrap();
    for k in 0..3 {
        assert!((low[k] + high[k]).abs() < 1e-3, "{low:?} {high:?}");
        let extent = frame["extents_m"][k].as_f64().unwrap();
        assert!((f64::from(high[k] - low[k]) - extent).abs() < 1e-3);
    }
    // Every vertex goes back to where the object's surface is.
    let matrix: [[f64; 4]; 4] = serde_json::from_value(frame["canonical_from_obj"].clone()).unwrap();
    let back = nalgebra::Matrix4::from_fn(|r, c| matrix[r][c]).try_inverse().unwrap();
    let shape = Sequence::tiny();
    let shape = shape.spec().object.shape().unwrap();
    let observed = mesh.vertices.iter().filter(|v| {
        let p = back.transform_point(&nalgebra::Point3::from(v.map(f64::from)));
        shape.distance(p.coords.cast::<f32>().into()).abs() < 0.001
    });
    assert!(observed.count() * 2 > mesh.vertices.len());
}

#[cfg(feature = "sim")]
#[test]
fn simulators_get_a_body() {
    let dir = tempfile::tempdir().unwrap();
    let folder = finished_run(dir.path());
    let options = ExportOptions { density: Some(800.0), faces: Some(2000), ..small() };
    let report = export(&folder, &options).unwrap();
    let mass = report.mass.unwrap();
    assert!((mass.mass_kg - 800.0 * mass.volume_m3).abs() < 1e-9 && mass.volume_m3 > 1e-5);
    let urdf = String::from_utf8(read(&folder, "sim/object.urdf")).unwrap();
    assert_eq!(urdf.matches("<collision>").count(), report.hulls);
    for i in 0..report.hulls {
        assert!(folder.path().join(format!("sim/hull_{i:02}.obj")).exists());
    }
    assert!(report.files.iter().all(|f| folder.path().join(f).exists()));
    // Without --sim the folder goes again.
    export(&folder, &small()).unwrap();
    assert!(!folder.path().join("sim").exists());
    for density in [0.0, -1.0, f64::NAN] {
        let bad = ExportOptions { density: Some(density), ..small() };
        assert!(matches!(export(&folder, &bad), Err(ExportError::Density(_))));
    }
}

#[test]
fn what_is_missing_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let folder = finished_run(dir.path());
    let message = || export(&folder, &small()).unwrap_err().to_string();
    let masks = folder.path().join("masks");
    fs::rename(&masks, dir.path().join("elsewhere")).unwrap();
    assert!(message().contains("masks"), "{}", message());
    fs::rename(dir.path().join("elsewhere"), &masks).unwrap();
    fs::rename(dir.path().join("video"), dir.path().join("moved")).unwrap();
    assert!(message().contains("video"), "{}", message());
    fs::write(folder.path().join("mesh.ply"), "ply\nnonsense").unwrap();
    assert!(message().contains("mesh.ply"), "{}", message());
    fs::remove_file(folder.path().join("mesh.ply")).unwrap();
    assert!(message().contains("mesh.ply"), "{}", message());
    assert!(!folder.path().join("mesh.glb").exists() && !folder.path().join("export.json").exists());
}

/// The Khronos validator finds nothing to say about any kind of GLB. Skipped, visibly, where node or the validator
/// (`npm install --prefix target/peers gltf-validator`) isn't installed.
#[test]
fn the_khronos_validator_accepts_the_glb() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..");
    let packages =
        std::env::var_os("BUNDLESDF_PEERS").map_or_else(|| root.join("target/peers"), PathBuf::from);
    let script = root.join("xtask/peers/validate_glb.mjs");
    let dir = tempfile::tempdir().unwrap();
    let folder = finished_run(dir.path());
    for (texture, canonical, close) in [(Some(256), true, true), (None, false, false)] {
        export(&folder, &ExportOptions { texture, canonical, close, faces: Some(2000), ..small() }).unwrap();
        let glb = folder.path().join("mesh.glb");
        let Ok(output) = Command::new("node").arg(&script).arg(&packages).arg(&glb).output() else {
            println!("SKIPPED: node is not installed");
            return;
        };
        if output.status.code() == Some(3) {
            println!("SKIPPED: {}", String::from_utf8_lossy(&output.stderr).trim());
            return;
        }
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
        println!("{text}");
    }
}
