//! `cargo xtask bench surface`: how far the field's surface and poses are from the true ones, round by round setting.
//!
//! A round is trained on keyframes of the synthetic suite as the tracker would give them, with true masks and with
//! poses that are true or disturbed by a known amount, so that the field's own error is seen apart from the tracker's.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::Context;
use bundlesdf::{Config, Observation};
use eval_metrics::{Camera, MeshProtocol, MeshRef, ModelPoints, add, keep_faces, score_mesh, visible_faces};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use neural_field::{Control, FieldConfig, FieldImages, TrainedField, train};
use rgbd_synth::Sequence;
use serde::Serialize;

/// Points of the true surface that the field is asked about.
const POINTS: usize = 20_000;
/// Spacing of the extracted mesh, metres.
const SPACING: f32 = 0.0025;

/// What to measure and how.
#[derive(clap::Args)]
pub(crate) struct SurfaceArgs {
    /// Sequences of the suite, or demo; all of the suite when none is named.
    #[arg(value_name = "NAME")]
    names: Vec<String>,
    /// Settings of the round: realtime, refine, paper, release.
    #[arg(long, value_delimiter = ',', default_value = "realtime")]
    settings: Vec<String>,
    /// Steps of the round in place of the setting's own number.
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Frames that are trained on, spread evenly over the video.
    #[arg(long, default_value_t = 24, value_name = "N")]
    views: usize,
    /// Disturb every pose but the first by up to so many millimetres and degrees per axis.
    #[arg(long, value_delimiter = ',', num_args = 1, value_name = "MM,DEG")]
    noise: Vec<f64>,
    /// Leave the poses as they are given.
    #[arg(long)]
    fixed: bool,
    /// Also write the figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// The figures of one sequence under one setting.
#[derive(Serialize)]
struct Row {
    name: String,
    settings: String,
    views: usize,
    /// Distance of the field's zero level from points of the true surface, millimetres, positive where the field's
    /// surface lies inside the true one.
    bias_mm: f64,
    median_mm: f64,
    p95_mm: f64,
    /// Median angle between the field's normals and the true ones, degrees.
    normals_deg: f64,
    /// Share of the points at which the field is known.
    known: f64,
    chamfer_cm: f64,
    /// Mean over the frames of the mean distance between model points (ADD), before and after, millimetres.
    pose_before_mm: f64,
    pose_mm: f64,
    seconds: f64,
}

struct Views {
    images: Vec<Arc<FieldImages>>,
    truth: Vec<Isometry3<f64>>,
    start: Vec<Isometry3<f64>>,
}

/// Trains a round per sequence and setting, and prints a table.
pub(super) fn run(args: &SurfaceArgs) -> anyhow::Result<ExitCode> {
    let mut names = args.names.clone();
    if names.is_empty() {
        names.extend(Sequence::suite().map(String::from));
    }
    println!(
        "sequence             settings   bias mm  median mm  p95 mm  normals  known  chamfer cm  poses mm         s"
    );
    let mut rows: Vec<Row> = Vec::new();
    for name in &names {
        let video = match name.as_str() {
            "demo" => Sequence::demo(),
            _ => {
                Sequence::named(name).with_context(|| format!("there is no sequence {name} in the suite"))?
            }
        };
        let views = views(&video, args)?;
        for settings in &args.settings {
            let row = measure(name, settings, &video, &views, args)?;
            println!("{}", line(&row));
            rows.push(row);
        }
    }
    for settings in &args.settings {
        if let Some(mean) = mean(settings, &rows) {
            println!("{}", line(&mean));
        }
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&rows)?)
            .with_context(|| format!("{} can't be written", path.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn line(r: &Row) -> String {
    format!(
        "{:<20} {:<9} {:>8.2} {:>10.2} {:>7.2} {:>8.1} {:>5.1} % {:>10.3} {:>5.2} -> {:>5.2} {:>7.1}",
        r.name,
        r.settings,
        r.bias_mm,
        r.median_mm,
        r.p95_mm,
        r.normals_deg,
        100.0 * r.known,
        r.chamfer_cm,
        r.pose_before_mm,
        r.pose_mm,
        r.seconds
    )
}

fn mean(settings: &str, rows: &[Row]) -> Option<Row> {
    let rows: Vec<&Row> = rows.iter().filter(|r| r.settings == settings).collect();
    let of = |pick: fn(&Row) -> f64| rows.iter().map(|r| pick(r)).sum::<f64>() / rows.len() as f64;
    (rows.len() > 1).then(|| Row {
        name: "mean".into(),
        settings: settings.into(),
        views: rows.iter().map(|r| r.views).sum::<usize>() / rows.len(),
        bias_mm: of(|r| r.bias_mm),
        median_mm: of(|r| r.median_mm),
        p95_mm: of(|r| r.p95_mm),
        normals_deg: of(|r| r.normals_deg),
        known: of(|r| r.known),
        chamfer_cm: of(|r| r.chamfer_cm),
        pose_before_mm: of(|r| r.pose_before_mm),
        pose_mm: of(|r| r.pose_mm),
        seconds: of(|r| r.seconds),
    })
}

/// Frames with the true masks, as the tracker hands them to the field.
fn views(video: &Sequence, args: &SurfaceArgs) -> anyhow::Result<Views> {
    let config = Config::default();
    let count = args.views.clamp(1, video.len());
    let mut views = Views { images: Vec::new(), truth: Vec::new(), start: Vec::new() };
    for i in 0..count {
        let index = i * video.len() / count;
        let seen = video.render(index);
        // Where the object is hidden there is nothing to train on.
        let Ok(observation) = Observation::new(index, &seen.frame, &seen.visible_mask, &config) else {
            continue;
        };
        let pose = seen.cam_from_obj.inverse();
        views.start.push(match args.noise[..] {
            [mm, deg] if !views.truth.is_empty() => disturbed(&pose, mm, deg, index),
            _ => pose,
        });
        views.truth.push(pose);
        views.images.push(observation.images.clone());
    }
    Ok(views)
}

/// A fixed disturbance of up to `mm` and `deg` per axis of the object, about its origin.
fn disturbed(obj_from_cam: &Isometry3<f64>, mm: f64, deg: f64, index: usize) -> Isometry3<f64> {
    let wave = |k: usize| (index as f64 * 12.9898 + k as f64 * 78.233).sin();
    let shift = Vector3::new(wave(0), wave(1), wave(2)) * mm * 1e-3;
    let turn = Vector3::new(wave(3), wave(4), wave(5)) * deg.to_radians();
    Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::from_scaled_axis(turn)) * obj_from_cam
}

fn measure(
    name: &str,
    settings: &str,
    video: &Sequence,
    views: &Views,
    args: &SurfaceArgs,
) -> anyhow::Result<Row> {
    let mut config = match settings {
        "realtime" => FieldConfig::realtime(),
        "refine" => FieldConfig::refine(),
        "paper" => FieldConfig::paper(),
        "release" => FieldConfig::release(),
        other => anyhow::bail!("no settings {other}: there are realtime, refine, paper, release"),
    };
    config.steps = args.steps.unwrap_or(config.steps);
    if args.fixed {
        config.pose_learning_rate = 0.0;
    }
    let begin = std::time::Instant::now();
    let field = train(&config, &views.images, &views.start, &Control::default())?;
    let seconds = begin.elapsed().as_secs_f64();

    let mesh = video.mesh();
    let vertices: Vec<[f64; 3]> = mesh.vertices.iter().map(|v| v.map(f64::from)).collect();
    let all = MeshRef::new(&vertices, &mesh.triangles);
    let cameras: Vec<_> = views.truth.iter().map(Isometry3::inverse).collect();
    let k = video.intrinsics();
    let (width, height) = (video.spec().width, video.spec().height);
    let camera = Camera { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width, height };
    let seen = keep_faces(&mesh.triangles, &visible_faces(all, &cameras, &camera));
    let seen = MeshRef::new(&vertices, &seen);
    let errors = Errors::of(&field, seen);
    let model = ModelPoints::from_mesh(all).context("the object has no surface")?;
    let poses = |poses: &[Isometry3<f64>]| {
        let error = |(p, t): (&Isometry3<f64>, &Isometry3<f64>)| add(&p.inverse(), &t.inverse(), &model);
        1e3 * poses.iter().zip(&views.truth).map(error).sum::<f64>() / poses.len() as f64
    };
    let found = field.extract_mesh(SPACING).largest_component();
    let found_vertices: Vec<[f64; 3]> = found.vertices.iter().map(|v| v.map(f64::from)).collect();
    let found = MeshRef::new(&found_vertices, &found.triangles);
    let chamfer = score_mesh(found, seen, &Isometry3::identity(), &MeshProtocol::paper_text());
    Ok(Row {
        name: name.into(),
        settings: settings.into(),
        views: views.images.len(),
        bias_mm: errors.bias_mm,
        median_mm: errors.median_mm,
        p95_mm: errors.p95_mm,
        normals_deg: errors.normals_deg,
        known: errors.known,
        chamfer_cm: chamfer.map_or(f64::NAN, |c| 100.0 * c.distance()),
        pose_before_mm: poses(&views.start),
        pose_mm: poses(field.poses()),
        seconds,
    })
}

struct Errors {
    bias_mm: f64,
    median_mm: f64,
    p95_mm: f64,
    normals_deg: f64,
    known: f64,
}

impl Errors {
    fn of(field: &TrainedField, surface: MeshRef<'_>) -> Self {
        let (points, normals) = oriented_points(surface);
        let (mut sdf, mut gradient) = (vec![0.0f32; points.len()], vec![[0.0f32; 3]; points.len()]);
        field.sdf_and_gradient(&points, &mut sdf, &mut gradient);
        let (mut signed, mut angles) = (Vec::new(), Vec::new());
        for ((s, g), n) in sdf.iter().zip(&gradient).zip(&normals) {
            let g = Vector3::from(g.map(f64::from));
            if s.is_finite() && g.norm() > 0.0 {
                signed.push(1e3 * f64::from(*s));
                angles.push((g.normalize().dot(n)).clamp(-1.0, 1.0).acos().to_degrees());
            }
        }
        let known = signed.len() as f64 / points.len().max(1) as f64;
        let bias_mm = signed.iter().sum::<f64>() / signed.len().max(1) as f64;
        let mut absolute: Vec<f64> = signed.iter().map(|v| v.abs()).collect();
        absolute.sort_by(f64::total_cmp);
        angles.sort_by(f64::total_cmp);
        let at = |v: &[f64], q: f64| v.get((q * v.len() as f64) as usize).copied().unwrap_or(f64::NAN);
        Self {
            bias_mm,
            median_mm: at(&absolute, 0.5),
            p95_mm: at(&absolute, 0.95),
            normals_deg: at(&angles, 0.5),
            known,
        }
    }
}

/// Centres of triangles evenly spread over a surface, with their outward normals.
fn oriented_points(surface: MeshRef<'_>) -> (Vec<[f32; 3]>, Vec<Vector3<f64>>) {
    let corners = |t: &[u32; 3]| t.map(|i| Vector3::from(surface.vertices[i as usize]));
    // Twice the area, along the normal.
    let area = |t: &[u32; 3]| {
        let [a, b, c] = corners(t);
        (b - a).cross(&(c - a))
    };
    let total: f64 = surface.triangles.iter().map(|t| area(t).norm()).sum();
    let (mut points, mut normals) = (Vec::new(), Vec::new());
    let mut passed = 0.0;
    for t in surface.triangles {
        let n = area(t);
        passed += n.norm() * POINTS as f64 / total;
        if points.len() as f64 + 0.5 < passed {
            let [a, b, c] = corners(t);
            let centre = (a + b + c) / 3.0;
            points.push([centre.x as f32, centre.y as f32, centre.z as f32]);
            normals.push(n.normalize());
        }
    }
    (points, normals)
}
