//! Wavefront OBJ with texture coordinates, and its material.

use std::fmt::Write;

use marching_cubes::TriMesh;

use crate::texture::TexturedMesh;

/// `.obj` text that names the material `object` of `material_file`.
pub(super) fn textured(mesh: &TexturedMesh, material_file: &str) -> String {
    let mut text = format!("mtllib {material_file}\no object\n");
    for [x, y, z] in &mesh.positions {
        let _ = writeln!(text, "v {x} {y} {z}");
    }
    // OBJ counts from the lower left corner of the image.
    for [u, v] in &mesh.uvs {
        let _ = writeln!(text, "vt {u} {}", 1.0 - v);
    }
    for [x, y, z] in &mesh.normals {
        let _ = writeln!(text, "vn {x} {y} {z}");
    }
    text.push_str("usemtl object\n");
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|i| u64::from(i) + 1);
        let _ = writeln!(text, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}");
    }
    text
}

/// `.mtl` text for a matt surface with the texture `image`.
pub(super) fn material(image: &str) -> String {
    format!("newmtl object\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {image}\n")
}

/// `.obj` text of bare triangles, for collision shapes.
#[cfg_attr(not(feature = "sim"), allow(dead_code))]
pub(super) fn plain(mesh: &TriMesh) -> String {
    let mut text = String::new();
    for [x, y, z] in &mesh.vertices {
        let _ = writeln!(text, "v {x} {y} {z}");
    }
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|i| u64::from(i) + 1);
        let _ = writeln!(text, "f {a} {b} {c}");
    }
    text
}
