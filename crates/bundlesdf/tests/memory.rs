//! Memory and time per frame stay flat over a very long video.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use std::time::Instant;

use bundlesdf::{Schedule, Tracker};
use rgbd_synth::Masks;
use support::small;

/// Resident memory of this process (MiB); 0 where the system doesn't tell.
fn resident() -> f64 {
    let text = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = text.split_whitespace().nth(1).and_then(|n| n.parse::<f64>().ok()).unwrap_or(0.0);
    pages * 4096.0 / (1 << 20) as f64
}

/// Tracks the tiny sequence to and fro; returns memory (MiB) and seconds of each part of `part` frames.
fn run(frames: usize, part: usize, masks: Masks) -> Vec<(f64, f64)> {
    let mut video = support::frames(Masks::Every);
    if masks == Masks::First {
        video.iter_mut().skip(1).for_each(|f| f.mask = None);
    }
    let mut tracker = Tracker::new(small(), Schedule::Lockstep).unwrap();
    let (mut parts, mut start) = (Vec::new(), Instant::now());
    let last = video.len() - 1;
    for index in 0..frames {
        let phase = index % (2 * last);
        // The first frame's mask starts the propagation, and comes once.
        let mut frame = video[if phase <= last { phase } else { 2 * last - phase }].clone();
        if masks == Masks::First && index > 0 {
            frame.mask = None;
        }
        tracker.track(&frame);
        if (index + 1) % 100 == 0 {
            // What a run does as it goes.
            tracker.save().unwrap();
        }
        if (index + 1) % part == 0 {
            parts.push((resident(), start.elapsed().as_secs_f64()));
            start = Instant::now();
        }
    }
    assert!(tracker.pool().keyframes().len() <= small().memory.capacity);
    parts
}

#[test]
fn memory_does_not_grow_over_six_hundred_frames() {
    for masks in [Masks::Every, Masks::First] {
        let parts = run(600, 200, masks);
        let growth = parts[2].0 - parts[1].0;
        // 200 frames of 160x120 held would be 25 MiB.
        assert!(growth < 12.0, "{growth:.1} MiB more after 200 frames: {parts:?}");
    }
}

/// The bar. `cargo test --release -p bundlesdf --test memory -- --ignored --nocapture`
#[test]
#[ignore = "minutes long"]
fn memory_and_time_are_flat_over_twenty_thousand_frames() {
    for masks in [Masks::Every, Masks::First] {
        let parts = run(20_000, 1000, masks);
        println!("masks {masks:?}: frames, resident memory (MiB), ms per frame");
        for (i, (memory, seconds)) in parts.iter().enumerate() {
            println!("{:6} {memory:7.1} {seconds:7.2}", 1000 * (i + 1));
        }
        assert!(parts[19].0 < parts[4].0 + 16.0, "memory grows");
    }
}
