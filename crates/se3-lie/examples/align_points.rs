//! Registers two noisy point sets several times and averages the motions that come out.
#![allow(clippy::print_stdout)]

use se3_lie::nalgebra::{Point3, Vector3, Vector6};
use se3_lie::{align, average, distance, se3};

fn main() -> Result<(), &'static str> {
    let dst_from_src = se3::exp(&Vector6::new(0.3, -0.1, 0.8, 0.4, -0.2, 0.9));
    let src: Vec<_> = (0..20)
        .map(|i| f64::from(i) * 0.7)
        .map(|t| Point3::new(t.sin() * 0.1, t.cos() * 0.1, t * 0.01))
        .collect();

    let mut motions = Vec::new();
    for round in 0..8 {
        let wobble = |i: usize, k: usize| 0.002 * (((i * 7 + k * 3 + round * 5) as f64) * 1.3).sin();
        let dst: Vec<_> = src
            .iter()
            .enumerate()
            .map(|(i, p)| dst_from_src * p + Vector3::new(wobble(i, 0), wobble(i, 1), wobble(i, 2)))
            .collect();
        motions.push(align::rigid_alignment(&src, &dst, None).ok_or("the points do not determine a motion")?);
    }
    let mean = average::pose_mean(&motions, None).ok_or("nothing to average")?;
    for motion in motions.iter().chain([&mean]) {
        let angle = distance::rotation_angle(&motion.rotation, &dst_from_src.rotation).to_degrees();
        let offset = (motion.translation.vector - dst_from_src.translation.vector).norm() * 1e3;
        println!("error {angle:.3} deg, {offset:.3} mm");
    }
    println!("the last line is the mean");
    Ok(())
}
