//! The same errors as the public BOP toolkit computes; `golden/README.md` tells how its numbers were made.
#![allow(clippy::unwrap_used)]

use eval_metrics::{ModelPoints, add, add_s, rotation_error, translation_error};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

/// The numbers of a table below its first line.
fn rows(csv: &str) -> Vec<Vec<f64>> {
    csv.lines().skip(1).map(|line| line.split(',').map(|v| v.parse().unwrap()).collect()).collect()
}

fn models() -> Vec<ModelPoints> {
    let points = rows(include_str!("golden/bop_points.csv"));
    let object = |i: usize| {
        points.iter().filter(|p| p[0] as usize == i).map(|p| [p[1], p[2], p[3]]).collect::<Vec<_>>()
    };
    (0..3).map(|i| ModelPoints::new(object(i)).unwrap()).collect()
}

/// Nine numbers of a rotation by rows, and a translation.
fn pose(row: &[f64]) -> Isometry3<f64> {
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_row_slice(&row[..9]));
    Isometry3::from_parts(
        Translation3::new(row[9], row[10], row[11]),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

#[test]
fn errors_are_those_of_the_bop_toolkit() {
    let models = models();
    let cases = rows(include_str!("golden/bop_errors.csv"));
    assert_eq!(cases.len(), 90);
    let mut largest = [0.0_f64; 4];
    for case in &cases {
        let model = &models[case[0] as usize];
        let (est, gt) = (pose(&case[1..13]), pose(&case[13..25]));
        let ours = [
            add(&est, &gt, model),
            add_s(&est, &gt, model),
            rotation_error(&est, &gt).to_degrees(),
            translation_error(&est, &gt),
        ];
        for (worst, (ours, theirs)) in largest.iter_mut().zip(ours.iter().zip(&case[25..29])) {
            assert!(*theirs > 0.0);
            *worst = worst.max((ours - theirs).abs() / theirs);
        }
    }
    println!(
        "largest relative differences: ADD {:.1e}, ADD-S {:.1e}, rotation {:.1e}, translation {:.1e}",
        largest[0], largest[1], largest[2], largest[3]
    );
    assert!(largest.iter().all(|d| *d < 1e-9), "{largest:?}");
}
