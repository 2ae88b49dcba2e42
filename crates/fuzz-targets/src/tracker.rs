//! `Tracker::track` on frames that no camera should deliver, in any order, between good ones.
//!
//! The first byte chooses the configuration. Then each frame takes a byte for the good frame it starts from and the
//! number of changes, and a few bytes for each change.

use crate::bytes::Bytes;
use crate::check_pose;
use bundlesdf::config::Refiner;
use bundlesdf::{Config, Schedule, Tracker};
use rgbd_io::{Image, Intrinsics, RgbdFrame};
use rgbd_synth::{Sequence, SequenceSpec};
use std::sync::OnceLock;

const MOST_FRAMES: usize = 8;
const MOST_SIDE: usize = 96;

const DEPTHS: [f32; 16] = [
    0.0,
    0.5,
    0.6,
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    -1.0,
    1e-30,
    1e30,
    f32::MAX,
    f32::MIN_POSITIVE,
    0.1,
    9.99,
    65.535,
    -0.0,
    0.1001,
];
const NUMBERS: [f64; 16] = [
    0.0,
    1.0,
    -1.0,
    f64::NAN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    1e300,
    1e-300,
    f64::MAX,
    f64::MIN_POSITIVE,
    40.0,
    1e6,
    -1e6,
    1e-6,
    30.0,
    f64::EPSILON,
];

/// Good frames of 80 x 60 pixels, all with masks.
fn good_frames() -> &'static [RgbdFrame] {
    static FRAMES: OnceLock<Vec<RgbdFrame>> = OnceLock::new();
    FRAMES.get_or_init(|| {
        let tiny = Sequence::tiny().spec().clone();
        let intrinsics = tiny.intrinsics.scaled(0.5, 0.5);
        let spec = SequenceSpec { width: 80, height: 60, frames: 12, intrinsics, ..tiny };
        let Ok(sequence) = Sequence::new(spec) else { return Vec::new() };
        (0..sequence.len()).map(|i| sequence.render(i).frame).collect()
    })
}

fn config(choice: u8) -> Config {
    let mut config = Config::default();
    config.preprocess.min_mask_pixels = 30;
    config.preprocess.mask_erosion = usize::from(choice >> 2 & 3);
    config.coarse.max_corners = 60;
    config.coarse.max_corners_memory = 40;
    config.coarse.hypotheses = 50;
    config.memory.capacity = 2 + usize::from(choice >> 4 & 3);
    config.memory.min_swing_deg = 2.0;
    config.graph.dense_pixels = 500;
    // The field trains in few inputs: a round takes as long as hundreds of frames.
    config.field.refiner = match choice & 0xc3 {
        0xc3 => Refiner::Field,
        0x80..=0x82 => Refiner::PoseGraph,
        _ => Refiner::None,
    };
    config.field.first_round_keyframes = 2;
    config.field.keyframes_per_round = 2;
    config.field.steps = 2;
    config.field.final_steps = 3;
    config.mesh.spacing = 0.02;
    config
}

pub(crate) fn run(data: &[u8]) {
    let mut bytes = Bytes(data);
    let good = good_frames();
    assert!(!good.is_empty(), "the good frames can't be rendered");
    let tracker = Tracker::new(config(bytes.byte()), Schedule::Lockstep);
    assert!(tracker.is_ok());
    let Ok(mut tracker) = tracker else { return };
    for _ in 0..MOST_FRAMES {
        if bytes.is_empty() {
            break;
        }
        let choice = bytes.byte();
        let Some(frame) = good.get(usize::from(choice & 15) % good.len()) else { return };
        if choice >= 0xf0 {
            check_pose(&tracker.skip("missing").cam_from_obj);
            continue;
        }
        let mut frame = frame.clone();
        for _ in 0..choice >> 4 & 3 {
            change(&mut bytes, &mut frame);
        }
        let result = tracker.track(&frame);
        check_pose(&result.cam_from_obj);
        assert!(result.depth_agreement.is_finite());
    }
    let reconstruction = tracker.finish();
    for keyframe in &reconstruction.keyframes {
        check_pose(&keyframe.obj_from_cam);
    }
    if let Some(mesh) = &reconstruction.mesh {
        assert!(mesh.vertices.iter().flatten().all(|v| v.is_finite()));
    }
}

/// One thing that is wrong with a frame.
fn change(bytes: &mut Bytes<'_>, frame: &mut RgbdFrame) {
    let (w, h) = frame.color.size();
    match bytes.below(16) {
        0 => {
            let z = bytes.choice(&DEPTHS, 0.0);
            fill(bytes, &mut frame.depth, z);
        }
        1 => {
            let c = bytes.byte();
            fill(bytes, &mut frame.color, [c, c.wrapping_mul(3), 255 - c]);
        }
        2 => frame.mask = None,
        3 => {
            let value = bytes.byte();
            if let Some(mask) = &mut frame.mask {
                fill(bytes, mask, value);
            }
        }
        4 => frame.mask = Some(Image::filled(side(bytes), side(bytes), 255)),
        5 => frame.depth = Image::filled(side(bytes), side(bytes), 0.5),
        6 => frame.color = Image::filled(side(bytes), side(bytes), [90; 3]),
        7 => resize(frame, side(bytes), side(bytes)),
        8 => camera(bytes, &mut frame.intrinsics),
        9 => {
            let (seed, spread) = (bytes.byte(), f32::from(bytes.byte()) / 100.0);
            noise(seed, &mut frame.depth, |z, v| *z += spread * v);
        }
        10 => frame.mask = Some(Image::filled(w, h, 255)),
        11 => {
            let scale = bytes.choice(&DEPTHS, 1.0);
            frame.depth.pixels_mut().iter_mut().for_each(|z| *z *= scale);
        }
        12 => noise(bytes.byte(), &mut frame.color, |c, v| {
            *c = c.map(|c| c.wrapping_add((v * 99.0) as i8 as u8))
        }),
        13 => frame.mask = Some(Image::filled(w, h, 0)),
        14 => resize(frame, 1, 1),
        _ => {
            let period = 1 + bytes.below(7);
            let (inside, outside) = (bytes.choice(&DEPTHS, 0.5), bytes.choice(&DEPTHS, 0.6));
            let pattern =
                |x: usize, y: usize| if (x / period + y / period) % 2 == 0 { inside } else { outside };
            frame.depth = Image::from_fn(w, h, pattern);
        }
    }
}

fn side(bytes: &mut Bytes<'_>) -> usize {
    bytes.below(MOST_SIDE)
}

/// Sets a rectangle; what lies outside of the image is left out.
fn fill<T: Clone>(bytes: &mut Bytes<'_>, image: &mut Image<T>, value: T) {
    let (x0, y0, w, h) = (side(bytes), side(bytes), side(bytes), side(bytes));
    let (width, height) = image.size();
    for y in y0.min(height)..(y0 + h).min(height) {
        for x in x0.min(width)..(x0 + w).min(width) {
            image[(x, y)] = value.clone();
        }
    }
}

/// Colour, depth and mask at another size, all three.
fn resize(frame: &mut RgbdFrame, w: usize, h: usize) {
    fn nearest<T: Clone + Default>(image: &Image<T>, w: usize, h: usize) -> Image<T> {
        let (sw, sh) = image.size();
        Image::from_fn(w, h, |x, y| image.get(x * sw / w, y * sh / h).cloned().unwrap_or_default())
    }
    frame.color = nearest(&frame.color, w, h);
    frame.depth = nearest(&frame.depth, w, h);
    frame.mask = frame.mask.as_ref().map(|mask| nearest(mask, w, h));
}

fn camera(bytes: &mut Bytes<'_>, k: &mut Intrinsics) {
    let value = bytes.choice(&NUMBERS, 0.0);
    match bytes.below(5) {
        0 => k.fx = value,
        1 => k.fy = value,
        2 => k.cx = value,
        3 => k.cy = value,
        _ => (k.fx, k.fy) = (value, value),
    }
}

/// Adds something between -1 and 1 to every pixel.
fn noise<T>(seed: u8, image: &mut Image<T>, add: impl Fn(&mut T, f32)) {
    let mut state = u32::from(seed) + 1;
    for pixel in image.pixels_mut() {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        add(pixel, (state >> 8) as f32 / 8_388_608.0 - 1.0);
    }
}
