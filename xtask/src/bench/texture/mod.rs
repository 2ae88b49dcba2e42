//! `cargo xtask bench texture`: textures against the true one, in frames that they weren't made from.

mod input;
mod register;
mod score;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Context;
use bundlesdf::texture::{TextureOptions, TexturedMesh, bake};
use nalgebra::{Isometry3, Point3};
use rgbd_synth::Sequence;
use serde::Serialize;

use input::{Input, Truth};
use score::{Psnr, Target, psnr};

/// What to measure and how.
#[derive(clap::Args)]
pub(crate) struct TextureArgs {
    /// Sequences of the suite, or demo; four that differ when none is named.
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Paint with this many frames, spread evenly over the video.
    #[arg(long, default_value_t = 30, value_name = "N")]
    views: usize,
    /// Compare in this many other frames.
    #[arg(long, default_value_t = 16, value_name = "N")]
    held_out: usize,
    /// Texels per side.
    #[arg(long, default_value_t = 2048, value_name = "TEXELS")]
    size: usize,
    /// Take mesh, keyframes and masks from the results folders DIR/NAME in place of the true ones.
    #[arg(long, value_name = "DIR")]
    runs: Option<PathBuf>,
    /// Of the runs, take the poses and masks alone, with the true mesh: what the mesh costs.
    #[arg(long, requires = "runs")]
    true_mesh: bool,
    /// Of the runs, take the mesh and the masks alone, with the true poses: what the poses cost.
    #[arg(long, requires = "runs")]
    true_poses: bool,
    /// Also write the figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Also write NAME-N.png for some held-out frames into this folder: the texture on the left, the truth on the right.
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// The figures of one sequence.
#[derive(Serialize)]
struct Row {
    name: String,
    views: usize,
    faces: usize,
    /// Against the object's own colours, after one factor on the whole texture.
    colours: Psnr,
    /// The same with the whole object moved so that it agrees best with the held-out frames.
    registered: Psnr,
    /// How far that moved it: root mean square over the vertices, millimetres.
    moved_mm: f64,
    /// Against the frames as the camera saw them, light and all.
    frames: Psnr,
    /// Share of the surface's texels that some view saw.
    observed: f64,
    /// Texels that are black, which no object of the suite is.
    black: usize,
    seconds: f64,
}

/// Paints every sequence's object and prints a table.
pub(super) fn run(args: &TextureArgs) -> anyhow::Result<ExitCode> {
    let mut names = args.names.clone();
    if names.is_empty() {
        names.extend(["depth-noise", "partial-occlusion", "large-near", "in-hand-turn"].map(String::from));
    }
    let mut rows = Vec::new();
    println!(
        "sequence             views  faces  colours dB (factor)  registered dB (mm)  as seen dB  covered  observed  \
         black  seconds"
    );
    for name in &names {
        let row = measure(name, args).with_context(|| format!("measuring on {name}"))?;
        println!(
            "{:<20} {:>5} {:>6} {:>11.2} ({:.2}) {:>13.2} ({:.2}) {:>11.2} {:>7.1} % {:>7.1} % {:>6} {:>8.1}",
            row.name,
            row.views,
            row.faces,
            row.colours.db,
            row.colours.factor,
            row.registered.db,
            row.moved_mm,
            row.frames.db,
            100.0 * row.colours.covered,
            100.0 * row.observed,
            row.black,
            row.seconds
        );
        rows.push(row);
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows)?)
            .with_context(|| format!("{} can't be written", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn measure(name: &str, args: &TextureArgs) -> anyhow::Result<Row> {
    let video = match name {
        "demo" => Sequence::demo(),
        _ => Sequence::named(name).context("no such sequence in the suite")?,
    };
    let input = match &args.runs {
        None => Input::truth(&video, args.views),
        Some(runs) => {
            let truth = Truth { mesh: args.true_mesh, poses: args.true_poses };
            Input::of_run(&video, &runs.join(name), truth)?
        }
    };
    let held_out = input.held_out(video.len(), args.held_out);
    let start = Instant::now();
    let options = TextureOptions { size: args.size, ..TextureOptions::default() };
    let textured = bake(&input.mesh, &input.views, &options)?;
    let seconds = start.elapsed().as_secs_f64();
    let truth = score::frames(&video, &held_out, Target::Colours);
    let colours = psnr(&textured, &video, &truth, &input.true_from_obj, Target::Colours);
    let place = register::registered(&textured, &video, &truth, &input.true_from_obj, colours.factor);
    let registered = psnr(&textured, &video, &truth, &place, Target::Colours);
    let seen = score::frames(&video, &held_out, Target::Frames);
    if let Some(folder) = &args.pictures {
        score::pictures(&textured, &video, &held_out, &input.true_from_obj, folder)?;
    }
    Ok(Row {
        name: name.to_owned(),
        views: input.views.len(),
        faces: textured.triangles.len(),
        colours,
        registered,
        moved_mm: moved_mm(&input, &place),
        frames: psnr(&textured, &video, &seen, &input.true_from_obj, Target::Frames),
        observed: textured.stats.observed,
        black: black(&textured),
        seconds,
    })
}

/// Texels that are black; the objects of the suite have no such colour.
fn black(textured: &TexturedMesh) -> usize {
    textured.texture.pixels().iter().filter(|c| c.iter().all(|v| *v < 6)).count()
}

/// Root mean square distance of the mesh's vertices between the place that the poses give it and `place`.
fn moved_mm(input: &Input, place: &Isometry3<f64>) -> f64 {
    let points = input.mesh.vertices.iter().map(|v| Point3::from(v.map(f64::from)));
    let squares: f64 = points.map(|p| (place * p - input.true_from_obj * p).norm_squared()).sum();
    1e3 * (squares / input.mesh.vertices.len().max(1) as f64).sqrt()
}
