//! A reader for the PLY meshes that reconstructions come in.

use anyhow::{Context, bail};
use eval_metrics::MeshRef;
use std::path::Path;

/// A triangle mesh, metres.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Mesh {
    pub(super) vertices: Vec<[f64; 3]>,
    pub(super) triangles: Vec<[u32; 3]>,
}

impl Mesh {
    pub(super) fn by_ref(&self) -> MeshRef<'_> {
        MeshRef::new(&self.vertices, &self.triangles)
    }
}

/// Reads `x y z` and the faces of an ASCII or little-endian PLY file; other properties are skipped.
pub(super) fn read(path: &Path) -> anyhow::Result<Mesh> {
    let bytes = std::fs::read(path).with_context(|| format!("{} can't be read", path.display()))?;
    parse(&bytes).with_context(|| format!("{} isn't a usable PLY file", path.display()))
}

#[derive(Clone, Copy)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

enum Kind {
    One(Scalar),
    List { length: Scalar, item: Scalar },
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<(String, Kind)>,
}

fn scalar(name: &str) -> anyhow::Result<Scalar> {
    Ok(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        other => bail!("property type {other} is unknown"),
    })
}

/// The values after the header, one at a time. `f64` holds every scalar of the format exactly.
enum Values<'a> {
    Ascii(std::str::SplitAsciiWhitespace<'a>),
    Binary(&'a [u8]),
}

impl Values<'_> {
    fn next(&mut self, kind: Scalar) -> anyhow::Result<f64> {
        const SHORT: &str = "the file ends before the last element";
        match self {
            Self::Ascii(words) => Ok(words.next().context(SHORT)?.parse()?),
            Self::Binary(bytes) => {
                fn take<const N: usize>(bytes: &mut &[u8]) -> anyhow::Result<[u8; N]> {
                    let (head, rest) = bytes.split_first_chunk::<N>().context(SHORT)?;
                    *bytes = rest;
                    Ok(*head)
                }
                Ok(match kind {
                    Scalar::I8 => f64::from(i8::from_le_bytes(take(bytes)?)),
                    Scalar::U8 => f64::from(u8::from_le_bytes(take(bytes)?)),
                    Scalar::I16 => f64::from(i16::from_le_bytes(take(bytes)?)),
                    Scalar::U16 => f64::from(u16::from_le_bytes(take(bytes)?)),
                    Scalar::I32 => f64::from(i32::from_le_bytes(take(bytes)?)),
                    Scalar::U32 => f64::from(u32::from_le_bytes(take(bytes)?)),
                    Scalar::F32 => f64::from(f32::from_le_bytes(take(bytes)?)),
                    Scalar::F64 => f64::from_le_bytes(take(bytes)?),
                })
            }
        }
    }
}

fn parse(bytes: &[u8]) -> anyhow::Result<Mesh> {
    const END: &[u8] = b"end_header";
    let end = bytes.windows(END.len()).position(|w| w == END).context("it has no end_header")?;
    let header = std::str::from_utf8(&bytes[..end])?;
    let body = &bytes[end + END.len()..];
    let body = body.strip_prefix(b"\r").unwrap_or(body);
    let body = body.strip_prefix(b"\n").unwrap_or(body);
    let (binary, elements) = parse_header(header)?;
    let mut values = if binary {
        Values::Binary(body)
    } else {
        Values::Ascii(std::str::from_utf8(body)?.split_ascii_whitespace())
    };

    let mut mesh = Mesh::default();
    for element in &elements {
        for _ in 0..element.count {
            read_element(element, &mut values, &mut mesh)?;
        }
    }
    anyhow::ensure!(
        mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.vertices.len()),
        "a face names a vertex that doesn't exist"
    );
    Ok(mesh)
}

fn parse_header(header: &str) -> anyhow::Result<(bool, Vec<Element>)> {
    let mut lines = header.lines().map(str::trim);
    anyhow::ensure!(lines.next() == Some("ply"), "it doesn't start with ply");
    let (mut binary, mut elements) = (None, Vec::<Element>::new());
    for line in lines {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["format", "ascii", _] => binary = Some(false),
            ["format", "binary_little_endian", _] => binary = Some(true),
            ["format", other, ..] => bail!("format {other} isn't supported"),
            ["element", name, count] => elements.push(Element {
                name: (*name).to_owned(),
                count: count.parse().context("an element count isn't a number")?,
                properties: Vec::new(),
            }),
            ["property", "list", length, item, name] => elements
                .last_mut()
                .context("a property comes before the first element")?
                .properties
                .push(((*name).to_owned(), Kind::List { length: scalar(length)?, item: scalar(item)? })),
            ["property", kind, name] => elements
                .last_mut()
                .context("a property comes before the first element")?
                .properties
                .push(((*name).to_owned(), Kind::One(scalar(kind)?))),
            [] | ["comment" | "obj_info", ..] => {}
            _ => bail!("header line {line:?} isn't understood"),
        }
    }
    // An element without properties takes no bytes, and its count could be anything.
    elements.retain(|element| !element.properties.is_empty());
    Ok((binary.context("it has no format line")?, elements))
}

fn read_element(element: &Element, values: &mut Values<'_>, mesh: &mut Mesh) -> anyhow::Result<()> {
    let mut position = [f64::NAN; 3];
    for (name, kind) in &element.properties {
        match kind {
            Kind::One(kind) => {
                let value = values.next(*kind)?;
                if let Some(axis) = ["x", "y", "z"].iter().position(|a| a == name) {
                    position[axis] = value;
                }
            }
            Kind::List { length, item } => {
                let is_face =
                    element.name == "face" && ["vertex_indices", "vertex_index"].contains(&name.as_str());
                let length = values.next(*length)?;
                let (mut first, mut previous) = (None, None);
                let mut i = 0.0;
                while i < length {
                    let value = values.next(*item)?;
                    i += 1.0;
                    if !is_face {
                        continue;
                    }
                    anyhow::ensure!(
                        (0.0..4_294_967_296.0).contains(&value),
                        "a face has an index of {value}"
                    );
                    let index = value as u32;
                    // A polygon is a fan around its first corner.
                    match (first, previous) {
                        (None, _) => first = Some(index),
                        (Some(_), None) => previous = Some(index),
                        (Some(a), Some(b)) => {
                            mesh.triangles.push([a, b, index]);
                            previous = Some(index);
                        }
                    }
                }
            }
        }
    }
    if element.name == "vertex" {
        mesh.vertices.push(position);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expected() -> Mesh {
        Mesh {
            vertices: vec![[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 1.0, 0.0], [0.0, 1.0, -0.25]],
            triangles: vec![[0, 1, 2], [0, 2, 3], [3, 1, 0]],
        }
    }

    #[test]
    fn ascii_with_polygons_and_extra_properties() {
        let text = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 4\nproperty float x\nproperty float y\n\
            property float z\nproperty uchar red\nelement face 2\nproperty list uchar int vertex_index\nend_header\n\
            0 0 0 1\n1.5 0 0 2\n1.5 1 0 3\n0 1 -0.25 4\n4 0 1 2 3\n3 3 1 0\n";
        assert_eq!(parse(text.as_bytes()).unwrap(), expected());
    }

    #[test]
    fn binary_with_normals_and_colours() {
        let mut bytes =
            b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
            property float z\nproperty float nx\nproperty uchar red\nproperty uchar green\nelement face 3\n\
            property uchar flags\nproperty list uchar uint vertex_indices\nend_header\n"
                .to_vec();
        for v in expected().vertices {
            v.iter().for_each(|c| bytes.extend((*c as f32).to_le_bytes()));
            bytes.extend(7f32.to_le_bytes());
            bytes.extend([1, 2]);
        }
        for t in expected().triangles {
            bytes.extend([9, 3]);
            t.iter().for_each(|i| bytes.extend(i.to_le_bytes()));
        }
        assert_eq!(parse(&bytes).unwrap(), expected());
        // Every truncation is an error, none a panic.
        for end in 0..bytes.len() {
            assert!(parse(&bytes[..end]).is_err());
        }
    }

    #[test]
    fn broken_files_are_errors() {
        let head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nelement face 1\n\
            property list uchar int vertex_indices\nend_header\n";
        for body in ["0 3 0 0 7", "0 3 0 0 -1", "zero", ""] {
            assert!(parse(format!("{head}{body}").as_bytes()).is_err(), "{body}");
        }
        let endless = "ply\nformat ascii 1.0\nelement nothing 18446744073709551615\nend_header\n";
        assert_eq!(parse(endless.as_bytes()).unwrap(), Mesh::default());
        assert!(parse(b"ply\nformat binary_big_endian 1.0\nend_header\n").is_err());
    }
}
