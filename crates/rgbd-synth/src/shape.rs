//! Solid shapes as signed distances: the description a true mesh is extracted from.

use nalgebra::{Isometry3, Point3, Vector3};

/// A solid given by its signed distance (metres, negative inside).
///
/// Built as one solid before meshing, so that the mesh is the outer surface alone: faces hidden inside another
/// part would count in a surface distance although no camera can see them.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Shape {
    /// A ball around the origin.
    Sphere {
        /// Metres.
        radius: f32,
    },
    /// An axis-parallel box around the origin with rounded edges.
    RoundedBox {
        /// Half the edge lengths with the rounding, metres.
        half: [f32; 3],
        /// Radius of the edges, metres.
        radius: f32,
    },
    /// A tube along a polyline, with a radius for each of its points: handles, spouts, rods.
    Tube {
        /// The polyline and the tube's radius at each point, `[x, y, z, radius]` in metres.
        points: Vec<[f32; 4]>,
    },
    /// A profile turned about the y axis: bottles, cups, plates.
    Lathe {
        /// The outline as `[distance from the axis, y]` in metres, closed along the axis.
        profile: Vec<[f32; 2]>,
        /// Radius added around the outline, metres.
        rounding: f32,
    },
    /// Everything that lies in one of the parts.
    Union {
        /// The parts.
        parts: Vec<Shape>,
        /// Width over which parts flow into each other, metres; `0` for sharp creases.
        blend: f32,
    },
    /// What lies in the first shape and not in the second.
    Difference(Box<Shape>, Box<Shape>),
    /// A shape that was moved.
    Placed {
        /// Maps the shape's coordinates to the outer frame.
        pose: Isometry3<f32>,
        /// The shape.
        shape: Box<Shape>,
    },
}

impl Shape {
    /// Moves the shape by `pose`.
    #[must_use]
    pub fn placed(self, pose: Isometry3<f32>) -> Self {
        Self::Placed { pose, shape: Box::new(self) }
    }

    /// Signed distance (metres, negative inside) from `p`; a lower bound of the true one where parts blend.
    pub fn distance(&self, p: [f32; 3]) -> f32 {
        match self {
            Self::Sphere { radius } => length(p) - radius,
            Self::RoundedBox { half, radius } => {
                let q: [f32; 3] = core::array::from_fn(|k| p[k].abs() - (half[k] - radius));
                let inside = q[0].max(q[1]).max(q[2]).min(0.0);
                length(q.map(|v| v.max(0.0))) + inside - radius
            }
            Self::Tube { points } => tube(points, p),
            Self::Lathe { profile, rounding } => {
                polygon(profile, [(p[0] * p[0] + p[2] * p[2]).sqrt(), p[1]]) - rounding
            }
            Self::Union { parts, blend } => parts
                .iter()
                .map(|part| part.distance(p))
                .reduce(|a, b| smooth_min(a, b, *blend))
                .unwrap_or(f32::INFINITY),
            Self::Difference(a, b) => a.distance(p).max(-b.distance(p)),
            Self::Placed { pose, shape } => {
                let q = pose.inverse_transform_point(&Point3::from(p));
                shape.distance(q.coords.into())
            }
        }
    }

    /// Outward unit normal at `p` from central differences over `2 * step` metres.
    pub fn normal(&self, p: [f32; 3], step: f32) -> [f32; 3] {
        let g: [f32; 3] = core::array::from_fn(|k| {
            let (mut a, mut b) = (p, p);
            a[k] += step;
            b[k] -= step;
            self.distance(a) - self.distance(b)
        });
        let n = length(g);
        if n > 0.0 { g.map(|v| v / n) } else { [0.0, 0.0, -1.0] }
    }

    /// Corners `(min, max)` of an axis-parallel box around the shape, metres; `None` for an empty shape.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        match self {
            Self::Sphere { radius } => Some(([-radius; 3], [*radius; 3])),
            Self::RoundedBox { half, .. } => Some((half.map(|v| -v), *half)),
            Self::Tube { points } => join(points.iter().map(|&[x, y, z, r]| {
                let c = [x, y, z];
                (c.map(|v| v - r), c.map(|v| v + r))
            })),
            Self::Lathe { profile, rounding } => {
                let r = profile.iter().map(|p| p[0].abs()).reduce(f32::max)? + rounding;
                let low = profile.iter().map(|p| p[1]).reduce(f32::min)? - rounding;
                let high = profile.iter().map(|p| p[1]).reduce(f32::max)? + rounding;
                Some(([-r, low, -r], [r, high, r]))
            }
            Self::Union { parts, blend } => {
                let (a, b) = join(parts.iter().filter_map(Self::bounds))?;
                // A blend bulges by at most a quarter of its width.
                Some((a.map(|v| v - 0.25 * blend), b.map(|v| v + 0.25 * blend)))
            }
            Self::Difference(a, _) => a.bounds(),
            Self::Placed { pose, shape } => {
                let (a, b) = shape.bounds()?;
                join((0..8).map(|corner| {
                    let pick = |k: usize| if corner >> k & 1 == 0 { a[k] } else { b[k] };
                    let q: [f32; 3] = (pose * Point3::new(pick(0), pick(1), pick(2))).coords.into();
                    (q, q)
                }))
            }
        }
    }
}

fn length(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

fn join(boxes: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Option<([f32; 3], [f32; 3])> {
    boxes.reduce(|(a, b), (c, d)| {
        (core::array::from_fn(|k| a[k].min(c[k])), core::array::from_fn(|k| b[k].max(d[k])))
    })
}

/// Polynomial smooth minimum: equal to `min` where the arguments differ by more than `width`.
fn smooth_min(a: f32, b: f32, width: f32) -> f32 {
    if width <= 0.0 {
        return a.min(b);
    }
    let h = (width - (a - b).abs()).max(0.0) / width;
    a.min(b) - 0.25 * h * h * width
}

/// Distance to a chain of cones: to the segments, less the radius at the closest point.
fn tube(points: &[[f32; 4]], p: [f32; 3]) -> f32 {
    let at = |q: &[f32; 4]| Vector3::new(q[0], q[1], q[2]);
    let p = Vector3::from(p);
    if let [only] = points {
        return (p - at(only)).norm() - only[3];
    }
    let mut best = f32::INFINITY;
    for pair in points.windows(2) {
        let (a, b) = (at(&pair[0]), at(&pair[1]));
        let ab = b - a;
        let t = ((p - a).dot(&ab) / ab.norm_squared().max(1e-12)).clamp(0.0, 1.0);
        best = best.min((p - a - ab * t).norm() - (pair[0][3] + (pair[1][3] - pair[0][3]) * t));
    }
    best
}

/// Signed distance to a closed polygon: distance to its edges, with the sign of the even-odd rule. An edge on the
/// axis (both ends at radius 0) bounds nothing once the profile is turned.
fn polygon(outline: &[[f32; 2]], p: [f32; 2]) -> f32 {
    let (mut best, mut inside) = (f32::INFINITY, false);
    for i in 0..outline.len() {
        let (a, b) = (outline[i], outline[(i + 1) % outline.len()]);
        if (a[1] > p[1]) != (b[1] > p[1]) && p[0] < a[0] + (p[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) {
            inside = !inside;
        }
        if a[0] <= 0.0 && b[0] <= 0.0 {
            continue;
        }
        let (ab, ap) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
        let t =
            ((ap[0] * ab[0] + ap[1] * ab[1]) / (ab[0] * ab[0] + ab[1] * ab[1]).max(1e-12)).clamp(0.0, 1.0);
        let d = [ap[0] - ab[0] * t, ap[1] - ab[1] * t];
        best = best.min(d[0] * d[0] + d[1] * d[1]);
    }
    if inside { -best.sqrt() } else { best.sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_of_simple_shapes() {
        let cube = Shape::RoundedBox { half: [1.0, 2.0, 3.0], radius: 0.1 };
        assert!((cube.distance([2.0, 0.0, 0.0]) - 1.0).abs() < 1e-6);
        assert!((cube.distance([0.0, 0.0, 0.0]) + 1.0).abs() < 1e-6);
        let can =
            Shape::Lathe { profile: vec![[0.0, 1.0], [0.5, 1.0], [0.5, -1.0], [0.0, -1.0]], rounding: 0.0 };
        assert!((can.distance([0.8, 0.0, 0.0]) - 0.3).abs() < 1e-6);
        assert!((can.distance([0.0, 0.0, 0.0]) + 0.5).abs() < 1e-6);
        assert!((can.distance([0.0, -1.4, 0.0]) - 0.4).abs() < 1e-6);
        let rod = Shape::Tube { points: vec![[0.0, 0.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.3]] };
        assert!((rod.distance([0.5, 1.0, 0.0]) - 0.8).abs() < 1e-6);
    }

    #[test]
    fn bounds_hold_the_solid() {
        let shape = crate::presets::jug_shape();
        let (a, b) = shape.bounds().unwrap();
        for i in 0..4000 {
            let t = i as f32;
            let p: [f32; 3] = [(t * 0.737).sin() * 0.15, (t * 1.311).sin() * 0.15, (t * 2.071).sin() * 0.15];
            if shape.distance(p) < 0.0 {
                assert!((0..3).all(|k| p[k] >= a[k] && p[k] <= b[k]));
            }
        }
        assert!(Shape::Union { parts: vec![], blend: 0.0 }.bounds().is_none());
    }
}
