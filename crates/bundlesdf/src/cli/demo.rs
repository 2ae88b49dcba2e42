//! `bundlesdf demo`: the whole system on a video whose truth is exact.

use std::{
    process::ExitCode,
    sync::{Arc, atomic::Ordering},
};

use bundlesdf::{
    OutputFolder, Status, VideoInput,
    evaluate::{Scores, Truth, evaluate},
};
use rgbd_io::FrameSource;
use rgbd_synth::{Masks, Sequence};

use super::{
    DemoArgs, DemoMasks, EXIT_INTERRUPTED,
    log::Log,
    refine::truth_lines,
    run::{finish, print, summary, track},
    stop_flag,
};

/// Makes the video, runs the system on it and prints how good the result is.
pub(super) fn demo(args: &DemoArgs, log: Log) -> anyhow::Result<ExitCode> {
    let (config, schedule) = args.how.resolve()?;
    let folder = OutputFolder::create(&args.out, true)?;
    let masks = match args.masks {
        DemoMasks::First => Masks::First,
        DemoMasks::All => Masks::Every,
    };
    let video = Sequence::demo().with_masks(masks);
    let video = args.frames.map_or_else(|| video.clone(), |n| video.truncated(n));
    let (width, height) = (video.spec().width, video.spec().height);
    print(&format!(
        "demo       {} frames, {width}x{height}, synthetic hand-held object with occluder and sensor noise\n",
        video.len()
    ));
    let source: Arc<dyn FrameSource> = Arc::new(video.clone());
    let given = if args.masks == DemoMasks::All { "all" } else { "first" };
    let input = VideoInput::Synthetic { name: "demo".into(), masks: given.into(), frames: video.len() };
    let stop = stop_flag();
    let how = (&config, schedule, &args.how.segmenter);
    let (run, report) = track(source, input, how, &folder, &stop, log)?;
    let truth: Vec<_> = (0..run.frames.len()).map(|i| video.cam_from_obj(i)).collect();
    let truth = Truth {
        cam_from_obj: &truth,
        mesh: video.mesh(),
        intrinsics: video.intrinsics(),
        size: (width, height),
    };
    let poses: Vec<_> = run.frames.iter().map(|f| f.cam_from_obj).collect();
    let scores = evaluate(&poses, run.reconstruction.mesh.as_ref(), report.count(Status::Lost), &truth);
    folder.write_json("eval.json", &scores)?;
    let products = finish(&report, &folder, &args.how, &stop, log);
    log.summary(&report, &folder);
    print(&summary(&report, &products, &folder));
    match &products.refined {
        Some(refined) => print(&truth_lines(&report, &folder, refined)?),
        None => print(&score_lines(&scores)),
    }
    Ok(if stop.load(Ordering::SeqCst) { ExitCode::from(EXIT_INTERRUPTED) } else { ExitCode::SUCCESS })
}

fn score_lines(scores: &Scores) -> String {
    let chamfer = scores.cd_cm.map_or_else(|| "no mesh".to_owned(), |cd| format!("{cd:.2} cm"));
    format!(
        "truth      ADD AUC {:.2}, ADD-S AUC {:.2} (0 to 0.1 m, percent), chamfer {chamfer}, {} lost (eval.json)\n",
        scores.add, scores.add_s, scores.lost
    )
}
