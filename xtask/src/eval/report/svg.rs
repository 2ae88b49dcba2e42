//! Line charts as SVG that takes its colours from the page's style.

use super::super::grid::escape;
use std::fmt::Write;

/// One line; where a value is missing it has a gap.
#[derive(Clone, Debug)]
pub(super) struct Series {
    pub(super) name: String,
    /// Which of the page's colours.
    pub(super) color: usize,
    pub(super) points: Vec<(f64, Option<f64>)>,
}

#[derive(Clone, Debug)]
pub(super) struct Chart {
    pub(super) title: String,
    pub(super) x_label: String,
    pub(super) x_max: f64,
    /// Values above it are drawn at the upper edge.
    pub(super) y_max: f64,
    /// Written behind the numbers of the vertical axis.
    pub(super) unit: &'static str,
    pub(super) series: Vec<Series>,
    pub(super) size: (f64, f64),
}

const LEFT: f64 = 44.0;
const RIGHT: f64 = 10.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 34.0;

impl Chart {
    pub(super) fn svg(&self) -> String {
        let (width, height) = self.size;
        let mut out = format!(
            "<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{0}\"><text class=\"t\" x=\"{LEFT}\" \
             y=\"15\">{0}</text>",
            escape(&self.title)
        );
        self.grid(&mut out);
        // The first series is drawn last, on top.
        for series in self.series.iter().rev() {
            let path = self.path(series);
            if !path.is_empty() {
                let _ = write!(
                    out,
                    "<path class=\"l c{}\" d=\"{path}\"><title>{}</title></path>",
                    series.color,
                    escape(&series.name)
                );
            }
        }
        out + "</svg>"
    }

    fn x(&self, value: f64) -> f64 {
        LEFT + (self.size.0 - LEFT - RIGHT) * value / self.x_max
    }

    fn y(&self, value: f64) -> f64 {
        self.size.1 - BOTTOM - (self.size.1 - TOP - BOTTOM) * (value / self.y_max).clamp(0.0, 1.0)
    }

    fn grid(&self, out: &mut String) {
        let (width, height) = self.size;
        let right = width - RIGHT;
        for tick in ticks(self.y_max, 4) {
            let y = self.y(tick);
            let _ = write!(
                out,
                "<path class=\"g\" d=\"M{LEFT} {y:.1}H{right}\"/><text class=\"n\" x=\"{:.1}\" y=\"{:.1}\" \
                 text-anchor=\"end\">{}{}</text>",
                LEFT - 5.0,
                y + 3.5,
                short(tick),
                self.unit
            );
        }
        for tick in ticks(self.x_max, 5) {
            let _ = write!(
                out,
                "<text class=\"n\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                self.x(tick),
                height - BOTTOM + 14.0,
                short(tick)
            );
        }
        let _ = write!(
            out,
            "<text class=\"n\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            right,
            height - 4.0,
            escape(&self.x_label)
        );
    }

    fn path(&self, series: &Series) -> String {
        let mut out = String::new();
        let mut pen_down = false;
        for (x, y) in &series.points {
            match y.filter(|y| y.is_finite()) {
                Some(y) => {
                    let command = if pen_down { 'L' } else { 'M' };
                    let _ = write!(out, "{command}{:.1} {:.1}", self.x(*x), self.y(y));
                    pen_down = true;
                }
                None => pen_down = false,
            }
        }
        out
    }
}

/// Round numbers from 0 to `max`, about `count` of them beside 0.
fn ticks(max: f64, count: usize) -> Vec<f64> {
    if !(max > 0.0 && max.is_finite()) {
        return vec![0.0];
    }
    let rough = max / count as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 2.5, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= rough * 0.999);
    let step = step.unwrap_or(10.0 * power);
    (0..).map(|i| f64::from(i) * step).take_while(|t| *t <= max * 1.001).collect()
}

/// Without zeros that say nothing.
fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// At most `count` points, each the worst (largest, or missing) of its part.
pub(super) fn thinned(points: &[(f64, Option<f64>)], count: usize) -> Vec<(f64, Option<f64>)> {
    let size = points.len().div_ceil(count.max(1)).max(1);
    let worst = |part: &[(f64, Option<f64>)]| {
        let missing = part.iter().any(|p| p.1.is_none());
        let largest = part.iter().filter_map(|p| p.1).reduce(f64::max);
        (part[0].0, largest.filter(|_| !missing))
    };
    points.chunks(size).map(worst).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within() {
        assert_eq!(ticks(10.0, 4), [0.0, 2.5, 5.0, 7.5, 10.0]);
        assert_eq!(ticks(1.0, 5), [0.0, 0.2, 0.4, 0.6000000000000001, 0.8, 1.0]);
        assert_eq!(ticks(239.0, 5), [0.0, 50.0, 100.0, 150.0, 200.0]);
        assert_eq!(ticks(f64::NAN, 5), [0.0]);
        assert_eq!(
            (short(2.5), short(10.0), short(0.6000000000000001)),
            ("2.5".into(), "10".into(), "0.6".into())
        );
    }

    #[test]
    fn a_line_has_gaps_and_stays_inside() {
        let points =
            vec![(0.0, Some(0.0)), (1.0, None), (2.0, Some(99.0)), (3.0, Some(f64::NAN)), (4.0, Some(5.0))];
        let chart = Chart {
            title: "a < b".into(),
            x_label: "x".into(),
            x_max: 4.0,
            y_max: 10.0,
            unit: "",
            series: vec![Series { name: "s".into(), color: 3, points }],
            size: (300.0, 160.0),
        };
        let svg = chart.svg();
        // Zero at the bottom, 99 at the top and not above it, the last one half way up at the right end.
        assert!(svg.contains("d=\"M44.0 126.0M167.0 26.0M290.0 76.0\""), "{svg}");
        assert!(svg.contains("a &lt; b") && svg.contains("class=\"l c3\""), "{svg}");
    }

    #[test]
    fn thinning_keeps_the_worst() {
        let points: Vec<_> = (0..10).map(|i| (f64::from(i), Some(f64::from(i % 4)))).collect();
        assert_eq!(thinned(&points, 5)[..2], [(0.0, Some(1.0)), (2.0, Some(3.0))]);
        let gap: Vec<_> = points.iter().map(|p| (p.0, p.1.filter(|v| *v > 0.0))).collect();
        assert_eq!(thinned(&gap, 5)[0], (0.0, None));
        assert_eq!(thinned(&points, 100).len(), 10);
    }
}
