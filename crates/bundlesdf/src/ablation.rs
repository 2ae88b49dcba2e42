//! The ablations of the paper's table 4, as switches of the same program.

use crate::config::{Config, KeyframeRule, Refiner};

/// A part of the system that is taken out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Ablation {
    /// Frame-to-frame coarse poses only: no keyframes, no pose graph, no field.
    NoMemory,
    /// The pose graph over memory without the Neural Object Field and its SDF term.
    NoNof,
    /// Rounds of global pose-graph optimisation over all keyframes in the field's place.
    Gpg,
    /// The field sees foreground rays inside the mask only: no uncertain free space, no ring around the mask.
    NoHybridSdf,
    /// Keyframes by full rotation distance, chosen as a least-total-distance subset (BundleTrack's rules).
    NoCompactPool,
}

impl Ablation {
    /// All of them, in the paper's order.
    pub const ALL: [Self; 5] =
        [Self::NoMemory, Self::NoNof, Self::Gpg, Self::NoHybridSdf, Self::NoCompactPool];

    /// Name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::NoMemory => "no-memory",
            Self::NoNof => "no-nof",
            Self::Gpg => "gpg",
            Self::NoHybridSdf => "no-hybrid-sdf",
            Self::NoCompactPool => "no-compact-pool",
        }
    }

    /// The ablation of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|a| a.name() == name)
    }

    /// Takes the part out of `config`.
    pub fn apply(self, config: &mut Config) {
        match self {
            Self::NoMemory => {
                config.memory.enabled = false;
                config.field.refiner = Refiner::None;
            }
            Self::NoNof => config.field.refiner = Refiner::None,
            Self::Gpg => config.field.refiner = Refiner::PoseGraph,
            Self::NoHybridSdf => config.field.hybrid = false,
            Self::NoCompactPool => config.memory.rule = KeyframeRule::FullRotation,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_back_and_every_ablation_changes_the_config() {
        for ablation in Ablation::ALL {
            assert_eq!(Ablation::from_name(ablation.name()), Some(ablation));
            let mut config = Config::default();
            ablation.apply(&mut config);
            assert_ne!(config, Config::default());
            config.validate().unwrap();
        }
        assert_eq!(Ablation::from_name("no-such"), None);
    }
}
