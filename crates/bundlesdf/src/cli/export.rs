//! `bundlesdf export`.

use std::{path::PathBuf, process::ExitCode};

use bundlesdf::{
    OutputFolder,
    export::{ExportOptions, ExportReport, Format, export},
};
use clap::Args;

use super::run::print;

#[derive(Args, Debug)]
pub(super) struct ExportArgs {
    /// Folder of a finished run.
    out: PathBuf,
    /// Texels per side of the texture: 1024, 2048 or 4096; none for vertex colours alone.
    #[arg(long, default_value = "2048", value_name = "TEXELS", value_parser = texture)]
    texture: Texture,
    /// Simplify the mesh to at most N faces.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(4..))]
    faces: Option<u32>,
    /// In a frame of the object's own: bounding box centred, z up; the transform goes to canonical.json.
    #[arg(long)]
    canonical: bool,
    /// Close the holes where nothing was seen: the mesh becomes watertight.
    #[arg(long)]
    close: bool,
    /// Cut off surface that fewer keyframes than this saw.
    #[arg(long, default_value_t = 2, value_name = "N")]
    min_observations: u32,
    /// Also write sim/: URDF and MJCF with convex collision hulls, mass and inertia.
    #[arg(long)]
    sim: bool,
    /// Density of the object for --sim, kg/m^3 (water has 1000).
    #[arg(long, default_value_t = 500.0, value_name = "KG_PER_M3", requires = "sim")]
    density: f64,
    /// Which files to write, of glb, obj, ply and stl.
    #[arg(long, value_delimiter = ',', default_value = "glb,obj,ply,stl", value_parser = format)]
    formats: Vec<Format>,
}

#[derive(Clone, Copy, Debug)]
struct Texture(Option<usize>);

fn texture(text: &str) -> Result<Texture, String> {
    match text {
        "none" => Ok(Texture(None)),
        "1024" | "2048" | "4096" => Ok(Texture(text.parse().ok())),
        _ => Err("use 1024, 2048, 4096 or none".to_owned()),
    }
}

fn format(text: &str) -> Result<Format, String> {
    Format::from_name(text).ok_or_else(|| "use glb, obj, ply and stl, separated by commas".to_owned())
}

/// Writes the assets of a finished run.
pub(super) fn run(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let options = ExportOptions {
        texture: args.texture.0,
        faces: args.faces.map(|n| n as usize),
        canonical: args.canonical,
        close: args.close,
        min_observations: args.min_observations,
        formats: args.formats.clone(),
        density: args.sim.then_some(args.density),
    };
    let folder = OutputFolder::open(&args.out)?;
    let report = export(&folder, &options)?;
    print(&summary(&report, &folder));
    Ok(ExitCode::SUCCESS)
}

/// The closing table.
fn summary(report: &ExportReport, folder: &OutputFolder) -> String {
    let closed = if report.watertight { "watertight" } else { "open where nothing was seen" };
    let mut lines = vec![(
        "mesh",
        format!("{} vertices, {} faces, {closed}, {} frame", report.vertices, report.faces, report.frame),
    )];
    if let Some(texture) = &report.texture {
        lines.push((
            "texture",
            format!(
                "{} charts, {:.0} % of the surface seen, from {} keyframes",
                texture.charts,
                100.0 * texture.observed,
                report.views
            ),
        ));
    }
    if let Some(mass) = &report.mass {
        let cubic_cm = mass.volume_m3 * 1e6;
        lines.push(("body", format!("{:.3} kg, {cubic_cm:.0} cm3, {} hulls", mass.mass_kg, report.hulls)));
    }
    let s = &report.seconds;
    lines.push((
        "time",
        format!(
            "load {:.1} s, mesh {:.1} s, texture {:.1} s, files {:.1} s",
            s.load, s.mesh, s.texture, s.write
        ),
    ));
    let tops: Vec<&str> =
        report.files.iter().filter(|f| !f.starts_with("sim/")).map(String::as_str).collect();
    let sim = if report.mass.is_some() { ", sim/" } else { "" };
    lines.push(("assets", format!("{} ({}{sim})", folder.path().display(), tops.join(", "))));
    lines.iter().map(|(name, value)| format!("{name:<10} {value}\n")).collect()
}
