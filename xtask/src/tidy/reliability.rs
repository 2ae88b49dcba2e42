//! docs/reliability.md names tests: each has to exist.

use super::tree::Tree;

const PAGE: &str = "docs/reliability.md";
/// Fewest faults in the table.
const ROWS: usize = 30;

pub(super) fn check(tree: &Tree) -> Vec<String> {
    let Some(page) = tree.get(PAGE) else { return Vec::new() };
    let tests: Vec<&str> =
        tree.files.iter().filter(|f| f.path.ends_with(".rs")).flat_map(|f| tests(&f.text)).collect();
    let mut problems = Vec::new();
    let mut rows = 0;
    for (i, line) in page.text.lines().enumerate() {
        // The last cell of a row with a fault in it.
        let cells: Vec<&str> = line.trim().trim_matches('|').split('|').map(str::trim).collect();
        let [_, _, names] = cells[..] else { continue };
        let named: Vec<&str> = names.split('`').skip(1).step_by(2).collect();
        rows += usize::from(!named.is_empty());
        for name in named.into_iter().filter(|name| !tests.contains(name)) {
            problems.push(format!("{PAGE}:{}: names the test {name}, which does not exist", i + 1));
        }
    }
    if rows < ROWS {
        problems.push(format!("{PAGE}: has {rows} faults with a test, at least {ROWS}"));
    }
    problems
}

/// Names of the functions that follow a `#[test]`.
fn tests(source: &str) -> impl Iterator<Item = &str> {
    source.split("#[test]").skip(1).filter_map(|after| {
        let (_, signature) = after.split_once("fn ")?;
        signature.split_once('(').map(|(name, _)| name)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_test_that_is_named_has_to_exist() {
        let row = |name: &str| format!("| fault | what happens | `{name}`, *long:* `here` |\n");
        let page = |name: &str| row(name).repeat(ROWS);
        let source = "#[test]\n#[ignore]\nfn here() {}\n#[test]\npub fn there() {}\nfn not_a_test() {}";
        let problems = |name: &str| check(&Tree::of(&[(PAGE, &page(name)), ("crates/a/tests/a.rs", source)]));
        assert!(problems("there").is_empty());
        assert_eq!(problems("not_a_test").len(), ROWS);
        assert!(problems("gone")[0].contains("gone"));
        let short = check(&Tree::of(&[(PAGE, &row("here")), ("crates/a/tests/a.rs", source)]));
        assert!(short[0].contains("at least"), "{short:?}");
    }
}
