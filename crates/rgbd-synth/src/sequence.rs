//! A sequence: what is in it, and rendering its frames.

use crate::scene::{self, Body, Camera, Clean};
use crate::{Backdrop, Error, Hand, Light, Motion, Object, Sensor};
use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::{FrameSource, Image, Intrinsics, Mask, RgbdFrame};
use std::sync::{Arc, OnceLock};

const OBJECT: u8 = 1;
const OCCLUDER: u8 = 2;
/// Exposures that are averaged for motion blur.
const EXPOSURES: usize = 5;

/// For which frames [`RgbdFrame::mask`] is filled with the true visible mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Masks {
    /// No frame.
    None,
    /// Frame 0 alone: what a tracker of masks starts from.
    First,
    /// All frames.
    #[default]
    Every,
}

/// Something that can hide the object.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Occluder {
    /// A hand that holds the object.
    Hand(Box<Hand>),
    /// A rigid body on a path of its own.
    Rigid {
        /// The body.
        object: Arc<Object>,
        /// Its `cam_from_body`.
        motion: Motion,
    },
}

/// Everything a sequence is made of.
#[derive(Clone, Debug)]
pub struct SequenceSpec {
    /// Short name, for folders and reports.
    pub name: String,
    /// Number of frames.
    pub frames: usize,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// All of the sensor's random choices follow from this.
    pub seed: u64,
    /// The object to track.
    pub object: Arc<Object>,
    /// The object's `cam_from_obj`.
    pub motion: Motion,
    /// What hides it.
    pub occluders: Vec<Occluder>,
    /// What stands behind it.
    pub backdrop: Backdrop,
    /// The light.
    pub light: Light,
    /// The sensor's faults.
    pub sensor: Sensor,
    /// Which frames come with a mask.
    pub masks: Masks,
}

/// One rendered frame with its truth.
#[derive(Clone, Debug)]
pub struct SynthFrame {
    /// What the sensor delivers. Its mask follows [`SequenceSpec::masks`].
    pub frame: RgbdFrame,
    /// Pixels whose centre sees the object: `255`, all others `0`.
    pub visible_mask: Mask,
    /// z-depth of whatever each pixel centre sees, metres, without any fault; `0` where nothing is.
    pub true_depth: Image<f32>,
    /// Maps the object's frame to the camera's.
    pub cam_from_obj: Isometry3<f64>,
}

/// A synthetic sequence. Frames can be rendered in any order and from any thread with the same result; copies share
/// what they hold.
#[derive(Clone, Debug)]
pub struct Sequence(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    spec: SequenceSpec,
    ids: Vec<String>,
    backdrop: OnceLock<Clean>,
}

impl std::fmt::Debug for Clean {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Clean").field("pixels", &self.depth.len()).finish_non_exhaustive()
    }
}

impl Sequence {
    /// A sequence of `spec`.
    ///
    /// # Errors
    /// When the image is empty or the intrinsics are not finite and positive.
    pub fn new(spec: SequenceSpec) -> Result<Self, Error> {
        if !spec.intrinsics.is_valid() {
            return Err(Error::Intrinsics(spec.intrinsics));
        }
        if spec.width == 0 || spec.height == 0 {
            return Err(Error::EmptyImage { width: spec.width, height: spec.height });
        }
        Ok(Self::from_spec(spec))
    }

    pub(crate) fn from_spec(spec: SequenceSpec) -> Self {
        let ids = (0..spec.frames).map(|i| format!("{i:06}")).collect();
        Self(Arc::new(Inner { spec, ids, backdrop: OnceLock::new() }))
    }

    /// What the sequence is made of; a changed copy gives a new one through [`Sequence::new`].
    pub fn spec(&self) -> &SequenceSpec {
        &self.0.spec
    }

    /// The same sequence with another choice of masks.
    #[must_use]
    pub fn with_masks(&self, masks: Masks) -> Self {
        Self::from_spec(SequenceSpec { masks, ..self.0.spec.clone() })
    }

    /// The same sequence with another sensor.
    #[must_use]
    pub fn with_sensor(&self, sensor: Sensor) -> Self {
        Self::from_spec(SequenceSpec { sensor, ..self.0.spec.clone() })
    }

    /// The first `frames` frames of the sequence.
    #[must_use]
    pub fn truncated(&self, frames: usize) -> Self {
        Self::from_spec(SequenceSpec { frames: frames.min(self.len()), ..self.0.spec.clone() })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.0.spec.frames
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Name of the sequence.
    pub fn name(&self) -> &str {
        &self.0.spec.name
    }

    /// The camera.
    pub fn intrinsics(&self) -> Intrinsics {
        self.0.spec.intrinsics
    }

    /// The object's true surface in its own frame, metres, with the texture's colours at the vertices.
    pub fn mesh(&self) -> &TriMesh {
        self.0.spec.object.mesh()
    }

    /// The true pose at frame `index`: maps the object's frame to the camera's.
    pub fn cam_from_obj(&self, index: usize) -> Isometry3<f64> {
        self.0.spec.motion.at(index as f64)
    }

    /// Renders frame `index`; the motion goes on beyond the last frame.
    pub fn render(&self, index: usize) -> SynthFrame {
        let spec = &self.0.spec;
        let camera = self.camera();
        let clean = self.clean(index);
        let visible = clean.label.iter().map(|&l| if l == OBJECT { 255 } else { 0 }).collect();
        let visible_mask = Image::from_vec(spec.width, spec.height, visible).unwrap_or_default();
        let mask = match spec.masks {
            Masks::Every => true,
            Masks::First => index == 0,
            Masks::None => false,
        };
        let frame = RgbdFrame {
            id: self.0.ids.get(index).cloned().unwrap_or_else(|| format!("{index:06}")),
            color: spec.sensor.color(&clean.color, &camera, spec.seed, index),
            depth: spec.sensor.depth(&clean, &camera, spec.seed, index),
            mask: mask.then(|| visible_mask.clone()),
            intrinsics: spec.intrinsics,
        };
        let mut true_depth = clean.depth;
        true_depth.iter_mut().filter(|z| !z.is_finite()).for_each(|z| *z = 0.0);
        let true_depth = Image::from_vec(spec.width, spec.height, true_depth).unwrap_or_default();
        SynthFrame { frame, visible_mask, true_depth, cam_from_obj: self.cam_from_obj(index) }
    }

    /// Share of the object's pixels in frame `index` that something hides; `0` when the object is out of the image.
    pub fn occlusion(&self, index: usize) -> f64 {
        let spec = &self.0.spec;
        let time = index as f64;
        let bodies = self.bodies(time);
        let Some(object) = bodies.first() else { return 0.0 };
        let camera = self.camera();
        let alone = scene::silhouette(&camera, object);
        let others: Vec<_> = bodies[1..].iter().map(|b| scene::silhouette(&camera, b)).collect();
        let (mut all, mut lost) = (0usize, 0usize);
        for y in 0..spec.height {
            for x in 0..spec.width {
                let Some((z, _)) = alone.at(x, y) else { continue };
                all += 1;
                lost += usize::from(others.iter().any(|o| o.at(x, y).is_some_and(|(near, _)| near < z)));
            }
        }
        if all == 0 { 0.0 } else { lost as f64 / all as f64 }
    }

    fn camera(&self) -> Camera {
        let spec = &self.0.spec;
        Camera { k: spec.intrinsics, width: spec.width, height: spec.height }
    }

    fn clean(&self, index: usize) -> Clean {
        let spec = &self.0.spec;
        let camera = self.camera();
        let backdrop = self.0.backdrop.get_or_init(|| scene::backdrop(&camera, &spec.backdrop, &spec.light));
        let time = index as f64;
        let mut clean = scene::render(&camera, &self.bodies(time), &spec.light, backdrop);
        if spec.sensor.exposure > 0.0 {
            let mut sum = vec![[0.0f32; 3]; clean.color.len()];
            for e in 0..EXPOSURES {
                // The shutter's opening is centred on the frame's time, where depth and pose are true.
                let share = (e as f64 + 0.5) / EXPOSURES as f64 - 0.5;
                let bodies = self.bodies(time + share * f64::from(spec.sensor.exposure));
                let color = scene::render_color(&camera, &bodies, &spec.light, backdrop);
                for (s, c) in sum.iter_mut().zip(color) {
                    *s = std::array::from_fn(|k| s[k] + c[k] / EXPOSURES as f32);
                }
            }
            clean.color = sum;
        }
        clean
    }

    /// The object, then everything that can hide it.
    fn bodies(&self, time: f64) -> Vec<Body<'_>> {
        let spec = &self.0.spec;
        let cam_from_obj = spec.motion.at(time);
        let mut bodies = vec![Body { object: &spec.object, cam_from_body: cam_from_obj, label: OBJECT }];
        for occluder in &spec.occluders {
            match occluder {
                Occluder::Hand(hand) => {
                    for (object, cam_from_body) in hand.place(time, &cam_from_obj, &spec.object) {
                        bodies.push(Body { object, cam_from_body, label: OCCLUDER });
                    }
                }
                Occluder::Rigid { object, motion } => {
                    bodies.push(Body { object, cam_from_body: motion.at(time), label: OCCLUDER });
                }
            }
        }
        bodies
    }
}

impl FrameSource for Sequence {
    fn len(&self) -> usize {
        self.0.spec.frames
    }

    fn id(&self, index: usize) -> &str {
        self.0.ids.get(index).map_or("", String::as_str)
    }

    fn frame(&self, index: usize) -> Result<RgbdFrame, rgbd_io::Error> {
        if index >= self.0.spec.frames {
            let remedy = format!("ask for frames below {}", self.0.spec.frames);
            return Err(rgbd_io::Error::new(&self.0.spec.name, format!("has no frame {index}"), remedy));
        }
        Ok(self.render(index).frame)
    }
}
