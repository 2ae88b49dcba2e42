//! Pose graphs in g2o files; small ones are solved, too.

use crate::check_pose;
use posegraph::{g2o, sparse};

/// Graphs of more nodes or edges are read but not solved: the fuzzer looks for faults and not for work.
const SOLVED: usize = 24;

pub(crate) fn run(data: &[u8]) {
    let Ok(file) = g2o::parse(data) else { return };
    file.graph.poses.iter().for_each(check_pose);
    let mut written = Vec::new();
    let result = g2o::write(&file, &mut written);
    assert!(result.is_ok(), "{result:?}");
    assert_eq!(g2o::parse(&written).ok(), Some(file.clone()), "what was written reads differently");
    if file.graph.poses.len() <= SOLVED && file.graph.edges.len() <= SOLVED {
        let options = sparse::Options { max_iterations: 5, ..sparse::Options::default() };
        if let Ok(solution) = sparse::solve(&file.graph, &options) {
            assert_eq!(solution.poses.len(), file.graph.poses.len());
            solution.poses.iter().for_each(check_pose);
        }
    }
}
