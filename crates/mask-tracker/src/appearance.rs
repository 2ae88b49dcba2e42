//! Colour models of object and background.

use serde::{Deserialize, Serialize};

use crate::grid::Color;

const LUMA: usize = 16;
const CHROMA: usize = 24;
const BINS: usize = LUMA * CHROMA * CHROMA;
/// Density that every colour has at least: keeps one stray sample from deciding.
const FLOOR: f32 = 2e-4;

/// A smoothed histogram over opponent colour.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Histogram {
    density: Vec<f32>,
    filled: bool,
}

fn bin(c: Color) -> usize {
    let axis =
        |v: f32, width: f32, offset: f32, bins: usize| ((v / width + offset).max(0.0) as usize).min(bins - 1);
    let half = CHROMA as f32 * 0.5;
    let y = axis(c[0], 16.0, 0.0, LUMA);
    let a = axis(c[1], 12.0, half, CHROMA);
    let b = axis(c[2], 12.0, half, CHROMA);
    (y * CHROMA + a) * CHROMA + b
}

impl Histogram {
    pub(crate) fn empty() -> Self {
        Self { density: vec![0.0; BINS], filled: false }
    }

    pub(crate) fn from_colors(colors: impl Iterator<Item = Color>) -> Self {
        let mut density = vec![0.0f32; BINS];
        let mut count = 0usize;
        for c in colors {
            density[bin(c)] += 1.0;
            count += 1;
        }
        if count > 0 {
            let scale = 1.0 / count as f32;
            density.iter_mut().for_each(|d| *d *= scale);
            smooth(&mut density);
        }
        Self { density, filled: count > 0 }
    }

    /// Moves towards `other` by `rate`; an empty histogram on either side changes nothing or is replaced.
    pub(crate) fn blend(&mut self, other: &Self, rate: f32) {
        if !other.filled {
            return;
        }
        if !self.filled {
            self.clone_from(other);
            return;
        }
        for (a, b) in self.density.iter_mut().zip(&other.density) {
            *a += rate * (b - *a);
        }
    }

    #[inline]
    fn at(&self, c: Color) -> f32 {
        self.density[bin(c)]
    }
}

/// Binomial filter (1 2 1)/4 along each axis of the histogram.
fn smooth(density: &mut [f32]) {
    for (stride, size) in [(1, CHROMA), (CHROMA, CHROMA), (CHROMA * CHROMA, LUMA)] {
        for start in 0..BINS / size {
            let base = start / stride * (stride * size) + start % stride;
            let mut before = density[base];
            for k in 0..size {
                let i = base + k * stride;
                let here = density[i];
                let after = if k + 1 < size { density[i + stride] } else { here };
                density[i] = 0.25 * before + 0.5 * here + 0.25 * after;
                before = here;
            }
        }
    }
}

/// Object against background. Half of the object's model is the first frame's and is never forgotten.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Appearance {
    anchor: Histogram,
    object: Histogram,
    background: Histogram,
    /// Balanced accuracy of the sign of [`Appearance::log_ratio`] on the frames learnt from; 0.5 = useless.
    accuracy: f32,
}

impl Appearance {
    pub(crate) fn empty() -> Self {
        Self {
            anchor: Histogram::empty(),
            object: Histogram::empty(),
            background: Histogram::empty(),
            accuracy: 0.5,
        }
    }

    pub(crate) fn start(object: Histogram, background: Histogram) -> Self {
        Self { anchor: object.clone(), object, background, accuracy: 0.5 }
    }

    /// Whether all histograms have their bins: false for a damaged copy.
    pub(crate) fn is_whole(&self) -> bool {
        [&self.anchor, &self.object, &self.background].iter().all(|h| h.density.len() == BINS)
    }

    pub(crate) fn learn(&mut self, object: &Histogram, background: &Histogram, rate: f32) {
        self.object.blend(object, rate);
        self.background.blend(background, rate);
    }

    /// Measures how well colour separates the two labels of a trusted frame.
    pub(crate) fn grade(&mut self, log_ratio: &[f32], labels: &[bool], rate: f32) {
        let mut hits = [0u32; 2];
        let mut counts = [0u32; 2];
        for (&l, &object) in log_ratio.iter().zip(labels) {
            counts[usize::from(object)] += 1;
            hits[usize::from(object)] += u32::from((l > 0.0) == object);
        }
        if counts[0] > 0 && counts[1] > 0 {
            let accuracy = 0.5 * (hits[0] as f32 / counts[0] as f32 + hits[1] as f32 / counts[1] as f32);
            self.accuracy += rate * (accuracy - self.accuracy);
        }
    }

    /// 0..1: how much colour decides.
    pub(crate) fn reliability(&self) -> f32 {
        ((self.accuracy - 0.6) / 0.35).clamp(0.0, 1.0)
    }

    /// `ln p(colour | object) / p(colour | background)`, within +-3; 0 when a model is missing.
    pub(crate) fn log_ratio(&self, c: Color) -> f32 {
        if !self.anchor.filled || !self.background.filled {
            return 0.0;
        }
        let object = 0.5 * (self.anchor.at(c) + self.object.at(c));
        ((object + FLOOR) / (self.background.at(c) + FLOOR)).ln().clamp(-3.0, 3.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::opponent;

    #[test]
    fn smoothing_keeps_the_sum_and_colours_are_told_apart() {
        let red = opponent([200.0, 40.0, 40.0]);
        let blue = opponent([40.0, 40.0, 200.0]);
        let object = Histogram::from_colors(std::iter::repeat_n(red, 50));
        assert!((object.density.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        let model = Appearance::start(object, Histogram::from_colors(std::iter::repeat_n(blue, 50)));
        assert!(model.log_ratio(red) > 2.0 && model.log_ratio(blue) < -2.0);
        assert_eq!(Appearance::empty().log_ratio(red), 0.0);
    }
}
