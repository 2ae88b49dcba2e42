//! Several trackers in one process share the machine and nothing else.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use bundlesdf::Schedule;
use rgbd_synth::Masks;
use support::{Video, assert_same, run, small};

#[test]
fn four_trackers_at_once_give_what_each_gives_alone() {
    let video = |seed: u64| {
        let masks = if seed.is_multiple_of(2) { Masks::Every } else { Masks::First };
        let sequence = support::medium(masks).with_seed(seed);
        Video::of((0..8).map(|i| sequence.render(i).frame).collect())
    };
    let videos: Vec<_> = (0..4).map(video).collect();
    let alone: Vec<_> = videos.iter().map(|v| run(v.clone(), &small(), Schedule::Lockstep)).collect();
    let together: Vec<_> = std::thread::scope(|scope| {
        let started: Vec<_> =
            videos.iter().map(|v| scope.spawn(|| run(v.clone(), &small(), Schedule::Lockstep))).collect();
        started.into_iter().map(|s| s.join().unwrap()).collect()
    });
    for (i, (a, b)) in alone.iter().zip(&together).enumerate() {
        assert_same((&a.frames, &a.reconstruction), (&b.frames, &b.reconstruction), &format!("tracker {i}"));
        assert!(a.reconstruction.field.rounds > 1);
    }
    let meshes = alone.iter().map(|a| a.reconstruction.mesh.as_ref().unwrap());
    let all: Vec<_> = meshes.collect();
    assert!(all[0] != all[1] && all[1] != all[3], "the videos differ, and so do the results");
}

#[test]
fn four_realtime_trackers_at_once_all_come_to_an_end() {
    let frames = support::frames(Masks::Every);
    std::thread::scope(|scope| {
        let started: Vec<_> = (0..4)
            .map(|_| scope.spawn(|| run(Video::of(frames[..10].to_vec()), &small(), Schedule::Realtime)))
            .collect();
        for run in started.into_iter().map(|s| s.join().unwrap()) {
            assert_eq!(run.frames.len(), 10);
            assert!(run.reconstruction.mesh.is_some());
        }
    });
}
