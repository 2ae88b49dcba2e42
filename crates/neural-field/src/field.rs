//! A trained field: distances, colours, poses.

use crate::config::FieldConfig;
use crate::contrast::Brightness;
use crate::frame::FieldImages;
use crate::grid::Grid;
use crate::mlp::Networks;
use crate::query::{Query, QueryColor};
use crate::rays::FrameRays;
use crate::round::Round;
use crate::simd::Set;
use crate::tile::{Aligned, Model, Scratch};
use crate::train::StepLosses;
use crate::volume::occupancy;
use nalgebra::{Isometry3, Point3, Vector3};
use octree_sampler::VoxelOctree;
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;

/// Points evaluated together.
const BLOCK: usize = 64;
/// Points per task when a query is large enough to be worth both cores.
const TASK: usize = 8192;
/// Depth points per frame that enter its residual.
const RESIDUAL_POINTS: usize = 512;
/// With this many frames a point of the surface is seen by more than one.
const MANY_FRAMES: usize = 20;
/// Points per frame that support the mesh.
const SUPPORT_POINTS: usize = 40_000;

/// What training finds, apart from the poses.
#[derive(Clone, Debug)]
pub(crate) struct Parameters {
    pub(crate) grid: Grid<f32>,
    pub(crate) networks: Networks,
    /// In the flat layout of [`Networks`].
    pub(crate) weights: Vec<f32>,
}

/// The result of a round: an object's signed distance and colour in the object frame, with refined poses.
///
/// Immutable; share it between threads in an `Arc`.
#[derive(Clone, Debug)]
pub struct TrainedField {
    grid: Grid<f32>,
    networks: Networks,
    weights: Vec<f32>,
    /// Transposes of some of the weights.
    flipped: Aligned<f32>,
    truncation: f64,
    center: [f64; 3],
    edge: f64,
    /// Takes points of the object frame to the frame in which the networks were trained.
    field_from_obj: Isometry3<f64>,
    octree: VoxelOctree,
    support: VoxelOctree,
    /// What the networks say in the middle of the depth points, metres: the zero level is there.
    zero: f32,
    /// What was taken out of the colours, if anything was.
    brightness: Option<Brightness>,
    /// How far behind a measured point the sign of the distance is known, metres.
    reach: f64,
    frames: Vec<Arc<FieldImages>>,
    poses: Vec<Isometry3<f64>>,
    residuals: Vec<f32>,
    losses: Vec<StepLosses>,
}

impl TrainedField {
    /// The zero level is moved to the middle of the depth points: losses in free space keep it a little behind them, all
    /// over, and poses that are drawn to it would follow, round after round.
    pub(crate) fn new(round: &Round, parameters: Parameters, losses: Vec<StepLosses>) -> Self {
        let Round { config, frames, sampler, corrections } = round;
        let poses = corrections.poses();
        let volume = sampler.volume();
        // Occupancy under the refined poses; the old one is a fallback that cannot be needed for finite poses.
        let octree =
            occupancy(frames, &poses, volume.octree.voxel_size()).unwrap_or_else(|| volume.octree.clone());
        let support = support(config, &octree, frames, &poses);
        let mut weights = parameters.weights;
        parameters.networks.codes.settle(&mut weights);
        let flipped = parameters.networks.flip_all(&weights);
        let brightness =
            (config.contrast_window > 0.0).then(|| Brightness::new(volume, sampler.rays(), &poses));
        let mut field = Self {
            grid: parameters.grid,
            networks: parameters.networks,
            weights,
            flipped,
            truncation: config.truncation,
            zero: 0.0,
            brightness,
            residuals: Vec::new(),
            losses,
            reach: reach(config),
            frames: frames.clone(),
            support: support.unwrap_or_else(|| octree.clone()),
            center: volume.center,
            edge: volume.edge,
            field_from_obj: corrections.field_from_obj(),
            octree,
            poses,
        };
        let mut distances: Vec<Vec<f32>> = field
            .poses
            .par_iter()
            .zip(sampler.rays())
            .map(|(pose, rays)| field.distances(pose, rays))
            .collect();
        field.zero = middle(&mut distances.concat()).unwrap_or(0.0);
        let residual = |of_frame: &mut Vec<f32>| {
            of_frame.iter_mut().for_each(|v| *v = (*v - field.zero).abs());
            middle(of_frame).unwrap_or(f32::NAN)
        };
        field.residuals = distances.iter_mut().map(residual).collect();
        field
    }

    /// Refined `obj_from_cam` per frame, metres. The first is bit-identical to the one given to
    /// [`train`](crate::train).
    pub fn poses(&self) -> &[Isometry3<f64>] {
        &self.poses
    }

    /// Losses of every step.
    pub fn losses(&self) -> &[StepLosses] {
        &self.losses
    }

    /// Per frame, the median absolute distance of its depth points to the field's surface under its refined pose,
    /// metres; NaN for a frame without usable depth. A frame far above the others has a bad pose or a bad mask.
    pub fn frame_residuals(&self) -> &[f32] {
        &self.residuals
    }

    /// Occupied space: outside of it the field is unknown.
    pub fn octree(&self) -> &VoxelOctree {
        &self.octree
    }

    /// Truncation distance, metres: within this distance of the surface the field is a distance, further outside it
    /// only says "outside".
    pub fn truncation(&self) -> f64 {
        self.truncation
    }

    pub(crate) fn support(&self) -> &VoxelOctree {
        &self.support
    }

    pub(crate) fn reach(&self) -> f64 {
        self.reach
    }

    /// What it was trained on, as many as there are poses.
    pub(crate) fn frames(&self) -> &[Arc<FieldImages>] {
        &self.frames
    }

    fn model(&self) -> Model<'_, f32> {
        Model {
            grid: &self.grid,
            networks: &self.networks,
            weights: &self.weights,
            flipped: &self.flipped,
            truncation: (self.truncation / self.edge) as f32,
        }
    }

    /// Signed distances in metres of points in the object frame: positive outside the object, NaN where unknown
    /// (outside the occupied space). Only as many points as both slices have are evaluated.
    pub fn sdf(&self, points: &[[f32; 3]], sdf: &mut [f32]) {
        self.evaluate(points, sdf, None);
    }

    /// Signed distances as [`sdf`](Self::sdf), with their gradients by the point (object frame, no unit; close to
    /// unit length near the surface). NaN where unknown.
    pub fn sdf_and_gradient(&self, points: &[[f32; 3]], sdf: &mut [f32], gradient: &mut [[f32; 3]]) {
        self.evaluate(points, sdf, Some(gradient));
    }

    fn evaluate(&self, points: &[[f32; 3]], sdf: &mut [f32], gradient: Option<&mut [[f32; 3]]>) {
        let n = points.len().min(sdf.len());
        let (points, sdf) = (&points[..n], &mut sdf[..n]);
        match gradient {
            None if n <= TASK => self.evaluate_task(points, sdf, None),
            None => points
                .par_chunks(TASK)
                .zip(sdf.par_chunks_mut(TASK))
                .for_each(|(p, s)| self.evaluate_task(p, s, None)),
            Some(g) => {
                let n = n.min(g.len());
                let (points, sdf, g) = (&points[..n], &mut sdf[..n], &mut g[..n]);
                if n <= TASK {
                    self.evaluate_task(points, sdf, Some(g));
                    return;
                }
                points
                    .par_chunks(TASK)
                    .zip(sdf.par_chunks_mut(TASK))
                    .zip(g.par_chunks_mut(TASK))
                    .for_each(|((p, s), g)| self.evaluate_task(p, s, Some(g)));
            }
        }
    }

    fn evaluate_task(&self, points: &[[f32; 3]], sdf: &mut [f32], mut gradient: Option<&mut [[f32; 3]]>) {
        let (set, model) = (Set::best(), self.model());
        let mut scratch = Scratch::new(BLOCK, BLOCK, &self.networks);
        let mut pos = vec![0.0; 3 * BLOCK];
        for start in (0..points.len()).step_by(BLOCK) {
            let block = &points[start..points.len().min(start + BLOCK)];
            self.place_block(block, &mut pos);
            if gradient.is_some() {
                let (model, pos, scratch) = (&model, &pos, &mut scratch);
                set.call(Query::<f32, true> { model, lanes: BLOCK, pos, scratch });
            } else {
                let (model, pos, scratch) = (&model, &pos, &mut scratch);
                set.call(Query::<f32, false> { model, lanes: BLOCK, pos, scratch });
            }
            for (l, p) in block.iter().enumerate() {
                sdf[start + l] = self.distance(*p, scratch.distances()[l]);
                if let Some(g) = gradient.as_deref_mut() {
                    let d = self.slope([0, 1, 2].map(|a| scratch.slopes()[a * BLOCK + l]));
                    g[start + l] = d.map(|v| self.known(*p, v));
                }
            }
        }
    }

    /// Colours (RGB in 0..1) of points in the object frame seen along unit view directions (object frame, from the
    /// camera to the point). Meaningful near the surface; NaN outside the occupied space.
    pub fn color(&self, points: &[[f32; 3]], view_dirs: &[[f32; 3]], out: &mut [[f32; 3]]) {
        let n = points.len().min(view_dirs.len()).min(out.len());
        points[..n]
            .par_chunks(TASK)
            .zip(view_dirs[..n].par_chunks(TASK))
            .zip(out[..n].par_chunks_mut(TASK))
            .for_each(|((p, d), o)| self.color_task(p, d, o));
    }

    fn color_task(&self, points: &[[f32; 3]], dirs: &[[f32; 3]], out: &mut [[f32; 3]]) {
        let (set, model) = (Set::best(), self.model());
        let mut scratch = Scratch::new(BLOCK, BLOCK, &self.networks);
        let mut pos = vec![0.0; 3 * BLOCK];
        let mut views = [[0.0; 3]; BLOCK];
        for start in (0..points.len()).step_by(BLOCK) {
            let end = points.len().min(start + BLOCK);
            self.place_block(&points[start..end], &mut pos);
            let (model, scratch) = (&model, &mut scratch);
            set.call(Query::<f32, false> { model, lanes: BLOCK, pos: &pos, scratch });
            for (view, d) in views.iter_mut().zip(&dirs[start..end]) {
                *view = self.view(*d);
            }
            set.call(QueryColor { model, lanes: BLOCK, dirs: &views, scratch });
            for l in 0..end - start {
                out[start + l] = self.color_at(points[start + l], scratch.color(l));
            }
        }
    }

    /// Writes points as positions in the unit cube, `[axis][lane]`; unused lanes keep what they had.
    fn place_block(&self, points: &[[f32; 3]], pos: &mut [f32]) {
        for (l, p) in points.iter().enumerate() {
            for (a, v) in self.place(*p).into_iter().enumerate() {
                pos[a * BLOCK + l] = v;
            }
        }
    }

    /// A point of the object frame as a position in the unit cube; moved to the nearest one if outside.
    pub(crate) fn place(&self, point: [f32; 3]) -> [f32; 3] {
        let inverse = 1.0 / self.edge;
        let p = self.field_from_obj * Point3::from(point.map(f64::from));
        std::array::from_fn(|a| {
            let x = (p[a] - self.center[a]) * inverse + 0.5;
            if x.is_finite() { x.clamp(0.0, 1.0) as f32 } else { 0.5 }
        })
    }

    /// The gradient by an object point, no unit, from the network's slope per edge of the cube.
    pub(crate) fn slope(&self, by_place: [f32; 3]) -> [f32; 3] {
        let per_metre = (self.truncation / self.edge) as f32;
        let d = Vector3::from(by_place.map(|v| f64::from(per_metre * v)));
        let d = self.field_from_obj.rotation.inverse_transform_vector(&d);
        [d.x as f32, d.y as f32, d.z as f32]
    }

    /// A view direction of the object frame as the networks know it.
    pub(crate) fn view(&self, dir: [f32; 3]) -> [f32; 3] {
        let d = self.field_from_obj.rotation * Vector3::from(dir.map(f64::from));
        [d.x as f32, d.y as f32, d.z as f32]
    }

    /// The signed distance at a point, metres, from what the networks say, truncation units.
    pub(crate) fn distance(&self, point: [f32; 3], value: f32) -> f32 {
        self.known(point, self.truncation as f32 * value - self.zero)
    }

    /// The colour at a point from what the networks say.
    pub(crate) fn color_at(&self, point: [f32; 3], rgb: [f32; 3]) -> [f32; 3] {
        let rgb = self.brightness.as_ref().map_or(rgb, |b| b.color(point, rgb));
        rgb.map(|v| self.known(point, v))
    }

    /// A value at a point, NaN where the field is unknown.
    pub(crate) fn known(&self, point: [f32; 3], value: f32) -> f32 {
        if self.octree.contains(point) { value } else { f32::NAN }
    }

    /// Signed distances of some depth points of a frame, metres, where they are known.
    fn distances(&self, pose: &Isometry3<f64>, rays: &FrameRays) -> Vec<f32> {
        let rays = &rays.surface;
        let n = rays.dir.len();
        let take = n.min(RESIDUAL_POINTS);
        let points: Vec<[f32; 3]> = (0..take)
            .map(|i| {
                let i = i * n / take;
                let p = pose * Point3::from(rays.dir[i].map(|c| f64::from(c * rays.distance[i])));
                [p.x as f32, p.y as f32, p.z as f32]
            })
            .collect();
        let mut sdf = vec![0.0; take];
        self.evaluate_task(&points, &mut sdf, None);
        sdf.retain(|v| v.is_finite());
        sdf
    }
}

/// The median, the values in any order after it; `None` without any.
fn middle(values: &mut [f32]) -> Option<f32> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

fn reach(config: &FieldConfig) -> f64 {
    config.behind.clamp(0.2, 1.0) * config.truncation
}

/// Space within reach of a measured point: there the sign of the distance was observed. Deeper inside the object than
/// samples reach it is anybody's guess, and a mesh would get inner walls. A point that only one of many frames has
/// seen does not count: it may be a pixel between object and background.
fn support(
    config: &FieldConfig,
    octree: &VoxelOctree,
    frames: &[Arc<FieldImages>],
    poses: &[Isometry3<f64>],
) -> Option<VoxelOctree> {
    // From one to two voxels around a point are within reach; smaller ones than the points' spacing would leave gaps.
    let spacing = frames.iter().filter_map(|f| f.point_spacing(SUPPORT_POINTS)).fold(0.0, f32::max);
    let voxel = (0.4 * reach(config) as f32).max(spacing).min(0.5 * octree.voxel_size());
    let key = |p: &[f32; 3]| p.map(|v| (v / (2.0 * voxel)).floor() as i32);
    let mut cloud = Vec::new();
    // By cell: the last frame that had a point in it, and the number of frames.
    let mut seen: HashMap<[i32; 3], (usize, usize)> = HashMap::new();
    for (f, (frame, pose)) in frames.iter().zip(poses).enumerate() {
        let from = cloud.len();
        frame.points(pose, SUPPORT_POINTS, &mut cloud);
        for p in &cloud[from..] {
            let cell = seen.entry(key(p)).or_insert((usize::MAX, 0));
            if cell.0 != f {
                *cell = (f, cell.1 + 1);
            }
        }
    }
    let enough = if frames.len() >= MANY_FRAMES { 2 } else { 1 };
    cloud.retain(|p| octree.contains(*p) && seen.get(&key(p)).is_some_and(|cell| cell.1 >= enough));
    VoxelOctree::from_points(&cloud, voxel, 1)
}
