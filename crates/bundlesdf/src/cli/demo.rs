//! `bundlesdf demo`: the whole system on a video whose truth is exact.

use std::{
    process::ExitCode,
    sync::{Arc, atomic::Ordering},
};

use bundlesdf::{OutputFolder, VideoInput};
use rgbd_io::FrameSource;
use rgbd_synth::{Masks, Sequence};

use super::{
    DemoArgs, DemoMasks, EXIT_INTERRUPTED,
    log::Log,
    run::{finish, print, summary, track},
    stop_flag, truth,
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
    let (_, report) = track(source, input, how, &folder, &stop, log)?;
    let products = finish(&report, &folder, &args.how, &stop, log);
    log.summary(&report, &folder);
    print(&summary(&report, &products, &folder));
    print(&truth::lines(&folder));
    Ok(if stop.load(Ordering::SeqCst) { ExitCode::from(EXIT_INTERRUPTED) } else { ExitCode::SUCCESS })
}
