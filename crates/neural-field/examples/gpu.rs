//! Trains a sphere on the best GPU there is, real or software, and on the CPU, and prints the time of a step and
//! how far the surface is from the truth: `cargo run --release --features gpu --example gpu [steps] [surface rays]`.
#![allow(clippy::print_stdout)]

#[path = "../tests/scene/mod.rs"]
mod scene;

use neural_field::{Control, Device, FieldConfig, FieldError};
use scene::{Shape, perturb, pose_errors, sdf_errors, views};
use std::time::Instant;

fn main() -> Result<(), FieldError> {
    let number =
        |i: usize, default: usize| std::env::args().nth(i).and_then(|a| a.parse().ok()).unwrap_or(default);
    let (steps, surface_rays) = (number(1, 100).max(2), number(2, 96));
    let sphere = Shape::Sphere { radius: 0.1 };
    let (frames, truth) = views(&sphere, 16, 120);
    let start = perturb(&truth, 0.005, 2f64.to_radians());
    let config = FieldConfig { steps, surface_rays, ring_rays: surface_rays / 3, ..FieldConfig::realtime() };
    for device in [Device::gpu(), Ok(Device::Cpu)] {
        let mut round = match device.and_then(|d| d.round(&config, &frames, &start)) {
            Ok(round) => round,
            Err(e) => {
                println!("{e}");
                continue;
            }
        };
        // The first step compiles the kernels.
        round.train(1, &Control::default())?;
        let clock = Instant::now();
        round.train(steps - 1, &Control::default())?;
        let seconds = clock.elapsed().as_secs_f64() / (steps - 1) as f64;
        let field = round.field()?;
        let errors = sdf_errors(&field, &sphere, 0.005, 5000);
        let [shift, _, turn, _] = pose_errors(field.poses(), &truth);
        let vertices = field.extract_mesh(0.005).vertices;
        let off = vertices.iter().map(|v| sphere.sdf(v.map(f64::from)).abs()).sum::<f64>();
        println!(
            "{}: {:.4} s/step; distance within 5 mm: median error {:.2} mm; mesh to sphere: mean {:.2} mm; poses: \
             median {:.2} mm {:.2} deg",
            round.device(),
            seconds,
            1e3 * errors[errors.len() / 2],
            1e3 * off / vertices.len() as f64,
            1e3 * shift,
            turn.to_degrees()
        );
    }
    Ok(())
}
