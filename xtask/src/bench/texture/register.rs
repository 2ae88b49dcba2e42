//! One rigid motion of the whole object that brings its pictures closest to the true ones.

use bundlesdf::texture::TexturedMesh;
use nalgebra::{Isometry3, Matrix6, Point3, Translation3, Vector3, Vector6};
use rgbd_io::Image;
use rgbd_synth::{Sequence, SynthFrame};

use super::score::inner;

/// Steps of the numeric derivatives: metres and radians; about a tenth of a pixel.
const STEP: [f64; 2] = [1e-4, 1e-3];
const ROUNDS: usize = 8;

/// `true_from_obj` moved, by Gauss-Newton on the colours of all pixels of `frames`, `factor` being the texture's.
/// A wrong place of the object frame is what ADD measures; one who looks at the mesh can't see it.
pub(super) fn registered(
    textured: &TexturedMesh,
    video: &Sequence,
    frames: &[SynthFrame],
    true_from_obj: &Isometry3<f64>,
    factor: f64,
) -> Isometry3<f64> {
    let count = textured.positions.len().max(1) as f64;
    let sum = textured.positions.iter().fold(Vector3::zeros(), |s, p| s + Vector3::from(p.map(f64::from)));
    let scene = Scene { textured, video, frames, factor, middle: sum / count };
    let mut best = *true_from_obj;
    let mut least = scene.error(&best);
    for _ in 0..ROUNDS {
        let Some(step) = scene.step(&best) else { break };
        let next = scene.moved(&best, &step);
        let error = scene.error(&next);
        // Written so that a NaN ends it.
        let better = error < least;
        if !better {
            break;
        }
        (best, least) = (next, error);
    }
    best
}

struct Scene<'a> {
    textured: &'a TexturedMesh,
    video: &'a Sequence,
    frames: &'a [SynthFrame],
    factor: f64,
    /// Of the mesh, object frame.
    middle: Vector3<f64>,
}

impl Scene<'_> {
    /// The object moved by a twist about its middle, translation first.
    fn moved(&self, true_from_obj: &Isometry3<f64>, twist: &Vector6<f64>) -> Isometry3<f64> {
        let origin = Translation3::from((true_from_obj * Point3::from(self.middle)).coords);
        let motion = Isometry3::new(twist.fixed_rows::<3>(0).into(), twist.fixed_rows::<3>(3).into());
        origin * motion * origin.inverse() * true_from_obj
    }

    fn drawn(&self, seen: &SynthFrame, true_from_obj: &Isometry3<f64>) -> Image<Option<[f64; 3]>> {
        let pose = seen.cam_from_obj * true_from_obj;
        let drawn = self.textured.render(&self.video.intrinsics(), seen.frame.color.size(), &pose);
        let (width, height) = drawn.color.size();
        Image::from_fn(width, height, |x, y| {
            (drawn.depth[(x, y)] > 0.0).then(|| drawn.color[(x, y)].map(|v| self.factor * f64::from(v)))
        })
    }

    /// Mean squared difference over the pixels that are drawn.
    fn error(&self, true_from_obj: &Isometry3<f64>) -> f64 {
        let (mut sum, mut count) = (0.0, 0usize);
        for seen in self.frames {
            let drawn = self.drawn(seen, true_from_obj);
            for at in inner(seen) {
                let Some(color) = drawn[at] else { continue };
                sum += (0..3).map(|k| (color[k] - f64::from(seen.frame.color[at][k])).powi(2)).sum::<f64>();
                count += 1;
            }
        }
        sum / count as f64
    }

    fn step(&self, true_from_obj: &Isometry3<f64>) -> Option<Vector6<f64>> {
        let (mut hessian, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
        for seen in self.frames {
            let side = |i: usize, sign: f64| {
                let mut twist = Vector6::zeros();
                twist[i] = sign * STEP[i / 3];
                self.drawn(seen, &self.moved(true_from_obj, &twist))
            };
            let here = self.drawn(seen, true_from_obj);
            let sides: Vec<_> = (0..6).map(|i| [side(i, 1.0), side(i, -1.0)]).collect();
            for at in inner(seen) {
                let Some(color) = here[at] else { continue };
                for k in 0..3 {
                    let slope = |i: usize| {
                        let [Some(plus), Some(minus)] = [&sides[i][0], &sides[i][1]].map(|s| s[at]) else {
                            return 0.0;
                        };
                        (plus[k] - minus[k]) / (2.0 * STEP[i / 3])
                    };
                    let row = Vector6::from_fn(|i, _| slope(i));
                    let error = color[k] - f64::from(seen.frame.color[at][k]);
                    hessian += row * row.transpose();
                    gradient += row * error;
                }
            }
        }
        Some(-hessian.cholesky()?.solve(&gradient))
    }
}
