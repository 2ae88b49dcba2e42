//! Binary glTF 2.0 (Khronos, ISO/IEC 12113).

use serde_json::{Value, json};

use super::{Asset, write::encoded};

const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const VERTICES: u32 = 34962;
const INDICES: u32 = 34963;
/// Quality of the JPEG inside: at 92 its error is below that of the camera's noise.
const JPEG_QUALITY: u8 = 92;

/// The asset as a `.glb` file: positions, normals, texture coordinates and a JPEG texture, or vertex colours without a
/// texture. Coordinates in the file are those of the asset's frame, metres; the node's rotation makes it stand
/// upright in glTF's y-up world: canonical z, or the first camera's "up", points up.
///
/// # Errors
/// When the texture can't be encoded; the text says why.
pub fn glb(asset: &Asset) -> Result<Vec<u8>, String> {
    let mut file = Buffers::default();
    let mut attributes = serde_json::Map::new();
    let mut material = json!({
        "name": "object",
        "doubleSided": !asset.mesh.is_watertight(),
        "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 0.9 },
    });
    let (positions, normals, triangles) = match &asset.textured {
        Some(t) => (&t.positions, &t.normals, &t.triangles),
        None => (&asset.mesh.vertices, &asset.mesh.normals, &asset.mesh.triangles),
    };
    attributes.insert("POSITION".into(), file.vectors(positions, true));
    attributes.insert("NORMAL".into(), file.vectors(&units(normals), false));
    let mut root = json!({
        "asset": { "version": "2.0", "generator": concat!("bundlesdf ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
    });
    if let Some(t) = &asset.textured {
        attributes.insert("TEXCOORD_0".into(), file.vectors(&t.uvs, false));
        material["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": 0 });
        let image = file.view(&encoded(&t.texture, Some(JPEG_QUALITY))?, None);
        root["images"] = json!([{ "bufferView": image, "mimeType": "image/jpeg", "name": "texture" }]);
        // Linear with mipmaps, clamped at the border.
        root["samplers"] = json!([{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }]);
        root["textures"] = json!([{ "sampler": 0, "source": 0 }]);
    } else if asset.mesh.has_colors() {
        let colors: Vec<[f32; 3]> = asset.mesh.colors.iter().map(|c| c.map(linear)).collect();
        attributes.insert("COLOR_0".into(), file.vectors(&colors, false));
    }
    let indices = file.indices(triangles);
    root["materials"] = json!([material]);
    root["meshes"] = json!([{
        "name": "object",
        "primitives": [{ "attributes": attributes, "indices": indices, "material": 0, "mode": 4 }],
    }]);
    root["nodes"] = json!([node(asset)]);
    root["accessors"] = Value::Array(file.accessors);
    root["bufferViews"] = Value::Array(file.views);
    root["buffers"] = json!([{ "byteLength": file.bytes.len() }]);
    container(&root, &file.bytes)
}

/// The node that turns the asset's frame upright.
fn node(asset: &Asset) -> Value {
    let half = std::f64::consts::FRAC_1_SQRT_2;
    match asset.canonical {
        Some(_) => json!({
            "name": "object", "mesh": 0, "rotation": [-half, 0.0, 0.0, half],
            "extras": { "frame": "canonical", "units": "metre" },
        }),
        // y is down and z away from the first camera: half a turn about x.
        None => json!({
            "name": "object", "mesh": 0, "rotation": [1.0, 0.0, 0.0, 0.0],
            "extras": { "frame": "object", "units": "metre" },
        }),
    }
}

/// sRGB to linear light (IEC 61966-2-1).
fn linear(v: u8) -> f32 {
    let v = f32::from(v) / 255.0;
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// The normals; glTF allows none without direction.
fn units(normals: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let unit = |n: &[f32; 3]| {
        let length = n.iter().map(|v| v * v).sum::<f32>().sqrt();
        if length > 0.5 { n.map(|v| v / length) } else { [0.0, 0.0, 1.0] }
    };
    normals.iter().map(unit).collect()
}

/// The binary part as it grows, and what describes it.
#[derive(Default)]
struct Buffers {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Buffers {
    fn view(&mut self, data: &[u8], target: Option<u32>) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let mut view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": data.len() });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.bytes.extend_from_slice(data);
        self.views.push(view);
        self.views.len() - 1
    }

    fn vectors<const N: usize>(&mut self, values: &[[f32; N]], bounds: bool) -> Value {
        let data: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.view(&data, Some(VERTICES));
        let mut accessor = json!({
            "bufferView": view, "componentType": FLOAT, "count": values.len(), "type": format!("VEC{N}"),
        });
        if bounds {
            let (mut low, mut high) = ([f32::INFINITY; N], [f32::NEG_INFINITY; N]);
            for v in values {
                low = std::array::from_fn(|k| low[k].min(v[k]));
                high = std::array::from_fn(|k| high[k].max(v[k]));
            }
            accessor["min"] = json!(low.as_slice());
            accessor["max"] = json!(high.as_slice());
        }
        self.accessors.push(accessor);
        json!(self.accessors.len() - 1)
    }

    fn indices(&mut self, triangles: &[[u32; 3]]) -> Value {
        let data: Vec<u8> = triangles.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.view(&data, Some(INDICES));
        self.accessors.push(json!({
            "bufferView": view, "componentType": UNSIGNED_INT, "count": 3 * triangles.len(), "type": "SCALAR",
        }));
        json!(self.accessors.len() - 1)
    }
}

/// Header, JSON chunk (padded with spaces) and binary chunk (padded with zeros).
fn container(root: &Value, binary: &[u8]) -> Result<Vec<u8>, String> {
    let mut text = serde_json::to_vec(root).map_err(|e| e.to_string())?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let padded = binary.len().next_multiple_of(4);
    let total = 12 + 8 + text.len() + 8 + padded;
    let length =
        |n: usize| u32::try_from(n).map(u32::to_le_bytes).map_err(|_| "is too large for GLB".to_owned());
    let mut out = Vec::with_capacity(total);
    out.extend(b"glTF");
    out.extend(2u32.to_le_bytes());
    out.extend(length(total)?);
    out.extend(length(text.len())?);
    out.extend(b"JSON");
    out.extend(text);
    out.extend(length(padded)?);
    out.extend(b"BIN\0");
    out.extend_from_slice(binary);
    out.resize(total, 0);
    Ok(out)
}
