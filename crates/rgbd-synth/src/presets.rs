//! Ready-made objects and sequences.

use crate::motion::Tumble;
use crate::texture::{Layer, Mapping, Pattern};
use crate::{
    Backdrop, Grip, Hand, Light, MaskFaults, Masks, Motion, Object, Occluder, Plane, Sensor, Sequence,
    SequenceSpec, Shape, Texture,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::Intrinsics;
use std::sync::{Arc, OnceLock};

/// Frames in which the rod of the demo crosses the image.
const CROSSING: [f64; 2] = [62.0, 92.0];

impl Sequence {
    /// 120 frames of 640 x 480: a jug turned by more than 180 degrees about changing axes in a hand 0.5 to 0.7 m
    /// before a structured-light camera, with a rod that crosses in front of it.
    pub fn demo() -> Self {
        let k = Intrinsics { fx: 608.0, fy: 607.0, cx: 321.4, cy: 237.9 };
        let (skin, rod) = (skin(), Arc::new(rod()));
        Self::from_spec(SequenceSpec {
            name: "demo".into(),
            frames: 120,
            width: 640,
            height: 480,
            intrinsics: k,
            seed: 7,
            object: jug(),
            motion: demo_motion(),
            camera: None,
            occluders: vec![
                Occluder::Hand(Box::new(Hand::new(Grip::default(), skin, sleeve()))),
                Occluder::Rigid { object: rod, motion: crossing(CROSSING) },
            ],
            backdrop: room(),
            light: Light::default(),
            sensor: Sensor::structured_light(),
            masks: Masks::Every,
            mask_faults: MaskFaults::none(),
        })
    }

    /// A small and fast sequence for tests: the first 24 frames of the demo's motion at 160 x 120 with a coarser
    /// mesh and the hand, without the rod.
    pub fn tiny() -> Self {
        let demo = Self::demo();
        let spec = demo.spec().clone();
        Self::from_spec(SequenceSpec {
            name: "tiny".into(),
            frames: 24,
            width: 160,
            height: 120,
            intrinsics: spec.intrinsics.scaled(0.25, 0.25),
            object: coarse_jug(),
            occluders: spec.occluders[..1].to_vec(),
            ..spec
        })
    }
}

fn demo_motion() -> Motion {
    Motion::tumble(Tumble {
        center: [-0.005, 0.0, 0.60],
        sway: [0.045, 0.022, 0.055],
        start: 0.5,
        turn: 2.3f64.to_radians(),
        tilt: 24f64.to_radians(),
        roll: 13f64.to_radians(),
        period: 84.0,
    })
}

/// The demo's object: a jug of 14 cm with handle, spout, off-centre stopper and a badge, no two sides alike.
///
/// Frame: y along the axis, towards the foot; the origin at half the height; the handle on the side of x, metres.
pub fn jug() -> Arc<Object> {
    static JUG: OnceLock<Arc<Object>> = OnceLock::new();
    JUG.get_or_init(|| Arc::new(build_jug(0.0016))).clone()
}

fn coarse_jug() -> Arc<Object> {
    static JUG: OnceLock<Arc<Object>> = OnceLock::new();
    JUG.get_or_init(|| Arc::new(build_jug(0.002))).clone()
}

fn build_jug(voxel: f32) -> Object {
    // The shape's extent is a constant, so extraction can't fail.
    Object::from_shape(jug_shape(), jug_texture(), voxel)
        .unwrap_or_else(|_| Object::from_mesh(Default::default(), jug_texture()))
}

pub(crate) fn jug_shape() -> Shape {
    let body = Shape::Lathe {
        profile: vec![
            [0.0, 0.066],
            [0.033, 0.066],
            [0.038, 0.058],
            [0.040, 0.010],
            [0.036, -0.018],
            [0.022, -0.042],
            [0.017, -0.052],
            [0.018, -0.064],
            [0.0, -0.064],
        ],
        rounding: 0.002,
    };
    let handle = Shape::Tube {
        points: vec![
            [0.030, -0.022, 0.0, 0.0065],
            [0.052, -0.026, 0.004, 0.0060],
            [0.066, -0.010, 0.006, 0.0055],
            [0.068, 0.014, 0.005, 0.0055],
            [0.058, 0.035, 0.002, 0.0060],
            [0.036, 0.044, 0.0, 0.0070],
        ],
    };
    let spout = Shape::Tube {
        points: vec![
            [-0.020, 0.020, 0.016, 0.013],
            [-0.044, 0.000, 0.034, 0.0095],
            [-0.054, -0.022, 0.042, 0.0085],
        ],
    };
    let stopper = Shape::RoundedBox { half: [0.019, 0.008, 0.014], radius: 0.003 }
        .placed(turned([0.004, -0.071, -0.003], Vector3::new(0.0, 0.5, 0.08)));
    let badge = Shape::RoundedBox { half: [0.017, 0.013, 0.007], radius: 0.003 }
        .placed(turned([0.012, 0.036, -0.037], Vector3::new(0.0, -0.31, 0.2)));
    let fin = Shape::RoundedBox { half: [0.005, 0.022, 0.009], radius: 0.002 }
        .placed(turned([0.012, 0.022, 0.041], Vector3::new(0.0, 0.0, 0.35)));
    Shape::Union {
        parts: vec![
            Shape::Union { parts: vec![body, handle, spout], blend: 0.006 },
            stopper,
            Shape::Union { parts: vec![badge, fin], blend: 0.0 },
        ],
        blend: 0.0,
    }
}

pub(crate) fn turned(place: [f32; 3], turn: Vector3<f32>) -> Isometry3<f32> {
    Isometry3::from_parts(Translation3::from(place), UnitQuaternion::from_scaled_axis(turn))
}

fn jug_texture() -> Texture {
    let layer = |pattern, color, band| Layer { pattern, color, band };
    let around = Mapping::Cylinder { radius_um: 40_000 };
    Texture {
        palette: vec![[0.10, 0.22, 0.42], [0.16, 0.45, 0.62], [0.78, 0.74, 0.60], [0.86, 0.52, 0.20]],
        scale: 0.026,
        octaves: 4,
        layers: vec![
            layer(Pattern::Patches { scale: 0.018, threshold: 0.62 }, [0.55, 0.16, 0.14], None),
            layer(Pattern::Speckle { cell: 0.0085, radius: 0.0027 }, [0.94, 0.90, 0.78], None),
            layer(
                Pattern::Stripes { direction: [0.3, 1.0, 0.1], period: 0.011, duty: 0.42, warp: 0.006 },
                [0.12, 0.30, 0.20],
                Some([0.046, 0.062]),
            ),
            layer(Pattern::Solid, [0.90, 0.87, 0.79], Some([-0.008, 0.032])),
            layer(
                Pattern::Patches { scale: 0.022, threshold: 0.60 },
                [0.86, 0.42, 0.25],
                Some([-0.008, 0.032]),
            ),
            layer(
                Pattern::Glyphs { cell: 0.0125, density: 0.85, mapping: around },
                [0.13, 0.12, 0.22],
                Some([-0.006, 0.030]),
            ),
            layer(
                Pattern::Glyphs { cell: 0.009, density: 0.7, mapping: Mapping::Cube },
                [0.95, 0.93, 0.85],
                Some([-0.09, -0.060]),
            ),
        ],
        seed: 11,
    }
}

pub(crate) fn skin() -> Texture {
    Texture {
        palette: vec![[0.66, 0.43, 0.34], [0.78, 0.55, 0.44], [0.84, 0.62, 0.51]],
        scale: 0.012,
        octaves: 4,
        layers: Vec::new(),
        seed: 3,
    }
}

pub(crate) fn sleeve() -> Texture {
    Texture {
        palette: vec![[0.20, 0.22, 0.27], [0.30, 0.32, 0.38]],
        scale: 0.02,
        octaves: 4,
        layers: vec![Layer {
            pattern: Pattern::Stripes { direction: [0.0, 0.0, 1.0], period: 0.03, duty: 0.25, warp: 0.004 },
            color: [0.55, 0.55, 0.58],
            band: None,
        }],
        seed: 5,
    }
}

pub(crate) fn rod() -> Object {
    let texture = Texture {
        palette: vec![[0.50, 0.38, 0.24], [0.62, 0.48, 0.30]],
        scale: 0.03,
        octaves: 4,
        layers: vec![Layer {
            pattern: Pattern::Stripes { direction: [0.0, 0.4, 1.0], period: 0.05, duty: 0.3, warp: 0.01 },
            color: [0.20, 0.26, 0.22],
            band: None,
        }],
        seed: 9,
    };
    Object::from_closed(crate::tessellate::rounded_cone(0.6, 0.0098, 0.0098), texture)
}

/// From the left to the right and out of sight again, leaning.
fn crossing([from, to]: [f64; 2]) -> Motion {
    Motion::from_fn(move |time| {
        let s = ((time - from) / (to - from)).clamp(-0.2, 1.2);
        let lean = 0.25 + 0.25 * s;
        let axis = Vector3::new(lean.sin(), -lean.cos(), 0.08);
        let rotation = UnitQuaternion::face_towards(&axis, &Vector3::z());
        let middle = Vector3::new(-0.36 + 0.72 * s, 0.02, 0.44);
        Isometry3::from_parts(Translation3::from(middle - axis.normalize() * 0.3), rotation)
    })
}

/// A corner of a room, 1.2 to 2 m away: two walls, a table, and things that stand on it.
pub fn room() -> Backdrop {
    scaled_room(1.0)
}

/// [`room`] with all lengths times `size`.
pub(crate) fn scaled_room(size: f32) -> Backdrop {
    let plane = |normal: [f64; 3], distance: f64, texture: Texture| {
        let n = Vector3::from(normal).normalize();
        Plane { normal: n.into(), distance: distance * f64::from(size), texture }
    };
    let wall = |seed, a, b| wall(seed, a, b, size);
    Backdrop {
        planes: vec![
            plane([0.12, 0.05, -1.0], 1.62, wall(31, [0.62, 0.63, 0.60], [0.72, 0.72, 0.67])),
            plane([-1.0, 0.0, -0.25], 1.05, wall(32, [0.55, 0.60, 0.64], [0.66, 0.69, 0.70])),
            plane([0.0, -1.0, -0.12], 0.46, wood()),
        ],
        furniture: vec![
            block([0.10, 0.13, 0.05], [-0.38, 0.14, 1.32], 0.4, [0.52, 0.22, 0.20], 41, size),
            block([0.06, 0.09, 0.06], [-0.10, 0.19, 1.42], -0.5, [0.26, 0.42, 0.30], 42, size),
            block([0.13, 0.05, 0.09], [0.36, 0.22, 1.28], 0.7, [0.72, 0.66, 0.42], 43, size),
        ],
    }
}

pub(crate) fn wall(seed: u32, a: [f32; 3], b: [f32; 3], size: f32) -> Texture {
    Texture {
        palette: vec![a, b],
        scale: 0.35 * size,
        octaves: 5,
        layers: vec![Layer {
            pattern: Pattern::Patches { scale: 0.5 * size, threshold: 0.66 },
            color: a.map(|c| c * 0.82),
            band: Some([-2.0 * size, -0.15 * size]),
        }],
        seed,
    }
}

pub(crate) fn wood() -> Texture {
    Texture {
        palette: vec![[0.42, 0.30, 0.20], [0.56, 0.42, 0.29]],
        scale: 0.08,
        octaves: 4,
        layers: vec![Layer {
            pattern: Pattern::Stripes { direction: [1.0, 0.0, 0.15], period: 0.09, duty: 0.12, warp: 0.05 },
            color: [0.36, 0.25, 0.16],
            band: None,
        }],
        seed: 21,
    }
}

/// A printed box with half-lengths `half` (metres) at `place` of the world frame, all lengths times `size`.
pub(crate) fn block(
    half: [f32; 3],
    place: [f64; 3],
    turn: f64,
    color: [f32; 3],
    seed: u32,
    size: f32,
) -> (Object, Isometry3<f64>) {
    let (half, place) = (half.map(|v| v * size), place.map(|v| v * f64::from(size)));
    let texture = Texture {
        palette: vec![color, color.map(|c| (c * 1.3).min(1.0))],
        scale: 0.07 * size,
        octaves: 4,
        layers: vec![Layer {
            pattern: Pattern::Glyphs { cell: 0.03 * size, density: 0.6, mapping: Mapping::Cube },
            color: color.map(|c| 1.0 - 0.7 * c),
            band: Some([-0.06 * size, 0.02 * size]),
        }],
        seed,
    };
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), turn);
    let pose = Isometry3::from_parts(Translation3::from(place), rotation);
    (Object::from_closed(crate::tessellate::cuboid(half), texture), pose)
}

impl Default for Grip {
    fn default() -> Self {
        Self { side: 0.45, reach: -0.006, shift: 0.012, lift: 0.6, period: 37.0 }
    }
}
