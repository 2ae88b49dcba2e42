//! The table and the JSON file.

use anyhow::Context;
use serde::Serialize;
use std::fmt;
use std::path::Path;

/// The scores of one sequence.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Row {
    pub(super) video: String,
    pub(super) method: Method,
    /// Area under the ADD-S recall curve, percent.
    pub(super) add_s: f64,
    /// Area under the ADD recall curve, percent.
    pub(super) add: f64,
    /// Chamfer distance to the surface that the video shows, centimetres.
    pub(super) cd_cm: Option<f64>,
    /// The same after registration by ICP, as the published numbers were computed.
    pub(super) cd_icp_cm: Option<f64>,
    /// Without registration, the reconstruction culled to the visible surface as well.
    pub(super) cd_seen_cm: Option<f64>,
    /// Median rate of the tracker, frames per second.
    pub(super) hz: Option<f64>,
    /// Median time of a field round, seconds.
    pub(super) round_s: Option<f64>,
    /// Number of frames that the tracker reported as lost.
    pub(super) lost: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) error: Option<String>,
}

/// The system that was scored; comparison files have rows of others.
#[derive(Clone, Copy, Debug, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Method {
    #[default]
    Ours,
}

impl Row {
    /// A sequence without results: its poses count as entirely wrong.
    pub(super) fn failed(video: &str, error: &str) -> Self {
        Self { video: video.to_owned(), error: Some(error.to_owned()), ..Self::default() }
    }

    /// One line for the log.
    pub(super) fn summary(&self) -> String {
        match &self.error {
            Some(error) => format!("{}: {error}", self.video),
            None => format!("{}: ADD-S {:.2}, ADD {:.2}", self.video, self.add_s, self.add),
        }
    }

    fn cells(&self) -> [String; 9] {
        let number = |x: Option<f64>, digits: usize| x.map_or("-".into(), |x| format!("{x:.digits$}"));
        [
            self.video.clone(),
            number(Some(self.add_s), 2),
            number(Some(self.add), 2),
            number(self.cd_cm, 3),
            number(self.cd_icp_cm, 3),
            number(self.cd_seen_cm, 3),
            self.lost.map_or("-".into(), |n| n.to_string()),
            number(self.hz, 2),
            number(self.round_s, 2),
        ]
    }
}

/// The scores of all sequences. Displays as a table with a row of means.
#[derive(Debug, Default, Serialize)]
pub(super) struct Report {
    pub(super) rows: Vec<Row>,
}

impl Report {
    const HEADER: [&'static str; 9] =
        ["video", "ADD-S", "ADD", "CD cm", "CD+ICP", "CD seen", "lost", "Hz", "s/round"];

    /// Unweighted means over the sequences, each over those that have the value.
    fn mean(&self) -> Row {
        let mean = |pick: fn(&Row) -> Option<f64>| {
            let values: Vec<f64> = self.rows.iter().filter_map(pick).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        Row {
            video: "mean".into(),
            add_s: mean(|r| Some(r.add_s)).unwrap_or(0.0),
            add: mean(|r| Some(r.add)).unwrap_or(0.0),
            cd_cm: mean(|r| r.cd_cm),
            cd_icp_cm: mean(|r| r.cd_icp_cm),
            cd_seen_cm: mean(|r| r.cd_seen_cm),
            hz: mean(|r| r.hz),
            round_s: mean(|r| r.round_s),
            ..Row::default()
        }
    }

    pub(super) fn write_json(&self, path: &Path) -> anyhow::Result<()> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        std::fs::write(path, text)
            .with_context(|| format!("{} can't be written; does its folder exist?", path.display()))
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut lines = vec![Self::HEADER.map(str::to_owned)];
        lines.extend(self.rows.iter().map(Row::cells));
        lines.push(self.mean().cells());
        let width = |k: usize| lines.iter().map(|line| line[k].chars().count()).max().unwrap_or(0);
        let widths: [usize; 9] = std::array::from_fn(width);
        for (i, line) in lines.iter().enumerate() {
            write!(f, "{:<w$}", line[0], w = widths[0])?;
            for k in 1..line.len() {
                write!(f, "  {:>w$}", line[k], w = widths[k])?;
            }
            writeln!(f)?;
            if i == 0 || i + 2 == lines.len() {
                writeln!(f, "{}", "-".repeat(widths.iter().sum::<usize>() + 2 * (widths.len() - 1)))?;
            }
        }
        writeln!(
            f,
            "ADD-S, ADD: area under the recall curve, 0 to 0.1 m, percent. CD: chamfer distance to the"
        )?;
        writeln!(f, "visible true surface; after ICP; with only the visible part of the reconstruction.")?;
        for row in &self.rows {
            if let Some(error) = &row.error {
                writeln!(f, "{} failed: {error}", row.video)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report() -> Report {
        let good = Row {
            video: "mustard".into(),
            add_s: 90.0,
            add: 80.0,
            cd_cm: Some(0.5),
            hz: Some(10.0),
            round_s: Some(2.0),
            lost: Some(3),
            ..Row::default()
        };
        Report { rows: vec![good, Row::failed("cube", "no mask")] }
    }

    #[test]
    fn a_failed_row_counts_as_zero_and_keeps_its_error() {
        let mean = report().mean();
        assert_eq!((mean.add_s, mean.add, mean.cd_cm), (45.0, 40.0, Some(0.5)));
        let table = report().to_string();
        assert!(table.contains("cube failed: no mask"), "{table}");
        assert!(table.lines().any(|l| l.starts_with("mean") && l.contains("45.00")), "{table}");
        assert_eq!(Report::default().mean().add, 0.0);
    }

    #[test]
    fn json_has_the_agreed_keys() {
        let value = serde_json::to_value(report()).unwrap();
        let row = &value["rows"][0];
        for key in ["video", "method", "add_s", "add", "cd_cm", "hz", "round_s", "lost"] {
            assert!(!row[key].is_null(), "{key}");
        }
        assert_eq!(row["method"], "ours");
        assert!(row.get("error").is_none());
        assert_eq!(value["rows"][1]["error"], "no mask");
    }
}
