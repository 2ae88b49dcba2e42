//! The g2o format: records, errors, round trips, and bytes of any kind.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Matrix6, Vector6};
use posegraph::g2o::{File, Problem, parse, write};
use posegraph::sparse::{Graph, RelativePose};
use proptest::prelude::*;
use se3_lie::se3;

const V0: &str = "VERTEX_SE3:QUAT 0 1 2 3 0 0 0 1\n";
const V1: &str = "VERTEX_SE3:QUAT 1 0 0 0 0 0 0.7071 0.7071\n";
const EDGE: &str =
    "EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 1 .1 .2 .3 .4 .5 2 .6 .7 .8 .9 3 1 1.1 1.2 4 1.3 1.4 5 1.5 6\n";

fn problem(text: &str) -> (usize, Problem) {
    let error = parse(text).unwrap_err();
    assert!(error.to_string().starts_with(&format!("line {}: ", error.line)));
    (error.line, error.problem)
}

#[test]
fn the_triangle_is_read_row_by_row() {
    let file = parse([V0, V1, EDGE].concat()).unwrap();
    let information = file.graph.edges[0].information;
    assert_eq!(information.diagonal(), Vector6::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0));
    for (at, value) in
        [((0, 5), 0.5), ((1, 2), 0.6), ((1, 5), 0.9), ((2, 3), 1.0), ((3, 5), 1.4), ((4, 5), 1.5)]
    {
        assert_eq!((information[at], information[(at.1, at.0)]), (value, value));
    }
    assert!((file.graph.poses[1].rotation.angle().to_degrees() - 90.0).abs() < 1e-9, "normalised");
}

#[test]
fn order_line_endings_comments_and_parameters_do_not_matter() {
    let expected = parse([V0, V1, EDGE, "FIX 0\n"].concat()).unwrap();
    let text = ["# caf\u{e9}\n\nFIX 0 # the first\n\t", EDGE, "PARAMS_SE3OFFSET 0 0 0 0\n", V0, V1].concat();
    let text = text.replace('\n', "\r\n");
    assert_eq!(parse(text.trim_end()).unwrap(), expected);
    assert_eq!(parse("").unwrap(), File::default());
    // A comment need not be text.
    assert_eq!(parse(b"#\xff\xfe\n").unwrap(), File::default());
}

#[test]
fn ids_are_labels_not_sizes() {
    let text = "VERTEX_SE3:QUAT 18446744073709551615 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 5 0 0 0 0 0 0 1\nFIX 5";
    let file = parse(text).unwrap();
    assert_eq!(file.ids, [u64::MAX, 5]);
    assert!(file.graph.fixed.contains(&1));
}

#[test]
fn errors_name_the_line() {
    let after = |line: &str| problem(&[V0, V1, "\n", line].concat());
    assert_eq!(after("EDGE_SE2 0 1 0 0 0"), (4, Problem::UnknownRecord("EDGE_SE2".into())));
    let short = Problem::FieldCount { record: "VERTEX_SE3:QUAT", got: 3, expected: 8 };
    assert_eq!(after("VERTEX_SE3:QUAT 2 0 0"), (4, short));
    assert_eq!(after("FIX"), (4, Problem::FieldCount { record: "FIX", got: 0, expected: 1 }));
    assert_eq!(after(&EDGE[..40]).0, 4);
    for bad in ["nan", "inf", "1e999", "x", "1,5", "--1"] {
        let line = format!("VERTEX_SE3:QUAT 2 0 {bad} 0 0 0 0 1");
        assert_eq!(after(&line), (4, Problem::Value(bad.into())));
    }
    for bad in ["-1", "1.5", "18446744073709551616", "99999999999999999999999"] {
        assert_eq!(after(&format!("FIX {bad}")), (4, Problem::Value(bad.into())));
    }
    assert_eq!(after("VERTEX_SE3:QUAT 2 0 0 0 0 0 0 0"), (4, Problem::ZeroQuaternion));
    assert_eq!(after(V0), (4, Problem::DuplicateVertex(0)));
    assert_eq!(after(&EDGE.replace("QUAT 0 1", "QUAT 0 7")), (4, Problem::UnknownVertex(7)));
    assert_eq!(after(&EDGE.replace("QUAT 0 1", "QUAT 1 1")), (4, Problem::SelfEdge(1)));
    assert_eq!(after(&EDGE.replace(" 4 ", " -4 ")), (4, Problem::Information));
    assert_eq!(after("FIX 0 2"), (4, Problem::UnknownVertex(2)));
}

#[test]
fn huge_and_tiny_quaternions_are_normalised() {
    for q in ["0 0 1e200 1e200", "0 0 1e-200 1e-200"] {
        let file = parse(format!("VERTEX_SE3:QUAT 0 0 0 0 {q}")).unwrap();
        assert!((file.graph.poses[0].rotation.angle().to_degrees() - 90.0).abs() < 1e-9);
    }
}

#[test]
fn unwritable_graphs_are_refused() {
    let mut file = parse([V0, V1, EDGE].concat()).unwrap();
    file.ids = vec![1];
    assert!(write(&file, &mut Vec::new()).is_err(), "index 1 is taken by id 1");
    file.ids.clear();
    assert!(write(&file, &mut Vec::new()).is_ok());
    file.graph.edges[0].to = 2;
    assert!(write(&file, &mut Vec::new()).is_err());
}

fn twist() -> impl Strategy<Value = Vector6<f64>> {
    prop::array::uniform6(-3.0f64..3.0).prop_map(Vector6::from)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn what_is_written_reads_back_to_the_same_bits(
        poses in prop::collection::btree_map(any::<u64>(), twist(), 2..8),
        edges in prop::collection::vec((0usize..8, 1usize..8, twist(), prop::array::uniform32(-1.0f64..1.0)), 0..8),
        fixed in prop::collection::btree_set(0usize..2, 0..2),
    ) {
        let n = poses.len();
        let edges = edges.into_iter().filter(|e| e.1 % n != 0).map(|(from, offset, z, w)| {
            let root = Matrix6::from_fn(|r, c| w[(6 * r + c) % 32]);
            let information = root.transpose() * root;
            let information = (information + information.transpose()) * 0.5;
            RelativePose::new(from % n, (from + offset) % n, se3::exp(&z), information)
        });
        let graph = Graph { edges: edges.collect(), poses: poses.values().map(se3::exp).collect(), fixed };
        let file = File { graph, ids: poses.keys().copied().collect() };
        let mut text = Vec::new();
        write(&file, &mut text).unwrap();
        prop_assert_eq!(parse(&text).unwrap(), file);
    }

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = parse(&bytes);
    }

    /// Valid files with bytes changed, removed and doubled: parsed or refused, and what parses can be solved.
    #[test]
    fn damaged_files_never_panic(
        damage in prop::collection::vec((0usize..400, 0u8..4, prop::sample::select(b"0159.-e \n#QN".to_vec())), 0..6),
    ) {
        let mut bytes = [V0, V1, EDGE, "FIX 0\n"].concat().into_bytes();
        for (at, kind, byte) in damage {
            let at = at % bytes.len();
            match kind {
                0 => bytes[at] = byte,
                1 => bytes.truncate(at.max(1)),
                2 => drop(bytes.remove(at)),
                _ => bytes.insert(at, byte),
            }
            if bytes.is_empty() {
                bytes.push(b'\n');
            }
        }
        if let Ok(file) = parse(&bytes) {
            prop_assert_eq!(file.ids.len(), file.graph.poses.len());
            if let Ok(solution) = posegraph::sparse::solve(&file.graph, &Default::default()) {
                prop_assert!(solution.cost_final <= solution.cost_initial);
            }
        }
    }
}
