//! Colour models of object and background.

use crate::grid::Color;

const LUMA: usize = 16;
const CHROMA: usize = 24;
const BINS: usize = LUMA * CHROMA * CHROMA;
/// Density that every colour has at least: keeps one stray sample from deciding.
const FLOOR: f32 = 2e-4;

/// A smoothed histogram over opponent colour.
#[derive(Clone)]
pub(crate) struct Histogram {
    density: Vec<f32>,
    filled: bool,
}

#[inline]
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

/// Where background lies: about as far away as the object, as a hand is, or elsewhere. A colour that the wall has
/// tells nothing of a cell at the object's depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Band {
    Near,
    Far,
}

/// A histogram of which half is the first frame's, where the labels are certain, and never forgotten.
#[derive(Clone)]
struct Anchored {
    anchor: Histogram,
    recent: Histogram,
    /// Balanced accuracy of the sign of [`Appearance::log_ratio`] on the frames learnt from; 0.5 = useless.
    accuracy: f32,
}

impl Anchored {
    fn new(anchor: Histogram) -> Self {
        Self { recent: anchor.clone(), anchor, accuracy: 0.5 }
    }

    fn learn(&mut self, recent: &Histogram, rate: f32) {
        self.recent.blend(recent, rate);
    }

    fn filled(&self) -> bool {
        self.recent.filled
    }

    fn at_bin(&self, k: usize) -> f32 {
        match (self.anchor.filled, self.recent.filled) {
            (true, true) => 0.5 * (self.anchor.density[k] + self.recent.density[k]),
            _ => self.recent.density[k],
        }
    }
}

/// Object against background.
pub(crate) struct Appearance {
    object: Anchored,
    background: [Anchored; 2],
    /// Log-likelihood ratio of every bin, by [`Band`]; follows from the histograms.
    table: [Vec<f32>; 2],
}

/// Colours of one frame.
pub(crate) struct FrameColors {
    pub(crate) object: Histogram,
    /// By [`Band`].
    pub(crate) background: [Histogram; 2],
}

impl Appearance {
    pub(crate) fn empty() -> Self {
        let nothing = || Anchored::new(Histogram::empty());
        Self {
            object: nothing(),
            background: [nothing(), nothing()],
            table: [vec![0.0; BINS], vec![0.0; BINS]],
        }
    }

    pub(crate) fn start(first: FrameColors) -> Self {
        let mut appearance = Self {
            object: Anchored::new(first.object),
            background: first.background.map(Anchored::new),
            ..Self::empty()
        };
        appearance.tabulate();
        appearance
    }

    pub(crate) fn learn(&mut self, frame: &FrameColors, rate: f32) {
        self.object.learn(&frame.object, rate);
        for (model, recent) in self.background.iter_mut().zip(&frame.background) {
            model.learn(recent, rate);
        }
        self.tabulate();
    }

    fn tabulate(&mut self) {
        for (table, background) in self.table.iter_mut().zip(&self.background) {
            let known = self.object.filled() && background.filled();
            for (k, ratio) in table.iter_mut().enumerate() {
                let odds = (self.object.at_bin(k) + FLOOR) / (background.at_bin(k) + FLOOR);
                *ratio = if known { odds.ln().clamp(-3.0, 3.0) } else { 0.0 };
            }
        }
    }

    /// Measures how well colour separates the two labels of a trusted frame, against each band's background.
    pub(crate) fn grade(
        &mut self,
        colors: &[Color],
        labels: &[bool],
        band: impl Fn(usize) -> Band,
        rate: f32,
    ) {
        for (which, slot) in [(Band::Near, 0), (Band::Far, 1)] {
            let mut hits = [0u32; 2];
            let mut counts = [0u32; 2];
            for (i, (&c, &object)) in colors.iter().zip(labels).enumerate() {
                if object || band(i) == which {
                    counts[usize::from(object)] += 1;
                    hits[usize::from(object)] += u32::from((self.log_ratio(c, which) > 0.0) == object);
                }
            }
            if counts[0] > 20 && counts[1] > 20 {
                let share = |k: usize| hits[k] as f32 / counts[k] as f32;
                let model = &mut self.background[slot];
                model.accuracy += rate * (0.5 * (share(0) + share(1)) - model.accuracy);
            }
        }
    }

    /// 0..1: how much colour decides against the background of a band.
    pub(crate) fn reliability(&self, band: Band) -> f32 {
        ((self.background[band as usize].accuracy - 0.6) / 0.35).clamp(0.0, 1.0)
    }

    /// `ln p(colour | object) / p(colour | background in the band)`, within +-3; 0 when a model is missing.
    pub(crate) fn log_ratio(&self, c: Color, band: Band) -> f32 {
        self.table[band as usize][bin(c)]
    }

    /// [`Appearance::log_ratio`] against background anywhere.
    pub(crate) fn log_ratio_anywhere(&self, c: Color) -> f32 {
        let filled = |band: Band| self.background[band as usize].filled();
        match (filled(Band::Near), filled(Band::Far)) {
            (true, true) => self.log_ratio(c, Band::Near).min(self.log_ratio(c, Band::Far)),
            (true, false) => self.log_ratio(c, Band::Near),
            _ => self.log_ratio(c, Band::Far),
        }
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
        let blues = Histogram::from_colors(std::iter::repeat_n(blue, 50));
        let model = Appearance::start(FrameColors { object, background: [Histogram::empty(), blues] });
        assert!(model.log_ratio(red, Band::Far) > 2.0 && model.log_ratio(blue, Band::Far) < -2.0);
        assert_eq!(model.log_ratio(blue, Band::Near), 0.0);
        assert!(model.log_ratio_anywhere(blue) < -2.0);
        assert_eq!(Appearance::empty().log_ratio_anywhere(red), 0.0);
    }
}
