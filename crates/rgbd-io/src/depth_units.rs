//! Is this depth in millimetres? Medians of raw 16-bit values.

use std::path::Path;

use crate::{Error, Image, Mask};

/// No depth camera measures nearer or farther (metres); a median outside means the wrong units.
const PLAUSIBLE_METRES: std::ops::RangeInclusive<f64> = 0.01..=20.0;

/// Counts of raw depth values, for exact percentiles.
pub(crate) struct Histogram {
    counts: Vec<u32>,
    valid: u64,
    missing: u64,
}

impl Histogram {
    pub(crate) fn new() -> Self {
        Self { counts: vec![0; 1 << 16], valid: 0, missing: 0 }
    }

    /// Adds the pixels of `depth` that lie in `mask`, or all of them.
    pub(crate) fn add(&mut self, depth: &Image<u16>, mask: Option<&Mask>) {
        for (i, raw) in depth.pixels().iter().enumerate() {
            if mask.is_some_and(|m| m.pixels().get(i).is_none_or(|v| *v == 0)) {
                continue;
            }
            if *raw == 0 {
                self.missing += 1;
            } else {
                self.counts[usize::from(*raw)] += 1;
                self.valid += 1;
            }
        }
    }

    /// Pixels with depth.
    pub(crate) fn valid(&self) -> u64 {
        self.valid
    }

    /// Whether any pixel was added.
    pub(crate) fn looked(&self) -> bool {
        self.valid + self.missing > 0
    }

    /// The part of the pixels without depth; 1 when there are no pixels.
    pub(crate) fn missing_share(&self) -> f64 {
        let all = self.valid + self.missing;
        if all == 0 { 1.0 } else { self.missing as f64 / all as f64 }
    }

    /// The raw value below which the part `q` (0 to 1) of the valid pixels lies; `None` without any.
    pub(crate) fn percentile(&self, q: f64) -> Option<u16> {
        let rank = (q * self.valid as f64).min(self.valid.saturating_sub(1) as f64) as u64;
        let mut seen = 0;
        for (raw, count) in self.counts.iter().enumerate() {
            seen += u64::from(*count);
            if seen > rank {
                return u16::try_from(raw).ok();
            }
        }
        None
    }

    /// The part of the valid pixels with raw values in `range`.
    pub(crate) fn share_within(&self, range: std::ops::RangeInclusive<f64>) -> f64 {
        let inside = self.counts.iter().enumerate().filter(|(raw, _)| range.contains(&(*raw as f64)));
        inside.map(|(_, n)| f64::from(*n)).sum::<f64>() / (self.valid.max(1) as f64)
    }
}

/// The units that make a median of raw values a likely distance: their name and the metres per unit.
pub(crate) fn guess_units(median_raw: u16) -> (&'static str, f64) {
    match median_raw {
        0..10 => ("metres", 1.0),
        10..100 => ("centimetres", 0.01),
        100..=20_000 => ("millimetres", 0.001),
        _ => ("tenths of a millimetre", 0.0001),
    }
}

/// Fails when `median_raw * depth_scale` is no distance that a depth camera measures.
pub(crate) fn check_units(path: &Path, median_raw: u16, depth_scale: f64) -> Result<(), Error> {
    let metres = f64::from(median_raw) * depth_scale;
    if PLAUSIBLE_METRES.contains(&metres) {
        return Ok(());
    }
    let (units, scale) = guess_units(median_raw);
    let problem = format!(
        "its median depth of {median_raw} would be {metres} m at a depth scale of {depth_scale}; it looks like {units}"
    );
    let remedy = if scale == depth_scale {
        "pass --depth-scale with the metres per unit of these files".to_owned()
    } else if median_raw < 10 {
        format!(
            "pass --depth-scale {scale}, or better save depth in millimetres: whole metres are too coarse"
        )
    } else {
        format!("pass --depth-scale {scale} (metres per unit)")
    };
    Err(Error::new(path, problem, remedy))
}
