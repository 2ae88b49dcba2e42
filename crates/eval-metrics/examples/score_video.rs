//! Scores a fabricated track and a mesh that is 2 mm too large.
#![allow(clippy::print_stdout)]

use eval_metrics::{
    Camera, MeshProtocol, MeshRef, ModelPoints, alignment, keep_faces, score_mesh, score_poses, visible_faces,
};
use nalgebra::{Isometry3, Vector3};

/// A tetrahedron with corners `r` metres from its centre.
fn tetrahedron(r: f64) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let c = r / 3f64.sqrt();
    (vec![[c, c, c], [c, -c, -c], [-c, c, -c], [-c, -c, c]], vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
}

fn main() -> Result<(), &'static str> {
    let (vertices, triangles) = tetrahedron(0.1);
    let truth = MeshRef::new(&vertices, &triangles);
    let model = ModelPoints::from_mesh(truth).ok_or("the model has no surface")?;

    let turn = |i: usize, drift: f64| {
        let (i, d) = (i as f64, drift * i as f64);
        Isometry3::new(Vector3::new(d, 0.0, 0.6), Vector3::y() * (0.02 * i + d))
    };
    let gt: Vec<_> = (0..60).map(|i| Some(turn(i, 0.0))).collect();
    let predicted: Vec<_> = (0..60).map(|i| (i % 20 != 19).then(|| turn(i, 2e-4))).collect();
    let scores = score_poses(&predicted, &gt, &model, 0.1);
    println!("ADD {:.2} %, ADD-S {:.2} %", scores.add_auc, scores.add_s_auc);

    let camera = Camera { fx: 600.0, fy: 600.0, cx: 319.5, cy: 239.5, width: 640, height: 480 };
    let poses: Vec<_> = gt.iter().flatten().copied().collect();
    let visible = keep_faces(&triangles, &visible_faces(truth, &poses, &camera));
    println!("{} of {} faces visible", visible.len(), triangles.len());

    let (larger, larger_triangles) = tetrahedron(0.102);
    let gt_from_pred = alignment(&predicted, &gt).ok_or("no frame has both poses")?.inverse();
    for (name, protocol) in
        [("paper", MeshProtocol::paper_text()), ("with ICP", MeshProtocol::authors_script())]
    {
        let reconstruction = MeshRef::new(&larger, &larger_triangles);
        let score = score_mesh(reconstruction, MeshRef::new(&vertices, &visible), &gt_from_pred, &protocol)
            .ok_or("a mesh has no surface")?;
        println!("chamfer distance, {name}: {:.2} mm", score.distance() * 1e3);
    }
    Ok(())
}
