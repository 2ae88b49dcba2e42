//! Decoding a few frames and gathering their numbers.

use super::{DepthRange, Finding, Inspection, Severity, findings};
use crate::custom::no_depth;
use crate::depth_units::{Histogram, check_units, guess_units};
use crate::layout::{self, Entry, Layout};
use crate::{BLURRED, Error, Image, Mask, Registration, codec, sharpness};

/// What the sampled frames hold.
pub(super) struct Samples {
    size: Option<(usize, usize)>,
    count: usize,
    all: Histogram,
    /// The first frame's depth, inside its mask.
    inside: Histogram,
    first: Option<Entry>,
    first_mask: Option<Mask>,
    /// Errors of one kind counted together: the first of them and their number.
    errors: Vec<(Error, usize)>,
    empty_masks: usize,
    no_depth_frames: usize,
    registration: Registration,
    /// Frames with a mask that were sharp enough, or not.
    sharp: usize,
    blurred: usize,
}

impl Samples {
    /// Reads up to `count` frames of `layout`, with the first and the last among them.
    pub(super) fn read(layout: &Layout, count: usize) -> Self {
        let mut samples = Self {
            size: None,
            count: 0,
            all: Histogram::new(),
            inside: Histogram::new(),
            first: layout.entries.first().cloned(),
            first_mask: None,
            errors: Vec::new(),
            empty_masks: 0,
            no_depth_frames: 0,
            registration: Registration::default(),
            sharp: 0,
            blurred: 0,
        };
        let n = layout.entries.len();
        let k = count.min(n);
        for i in 0..k {
            let index = if k > 1 { i * (n - 1) / (k - 1) } else { 0 };
            samples.add(layout, &layout.entries[index], index == 0);
        }
        samples
    }

    fn add(&mut self, layout: &Layout, entry: &Entry, is_first: bool) {
        self.count += 1;
        let color = match codec::read_color(&entry.color) {
            Ok(color) => color,
            Err(e) => return self.note(e),
        };
        let size = color.size();
        let expected = *self.size.get_or_insert(size);
        if size != expected {
            let ((w, h), (ew, eh)) = (size, expected);
            let problem = format!("has {w}x{h} pixels but the first image {ew}x{eh}");
            return self.note(Error::new(
                &entry.color,
                problem,
                "use images of one size, from one camera setting",
            ));
        }
        let mask = self.mask(entry, size, is_first);
        // Frames without a depth file were counted from the listing.
        if entry.depth.is_some() {
            match layout::read_depth(&layout.root, entry, size) {
                Ok(depth) => {
                    // Jumps count by their share of the depth: the unit doesn't matter.
                    self.registration.add(&color, &depth.map(|raw| f32::from(*raw)));
                    self.depth(&depth, mask.as_ref().filter(|_| is_first));
                }
                Err(e) => self.note(e),
            }
        }
        if let Some(sharpness) = mask.as_ref().and_then(|mask| sharpness(&color, mask)) {
            let count = if sharpness < BLURRED { &mut self.blurred } else { &mut self.sharp };
            *count += 1;
        }
        if is_first {
            self.first_mask = mask;
        }
    }

    fn mask(&mut self, entry: &Entry, size: (usize, usize), is_first: bool) -> Option<Mask> {
        let path = entry.mask.as_deref()?;
        let read = layout::read_mask(path, size);
        let mask = read.map_err(|e| self.note(e)).ok()?;
        match layout::check_not_empty(path, &mask) {
            Ok(()) => Some(mask),
            Err(e) if is_first => {
                self.note(e);
                None
            }
            Err(_) => {
                self.empty_masks += 1;
                None
            }
        }
    }

    fn depth(&mut self, depth: &Image<u16>, first_mask: Option<&Mask>) {
        let before = self.all.valid();
        self.all.add(depth, None);
        self.no_depth_frames += usize::from(self.all.valid() == before);
        if let Some(mask) = first_mask {
            self.inside.add(depth, Some(mask));
        }
    }

    fn note(&mut self, error: Error) {
        match self.errors.iter_mut().find(|(e, _)| e.problem == error.problem) {
            Some((_, count)) => *count += 1,
            None => self.errors.push((error, 1)),
        }
    }

    /// Fills in what the samples show.
    pub(super) fn report_into(&self, seen: &mut Inspection) {
        seen.sampled = self.count;
        seen.size = self.size;
        for (error, count) in &self.errors {
            let mut finding = Finding::from_error(error);
            if *count > 1 {
                finding.message += &format!(" (and {} more of {} frames looked at)", count - 1, self.count);
            }
            seen.findings.push(finding);
        }
        let counted = |n: usize, what: &str, remedy: &str| {
            let message = format!("{n} of {} frames looked at have {what}", self.count);
            Finding::new(Severity::Warning, message, remedy)
        };
        if self.empty_masks > 0 {
            let remedy = "nothing, if the object can't be seen in them";
            seen.findings.push(counted(self.empty_masks, "a mask without any object pixel", remedy));
        }
        if self.no_depth_frames > 0 && self.all.valid() > 0 {
            let remedy = "export their depth again, or leave these frames out";
            seen.findings.push(counted(self.no_depth_frames, "depth images without any depth", remedy));
        }
        seen.findings.extend(findings::registration(self.registration.shift()));
        seen.findings.extend(findings::blur(self.blurred, self.sharp));
        self.depth_into(seen);
    }

    fn depth_into(&self, seen: &mut Inspection) {
        let scale = seen.depth_scale;
        let range = |h: &Histogram| -> Option<DepthRange> {
            let metres = |q| h.percentile(q).map(|raw| f64::from(raw) * scale);
            Some(DepthRange { p05: metres(0.05)?, p50: metres(0.5)?, p95: metres(0.95)? })
        };
        let read_any = self.all.looked();
        seen.missing_depth = read_any.then(|| self.all.missing_share());
        seen.depth = range(&self.all);
        seen.depth_in_mask = range(&self.inside);
        let Some(entry) = &self.first else { return };
        let depth_path = entry.depth.as_deref().unwrap_or(&entry.color);
        let name = |path: &std::path::Path| path.display().to_string();
        if let Some(mask) = &self.first_mask {
            let mask_path = entry.mask.as_deref().unwrap_or(&entry.color);
            let (coverage, found) = findings::mask(mask, &name(mask_path));
            seen.mask_coverage = Some(coverage);
            seen.findings.extend(found);
        }
        // The object decides where there is one; the whole image otherwise.
        let decisive = if self.inside.valid() > 0 { &self.inside } else { &self.all };
        let units_ok = decisive.percentile(0.5).is_none_or(|median| {
            seen.depth_units = Some(guess_units(median).0);
            let checked = check_units(depth_path, median, scale);
            checked.map_err(|e| seen.findings.push(Finding::from_error(&e))).is_ok()
        });
        if read_any && self.all.valid() == 0 {
            seen.findings.push(Finding::from_error(&no_depth(depth_path, false)));
        } else if let (Some(inside), true) = (seen.depth_in_mask, units_ok) {
            let missing = self.inside.missing_share();
            seen.missing_depth_in_mask = Some(missing);
            let near = self.inside.share_within((inside.p50 - 0.25) / scale..=(inside.p50 + 0.25) / scale);
            seen.findings.extend(findings::depth_in_mask(inside, missing, near, &name(depth_path)));
        } else if self.first_mask.is_some() && self.inside.looked() && self.inside.valid() == 0 {
            seen.missing_depth_in_mask = Some(1.0);
            seen.findings.push(Finding::from_error(&no_depth(depth_path, true)));
        }
    }
}
