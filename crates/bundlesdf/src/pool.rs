//! The memory pool: the posed frames that are worth remembering (paper section 3.2).

use std::{collections::HashMap, sync::Arc};

use nalgebra::Isometry3;
use se3_lie::distance::{rotation_angle, swing_angle};
use serde::{Deserialize, Serialize};

use crate::{
    config::{KeyframeRule, MemoryConfig},
    coverage::unseen_share,
    observation::Observation,
};

/// Share of a keyframe's points that may go with it: noise at the rim of the mask and at steps.
const MOST_LOST: f64 = 0.02;

/// One remembered frame.
#[derive(Clone, Debug)]
pub struct Keyframe {
    /// Index of the frame in the video.
    pub index: usize,
    /// Name of the frame.
    pub id: String,
    /// Current pose.
    pub obj_from_cam: Isometry3<f64>,
    /// The paper's flag b(F): the field has refined this pose, the pose graph may not move it any more.
    pub refined_by_field: bool,
    /// What was seen.
    pub observation: Arc<Observation>,
}

/// Matches between two keyframes, as camera-frame points: `(older, newer, weight)`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct MemoryEdge {
    pub(crate) older: Vec<[f32; 3]>,
    pub(crate) newer: Vec<[f32; 3]>,
    pub(crate) weights: Vec<f32>,
}

/// Keyframes in the order in which they were added; the first one is the anchor of the object frame.
#[derive(Debug, Default)]
pub struct MemoryPool {
    keyframes: Vec<Keyframe>,
    edges: HashMap<(usize, usize), MemoryEdge>,
}

impl MemoryPool {
    /// All keyframes, oldest first.
    pub fn keyframes(&self) -> &[Keyframe] {
        &self.keyframes
    }

    pub(crate) fn keyframes_mut(&mut self) -> &mut [Keyframe] {
        &mut self.keyframes
    }

    /// The keyframe of video frame `index`.
    pub fn get(&self, index: usize) -> Option<&Keyframe> {
        self.keyframes.iter().find(|k| k.index == index)
    }

    /// Cached matches between two keyframes given by frame index, `older < newer`.
    pub(crate) fn edge(&self, older: usize, newer: usize) -> Option<&MemoryEdge> {
        self.edges.get(&(older, newer))
    }

    /// All cached matches, by frame index, in a fixed order.
    pub(crate) fn all_edges(&self) -> Vec<((usize, usize), MemoryEdge)> {
        let mut edges: Vec<_> = self.edges.iter().map(|(key, edge)| (*key, edge.clone())).collect();
        edges.sort_unstable_by_key(|(key, _)| *key);
        edges
    }

    /// Whether `obj_from_cam` adds a view: its optical axis differs from every keyframe's by the minimum swing angle
    /// (roll about the optical axis shows nothing new).
    pub fn is_new_view(&self, obj_from_cam: &Isometry3<f64>, config: &MemoryConfig) -> bool {
        let least = config.min_swing_deg.to_radians();
        self.keyframes.iter().all(|k| view_angle(k, obj_from_cam, config.rule) >= least)
    }

    /// Position of the keyframe that `observation`, at `obj_from_cam` and no new view, does better than: the nearest,
    /// which shows the same side within half the minimum angle, unless it is the anchor. No other is as near, and what
    /// this one alone shows the new frame shows too, so that the pool covers what it did.
    pub(crate) fn worse_view(
        &self,
        observation: &Observation,
        obj_from_cam: &Isometry3<f64>,
        config: &MemoryConfig,
    ) -> Option<usize> {
        let half = 0.5 * config.min_swing_deg.to_radians();
        let is_near = |k: &Keyframe| view_angle(k, obj_from_cam, config.rule) < half;
        let mut near = self.keyframes.iter().enumerate().filter(|(_, k)| is_near(k));
        let (position, keyframe) = near.next().filter(|(position, _)| *position > 0)?;
        let is_alone = near.next().is_none();
        let better = || observation.quality().over(keyframe.observation.quality());
        let others = self.keyframes.iter().enumerate().filter(|(other, _)| *other != position);
        let without = others.map(|(_, k)| (&*k.observation, &k.obj_from_cam));
        let views = std::iter::once((observation, obj_from_cam)).chain(without);
        let lost = || unseen_share((&keyframe.observation, &keyframe.obj_from_cam), views);
        (is_alone && better() >= config.replace_ratio && lost() <= MOST_LOST).then_some(position)
    }

    /// A pool of these keyframes, oldest first, and these matches, by frame index.
    pub(crate) fn from_parts(
        keyframes: Vec<Keyframe>,
        edges: impl IntoIterator<Item = ((usize, usize), MemoryEdge)>,
    ) -> Self {
        Self { keyframes, edges: edges.into_iter().collect() }
    }

    /// Makes `keyframe` the only one: memory that is switched off still has the previous frame.
    pub(crate) fn replace_all(&mut self, keyframe: Keyframe) {
        self.keyframes.clear();
        self.edges.clear();
        self.keyframes.push(keyframe);
    }

    /// Adds a keyframe with its matches to older ones; beyond the capacity the most redundant keyframe goes.
    pub(crate) fn add(
        &mut self,
        keyframe: Keyframe,
        edges: impl IntoIterator<Item = (usize, MemoryEdge)>,
        config: &MemoryConfig,
    ) {
        let newer = keyframe.index;
        self.edges.extend(edges.into_iter().map(|(older, edge)| ((older, newer), edge)));
        self.keyframes.push(keyframe);
        if self.keyframes.len() > config.capacity.max(2) {
            self.forget_most_redundant();
        }
    }

    /// Puts `keyframe`, with its matches to others, in the place of the one at `position`, whose matches go with it.
    pub(crate) fn replace(
        &mut self,
        position: usize,
        keyframe: Keyframe,
        edges: impl IntoIterator<Item = (usize, MemoryEdge)>,
    ) {
        let newer = keyframe.index;
        self.edges.extend(edges.into_iter().map(|(older, edge)| ((older, newer), edge)));
        self.keyframes.push(keyframe);
        self.forget(position);
    }

    fn forget(&mut self, position: usize) {
        let gone = self.keyframes.remove(position).index;
        self.edges.retain(|(a, b), _| *a != gone && *b != gone);
    }

    /// Removes the keyframe whose nearest neighbour is nearest; never the anchor nor the newest.
    fn forget_most_redundant(&mut self) {
        let spread = |i: usize| {
            let own = &self.keyframes[i].obj_from_cam.rotation;
            let others = self.keyframes.iter().enumerate().filter(|(j, _)| *j != i);
            others.map(|(_, k)| swing_angle(own, &k.obj_from_cam.rotation)).fold(f64::MAX, f64::min)
        };
        let candidates = 1..self.keyframes.len().saturating_sub(1);
        if let Some(worst) = candidates.min_by(|a, b| spread(*a).total_cmp(&spread(*b))) {
            self.forget(worst);
        }
    }

    /// Positions in [`MemoryPool::keyframes`] of the keyframes that take part in the pose graph of a new frame at
    /// `obj_from_cam`: visible enough, then nearest by swing angle, at most K (paper section 3.3).
    pub fn select(&self, obj_from_cam: &Isometry3<f64>, config: &MemoryConfig) -> Vec<usize> {
        if self.keyframes.len() <= config.selected {
            return (0..self.keyframes.len()).collect();
        }
        if config.rule == KeyframeRule::FullRotation {
            return self.select_nearest_set(obj_from_cam, config.selected);
        }
        let visible: Vec<(f64, usize)> = self
            .keyframes
            .iter()
            .enumerate()
            .filter(|(_, k)| {
                k.observation.visible_share(&k.obj_from_cam, obj_from_cam, config.visible_deg)
                    > config.min_visible
            })
            .map(|(i, k)| (swing_angle(&k.obj_from_cam.rotation, &obj_from_cam.rotation), i))
            .collect();
        self.spread(visible, config)
    }

    /// At most K of `visible`, positions of keyframes with their swing angles to a new frame: the nearest first, without
    /// those that show the side of one taken before (within half the minimum swing, where poses moved together); these
    /// only fill places that would stay empty.
    fn spread(&self, mut visible: Vec<(f64, usize)>, config: &MemoryConfig) -> Vec<usize> {
        visible.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let half = 0.5 * config.min_swing_deg.to_radians();
        let (mut chosen, mut doubles) = (Vec::with_capacity(config.selected), Vec::new());
        for (_, i) in visible {
            if chosen.len() == config.selected {
                break;
            }
            let own = &self.keyframes[i].obj_from_cam;
            let doubled =
                chosen.iter().any(|c: &usize| view_angle(&self.keyframes[*c], own, config.rule) < half);
            (if doubled { &mut doubles } else { &mut chosen }).push(i);
        }
        let free = config.selected - chosen.len();
        chosen.extend(doubles.into_iter().take(free));
        chosen.sort_unstable();
        chosen
    }

    /// Greedy choice of the `count` keyframes with the least total rotation distance to the new frame and to each
    /// other (BundleTrack's minimum subgraph).
    fn select_nearest_set(&self, obj_from_cam: &Isometry3<f64>, count: usize) -> Vec<usize> {
        let distance = |i: usize, to: &Isometry3<f64>| {
            rotation_angle(&self.keyframes[i].obj_from_cam.rotation, &to.rotation)
        };
        let mut total: Vec<f64> = (0..self.keyframes.len()).map(|i| distance(i, obj_from_cam)).collect();
        let mut chosen: Vec<usize> = Vec::with_capacity(count);
        while chosen.len() < count {
            let free = (0..total.len()).filter(|i| !chosen.contains(i));
            let Some(next) = free.min_by(|a, b| total[*a].total_cmp(&total[*b])) else { break };
            for (i, sum) in total.iter_mut().enumerate() {
                *sum += distance(i, &self.keyframes[next].obj_from_cam);
            }
            chosen.push(next);
        }
        chosen.sort_unstable();
        chosen
    }

    /// Takes the field's poses over; every other pose that was tracked against a moved keyframe is moved with it.
    /// Returns the correction that a pose tracked next to video frame `near` needs: `(old, new)` of its keyframe.
    pub(crate) fn apply_field_poses(
        &mut self,
        poses: &[(usize, Isometry3<f64>)],
        near: usize,
    ) -> Option<(Isometry3<f64>, Isometry3<f64>)> {
        let mut moved: Vec<(usize, Isometry3<f64>, Isometry3<f64>)> = Vec::new();
        for keyframe in &mut self.keyframes {
            if let Some((_, pose)) = poses.iter().find(|(index, _)| *index == keyframe.index) {
                moved.push((keyframe.index, keyframe.obj_from_cam, *pose));
                keyframe.obj_from_cam = *pose;
                keyframe.refined_by_field = true;
            }
        }
        let nearest = |index: usize| moved.iter().min_by_key(|(i, _, _)| i.abs_diff(index));
        for keyframe in &mut self.keyframes {
            if poses.iter().all(|(index, _)| *index != keyframe.index)
                && let Some((_, old, new)) = nearest(keyframe.index)
            {
                keyframe.obj_from_cam = carry(old, new, &keyframe.obj_from_cam);
            }
        }
        nearest(near).map(|(_, old, new)| (*old, *new))
    }
}

/// How differently (radians) a camera at `obj_from_cam` sees the object, by the rule for new views.
fn view_angle(keyframe: &Keyframe, obj_from_cam: &Isometry3<f64>, rule: KeyframeRule) -> f64 {
    let (a, b) = (&keyframe.obj_from_cam.rotation, &obj_from_cam.rotation);
    match rule {
        KeyframeRule::Compact => swing_angle(a, b),
        KeyframeRule::FullRotation => rotation_angle(a, b),
    }
}

/// Moves `obj_from_cam` rigidly with a keyframe whose pose went from `old` to `new`: their relative motion stays.
pub(crate) fn carry(
    old: &Isometry3<f64>,
    new: &Isometry3<f64>,
    obj_from_cam: &Isometry3<f64>,
) -> Isometry3<f64> {
    new * old.inv_mul(obj_from_cam)
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use rgbd_io::Image;

    use super::*;
    use crate::observation::tests::flat_observation;

    fn pose(axis: [f64; 3], deg: f64) -> Isometry3<f64> {
        let rotation = Vector3::from(axis) * deg.to_radians();
        Isometry3::from_parts(Vector3::zeros().into(), UnitQuaternion::from_scaled_axis(rotation))
    }

    fn pool(poses: &[Isometry3<f64>], config: &MemoryConfig) -> MemoryPool {
        let observation = Arc::new(flat_observation());
        let mut pool = MemoryPool::default();
        for (index, obj_from_cam) in poses.iter().enumerate() {
            let observation = observation.clone();
            let keyframe = Keyframe {
                index,
                id: index.to_string(),
                obj_from_cam: *obj_from_cam,
                refined_by_field: false,
                observation,
            };
            pool.add(keyframe, [], config);
        }
        pool
    }

    #[test]
    fn roll_is_no_new_view_and_tilt_is() {
        let config = MemoryConfig::default();
        let pool = pool(&[Isometry3::identity()], &config);
        assert!(!pool.is_new_view(&pose([0.0, 0.0, 1.0], 90.0), &config));
        assert!(!pool.is_new_view(&pose([1.0, 0.0, 0.0], config.min_swing_deg - 0.1), &config));
        assert!(pool.is_new_view(&pose([1.0, 0.0, 0.0], config.min_swing_deg + 0.1), &config));
    }

    #[test]
    fn the_capacity_holds_and_the_anchor_and_the_newest_stay() {
        let config = MemoryConfig { capacity: 4, ..MemoryConfig::default() };
        let poses: Vec<_> = [0.0, 10.0, 11.0, 40.0, 60.0].map(|d| pose([0.0, 1.0, 0.0], d)).to_vec();
        let pool = pool(&poses, &config);
        let kept: Vec<usize> = pool.keyframes().iter().map(|k| k.index).collect();
        assert_eq!(kept.len(), 4);
        assert!(kept.contains(&0) && kept.contains(&4) && kept.contains(&3));
    }

    #[test]
    fn the_nearest_visible_views_are_selected() {
        let config = MemoryConfig { selected: 2, ..MemoryConfig::default() };
        let poses: Vec<_> = [0.0, 20.0, 40.0, 170.0].map(|d| pose([0.0, 1.0, 0.0], d)).to_vec();
        assert_eq!(pool(&poses, &config).select(&pose([0.0, 1.0, 0.0], 25.0), &config), vec![1, 2]);
    }

    #[test]
    fn no_side_is_selected_twice_while_others_are_visible() {
        let config = MemoryConfig { selected: 3, ..MemoryConfig::default() };
        let (y, new) = ([0.0, 1.0, 0.0], Isometry3::identity());
        let select = |degrees: &[f64]| {
            let poses: Vec<_> = degrees.iter().map(|d| pose(y, *d)).collect();
            pool(&poses, &config).select(&new, &config)
        };
        // 6 and 7 degrees are the side of 5, -8 and 40 are others; the nearest three would be 5, 6 and 7.
        assert_eq!(select(&[40.0, 5.0, 6.0, 7.0, -8.0]), vec![0, 1, 4]);
        assert_eq!(select(&[40.0, 5.0, 10.0, 7.0, -8.0]), vec![1, 2, 4]);
        // Where there is no third side the nearest double takes the place.
        assert_eq!(select(&[5.0, 6.0, 7.0, -8.0]), vec![0, 1, 3]);
    }

    #[test]
    fn only_a_clearly_worse_view_of_the_same_side_gives_way() {
        use crate::{config::Config, observation::tests::flat_frame};
        let config = MemoryConfig::default();
        let y = [0.0, 1.0, 0.0];
        let poses: Vec<_> = [0.0, 10.0, 20.0].map(|d| pose(y, d)).to_vec();
        // The left half of the depth is missing in the worse one.
        let (mut frame, mask) = flat_frame(160, 120);
        let good = Arc::new(flat_observation());
        frame.depth = Image::from_fn(160, 120, |x, _| if x < 80 { 0.0 } else { 0.5 });
        let bad = Arc::new(Observation::new(0, &frame, &mask, &Config::default()).unwrap());
        let worse = |at: usize, seen: &Arc<Observation>| {
            let mut pool = pool(&poses, &config);
            pool.keyframes_mut()[at].observation = bad.clone();
            let find = |deg: f64| pool.worse_view(seen, &pose(y, deg), &config);
            (find(10.0 * at as f64 + 1.0), find(10.0 * at as f64 + 3.0))
        };
        // Near it, and beyond half of the 5 degrees that make a new view; the anchor stays.
        assert_eq!(worse(1, &good), (Some(1), None));
        assert_eq!(worse(0, &good), (None, None));
        assert_eq!(worse(1, &bad), (None, None));
        // Nothing is gained where the keyframe is as good.
        assert_eq!(pool(&poses, &config).worse_view(&good, &pose(y, 11.0), &config), None);
        // Two that near are of the same side: the pool would keep one view twice.
        let mut close = pool(&[poses[0], poses[1], pose(y, 11.0)], &config);
        close.keyframes_mut()[1].observation = bad;
        assert_eq!(close.worse_view(&good, &pose(y, 10.5), &config), None);
    }

    #[test]
    fn a_keyframe_gives_way_only_to_what_shows_all_that_it_alone_shows() {
        use crate::coverage::tests::{board, observed, turned};
        let config = MemoryConfig::default();
        let keyframe = |index: usize, deg: f64, part: [f64; 2], blur: usize| Keyframe {
            index,
            id: index.to_string(),
            obj_from_cam: turned(deg),
            refined_by_field: false,
            observation: Arc::new(observed(&board(deg, part, blur))),
        };
        // The second is smeared, and alone shows the board's right end.
        let two = vec![keyframe(0, 0.0, [-0.1, 0.05], 1), keyframe(1, 10.0, [-0.1, 0.1], 6)];
        let mut three = two.clone();
        three.push(keyframe(2, 20.0, [0.05, 0.1], 1));
        let [two, three] = [two, three].map(|keyframes| MemoryPool::from_parts(keyframes, []));
        let gives_way = |pool: &MemoryPool, part: [f64; 2]| {
            let better = observed(&board(11.0, part, 1));
            assert!(better.quality().over(pool.keyframes()[1].observation.quality()) > config.replace_ratio);
            pool.worse_view(&better, &turned(11.0), &config)
        };
        assert_eq!(gives_way(&two, [-0.1, 0.1]), Some(1));
        // The left end is shown by the first one as well.
        assert_eq!(gives_way(&two, [-0.085, 0.1]), Some(1));
        assert_eq!(gives_way(&two, [-0.1, 0.085]), None);
        assert_eq!(gives_way(&three, [-0.1, 0.085]), Some(1));
    }

    #[test]
    fn a_replaced_keyframe_takes_its_matches_along() {
        let config = MemoryConfig::default();
        let poses: Vec<_> = [0.0, 10.0, 20.0].map(|d| pose([0.0, 1.0, 0.0], d)).to_vec();
        let mut pool = pool(&poses, &config);
        pool.edges = [((0, 1), MemoryEdge::default()), ((0, 2), MemoryEdge::default())].into();
        let keyframe = Keyframe { index: 7, ..pool.keyframes()[1].clone() };
        pool.replace(1, keyframe, [0, 1, 2].map(|older| (older, MemoryEdge::default())));
        let kept: Vec<usize> = pool.keyframes().iter().map(|k| k.index).collect();
        assert_eq!(kept, [0, 2, 7]);
        let edges: Vec<_> = pool.all_edges().into_iter().map(|(key, _)| key).collect();
        assert_eq!(edges, [(0, 2), (0, 7), (2, 7)]);
    }

    #[test]
    fn by_the_full_rotation_roll_is_a_new_view_and_the_closest_set_is_selected() {
        let config =
            MemoryConfig { rule: KeyframeRule::FullRotation, selected: 2, ..MemoryConfig::default() };
        let poses: Vec<_> = [0.0, 30.0, 35.0, 90.0].map(|d| pose([0.0, 0.0, 1.0], d)).to_vec();
        let pool = pool(&poses, &config);
        assert!(pool.is_new_view(&pose([0.0, 0.0, 1.0], 60.0), &config));
        assert!(!pool.is_new_view(&pose([0.0, 0.0, 1.0], 60.0), &MemoryConfig::default()));
        assert_eq!(pool.select(&pose([0.0, 0.0, 1.0], 20.0), &config), vec![1, 2]);
    }

    #[test]
    fn a_pose_tracked_against_a_moved_keyframe_moves_with_it() {
        let config = MemoryConfig::default();
        let mut pool = pool(&[Isometry3::identity(), pose([0.0, 1.0, 0.0], 20.0)], &config);
        let refined = Isometry3::translation(0.01, 0.0, 0.0) * pose([0.0, 1.0, 0.0], 22.0);
        let before = pool.keyframes()[1].obj_from_cam;
        let (old, new) = pool.apply_field_poses(&[(0, Isometry3::identity()), (1, refined)], 5).unwrap();
        assert_eq!((old, new), (before, refined));
        assert!(pool.keyframes().iter().all(|k| k.refined_by_field));
        let live = pose([0.0, 1.0, 0.0], 21.0);
        let relative = before.inv_mul(&live);
        let carried = new.inv_mul(&carry(&old, &new, &live));
        assert!((relative.to_homogeneous() - carried.to_homogeneous()).norm() < 1e-12);
    }
}
