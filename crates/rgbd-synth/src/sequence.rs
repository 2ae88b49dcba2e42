//! A sequence: what is in it, and rendering its frames.

use crate::backdrop::Behind;
use crate::scene::{self, Body, Camera, Clean};
use crate::{Backdrop, Error, Hand, Light, MaskFaults, Motion, Object, Sensor};
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3};
use rgbd_io::{FrameSource, Image, Intrinsics, Mask, RgbdFrame};
use std::sync::{Arc, OnceLock};

const OBJECT: u8 = 1;
const OCCLUDER: u8 = 2;
/// Most exposures that are averaged for motion blur; odd, so that one falls on the frame's own time.
const MOST_EXPOSURES: usize = 9;
/// Pixels that the fastest point may move between two exposures, unless that takes more than the most.
const SMEAR: f64 = 2.0;

/// For which frames [`RgbdFrame::mask`] is filled.
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
        /// Its `world_from_body`.
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
    /// The object's `world_from_obj`: its `cam_from_obj` while the camera stands still.
    pub motion: Motion,
    /// The camera's `cam_from_world` if it moves; `None` makes the camera's frame the world's. Backdrop, light and
    /// rigid occluders are fixed in the world.
    pub camera: Option<Motion>,
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
    /// What is wrong with the masks of the frames after the first.
    pub mask_faults: MaskFaults,
}

/// One rendered frame with its truth.
#[derive(Clone, Debug)]
pub struct SynthFrame {
    /// What the sensor delivers. Its mask follows [`SequenceSpec::masks`] and [`SequenceSpec::mask_faults`].
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

    /// The same sequence with other random choices of the sensor and of the masks' faults.
    #[must_use]
    pub fn with_seed(&self, seed: u64) -> Self {
        Self::from_spec(SequenceSpec { seed, ..self.0.spec.clone() })
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
        self.pose(index as f64)
    }

    /// The camera's true `cam_from_world` at frame `index`; the identity unless the camera moves.
    pub fn cam_from_world(&self, index: usize) -> Isometry3<f64> {
        self.world(index as f64)
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
            mask: mask.then(|| spec.mask_faults.apply(&visible_mask, spec.seed, index)),
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

    fn world(&self, time: f64) -> Isometry3<f64> {
        self.0.spec.camera.as_ref().map_or_else(Isometry3::identity, |m| m.at(time))
    }

    fn pose(&self, time: f64) -> Isometry3<f64> {
        self.world(time) * self.0.spec.motion.at(time)
    }

    /// The true visible mask of frame `index` (`255` = object) without the colours: what [`Sequence::render`] gives,
    /// for a fraction of the time.
    pub fn visible_mask(&self, index: usize) -> Mask {
        let spec = &self.0.spec;
        let camera = self.camera();
        let bodies = self.bodies(index as f64);
        let hits: Vec<_> = bodies.iter().map(|b| scene::silhouette(&camera, b)).collect();
        let Some((object, others)) = hits.split_first() else { return Mask::default() };
        let behind = Behind::new(&spec.backdrop, camera, &self.cam_from_world(index));
        Image::from_fn(spec.width, spec.height, |x, y| {
            let seen = object.at(x, y).is_some_and(|(z, _)| {
                z < behind.at(x, y) && others.iter().all(|o| o.at(x, y).is_none_or(|(near, _)| near >= z))
            });
            if seen { 255 } else { 0 }
        })
    }

    fn clean(&self, index: usize) -> Clean {
        let exposure = f64::from(self.0.spec.sensor.exposure);
        let time = index as f64;
        let mut clean = self.clean_at(time);
        let count = self.exposures(time, exposure);
        if count > 1 {
            let share = 1.0 / count as f32;
            clean.color.iter_mut().for_each(|c| *c = c.map(|v| v * share));
            // The shutter's opening is centred on the frame's time, where depth and pose are true.
            for e in (0..count).filter(|e| *e != count / 2) {
                let moment = time + exposure * ((e as f64 + 0.5) / count as f64 - 0.5);
                for (sum, c) in clean.color.iter_mut().zip(self.clean_at(moment).color) {
                    *sum = std::array::from_fn(|k| sum[k] + share * c[k]);
                }
            }
        }
        clean
    }

    /// How many exposures make the blur of the object at `time` look smooth.
    fn exposures(&self, time: f64, exposure: f64) -> usize {
        if exposure.is_nan() || exposure <= 0.0 {
            return 1;
        }
        let spec = &self.0.spec;
        let ends = [-0.5, 0.5].map(|s| self.pose(time + s * exposure));
        let (low, high) = spec.object.mesh().bounds().unwrap_or_default();
        let moved = (0..8).filter_map(|corner| {
            let p = Point3::from(std::array::from_fn::<f64, 3, _>(|k| {
                f64::from(if corner >> k & 1 == 0 { low[k] } else { high[k] })
            }));
            let [a, b] = ends.map(|pose| spec.intrinsics.project((pose * p).coords.into()));
            a.zip(b).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]))
        });
        let steps = moved.fold(0.0, f64::max) / SMEAR;
        // Odd. Other things move too: never fewer than three.
        1 + 2 * (0.5 * steps).ceil().clamp(1.0, (MOST_EXPOSURES / 2) as f64) as usize
    }

    fn clean_at(&self, time: f64) -> Clean {
        let spec = &self.0.spec;
        let camera = self.camera();
        let world = self.world(time);
        let direction = world.rotation.cast() * nalgebra::Vector3::from(spec.light.direction);
        let light = Light { direction: direction.into(), ..spec.light };
        let bodies = self.bodies(time);
        if spec.camera.is_some() {
            let backdrop = scene::backdrop(&camera, &spec.backdrop, &world, &light, false);
            return scene::render(&camera, &bodies, &light, &backdrop);
        }
        scene::render(&camera, &bodies, &light, self.still_backdrop())
    }

    /// What a camera that doesn't move sees behind the bodies; rendered once.
    fn still_backdrop(&self) -> &Clean {
        let spec = &self.0.spec;
        self.0.backdrop.get_or_init(|| {
            scene::backdrop(&self.camera(), &spec.backdrop, &Isometry3::identity(), &spec.light, true)
        })
    }

    /// The object, then everything that can hide it.
    fn bodies(&self, time: f64) -> Vec<Body<'_>> {
        let spec = &self.0.spec;
        let cam_from_world = self.world(time);
        let cam_from_obj = cam_from_world * spec.motion.at(time);
        let mut bodies = vec![Body { object: &spec.object, cam_from_body: cam_from_obj, label: OBJECT }];
        for occluder in &spec.occluders {
            match occluder {
                Occluder::Hand(hand) => {
                    for (object, cam_from_body) in hand.place(time, &cam_from_obj, &spec.object) {
                        bodies.push(Body { object, cam_from_body, label: OCCLUDER });
                    }
                }
                Occluder::Rigid { object, motion } => {
                    let cam_from_body = cam_from_world * motion.at(time);
                    bodies.push(Body { object, cam_from_body, label: OCCLUDER });
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
