use super::super::published;
use super::super::score::Errors;
use super::super::video::{Masks, Place};
use super::*;
use baselines::Baseline;

const SDF2SDF: Method = Method::Baseline(Baseline::Sdf2Sdf);

fn asked(benchmark: Benchmark, video: &str, method: Method, repeat: u64) -> Asked {
    let (root, name) = ("data".into(), video.to_owned());
    let place = Place { benchmark, root, name, models: None, object: None, stride: 1 };
    Asked { method, place, repeat, masks: Masks::First, schedule: None, config: None, python: None }
}

/// A run with the same ADD and ADD-S error in every frame.
fn run(
    benchmark: Benchmark,
    video: &str,
    method: Method,
    error: f64,
    frames: usize,
    cd: Option<f64>,
) -> Entry {
    let errors = vec![Some(error); frames];
    let errors =
        Errors { frames: (0..frames).collect(), add: errors.clone(), add_s: errors, ..Errors::default() };
    let score = Score { cd_cm: cd, cd_icp_cm: cd.map(|c| c / 2.0), errors, ..Score::default() };
    Entry { asked: asked(benchmark, video, method, 0), score: Ok(score), other_build: None }
}

fn tables(benchmark: Benchmark, entries: &[Entry]) -> Tables {
    let published = published::table(benchmark).unwrap();
    Tables::new(benchmark, entries, &published, published::ablations(benchmark).unwrap())
}

fn near(value: Option<f64>, expected: f64) -> bool {
    value.is_some_and(|v| (v - expected).abs() < 1e-9)
}

#[test]
fn means_are_over_videos_and_pooled_ones_over_frames() {
    let b = Benchmark::Synth;
    let entries = [
        run(b, "a", Method::Ours, 0.0, 10, Some(0.5)),
        run(b, "b", Method::Ours, 0.2, 30, None),
        run(b, "a", SDF2SDF, 0.2, 10, Some(0.4)),
        run(b, "b", SDF2SDF, 0.2, 30, Some(0.6)),
    ];
    let tables = tables(b, &entries);
    assert_eq!(tables.groups, ["a", "b"]);
    let ours = &tables.columns[0];
    assert!(near(ours.mean.add, 50.0) && near(ours.pooled.unwrap().add, 25.0));
    // One surface of two: no mean to compare with others.
    assert_eq!((ours.mean.cd_cm, ours.cd_groups), (Some(0.5), Some(1)));
    assert_eq!(tables.best(None, Metric::Chamfer), [false, true]);
    assert_eq!(tables.best(Some(0), Metric::Chamfer), [false, true]);
    assert_eq!(tables.best(None, Metric::Add), [true, false]);
    // Equal to the digits that are shown.
    assert_eq!(tables.best(Some(1), Metric::Add), [true, true]);
}

#[test]
fn a_failed_run_counts_as_nothing_and_not_as_absent() {
    let b = Benchmark::YcbInEoat;
    let mut failed = run(b, "mustard_easy_00_02", Method::Ours, 0.0, 1, None);
    failed.score = Err("no mask".into());
    let entries = [
        run(b, "mustard0", Method::Ours, 0.0, 10, Some(0.4)),
        failed,
        run(b, "mustard0", SDF2SDF, 0.0, 10, Some(0.4)),
        run(b, "mustard_easy_00_02", SDF2SDF, 0.0, 30, Some(0.8)),
    ];
    let tables = tables(b, &entries);
    // Both videos are one line; the failed one has the frames that the other method scored.
    assert_eq!(tables.groups, ["006_mustard_bottle"]);
    let column = |m: Method| tables.columns.iter().find(|c| c.method == Some(m)).unwrap();
    assert!(near(column(Method::Ours).values[0].add, 25.0));
    assert!(near(column(SDF2SDF).values[0].add, 100.0));
    // After ICP, as published: means of 0.2 and 0.4.
    assert!(near(column(SDF2SDF).values[0].cd_cm, 0.3));
    // The table's mean is over frames of all objects, which one object's line doesn't tell.
    let paper = tables.columns.iter().find(|c| c.name == "BundleSDF").unwrap();
    assert_eq!((paper.values[0].add, paper.mean.add), (Some(89.87), None));
}

#[test]
fn published_means_are_over_the_same_videos() {
    let b = Benchmark::Ho3d;
    let entries = [run(b, "AP10", Method::Ours, 0.0, 5, None), run(b, "AP11", Method::Ours, 0.0, 5, None)];
    let two = tables(b, &entries);
    let paper = two.columns.iter().find(|c| c.name == "BundleSDF").unwrap();
    assert!(near(paper.mean.add, (91.00 + 91.76) / 2.0) && near(paper.mean.cd_cm, (0.47 + 0.56) / 2.0));
    // All thirteen: the published mean itself.
    let table = published::table(b).unwrap();
    let all: Vec<Entry> = table
        .iter()
        .filter(|l| l.method == "BundleSDF" && l.group != MEAN)
        .map(|l| run(b, &l.group, Method::Ours, 0.0, 5, None))
        .collect();
    assert_eq!(all.len(), 13);
    let whole = tables(b, &all);
    let droid = whole.columns.iter().find(|c| c.name == "DROID-SLAM").unwrap();
    assert_eq!(droid.mean, Values { add_s: Some(64.64), add: Some(33.36), cd_cm: Some(30.84) });
    // Of videos that the paper hasn't, nothing was published.
    assert_eq!(tables(b, &[run(b, "tiny", Method::Ours, 0.0, 5, None)]).columns.len(), 1);
    // Of BEHAVE there are means alone.
    let behave = tables(Benchmark::Behave, &[run(Benchmark::Behave, "x", Method::Ours, 0.0, 5, None)]);
    assert_eq!((behave.columns.len(), behave.columns[5].mean.add), (7, Some(67.52)));
}

#[test]
fn repeats_are_averaged() {
    let b = Benchmark::Custom;
    let first = run(b, "a", Method::Ours, 0.0, 10, Some(0.4));
    let mut second = run(b, "a", Method::Ours, 0.2, 10, Some(0.6));
    second.asked = asked(b, "a", Method::Ours, 1);
    let tables = tables(b, &[first, second]);
    assert_eq!(tables.columns.len(), 1);
    assert!(near(tables.columns[0].values[0].add, 50.0) && near(tables.columns[0].mean.cd_cm, 0.5));
}
