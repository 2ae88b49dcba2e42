//! An asset's files.

use std::fs;

use image::{
    ExtendedColorType, ImageEncoder,
    codecs::{
        jpeg::JpegEncoder,
        png::{CompressionType, FilterType, PngEncoder},
    },
};
use marching_cubes::{write_obj, write_ply_with, write_stl};
use rgbd_io::{Error, Image, poses::write_atomic};

use super::{Asset, ExportError, ExportOptions, Format, MassProperties, glb, obj};
use crate::OutputFolder;

/// Every file that an export can write at the top of the folder.
pub(crate) const FILES: [&str; 8] = [
    "mesh.glb",
    "textured.obj",
    "textured.mtl",
    "textured.png",
    "textured.ply",
    "mesh.stl",
    "canonical.json",
    "export.json",
];
/// Folder of the simulators' files.
pub(crate) const SIM: &str = "sim";

/// What was written.
pub(super) struct Written {
    pub(super) files: Vec<String>,
    pub(super) mass: Option<MassProperties>,
    pub(super) hulls: usize,
}

/// Writes all files that are asked for and removes those of an earlier export that are not.
pub(super) fn write(
    folder: &OutputFolder,
    asset: &Asset,
    options: &ExportOptions,
) -> Result<Written, ExportError> {
    let mut files = Files { folder, names: Vec::new() };
    if let Some(frame) = &asset.canonical {
        folder.write_json("canonical.json", frame)?;
        files.names.push("canonical.json".into());
    }
    for format in Format::ALL.into_iter().filter(|f| options.formats.contains(f)) {
        files.format(asset, format)?;
    }
    let (mass, hulls) = match options.density {
        Some(density) => simulation(&mut files, asset, density)?,
        None => (None, 0),
    };
    let names = files.names;
    for stale in FILES.iter().filter(|f| **f != "export.json" && !names.iter().any(|n| n == *f)) {
        remove(folder, stale)?;
    }
    if options.density.is_none() && folder.path().join(SIM).join("object.urdf").is_file() {
        fs::remove_dir_all(folder.path().join(SIM))
            .map_err(|e| failed(folder, SIM, &format!("can't be removed ({e})")))?;
    }
    Ok(Written { files: names, mass, hulls })
}

#[cfg(feature = "sim")]
fn simulation(
    files: &mut Files<'_>,
    asset: &Asset,
    density: f64,
) -> Result<(Option<MassProperties>, usize), ExportError> {
    let body = super::sim::Body::of(asset, density)?;
    let dir = files.folder.path().join(SIM);
    // The hulls of an earlier export may be more.
    let old = fs::read_dir(&dir).into_iter().flatten().flatten().map(|e| e.path());
    let is_hull = |p: &std::path::PathBuf| {
        p.file_name().is_some_and(|n| n.to_string_lossy().starts_with("hull_"))
            && p.extension().is_some_and(|e| e == "obj")
    };
    for hull in old.filter(is_hull) {
        fs::remove_file(&hull).map_err(|e| failed(files.folder, SIM, &format!("can't be renewed ({e})")))?;
    }
    fs::create_dir_all(&dir).map_err(|e| failed(files.folder, SIM, &format!("can't be made ({e})")))?;
    for (name, bytes) in body.files(asset)? {
        files.put(&format!("{SIM}/{name}"), &bytes)?;
    }
    Ok((Some(body.mass), body.hulls.len()))
}

#[cfg(not(feature = "sim"))]
fn simulation(_: &mut Files<'_>, _: &Asset, _: f64) -> Result<(Option<MassProperties>, usize), ExportError> {
    Err(ExportError::NoSim)
}

/// The files written so far.
struct Files<'a> {
    folder: &'a OutputFolder,
    names: Vec<String>,
}

impl Files<'_> {
    fn put(&mut self, name: &str, bytes: &[u8]) -> Result<(), Error> {
        write_atomic(&self.folder.path().join(name), bytes)?;
        self.names.push(name.to_owned());
        Ok(())
    }

    fn format(&mut self, asset: &Asset, format: Format) -> Result<(), Error> {
        let folder = self.folder;
        let mut bytes = Vec::new();
        let io = |name: &str, e: std::io::Error| failed(folder, name, &format!("can't be made ({e})"));
        match (format, &asset.textured) {
            (Format::Glb, _) => {
                let bytes = glb(asset).map_err(|e| failed(folder, "mesh.glb", &e))?;
                self.put("mesh.glb", &bytes)
            }
            (Format::Obj, Some(t)) => {
                // What is named comes before what names it.
                let png = encoded(&t.texture, None).map_err(|e| failed(folder, "textured.png", &e))?;
                self.put("textured.png", &png)?;
                self.put("textured.mtl", obj::material("textured.png").as_bytes())?;
                self.put("textured.obj", obj::textured(t, "textured.mtl").as_bytes())
            }
            (Format::Obj, None) => {
                write_obj(&asset.mesh, &mut bytes).map_err(|e| io("textured.obj", e))?;
                self.put("textured.obj", &bytes)
            }
            (Format::Ply, _) => {
                let counts: Vec<f32> = asset.observations.counts.iter().map(|&c| c as f32).collect();
                let extra: [(&str, &[f32]); 2] =
                    [("confidence", &asset.observations.confidence), ("observations", &counts)];
                write_ply_with(&asset.mesh, &extra, &mut bytes).map_err(|e| io("textured.ply", e))?;
                self.put("textured.ply", &bytes)
            }
            (Format::Stl, _) => {
                write_stl(&asset.mesh, &mut bytes).map_err(|e| io("mesh.stl", e))?;
                self.put("mesh.stl", &bytes)
            }
        }
    }
}

/// An image as JPEG of that quality, or as PNG.
pub(super) fn encoded(image: &Image<[u8; 3]>, jpeg_quality: Option<u8>) -> Result<Vec<u8>, String> {
    let pixels = image.pixels().as_flattened();
    let (width, height) = (image.width() as u32, image.height() as u32);
    let mut bytes = Vec::new();
    let outcome = match jpeg_quality {
        Some(quality) => JpegEncoder::new_with_quality(&mut bytes, quality).write_image(
            pixels,
            width,
            height,
            ExtendedColorType::Rgb8,
        ),
        None => PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive)
            .write_image(pixels, width, height, ExtendedColorType::Rgb8),
    };
    outcome.map_err(|e| format!("can't be encoded ({e})"))?;
    Ok(bytes)
}

fn remove(folder: &OutputFolder, name: &str) -> Result<(), Error> {
    match fs::remove_file(folder.path().join(name)) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
            Err(failed(folder, name, &format!("can't be removed ({e})")))
        }
        _ => Ok(()),
    }
}

fn failed(folder: &OutputFolder, name: &str, problem: &str) -> Error {
    Error::new(folder.path().join(name), problem, "check the folder's permissions and free space")
}
