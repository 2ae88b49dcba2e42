//! Tables of text, for a terminal, in Markdown and in HTML.

use std::fmt::Write;

/// A cell; the best of its line or column is shown in bold.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Cell {
    pub(super) text: String,
    pub(super) best: bool,
    /// From 0 to 1: drawn as a bar behind the number, in HTML.
    pub(super) bar: Option<f64>,
}

impl Cell {
    pub(super) fn new(text: impl Into<String>) -> Self {
        Self { text: text.into(), best: false, bar: None }
    }

    /// A number with `digits` decimals, or a dash.
    pub(super) fn number(value: Option<f64>, digits: usize) -> Self {
        Self::new(value.map_or_else(|| "-".into(), |x| format!("{x:.digits$}")))
    }
}

/// A line of a table.
#[derive(Clone, Debug)]
pub(super) struct Row {
    pub(super) cells: Vec<Cell>,
    /// Measured by this project, not published.
    pub(super) measured: bool,
    /// Of our own system.
    pub(super) own: bool,
    /// Set apart from the lines above.
    pub(super) rule: bool,
}

#[derive(Clone, Debug)]
pub(super) struct Grid {
    pub(super) title: String,
    pub(super) header: Vec<String>,
    /// As many cells each as the header has.
    pub(super) rows: Vec<Row>,
}

impl Grid {
    /// Text in columns; the best in bold when `bold`, else with a star.
    pub(super) fn terminal(&self, bold: bool) -> String {
        let mark = |c: &Cell| if c.best && !bold { format!("{}*", c.text) } else { c.text.clone() };
        let width = |k: usize| {
            let cells = self.rows.iter().filter_map(|r| r.cells.get(k)).map(|c| mark(c).chars().count());
            cells.chain([self.header[k].chars().count()]).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.header.len()).map(width).collect();
        let line = "-".repeat(widths.iter().sum::<usize>() + 2 * widths.len().saturating_sub(1));
        let pad = |k: usize, text: &str| {
            let fill = " ".repeat(widths[k].saturating_sub(text.chars().count()));
            if k == 0 { format!("{text}{fill}") } else { format!("  {fill}{text}") }
        };
        let mut out = format!("{}\n", self.title);
        out += &self.header.iter().enumerate().map(|(k, h)| pad(k, h)).collect::<String>();
        let _ = write!(out, "\n{line}\n");
        for (i, row) in self.rows.iter().enumerate() {
            if row.rule && i > 0 {
                let _ = writeln!(out, "{line}");
            }
            for (k, cell) in row.cells.iter().enumerate() {
                let text = pad(k, &mark(cell));
                out += &if cell.best && bold { format!("\x1b[1m{text}\x1b[0m") } else { text };
            }
            out.push('\n');
        }
        out
    }

    pub(super) fn markdown(&self) -> String {
        let clean = |text: &str| text.replace('|', "\\|");
        let mut out = format!("### {}\n\n|", self.title);
        self.header.iter().for_each(|h| out += &format!(" {} |", clean(h)));
        out += "\n|---|";
        out += &"---:|".repeat(self.header.len().saturating_sub(1));
        out.push('\n');
        for row in &self.rows {
            out.push('|');
            for cell in &row.cells {
                // A star would begin emphasis.
                let text = clean(&cell.text).replace('*', "\\*");
                out += &if cell.best { format!(" **{text}** |") } else { format!(" {text} |") };
            }
            out.push('\n');
        }
        out
    }

    pub(super) fn html(&self) -> String {
        let mut out = format!("<h3>{}</h3>\n<div class=\"scroll\"><table>\n<thead><tr>", escape(&self.title));
        self.header.iter().for_each(|h| out += &format!("<th>{}</th>", escape(h)));
        out += "</tr></thead>\n<tbody>\n";
        for row in &self.rows {
            let classes = [(row.measured, "measured"), (row.own, "own"), (row.rule, "rule")];
            let classes: Vec<&str> = classes.iter().filter(|(on, _)| *on).map(|(_, c)| *c).collect();
            let _ = write!(out, "<tr class=\"{}\">", classes.join(" "));
            for cell in &row.cells {
                let text = escape(&cell.text);
                let text = if cell.best { format!("<b>{text}</b>") } else { text };
                let bar = cell
                    .bar
                    .map(|b| format!(" class=\"bar\" style=\"--w:{:.1}%\"", 100.0 * b.clamp(0.0, 1.0)));
                let _ = write!(out, "<td{}>{text}</td>", bar.unwrap_or_default());
            }
            out += "</tr>\n";
        }
        out + "</tbody></table></div>\n"
    }
}

/// Text that can stand in HTML.
pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Grid {
        let best = Cell { best: true, bar: Some(0.5), ..Cell::number(Some(1.234), 2) };
        let row = |name: &str, cell, rule| Row {
            cells: vec![Cell::new(name), cell],
            measured: rule,
            own: false,
            rule,
        };
        let rows = vec![row("a<b", best, false), row("BundleTrack*", Cell::number(None, 2), true)];
        Grid { title: "T".into(), header: vec!["method".into(), "ADD".into()], rows }
    }

    #[test]
    fn columns_line_up_whatever_marks_the_best() {
        let plain = grid().terminal(false);
        let lines: Vec<&str> = plain.lines().collect();
        assert_eq!(lines[3], "a<b           1.23*");
        assert_eq!(lines[5], "BundleTrack*      -");
        assert!(lines[4].starts_with("-----"));
        assert!(grid().terminal(true).contains("\x1b[1m  1.23\x1b[0m"));
    }

    #[test]
    fn markdown_and_html_are_escaped() {
        let markdown = grid().markdown();
        assert!(markdown.contains("| a<b | **1.23** |\n| BundleTrack\\* | - |"), "{markdown}");
        let html = grid().html();
        assert!(
            html.contains("a&lt;b") && html.contains("<b>1.23</b>") && html.contains("--w:50.0%"),
            "{html}"
        );
    }
}
