//! Which tables are shown, and what stands under them.

use super::grid::{Cell, Grid, Row};
use super::method::Method;
use super::published;
use super::table::{Column, Entry, Metric, Tables, Values};
use super::video::Masks;

/// One metric of every video (or object) and method.
pub(super) fn by_group(tables: &Tables, metric: Metric) -> Grid {
    let row = |name: &str, best: Vec<bool>, pick: &dyn Fn(&Column) -> Values, rule: bool| {
        let number = |(c, best): (&Column, bool)| Cell { best, ..Cell::number(metric.of(&pick(c)), 2) };
        let cells =
            std::iter::once(Cell::new(name)).chain(tables.columns.iter().zip(best).map(number)).collect();
        Row { cells, measured: false, own: false, rule }
    };
    let mut rows: Vec<Row> = tables
        .groups
        .iter()
        .enumerate()
        .map(|(g, name)| row(name, tables.best(Some(g), metric), &|c| c.values[g], false))
        .collect();
    rows.push(row("mean", tables.best(None, metric), &|c| c.mean, true));
    let header =
        std::iter::once("video".to_owned()).chain(tables.columns.iter().map(|c| c.name.clone())).collect();
    Grid { title: format!("{} per video", metric.name()), header, rows }
}

/// The dataset's means: the paper's own table with ours under it.
pub(super) fn means(tables: &Tables) -> Grid {
    let best = Metric::ALL.map(|metric| tables.best(None, metric));
    let mut rows = Vec::new();
    let mut measured = false;
    for (i, column) in tables.columns.iter().enumerate() {
        let mut cells = vec![Cell::new(column.name.clone())];
        for (metric, best) in Metric::ALL.iter().zip(&best) {
            let value = metric.of(&column.mean);
            let mut cell = Cell { best: best[i], ..Cell::number(value, 2) };
            if *metric != Metric::Chamfer {
                cell.bar = value.map(|v| v / 100.0);
            } else if let Some(count) = column.cd_groups {
                cell.text += &format!(" ({count} of {})", tables.groups.len());
            }
            cells.push(cell);
        }
        let rule = column.method.is_some() && !measured;
        measured |= column.method.is_some();
        let own = column.method == Some(Method::Ours);
        rows.push(Row { cells, measured: column.method.is_some(), own, rule });
    }
    let header = ["method", "ADD-S", "ADD", "CD cm"].map(str::to_owned).to_vec();
    Grid { title: format!("{}: mean", tables.benchmark.title()), header, rows }
}

/// Ours with all frames together, where it differs from the means.
pub(super) fn pooled(tables: &Tables) -> Option<Grid> {
    let row = |column: &Column| {
        let values = column.pooled?;
        let numbers = [values.add_s, values.add].map(|v| Cell::number(v, 2));
        let cells = std::iter::once(Cell::new(column.name.clone())).chain(numbers).collect();
        Some(Row { cells, measured: true, own: column.method == Some(Method::Ours), rule: false })
    };
    let header = ["method", "ADD-S", "ADD"].map(str::to_owned).to_vec();
    let rows = tables.columns.iter().filter_map(row).collect();
    (tables.groups.len() > 1).then(|| Grid { title: "all frames pooled".into(), header, rows })
}

/// The ablations under the published ones.
pub(super) fn ablations(tables: &Tables) -> Option<Grid> {
    let is_ablated = |c: &&Column| matches!(c.method, Some(Method::Ablated(_) | Method::Ours));
    let own: Vec<&Column> = tables.columns.iter().filter(is_ablated).collect();
    if tables.ablations.is_empty() || !own.iter().any(|c| c.method != Some(Method::Ours)) {
        return None;
    }
    let row = |name: &str, values: Values, measured: bool, rule: bool| {
        let numbers = Metric::ALL.map(|metric| Cell::number(metric.of(&values), 2));
        let cells = std::iter::once(Cell::new(name)).chain(numbers).collect();
        Row { cells, measured, own: false, rule }
    };
    let mut rows: Vec<Row> =
        tables.ablations.iter().map(|l| row(&l.method, Values::from(l), false, false)).collect();
    rows.extend(
        own.iter()
            .enumerate()
            .map(|(i, c)| Row { own: c.method == Some(Method::Ours), ..row(&c.name, c.mean, true, i == 0) }),
    );
    let header = ["method", "ADD-S", "ADD", "CD cm"].map(str::to_owned).to_vec();
    Some(Grid { title: "ablations, beside the paper's table 4 (13 videos)".into(), header, rows })
}

/// Everything else about each run.
pub(super) fn details(entries: &[Entry]) -> Grid {
    let header = [
        "run", "ADD-S", "ADD", "CD", "CD+ICP", "CD seen", "normals", "mask J", "mask F", "lost", "Hz",
        "s/round", "wall s",
    ];
    let row = |entry: &Entry| {
        let repeat =
            if entry.asked.repeat > 0 { format!(" #{}", entry.asked.repeat + 1) } else { String::new() };
        let name = format!("{}, {}{repeat}", entry.asked.place.name, entry.asked.method.name());
        let score = entry.score.as_ref().ok();
        let number = |pick: fn(&super::score::Score) -> Option<f64>, digits| {
            Cell::number(score.and_then(pick), digits)
        };
        let cells = vec![
            Cell::new(if score.is_some() { name } else { format!("{name} (failed)") }),
            number(|s| Some(s.add_s), 2),
            number(|s| Some(s.add), 2),
            number(|s| s.cd_cm, 3),
            number(|s| s.cd_icp_cm, 3),
            number(|s| s.cd_seen_cm, 3),
            number(|s| s.normals_deg, 1),
            number(|s| s.region_j, 1),
            number(|s| s.boundary_f, 1),
            number(|s| Some(s.lost as f64), 0),
            number(|s| s.hz, 1),
            number(|s| s.round_s, 1),
            number(|s| s.wall_s, 0),
        ];
        Row { cells, measured: false, own: false, rule: false }
    };
    let (header, rows) = (header.map(str::to_owned).to_vec(), entries.iter().map(row).collect());
    Grid { title: "runs".into(), header, rows }
}

/// What one has to know to read the numbers.
pub(super) fn notes(tables: &Tables, entries: &[Entry], masks: &Masks) -> Vec<String> {
    let benchmark = tables.benchmark;
    let mut notes = vec![format!(
        "ADD-S, ADD: area under the recall curve from 0 to {} m, percent; the object frames are aligned at the first \
         frame with truth. A failed run counts as zero.",
        benchmark.max_error()
    )];
    notes.push(if benchmark.registers_surfaces() {
        "CD: chamfer distance to the surface that the video shows, after ICP, as the published values were computed; \
         without ICP, as the paper's text has it, under `CD` of the runs."
            .into()
    } else {
        "CD: chamfer distance to the surface that the video shows, without registration; CD+ICP: after ICP; CD seen: \
         with only the visible part of the reconstruction. A perfect surface has about 0.11 cm."
            .into()
    });
    notes.push(
        "normals: median angle between the normals of the visible part and the true ones, degrees.".into(),
    );
    if let Some(source) =
        published::source(benchmark).filter(|_| tables.columns.iter().any(|c| c.method.is_none()))
    {
        notes.push(format!("Published rows: {source}. Rows with (ours) are this project's own programs."));
    }
    notes.push(format!("Masks: {}.", masks.describe()));
    let has_baselines = entries.iter().any(|e| matches!(e.asked.method, Method::Baseline(_)));
    if has_baselines && *masks == Masks::First {
        notes.push(
            "kinectfusion, sdf2sdf and frame-to-frame can't find masks: they had the given ones of every frame.".into(),
        );
    }
    if entries.iter().any(|e| e.score.as_ref().is_ok_and(|s| s.region_j.is_some())) {
        notes.push(
            "mask J, F: region similarity and contour accuracy against the true masks, percent (DAVIS)."
                .into(),
        );
    }
    if tables.columns.iter().any(|c| c.cd_groups.is_some()) {
        notes.push("(n of m): only n videos have a surface, so that the mean isn't comparable.".into());
    }
    let mut others: Vec<String> = entries
        .iter()
        .filter_map(|e| e.other_build.as_ref())
        .map(|b| b.commit.clone().unwrap_or_else(|| b.version.clone()))
        .collect();
    others.sort();
    others.dedup();
    if !others.is_empty() {
        let count = entries.iter().filter(|e| e.other_build.is_some()).count();
        notes.push(format!(
            "{count} runs were done earlier by another build ({}); --force does them again.",
            others.join(", ")
        ));
    }
    notes
}
