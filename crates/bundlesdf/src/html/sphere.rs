//! From where the keyframes look at the object: both halves of the sphere of directions around it.

use maud::{Markup, html};
use nalgebra::Vector3;

use super::{gather::Results, plot::num};

const RADIUS: f64 = 118.0;
const CENTRES: [[f64; 2]; 2] = [[130.0, 134.0], [390.0, 134.0]];

/// The map. Lambert's azimuthal projection keeps areas: a gap looks as large as it is.
pub(super) fn keyframe_map(results: &Results) -> Markup {
    let directions = results.keyframe_directions();
    let path: Vec<Option<Vector3<f64>>> =
        results.poses.iter().map(|p| p.as_ref().and_then(|p| results.camera_direction(p))).collect();
    let last = directions.len().saturating_sub(1).max(1) as f64;
    html! {
        svg.plot.map viewBox="0 0 520 300" role="img"
            aria-label="Directions from which the keyframes look at the object" {
            @for centre in CENTRES { (half(centre)) }
            text.tick x=(CENTRES[0][0]) y="282" text-anchor="middle" { "side of the first view" }
            text.tick x=(CENTRES[1][0]) y="282" text-anchor="middle" { "far side" }
            @for segment in segments(&path) { path.way d=(segment) {} }
            @for (i, direction) in directions.iter().enumerate() {
                @if let Some(direction) = direction {
                    @let (_, [x, y]) = project(direction);
                    @let keyframe = &results.keyframes[i];
                    circle.dot cx=(num(x)) cy=(num(y)) r="5"
                        style=(format!("--age:{:.0}%", 100.0 * i as f64 / last)) {
                        title {
                            "keyframe " (i + 1) ", frame " (keyframe.id)
                            @if keyframe.refined_by_field { ", refined by the field" }
                        }
                    }
                }
            }
        }
    }
}

/// Outline, rings at 30 and 60 degrees and spokes of a half.
fn half([x, y]: [f64; 2]) -> Markup {
    html! {
        circle.disc cx=(x) cy=(y) r=(RADIUS) {}
        @for degrees in [30.0_f64, 60.0] {
            circle.grid cx=(x) cy=(y) r=(num(ring(degrees.to_radians()))) {}
        }
        line.grid x1=(x - RADIUS) x2=(x + RADIUS) y1=(y) y2=(y) {}
        line.grid x1=(x) x2=(x) y1=(y - RADIUS) y2=(y + RADIUS) {}
    }
}

/// Distance from the middle of a half for an angle from its axis: 90 degrees lie on the outline.
fn ring(angle: f64) -> f64 {
    RADIUS * std::f64::consts::SQRT_2 * (angle / 2.0).sin()
}

/// Which half a direction of the object frame is on, and where (pixels). The first camera looks along +z with x right
/// and y down, so its side is that of -z, shown as that camera sees it; the far side as one sees it from there.
fn project(direction: &Vector3<f64>) -> (usize, [f64; 2]) {
    let far = usize::from(direction.z > 0.0);
    let angle = direction.z.abs().clamp(0.0, 1.0).acos();
    let across = direction.xy().norm();
    let scale = if across > 0.0 { ring(angle) / across } else { 0.0 };
    let mirrored = if far == 1 { -1.0 } else { 1.0 };
    let [x, y] = CENTRES[far];
    (far, [x + mirrored * scale * direction.x, y + scale * direction.y])
}

/// The way of the camera, cut where it changes sides or has a hole.
fn segments(path: &[Option<Vector3<f64>>]) -> Vec<String> {
    let mut parts: Vec<Vec<[f64; 2]>> = Vec::new();
    let mut previous = None;
    for direction in path {
        let at = direction.as_ref().map(project);
        match (at, previous, parts.last_mut()) {
            (Some((side, point)), Some(before), Some(part)) if side == before => part.push(point),
            (Some((_, point)), _, _) => parts.push(vec![point]),
            (None, _, _) => {}
        }
        previous = at.map(|(side, _)| side);
    }
    parts.into_iter().filter(|p| p.len() > 1).map(super::plot::line_path).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_view_is_in_the_middle_and_the_side_on_the_outline() {
        let (side, at) = project(&-Vector3::z());
        assert_eq!((side, at), (0, CENTRES[0]));
        let (_, [x, y]) = project(&Vector3::new(1.0, 0.0, -1e-12));
        assert!((x - CENTRES[0][0] - RADIUS).abs() < 1e-6 && (y - CENTRES[0][1]).abs() < 1e-6);
        // Going round the object to the right, one comes to the far side from its left.
        let (side, [x, _]) = project(&Vector3::new(0.9, 0.0, 0.4).normalize());
        assert!(side == 1 && x < CENTRES[1][0]);
    }

    #[test]
    fn areas_are_kept() {
        // The cap of 60 degrees has half the area of a hemisphere.
        let share = (ring(60_f64.to_radians()) / RADIUS).powi(2);
        assert!((share - 0.5).abs() < 1e-12);
    }
}
