//! Assets from a finished run: a clean mesh, its texture, and the files that other programs load.
//!
//! [`export`] does it for a results folder, [`build`] for a mesh and views in memory.

mod glb;
mod load;
mod mass;
mod obj;
mod observe;
#[cfg(feature = "sim")]
mod sim;
mod write;

use std::time::Instant;

use marching_cubes::TriMesh;
use serde::Serialize;

use crate::{
    OutputFolder,
    canonical::{CanonicalFrame, canonical_frame},
    texture::{TextureError, TextureOptions, TextureStats, TexturedMesh, View, bake},
};

pub use glb::glb;
pub use mass::{MassProperties, mass_properties};
pub use observe::{Observations, observe};
pub(crate) use write::{FILES, SIM};

/// A mesh format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Format {
    /// `mesh.glb`: binary glTF 2.0 with the texture inside.
    Glb,
    /// `textured.obj` with `textured.mtl` and `textured.png`.
    Obj,
    /// `textured.ply`: vertex colours, normals, confidence and number of observations.
    Ply,
    /// `mesh.stl`.
    Stl,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 4] = [Self::Glb, Self::Obj, Self::Ply, Self::Stl];

    /// The format's name: its file extension.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Obj => "obj",
            Self::Ply => "ply",
            Self::Stl => "stl",
        }
    }

    /// The format of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.name() == name)
    }
}

/// What to export and how.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportOptions {
    /// Texels per side of the texture; `None` for vertex colours alone.
    pub texture: Option<usize>,
    /// Most faces; `None` leaves them all.
    pub faces: Option<usize>,
    /// In the canonical frame in place of the object frame.
    pub canonical: bool,
    /// Close the holes where nothing was seen.
    pub close: bool,
    /// Surface that fewer keyframes saw is cut off, with fewer keyframes than this what not all saw; `0` keeps
    /// everything.
    pub min_observations: u32,
    /// Which files.
    pub formats: Vec<Format>,
    /// Density (kg/m^3) for the simulators' files in `sim/`; `None` leaves them out.
    pub density: Option<f64>,
}

impl Default for ExportOptions {
    fn default() -> Self {
        Self {
            texture: Some(2048),
            faces: None,
            canonical: false,
            close: false,
            min_observations: 2,
            formats: Format::ALL.to_vec(),
            density: None,
        }
    }
}

/// Why nothing was exported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// A file of the run or its video can't be read, or an asset not be written.
    #[error(transparent)]
    File(#[from] rgbd_io::Error),
    /// See [`TextureError`].
    #[error(transparent)]
    Texture(#[from] TextureError),
    /// The mesh is empty.
    #[error("the mesh is empty; track more of the object before exporting it")]
    NoMesh,
    /// Nothing of the mesh was seen often enough.
    #[error("no keyframe's depth agrees with the mesh; lower --min-observations or run the video again")]
    Unseen,
    /// A density that is no density.
    #[error("a density of {0} kg/m^3 can't be; give a positive number with --density")]
    Density(f64),
    /// Without volume there is no mass.
    #[error(
        "the closed mesh has no volume; track more sides of the object before exporting it for a simulator"
    )]
    NoVolume,
    /// This build can't decompose meshes.
    #[error("this build has no collision hulls; build it with the feature sim")]
    NoSim,
}

/// A finished asset in memory.
#[derive(Clone, Debug)]
pub struct Asset {
    /// Welded, oriented, one component; with normals and colours.
    pub mesh: TriMesh,
    /// How often and how well each vertex was observed.
    pub observations: Observations,
    /// The mesh with texture coordinates and texture.
    pub textured: Option<TexturedMesh>,
    /// The frame that everything is in, unless that is the object frame.
    pub canonical: Option<CanonicalFrame>,
}

/// The content of `export.json`.
#[derive(Clone, Debug, Serialize)]
pub struct ExportReport {
    /// Files written, relative to the results folder.
    pub files: Vec<String>,
    /// `object` or `canonical`: the frame of every file.
    pub frame: &'static str,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Faces of the mesh.
    pub faces: usize,
    /// Whether every edge has exactly two faces.
    pub watertight: bool,
    /// Keyframes used.
    pub views: usize,
    /// The texture in numbers.
    pub texture: Option<TextureStats>,
    /// Mass properties of the closed mesh, of `--sim`.
    pub mass: Option<MassProperties>,
    /// Convex collision hulls in `sim/`.
    pub hulls: usize,
    /// Seconds for the mesh, the texture and the files.
    pub seconds: ExportSeconds,
}

/// Wall-clock seconds by stage.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct ExportSeconds {
    /// Reading mesh, keyframes and video.
    pub load: f64,
    /// Observation count, trimming, closing, simplification.
    pub mesh: f64,
    /// Unwrapping and painting.
    pub texture: f64,
    /// Collision hulls and all files.
    pub write: f64,
}

/// Exports a finished run: reads its mesh, keyframes (the refined ones when there are any), masks and video, and
/// writes assets and `export.json` into the folder, each file whole or not at all.
///
/// # Errors
/// When a file can't be read or written, or there is nothing to export, see [`ExportError`].
pub fn export(folder: &OutputFolder, options: &ExportOptions) -> Result<ExportReport, ExportError> {
    check(options)?;
    let start = Instant::now();
    let (mesh, views) = load::load(folder)?;
    let load = start.elapsed().as_secs_f64();
    let (asset, mut seconds) = build_timed(&mesh, &views, options)?;
    seconds.load = load;
    let start = Instant::now();
    let written = write::write(folder, &asset, options)?;
    seconds.write = start.elapsed().as_secs_f64();
    let report = ExportReport {
        files: written.files,
        frame: if asset.canonical.is_some() { "canonical" } else { "object" },
        vertices: asset.mesh.vertices.len(),
        faces: asset.mesh.triangles.len(),
        watertight: asset.mesh.is_watertight(),
        views: views.len(),
        texture: asset.textured.map(|t| t.stats),
        mass: written.mass,
        hulls: written.hulls,
        seconds,
    };
    folder.write_json("export.json", &report)?;
    Ok(report)
}

/// Makes an asset of `mesh` (object frame, metres) and what `views` saw of it.
///
/// # Errors
/// When nothing of the mesh is left or the texture can't be made.
pub fn build(mesh: &TriMesh, views: &[View], options: &ExportOptions) -> Result<Asset, ExportError> {
    check(options)?;
    Ok(build_timed(mesh, views, options)?.0)
}

/// Whether the options can be met at all, before anything long is begun.
fn check(options: &ExportOptions) -> Result<(), ExportError> {
    match options.density {
        Some(d) if !(d > 0.0 && d.is_finite()) => Err(ExportError::Density(d)),
        Some(_) if cfg!(not(feature = "sim")) => Err(ExportError::NoSim),
        _ => Ok(()),
    }
}

fn build_timed(
    mesh: &TriMesh,
    views: &[View],
    options: &ExportOptions,
) -> Result<(Asset, ExportSeconds), ExportError> {
    let start = Instant::now();
    let mut mesh = clean(mesh, views, options)?;
    let observations = observe(&mesh, views);
    let mut seconds = ExportSeconds { mesh: start.elapsed().as_secs_f64(), ..ExportSeconds::default() };
    let start = Instant::now();
    let mut textured = match options.texture {
        Some(size) => Some(bake(&mesh, views, &TextureOptions { size, ..TextureOptions::default() })?),
        None => None,
    };
    if let Some(textured) = &textured {
        mesh.colors.clone_from(&textured.vertex_colors);
    }
    seconds.texture = start.elapsed().as_secs_f64();
    let canonical = if options.canonical { canonical_frame(&mesh) } else { None };
    if let Some(frame) = &canonical {
        mesh = mesh.transformed_by(&frame.canonical_from_obj);
        textured = textured.map(|t| t.transformed_by(&frame.canonical_from_obj));
    }
    Ok((Asset { mesh, observations, textured, canonical }, seconds))
}

/// One welded, oriented component of what was seen, closed and simplified as asked, with normals.
fn clean(mesh: &TriMesh, views: &[View], options: &ExportOptions) -> Result<TriMesh, ExportError> {
    let mut mesh = mesh.clone();
    mesh.weld();
    mesh = mesh.largest_component();
    if mesh.triangles.is_empty() {
        return Err(ExportError::NoMesh);
    }
    if !mesh.has_normals() {
        mesh.compute_normals();
    }
    if options.min_observations > 0 {
        let counts = observe(&mesh, views).counts;
        let least = options.min_observations.min(views.len() as u32);
        mesh = observe::trimmed(&mesh, &counts, least).largest_component();
        if mesh.triangles.is_empty() {
            return Err(ExportError::Unseen);
        }
    }
    if options.close {
        mesh = mesh.closed();
    }
    if let Some(faces) = options.faces {
        mesh = mesh.simplified(faces);
    }
    mesh.compute_normals();
    Ok(mesh)
}

impl TexturedMesh {
    /// The mesh under a rigid motion given as a row-major 4x4 matrix.
    #[must_use]
    pub fn transformed_by(self, matrix: &[[f64; 4]; 4]) -> Self {
        let shell = TriMesh {
            vertices: self.positions,
            normals: self.normals,
            triangles: self.triangles,
            colors: Vec::new(),
        };
        let moved = shell.transformed_by(matrix);
        Self { positions: moved.vertices, normals: moved.normals, triangles: moved.triangles, ..self }
    }
}
