//! Simplification, closing, welding and files: what must stay, stays.

use marching_cubes::{TriMesh, extract_fn, read_ply, write_ply, write_ply_with, write_stl};
use proptest::prelude::*;

fn distance(p: [f32; 3]) -> f32 {
    p.iter().map(|v| v * v).sum::<f32>().sqrt()
}

fn sphere(n: usize) -> TriMesh {
    extract_fn([n; 3], [-1.0; 3], 2.0 / (n - 1) as f32, 0.0, |p| distance(p) - 0.8)
}

fn torus(n: usize) -> TriMesh {
    extract_fn([n; 3], [-1.0; 3], 2.0 / (n - 1) as f32, 0.0, |p| {
        let ring = (p[0] * p[0] + p[1] * p[1]).sqrt() - 0.6;
        (ring * ring + p[2] * p[2]).sqrt() - 0.25
    })
}

#[test]
fn a_simplified_sphere_is_still_a_sphere() {
    let full = sphere(48);
    for faces in [2000, 500, 100] {
        let mesh = full.simplified(faces);
        assert!(
            mesh.triangles.len() <= faces && mesh.triangles.len() + 2 >= faces,
            "{}",
            mesh.triangles.len()
        );
        assert!(mesh.is_watertight());
        assert_eq!(mesh.euler_characteristic(), 2);
        let worst = mesh.vertices.iter().map(|&p| (distance(p) - 0.8).abs()).fold(0.0, f32::max);
        // The sagitta of triangles of equal area on the sphere, with a margin for uneven ones.
        let edge_squared = 4.0 * std::f32::consts::PI * 0.64 / faces as f32 * 4.0 / 3.0f32.sqrt();
        assert!(worst < edge_squared / (8.0 * 0.8) * 3.0, "{faces}: {worst}");
        assert!((mesh.signed_volume() / full.signed_volume() - 1.0).abs() < 30.0 / faces as f64 / 5.0);
    }
}

#[test]
fn a_ring_keeps_its_hole_and_a_cube_its_edges() {
    let mesh = torus(40).simplified(300);
    assert!(mesh.is_watertight());
    assert_eq!(mesh.euler_characteristic(), 0);
    // On a cube flat areas cost nothing: twelve triangles can hold it, and so can some more exactly.
    let cube =
        extract_fn([21; 3], [-1.0; 3], 0.1, 0.0, |p| p.iter().map(|v| v.abs()).fold(0.0, f32::max) - 0.65);
    let few = cube.simplified(200);
    assert!(few.is_watertight());
    assert!((few.signed_volume() / cube.signed_volume() - 1.0).abs() < 0.01, "{}", few.signed_volume());
}

#[test]
fn simplification_ends_at_what_topology_allows() {
    let least = sphere(12).simplified(0);
    assert!(least.is_watertight());
    assert_eq!(least.euler_characteristic(), 2);
    assert!(least.triangles.len() < 40, "{}", least.triangles.len());
}

#[test]
fn colours_follow_their_place() {
    let mut mesh = sphere(40);
    let shade = |p: [f32; 3]| ((p[0] + 1.0) * 127.0) as u8;
    mesh.colors = mesh.vertices.iter().map(|&p| [shade(p), 100, 0]).collect();
    mesh.compute_normals();
    let less = mesh.simplified(600);
    assert!(less.has_normals() && less.has_colors());
    for (p, c) in less.vertices.iter().zip(&less.colors) {
        assert!(c[0].abs_diff(shade(*p)) < 12 && c[1] == 100, "{p:?} {c:?}");
    }
}

/// The sphere without its cap above `z`.
fn open(z: f32) -> TriMesh {
    let mut mesh = sphere(32);
    mesh.triangles.retain(|t| t.iter().all(|&i| mesh.vertices[i as usize][2] < z));
    mesh.drop_unused_vertices();
    mesh
}

#[test]
fn a_simplified_open_surface_keeps_its_border() {
    let mesh = open(0.3);
    let less = mesh.simplified(300);
    let [rim] = less.rims().try_into().unwrap();
    assert_eq!(less.euler_characteristic(), 1);
    let highest = |m: &TriMesh| m.vertices.iter().map(|p| p[2]).fold(-1.0, f32::max);
    assert!((highest(&less) - highest(&mesh)).abs() < 0.02);
    assert!(rim.iter().all(|&i| less.vertices[i as usize][2] > 0.15));
}

#[test]
fn holes_close_flat_and_outwards() {
    let mut mesh = open(0.3);
    mesh.colors = vec![[10, 200, 30]; mesh.vertices.len()];
    assert!(!mesh.is_watertight());
    let closed = mesh.closed();
    assert!(closed.is_watertight());
    assert_eq!(closed.euler_characteristic(), 2);
    assert_eq!(&closed.vertices[..mesh.vertices.len()], mesh.vertices.as_slice());
    assert!(closed.colors.iter().all(|c| *c == [10, 200, 30]));
    // A ball of 0.8 cut at about 0.3 (the cut follows the triangles): volume of the part below.
    let (r, h) = (0.8f64, 0.8 + 0.27);
    let expected = std::f64::consts::PI * h * h * (r - h / 3.0);
    assert!((closed.signed_volume() / expected - 1.0).abs() < 0.03, "{} {expected}", closed.signed_volume());
}

#[test]
fn sheets_that_touch_in_a_vertex_are_closed_one_by_one() {
    // Two open corners whose tips are one vertex.
    let tip = [0.0; 3];
    let mut mesh = TriMesh { vertices: vec![tip], ..TriMesh::default() };
    for side in [1.0, -1.0f32] {
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend([[side, 0.0, 0.0], [side, 1.0, 0.0], [side, 0.0, 1.0]]);
        let [a, b, c] = [first, first + 1, first + 2];
        mesh.triangles.extend(if side > 0.0 {
            [[0, b, a], [0, c, b], [0, a, c]]
        } else {
            [[0, a, b], [0, b, c], [0, c, a]]
        });
    }
    let closed = mesh.closed();
    assert!(closed.is_watertight());
    assert_eq!(closed.components().len(), 2);
    assert!((closed.signed_volume().abs() - 2.0 / 6.0).abs() < 1e-6, "{}", closed.signed_volume());
}

#[test]
fn welding_restores_a_soup() {
    let mesh = sphere(16);
    let mut soup = TriMesh::default();
    for t in &mesh.triangles {
        let first = soup.vertices.len() as u32;
        soup.vertices.extend(t.map(|i| mesh.vertices[i as usize]));
        soup.triangles.push([first, first + 1, first + 2]);
    }
    assert!(!soup.is_watertight());
    assert_eq!(soup.weld(), 3 * mesh.triangles.len() - mesh.vertices.len());
    assert!(soup.is_watertight());
    assert_eq!(soup.triangles.len(), mesh.triangles.len());
}

#[test]
fn ply_comes_back_as_it_was() {
    let mut mesh = sphere(12);
    let bytes = |mesh: &TriMesh| {
        let mut out = Vec::new();
        write_ply(mesh, &mut out).unwrap();
        out
    };
    assert_eq!(read_ply(&bytes(&mesh)).unwrap(), mesh);
    mesh.compute_normals();
    mesh.colors = (0..mesh.vertices.len()).map(|i| [i as u8, 1, 2]).collect();
    assert_eq!(read_ply(&bytes(&mesh)).unwrap(), mesh);
    let confidence: Vec<f32> = (0..mesh.vertices.len()).map(|i| i as f32).collect();
    let mut out = Vec::new();
    write_ply_with(&mesh, &[("confidence", &confidence)], &mut out).unwrap();
    assert!(String::from_utf8_lossy(&out).contains("property float confidence"));
    assert_eq!(read_ply(&out).unwrap(), mesh);
    assert!(write_ply_with(&mesh, &[("confidence", &confidence[1..])], &mut Vec::new()).is_err());
    assert!(write_ply_with(&mesh, &[("a b", &confidence)], &mut Vec::new()).is_err());
}

#[test]
fn stl_has_the_size_and_the_corners_it_should() {
    let mesh = sphere(10);
    let mut out = Vec::new();
    write_stl(&mesh, &mut out).unwrap();
    assert_eq!(out.len(), 84 + 50 * mesh.triangles.len());
    assert_eq!(u32::from_le_bytes(out[80..84].try_into().unwrap()) as usize, mesh.triangles.len());
    let float = |at: usize| f32::from_le_bytes(out[at..at + 4].try_into().unwrap());
    let corner = mesh.vertices[mesh.triangles[0][0] as usize];
    assert_eq!([float(96), float(100), float(104)], corner);
    // The normal looks away from the middle.
    assert!((0..3).map(|k| float(84 + 4 * k) * corner[k]).sum::<f32>() > 0.0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Damaged files are errors or meshes, never a panic.
    #[test]
    fn damaged_ply_never_panics(cut in 0usize..3000, at in 0usize..3000, byte: u8) {
        let mut out = Vec::new();
        write_ply(&sphere(6), &mut out).unwrap();
        let (cut, at) = (cut.min(out.len()), at % out.len());
        let mut damaged = out.clone();
        damaged[at] = byte;
        let _ = read_ply(&damaged);
        if cut < out.len() {
            prop_assert!(read_ply(&out[..cut]).is_err());
        }
    }

    /// Any triangles at all: no panic, no more faces than asked for or than can be.
    #[test]
    fn any_triangles_can_be_edited(
        points in prop::collection::vec(prop::array::uniform3(-1.0f32..1.0), 3..12),
        triangles in prop::collection::vec(prop::array::uniform3(0u32..13), 0..20),
    ) {
        let mesh = TriMesh { vertices: points, triangles, ..TriMesh::default() };
        let less = mesh.simplified(4);
        prop_assert!(less.triangles.len() <= mesh.triangles.len());
        let _ = mesh.closed().rims();
        mesh.clone().weld();
    }
}
