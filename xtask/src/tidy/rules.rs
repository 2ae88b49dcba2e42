//! What every crate has, and what code may touch.

use super::code::{has_word, without_tests, without_text};
use super::tree::{File, Tree};

/// A source file with more lines has more than one idea in it.
const MAX_LINES: usize = 600;
/// Only these touch the file system.
const FILE_CRATES: [&str; 5] =
    ["crates/rgbd-io", "crates/bundlesdf", "crates/rgbd-synth", "crates/fuzz-targets", "xtask"];
/// Only files of these names hold unsafe code.
const UNSAFE_FILES: [&str; 2] = ["simd.rs", "gpu.rs"];

pub(super) fn check(tree: &Tree) -> Vec<String> {
    let mut problems = Vec::new();
    for licence in ["LICENSE-MIT", "LICENSE-APACHE"] {
        if tree.get(licence).is_none() {
            problems.push(format!("{licence}: is missing"));
        }
    }
    for member in tree.members() {
        check_member(tree, member, &mut problems);
    }
    for file in &tree.files {
        check_paths(file, &mut problems);
        if file.path.ends_with(".rs") || file.path.ends_with(".wgsl") {
            let lines = file.text.lines().count();
            if lines > MAX_LINES {
                problems.push(format!("{}: has {lines} lines, at most {MAX_LINES}; split it", file.path));
            }
        }
        if file.path.ends_with(".rs") {
            check_code(file, &mut problems);
        }
    }
    problems
}

/// README, example and crate docs; xtask is no library and needs the docs only.
fn check_member(tree: &Tree, member: &str, problems: &mut Vec<String>) {
    let roots = ["src/lib.rs", "src/main.rs"].map(|name| tree.get(&format!("{member}/{name}")));
    match roots.into_iter().flatten().next() {
        None => problems.push(format!("{member}: has neither src/lib.rs nor src/main.rs")),
        Some(root) if !root.text.lines().any(|line| line.starts_with("//!")) => {
            problems.push(format!("{}: has no crate docs (//!)", root.path));
        }
        Some(_) => {}
    }
    if member == "xtask" {
        return;
    }
    if tree.get(&format!("{member}/README.md")).is_none() {
        problems.push(format!("{member}: has no README.md"));
    }
    if member == "crates/bundlesdf" {
        if tree.get("crates/bundlesdf/examples/embed.rs").is_none() {
            problems.push(format!("{member}: has no examples/embed.rs"));
        }
        return;
    }
    let prefix = format!("{member}/examples/");
    let is_example =
        |f: &File| f.path.starts_with(&prefix) && f.path.ends_with(".rs") && f.text.contains("fn main()");
    if !tree.files.iter().any(is_example) {
        problems.push(format!("{member}: has no runnable example under examples/"));
    }
}

/// No file names a place on somebody's machine.
fn check_paths(file: &File, problems: &mut Vec<String>) {
    // Put together here, so that this file does not name one either.
    for folder in ["home", "root", "work"].map(|name| format!("/{name}/")) {
        for (i, line) in file.text.lines().enumerate() {
            if names_folder(line, &folder) {
                problems.push(format!("{}:{}: has an absolute path ({folder}…)", file.path, i + 1));
            }
        }
    }
}

/// Whether the line has `folder` as the start of a path, not inside a longer one or an address.
fn names_folder(line: &str, folder: &str) -> bool {
    line.match_indices(folder)
        .any(|(at, _)| !line[..at].ends_with(|c: char| c.is_alphanumeric() || "._-/)]}*$~".contains(c)))
}

fn check_code(file: &File, problems: &mut Vec<String>) {
    let code = without_text(&file.text);
    if has_word(&code, "unsafe") && !UNSAFE_FILES.contains(&file.name()) {
        problems.push(format!("{}: has unsafe code outside of simd.rs and gpu.rs", file.path));
    }
    let is_library = file.within().starts_with("src/");
    if let Some(member) = file.member().filter(|m| is_library && !FILE_CRATES.contains(m)) {
        let library = without_tests(&code);
        if ["std::fs", "fs::File", "File::open", "File::create"].iter().any(|word| has_word(library, word)) {
            problems.push(format!(
                "{}: touches the file system; {member} takes readers, writers and slices",
                file.path
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tree without problems, with one file replaced or added.
    fn with(path: &str, text: &str) -> Vec<String> {
        let mut files = vec![
            ("LICENSE-MIT", ""),
            ("LICENSE-APACHE", ""),
            ("crates/matcher/Cargo.toml", ""),
            ("crates/matcher/README.md", ""),
            ("crates/matcher/src/lib.rs", "//! Docs.\n"),
            ("crates/matcher/examples/a.rs", "fn main() {}"),
        ];
        files.retain(|(p, _)| *p != path);
        files.push((path, text));
        check(&Tree::of(&files))
    }

    #[test]
    fn a_complete_crate_is_fine() {
        assert_eq!(with("docs/notes.md", ""), Vec::<String>::new());
    }

    #[test]
    fn each_rule_can_fail() {
        let long = "//! Docs.\n".repeat(601);
        for (path, text, problem) in [
            ("crates/matcher/src/lib.rs", "mod a;\n", "crate docs"),
            ("crates/matcher/src/lib.rs", long.as_str(), "601 lines"),
            ("crates/matcher/src/a.rs", "fn f() { unsafe { g() } }", "unsafe"),
            ("crates/matcher/src/a.rs", "use std::fs;", "file system"),
            ("crates/matcher/src/a.rs", "fn f() { File::open(p); }", "file system"),
            ("crates/matcher/examples/a.rs", "mod shared;", "runnable example"),
            ("crates/posegraph/Cargo.toml", "", "neither"),
            ("crates/bundlesdf/Cargo.toml", "", "embed.rs"),
            ("docs/notes.md", concat!("see /ho", "me/me/data"), "absolute path"),
            ("docs/notes.md", concat!("`/ro", "ot/x`"), "absolute path"),
        ] {
            let found = with(path, text);
            assert!(found.iter().any(|p| p.contains(problem)), "{path} {problem}: {found:?}");
        }
        assert_eq!(check(&Tree::of(&[])).len(), 2);
    }

    #[test]
    fn what_is_allowed_stays_silent() {
        for (path, text) in [
            ("crates/matcher/src/simd.rs", "fn f() { unsafe { g() } }"),
            ("crates/matcher/src/a.rs", "// unsafe std::fs\nfn f() { \"unsafe\"; }\n"),
            ("crates/matcher/src/a.rs", "#[cfg(test)]\nmod tests { use std::fs; }"),
            ("crates/matcher/tests/a.rs", "use std::fs;"),
            ("docs/notes.md", concat!("https://example.org/wo", "rk/x and src/ro", "ot/x")),
        ] {
            assert_eq!(with(path, text), Vec::<String>::new(), "{path}");
        }
    }
}
