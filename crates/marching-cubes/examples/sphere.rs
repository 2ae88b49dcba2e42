//! Meshes a sphere; writes it as PLY to the path given as argument, or prints its measures.
#![allow(clippy::print_stdout)]

fn main() -> std::io::Result<()> {
    let sphere = |p: [f32; 3]| p.iter().map(|v| v * v).sum::<f32>().sqrt() - 0.4;
    let mut mesh = marching_cubes::extract_fn([101; 3], [-0.5; 3], 0.01, 0.0, sphere);
    mesh.compute_normals();
    mesh.colors = mesh.normals.iter().map(|n| n.map(|v| (127.5 * (v + 1.0)) as u8)).collect();
    match std::env::args_os().nth(1) {
        Some(path) => {
            marching_cubes::write_ply(&mesh, &mut std::io::BufWriter::new(std::fs::File::create(path)?))
        }
        None => {
            println!(
                "{} vertices, {} triangles, watertight: {}, area {:.4} (exact 2.0106), volume {:.4} (exact 0.2681)",
                mesh.vertices.len(),
                mesh.triangles.len(),
                mesh.is_watertight(),
                mesh.area(),
                mesh.signed_volume()
            );
            Ok(())
        }
    }
}
