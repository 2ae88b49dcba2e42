//! The mesh files that datasets come with: PLY, OBJ and lists of points.

use std::path::Path;

use crate::Error;

const MAX_BYTES: u64 = 512 << 20;
const REMEDY: &str = "download the models of this dataset again";

/// Surface of an object: vertices and triangles; colours and texture are left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ModelMesh {
    /// Positions.
    pub vertices: Vec<[f64; 3]>,
    /// Vertex numbers, each below the number of vertices; empty for a list of points.
    pub triangles: Vec<[u32; 3]>,
}

impl ModelMesh {
    /// Mean of the vertices; `None` without any.
    pub fn centroid(&self) -> Option<[f64; 3]> {
        let n = self.vertices.len() as f64;
        let mut mean = [0.0; 3];
        for vertex in &self.vertices {
            // Divided first: the sum of large numbers may overflow.
            mean.iter_mut().zip(vertex).for_each(|(mean, v)| *mean += v / n);
        }
        (!self.vertices.is_empty()).then_some(mean)
    }

    /// Reads a `.ply` (text or binary), `.obj` or `.xyz` file, in the file's units; polygons become triangles.
    ///
    /// # Errors
    /// When the file is missing, larger than 512 MiB, damaged, or without vertices.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let bytes = super::read_file(path, MAX_BYTES, REMEDY)?;
        Self::parse(&bytes).map_err(|problem| Error::new(path, problem, REMEDY))
    }

    /// Parses the bytes of such a file: a PLY by its first line, anything else as OBJ or lines of three numbers.
    ///
    /// # Errors
    /// What is wrong with the file.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mesh = if bytes.starts_with(b"ply") { parse_ply(bytes)? } else { parse_obj(bytes)? };
        if mesh.vertices.is_empty() {
            return Err("holds no vertices".into());
        }
        if mesh.vertices.iter().flatten().any(|v| !v.is_finite()) {
            return Err("holds a vertex that isn't finite".into());
        }
        let n = mesh.vertices.len();
        if mesh.triangles.iter().flatten().any(|i| *i as usize >= n) {
            return Err("has a face with a vertex that it doesn't hold".into());
        }
        Ok(mesh)
    }

    fn fan(&mut self, corners: &[u32]) {
        if let [first, rest @ ..] = corners {
            self.triangles.extend(rest.iter().zip(rest.iter().skip(1)).map(|(b, c)| [*first, *b, *c]));
        }
    }
}

fn parse_obj(bytes: &[u8]) -> Result<ModelMesh, String> {
    let mut mesh = ModelMesh::default();
    let mut corners = Vec::new();
    for line in bytes.split(|b| *b == b'\n') {
        let Ok(line) = std::str::from_utf8(line) else { continue };
        let mut words = line.split_ascii_whitespace().peekable();
        match words.peek() {
            Some(&"v") => {
                words.next();
                mesh.vertices.push(point(words).ok_or("has a vertex that isn't three numbers")?);
            }
            Some(&"f") => {
                corners.clear();
                for word in words.skip(1) {
                    let index: i64 = word.split('/').next().and_then(|w| w.parse().ok()).unwrap_or(0);
                    // Negative numbers count from the end.
                    let index = if index < 0 { mesh.vertices.len() as i64 + index } else { index - 1 };
                    corners.push(u32::try_from(index).map_err(|_| "has a face without vertex numbers")?);
                }
                mesh.fan(&corners);
            }
            Some(word) if word.parse::<f64>().is_ok() => {
                mesh.vertices.push(point(words).ok_or("has a point that isn't three numbers")?);
            }
            _ => {}
        }
    }
    Ok(mesh)
}

fn point<'a>(words: impl Iterator<Item = &'a str>) -> Option<[f64; 3]> {
    let mut p = [0.0; 3];
    let mut words = words.map_while(|w| w.parse::<f64>().ok());
    for slot in &mut p {
        *slot = words.next()?;
    }
    Some(p)
}

#[derive(Clone, Copy, PartialEq)]
enum Format {
    Text,
    Little,
    Big,
}

#[derive(Clone, Copy)]
struct Scalar {
    kind: char,
    size: usize,
}

struct Property {
    name: String,
    /// The type of the count, for lists.
    count: Option<Scalar>,
    scalar: Scalar,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

fn parse_ply(bytes: &[u8]) -> Result<ModelMesh, String> {
    let (format, elements, body) = ply_header(bytes)?;
    let mut input = Body { rest: body, format };
    let mut mesh = ModelMesh::default();
    let (mut list, mut corners) = (Vec::new(), Vec::new());
    for element in &elements {
        let axis = |p: &Property| ["x", "y", "z"].iter().position(|n| *n == p.name);
        for _ in 0..element.count {
            let mut vertex = [f64::NAN; 3];
            for property in &element.properties {
                let Some(count) = property.count else {
                    let value = input.number(property.scalar)?;
                    if let Some(v) = axis(property).and_then(|k| vertex.get_mut(k)) {
                        *v = value;
                    }
                    continue;
                };
                let count = input.number(count)? as usize;
                list.clear();
                for _ in 0..count {
                    list.push(input.number(property.scalar)?);
                }
                if element.name == "face" && property.name.starts_with("vertex_ind") {
                    corners.clear();
                    corners.extend(list.iter().map(|v| *v as u32));
                    mesh.fan(&corners);
                }
            }
            if element.name == "vertex" {
                mesh.vertices.push(vertex);
            }
        }
    }
    Ok(mesh)
}

fn ply_header(bytes: &[u8]) -> Result<(Format, Vec<Element>, &[u8]), String> {
    let mut rest = bytes;
    let (mut format, mut elements) = (None, Vec::<Element>::new());
    loop {
        let end =
            rest.iter().take(1 << 12).position(|b| *b == b'\n').ok_or("has a PLY header without an end")?;
        let (line, after) = rest.split_at(end);
        let line = String::from_utf8_lossy(line).into_owned();
        rest = after.get(1..).unwrap_or_default();
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => break,
            ["format", "ascii", ..] => format = Some(Format::Text),
            ["format", "binary_little_endian", ..] => format = Some(Format::Little),
            ["format", "binary_big_endian", ..] => format = Some(Format::Big),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| "has a PLY header with a damaged count")?;
                // Every item has a property and takes a byte at least.
                if count > bytes.len() {
                    return Err("is truncated".into());
                }
                elements.push(Element { name: (*name).into(), count, properties: Vec::new() });
            }
            ["property", kinds @ .., name] => {
                let element = elements.last_mut().ok_or("has a PLY property without an element")?;
                let (count, scalar) = match kinds {
                    ["list", count, kind] => (Some(scalar(count)?), scalar(kind)?),
                    [kind] => (None, scalar(kind)?),
                    _ => return Err("has a PLY header with a damaged property".into()),
                };
                element.properties.push(Property { name: (*name).into(), count, scalar });
            }
            _ => {}
        }
    }
    if elements.iter().any(|e| e.count > 0 && e.properties.is_empty()) {
        return Err("has a PLY element without properties".into());
    }
    Ok((format.ok_or("has a PLY header without a format")?, elements, rest))
}

fn scalar(name: &str) -> Result<Scalar, String> {
    let (kind, size) = match name {
        "char" | "int8" => ('i', 1),
        "uchar" | "uint8" => ('u', 1),
        "short" | "int16" => ('i', 2),
        "ushort" | "uint16" => ('u', 2),
        "int" | "int32" => ('i', 4),
        "uint" | "uint32" => ('u', 4),
        "float" | "float32" => ('f', 4),
        "double" | "float64" => ('f', 8),
        other => return Err(format!("has a PLY property of the unknown type \"{}\"", other.escape_debug())),
    };
    Ok(Scalar { kind, size })
}

struct Body<'a> {
    rest: &'a [u8],
    format: Format,
}

impl Body<'_> {
    fn number(&mut self, scalar: Scalar) -> Result<f64, String> {
        if self.format == Format::Text {
            let word = self.rest.trim_ascii_start();
            if word.is_empty() {
                return Err("is truncated".into());
            }
            let (word, rest) =
                word.split_at(word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len()));
            self.rest = rest;
            let number = std::str::from_utf8(word).ok().and_then(|w| w.parse().ok());
            return number.ok_or_else(|| "holds a word that isn't a number".to_owned());
        }
        let (word, rest) = self.rest.split_at_checked(scalar.size).ok_or("is truncated")?;
        self.rest = rest;
        super::pickle::decode(scalar.kind, scalar.size, self.format == Format::Big, word)
            .ok_or_else(|| "holds a number of an unknown type".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &[u8] = b"ply\nformat ascii 1.0\ncomment c\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n\
        0 0 0 255\n1 0 0 255\n1 1 0.5 0\n0 1 0 0\n4 0 1 2 3\n";

    fn binary(big: bool) -> Vec<u8> {
        let order = if big { "big" } else { "little" };
        let mut bytes = format!(
            "ply\r\nformat binary_{order}_endian 1.0\r\nelement vertex 4\nproperty double x\nproperty float y\n\
             property float z\nproperty uchar red\nelement face 1\nproperty list uchar uint vertex_index\nend_header\n"
        )
        .into_bytes();
        for v in [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.5], [0.0, 1.0, 0.0_f32]] {
            let x = f64::from(v[0]);
            bytes.extend(if big { x.to_be_bytes() } else { x.to_le_bytes() });
            for c in &v[1..] {
                bytes.extend(if big { c.to_be_bytes() } else { c.to_le_bytes() });
            }
            bytes.push(255);
        }
        bytes.push(4);
        for i in 0..4_u32 {
            bytes.extend(if big { i.to_be_bytes() } else { i.to_le_bytes() });
        }
        bytes
    }

    #[test]
    fn all_formats_hold_the_same_square() {
        let obj =
            b"mtllib a.mtl\nv 0 0 0 0.5 0.5 0.5\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\nvt 0 0\nf 1/1 2/1/1 -2 4//3\n";
        let square = ModelMesh::parse(TEXT).unwrap();
        assert_eq!(square.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(square.centroid(), Some([0.5, 0.5, 0.125]));
        for bytes in [&obj[..], &binary(false), &binary(true)] {
            assert_eq!(ModelMesh::parse(bytes).unwrap(), square);
        }
        assert_eq!(ModelMesh::parse(b"0 0 0\n1 0 0\n1 1 .5\n0 1 0").unwrap().vertices, square.vertices);
    }

    #[test]
    fn damaged_files_are_errors() {
        let huge = b"ply\nformat ascii 1.0\nelement vertex 99999999999\nend_header\n";
        for bytes in
            [&b""[..], b"ply\n", huge, b"v 1 2\n", b"v 1 2 nan\n", b"v 1 2 3\nf 1 2 3\n", b"v 1 2 3\nf a b c"]
        {
            assert!(ModelMesh::parse(bytes).is_err());
        }
        let corners =
            b"ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uint int vertex_index\n\
            end_header\n\xff\xff\xff\xff\0\0\0\0";
        for (bytes, word) in [
            (&huge[..], "truncated"),
            (corners, "truncated"),
            (b"v 1 2 3\nf 1 2 99999999999\n", "vertex"),
            (b"v 1 2 3\nf 1 4294967296 1\n", "doesn't hold"),
            (b"v 1 2 3\nf 1 -9223372036854775808 1\n", "vertex numbers"),
            (b"v 1 2 3\nf 1 0 1\n", "vertex numbers"),
        ] {
            let problem = ModelMesh::parse(bytes).unwrap_err();
            assert!(problem.contains(word), "{problem}");
        }
        // Vertices whose sum is no number any more.
        let far = ModelMesh::parse(b"v 1e308 0 0\nv 1e308 0 0\n").unwrap();
        assert_eq!(far.centroid(), Some([1e308, 0.0, 0.0]));
        for bytes in [TEXT, &binary(false)] {
            for n in 0..bytes.len() - 1 {
                let _ = ModelMesh::parse(&bytes[..n]);
            }
        }
    }

    proptest::proptest! {
        #[test]
        fn mutations_are_survived(at in 0usize..400, value: u8, big: bool) {
            let mut bytes = binary(big);
            let n = bytes.len();
            bytes[at % n] = value;
            let _ = ModelMesh::parse(&bytes);
            let mut text = TEXT.to_vec();
            let n = text.len();
            text[at % n] = value;
            let _ = ModelMesh::parse(&text);
        }
    }
}
