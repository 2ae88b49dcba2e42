//! Is this the camera of these images?

use super::{Finding, Severity};
use crate::Intrinsics;
use crate::layout::rescale_remedy;

/// Full angles of view, degrees.
pub(super) fn fov_degrees(k: &Intrinsics, size: (usize, usize)) -> [f64; 2] {
    let angle = |pixels: usize, f: f64| 2.0 * (pixels as f64 / (2.0 * f)).atan().to_degrees();
    [angle(size.0, k.fx), angle(size.1, k.fy)]
}

/// What is unusual about a camera that is valid as such.
pub(super) fn plausibility(k: &Intrinsics, size: (usize, usize)) -> Vec<Finding> {
    let mut findings = Vec::new();
    let (w, h) = (size.0 as f64, size.1 as f64);
    let off_centre = [(k.cx / w - 0.5).abs(), (k.cy / h - 0.5).abs()];
    if off_centre.iter().any(|d| *d > 0.15) {
        let message = format!(
            "cam_K.txt: the principal point ({:.1}, {:.1}) is far from the centre of {w}x{h} images",
            k.cx, k.cy
        );
        findings.push(Finding::new(Severity::Warning, message, rescale_remedy(k, size)));
    }
    let [across, down] = fov_degrees(k, size);
    if [across, down].iter().any(|a| !(15.0..=120.0).contains(a)) {
        let message = format!("cam_K.txt: an angle of view of {across:.0} x {down:.0} degrees is unusual");
        let remedy = "check that fx and fy are in pixels of these images, not in millimetres or of another \
                      resolution";
        findings.push(Finding::new(Severity::Warning, message, remedy));
    }
    let ratio = k.fx / k.fy;
    if !(0.6..=1.0 / 0.6).contains(&ratio) {
        let message = format!("cam_K.txt: fx and fy differ by the factor {ratio:.2}");
        let remedy = "check the camera matrix; fine only if the images were squeezed in one direction";
        findings.push(Finding::new(Severity::Warning, message, remedy));
    } else if !(0.97..=1.03).contains(&ratio) {
        let message = format!("cam_K.txt: fx and fy differ by the factor {ratio:.2} (non-square pixels)");
        findings.push(Finding::new(Severity::Info, message, "nothing, if the images were resized unevenly"));
    }
    findings
}
