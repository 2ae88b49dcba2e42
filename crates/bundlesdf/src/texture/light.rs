//! The light in a video, and colours without it.
//!
//! An object that turns under a lamp shows every part in different light. What is common to all frames is the light as a
//! function of where the surface faces, seen from the camera: a low-order function of the normal is enough for matt
//! surfaces (Basri and Jacobs, "Lambertian Reflectance and Linear Subspaces", PAMI 25(2), 2003). In logarithms a pixel
//! is the sum of the surface's colour, the view's exposure and that function, so that all three follow from linear
//! least squares over the same surface seen in different poses.
//!
//! What the motion doesn't show, say light from above on an object that turns about the vertical, has to be told from
//! paint by its spread: colours vary in patches and not with the direction. The surface counts as so many patches with
//! independent colours, which is little evidence next to true changes of pose, and all there is without them.

use marching_cubes::TriMesh;
use nalgebra::{DMatrix, DVector, Vector3};
use rayon::prelude::*;

use super::view::{Prepared, bilinear};

/// Monomials of the normal up to third order; those that the unit length makes dependent are left out.
const TERMS: usize = 15;
/// Most vertices that take part.
const VERTICES: usize = 12_000;
/// Rounds of reweighting.
const ROUNDS: usize = 8;
/// Least cosine at which a vertex takes part: a steep surface shines and mixes with what is behind it.
const GRAZING: f32 = 0.2;
/// Pixels from the border of the usable area at which a vertex takes part.
const INSET: f32 = 3.0;
/// Colours outside (0 to 255) say nothing of the light.
const RANGE: [f32; 2] = [6.0, 250.0];
/// Standard deviation of a logarithmic brightness around the model, and its Huber limit.
const NOISE: f64 = 0.1;
const HUBER: f64 = 0.12;
/// Neighbours err together: the surface has so many independent places.
const PLACES: f64 = 500.0;
/// Standard deviation of the logarithmic brightness of patches of paint, and how many of them there are.
const PAINT: f64 = 0.5;
const PATCHES: f64 = 60.0;
/// Standard deviations of the views' logarithmic exposures and of the light's coefficients, before anything is seen.
const EXPOSURE: f64 = 0.2;
const COEFFICIENT: f64 = 0.7;
/// Share of the seen surface that is darker than full light.
const FULL: f64 = 0.9;
/// Factors beyond these aren't trusted.
const FACTORS: [f64; 2] = [0.25, 4.0];

/// Light as a function of the normal in the camera's frame.
pub(super) struct Light {
    coefficients: [f64; TERMS],
    /// Logarithm of what counts as full light.
    full: f64,
    /// Brightness of the darkest tenth of what was seen, next to full light.
    pub(super) dimmest: f64,
}

impl Light {
    /// What brings a colour that was seen on a surface with this unit normal (camera frame) to full light.
    pub(super) fn factor(&self, normal: Vector3<f64>) -> f32 {
        let [low, high] = FACTORS;
        (self.full - self.log(normal)).exp().clamp(low, high) as f32
    }

    fn log(&self, normal: Vector3<f64>) -> f64 {
        dot(&terms(normal), self.coefficients.iter())
    }
}

fn terms(n: Vector3<f64>) -> [f64; TERMS] {
    let (x, y, z) = (n.x, n.y, n.z);
    [
        x,
        y,
        z,
        x * y,
        y * z,
        x * z,
        x * x - y * y,
        z * z,
        x * x * x,
        y * y * y,
        z * z * z,
        x * y * z,
        x * x * y,
        x * y * y,
        x * x * z,
    ]
}

fn dot<'a>(row: &[f64; TERMS], coefficients: impl Iterator<Item = &'a f64>) -> f64 {
    row.iter().zip(coefficients).map(|(t, c)| t * c).sum()
}

/// A vertex in one view.
struct Look {
    view: usize,
    normal: Vector3<f64>,
    /// Logarithm of the brightness.
    value: f64,
    weight: f64,
}

/// The light that explains best what `views` saw of `mesh`; `None` where nothing was seen twice.
pub(super) fn estimate(mesh: &TriMesh, views: &[Prepared]) -> Option<Light> {
    let step = mesh.vertices.len().div_ceil(VERTICES).max(1);
    let looks: Vec<Vec<Look>> = (0..mesh.vertices.len())
        .into_par_iter()
        .step_by(step)
        .map(|v| looks(mesh.vertices[v], mesh.normals[v], views))
        .filter(|looks| looks.len() > 1)
        .collect();
    if looks.is_empty() {
        return None;
    }
    let mut unknowns = DVector::zeros(views.len() + TERMS);
    for _ in 0..ROUNDS {
        unknowns = step_of(&looks, views.len(), &unknowns)?;
    }
    let coefficients = std::array::from_fn(|k| unknowns[views.len() + k]);
    let mut light = Light { coefficients, full: 0.0, dimmest: 1.0 };
    let mut brightness: Vec<(f64, f64)> =
        looks.iter().flatten().map(|l| (light.log(l.normal), l.weight)).collect();
    brightness.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    light.full = quantile(&brightness, FULL);
    light.dimmest = (quantile(&brightness, 1.0 - FULL) - light.full).exp();
    Some(light)
}

fn looks(p: [f32; 3], n: [f32; 3], views: &[Prepared]) -> Vec<Look> {
    let normal = Vector3::from(n.map(f64::from));
    let seen = views.iter().enumerate().filter_map(|(number, view)| {
        let sight = view.sight(p, n).filter(|s| s.cosine >= GRAZING && s.inset >= INSET)?;
        let [r, g, b] = bilinear(&view.color, sight.pixel);
        let known = [r, g, b].iter().all(|c| *c <= RANGE[1]) && r.max(g).max(b) >= RANGE[0];
        let brightness = 0.299 * r + 0.587 * g + 0.114 * b;
        known.then(|| Look {
            view: number,
            normal: view.cam_from_obj().rotation * normal,
            value: f64::from(brightness.max(1.0)).ln(),
            weight: f64::from(sight.cosine * sight.cosine * view.quality),
        })
    });
    seen.collect()
}

/// Exposures and coefficients after one round of reweighted least squares.
///
/// The colour of each vertex is eliminated: within a vertex only differences from its weighted mean count, and the means
/// themselves count as draws from one distribution of paint.
fn step_of(looks: &[Vec<Look>], views: usize, before: &DVector<f64>) -> Option<DVector<f64>> {
    let size = views + TERMS;
    let mut within = Normal::new(size);
    let mut between = Normal::new(size);
    let (mut total, mut mean_value) = (DVector::<f64>::zeros(size), 0.0);
    for list in looks {
        let rows: Vec<[f64; TERMS]> = list.iter().map(|l| terms(l.normal)).collect();
        let left: Vec<f64> = list
            .iter()
            .zip(&rows)
            .map(|(l, row)| l.value - before[l.view] - dot(row, before.rows(views, TERMS).iter()))
            .collect();
        let all: f64 = list.iter().map(|l| l.weight).sum();
        let color = list.iter().zip(&left).map(|(l, e)| l.weight * e).sum::<f64>() / all;
        let weights: Vec<f64> =
            list.iter().zip(&left).map(|(l, e)| l.weight * (HUBER / (e - color).abs()).min(1.0)).collect();
        let all: f64 = weights.iter().sum();
        // The vertex's mean row: views first, in the order of `list`, then the terms.
        let mut places: Vec<usize> = list.iter().map(|l| l.view).collect();
        places.extend(views..size);
        let mut mean = vec![0.0; places.len()];
        let mut value = 0.0;
        for (i, (l, w)) in list.iter().zip(&weights).enumerate() {
            mean[i] += w / all;
            (0..TERMS).for_each(|k| mean[list.len() + k] += w / all * rows[i][k]);
            value += w / all * l.value;
        }
        for (i, (l, w)) in list.iter().zip(&weights).enumerate() {
            let mut row: Vec<f64> = mean.iter().map(|m| -m).collect();
            row[i] += 1.0;
            (0..TERMS).for_each(|k| row[list.len() + k] += rows[i][k]);
            within.add(&places, &row, l.value - value, *w);
        }
        between.add(&places, &mean, value, 1.0);
        places.iter().zip(&mean).for_each(|(&p, m)| total[p] += m);
        mean_value += value;
    }
    // Differences from the mean of all vertices.
    let count = looks.len() as f64;
    between.matrix -= &total * total.transpose() / count;
    between.vector -= &total * (mean_value / count);
    let mut matrix =
        within.matrix * (PLACES / count / NOISE.powi(2)) + between.matrix * (PATCHES / count / PAINT.powi(2));
    let vector =
        within.vector * (PLACES / count / NOISE.powi(2)) + between.vector * (PATCHES / count / PAINT.powi(2));
    for i in 0..size {
        matrix[(i, i)] += if i < views { EXPOSURE.powi(-2) } else { COEFFICIENT.powi(-2) };
    }
    let solution = matrix.cholesky()?.solve(&vector);
    solution.iter().all(|v| v.is_finite()).then_some(solution)
}

/// Normal equations.
struct Normal {
    matrix: DMatrix<f64>,
    vector: DVector<f64>,
}

impl Normal {
    fn new(size: usize) -> Self {
        Self { matrix: DMatrix::zeros(size, size), vector: DVector::zeros(size) }
    }

    /// An equation `row . unknowns[places] = value`.
    fn add(&mut self, places: &[usize], row: &[f64], value: f64, weight: f64) {
        for (&i, a) in places.iter().zip(row) {
            self.vector[i] += weight * a * value;
            for (&j, b) in places.iter().zip(row) {
                self.matrix[(j, i)] += weight * a * b;
            }
        }
    }
}

/// Value below which `share` of the weight lies, of sorted values with weights.
fn quantile(sorted: &[(f64, f64)], share: f64) -> f64 {
    let wanted = share * sorted.iter().map(|(_, w)| w).sum::<f64>();
    let mut sum = 0.0;
    for &(value, weight) in sorted {
        sum += weight;
        if sum >= wanted {
            return value;
        }
    }
    sorted.last().map_or(0.0, |(value, _)| *value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    /// Patches of paint on a ball that is seen in `turns`, lit from above the camera.
    fn looks_at_a_ball(turns: &[UnitQuaternion<f64>], lamp: Vector3<f64>) -> Vec<Vec<Look>> {
        let golden = |i: f64| {
            let (y, turn) = (1.0 - (i + 0.5) / 300.0, i * 2.399_963);
            let r = (1.0 - y * y).sqrt();
            Vector3::new(r * turn.cos(), y, r * turn.sin())
        };
        let look = |view: usize, normal: Vector3<f64>, paint: f64| {
            let normal = turns[view] * normal;
            let light = 0.4 + 0.6 * normal.dot(&lamp).max(0.0);
            let exposure = 0.1 * (view as f64).sin();
            Look { view, normal, value: paint + exposure + light.ln(), weight: normal.z * normal.z }
        };
        (0..600)
            .map(|i| {
                let (normal, paint) = (golden(f64::from(i)), 4.0 + 0.5 * (f64::from(i) * 0.7).sin());
                let all = (0..turns.len()).map(|v| look(v, normal, paint));
                all.filter(|l| l.normal.z < -0.2).collect::<Vec<_>>()
            })
            .filter(|l| l.len() > 1)
            .collect()
    }

    #[test]
    fn the_light_on_a_tumbling_ball_is_found() {
        let turns: Vec<_> = (0..16)
            .map(|i| {
                let a = f64::from(i) * 0.4;
                UnitQuaternion::from_euler_angles(0.5 * (2.3 * a).sin(), a, 0.4 * (1.7 * a).cos())
            })
            .collect();
        let lamp = Vector3::new(-0.4, -0.7, -0.6).normalize();
        let looks = looks_at_a_ball(&turns, lamp);
        let mut unknowns = DVector::zeros(turns.len() + TERMS);
        for _ in 0..ROUNDS {
            unknowns = step_of(&looks, turns.len(), &unknowns).unwrap();
        }
        let coefficients = std::array::from_fn(|k| unknowns[turns.len() + k]);
        let light = Light { coefficients, full: 0.0, dimmest: 1.0 };
        // The light itself, but for its strength, where the camera sees it.
        let gaps: Vec<f64> = looks
            .iter()
            .flatten()
            .map(|l| light.log(l.normal) - (0.4 + 0.6 * l.normal.dot(&lamp).max(0.0)).ln())
            .collect();
        let mean = gaps.iter().sum::<f64>() / gaps.len() as f64;
        let spread = (gaps.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / gaps.len() as f64).sqrt();
        assert!(spread < 0.05, "{spread}");
    }

    #[test]
    fn even_light_stays_even() {
        let turns: Vec<_> =
            (0..8).map(|i| UnitQuaternion::from_euler_angles(0.3, 0.5 * f64::from(i), 0.0)).collect();
        let mut looks = looks_at_a_ball(&turns, Vector3::z());
        looks.iter_mut().flatten().for_each(|l| l.value -= (0.4 + 0.6 * l.normal.z.max(0.0)).ln());
        let unknowns = step_of(&looks, turns.len(), &DVector::zeros(turns.len() + TERMS)).unwrap();
        let largest = unknowns.rows(turns.len(), TERMS).amax();
        assert!(largest < 0.1, "{unknowns}");
    }
}
