//! Measures how fast the demo, or the suite's sequence of the name given, renders, and prints what its motion and
//! occlusion amount to: `frame_rate [NAME]`.
#![allow(clippy::print_stdout)]

use rgbd_synth::Sequence;
use std::time::Instant;

fn main() {
    let start = Instant::now();
    let demo = std::env::args().nth(1).and_then(|name| Sequence::named(&name)).unwrap_or_else(Sequence::demo);
    println!("object: {} triangles in {:.2?}", demo.mesh().triangles.len(), start.elapsed());
    let start = Instant::now();
    demo.render(0);
    println!("first frame with the backdrop: {:.2?}", start.elapsed());
    let start = Instant::now();
    for index in 0..demo.len() {
        demo.render(index);
    }
    let seconds = start.elapsed().as_secs_f64();
    println!("{:.1} frames/s on {} threads", demo.len() as f64 / seconds, rayon::current_num_threads());
    let (mut turned, mut fastest, mut furthest) = (0.0, 0.0f64, 0.0f64);
    for index in 1..demo.len() {
        let (a, b) = (demo.cam_from_obj(index - 1), demo.cam_from_obj(index));
        let angle = a.rotation.angle_to(&b.rotation).to_degrees();
        turned += angle;
        fastest = fastest.max(angle);
        furthest = furthest.max((a.translation.vector - b.translation.vector).norm());
    }
    println!(
        "turned by {turned:.0} degrees, at most {fastest:.2} degrees and {:.1} mm a frame",
        1e3 * furthest
    );
    let hidden: Vec<f64> = (0..demo.len()).step_by(6).map(|i| demo.occlusion(i)).collect();
    let mean = hidden.iter().sum::<f64>() / hidden.len() as f64;
    let most = hidden.iter().copied().fold(0.0, f64::max);
    println!("hidden: {:.0} % on average, {:.0} % at most", 100.0 * mean, 100.0 * most);
}
