//! The g2o text format for 3-D pose graphs: `VERTEX_SE3:QUAT`, `EDGE_SE3:QUAT` and `FIX` (feature `sparse`).
//!
//! ```
//! let text = "\
//! VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1
//! VERTEX_SE3:QUAT 3 1 0 0 0 0 0 1
//! EDGE_SE3:QUAT 7 3 1.1 0 0 0 0 0 1  100 0 0 0 0 0  100 0 0 0 0  100 0 0 0  400 0 0  400 0  400
//! FIX 7
//! ";
//! let file = posegraph::g2o::parse(text)?;
//! assert_eq!((file.ids.as_slice(), file.graph.edges[0].to), ([7, 3].as_slice(), 1));
//! assert!((file.graph.half_chi_squared() - 0.5).abs() < 1e-9);
//! let mut written = Vec::new();
//! posegraph::g2o::write(&file, &mut written)?;
//! assert_eq!(posegraph::g2o::parse(&written)?, file);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Conventions
//! A vertex is `id x y z qx qy qz qw`, the pose in the world. An edge is `from to`, the measured pose of `to` in `from`
//! in the same seven numbers, and the upper triangle, row by row, of the information of `x y z qx qy qz`.
//!
//! The information is read as that of the twist `[rho; phi]` in metres and **radians**, as GTSAM reads it, so that chi
//! squared is comparable with published optima. g2o itself takes the error of a rotation to be the vector part of its
//! quaternion, which is half of the angle: for a file made for that, divide the information on rotations by four and
//! that between rotations and translations by two.

#![warn(clippy::indexing_slicing)]

use std::collections::HashMap;
use std::io::{self, Write};

use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion};

use crate::sparse::{Graph, RelativePose, is_information};

/// Contents of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct File {
    /// Poses and edges, both in the order of the file, with indices instead of ids.
    pub graph: Graph,
    /// Id of each pose in the file.
    pub ids: Vec<u64>,
}

/// A line that could not be understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct ParseError {
    /// Line number, from 1.
    pub line: usize,
    /// What is wrong and what to do about it.
    pub problem: Problem,
}

/// What is wrong with a line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The first word is no record that a 3-D pose graph can hold.
    #[error(
        "record {0} is not supported; delete the line, or convert it to VERTEX_SE3:QUAT or EDGE_SE3:QUAT"
    )]
    UnknownRecord(String),
    /// The line has too few or too many fields.
    #[error(
        "{record} has {got} fields after its name where {expected} are needed; complete or delete the line"
    )]
    FieldCount {
        /// The record.
        record: &'static str,
        /// Fields found.
        got: usize,
        /// Fields needed.
        expected: usize,
    },
    /// A field is not a finite number, or an id not a non-negative integer.
    #[error("{0:?} is not a valid value; write a finite number (ids: an integer from 0 to 2^64 - 1)")]
    Value(String),
    /// The quaternion has no direction.
    #[error("quaternion has length zero; write a rotation as qx qy qz qw, identity is 0 0 0 1")]
    ZeroQuaternion,
    /// The information matrix is not positive semi-definite.
    #[error("information matrix is not positive semi-definite; correct it or delete the edge")]
    Information,
    /// Two vertices have the same id.
    #[error("vertex {0} appears twice; delete one of the lines")]
    DuplicateVertex(u64),
    /// An edge joins a vertex with itself.
    #[error("edge joins vertex {0} with itself; delete the line")]
    SelfEdge(u64),
    /// The line refers to a vertex that the file does not contain.
    #[error("vertex {0} is not in the file; add a VERTEX_SE3:QUAT line for it or delete this line")]
    UnknownVertex(u64),
}

const VERTEX: &str = "VERTEX_SE3:QUAT";
const EDGE: &str = "EDGE_SE3:QUAT";
const FIX: &str = "FIX";

/// Reads a file. Records may come in any order and ids need not be contiguous. Comments (`#` to the end of the line),
/// blank lines, `PARAMS_*` lines and either line ending are accepted. Quaternions are normalised.
///
/// # Errors
/// The first line that is malformed, with its number.
pub fn parse(text: impl AsRef<[u8]>) -> Result<File, ParseError> {
    let mut file = File::default();
    let mut index = HashMap::new();
    // Edges and FIX may come before the vertices that they name.
    let mut edges = Vec::new();
    let mut fixed = Vec::new();
    for (k, line) in text.as_ref().split(|&b| b == b'\n').enumerate() {
        let line = line.split(|&b| b == b'#').next().unwrap_or_default();
        let at = |problem| ParseError { line: k + 1, problem };
        let mut fields = Fields(line);
        match fields.next() {
            None => {}
            Some(b"VERTEX_SE3:QUAT") => {
                let (id, pose) = vertex(fields).map_err(at)?;
                if index.insert(id, file.ids.len()).is_some() {
                    return Err(at(Problem::DuplicateVertex(id)));
                }
                file.ids.push(id);
                file.graph.poses.push(pose);
            }
            Some(b"EDGE_SE3:QUAT") => edges.push((k + 1, edge(fields).map_err(at)?)),
            Some(b"FIX") => {
                if fields.clone().next().is_none() {
                    return Err(at(Problem::FieldCount { record: FIX, got: 0, expected: 1 }));
                }
                for field in fields {
                    fixed.push((k + 1, integer(field).map_err(at)?));
                }
            }
            Some(record) if record.starts_with(b"PARAMS_") => {}
            Some(record) => return Err(at(Problem::UnknownRecord(excerpt(record)))),
        }
    }
    let find = |line, id| {
        let unknown = ParseError { line, problem: Problem::UnknownVertex(id) };
        index.get(&id).copied().ok_or(unknown)
    };
    for (line, (from, to, from_from_to, information)) in edges {
        let (from, to) = (find(line, from)?, find(line, to)?);
        file.graph.edges.push(RelativePose { from, to, from_from_to, information });
    }
    for (line, id) in fixed {
        file.graph.fixed.insert(find(line, id)?);
    }
    Ok(file)
}

/// Writes a file: vertices, fixed vertices, edges. Numbers are the shortest that read back to the same bits. A pose
/// without an id (`ids` too short) gets its index, if that is not an id already.
///
/// # Errors
/// What the writer returns, and `InvalidInput` if an edge or `fixed` refers to a pose that does not exist, or ids
/// repeat.
pub fn write(file: &File, out: &mut impl Write) -> io::Result<()> {
    let invalid = |what: &str| io::Error::new(io::ErrorKind::InvalidInput, what.to_owned());
    let graph = &file.graph;
    let ids: Vec<u64> =
        (0..graph.poses.len()).map(|k| file.ids.get(k).copied().unwrap_or(k as u64)).collect();
    let unique: std::collections::HashSet<&u64> = ids.iter().collect();
    if unique.len() < ids.len() {
        return Err(invalid("two poses have the same id; give every pose its own"));
    }
    let id = |node: usize| ids.get(node).ok_or_else(|| invalid("graph refers to a missing pose; add it"));
    for (id, pose) in ids.iter().zip(&graph.poses) {
        write!(out, "{VERTEX} {id}")?;
        write_pose(pose, out)?;
        writeln!(out)?;
    }
    for &node in &graph.fixed {
        writeln!(out, "{FIX} {}", id(node)?)?;
    }
    for edge in &graph.edges {
        write!(out, "{EDGE} {} {}", id(edge.from)?, id(edge.to)?)?;
        write_pose(&edge.from_from_to, out)?;
        for row in 0..6 {
            for column in row..6 {
                let value = edge.information.get((row, column)).copied().unwrap_or_default();
                write!(out, " {value}")?;
            }
        }
        writeln!(out)?;
    }
    Ok(())
}

fn write_pose(pose: &Isometry3<f64>, out: &mut impl Write) -> io::Result<()> {
    let (t, q) = (&pose.translation.vector, pose.rotation.as_ref());
    write!(out, " {} {} {} {} {} {} {}", t.x, t.y, t.z, q.i, q.j, q.k, q.w)
}

/// Words of a line.
#[derive(Clone)]
struct Fields<'a>(&'a [u8]);

impl<'a> Iterator for Fields<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let line = self.0.trim_ascii_start();
        let end = line.iter().position(u8::is_ascii_whitespace).unwrap_or(line.len());
        let (word, rest) = line.split_at(end);
        self.0 = rest;
        (!word.is_empty()).then_some(word)
    }
}

fn vertex(mut fields: Fields<'_>) -> Result<(u64, Isometry3<f64>), Problem> {
    check_count(VERTEX, &fields, 8)?;
    let id = integer(fields.next().unwrap_or_default())?;
    Ok((id, pose(&numbers(&mut fields)?)?))
}

type Edge = (u64, u64, Isometry3<f64>, Matrix6<f64>);

fn edge(mut fields: Fields<'_>) -> Result<Edge, Problem> {
    check_count(EDGE, &fields, 30)?;
    let from = integer(fields.next().unwrap_or_default())?;
    let to = integer(fields.next().unwrap_or_default())?;
    if from == to {
        return Err(Problem::SelfEdge(from));
    }
    let measured = pose(&numbers(&mut fields)?)?;
    // Before row r of the triangle there are 6 + 5 + ... values in r rows, and its own begin at column r.
    let triangle = numbers::<21>(&mut fields)?;
    let information = Matrix6::from_fn(|i, j| {
        let (row, column) = (i.min(j), i.max(j));
        triangle.get(row * (11 - row) / 2 + column).copied().unwrap_or_default()
    });
    if !is_information(&information) {
        return Err(Problem::Information);
    }
    Ok((from, to, measured, information))
}

fn check_count(record: &'static str, fields: &Fields<'_>, expected: usize) -> Result<(), Problem> {
    let got = fields.clone().count();
    if got == expected { Ok(()) } else { Err(Problem::FieldCount { record, got, expected }) }
}

fn numbers<const N: usize>(fields: &mut Fields<'_>) -> Result<[f64; N], Problem> {
    let mut values = [0.0; N];
    for (value, field) in values.iter_mut().zip(fields) {
        let parsed = std::str::from_utf8(field).ok().and_then(|s| s.parse::<f64>().ok());
        *value = parsed.filter(|x| x.is_finite()).ok_or_else(|| Problem::Value(excerpt(field)))?;
    }
    Ok(values)
}

fn integer(field: &[u8]) -> Result<u64, Problem> {
    let parsed = std::str::from_utf8(field).ok().and_then(|s| s.parse().ok());
    parsed.ok_or_else(|| Problem::Value(excerpt(field)))
}

fn pose(values: &[f64; 7]) -> Result<Isometry3<f64>, Problem> {
    let [x, y, z, qx, qy, qz, qw] = *values;
    // Scaled first: the square of a huge length overflows.
    let largest = [qx, qy, qz, qw].iter().fold(0.0f64, |a, b| a.max(b.abs()));
    if largest == 0.0 {
        return Err(Problem::ZeroQuaternion);
    }
    let q = Quaternion::new(qw, qx, qy, qz);
    let rotation = if (q.norm_squared() - 1.0).abs() < 1e-14 {
        // What `write` wrote comes back bit for bit.
        UnitQuaternion::new_unchecked(q)
    } else {
        UnitQuaternion::new_normalize(Quaternion::from(q.coords.map(|c| c / largest)))
    };
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
}

/// The beginning of a field, for messages.
fn excerpt(field: &[u8]) -> String {
    String::from_utf8_lossy(field.get(..40).unwrap_or(field)).into_owned()
}
