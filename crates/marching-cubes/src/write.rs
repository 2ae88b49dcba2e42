//! Mesh files, written to any `std::io::Write`.

use crate::TriMesh;
use crate::mesh::{double_area_normal, norm};
use std::io::{Error, ErrorKind, Result, Write};

/// Writes binary little-endian PLY: `x y z`, then `nx ny nz` and `red green blue` when the mesh has them, and faces as
/// `property list uchar int vertex_indices`. Pass a buffered writer or a `Vec`.
///
/// # Errors
/// From the writer, and `InvalidInput` when a triangle names a missing vertex (nothing is written then).
pub fn write_ply(mesh: &TriMesh, out: &mut impl Write) -> Result<()> {
    write_ply_with(mesh, &[], out)
}

/// [`write_ply`] with further `float` properties of the vertices: their names, and a value per vertex each.
///
/// # Errors
/// As [`write_ply`], and when a property hasn't one value per vertex or its name isn't one word.
pub fn write_ply_with(mesh: &TriMesh, extra: &[(&str, &[f32])], out: &mut impl Write) -> Result<()> {
    check(mesh)?;
    for (name, values) in extra {
        let word = !name.is_empty() && name.chars().all(|c| c.is_ascii_graphic());
        if !word || values.len() != mesh.vertices.len() {
            return Err(Error::new(
                ErrorKind::InvalidInput,
                format!("property {name:?} has {} values for {} vertices", values.len(), mesh.vertices.len()),
            ));
        }
    }
    let (normals, colors) = (mesh.has_normals(), mesh.has_colors());
    let mut header =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", mesh.vertices.len());
    let properties = |kind: &str, names: &[&str]| -> String {
        names.iter().map(|name| format!("property {kind} {name}\n")).collect()
    };
    header += &properties("float", &["x", "y", "z"]);
    if normals {
        header += &properties("float", &["nx", "ny", "nz"]);
    }
    if colors {
        header += &properties("uchar", &["red", "green", "blue"]);
    }
    extra.iter().for_each(|(name, _)| header += &properties("float", &[name]));
    header += &format!(
        "element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.triangles.len()
    );
    out.write_all(header.as_bytes())?;

    let mut row = Vec::with_capacity(27);
    for (i, p) in mesh.vertices.iter().enumerate() {
        row.clear();
        p.iter().for_each(|v| row.extend(v.to_le_bytes()));
        if normals {
            mesh.normals[i].iter().for_each(|v| row.extend(v.to_le_bytes()));
        }
        if colors {
            row.extend(mesh.colors[i]);
        }
        extra.iter().for_each(|(_, values)| row.extend(values[i].to_le_bytes()));
        out.write_all(&row)?;
    }
    for t in &mesh.triangles {
        row.clear();
        row.push(3);
        t.iter().for_each(|i| row.extend(i.to_le_bytes()));
        out.write_all(&row)?;
    }
    Ok(())
}

/// Writes Wavefront OBJ: `v x y z`, with `r g b` from 0 to 1 behind it when the mesh has colours (an extension that
/// most viewers read), `vn` when it has normals, and faces `f a b c` or `f a//a b//b c//c`.
///
/// # Errors
/// From the writer, and `InvalidInput` when a triangle names a missing vertex (nothing is written then).
pub fn write_obj(mesh: &TriMesh, out: &mut impl Write) -> Result<()> {
    check(mesh)?;
    let (normals, colors) = (mesh.has_normals(), mesh.has_colors());
    for (i, [x, y, z]) in mesh.vertices.iter().enumerate() {
        if colors {
            let [r, g, b] = mesh.colors[i].map(|c| f32::from(c) / 255.0);
            writeln!(out, "v {x} {y} {z} {r} {g} {b}")?;
        } else {
            writeln!(out, "v {x} {y} {z}")?;
        }
    }
    if normals {
        for [x, y, z] in &mesh.normals {
            writeln!(out, "vn {x} {y} {z}")?;
        }
    }
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|i| u64::from(i) + 1);
        if normals {
            writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
        } else {
            writeln!(out, "f {a} {b} {c}")?;
        }
    }
    Ok(())
}

/// Writes binary STL: triangles with their normals; nothing of colour or of shared vertices survives in this format.
///
/// # Errors
/// From the writer, and `InvalidInput` when a triangle names a missing vertex (nothing is written then).
pub fn write_stl(mesh: &TriMesh, out: &mut impl Write) -> Result<()> {
    check(mesh)?;
    // Readers take a file whose header starts with "solid" for text.
    let mut bytes = b"binary STL".to_vec();
    bytes.resize(80, b' ');
    let count = u32::try_from(mesh.triangles.len())
        .map_err(|_| Error::new(ErrorKind::InvalidInput, "more triangles than an STL file can count"))?;
    bytes.extend(count.to_le_bytes());
    for t in &mesh.triangles {
        let corners = t.map(|i| mesh.vertices[i as usize]);
        let n = double_area_normal(&corners.map(|c| c.map(f64::from)));
        let length = norm(n);
        let n = if length > 0.0 { n.map(|v| (v / length) as f32) } else { [0.0; 3] };
        for v in n.iter().chain(corners.as_flattened()) {
            bytes.extend(v.to_le_bytes());
        }
        bytes.extend([0, 0]);
    }
    out.write_all(&bytes)
}

fn check(mesh: &TriMesh) -> Result<()> {
    // PLY's `int` is signed.
    let limit = mesh.vertices.len().min(i32::MAX as usize);
    match mesh.triangles.as_flattened().iter().find(|&&i| i as usize >= limit) {
        Some(i) => Err(Error::new(
            ErrorKind::InvalidInput,
            format!(
                "a triangle names vertex {i} of {limit}; call drop_unused_vertices to remove such triangles"
            ),
        )),
        None => Ok(()),
    }
}
