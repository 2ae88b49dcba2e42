//! Mesh files, written to any `std::io::Write`.

use crate::TriMesh;
use std::io::{Error, ErrorKind, Result, Write};

/// Writes binary little-endian PLY: `x y z`, then `nx ny nz` and `red green blue` when the mesh has them, and faces as
/// `property list uchar int vertex_indices`. Pass a buffered writer or a `Vec`.
///
/// # Errors
/// From the writer, and `InvalidInput` when a triangle names a missing vertex (nothing is written then).
pub fn write_ply(mesh: &TriMesh, out: &mut impl Write) -> Result<()> {
    check(mesh)?;
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
