//! `cargo xtask bench field`.

use super::peer::{PeerArgs, number_after};
use neural_field::bench::{StepProfile, peak_bytes, peak_flops, profile_steps};
use neural_field::{FieldConfig, FieldImages};
use rgbd_io::FrameSource;
use rgbd_synth::{Masks, Sequence};
use serde::Serialize;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

type Pose = nalgebra::Isometry3<f64>;

#[derive(clap::Args)]
pub(crate) struct FieldArgs {
    /// Steps that are measured of each configuration; by default as many as take about two seconds.
    #[arg(long)]
    steps: Option<usize>,
    /// Keyframes of the demo video to train on.
    #[arg(long, default_value_t = 20)]
    frames: usize,
    /// Write all figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    peer: PeerArgs,
}

/// One configuration on one number of threads.
#[derive(Serialize)]
struct Row {
    config: &'static str,
    threads: usize,
    /// Time of day; grows with whatever else the machine does.
    step_s: f64,
    /// Processor time of the kernels, all threads in sum.
    step_cpu_s: f64,
    round_steps: usize,
    round_s: f64,
    samples_per_s: f64,
    /// Network products over the time spent in them, all threads.
    network_gflops: f64,
    peak_share: f64,
    /// Table traffic of encoding and scattering over the time spent in them, all threads.
    table_gbytes: f64,
    kernels: Vec<KernelRow>,
    peer_step_s: Option<f64>,
}

#[derive(Serialize)]
struct KernelRow {
    name: &'static str,
    share: f64,
    gflops: f64,
    gbytes: f64,
}

#[derive(Serialize)]
struct Figures {
    threads: usize,
    peak_gflops: f64,
    peak_gbytes: f64,
    rows: Vec<Row>,
}

pub(super) fn run(args: &FieldArgs) -> anyhow::Result<ExitCode> {
    let threads = std::thread::available_parallelism()?.get();
    let (frames, poses) = keyframes(args.frames)?;
    let mut figures = Figures {
        threads,
        peak_gflops: peak_flops(threads) / 1e9,
        peak_gbytes: peak_bytes(threads) / 1e9,
        rows: Vec::new(),
    };
    println!(
        "{threads} threads: {:.1} GFLOP/s in a multiply-add loop, {:.1} GB/s copied\n",
        figures.peak_gflops, figures.peak_gbytes
    );
    let configs = [
        ("realtime", FieldConfig::realtime(), None),
        ("refine", FieldConfig::refine(), None),
        ("paper", FieldConfig::paper(), Some("")),
        ("release", FieldConfig::release(), Some("--release")),
    ];
    for (name, config, peer) in configs {
        let mut counts = vec![threads];
        if threads > 1 {
            counts.push(1);
        }
        for threads in counts {
            let mut row = measure(name, &config, threads, args.steps, (&frames, &poses), &figures)?;
            // The peer gets all threads, as the first row does.
            if let (Some(mode), true) = (peer, threads == figures.threads) {
                row.peer_step_s = peer_step(&args.peer, mode, &config, threads);
            }
            print_row(&row);
            figures.rows.push(row);
        }
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&figures)?)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Every few frames of the demo video with their true poses (`obj_from_cam`).
fn keyframes(count: usize) -> anyhow::Result<(Vec<Arc<FieldImages>>, Vec<Pose>)> {
    let video = Sequence::demo().with_masks(Masks::Every);
    let stride = (video.len() / count.max(1)).max(1);
    let (mut frames, mut poses) = (Vec::new(), Vec::new());
    for index in (0..video.len()).step_by(stride).take(count.max(1)) {
        let frame = video.frame(index)?;
        let k = frame.intrinsics;
        let mask = frame.mask.as_ref().map_or_else(Vec::new, |m| m.pixels().to_vec());
        frames.push(Arc::new(FieldImages {
            id: index as u64,
            width: frame.color.width(),
            height: frame.color.height(),
            fx: k.fx,
            fy: k.fy,
            cx: k.cx,
            cy: k.cy,
            color: frame.color.pixels().to_vec(),
            depth: frame.depth.pixels().to_vec(),
            mask,
            mask_margin: 0.5,
        }));
        poses.push(video.cam_from_obj(index).inverse());
    }
    Ok((frames, poses))
}

fn measure(
    name: &'static str,
    config: &FieldConfig,
    threads: usize,
    steps: Option<usize>,
    (frames, poses): (&[Arc<FieldImages>], &[Pose]),
    figures: &Figures,
) -> anyhow::Result<Row> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let profile = |steps| pool.install(|| profile_steps(config, frames, poses, steps));
    let steps = match steps {
        Some(steps) => steps.max(1),
        None => {
            let probe = profile(2)?;
            ((2.0 * probe.steps as f64 / probe.seconds) as usize).clamp(2, 200)
        }
    };
    Ok(row(name, config, threads, &profile(steps)?, figures))
}

fn row(
    name: &'static str,
    config: &FieldConfig,
    threads: usize,
    profile: &StepProfile,
    figures: &Figures,
) -> Row {
    let all: f64 = profile.kernels.iter().map(|k| k.seconds).sum();
    // Seconds are those of all threads in sum: work over them is what one thread does.
    let rate =
        |work: f64, seconds: f64| if seconds > 0.0 { threads as f64 * work / seconds / 1e9 } else { 0.0 };
    let total = |pick: fn(&neural_field::bench::Kernel) -> f64| {
        let busy = profile.kernels.iter().filter(|k| pick(k) > 0.0);
        busy.fold((0.0, 0.0), |(work, seconds), k| (work + pick(k), seconds + k.seconds))
    };
    let ((flops, network_s), (bytes, table_s)) = (total(|k| k.flops), total(|k| k.bytes));
    let step_s = profile.seconds / profile.steps as f64;
    let network_gflops = rate(flops, network_s);
    Row {
        config: name,
        threads,
        step_s,
        step_cpu_s: all / profile.steps as f64,
        round_steps: config.steps,
        round_s: step_s * config.steps as f64,
        samples_per_s: profile.samples as f64 / step_s,
        network_gflops,
        peak_share: network_gflops / (figures.peak_gflops * threads as f64 / figures.threads as f64),
        table_gbytes: rate(bytes, table_s),
        kernels: profile
            .kernels
            .iter()
            .map(|k| KernelRow {
                name: k.name,
                share: k.seconds / all,
                gflops: rate(k.flops, k.seconds),
                gbytes: rate(k.bytes, k.seconds),
            })
            .collect(),
        peer_step_s: None,
    }
}

fn peer_step(peer: &PeerArgs, mode: &str, config: &FieldConfig, threads: usize) -> Option<f64> {
    let rays = (config.surface_rays + config.ring_rays).to_string();
    let (free, band, threads) =
        (config.free_samples.to_string(), config.band_samples.to_string(), threads.to_string());
    let mut arguments =
        vec!["--steps", "1", "--rays", &rays, "--n", &free, "--nsurf", &band, "--threads", &threads];
    if !mode.is_empty() {
        arguments.push(mode);
    }
    number_after(&peer.output(&arguments)?, "s/step=")
}

fn print_row(row: &Row) {
    println!(
        "{} on {} threads: {:.2} ms/step ({:.2} of processor time), {:.1} s for a round of {} steps, {:.2} M samples/s",
        row.config,
        row.threads,
        1e3 * row.step_s,
        1e3 * row.step_cpu_s,
        row.round_s,
        row.round_steps,
        row.samples_per_s / 1e6
    );
    println!(
        "  networks {:.1} GFLOP/s ({:.0} % of the peak), tables {:.1} GB/s",
        row.network_gflops,
        100.0 * row.peak_share,
        row.table_gbytes
    );
    let shares: Vec<_> = row.kernels.iter().map(|k| format!("{} {:.0} %", k.name, 100.0 * k.share)).collect();
    println!("  time: {}", shares.join(", "));
    if let Some(peer) = row.peer_step_s {
        println!("  peer: {:.3} s/step, ours is {:.1} times as fast", peer, peer / row.step_s);
    }
}
