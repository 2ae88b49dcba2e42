//! Dependencies point down: a crate knows those on lower floors and no other.

use super::tree::Tree;

/// The floors, lowest first; names are folders, and keys in `[workspace.dependencies]`.
const FLOORS: [&[&str]; 5] = [
    &["se3-lie", "rgbd-io"],
    &["octree-sampler", "matcher", "marching-cubes", "eval-metrics"],
    &["neural-field", "posegraph", "mask-tracker", "rgbd-synth", "baselines"],
    &["bundlesdf"],
    &["xtask", "fuzz-targets"],
];

fn floor(name: &str) -> Option<usize> {
    FLOORS.iter().position(|names| names.contains(&name))
}

pub(super) fn check(tree: &Tree) -> Vec<String> {
    let mut problems = Vec::new();
    for member in tree.members() {
        let name = member.strip_prefix("crates/").unwrap_or(member);
        let path = format!("{member}/Cargo.toml");
        let Some(own) = floor(name) else {
            problems.push(format!("{path}: has no floor; give it one in xtask/src/tidy/layers.rs"));
            continue;
        };
        let text = tree.get(&path).map_or("", |file| file.text.as_str());
        let manifest: toml::Table = match text.parse() {
            Ok(manifest) => manifest,
            Err(error) => {
                problems.push(format!("{path}: {}", error.message()));
                continue;
            }
        };
        for (dependency, is_test) in dependencies(&manifest) {
            let Some(other) = floor(&dependency) else { continue };
            // Tests may borrow from the same floor: synthetic sequences are the truth for many.
            if other > own || (other == own && !is_test) {
                problems.push(format!(
                    "{path}: {name} (floor {own}) depends on {dependency} (floor {other}); only lower floors"
                ));
            }
        }
    }
    problems
}

/// Names of all dependencies, and whether each is for tests only; of every target.
fn dependencies(manifest: &toml::Table) -> Vec<(String, bool)> {
    let mut found = Vec::new();
    for (section, is_test) in
        [("dependencies", false), ("build-dependencies", false), ("dev-dependencies", true)]
    {
        if let Some(toml::Value::Table(table)) = manifest.get(section) {
            for (key, value) in table {
                // A renamed local crate is told by its folder.
                let folder = value.get("path").and_then(|p| p.as_str()).and_then(|p| p.rsplit('/').next());
                found.push((folder.unwrap_or(key).to_owned(), is_test));
            }
        }
    }
    if let Some(toml::Value::Table(targets)) = manifest.get("target") {
        found.extend(targets.values().filter_map(toml::Value::as_table).flat_map(dependencies));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problems(path: &str, manifest: &str) -> Vec<String> {
        check(&Tree::of(&[(path, manifest)]))
    }

    #[test]
    fn down_is_allowed() {
        let manifest = "[dependencies]\nse3-lie.workspace = true\nserde = \"1\"\n\
                        [dev-dependencies]\nrgbd-synth.workspace = true\n";
        assert!(problems("crates/posegraph/Cargo.toml", manifest).is_empty());
        assert!(problems("xtask/Cargo.toml", "[dependencies]\nbundlesdf.workspace = true\n").is_empty());
    }

    #[test]
    fn up_and_across_are_not() {
        for dependencies in [
            "[dependencies]\nbundlesdf.workspace = true\n",
            "[dependencies]\nneural-field.workspace = true\n",
            "[dependencies]\nother = { path = \"../neural-field\" }\n",
            "[build-dependencies]\nrgbd-synth.workspace = true\n",
            "[dev-dependencies]\nbundlesdf.workspace = true\n",
            "[target.'cfg(unix)'.dependencies]\nbundlesdf.workspace = true\n",
        ] {
            assert_eq!(problems("crates/posegraph/Cargo.toml", dependencies).len(), 1, "{dependencies}");
        }
        let xtask = "[dependencies]\nxtask = { path = \"../../xtask\" }\n";
        assert_eq!(problems("crates/bundlesdf/Cargo.toml", xtask).len(), 1);
        assert_eq!(problems("crates/new-thing/Cargo.toml", "").len(), 1);
        assert_eq!(problems("crates/posegraph/Cargo.toml", "[dependencies").len(), 1);
    }
}
