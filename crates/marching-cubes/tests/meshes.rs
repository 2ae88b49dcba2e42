//! Measures, components, transforms and writers of `TriMesh`.
#![allow(clippy::unwrap_used)]

use marching_cubes::{TriMesh, extract_fn, write_obj, write_ply};

fn ball(center: [f32; 3], radius: f32) -> TriMesh {
    extract_fn([41; 3], [-1.0; 3], 0.05, 0.0, move |p| {
        (0..3).map(|a| (p[a] - center[a]).powi(2)).sum::<f32>().sqrt() - radius
    })
}

fn two_balls() -> TriMesh {
    let mut mesh = ball([-0.5, 0.0, 0.0], 0.2);
    mesh.merge(&ball([0.4, 0.0, 0.0], 0.4));
    mesh.compute_normals();
    mesh.colors =
        mesh.vertices.iter().map(|v| if v[0] < -0.1 { [255, 0, 10] } else { [0, 128, 7] }).collect();
    mesh
}

#[test]
fn components_are_found_and_keep_their_attributes() {
    let mesh = two_balls();
    assert!(mesh.is_watertight());
    assert_eq!(mesh.euler_characteristic(), 4);
    let parts = mesh.components();
    assert_eq!(parts.len(), 2);
    assert!(parts[0].triangles.len() > parts[1].triangles.len());
    assert_eq!(parts.iter().map(|p| p.vertices.len()).sum::<usize>(), mesh.vertices.len());
    for (part, (center, radius, color)) in
        parts.iter().zip([(0.4, 0.4f32, [0, 128, 7]), (-0.5, 0.2, [255, 0, 10])])
    {
        assert!(part.is_watertight() && part.has_normals());
        assert!(part.colors.iter().all(|c| *c == color));
        for (v, n) in part.vertices.iter().zip(&part.normals) {
            let along = ((v[0] - center) * n[0] + v[1] * n[1] + v[2] * n[2]) / radius;
            assert!(along > 0.9, "{v:?} {n:?}");
        }
    }
    assert_eq!(mesh.largest_component(), parts[0]);

    let mut kept = mesh.clone();
    assert_eq!(kept.remove_small_components(parts[1].triangles.len() + 1), 1);
    assert_eq!(kept, parts[0]);
    assert_eq!(kept.remove_small_components(usize::MAX), 1);
    assert_eq!(kept, TriMesh::default());
    assert!(TriMesh::default().components().is_empty());
    assert_eq!(TriMesh::default().largest_component(), TriMesh::default());
}

#[test]
fn broken_meshes_are_noticed_and_never_panic() {
    let mut mesh = ball([0.0; 3], 0.5);
    let (area, removed) = (mesh.area(), mesh.triangles.pop().unwrap());
    assert!(!mesh.is_watertight());
    mesh.triangles.push([removed[0], removed[2], removed[1]]);
    assert!(!mesh.is_watertight(), "one triangle faces the wrong way");
    *mesh.triangles.last_mut().unwrap() = removed;
    assert!(mesh.is_watertight());
    mesh.triangles.push(removed);
    assert!(!mesh.is_watertight(), "doubled triangle");
    *mesh.triangles.last_mut().unwrap() = [0, 1, u32::MAX];
    mesh.colors = vec![[1, 2, 3]];
    assert!(!mesh.is_watertight());
    assert!((mesh.area() - area).abs() < 1e-9);
    mesh.compute_normals();
    assert_eq!(mesh.components().len(), 1);
    assert!(mesh.largest_component().is_watertight());
    let mut file = Vec::new();
    assert!(write_ply(&mesh, &mut file).is_err() && write_obj(&mesh, &mut file).is_err() && file.is_empty());
    mesh.vertices.push([9.0; 3]);
    mesh.drop_unused_vertices();
    assert!(mesh.is_watertight() && mesh.colors.is_empty());
    assert_eq!(mesh.duplicate_vertices(), 0);
    mesh.vertices.push(mesh.vertices[3]);
    assert_eq!(mesh.duplicate_vertices(), 1);
}

#[test]
fn transforms_move_scale_and_mirror() {
    let mesh = two_balls();
    let (lo, hi) = mesh.bounds().unwrap();
    // Turn by 90 degrees about z and shift, as a pose does.
    let pose = [[0.0, -1.0, 0.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0], [0.0, 0.0, 0.0, 1.0]];
    let moved = mesh.transformed_by(&pose);
    let (mlo, mhi) = moved.bounds().unwrap();
    assert!(
        (mlo[0] - (2.0 - hi[1])).abs() < 1e-6
            && (mhi[1] - hi[0]).abs() < 1e-6
            && (mlo[2] - (lo[2] - 1.0)).abs() < 1e-6
    );
    assert!((moved.signed_volume() / mesh.signed_volume() - 1.0).abs() < 1e-5);
    // Unequal scale and a mirror: still outwards, and normals agree with the new triangles.
    let skew = [[-2.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.5, 0.0], [0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let skewed = mesh.transformed_by(&skew);
    assert!((skewed.signed_volume() / mesh.signed_volume() - 6.0).abs() < 1e-4);
    assert!(skewed.is_watertight());
    let mut fresh = skewed.clone();
    fresh.compute_normals();
    for (a, b) in skewed.normals.iter().zip(&fresh.normals) {
        assert!((0..3).map(|k| a[k] * b[k]).sum::<f32>() > 0.9);
    }
    let grown = mesh.transformed(|p| p.map(|v| 2.0 * v));
    assert!((grown.area() / mesh.area() - 4.0).abs() < 1e-5 && grown.has_normals());
    assert_eq!(TriMesh::default().bounds(), None);
}

/// Reads what `write_ply` may write, by its header.
fn parse_ply(file: &[u8]) -> TriMesh {
    let end = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&file[..end]).unwrap();
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"));
    let count = |element: &str| -> usize {
        header.lines().find_map(|l| l.strip_prefix(&format!("element {element} "))).unwrap().parse().unwrap()
    };
    assert!(header.contains("property list uchar int vertex_indices\n"));
    let mut at = end;
    let mut take = |n: usize| {
        at += n;
        &file[at - n..at]
    };
    let names: Vec<&str> = header
        .lines()
        .filter(|l| l.starts_with("property float") || l.starts_with("property uchar"))
        .map(|l| l.rsplit(' ').next().unwrap())
        .collect();
    let mut mesh = TriMesh::default();
    for _ in 0..count("vertex") {
        let mut float3 = || std::array::from_fn(|_| f32::from_le_bytes(take(4).try_into().unwrap()));
        mesh.vertices.push(float3());
        if names.contains(&"nx") {
            mesh.normals.push(float3());
        }
        if names.contains(&"red") {
            mesh.colors.push(take(3).try_into().unwrap());
        }
    }
    let mut expected = vec!["x", "y", "z"];
    expected.extend(["nx", "ny", "nz"].iter().filter(|_| mesh.has_normals()));
    expected.extend(["red", "green", "blue"].iter().filter(|_| mesh.has_colors()));
    assert_eq!(names, expected);
    for _ in 0..count("face") {
        assert_eq!(take(1), [3]);
        mesh.triangles.push(std::array::from_fn(|_| {
            i32::from_le_bytes(take(4).try_into().unwrap()).try_into().unwrap()
        }));
    }
    assert_eq!(at, file.len());
    mesh
}

fn parse_obj(file: &[u8]) -> TriMesh {
    let mut mesh = TriMesh::default();
    for line in std::str::from_utf8(file).unwrap().lines() {
        let (kind, rest) = line.split_once(' ').unwrap();
        let numbers = || rest.split(' ').map(|w| w.parse::<f32>().unwrap()).collect::<Vec<_>>();
        match kind {
            "v" => {
                let n = numbers();
                mesh.vertices.push(n[..3].try_into().unwrap());
                if n.len() == 6 {
                    mesh.colors.push(std::array::from_fn(|k| (n[3 + k] * 255.0).round() as u8));
                }
            }
            "vn" => mesh.normals.push(numbers().try_into().unwrap()),
            "f" => {
                let corners: Vec<u32> = rest
                    .split(' ')
                    .map(|w| {
                        let mut ids = w.split("//").map(|i| i.parse::<u32>().unwrap() - 1);
                        let v = ids.next().unwrap();
                        assert!(ids.next().is_none_or(|n| n == v));
                        v
                    })
                    .collect();
                mesh.triangles.push(corners.try_into().unwrap());
            }
            _ => unreachable!("line {line}"),
        }
    }
    mesh
}

#[test]
fn writers_round_trip() {
    let full = two_balls();
    let mut plain = full.clone();
    plain.normals.clear();
    plain.colors.clear();
    let (mut colored, mut shaded) = (full.clone(), full.clone());
    colored.normals.clear();
    shaded.colors.clear();
    for mesh in [full, plain, colored, shaded, TriMesh::default()] {
        let (mut ply, mut obj) = (Vec::new(), Vec::new());
        write_ply(&mesh, &mut ply).unwrap();
        write_obj(&mesh, &mut obj).unwrap();
        assert_eq!(parse_ply(&ply), mesh);
        assert_eq!(parse_obj(&obj), mesh);
    }
}
