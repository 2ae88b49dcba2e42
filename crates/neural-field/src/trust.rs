//! How much each frame is believed: a frame with a wrong pose or mask must not bend the surface of all others.

use crate::config::FieldConfig;

/// Residuals below this (truncation units) are noise, whatever the other frames' are.
const NOISE: f32 = 0.05;
/// No frame loses all its weight: its pose must still feel where the surface is, to come back.
const LEAST: f32 = 0.003;

/// Whether the frames' weights are looked at before this step: every tenth of the round but the first and last two.
pub(crate) fn is_due(config: &FieldConfig, step: usize) -> bool {
    let tenth = config.steps / 10;
    config.outlier_ratio > 0.0 && tenth > 0 && step.is_multiple_of(tenth) && (1..=8).contains(&(step / tenth))
}

/// Weights from residuals (NaN where there is none): 1 up to `ratio` times the median, then falling with the fourth
/// power. Adam is blind to the scale of a gradient, so a frame without much weight moves towards the surface as fast
/// as any other, and has its weight back once it fits.
pub(crate) fn weights(residuals: &[f32], ratio: f64) -> Vec<f32> {
    let mut known: Vec<f32> = residuals.iter().copied().filter(|r| r.is_finite()).collect();
    if known.is_empty() {
        return vec![1.0; residuals.len()];
    }
    let middle = known.len() / 2;
    let median = *known.select_nth_unstable_by(middle, f32::total_cmp).1;
    let limit = ratio as f32 * median.max(NOISE);
    let weight = |r: &f32| if *r > limit { (limit / r).powi(4).max(LEAST) } else { 1.0 };
    residuals.iter().map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_stands_out_loses_weight() {
        let w = weights(&[0.1, 0.12, f32::NAN, 0.9, 0.11, 0.29], 3.0);
        assert_eq!([w[0], w[1], w[2], w[4], w[5]], [1.0; 5]);
        assert!(w[3] < 0.03 && w[3] >= LEAST);
        assert_eq!(weights(&[0.001, 0.02], 3.0), [1.0, 1.0]);
        assert_eq!(weights(&[f32::NAN], 3.0), [1.0]);
    }

    #[test]
    fn weights_are_looked_at_eight_times_a_round() {
        let config = FieldConfig { steps: 200, ..FieldConfig::refine() };
        assert_eq!((0..200).filter(|s| is_due(&config, *s)).count(), 8);
        let short = FieldConfig { steps: 5, ..FieldConfig::refine() };
        assert!((0..5).all(|s| !is_due(&short, s)));
    }
}
