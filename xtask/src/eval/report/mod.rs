//! The page: one HTML file with tables and plots, which asks nothing of the network.

mod svg;

use super::benchmark::Benchmark;
use super::grid::{Grid, escape};
use super::job::Build;
use super::layout;
use super::method::Method;
use super::score::Score;
use super::table::{Column, Entry, Metric, Tables};
use eval_metrics::recall_curve;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use svg::{Chart, Series, thinned};

const STYLE: &str = include_str!("style.css");
/// Colours that the style has.
const COLORS: usize = 10;
/// Points of a line.
const POINTS: usize = 320;
/// More videos than this are folded away.
const OPEN_VIDEOS: usize = 16;

/// Writes `index.html` and `tables.md`; the page's path.
pub(super) fn write(
    dir: &Path,
    tables: &Tables,
    entries: &[Entry],
    notes: &[String],
    build: &Build,
) -> anyhow::Result<PathBuf> {
    super::write_text(&dir.join("tables.md"), &markdown(tables, entries, notes))?;
    let page = dir.join("index.html");
    super::write_text(&page, &html(tables, entries, notes, build))?;
    Ok(page)
}

fn markdown(tables: &Tables, entries: &[Entry], notes: &[String]) -> String {
    let mut grids = vec![layout::means(tables)];
    grids.extend(layout::ablations(tables));
    grids.extend(layout::pooled(tables));
    grids.extend(Metric::ALL.map(|metric| layout::by_group(tables, metric)));
    grids.push(layout::details(entries));
    let mut out = grids.iter().map(Grid::markdown).collect::<Vec<_>>().join("\n");
    out.push('\n');
    notes.iter().for_each(|note| out += &format!("- {}\n", note.replace('*', "\\*")));
    out
}

fn html(tables: &Tables, entries: &[Entry], notes: &[String], build: &Build) -> String {
    let title = format!("Evaluation on {}", tables.benchmark.title());
    let commit = build.commit.as_ref().map(|c| format!(", commit {c}")).unwrap_or_default();
    let (videos, done) = (tables.groups.len(), entries.iter().filter(|e| e.score.is_ok()).count());
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n<style>\n{STYLE}</style></head>\n\
         <body><main>\n<h1>{title}</h1>\n<p class=\"sub\">{done} of {} runs, {videos} {} · bundlesdf \
         {}{commit}</p>\n",
        entries.len(),
        if videos == 1 { "sequence" } else { "sequences" },
        build.version
    );
    out += &failures(entries);
    out += &tiles(tables, entries);
    let _ =
        write!(out, "<div class=\"two\"><section class=\"card\">{}</section>", layout::means(tables).html());
    let colors = Palette::new(entries);
    let _ = writeln!(
        out,
        "<section class=\"card\">{}</section></div>",
        recall(tables.benchmark, entries, &colors)
    );
    let more: Vec<String> = layout::ablations(tables)
        .into_iter()
        .chain(layout::pooled(tables))
        .map(|grid| format!("<section class=\"card\">{}</section>", grid.html()))
        .collect();
    let _ = writeln!(out, "<div class=\"two\">{}</div>", more.concat());
    out += "<h2>Per video</h2>\n";
    for metric in Metric::ALL {
        let _ =
            writeln!(out, "<section class=\"card\">{}</section>", layout::by_group(tables, metric).html());
    }
    out += "<h2>Errors over time</h2>\n";
    out += &colors.legend();
    out += &videos_over_time(tables.benchmark, entries, &colors);
    let _ = write!(
        out,
        "<h2>Runs</h2>\n<section class=\"card\"><details><summary>{} runs with all their numbers</summary>{}</details>\
         </section>\n<h2>Notes</h2>\n<ul class=\"notes\">",
        entries.len(),
        layout::details(entries).html().replace("<h3>runs</h3>", "")
    );
    notes.iter().for_each(|note| out += &format!("<li>{}</li>", escape(note)));
    out + "</ul>\n</main></body></html>\n"
}

fn failures(entries: &[Entry]) -> String {
    let mut out = String::new();
    for entry in entries {
        if let Err(error) = &entry.score {
            let (method, video) = (entry.asked.method.name(), escape(&entry.asked.place.name));
            let _ = writeln!(
                out,
                "<section class=\"card failed\"><b>{method} failed on {video}</b><br><code>{}</code></section>",
                escape(error)
            );
        }
    }
    out
}

/// The first method's means, and where it stands among the others.
fn tiles(tables: &Tables, entries: &[Entry]) -> String {
    let Some(first) = tables.columns.iter().find(|c| c.method.is_some()) else { return String::new() };
    let mut out = String::from("<div class=\"tiles\">");
    for metric in [Metric::Add, Metric::AddS, Metric::Chamfer] {
        let Some(value) = metric.of(&first.mean) else { continue };
        let _ = write!(
            out,
            "<div class=\"tile\"><span>{}, {}</span><b>{value:.2}</b><span>{}</span></div>",
            escape(&first.name),
            metric.name(),
            standing(tables, first, metric)
        );
    }
    let own = || {
        entries.iter().filter(|e| Some(e.asked.method) == first.method).filter_map(|e| e.score.as_ref().ok())
    };
    let (lost, frames): (usize, usize) =
        own().fold((0, 0), |(l, f), s| (l + s.lost, f + s.errors.frames.len()));
    let mut rates: Vec<f64> = own().filter_map(|s| s.hz).collect();
    rates.sort_by(f64::total_cmp);
    if let Some(hz) = rates.get(rates.len() / 2) {
        let _ = write!(
            out,
            "<div class=\"tile\"><span>tracking</span><b>{hz:.0} Hz</b><span>median video</span></div>"
        );
    }
    let _ = write!(
        out,
        "<div class=\"tile\"><span>lost frames</span><b>{lost}</b><span>of {frames}</span></div>"
    );
    out + "</div>\n"
}

/// How far ahead of the next best, or behind the best, a method is.
fn standing(tables: &Tables, own: &Column, metric: Metric) -> String {
    let lower_is_better = metric == Metric::Chamfer;
    let is_rival = |c: &&Column| c.name != own.name && !matches!(c.method, Some(Method::Ablated(_)));
    let rivals = tables.columns.iter().filter(is_rival).filter_map(|c| Some((metric.of(&c.mean)?, &c.name)));
    let better = |a: f64, b: f64| if lower_is_better { a < b } else { a > b };
    let best = rivals.reduce(|a, b| if better(b.0, a.0) { b } else { a });
    match (best, metric.of(&own.mean)) {
        (Some((value, name)), Some(own)) => {
            let word = if better(value, own) { "behind" } else { "ahead of" };
            format!("{:.2} {word} {}", (own - value).abs(), escape(name))
        }
        _ => String::new(),
    }
}

/// The methods of the page. Each has the same colour on every page.
struct Palette(Vec<Method>);

impl Palette {
    fn new(entries: &[Entry]) -> Self {
        let mut methods: Vec<Method> = Vec::new();
        for entry in entries {
            if !methods.contains(&entry.asked.method) {
                methods.push(entry.asked.method);
            }
        }
        Self(methods)
    }

    fn of(&self, method: Method) -> usize {
        let mut known = Method::all().into_iter().chain(Method::ablations()).chain([Method::Open3d]);
        known.position(|m| m == method).unwrap_or(0) % COLORS
    }

    fn legend(&self) -> String {
        let item = |m: &Method| format!("<span style=\"--k:var(--c{})\">{}</span>", self.of(*m), m.name());
        format!("<div class=\"legend\">{}</div>\n", self.0.iter().map(item).collect::<String>())
    }
}

/// Recall curves of each method, all frames of all its videos together.
fn recall(benchmark: Benchmark, entries: &[Entry], colors: &Palette) -> String {
    let limit = benchmark.max_error();
    let thresholds: Vec<f64> = (0..=100).map(|i| limit * f64::from(i) / 100.0).collect();
    let chart = |title: &str, pick: &dyn Fn(&Score) -> &Vec<Option<f64>>| {
        let series = colors.0.iter().map(|&method| {
            let own =
                entries.iter().filter(|e| e.asked.method == method).filter_map(|e| e.score.as_ref().ok());
            let errors: Vec<f64> =
                own.flat_map(|s| pick(s).iter().map(|e| e.unwrap_or(f64::INFINITY))).collect();
            let recall = recall_curve(&errors, &thresholds);
            let points = thresholds.iter().zip(recall).map(|(t, r)| (100.0 * t, Some(100.0 * r))).collect();
            Series { name: method.name().into(), color: colors.of(method), points }
        });
        let chart = Chart {
            title: title.into(),
            x_label: "error below, cm".into(),
            x_max: 100.0 * limit,
            y_max: 100.0,
            unit: "%",
            series: series.collect(),
            size: (560.0, 230.0),
        };
        chart.svg()
    };
    let add = chart("recall by ADD, all frames", &|s| &s.errors.add);
    let add_s = chart("recall by ADD-S, all frames", &|s| &s.errors.add_s);
    format!(
        "{}{add}{add_s}",
        colors.legend().replace(
            "class=\"legend\"",
            "class=\"legend\" style=\"position:static;background:none;padding:0\""
        )
    )
}

fn videos_over_time(benchmark: Benchmark, entries: &[Entry], colors: &Palette) -> String {
    let mut names: Vec<&str> = Vec::new();
    entries.iter().for_each(|e| {
        if !names.contains(&e.asked.place.name.as_str()) {
            names.push(&e.asked.place.name)
        }
    });
    let open = if names.len() <= OPEN_VIDEOS { " open" } else { "" };
    let mut out = String::new();
    for name in names {
        // One line a method: the first repeat.
        let scores: Vec<(Method, &Score)> = entries
            .iter()
            .filter(|e| e.asked.place.name == name && e.asked.repeat == 0)
            .filter_map(|e| Some((e.asked.method, e.score.as_ref().ok()?)))
            .collect();
        if scores.is_empty() {
            continue;
        }
        let limit = benchmark.max_error();
        let charts = [
            over_time("ADD", " cm", 100.0, limit, &scores, colors, |s| &s.errors.add),
            over_time("translation", " cm", 100.0, limit, &scores, colors, |s| &s.errors.translation),
            over_time("rotation", "°", 180.0 / std::f64::consts::PI, 0.8, &scores, colors, |s| {
                &s.errors.rotation
            }),
        ];
        let _ = writeln!(
            out,
            "<section class=\"card\"><details class=\"video\"{open}><summary>{}</summary><div class=\"three\">{}</div>\
             </details></section>",
            escape(name),
            charts.concat()
        );
    }
    out
}

/// Errors of all methods, times `factor` in `unit`; more than `limit` (before the factor) is drawn at the edge.
fn over_time(
    title: &str,
    unit: &'static str,
    factor: f64,
    limit: f64,
    scores: &[(Method, &Score)],
    colors: &Palette,
    pick: fn(&Score) -> &Vec<Option<f64>>,
) -> String {
    let all = scores.iter().flat_map(|(_, s)| pick(s)).flatten();
    let largest = all.copied().fold(0.0, f64::max).min(limit).max(0.05 * limit);
    let x_max =
        scores.iter().filter_map(|(_, s)| s.errors.frames.last()).max().map_or(1.0, |n| (*n).max(1) as f64);
    let series = scores.iter().map(|&(method, score)| {
        let frames = score.errors.frames.iter().map(|f| *f as f64);
        let points: Vec<_> = frames.zip(pick(score).iter().map(|e| e.map(|e| e * factor))).collect();
        Series { name: method.name().into(), color: colors.of(method), points: thinned(&points, POINTS) }
    });
    let chart = Chart {
        title: title.into(),
        x_label: "frame".into(),
        x_max,
        y_max: factor * largest,
        unit,
        series: series.collect(),
        size: (360.0, 190.0),
    };
    chart.svg()
}
