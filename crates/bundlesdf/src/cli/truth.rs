//! Scores of a run against the exact truth that a synthetic video has.

use std::fs;

use bundlesdf::{
    OutputFolder, RunReport, Status, VideoInput,
    evaluate::{Scores, Truth, evaluate},
    refine::Refined,
};
use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_synth::Sequence;

/// Scores of the run itself.
const ONLINE: &str = "eval.json";
/// Scores after the refinement.
const REFINED: &str = "eval_refined.json";

/// Scores the run, and its refinement if there was one, where the truth is known; the report shows these files.
pub(super) fn write_scores(
    report: &RunReport,
    folder: &OutputFolder,
    refined: Option<&Refined>,
) -> anyhow::Result<()> {
    let Some(video) = synthetic(report) else { return Ok(()) };
    let poses =
        report.frames.iter().map(|f| folder.read_pose(&f.id)).collect::<Result<Vec<_>, rgbd_io::Error>>()?;
    let mesh = folder.read_online_mesh()?;
    folder.write_json(ONLINE, &score(&video, &poses, mesh.as_ref(), report.count(Status::Lost)))?;
    if let Some(refined) = refined {
        write_refined(&video, folder, refined)?;
    }
    Ok(())
}

/// The same for a refinement alone: what the run's own scores were stays.
pub(super) fn write_refined_scores(
    report: &RunReport,
    folder: &OutputFolder,
    refined: &Refined,
) -> anyhow::Result<()> {
    if !folder.path().join(ONLINE).is_file() {
        return write_scores(report, folder, Some(refined));
    }
    synthetic(report).map_or(Ok(()), |video| write_refined(&video, folder, refined))
}

fn write_refined(video: &Sequence, folder: &OutputFolder, refined: &Refined) -> anyhow::Result<()> {
    let poses: Vec<_> = refined.frames.iter().map(|f| f.cam_from_obj).collect();
    let unmeasured = refined.frames.iter().filter(|f| !f.measured).count();
    Ok(folder.write_json(REFINED, &score(video, &poses, Some(&refined.mesh), unmeasured))?)
}

fn synthetic(report: &RunReport) -> Option<Sequence> {
    let VideoInput::Synthetic { name, .. } = report.input.as_ref()? else { return None };
    if name == "demo" { Some(Sequence::demo()) } else { Sequence::named(name) }
}

fn score(video: &Sequence, poses: &[Isometry3<f64>], mesh: Option<&TriMesh>, lost: usize) -> Scores {
    let exact: Vec<_> = (0..poses.len()).map(|i| video.cam_from_obj(i)).collect();
    let truth = Truth {
        cam_from_obj: &exact,
        mesh: video.mesh(),
        intrinsics: video.intrinsics(),
        size: (video.spec().width, video.spec().height),
    };
    evaluate(poses, mesh, lost, &truth)
}

/// What the files of scores say, a line each; nothing where there are none.
pub(super) fn lines(folder: &OutputFolder) -> String {
    let read = |name: &str| -> Option<Scores> {
        serde_json::from_slice(&fs::read(folder.path().join(name)).ok()?).ok()
    };
    let line = |name: &str, s: &Scores, rest: &str| {
        let chamfer = s.cd_cm.map_or_else(|| "no mesh".to_owned(), |cd| format!("chamfer {cd:.2} cm"));
        let (add, add_s) = (s.add, s.add_s);
        format!(
            "{name:<10} ADD AUC {add:.2}, ADD-S AUC {add_s:.2} (0 to 0.1 m, percent), {chamfer}, {} {rest}\n",
            s.lost
        )
    };
    let online = read(ONLINE).map(|s| line("online", &s, "lost"));
    let refined = read(REFINED).map(|s| line("refined", &s, "not measured"));
    online.into_iter().chain(refined).collect()
}
