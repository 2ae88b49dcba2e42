//! What is evaluated: the system, its ablations, and what it is compared with.

use baselines::Baseline;
use bundlesdf::Ablation;
use serde::{Deserialize, Serialize};

/// A tracker and reconstructor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(super) enum Method {
    Ours,
    /// Ours, then refined over all keyframes once the video has ended.
    Refined,
    /// Ours with a part taken out.
    Ablated(Ablation),
    /// Our tracker without the field and with BundleTrack's choice of keyframes; its poses fused into a surface.
    BundleTrack,
    Baseline(Baseline),
    /// Open3D's odometry and fusion, in a Python of the user's.
    Open3d,
}

impl Method {
    /// Everything that isn't an ablation and needs no other program.
    pub(super) fn all() -> Vec<Self> {
        let mut all = vec![Self::Ours, Self::Refined, Self::BundleTrack];
        all.extend(Baseline::ALL.map(Self::Baseline));
        all
    }

    pub(super) fn ablations() -> Vec<Self> {
        Ablation::ALL.into_iter().map(Self::Ablated).collect()
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Ours => "ours",
            Self::Refined => "refined",
            Self::BundleTrack => "bundletrack",
            Self::Ablated(ablation) => ablation.name(),
            Self::Baseline(baseline) => baseline.name(),
            Self::Open3d => "open3d",
        }
    }

    /// Everything that isn't an ablation.
    pub(super) fn named() -> Vec<Self> {
        let mut named = Self::all();
        named.push(Self::Open3d);
        named
    }

    fn from_name(name: &str) -> Option<Self> {
        Self::named().into_iter().chain(Self::ablations()).find(|m| m.name().eq_ignore_ascii_case(name))
    }

    /// Name in tables; beside published numbers it says that these are measured.
    pub(super) fn label(self, beside_published: bool) -> String {
        match self {
            Self::Ablated(_) | Self::Refined if beside_published => format!("ours, {}", self.name()),
            Self::Open3d if beside_published => "open3d (measured)".into(),
            Self::BundleTrack | Self::Baseline(_) if beside_published => format!("{} (ours)", self.name()),
            _ => self.name().into(),
        }
    }

    /// The methods that the two lists name; `all` stands for each list's whole. In the order of the known ones.
    pub(super) fn parse(methods: &[String], ablations: &[String]) -> anyhow::Result<Vec<Self>> {
        let mut chosen = choose("method", methods, &Self::named())?;
        chosen.extend(choose("ablation", ablations, &Self::ablations())?);
        Ok(chosen)
    }
}

fn choose(kind: &str, names: &[String], known: &[Method]) -> anyhow::Result<Vec<Method>> {
    for name in names {
        let is_known = name == "all" || known.iter().any(|m| m.name() == name);
        let list = known.iter().map(|m| m.name()).collect::<Vec<_>>().join(", ");
        anyhow::ensure!(is_known, "there is no {kind} {name}; there are {list}, and all");
    }
    // What needs another program runs only by its name.
    let wanted = |m: &&Method| names.iter().any(|n| (n == "all" && **m != Method::Open3d) || n == m.name());
    Ok(known.iter().filter(wanted).copied().collect())
}

impl TryFrom<String> for Method {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        Self::from_name(&name).ok_or_else(|| format!("there is no method {name}"))
    }
}

impl From<Method> for String {
    fn from(method: Method) -> Self {
        method.name().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_read_in_order_and_once() {
        let names = |m: &[&str], a: &[&str]| {
            let own = |l: &[&str]| l.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
            Method::parse(&own(m), &own(a)).map(|v| v.iter().map(|m| m.name()).collect::<Vec<_>>())
        };
        assert_eq!(names(&["sdf2sdf", "ours", "ours"], &["no-nof"]).unwrap(), ["ours", "sdf2sdf", "no-nof"]);
        assert_eq!(names(&["all"], &["all"]).unwrap().len(), 11);
        assert_eq!(names(&["open3d", "ours"], &[]).unwrap(), ["ours", "open3d"]);
        let error = names(&["nonesuch"], &[]).unwrap_err().to_string();
        assert!(error.contains("nonesuch") && error.contains("kinectfusion"), "{error}");
        assert!(names(&["no-nof"], &[]).is_err());
    }

    #[test]
    fn names_come_back() {
        for method in Method::named().into_iter().chain(Method::ablations()) {
            assert_eq!(Method::try_from(method.name().to_owned()), Ok(method));
        }
    }
}
