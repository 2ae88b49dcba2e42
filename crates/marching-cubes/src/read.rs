//! PLY files, read from bytes.

use crate::TriMesh;

/// What is wrong with a PLY file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlyError(String);

impl std::fmt::Display for PlyError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for PlyError {}

/// A scalar type of a PLY file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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

enum Property {
    Scalar(Scalar, String),
    List(Scalar, Scalar, String),
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

/// Reads binary little-endian PLY as [`crate::write_ply`] and most programs write it: positions, normals and colours
/// where they are complete, and faces (polygons are cut into fans). Everything else in the file is skipped.
///
/// # Errors
/// When it is no such file, is truncated, or a face names a vertex that doesn't exist.
pub fn read_ply(bytes: &[u8]) -> Result<TriMesh, PlyError> {
    let (elements, mut data) = header(bytes)?;
    let mut mesh = TriMesh::default();
    // An element without properties has no bytes.
    for element in elements.iter().filter(|e| !e.properties.is_empty()) {
        match element.name.as_str() {
            "vertex" => vertices(element, &mut data, &mut mesh)?,
            "face" => faces(element, &mut data, &mut mesh)?,
            _ => {
                for _ in 0..element.count {
                    row(element, &mut data, |_, _| ())?;
                }
            }
        }
    }
    let count = mesh.vertices.len();
    match mesh.triangles.as_flattened().iter().find(|&&i| i as usize >= count) {
        Some(i) => Err(PlyError(format!("a face names vertex {i} of {count}"))),
        None => Ok(mesh),
    }
}

fn header(bytes: &[u8]) -> Result<(Vec<Element>, &[u8]), PlyError> {
    let wrong = |text: &str| PlyError(text.to_owned());
    let mut rest = bytes;
    let mut lines = std::iter::from_fn(|| {
        let end = rest.iter().position(|&b| b == b'\n')?;
        let line = std::str::from_utf8(&rest[..end]).ok()?.trim();
        rest = &rest[end + 1..];
        Some(line)
    });
    if lines.next() != Some("ply") {
        return Err(wrong("isn't a PLY file"));
    }
    let mut elements: Vec<Element> = Vec::new();
    let mut ended = false;
    for line in lines.by_ref() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => {
                ended = true;
                break;
            }
            ["format", "binary_little_endian", ..] | ["comment" | "obj_info", ..] | [] => {}
            ["format", other, ..] => {
                return Err(PlyError(format!("is {other} PLY; save it as binary little-endian")));
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| wrong("has an element without a count"))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", kinds @ .., name] => {
                let property = match kinds {
                    ["list", count, item] => scalar(count)
                        .zip(scalar(item))
                        .map(|(count, item)| Property::List(count, item, (*name).to_owned())),
                    [kind] => scalar(kind).map(|kind| Property::Scalar(kind, (*name).to_owned())),
                    _ => None,
                };
                let element = elements.last_mut().ok_or_else(|| wrong("has a property of no element"))?;
                let property =
                    property.ok_or_else(|| PlyError(format!("has an unknown property: {line}")))?;
                element.properties.push(property);
            }
            _ => return Err(PlyError(format!("has an unknown line in its header: {line}"))),
        }
    }
    if ended { Ok((elements, rest)) } else { Err(wrong("has no end of its header")) }
}

fn scalar(name: &str) -> Option<Scalar> {
    Some(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        _ => return None,
    })
}

fn take<const N: usize>(data: &mut &[u8]) -> Result<[u8; N], PlyError> {
    let (head, rest) = data.split_first_chunk::<N>().ok_or_else(|| PlyError("is truncated".to_owned()))?;
    *data = rest;
    Ok(*head)
}

fn value(kind: Scalar, data: &mut &[u8]) -> Result<f64, PlyError> {
    Ok(match kind {
        Scalar::I8 => f64::from(i8::from_le_bytes(take(data)?)),
        Scalar::U8 => f64::from(u8::from_le_bytes(take(data)?)),
        Scalar::I16 => f64::from(i16::from_le_bytes(take(data)?)),
        Scalar::U16 => f64::from(u16::from_le_bytes(take(data)?)),
        Scalar::I32 => f64::from(i32::from_le_bytes(take(data)?)),
        Scalar::U32 => f64::from(u32::from_le_bytes(take(data)?)),
        Scalar::F32 => f64::from(f32::from_le_bytes(take(data)?)),
        Scalar::F64 => f64::from_le_bytes(take(data)?),
    })
}

/// Reads one row; `seen` gets each property's name and values.
fn row(element: &Element, data: &mut &[u8], mut seen: impl FnMut(&str, &[f64])) -> Result<(), PlyError> {
    let mut list = Vec::new();
    for property in &element.properties {
        match property {
            Property::Scalar(kind, name) => seen(name, &[value(*kind, data)?]),
            Property::List(count, item, name) => {
                let count = value(*count, data)?;
                list.clear();
                for _ in 0..count as usize {
                    list.push(value(*item, data)?);
                }
                seen(name, &list);
            }
        }
    }
    Ok(())
}

fn vertices(element: &Element, data: &mut &[u8], mesh: &mut TriMesh) -> Result<(), PlyError> {
    const NAMES: [&str; 9] = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"];
    let mut has = [false; 9];
    for property in &element.properties {
        if let Property::Scalar(_, name) = property
            && let Some(k) = NAMES.iter().position(|n| n == name)
        {
            has[k] = true;
        }
    }
    if has[..3] != [true; 3] {
        return Err(PlyError("has vertices without x, y and z".to_owned()));
    }
    for _ in 0..element.count {
        let mut v = [0.0; 9];
        row(element, data, |name, values| {
            if let (Some(k), [value]) = (NAMES.iter().position(|n| *n == name), values) {
                v[k] = *value;
            }
        })?;
        mesh.vertices.push([v[0] as f32, v[1] as f32, v[2] as f32]);
        if has[3..6] == [true; 3] {
            mesh.normals.push([v[3] as f32, v[4] as f32, v[5] as f32]);
        }
        if has[6..] == [true; 3] {
            mesh.colors.push([v[6] as u8, v[7] as u8, v[8] as u8]);
        }
    }
    Ok(())
}

fn faces(element: &Element, data: &mut &[u8], mesh: &mut TriMesh) -> Result<(), PlyError> {
    for _ in 0..element.count {
        row(element, data, |name, corners| {
            if name == "vertex_indices" || name == "vertex_index" {
                for k in 2..corners.len() {
                    // A negative number saturates to 0 and a large one stays too large.
                    mesh.triangles.push([corners[0], corners[k - 1], corners[k]].map(|v| v as u32));
                }
            }
        })?;
    }
    Ok(())
}
