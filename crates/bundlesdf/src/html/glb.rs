//! A mesh with vertex colours as a binary glTF 2.0 file, for the page's viewer.

use marching_cubes::TriMesh;
use serde_json::json;

/// The file; `None` for a mesh without triangles or with indices that lead nowhere.
pub(super) fn vertex_colored_glb(mesh: &TriMesh) -> Option<Vec<u8>> {
    let count = mesh.vertices.len();
    let (low, high) = mesh.bounds()?;
    if mesh.triangles.is_empty() || mesh.triangles.iter().flatten().any(|i| *i as usize >= count) {
        return None;
    }
    let mut data = Vec::with_capacity(count * 20 + mesh.triangles.len() * 12);
    mesh.vertices.iter().flatten().for_each(|v| data.extend(v.to_le_bytes()));
    for i in 0..count {
        // glTF's vertex colours are linear light; eight bits of that would show steps in the shadows.
        let color = if mesh.has_colors() { mesh.colors[i] } else { [180; 3] };
        color.iter().for_each(|v| data.extend(((linear(*v) * 65535.0).round() as u16).to_le_bytes()));
        data.extend(u16::MAX.to_le_bytes());
    }
    mesh.triangles.iter().flatten().for_each(|i| data.extend(i.to_le_bytes()));

    let (positions, colors, faces) = (count * 12, count * 8, mesh.triangles.len() * 12);
    let document = json!({
        "asset": { "version": "2.0", "generator": "bundlesdf" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{
            "attributes": { "POSITION": 0, "COLOR_0": 1 }, "indices": 2, "material": 0,
        }] }],
        "materials": [{ "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 0.8 }, "doubleSided": true }],
        "buffers": [{ "byteLength": data.len() }],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": positions, "target": 34962 },
            { "buffer": 0, "byteOffset": positions, "byteLength": colors, "target": 34962 },
            { "buffer": 0, "byteOffset": positions + colors, "byteLength": faces, "target": 34963 },
        ],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3", "min": low, "max": high },
            { "bufferView": 1, "componentType": 5123, "normalized": true, "count": count, "type": "VEC4" },
            { "bufferView": 2, "componentType": 5125, "count": mesh.triangles.len() * 3, "type": "SCALAR" },
        ],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');

    let total = u32::try_from(12 + 8 + text.len() + 8 + data.len()).ok()?;
    let mut file = Vec::with_capacity(total as usize);
    file.extend(b"glTF");
    file.extend(2_u32.to_le_bytes());
    file.extend(total.to_le_bytes());
    for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &data)] {
        file.extend((chunk.len() as u32).to_le_bytes());
        file.extend(kind);
        file.extend(chunk);
    }
    Some(file)
}

/// sRGB to linear light (IEC 61966-2-1).
fn linear(value: u8) -> f64 {
    let v = f64::from(value) / 255.0;
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chunks_are_as_long_as_they_say() {
        let mesh = TriMesh {
            vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5]],
            triangles: vec![[0, 1, 2]],
            colors: vec![[255, 0, 128]; 3],
            ..TriMesh::default()
        };
        let file = vertex_colored_glb(&mesh).unwrap();
        let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&file[..4], number(4), number(8)), (&b"glTF"[..], 2, file.len()));
        let text = number(12);
        assert_eq!(text % 4, 0);
        let document: serde_json::Value = serde_json::from_slice(&file[20..20 + text]).unwrap();
        assert_eq!(document["accessors"][0]["max"], json!([1.0, 1.0, 0.5]));
        assert_eq!(number(20 + text), 3 * 20 + 12);
        assert_eq!(document["buffers"][0]["byteLength"], 3 * 20 + 12);
        assert_eq!(file.len(), 28 + text + 3 * 20 + 12);
    }

    #[test]
    fn what_cannot_be_shown_is_none() {
        assert_eq!(vertex_colored_glb(&TriMesh::default()), None);
        let broken = TriMesh { vertices: vec![[0.0; 3]], triangles: vec![[0, 1, 2]], ..TriMesh::default() };
        assert_eq!(vertex_colored_glb(&broken), None);
    }
}
