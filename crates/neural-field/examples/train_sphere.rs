//! Trains a field on a painted sphere seen by 16 depth cameras whose poses are wrong by 1 cm and 5 degrees, and
//! prints how far the surface and the poses are from the truth: `cargo run --release --example train_sphere`.
#![allow(clippy::print_stdout)]

#[path = "../tests/scene/mod.rs"]
mod scene;

use neural_field::{Control, FieldConfig, FieldError, StepLosses, train};
use scene::{Shape, perturb, pose_errors, sdf_errors, views};
use std::time::Instant;

fn main() -> Result<(), FieldError> {
    let sphere = Shape::Sphere { radius: 0.1 };
    let (frames, truth) = views(&sphere, 16, 120);
    let start = perturb(&truth, 0.01, 5f64.to_radians());
    let report = |step: usize, losses: &StepLosses| {
        if step.is_multiple_of(50) {
            println!("step {step:3}: loss {:.4}, surface {:.4}", losses.total(), losses.surface);
        }
    };
    let clock = Instant::now();
    let control = Control { stop: None, progress: Some(&report) };
    let field = train(&FieldConfig::realtime(), &frames, &start, &control)?;
    println!("trained in {:.1} s", clock.elapsed().as_secs_f64());

    let errors = sdf_errors(&field, &sphere, 0.005, 5000);
    println!("distance within 5 mm of the surface: median error {:.2} mm", 1e3 * errors[errors.len() / 2]);
    for (name, poses) in [("before", start.as_slice()), ("after", field.poses())] {
        let [shift, worst_shift, turn, worst_turn] = pose_errors(poses, &truth);
        println!(
            "poses {name}: median {:.2} mm {:.2} deg, worst {:.2} mm {:.2} deg",
            1e3 * shift,
            turn.to_degrees(),
            1e3 * worst_shift,
            worst_turn.to_degrees()
        );
    }
    let mesh = field.extract_mesh(0.004);
    println!("mesh: {} vertices, {} piece(s)", mesh.vertices.len(), mesh.components().len());
    Ok(())
}
