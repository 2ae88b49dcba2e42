//! Which part of a view's surface other views show too.

use nalgebra::{Isometry3, Point3, Vector3};

use crate::observation::Observation;

/// A view: what was seen, and its `obj_from_cam`.
type View<'a> = (&'a Observation, &'a Isometry3<f64>);

/// Share of `view`'s sample points that none of `others` shows. Those that show most of them should come first.
pub(crate) fn unseen_share<'a>(view: View<'_>, others: impl Iterator<Item = View<'a>>) -> f64 {
    let (observation, obj_from_cam) = view;
    let others: Vec<_> = others.map(|(other, pose)| (other, pose.inv_mul(obj_from_cam))).collect();
    let unseen = observation.samples.iter().filter(|(p, n)| {
        let (point, normal) = (Point3::from(*p).cast::<f64>(), Vector3::from(*n).cast::<f64>());
        !others.iter().any(|(other, to_from)| shows(other, &(to_from * point), &(to_from * normal)))
    });
    unseen.count() as f64 / observation.samples.len().max(1) as f64
}

/// Whether `observation` has measured a point with this normal, both in its camera frame: it faces the camera, and the
/// depth there is its own. At steeper angles than the grazing filter's there is no depth.
fn shows(observation: &Observation, point: &Point3<f64>, normal: &Vector3<f64>) -> bool {
    if normal.dot(&point.coords) >= 0.0 {
        return false;
    }
    let Some([u, v]) = observation.intrinsics.project(point.coords.into()) else { return false };
    let (tolerance, step) = (observation.depth_tolerance(), observation.zoom as f64);
    let agrees = |u: f64, v: f64| {
        let seen = (u >= 0.0 && v >= 0.0).then(|| observation.points.get(u as usize, v as usize)).flatten();
        seen.is_some_and(|s| s[2] > 0.0 && (f64::from(s[2]) - point.z).abs() < tolerance)
    };
    // The rim of a mask is not known better than to a pixel.
    let around = [0.0, -step, step];
    around.iter().any(|dy| around.iter().any(|dx| agrees(u + dx + 0.5, v + dy + 0.5)))
}

#[cfg(test)]
pub(crate) mod tests {
    use nalgebra::UnitQuaternion;
    use rgbd_io::{Image, Intrinsics, RgbdFrame};

    use super::*;
    use crate::config::Config;

    /// `obj_from_cam` of a camera half a metre from the origin, turned about the object's y axis.
    pub(crate) fn turned(deg: f64) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), deg.to_radians());
        turn * Isometry3::translation(0.0, 0.0, -0.5)
    }

    /// A printed board in the plane z = 0, 12 cm high, from `left` to `right` (metres) along x, seen at [`turned`] `deg`;
    /// the print is smeared over `blur` samples of 3 mm.
    pub(crate) fn board(deg: f64, [left, right]: [f64; 2], blur: usize) -> (RgbdFrame, Image<u8>) {
        let intrinsics = Intrinsics { fx: 300.0, fy: 300.0, cx: 80.0, cy: 60.0 };
        let pose = turned(deg);
        let hit = |x: usize, y: usize| {
            let ray = pose.rotation * Vector3::from(intrinsics.unproject(x as f64, y as f64, 1.0));
            let depth = -pose.translation.z / ray.z;
            (pose.translation.vector + ray * depth, depth)
        };
        let mask = Image::from_fn(160, 120, |x, y| {
            let p = hit(x, y).0;
            255 * u8::from((left..right).contains(&p.x) && p.y.abs() < 0.06)
        });
        let depth = Image::from_fn(160, 120, |x, y| if mask[(x, y)] != 0 { hit(x, y).1 as f32 } else { 0.9 });
        let print = |x: f64, y: f64| {
            let (x, y) = (((x + 1.0) / 0.012) as usize, ((y + 1.0) / 0.012) as usize);
            40 + (x * 37 + y * 61 + x * y * 17) % 180
        };
        let color = Image::from_fn(160, 120, |x, y| {
            let p = hit(x, y).0;
            let sum: usize = (0..blur).map(|i| print(p.x + 0.003 * i as f64, p.y)).sum();
            [(sum / blur) as u8; 3]
        });
        (RgbdFrame { id: "0".into(), color, depth, mask: None, intrinsics }, mask)
    }

    pub(crate) fn observed((frame, mask): &(RgbdFrame, Image<u8>)) -> Observation {
        Observation::new(0, frame, mask, &Config::default()).unwrap()
    }

    const WHOLE: [f64; 2] = [-0.1, 0.1];

    /// What a view of the whole board loses when others see it at these angles, and so much of it.
    fn unseen(others: &[(f64, [f64; 2])]) -> f64 {
        let whole = observed(&board(10.0, WHOLE, 1));
        let others: Vec<_> =
            others.iter().map(|(deg, part)| (observed(&board(*deg, *part, 1)), turned(*deg))).collect();
        unseen_share((&whole, &turned(10.0)), others.iter().map(|(seen, pose)| (seen, pose)))
    }

    #[test]
    fn what_others_do_not_show_is_counted() {
        assert_eq!(unseen(&[]), 1.0);
        assert_eq!(unseen(&[(10.0, WHOLE)]), 0.0);
        assert!(unseen(&[(12.0, WHOLE)]) < 0.005, "{}", unseen(&[(12.0, WHOLE)]));
        let part = unseen(&[(12.0, [-0.1, 0.06])]);
        assert!((part - 0.2).abs() < 0.03, "{part}");
        // Two halves are a whole.
        let halves = unseen(&[(12.0, [-0.1, 0.01]), (30.0, [-0.01, 0.1])]);
        assert!(halves < 0.005, "{halves}");
    }

    #[test]
    fn something_before_it_or_the_other_side_does_not_show_it() {
        let whole = observed(&board(10.0, WHOLE, 1));
        let (mut frame, mask) = board(12.0, WHOLE, 1);
        frame.depth = frame.depth.map(|d| if *d < 0.8 { d - 0.02 } else { *d });
        let pose = turned(12.0);
        let hidden = observed(&(frame, mask));
        assert_eq!(unseen_share((&whole, &turned(10.0)), [(&hidden, &pose)].into_iter()), 1.0);
        // A thin board from behind: the same depths, but of its back.
        let behind = turned(180.0 + 10.0);
        let back = observed(&board(10.0, WHOLE, 1));
        assert_eq!(unseen_share((&whole, &turned(10.0)), [(&back, &behind)].into_iter()), 1.0);
    }
}
