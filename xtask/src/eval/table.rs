//! From the scores of jobs to the numbers of a table.

use super::benchmark::{Benchmark, MeanOf};
use super::job::{Asked, Build};
use super::method::Method;
use super::published::{MEAN, Published};
use super::score::Score;
use eval_metrics::auc;

/// A job that was done, or failed.
#[derive(Clone, Debug)]
pub(super) struct Entry {
    pub(super) asked: Asked,
    /// The score, or what went wrong.
    pub(super) score: Result<Score, String>,
    /// The program that did it, where it isn't this one.
    pub(super) other_build: Option<Build>,
}

/// The three numbers of the paper.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Values {
    pub(super) add_s: Option<f64>,
    pub(super) add: Option<f64>,
    pub(super) cd_cm: Option<f64>,
}

/// A method, ours or published.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Column {
    pub(super) name: String,
    /// `None` for published numbers.
    pub(super) method: Option<Method>,
    /// One per group of the table.
    pub(super) values: Vec<Values>,
    pub(super) mean: Values,
    /// Groups that the mean of the chamfer distance is over, where it isn't over all.
    pub(super) cd_groups: Option<usize>,
    /// All frames together, for ours; with one video the same as the mean.
    pub(super) pooled: Option<Values>,
}

/// Everything that was measured, beside what was published.
#[derive(Clone, Debug)]
pub(super) struct Tables {
    pub(super) benchmark: Benchmark,
    /// Videos, or objects where the paper's table has these.
    pub(super) groups: Vec<String>,
    pub(super) columns: Vec<Column>,
    /// The published ablations, where ablations were run.
    pub(super) ablations: Vec<Published>,
}

impl Tables {
    pub(super) fn new(
        benchmark: Benchmark,
        entries: &[Entry],
        published: &[Published],
        ablations: Vec<Published>,
    ) -> Self {
        let mut groups: Vec<String> = Vec::new();
        let mut methods: Vec<Method> = Vec::new();
        for entry in entries {
            let group = benchmark.group_of(&entry.asked.place.name);
            if !groups.contains(&group) {
                groups.push(group);
            }
            if !methods.contains(&entry.asked.method) {
                methods.push(entry.asked.method);
            }
        }
        let mut columns = published_columns(benchmark, &groups, published);
        let beside_published = !columns.is_empty();
        columns.extend(methods.into_iter().map(|method| Column {
            name: method.label(beside_published),
            ..measured(benchmark, method, &groups, entries)
        }));
        Self { benchmark, groups, columns, ablations }
    }

    /// Which of the columns have the best value of a group (of the mean without one), to the two digits shown.
    pub(super) fn best(&self, group: Option<usize>, metric: Metric) -> Vec<bool> {
        let value = |c: &Column| {
            let values = group.map_or(Some(&c.mean), |g| c.values.get(g))?;
            // A mean over fewer surfaces than others have isn't comparable.
            let partial = metric == Metric::Chamfer && group.is_none() && c.cd_groups.is_some();
            metric.of(values).filter(|_| !partial).map(|v| (v * 100.0).round())
        };
        let values: Vec<Option<f64>> = self.columns.iter().map(value).collect();
        let known = values.iter().copied().flatten();
        let best = if metric == Metric::Chamfer { known.reduce(f64::min) } else { known.reduce(f64::max) };
        values.iter().map(|v| v.is_some() && *v == best).collect()
    }
}

/// What a column of numbers measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Metric {
    AddS,
    Add,
    Chamfer,
}

impl Metric {
    pub(super) const ALL: [Self; 3] = [Self::AddS, Self::Add, Self::Chamfer];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::AddS => "ADD-S",
            Self::Add => "ADD",
            Self::Chamfer => "CD cm",
        }
    }

    pub(super) fn of(self, values: &Values) -> Option<f64> {
        match self {
            Self::AddS => values.add_s,
            Self::Add => values.add,
            Self::Chamfer => values.cd_cm,
        }
    }
}

impl From<&Published> for Values {
    fn from(line: &Published) -> Self {
        Self { add_s: Some(line.add_s), add: Some(line.add), cd_cm: line.cd_cm }
    }
}

/// The published numbers of these groups. Their mean is over the same groups where that can be told.
fn published_columns(benchmark: Benchmark, groups: &[String], lines: &[Published]) -> Vec<Column> {
    let per_group = lines.iter().any(|l| l.group != MEAN);
    let known = |group: &&String| lines.iter().any(|l| l.group == **group);
    if per_group && !groups.iter().any(|g| known(&g)) {
        return Vec::new();
    }
    let in_paper: Vec<&str> = lines.iter().map(|l| l.group.as_str()).filter(|g| *g != MEAN).collect();
    let is_whole = in_paper.iter().all(|g| groups.iter().any(|own| own == g));
    let mut names: Vec<&str> = Vec::new();
    lines.iter().for_each(|l| {
        if !names.contains(&l.method.as_str()) {
            names.push(&l.method)
        }
    });
    let column = |name: &str| {
        let of = |group: &str| lines.iter().find(|l| l.method == name && l.group == group).map(Values::from);
        let values: Vec<Values> = groups.iter().map(|g| of(g).unwrap_or_default()).collect();
        let mean = match benchmark.mean_of() {
            _ if is_whole => of(MEAN).unwrap_or_default(),
            MeanOf::Groups => mean_of_groups(&values).0,
            MeanOf::Frames => Values::default(),
        };
        Column { name: name.to_owned(), method: None, values, mean, cd_groups: None, pooled: None }
    };
    names.into_iter().map(column).collect()
}

/// One repeat of a method over all videos.
struct Pass {
    groups: Vec<Values>,
    /// All frames pooled.
    together: Values,
}

fn measured(benchmark: Benchmark, method: Method, groups: &[String], entries: &[Entry]) -> Column {
    let own: Vec<&Entry> = entries.iter().filter(|e| e.asked.method == method).collect();
    let mut repeats: Vec<u64> = own.iter().map(|e| e.asked.repeat).collect();
    repeats.sort_unstable();
    repeats.dedup();
    let of_repeat = |repeat: u64| {
        let of = |e: &&&Entry| e.asked.repeat == repeat;
        let group = |name: &String| {
            let members: Vec<&Entry> = own
                .iter()
                .filter(of)
                .filter(|e| benchmark.group_of(&e.asked.place.name) == *name)
                .copied()
                .collect();
            pooled(benchmark, &members, entries)
        };
        let all: Vec<&Entry> = own.iter().filter(of).copied().collect();
        Pass { groups: groups.iter().map(group).collect(), together: pooled(benchmark, &all, entries) }
    };
    let passes: Vec<Pass> = repeats.into_iter().map(of_repeat).collect();
    let over_passes =
        |pick: &dyn Fn(&Pass) -> Values| mean_of_groups(&passes.iter().map(pick).collect::<Vec<_>>()).0;
    let values: Vec<Values> = (0..groups.len()).map(|g| over_passes(&|pass| pass.groups[g])).collect();
    let together = over_passes(&|pass| pass.together);
    let (mut mean, with_cd) = mean_of_groups(&values);
    if benchmark.mean_of() == MeanOf::Frames {
        (mean.add_s, mean.add) = (together.add_s, together.add);
    }
    Column {
        name: method.name().into(),
        method: Some(method),
        values,
        mean,
        cd_groups: (with_cd > 0 && with_cd < groups.len()).then_some(with_cd),
        pooled: Some(together),
    }
}

/// Means, each over the groups that have the value, and how many have a chamfer distance.
fn mean_of_groups(values: &[Values]) -> (Values, usize) {
    let mean = |pick: fn(&Values) -> Option<f64>| {
        let known: Vec<f64> = values.iter().filter_map(pick).collect();
        ((!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64), known.len())
    };
    let (cd_cm, with_cd) = mean(|v| v.cd_cm);
    (Values { add_s: mean(|v| v.add_s).0, add: mean(|v| v.add).0, cd_cm }, with_cd)
}

/// The scores of some videos with their frames pooled. All frames of a video that failed are infinitely wrong; how many
/// these are is known from other methods' scores of it.
fn pooled(benchmark: Benchmark, members: &[&Entry], entries: &[Entry]) -> Values {
    if members.is_empty() {
        return Values::default();
    }
    let (mut add, mut add_s, mut chamfer) = (Vec::new(), Vec::new(), Vec::new());
    for entry in members {
        match &entry.score {
            Ok(score) => {
                let wrong = |e: &Option<f64>| e.unwrap_or(f64::INFINITY);
                add.extend(score.errors.add.iter().map(wrong));
                add_s.extend(score.errors.add_s.iter().map(wrong));
                let chamfers = Values { cd_cm: benchmark.chamfer(score), ..Values::default() };
                chamfer.push(chamfers);
            }
            Err(_) => {
                let same = |e: &&Entry| e.asked.place.name == entry.asked.place.name;
                let counts = entries.iter().filter(same).filter_map(|e| e.score.as_ref().ok());
                let frames = counts.map(|s| s.errors.add.len()).max().unwrap_or(1);
                add.extend(std::iter::repeat_n(f64::INFINITY, frames));
                add_s.extend(std::iter::repeat_n(f64::INFINITY, frames));
            }
        }
    }
    let limit = benchmark.max_error();
    let cd_cm = mean_of_groups(&chamfer).0.cd_cm;
    Values { add_s: Some(auc(&add_s, limit)), add: Some(auc(&add, limit)), cd_cm }
}

#[cfg(test)]
#[path = "table_tests.rs"]
mod tests;
