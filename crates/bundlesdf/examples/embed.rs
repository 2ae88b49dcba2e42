//! Feeds frames from memory into the tracker, as another SLAM system would: no files, no command line.
//!
//! `cargo run --release --example embed`
#![allow(clippy::print_stdout)]

use bundlesdf::{Config, Schedule, Status, Tracker};
use nalgebra::Isometry3;
use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};
use rgbd_synth::Sequence;

/// What a camera driver or a SLAM system has in its hands: raw buffers.
struct CameraBuffers {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
    depth_mm: Vec<u16>,
}

/// Wraps raw buffers as a frame; `None` when their lengths don't fit the size.
fn to_frame(
    id: usize,
    buffers: &CameraBuffers,
    intrinsics: Intrinsics,
    mask: Option<Mask>,
) -> Option<RgbdFrame> {
    let (width, height) = (buffers.width, buffers.height);
    let rgb = buffers.rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    let depth = buffers.depth_mm.iter().map(|mm| f32::from(*mm) * 1e-3).collect();
    Some(RgbdFrame {
        id: id.to_string(),
        color: Image::from_vec(width, height, rgb)?,
        depth: Image::from_vec(width, height, depth)?,
        mask,
        intrinsics,
    })
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Stands for the camera.
    let camera = Sequence::tiny();
    let buffers = |index: usize| {
        let frame = camera.render(index).frame;
        CameraBuffers {
            width: frame.color.width(),
            height: frame.color.height(),
            rgb: frame.color.pixels().iter().flatten().copied().collect(),
            depth_mm: frame.depth.pixels().iter().map(|d| (d * 1e3).round() as u16).collect(),
        }
    };

    let mut config = Config::default();
    config.memory.min_swing_deg = 6.0;
    let mut tracker = Tracker::new(config, Schedule::Realtime)?;
    let mut first: Option<Isometry3<f64>> = None;
    for index in 0..camera.len() {
        // Only the first frame needs a mask; here the simulator has it, elsewhere a person or a detector does.
        let mask = (index == 0).then(|| camera.render(0).visible_mask);
        let frame = to_frame(index, &buffers(index), camera.intrinsics(), mask)
            .ok_or("a buffer has the wrong size")?;
        let result = tracker.track(&frame);
        let start = *first.get_or_insert(result.cam_from_obj);
        let motion = result.cam_from_obj * start.inverse();
        println!(
            "frame {:>2}: {:<11} {:>3} matches, turned {:>5.1} deg since the first frame",
            result.id,
            result.status.as_str(),
            result.inliers,
            motion.rotation.angle().to_degrees()
        );
        if result.status == Status::Lost {
            println!(
                "          the pose is the last good one; tracking goes on by itself when the object is seen again"
            );
        }
    }
    let reconstruction = tracker.finish();
    match &reconstruction.mesh {
        Some(mesh) => println!("mesh: {} vertices, {} triangles", mesh.vertices.len(), mesh.triangles.len()),
        None => println!("no mesh: the field had too few keyframes"),
    }
    Ok(())
}
