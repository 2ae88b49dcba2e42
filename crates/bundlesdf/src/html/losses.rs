//! The training loss of every round of the field.

use maud::{Markup, html};

use super::plot::{Scale, line_path, num};
use crate::report::RoundReport;

const WIDTH: f64 = 1000.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 990.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 210.0;

/// The plot, on a logarithmic axis; nothing when no round was trained.
pub(super) fn loss_plot(rounds: &[RoundReport]) -> Option<Markup> {
    let values = || rounds.iter().flat_map(|r| &r.loss).copied().filter(|v| *v > 0.0);
    let (low, high) = (values().fold(f64::INFINITY, f64::min), values().fold(0.0, f64::max));
    if !(low.is_finite() && high > 0.0) {
        return None;
    }
    let y = Scale { from: [low.log10() - 0.05, high.log10() + 0.05], to: [BOTTOM, TOP] };
    let slot = (RIGHT - LEFT) / rounds.len() as f64;
    // Long videos have more rounds than there is room for numbers.
    let every = (rounds.len() / 24 + 1).max(1);
    Some(html! {
        div.scroll {
            svg.plot viewBox=(format!("0 0 {WIDTH} {}", BOTTOM + 44.0)) role="img"
                aria-label="Training loss of every round" {
                text.title x=(LEFT) y=(TOP - 14.0) { "training loss, logarithmic; one curve per round" }
                @for mark in log_ticks(low, high) {
                    line.grid x1=(LEFT) x2=(RIGHT) y1=(num(y.at(mark.log10()))) y2=(num(y.at(mark.log10()))) {}
                    text.tick x=(LEFT - 7.0) y=(num(y.at(mark.log10()) + 3.5)) text-anchor="end" { (mark) }
                }
                @for (i, round) in rounds.iter().enumerate() {
                    @let left = LEFT + slot * i as f64;
                    @let x = Scale {
                        from: [0.0, round.loss.len().saturating_sub(1) as f64],
                        to: [left + 0.08 * slot, left + 0.92 * slot],
                    };
                    @let points = round.loss.iter().enumerate().filter(|(_, v)| **v > 0.0);
                    path.line.final[i + 1 == rounds.len()]
                        d=(line_path(points.map(|(k, v)| [x.at(k as f64), y.at(v.log10())]))) {
                        title { "round " (i + 1) ": " (round.keyframes) " keyframes, " (round.steps) " steps" }
                    }
                    @if i % every == 0 {
                        text.tick x=(num(left + slot / 2.0)) y=(BOTTOM + 16.0) text-anchor="middle" { (i + 1) }
                        text.tick.faint x=(num(left + slot / 2.0)) y=(BOTTOM + 31.0) text-anchor="middle" {
                            (round.keyframes)
                        }
                    }
                }
                text.tick x=(LEFT - 7.0) y=(BOTTOM + 16.0) text-anchor="end" { "round" }
                text.tick.faint x=(LEFT - 7.0) y=(BOTTOM + 31.0) text-anchor="end" { "views" }
            }
        }
    })
}

/// 1, 2 and 5 times powers of ten in the range.
fn log_ticks(low: f64, high: f64) -> Vec<f64> {
    let powers = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let marks = powers.flat_map(|p| [1.0, 2.0, 5.0].map(|m| m * 10_f64.powi(p)));
    // Powers of ten below one aren't exact in binary: as many digits as they have.
    marks.filter(|m| (low..=high).contains(m)).map(|m| (m * 1e6).round() / 1e6).collect()
}

/// What each round did, in numbers.
pub(super) fn rounds_table(rounds: &[RoundReport]) -> Markup {
    html! {
        div.scroll {
            table {
                thead { tr {
                    th { "round" } th { "views" } th { "steps" } th { "seconds" } th { "loss" }
                    th { "surface" } th { "empty" } th { "uncertain" } th { "colour" } th { "eikonal" }
                } }
                tbody {
                    @for (i, round) in rounds.iter().enumerate() {
                        tr {
                            td { (i + 1) } td { (round.keyframes) } td { (round.steps) }
                            td { (format!("{:.2}", round.ms / 1e3)) }
                            td { (round.loss.last().map_or("-".into(), |v| format!("{v:.4}"))) }
                            @if let Some(t) = &round.terms {
                                @for v in [t.surface, t.empty, t.uncertain, t.color, t.eikonal] {
                                    td { (format!("{v:.4}")) }
                                }
                            } @else {
                                td colspan="5" { "nothing was trained" }
                            }
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_of_a_logarithmic_axis() {
        assert_eq!(log_ticks(0.03, 2.5), [0.05, 0.1, 0.2, 0.5, 1.0, 2.0]);
    }

    #[test]
    fn rounds_without_training_have_no_plot() {
        let round = RoundReport { keyframes: 3, steps: 7, ms: 1.0, loss: Vec::new(), terms: None };
        assert!(loss_plot(&[round]).is_none() && loss_plot(&[]).is_none());
    }
}
