//! An inspection as text.

use std::fmt;

use super::{DepthRange, Inspection, Severity};

/// Findings printed; a folder with more has one cause for most of them.
const SHOWN: usize = 12;

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Info => "info",
            Self::Warning => "warning",
            Self::Error => "error",
        })
    }
}

impl fmt::Display for DepthRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} / {:.3} / {:.3} m (5 / 50 / 95 %)", self.p05, self.p50, self.p95)
    }
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.path.display())?;
        let size = self.size.map_or(String::new(), |(w, h)| format!(" of {w}x{h}"));
        let stride = if self.frames < self.color_files {
            format!(" (of {} colour images)", self.color_files)
        } else {
            String::new()
        };
        writeln!(f, "  frames   {}{size}{stride}, {} looked at", self.frames, self.sampled)?;
        if let Some(k) = self.intrinsics {
            write!(f, "  camera   fx {:.1}  fy {:.1}  cx {:.1}  cy {:.1}", k.fx, k.fy, k.cx, k.cy)?;
            match self.fov_degrees {
                Some([across, down]) => writeln!(f, ", view {across:.0} x {down:.0} degrees")?,
                None => writeln!(f)?,
            }
        }
        self.depth_lines(f)?;
        write!(
            f,
            "  masks    {} files, used for {} of {} frames",
            self.mask_files, self.frames_with_mask, self.frames
        )?;
        match self.mask_coverage {
            Some(share) => writeln!(f, "; the first covers {:.1} % of the image", 100.0 * share)?,
            None => writeln!(f)?,
        }
        self.finding_lines(f)
    }
}

impl Inspection {
    fn depth_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let units = self.depth_units.map_or(String::new(), |u| format!(", looks like {u}"));
        writeln!(f, "  depth    {} files, {} m per unit{units}", self.depth_files, self.depth_scale)?;
        let missing =
            |share: Option<f64>| share.map_or(String::new(), |s| format!(", {:.1} % missing", 100.0 * s));
        if let Some(range) = self.depth {
            writeln!(f, "    image  {range}{}", missing(self.missing_depth))?;
        }
        if let Some(range) = self.depth_in_mask {
            writeln!(f, "    object {range}{}", missing(self.missing_depth_in_mask))?;
        }
        Ok(())
    }

    fn finding_lines(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for finding in self.findings.iter().take(SHOWN) {
            writeln!(f, "  {:<8} {}", finding.severity, finding.message)?;
            writeln!(f, "           -> {}", finding.remedy)?;
        }
        if self.findings.len() > SHOWN {
            writeln!(f, "  ... and {} more", self.findings.len() - SHOWN)?;
        }
        let count = |s: Severity| self.findings.iter().filter(|f| f.severity == s).count();
        match (count(Severity::Error), count(Severity::Warning)) {
            (0, 0) => write!(f, "  ready"),
            (0, warnings) => write!(f, "  ready, with {warnings} warning(s)"),
            (errors, warnings) => write!(f, "  not ready: {errors} error(s), {warnings} warning(s)"),
        }
    }
}
