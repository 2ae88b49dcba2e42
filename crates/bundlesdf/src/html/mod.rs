//! `report.html`: one file, without any request to the network, that shows what a run did.

mod gather;
mod glb;
mod losses;
mod overlays;
mod page;
mod plot;
mod sphere;
mod story;
mod timeline;

use std::path::PathBuf;

use rgbd_io::{Error, poses::write_atomic};

use self::gather::Results;
use crate::output::OutputFolder;

/// Reads a finished run's folder and writes `report.html` into it; answers the file's path. The video is opened once
/// more for the frames with overlays; when it has moved, the page says so and holds the rest.
///
/// # Errors
/// When `run.json` or `keyframes.json` can't be read, or the page can't be written.
pub fn write_page(folder: &OutputFolder) -> Result<PathBuf, Error> {
    let results = Results::gather(folder)?;
    let path = folder.path().join("report.html");
    write_atomic(&path, page::render(&results).as_bytes())?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Config, RunReport, Schedule, VideoRun,
        tracker::{FieldSummary, Reconstruction},
    };

    fn empty_run() -> RunReport {
        let reconstruction =
            Reconstruction { mesh: None, keyframes: Vec::new(), field: FieldSummary::default() };
        let run = VideoRun {
            frames: Vec::new(),
            reconstruction,
            unreadable: Vec::new(),
            interrupted: true,
            wall: std::time::Duration::ZERO,
        };
        RunReport::new(&Config::default(), Schedule::Lockstep, &run)
    }

    #[test]
    fn a_run_of_nothing_still_has_a_page() {
        let dir = tempfile::tempdir().unwrap();
        let folder = OutputFolder::create(dir.path(), false).unwrap();
        folder.write_report(&empty_run()).unwrap();
        folder.write_json("keyframes.json", &Vec::<crate::KeyframeReport>::new()).unwrap();
        let text = std::fs::read_to_string(write_page(&folder).unwrap()).unwrap();
        assert!(text.starts_with("<!DOCTYPE html>") && text.trim_end().ends_with("</html>"));
        assert!(text.contains("No frame was tracked"));
        for number in ["NaN", "inf,", "inf\""] {
            let body = &text[..text.find("<script").unwrap()];
            assert!(!body.contains(number), "{number}");
        }
    }

    #[test]
    fn names_from_outside_are_escaped() {
        let dir = tempfile::tempdir().unwrap();
        let folder = OutputFolder::create(dir.path(), false).unwrap();
        let mut report = empty_run();
        report.warnings.push("<script>alert(1)</script>.png: is truncated".into());
        folder.write_report(&report).unwrap();
        folder.write_json("keyframes.json", &Vec::<crate::KeyframeReport>::new()).unwrap();
        let text = std::fs::read_to_string(write_page(&folder).unwrap()).unwrap();
        assert!(!text.contains("<script>alert") && text.contains("&lt;script&gt;alert"));
    }

    #[test]
    fn a_folder_without_a_run_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let error = OutputFolder::open(dir.path()).unwrap_err().to_string();
        assert!(error.contains("run.json"), "{error}");
    }
}
