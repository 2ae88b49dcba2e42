//! How well a motion explains all matches: the inner loop of RANSAC.

use super::LiftedMatch;
use super::triangle::Motion;

const LANES: usize = 8;

/// Eight matches, one array a coordinate.
#[derive(Clone, Copy, Default)]
struct Block {
    a: [[f32; LANES]; 3],
    b: [[f32; LANES]; 3],
    normal_a: [[f32; LANES]; 3],
    normal_b: [[f32; LANES]; 3],
    sight: [[f32; LANES]; 3],
    /// One over the squared threshold across the line of sight, and what is taken off that along it.
    lateral: [f32; LANES],
    relief: [f32; LANES],
    /// Added to the cosine of the normals: 0, or enough to pass any test where a normal is unknown.
    excuse: [f32; LANES],
    weight: [f32; LANES],
}

/// All matches in blocks; the last one is filled with weight 0.
pub(crate) struct Votes {
    blocks: Vec<Block>,
    min_cos: f32,
}

impl Votes {
    pub(super) fn new<'a>(
        matches: impl Iterator<Item = &'a LiftedMatch>,
        tau: f64,
        lateral: f64,
        min_cos: f64,
    ) -> Self {
        let (along, across) = ((1.0 / (tau * tau)) as f32, (1.0 / (lateral * lateral)) as f32);
        let mut blocks: Vec<Block> = Vec::new();
        for (i, m) in matches.enumerate() {
            if i % LANES == 0 {
                blocks.push(Block::default());
            }
            let Some(block) = blocks.last_mut() else { continue };
            let k = i % LANES;
            for c in 0..3 {
                block.a[c][k] = m.a[c];
                block.b[c][k] = m.b[c];
                block.normal_a[c][k] = m.normal_a[c];
                block.normal_b[c][k] = m.normal_b[c];
                block.sight[c][k] = m.sight[c];
            }
            block.lateral[k] = if m.sight == [0.0; 3] { along } else { across };
            block.relief[k] = block.lateral[k] - along;
            block.excuse[k] = if m.has_normals() { 0.0 } else { 4.0 };
            block.weight[k] = m.weight;
        }
        Self { blocks, min_cos: min_cos as f32 }
    }

    /// Sum of `weight * (1 - r^2)` over the inliers, r relative to the thresholds (MSAC: Torr and Zisserman, CVIU 2000).
    #[inline(always)]
    pub(crate) fn score(&self, motion: &Motion) -> f32 {
        let r: [[f32; 3]; 3] =
            core::array::from_fn(|i| core::array::from_fn(|j| motion.rotation[(i, j)] as f32));
        let t: [f32; 3] = core::array::from_fn(|i| motion.translation[i] as f32);
        let mut sums = [0.0_f32; LANES];
        for m in &self.blocks {
            let (mut squared, mut along, mut cos) = ([0.0_f32; LANES], [0.0_f32; LANES], m.excuse);
            for i in 0..3 {
                for k in 0..LANES {
                    let moved = r[i][0] * m.a[0][k] + r[i][1] * m.a[1][k] + r[i][2] * m.a[2][k] + t[i];
                    let d = moved - m.b[i][k];
                    squared[k] += d * d;
                    along[k] += d * m.sight[i][k];
                }
                for k in 0..LANES {
                    let turned =
                        r[i][0] * m.normal_a[0][k] + r[i][1] * m.normal_a[1][k] + r[i][2] * m.normal_a[2][k];
                    cos[k] += turned * m.normal_b[i][k];
                }
            }
            for k in 0..LANES {
                let closeness = 1.0 - (squared[k] * m.lateral[k] - along[k] * along[k] * m.relief[k]);
                let closeness = if closeness > 0.0 { closeness } else { 0.0 };
                let agrees = if cos[k] >= self.min_cos { m.weight[k] } else { 0.0 };
                sums[k] += agrees * closeness;
            }
        }
        sums.iter().sum()
    }
}
