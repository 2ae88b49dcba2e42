//! Bodies for physics simulators: URDF, MJCF and convex collision hulls.

use std::fmt::Write;

use marching_cubes::{TriMesh, write_obj};
use parry3d::{
    math::Vector,
    transformation::{
        try_convex_hull,
        vhacd::{VHACD, VHACDParameters},
    },
};

use super::{Asset, ExportError, MassProperties, mass_properties, obj, write::encoded};

/// Most convex parts of the decomposition.
const MOST_HULLS: u32 = 16;
/// Faces of the mesh that is decomposed; a hull needs no more.
const FACES: usize = 6000;
/// Most corners of a hull: the points farthest out in as many directions.
const CORNERS: usize = 64;

/// A body in numbers.
pub(super) struct Body {
    pub(super) mass: MassProperties,
    /// Convex, closed, in the asset's frame.
    pub(super) hulls: Vec<TriMesh>,
}

impl Body {
    /// Closes the asset's mesh, weighs it and decomposes it.
    pub(super) fn of(asset: &Asset, density: f64) -> Result<Self, ExportError> {
        let closed = asset.mesh.closed();
        let mass = mass_properties(&closed, density).ok_or(ExportError::NoVolume)?;
        let mut hulls = decompose(&closed.simplified(FACES));
        if hulls.is_empty() {
            hulls.extend(hull(&closed.vertices));
        }
        if hulls.is_empty() {
            return Err(ExportError::NoVolume);
        }
        Ok(Self { mass, hulls })
    }

    /// Name and content of every file, in the order in which to write them.
    pub(super) fn files(&self, asset: &Asset) -> Result<Vec<(String, Vec<u8>)>, ExportError> {
        let mut files: Vec<(String, Vec<u8>)> = Vec::new();
        match &asset.textured {
            Some(t) => {
                let png = encoded(&t.texture, None);
                let png =
                    png.map_err(|e| rgbd_io::Error::new("sim/texture.png", e, "report this as a bug"))?;
                files.push(("texture.png".into(), png));
                files.push(("visual.mtl".into(), obj::material("texture.png").into_bytes()));
                files.push(("visual.obj".into(), obj::textured(t, "visual.mtl").into_bytes()));
            }
            None => {
                let mut bytes = Vec::new();
                // Readers that know no vertex colours take the rest of the line for something else.
                let mesh = TriMesh { colors: Vec::new(), ..asset.mesh.clone() };
                write_obj(&mesh, &mut bytes).map_err(|e| {
                    rgbd_io::Error::new("sim/visual.obj", e.to_string(), "report this as a bug")
                })?;
                files.push(("visual.obj".into(), bytes));
            }
        }
        for (i, hull) in self.hulls.iter().enumerate() {
            files.push((hull_name(i), obj::plain(hull).into_bytes()));
        }
        files.push(("object.urdf".into(), self.urdf().into_bytes()));
        files.push(("object.xml".into(), self.mjcf(asset.textured.is_some()).into_bytes()));
        Ok(files)
    }

    fn urdf(&self) -> String {
        let MassProperties { mass_kg, center_of_mass_m: [x, y, z], inertia_kg_m2: i, .. } = self.mass;
        let mut text = format!(
            "<?xml version=\"1.0\"?>\n<robot name=\"object\">\n  <link name=\"object\">\n    <inertial>\n      \
             <origin xyz=\"{x} {y} {z}\" rpy=\"0 0 0\"/>\n      <mass value=\"{mass_kg}\"/>\n      \
             <inertia ixx=\"{}\" ixy=\"{}\" ixz=\"{}\" iyy=\"{}\" iyz=\"{}\" izz=\"{}\"/>\n    </inertial>\n    \
             <visual>\n      <geometry><mesh filename=\"visual.obj\"/></geometry>\n    </visual>\n",
            i[0][0], i[0][1], i[0][2], i[1][1], i[1][2], i[2][2]
        );
        for h in 0..self.hulls.len() {
            let _ = writeln!(
                text,
                "    <collision>\n      <geometry><mesh filename=\"{}\"/></geometry>\n    </collision>",
                hull_name(h)
            );
        }
        text + "  </link>\n</robot>\n"
    }

    fn mjcf(&self, has_texture: bool) -> String {
        let MassProperties { mass_kg, center_of_mass_m: [x, y, z], inertia_kg_m2: i, .. } = self.mass;
        let mut text = String::from("<mujoco model=\"object\">\n  <asset>\n");
        if has_texture {
            text += "    <texture name=\"object\" type=\"2d\" file=\"texture.png\"/>\n    \
                     <material name=\"object\" texture=\"object\" specular=\"0.1\" shininess=\"0.1\"/>\n";
        }
        // What is seen has no mass of its own and may be open.
        text += "    <mesh name=\"visual\" file=\"visual.obj\" inertia=\"shell\"/>\n";
        for h in 0..self.hulls.len() {
            let _ = writeln!(
                text,
                "    <mesh name=\"hull_{h:02}\" file=\"{}\" inertia=\"convex\"/>",
                hull_name(h)
            );
        }
        let _ = write!(
            text,
            "  </asset>\n  <worldbody>\n    <body name=\"object\">\n      <freejoint/>\n      <inertial \
             pos=\"{x} {y} {z}\" mass=\"{mass_kg}\" fullinertia=\"{} {} {} {} {} {}\"/>\n      <geom \
             type=\"mesh\" mesh=\"visual\"{} contype=\"0\" conaffinity=\"0\" group=\"2\"/>\n",
            i[0][0],
            i[1][1],
            i[2][2],
            i[0][1],
            i[0][2],
            i[1][2],
            if has_texture { " material=\"object\"" } else { "" }
        );
        for h in 0..self.hulls.len() {
            let _ = writeln!(text, "      <geom type=\"mesh\" mesh=\"hull_{h:02}\" group=\"3\"/>");
        }
        text + "    </body>\n  </worldbody>\n</mujoco>\n"
    }
}

fn hull_name(i: usize) -> String {
    format!("hull_{i:02}.obj")
}

/// Approximate convex decomposition (VHACD, Mamou 2016) of a closed mesh.
fn decompose(mesh: &TriMesh) -> Vec<TriMesh> {
    let Some((low, high)) = mesh.bounds() else { return Vec::new() };
    // To unit size: the library's tolerances are absolute.
    let size = (0..3).map(|k| high[k] - low[k]).fold(0.0, f32::max);
    let scaled: Vec<Vector> = mesh
        .vertices
        .iter()
        .map(|p| Vector::new((p[0] - low[0]) / size, (p[1] - low[1]) / size, (p[2] - low[2]) / size))
        .collect();
    let settings = VHACDParameters { max_convex_hulls: MOST_HULLS, ..VHACDParameters::default() };
    let parts = VHACD::decompose(&settings, &scaled, &mesh.triangles, true);
    let pieces = parts.compute_primitive_intersections(&scaled, &mesh.triangles);
    let back = |p: &Vector| std::array::from_fn(|k| p[k] * size + low[k]);
    pieces.iter().filter_map(|points| hull(&points.iter().map(back).collect::<Vec<_>>())).collect()
}

/// Convex hull with at most [`CORNERS`] corners; `None` when the points span no volume.
fn hull(points: &[[f32; 3]]) -> Option<TriMesh> {
    let farthest = |i: usize| {
        let z = 1.0 - 2.0 * (i as f32 + 0.5) / CORNERS as f32;
        let (r, turn) = ((1.0 - z * z).sqrt(), i as f32 * 2.399_963_2);
        let direction = [r * turn.cos(), r * turn.sin(), z];
        let along = |p: &[f32; 3]| (0..3).map(|k| p[k] * direction[k]).sum::<f32>();
        (0..points.len()).max_by(|&a, &b| along(&points[a]).total_cmp(&along(&points[b])))
    };
    let mut chosen: Vec<usize> = (0..CORNERS).filter_map(farthest).collect();
    chosen.sort_unstable();
    chosen.dedup();
    let corners: Vec<Vector> = chosen.iter().map(|&i| Vector::from_array(points[i])).collect();
    let (vertices, triangles) = try_convex_hull(&corners).ok()?;
    let mesh = TriMesh {
        vertices: vertices.iter().map(|v| v.to_array()).collect(),
        triangles,
        ..TriMesh::default()
    };
    // Simulators refuse bodies that are all but flat.
    let (low, high) = mesh.bounds()?;
    let thinnest = (0..3).map(|k| high[k] - low[k]).fold(f32::INFINITY, f32::min);
    (mesh.is_watertight() && thinnest > 1e-4 && mesh.signed_volume() > 1e-10).then_some(mesh)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::{Observations, mass_properties};

    /// An L of two bars: concave, 12 cm.
    fn angle() -> Asset {
        let mut mesh = marching_cubes::extract_fn([50; 3], [-0.02; 3], 0.16 / 49.0, 0.0, |p| {
            let bar = |half: [f32; 3], at: [f32; 3]| {
                (0..3).map(|k| (p[k] - at[k]).abs() - half[k]).fold(f32::NEG_INFINITY, f32::max)
            };
            bar([0.06, 0.02, 0.02], [0.06, 0.02, 0.02]).min(bar([0.02, 0.06, 0.02], [0.02, 0.06, 0.02]))
        });
        mesh.compute_normals();
        Asset { mesh, observations: Observations::default(), textured: None, canonical: None }
    }

    #[test]
    fn hulls_are_convex_and_follow_a_concave_body() {
        let asset = angle();
        let body = Body::of(&asset, 700.0).unwrap();
        assert!((2..=MOST_HULLS as usize).contains(&body.hulls.len()), "{}", body.hulls.len());
        let mut volume = 0.0;
        for hull in &body.hulls {
            assert!(hull.is_watertight() && hull.vertices.len() <= CORNERS);
            volume += hull.signed_volume();
            for t in &hull.triangles {
                let [a, b, c] = t.map(|i| hull.vertices[i as usize].map(f64::from));
                let sub = |p: [f64; 3], q: [f64; 3]| nalgebra::Vector3::from(p) - nalgebra::Vector3::from(q);
                let n = sub(b, a).cross(&sub(c, a));
                let out = |p: &[f32; 3]| sub(p.map(f64::from), a).dot(&n) / n.norm();
                assert!(n.norm() < 1e-9 || hull.vertices.iter().all(|p| out(p) < 1e-4));
            }
        }
        // One hull around the L would have half as much volume again.
        let solid = mass_properties(&asset.mesh, 1.0).unwrap().volume_m3;
        assert!((0.85..1.25).contains(&(volume / solid)), "{}", volume / solid);
    }

    #[test]
    fn files_name_each_other() {
        let asset = angle();
        let body = Body::of(&asset, 700.0).unwrap();
        let files = body.files(&asset).unwrap();
        let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
        for file in ["object.urdf", "object.xml"] {
            let at = names.iter().position(|n| *n == file).unwrap();
            let text = String::from_utf8_lossy(&files[at].1).into_owned();
            for name in names.iter().filter(|n| n.ends_with(".obj")) {
                assert!(text.contains(&format!("\"{name}\"")), "{file} {name}");
            }
            assert!(text.contains(&format!("\"{}\"", body.mass.mass_kg)));
        }
        assert!((body.mass.mass_kg - 700.0 * body.mass.volume_m3).abs() < 1e-12);
    }
}
