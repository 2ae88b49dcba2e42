//! What all plots share: scales, numbers and paths as SVG wants them.

use std::fmt::Write;

/// A coordinate with as many digits as a plot needs.
pub(super) fn num(value: f64) -> String {
    if !value.is_finite() {
        return "0".into();
    }
    let text = format!("{value:.1}");
    text.strip_suffix(".0").map_or(text.clone(), str::to_owned)
}

/// Maps `from` linearly to `to`; both may run either way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scale {
    pub(super) from: [f64; 2],
    pub(super) to: [f64; 2],
}

impl Scale {
    pub(super) fn at(&self, value: f64) -> f64 {
        let span = self.from[1] - self.from[0];
        let share = if span == 0.0 { 0.0 } else { (value - self.from[0]) / span };
        self.to[0] + share.clamp(0.0, 1.0) * (self.to[1] - self.to[0])
    }
}

/// A line through points (pixels).
pub(super) fn line_path(points: impl IntoIterator<Item = [f64; 2]>) -> String {
    let mut path = String::new();
    for (i, [x, y]) in points.into_iter().enumerate() {
        // Writing to a string can't fail.
        let _ = write!(path, "{}{} {}", if i == 0 { "M" } else { "L" }, num(x), num(y));
    }
    path
}

/// The area between two lines with the same number of points.
pub(super) fn area_path(upper: &[[f64; 2]], lower: &[[f64; 2]]) -> String {
    if upper.is_empty() {
        return String::new();
    }
    line_path(upper.iter().chain(lower.iter().rev()).copied()) + "Z"
}

/// Round numbers from zero that cover `max` in about `count` steps.
pub(super) fn ticks(max: f64, count: usize) -> Vec<f64> {
    if !max.is_finite() || max <= 0.0 {
        return vec![0.0];
    }
    let rough = max / count.max(1) as f64;
    let power = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * power >= rough).unwrap_or(10.0) * power;
    (0..).map(|i| f64::from(i) * step).take_while(|t| *t <= max * 1.0001).collect()
}

/// The value below which `share` of the values lie; 0 for none.
pub(super) fn quantile(values: impl IntoIterator<Item = f64>, share: f64) -> f64 {
    let mut sorted: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    sorted.get((last as f64 * share).round() as usize).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_cover_the_range() {
        assert_eq!(ticks(100.0, 4), [0.0, 50.0, 100.0]);
        assert_eq!(ticks(1.0, 2), [0.0, 0.5, 1.0]);
        assert_eq!(ticks(0.0, 4), [0.0]);
        assert_eq!(ticks(f64::NAN, 4), [0.0]);
    }

    #[test]
    fn numbers_are_short_and_never_nan() {
        assert_eq!([num(3.0), num(2.25), num(f64::NAN)], ["3", "2.2", "0"]);
        assert_eq!(line_path([[0.0, 1.0], [2.5, 3.0]]), "M0 1L2.5 3");
        assert_eq!(area_path(&[], &[]), "");
        assert_eq!(quantile([3.0, 1.0, 2.0], 0.5), 2.0);
        assert_eq!(quantile([], 0.5), 0.0);
    }
}
