//! The checks on numbers already gathered.

use super::{DepthRange, Finding, Inspection, Severity};
use crate::layout::Layout;
use crate::{Cadence, Mask, Shift};

/// Numbers of files that don't match.
pub(super) fn counts(layout: &Layout, masks_unused: bool, seen: &mut Inspection) {
    let without: Vec<&str> =
        layout.entries.iter().filter(|e| e.depth.is_none()).map(|e| e.id.as_str()).collect();
    // Without any depth file the folder itself was reported.
    if layout.depth_files > 0 && !without.is_empty() {
        let shown = without.iter().take(3).copied().collect::<Vec<_>>().join(", ");
        let more = if without.len() > 3 { ", ..." } else { "" };
        let message = format!(
            "depth/: {} of {} frames have no depth file ({shown}{more})",
            without.len(),
            layout.entries.len()
        );
        let remedy = "these frames are skipped; export their depth, and check that both folders number alike";
        seen.findings.push(Finding::new(Severity::Warning, message, remedy));
    }
    if layout.depth_files > layout.color_files {
        let message = format!("{} depth images for {} colour images", layout.depth_files, layout.color_files);
        let remedy = "the surplus is ignored; check that depth and colour of one name were taken together";
        seen.findings.push(Finding::new(Severity::Info, message, remedy));
    }
    if !masks_unused && layout.mask_files > layout.color_files {
        let message = format!("{} masks for {} colour images", layout.mask_files, layout.color_files);
        seen.findings.push(Finding::new(Severity::Info, message, "the surplus is ignored"));
    }
    let mut cadence = Cadence::default();
    let gaps: Vec<_> =
        layout.entries.iter().filter_map(|e| Some((&e.id, cadence.missing_before(&e.id)?))).collect();
    if let Some((id, missing)) = gaps.first() {
        let message = format!("{} gaps between frames; the first: {missing} missing before {id}", gaps.len());
        let remedy = "record with fewer pixels, to a faster disk or without other programs; slow motion tolerates \
                      gaps";
        seen.findings.push(Finding::new(Severity::Warning, message, remedy));
    }
    if layout.entries.len() < 5 {
        let message = format!("only {} frames", layout.entries.len());
        let remedy = "record more frames, from more sides of the object; a reconstruction needs tens of them";
        seen.findings.push(Finding::new(Severity::Warning, message, remedy));
    }
}

/// The part of the image covered, and what is odd about a first mask.
pub(super) fn mask(mask: &Mask, name: &str) -> (f64, Vec<Finding>) {
    let (w, h) = mask.size();
    let covered = mask.pixels().iter().filter(|v| **v != 0).count();
    let coverage = covered as f64 / mask.pixels().len().max(1) as f64;
    let mut found = Vec::new();
    let on = |x: usize, y: usize| mask.get(x, y).is_some_and(|v| *v != 0);
    let all_borders = w > 0
        && h > 0
        && (0..w).any(|x| on(x, 0))
        && (0..w).any(|x| on(x, h - 1))
        && (0..h).any(|y| on(0, y))
        && (0..h).any(|y| on(w - 1, y));
    if coverage > 0.6 || all_borders {
        let how = match (coverage > 0.6, all_borders) {
            (true, true) => "covers most of the image and touches all four borders",
            (true, false) => "covers most of the image",
            _ => "touches all four borders",
        };
        let severity = if coverage > 0.6 && all_borders { Severity::Error } else { Severity::Warning };
        let message = format!("{name}: the mask {how} ({:.1} %): inverted?", 100.0 * coverage);
        found.push(Finding::new(severity, message, "paint the object white and the background black"));
    } else if covered > 0 && covered < 400 {
        let message = format!("{name}: the mask covers only {covered} pixels");
        let remedy = "start at a frame in which the object is larger, or record from nearer";
        found.push(Finding::new(Severity::Warning, message, remedy));
    }
    (coverage, found)
}

/// What is odd about depth inside the first mask; `near` is the part of it within 25 cm of the median.
pub(super) fn depth_in_mask(range: DepthRange, missing: f64, near: f64, name: &str) -> Vec<Finding> {
    let mut found = Vec::new();
    let percent = 100.0 * missing;
    if missing > 0.5 {
        let message = format!("{name}: {percent:.0} % of the mask has no depth");
        let remedy = "move the object farther from the camera (at least 0.3 m for most), avoid shiny, black or \
                      transparent surfaces, and check that the mask belongs to this frame";
        found.push(Finding::new(Severity::Warning, message, remedy));
    } else if missing > 0.2 {
        let message = format!("{name}: {percent:.0} % of the mask has no depth");
        found.push(Finding::new(Severity::Info, message, "nothing; the holes are bridged where possible"));
    }
    let metres = range.p50;
    if metres > 3.0 {
        let message = format!("{name}: the object is {metres:.2} m away, where depth cameras are coarse");
        let remedy = "record from 0.3 to 1.5 m; if it was nearer, the units are wrong: pass --depth-scale (depth \
                      in units of 1/5000 m, for example, needs 0.0002)";
        found.push(Finding::new(Severity::Warning, message, remedy));
    } else if metres < 0.15 {
        let message = format!("{name}: the object is {metres:.3} m away, nearer than depth cameras measure");
        let remedy = "if it was farther, the units are wrong: pass --depth-scale (metres per unit)";
        found.push(Finding::new(Severity::Warning, message, remedy));
    }
    if near < 0.75 {
        let message = format!(
            "{name}: {:.0} % of the depth inside the mask is more than 25 cm from its median",
            100.0 * (1.0 - near)
        );
        let remedy = "the mask contains background, or depth isn't registered to colour: draw the mask tighter, \
                      export depth aligned to colour";
        found.push(Finding::new(Severity::Warning, message, remedy));
    }
    found
}

/// Depth that fits colour only when shifted.
pub(super) fn registration(shift: Option<Shift>) -> Option<Finding> {
    let [dx, dy] = shift?.pixels;
    let message = format!("depth/: depth fits colour better when shifted by ({dx}, {dy}) pixels");
    let remedy = "export depth registered to colour (the camera's software calls it aligned depth)";
    Some(Finding::new(Severity::Warning, message, remedy))
}

/// Frames in which the object is smeared.
pub(super) fn blur(blurred: usize, sharp: usize) -> Option<Finding> {
    let message = format!("the object is blurred in {blurred} of {} frames looked at", blurred + sharp);
    let remedy = "move it more slowly, add light, or set a shorter exposure; check the focus";
    (blurred > sharp).then(|| Finding::new(Severity::Warning, message, remedy))
}
