//! The synthetic suite as folders on disk.

use anyhow::Context;
use rgbd_io::write_png_mask;
use rgbd_synth::{MaskFaults, Sequence, write_custom};
use std::path::Path;

/// Written last: a folder without it was interrupted and is made anew.
const COMPLETE: &str = "complete";
/// The masks that a method gets where they differ from the true ones in `masks/`.
pub(super) const GIVEN: &str = "given_masks";

/// Names of the suite's sequences below `data`, made if they aren't there yet; all of the suite when `names` is empty.
pub(crate) fn prepare(names: &[String], data: &Path) -> anyhow::Result<Vec<String>> {
    chosen(names).iter().map(|name| make(&variant(name, 0)?, data)).collect()
}

/// The names asked for; all of the suite when there are none.
pub(crate) fn chosen(names: &[String]) -> Vec<String> {
    if names.is_empty() { Sequence::suite().map(str::to_owned).collect() } else { names.to_vec() }
}

/// A sequence of the suite in one of its make-ups; 0 is the suite's own.
pub(crate) fn variant(name: &str, number: u64) -> anyhow::Result<Sequence> {
    Sequence::variant(name, number).with_context(|| {
        let known: Vec<_> = Sequence::suite().collect();
        format!("there is no synthetic sequence {name}; there are {}", known.join(", "))
    })
}

/// Writes the sequence below `data` unless it is there; gives the folder's name.
pub(crate) fn make(sequence: &Sequence, data: &Path) -> anyhow::Result<String> {
    let folder = data.join(sequence.name());
    if !folder.join(COMPLETE).exists() {
        eprintln!("making {}, {} frames", folder.display(), sequence.len());
        write_custom(sequence, &folder)?;
        mark(&folder)?;
    }
    let given = folder.join(GIVEN);
    if sequence.spec().mask_faults != MaskFaults::none() && !given.join(COMPLETE).exists() {
        eprintln!("making {}", given.display());
        write_given_masks(sequence, &given)?;
        mark(&given)?;
    }
    Ok(sequence.name().to_owned())
}

/// The masks with their faults.
fn write_given_masks(sequence: &Sequence, folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} can't be created", folder.display()))?;
    for index in 0..sequence.len() {
        let frame = sequence.render(index).frame;
        let mask = frame.mask.with_context(|| format!("{} has frames without masks", sequence.name()))?;
        write_png_mask(&folder.join(format!("{}.png", frame.id)), &mask)?;
    }
    Ok(())
}

fn mark(folder: &Path) -> anyhow::Result<()> {
    std::fs::write(folder.join(COMPLETE), "")
        .with_context(|| format!("{} can't be written; choose another --root", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use eval_metrics::{MeshRef, ModelPoints, score_poses};
    use nalgebra::{Isometry3, UnitQuaternion, Vector3};

    /// Poses of a tracker that knows everything but the turn about the object's `axis`: at every frame the object has
    /// turned as it truly has, less the part about the axis.
    fn without_turn(truth: &[Isometry3<f64>], axis: &Vector3<f64>) -> Vec<Isometry3<f64>> {
        let mut missed = 0.0;
        let mut poses = truth.to_vec();
        for (k, pair) in truth.windows(2).enumerate() {
            missed += (pair[0].rotation.inverse() * pair[1].rotation).scaled_axis().dot(axis);
            poses[k + 1] *= UnitQuaternion::from_scaled_axis(-missed * axis);
        }
        poses
    }

    /// Prints the ADD that is left on the can without print, `cargo test --release -p xtask can_without -- --nocapture`.
    #[test]
    fn the_best_add_of_a_can_without_print_is_far_from_perfect() {
        let can = Sequence::named("symmetric").unwrap();
        let truth: Vec<_> = (0..can.len()).map(|i| can.cam_from_obj(i)).collect();
        let held = without_turn(&truth, &Vector3::y());
        let vertices: Vec<[f64; 3]> = can.mesh().vertices.iter().map(|p| p.map(f64::from)).collect();
        let model = ModelPoints::from_mesh(MeshRef::new(&vertices, &can.mesh().triangles)).unwrap();
        let all = |poses: &[Isometry3<f64>]| poses.iter().copied().map(Some).collect::<Vec<_>>();
        let scores = score_poses(&all(&held), &all(&truth), &model, 0.1);
        println!("turn held, all else true: ADD {:.2}, ADD-S {:.2}", scores.add_auc, scores.add_s_auc);
        // The shape can't tell the difference, the corresponding points can.
        assert!(scores.add_s_auc > 98.0 && scores.add_auc < 80.0);
        // About an axis across the can, the shape tells.
        let across = without_turn(&truth, &Vector3::x());
        assert!(score_poses(&all(&across), &all(&truth), &model, 0.1).add_s_auc < 98.0);
    }

    #[test]
    fn an_unknown_name_is_refused_with_the_known_ones() {
        let error = prepare(&["nonesuch".into()], Path::new("unused")).unwrap_err().to_string();
        assert!(error.contains("nonesuch") && error.contains("texture-less"), "{error}");
    }
}
