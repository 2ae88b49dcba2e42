//! A hand-like occluder: four fingers, a thumb, a palm and a forearm of rounded cones that close around the object.

use crate::tessellate::rounded_cone;
use crate::{Object, Shape, Texture};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

type V = Vector3<f64>;

/// Lengths and radii (metres) of the phalanges from knuckle to tip.
const FINGER: [(f64, f64); 3] = [(0.042, 0.0088), (0.027, 0.0080), (0.022, 0.0070)];
/// Largest flexion of the three joints, radians.
const FLEXION: [f64; 3] = [1.6, 1.75, 1.2];
const PALM_RADIUS: f64 = 0.0105;
const PALM_LENGTH: f64 = 0.075;
const SPREAD: f64 = 0.0195;
const FOREARM: f64 = 0.90;

/// How a [`Hand`] holds the object.
#[derive(Clone, Debug, PartialEq)]
pub struct Grip {
    /// Side of the object on which the palm lies: angle in the image from right towards down, radians.
    pub side: f64,
    /// How far the knuckles stand in front of the object's centre, metres; more covers more of the object.
    pub reach: f64,
    /// Place of the palm along the fingers' spread (up and down at `side` 0), metres from the object's centre.
    pub shift: f64,
    /// Angle by which a finger opens when it is lifted in turn, radians.
    pub lift: f64,
    /// Frames between two lifts of one finger.
    pub period: f64,
}

/// An articulated hand. It follows the object's place, not its turn, and closes each joint until the finger touches
/// the object's surface, as if the object was turned within the hand.
#[derive(Clone, Debug)]
pub struct Hand {
    grip: Grip,
    /// Three phalanges, a metacarpal, a forearm.
    parts: [Object; 5],
}

impl Hand {
    /// A hand with skin and sleeve of the given textures.
    pub fn new(grip: Grip, skin: Texture, sleeve: Texture) -> Self {
        let cone = |length: f64, a: f64, b: f64, texture: &Texture| {
            Object::from_closed(rounded_cone(length as f32, a as f32, b as f32), texture.clone())
        };
        let [a, b, c] = FINGER;
        let parts = [
            cone(a.0, a.1 * 1.08, b.1 * 1.04, &skin),
            cone(b.0, b.1 * 1.04, c.1 * 1.04, &skin),
            cone(c.0, c.1 * 1.04, c.1 * 0.85, &skin),
            cone(PALM_LENGTH, PALM_RADIUS * 1.1, PALM_RADIUS, &skin),
            cone(FOREARM, 0.027, 0.058, &sleeve),
        ];
        Self { grip, parts }
    }

    pub(crate) fn grip(&self) -> &Grip {
        &self.grip
    }

    /// The hand's parts at `time` (frames) around the object at `cam_from_obj`, each with `cam_from_part`.
    pub(crate) fn place(
        &self,
        time: f64,
        cam_from_obj: &Isometry3<f64>,
        object: &Object,
    ) -> Vec<(&Object, Isometry3<f64>)> {
        let touch = Touch { obj_from_cam: cam_from_obj.inverse(), shape: object.shape() };
        let frame = self.frame(time, cam_from_obj, object, &touch);
        let mut placed = Vec::with_capacity(24);
        let mut cone = |part: usize, from: V, towards: V, up: V| {
            let rotation = UnitQuaternion::face_towards(&towards, &up);
            placed.push((&self.parts[part], Isometry3::from_parts(Translation3::from(from), rotation)));
        };
        for finger in 0..4 {
            let side = frame.spread * ((finger as f64 - 1.5) * SPREAD);
            // Metacarpals converge towards the wrist.
            let knuckle = frame.knuckles + side;
            let towards = (frame.ahead * PALM_LENGTH + side * 0.35).normalize();
            cone(3, knuckle - towards * PALM_LENGTH, towards, frame.spread);
            let phase = time / self.grip.period.max(1e-6) - finger as f64 * 0.25;
            let lift = self.grip.lift * (std::f64::consts::TAU * phase).sin().max(0.0).powi(2);
            for (part, from, towards) in close(&touch, knuckle, frame.ahead, frame.inwards, lift) {
                cone(part, from, towards, frame.spread);
            }
        }
        // The thumb closes around the other side.
        let base = frame.knuckles - frame.ahead * (0.8 * PALM_LENGTH) - frame.spread * (1.2 * SPREAD);
        let back = (frame.ahead * -0.8 - frame.spread * 0.6).normalize();
        for (part, from, towards) in close(&touch, base, back, frame.inwards, 0.0) {
            cone(part, from, towards, frame.spread);
        }
        let wrist = frame.knuckles - frame.ahead * (PALM_LENGTH + 0.012);
        cone(4, wrist, frame.arm, frame.spread);
        placed
    }

    /// Lays the palm on the object.
    fn frame(&self, time: f64, cam_from_obj: &Isometry3<f64>, object: &Object, touch: &Touch<'_>) -> Frame {
        let wobble = 0.06 * (time / 23.0).sin();
        let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.grip.side + wobble);
        let (inwards, ahead, spread) = (roll * -V::x(), -V::z(), roll * V::y());
        let arm = roll * V::new(0.80, 0.30, 0.45).normalize();
        let middle = object.shape().and_then(Shape::bounds).map_or(Point3::origin(), |(a, b)| {
            Point3::from(std::array::from_fn::<f64, 3, _>(|k| 0.5 * (f64::from(a[k]) + f64::from(b[k]))))
        });
        let centre = (cam_from_obj * middle).coords + spread * self.grip.shift + ahead * self.grip.reach;
        let mut stand = 0.0f64;
        for finger in 0..4 {
            for back in [0.0, 0.5 * PALM_LENGTH, PALM_LENGTH] {
                let start = centre + spread * ((f64::from(finger) - 1.5) * SPREAD) - ahead * back;
                stand = stand.max(touch.stand_off(start, inwards, 1.2 * PALM_RADIUS));
            }
        }
        Frame { knuckles: centre - inwards * stand, inwards, ahead, spread, arm }
    }
}

/// The hand's axes in the camera frame.
struct Frame {
    knuckles: V,
    /// From the palm to the object.
    inwards: V,
    /// From the wrist to the knuckles.
    ahead: V,
    spread: V,
    /// From the wrist to the elbow.
    arm: V,
}

/// Distance from camera-frame points to the object.
struct Touch<'a> {
    obj_from_cam: Isometry3<f64>,
    shape: Option<&'a Shape>,
}

impl Touch<'_> {
    fn distance(&self, p: V) -> f64 {
        let q: [f64; 3] = (self.obj_from_cam * Point3::from(p)).coords.into();
        self.shape.map_or(f64::INFINITY, |s| f64::from(s.distance(q.map(|v| v as f32))))
    }

    /// How far from `centre`, against `inwards`, a ball of `radius` coming from outside meets the object.
    fn stand_off(&self, centre: V, inwards: V, radius: f64) -> f64 {
        let mut s = 0.25;
        for _ in 0..40 {
            let gap = self.distance(centre - inwards * s) - radius;
            if gap < 2e-4 || s <= 0.0 {
                break;
            }
            s -= gap.min(s.max(1e-3));
        }
        s.max(0.0)
    }
}

/// Closes a finger joint by joint from `ahead` towards `inwards` until it touches; gives part, start and direction
/// of its phalanges.
fn close(touch: &Touch<'_>, knuckle: V, ahead: V, inwards: V, lift: f64) -> [(usize, V, V); 3] {
    let direction = |angle: f64| ahead * angle.cos() + inwards * angle.sin();
    let mut angles = [0.0; 3];
    let (mut from, mut bent) = (knuckle, 0.0);
    for (joint, &(length, radius)) in FINGER.iter().enumerate() {
        let free = |flex: f64| {
            let towards = direction(bent + flex);
            [0.35, 0.7, 1.0].iter().all(|t| touch.distance(from + towards * (length * t)) > radius)
        };
        let first = if joint == 0 { -0.6 } else { -0.1 };
        angles[joint] = flexion(free, first, FLEXION[joint]);
        bent += angles[joint];
        from += direction(bent) * length;
    }
    let (mut from, mut bent) = (knuckle, -lift);
    std::array::from_fn(|joint| {
        bent += angles[joint];
        let towards = direction(bent);
        let start = from;
        from += towards * FINGER[joint].0;
        (joint, start, towards)
    })
}

/// The largest flexion up to which the phalanx stays free, found in steps and refined by bisection.
fn flexion(free: impl Fn(f64) -> bool, first: f64, last: f64) -> f64 {
    const STEP: f64 = 0.08;
    let mut at = first;
    while at < last {
        if !free(at + STEP) {
            let (mut a, mut b) = (at, at + STEP);
            for _ in 0..5 {
                let m = 0.5 * (a + b);
                if free(m) { a = m } else { b = m }
            }
            return a;
        }
        at += STEP;
    }
    last
}
