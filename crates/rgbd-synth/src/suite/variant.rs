//! The suite in other make-ups: what a method was not developed on.

use super::motions::curtain;
use super::objects;
use crate::noise::{mix, unit};
use crate::{Backdrop, Grip, Hand, Motion, Occluder, Plane, Sequence, SequenceSpec, Texture, presets};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::sync::Arc;

impl Sequence {
    /// The sequence of the suite with this name in another make-up: the same shape and the same difficulty, in other
    /// colours, seen from another side at first, on another course, held otherwise, before another room, with other
    /// noise. Variant 0 is [`Sequence::named`]; `None` for names that the suite doesn't have.
    pub fn variant(name: &str, variant: u64) -> Option<Self> {
        let sequence = Self::named(name)?;
        if variant == 0 {
            return Some(sequence);
        }
        Some(Self::from_spec(varied(sequence.spec().clone(), variant)))
    }

    /// The same sequence with a card before the camera that hides everything of the object from frame `from` to frame
    /// `to`; it comes in within the 16 frames before and leaves within the 16 after.
    #[must_use]
    pub fn hidden_between(&self, from: f64, to: f64) -> Self {
        let mut spec = self.spec().clone();
        let object = objects::card([0.17, 0.145, 0.002], 62);
        // The suite's card crosses at 0.4 m; it has to cross before the object.
        let nearer = (0.6 * spec.motion_in_camera(from).translation.z / 0.4).min(1.0);
        let (camera, across) = (spec.camera.clone(), curtain([from, to]));
        let motion = Motion::from_fn(move |t| {
            let mut pose = across.at(t);
            pose.translation.vector *= nearer;
            camera.as_ref().map_or(pose, |camera| camera.at(t).inverse() * pose)
        });
        spec.occluders.push(Occluder::Rigid { object, motion });
        Self::from_spec(spec)
    }
}

/// Random choices, one after the other.
struct Dice(u64);

impl Dice {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = mix(self.0);
        low + (high - low) * f64::from(unit(self.0, 0))
    }

    fn seed(&mut self) -> u32 {
        self.between(0.0, 1e6) as u32
    }
}

fn varied(spec: SequenceSpec, variant: u64) -> SequenceSpec {
    let mut dice = Dice(mix(spec.seed ^ variant << 32));
    let object = Arc::new(spec.object.with_texture(&dyed(spec.object.texture(), &mut dice, 3.2)));
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), dice.between(-3.1, 3.1));
    // Later starts of the same course; those that begin calmly stay calm for longer.
    let (delay, original) = (dice.between(0.0, 50.0), spec.motion.clone());
    let motion = Motion::from_fn(move |t| original.at(t - delay) * turn);
    let camera = spec.camera.clone().map(|camera| Motion::from_fn(move |t| camera.at(t - delay)));
    let occluders = spec.occluders.iter().map(|o| occluder(o, &mut dice)).collect();
    let backdrop = backdrop(&spec.backdrop, &mut dice);
    let seed = u64::from(dice.seed());
    SequenceSpec { seed, object, motion, camera, occluders, backdrop, ..spec }
}

fn occluder(occluder: &Occluder, dice: &mut Dice) -> Occluder {
    match occluder {
        Occluder::Hand(hand) => {
            let grip = hand.grip();
            let grip = Grip {
                side: grip.side + dice.between(-0.35, 0.35),
                shift: grip.shift + dice.between(-0.008, 0.008),
                period: grip.period * dice.between(0.8, 1.25),
                ..grip.clone()
            };
            // Skin keeps its hue, from pale to dark.
            let skin = dyed(&presets::skin(), dice, 0.12);
            Occluder::Hand(Box::new(Hand::new(grip, skin, dyed(&presets::sleeve(), dice, 3.2))))
        }
        Occluder::Rigid { object, motion } => {
            let object = Arc::new(object.with_texture(&dyed(object.texture(), dice, 3.2)));
            Occluder::Rigid { object, motion: motion.clone() }
        }
    }
}

fn backdrop(backdrop: &Backdrop, dice: &mut Dice) -> Backdrop {
    let plane = |p: &Plane, dice: &mut Dice| Plane { texture: dyed(&p.texture, dice, 3.2), ..p.clone() };
    let planes = backdrop.planes.iter().map(|p| plane(p, dice)).collect();
    let furniture = backdrop.furniture.iter().map(|(object, pose)| {
        let shift = Translation3::new(dice.between(-0.05, 0.05), 0.0, dice.between(-0.05, 0.05));
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), dice.between(-1.0, 1.0));
        let pose: Isometry3<f64> = shift * pose * turn;
        (object.with_texture(&dyed(object.texture(), dice, 3.2)), pose)
    });
    Backdrop { planes, furniture: furniture.collect() }
}

/// The texture with another seed, its hues turned by up to `most` radians, all darker or lighter.
fn dyed(texture: &Texture, dice: &mut Dice, most: f64) -> Texture {
    let turn = dice.between(-most, most) as f32;
    let gain = dice.between(0.55, 1.1) as f32;
    let grey = Vector3::new(1.0f32, 1.0, 1.0);
    let rotation = UnitQuaternion::from_scaled_axis(grey.normalize() * turn);
    let dye = |c: [f32; 3]| -> [f32; 3] {
        let turned: [f32; 3] = (rotation * Vector3::from(c)).into();
        turned.map(|v| (gain * v).clamp(0.02, 0.98))
    };
    let mut texture = texture.clone();
    texture.palette.iter_mut().for_each(|c| *c = dye(*c));
    texture.layers.iter_mut().for_each(|layer| layer.color = dye(layer.color));
    texture.seed ^= dice.seed();
    texture
}

impl SequenceSpec {
    fn motion_in_camera(&self, time: f64) -> Isometry3<f64> {
        let world = self.camera.as_ref().map_or_else(Isometry3::identity, |m| m.at(time));
        world * self.motion.at(time)
    }
}
