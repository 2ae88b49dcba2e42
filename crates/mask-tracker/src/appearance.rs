//! Colour models of object and background.

use serde::{Deserialize, Serialize};

use crate::grid::Color;
use crate::math::ln_positive;

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

/// A colour's place in the histograms.
pub(crate) type Bin = u16;

#[inline]
pub(crate) fn bin(c: Color) -> Bin {
    // Casts of negative numbers give 0.
    let axis = |v: f32, scale: f32, offset: f32, bins: usize| ((v * scale + offset) as usize).min(bins - 1);
    let half = CHROMA as f32 * 0.5;
    let y = axis(c[0], 1.0 / 16.0, 0.0, LUMA);
    let a = axis(c[1], 1.0 / 12.0, half, CHROMA);
    let b = axis(c[2], 1.0 / 12.0, half, CHROMA);
    ((y * CHROMA + a) * CHROMA + b) as Bin
}

impl Histogram {
    pub(crate) fn empty() -> Self {
        Self { density: vec![0.0; BINS], filled: false }
    }

    pub(crate) fn count(&mut self, bin: Bin) {
        if let Some(density) = self.density.get_mut(usize::from(bin)) {
            *density += 1.0;
            self.filled = true;
        }
    }

    /// Densities from the counts, smoothed.
    pub(crate) fn normalised(mut self) -> Self {
        if self.filled {
            let scale = 1.0 / self.density.iter().sum::<f32>();
            self.density.iter_mut().for_each(|d| *d *= scale);
            smooth(&mut self.density);
        }
        self
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

/// Binomial filter (1 2 1)/4 along each axis of the histogram; its ends repeat.
fn smooth(density: &mut [f32]) {
    fn add(to: &mut [f32], from: &[f32], weight: f32) {
        to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
    }
    let mut from = vec![0.0; density.len()];
    for (stride, size) in [(1, CHROMA), (CHROMA, CHROMA), (CHROMA * CHROMA, LUMA)] {
        let all = stride * size;
        let inner = all - stride;
        from.copy_from_slice(density);
        density.iter_mut().for_each(|d| *d *= 0.5);
        for (to, from) in density.chunks_exact_mut(all).zip(from.chunks_exact(all)) {
            add(&mut to[..stride], &from[..stride], 0.25);
            add(&mut to[stride..], &from[..inner], 0.25);
            add(&mut to[..inner], &from[stride..], 0.25);
            add(&mut to[inner..], &from[inner..], 0.25);
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
#[derive(Clone, Serialize, Deserialize)]
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

    /// Logarithm of every bin's density.
    fn logarithms(&self) -> Vec<f32> {
        let both = if self.anchor.filled { 0.5 } else { 0.0 };
        let density = self.anchor.density.iter().zip(&self.recent.density);
        density.map(|(a, r)| ln_positive(both * a + (1.0 - both) * r + FLOOR)).collect()
    }
}

/// Object against background.
#[derive(Clone, Serialize, Deserialize)]
pub(crate) struct Appearance {
    object: Anchored,
    background: [Anchored; 2],
    /// Log-likelihood ratio of every bin, by [`Band`]; follows from the histograms.
    #[serde(skip)]
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

    /// Fills in what is not saved; false for a damaged copy, whose histograms don't have their bins.
    pub(crate) fn complete(&mut self) -> bool {
        let models = [&self.object, &self.background[0], &self.background[1]];
        if !models.iter().all(|m| m.anchor.density.len() == BINS && m.recent.density.len() == BINS) {
            return false;
        }
        self.table = [vec![0.0; BINS], vec![0.0; BINS]];
        self.tabulate();
        true
    }

    pub(crate) fn learn(&mut self, frame: &FrameColors, rate: f32) {
        self.object.learn(&frame.object, rate);
        for (model, recent) in self.background.iter_mut().zip(&frame.background) {
            model.learn(recent, rate);
        }
        self.tabulate();
    }

    /// The background that a band is compared with: all there is, while nothing was seen in it.
    fn against(&self, band: Band) -> &Anchored {
        let [near, far] = &self.background;
        match band {
            Band::Near if near.filled() => near,
            _ if far.filled() => far,
            _ => near,
        }
    }

    fn tabulate(&mut self) {
        let object = self.object.logarithms();
        self.table = [Band::Near, Band::Far].map(|band| {
            let background = self.against(band);
            if !(self.object.filled() && background.filled()) {
                return vec![0.0; BINS];
            }
            let ratios = object.iter().zip(background.logarithms());
            ratios.map(|(object, background)| (object - background).clamp(-3.0, 3.0)).collect()
        });
    }

    /// Measures how well colour separates the two labels of a trusted frame, against each band's background.
    pub(crate) fn grade(&mut self, colors: &[Bin], labels: &[bool], band: impl Fn(usize) -> Band, rate: f32) {
        // By band, then by label.
        let mut hits = [[0u32; 2]; 2];
        let mut counts = [[0u32; 2]; 2];
        for (i, (&c, &object)) in colors.iter().zip(labels).enumerate() {
            let own = band(i);
            for which in [Band::Near, Band::Far] {
                let counted = u32::from(object || own == which);
                let right = u32::from((self.log_ratio(c, which) > 0.0) == object);
                counts[which as usize][usize::from(object)] += counted;
                hits[which as usize][usize::from(object)] += counted * right;
            }
        }
        for (model, (hits, counts)) in self.background.iter_mut().zip(hits.iter().zip(&counts)) {
            if counts[0] > 20 && counts[1] > 20 {
                let share = |k: usize| hits[k] as f32 / counts[k] as f32;
                model.accuracy += rate * (0.5 * (share(0) + share(1)) - model.accuracy);
            }
        }
    }

    /// 0..1: how much colour decides against the background of a band.
    pub(crate) fn reliability(&self, band: Band) -> f32 {
        ((self.against(band).accuracy - 0.6) / 0.35).clamp(0.0, 1.0)
    }

    /// `ln p(colour | object) / p(colour | background in the band)`, within +-3; 0 when a model is missing.
    #[inline]
    pub(crate) fn log_ratio(&self, c: Bin, band: Band) -> f32 {
        self.table[band as usize].get(usize::from(c)).copied().unwrap_or(0.0)
    }

    /// [`Appearance::log_ratio`] against background anywhere.
    #[inline]
    pub(crate) fn log_ratio_anywhere(&self, c: Bin) -> f32 {
        self.log_ratio(c, Band::Near).min(self.log_ratio(c, Band::Far))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::opponent;

    #[test]
    fn smoothing_keeps_the_sum_and_colours_are_told_apart() {
        let red = bin(opponent([200.0, 40.0, 40.0]));
        let blue = bin(opponent([40.0, 40.0, 200.0]));
        let counted = |bin: Bin| {
            let mut histogram = Histogram::empty();
            (0..50).for_each(|_| histogram.count(bin));
            histogram.normalised()
        };
        let object = counted(red);
        assert!((object.density.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        let blues = counted(blue);
        let model = Appearance::start(FrameColors { object, background: [Histogram::empty(), blues] });
        assert!(model.log_ratio(red, Band::Far) > 2.0 && model.log_ratio(blue, Band::Far) < -2.0);
        assert!(model.log_ratio(blue, Band::Near) < -2.0);
        assert!(model.log_ratio_anywhere(blue) < -2.0);
        assert_eq!(Appearance::empty().log_ratio_anywhere(red), 0.0);
    }
}
