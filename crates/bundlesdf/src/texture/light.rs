//! The light of the video, so that it can be taken out of the colours.
//!
//! A point of an object that turns before a still camera is seen under changing light. What its brightness has in common
//! with that of all other points is a function of the normal in the camera's frame: the shading. Under any light from
//! far away it is smooth enough for a spherical polynomial of low degree (Basri and Jacobs, "Lambertian Reflectance and
//! Linear Subspaces", PAMI 2003; Ramamoorthi and Hanrahan, "On the relationship between radiance and irradiance",
//! JOSA A 2001). In logarithms
//!
//! `brightness of point i in view v = albedo of i + exposure of v + shading(rotation of v * normal of i)`
//!
//! is linear in all three; the albedos are eliminated, the rest is a small robust least-squares problem. What the views
//! can't tell is left to the prior "no shading": the part that a turntable's axis hides, light that turns with the object,
//! and everything if there is one view alone.

use nalgebra::{DMatrix, DVector, Vector3};
use rayon::prelude::*;

use super::{
    color,
    polynomial::{TERMS, Terms, basis, cauchy, deviation, dot, prior},
    sample::{self, Sighting, SurfacePoint},
    still_light,
    view::Prepared,
};

/// Expected size of the log exposures.
const EXPOSURE: f64 = 0.3;
/// Most points that take part.
const POINTS: usize = 6000;
/// So many of a view's points err together (a shadow, a patch of the mesh with a wrong normal).
const CORRELATED: f64 = 40.0;
const ROUNDS: usize = 12;
/// Least standard deviation of log brightness that residuals are judged by.
const LEAST_SIGMA: f64 = 0.01;
/// Colours (0 to 255) that are too dark to have a logarithm, and too bright to be trusted.
const DARK: f32 = 6.0;
const CLIPPED: f32 = 250.0;

/// Brightness by the direction of the surface.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Light {
    /// By the normal in the camera's frame.
    moving: Terms,
    /// By the normal in the object's frame.
    still: Terms,
    /// Log brightness that is subtracted, so that the mean over what the views saw is none.
    mean: f64,
}

/// What one view saw of a vertex.
struct Row {
    view: usize,
    log: f64,
    weight: f64,
    basis: Terms,
}

impl Light {
    /// The same light from everywhere.
    pub(super) fn even() -> Self {
        Self { moving: [0.0; TERMS], still: [0.0; TERMS], mean: 0.0 }
    }

    /// Estimates the light that the views have in common.
    pub(super) fn estimate(points: &[SurfacePoint], views: &[Prepared]) -> Self {
        let mut sightings = sample::sightings(points, views);
        let mut light = Self::even();
        light.moving = moving(&rows(points, views, &sightings), views.len());
        light.remove(points, views, &mut sightings);
        let gains = color::gains(&sightings, views.len());
        color::apply(&mut sightings, &gains);
        let log = |list: &Vec<Sighting>| {
            let color = color::agreed(list)?;
            color.iter().all(|v| *v > DARK).then(|| color.map(|v| f64::from(v).ln()))
        };
        let colors: Vec<_> = sightings.iter().map(log).collect();
        light.still = still_light::estimate(points, &colors);
        let (mut sum, mut weight) = (0.0, 0.0);
        for (point, list) in points.iter().zip(&sightings) {
            for s in list {
                let broad = f64::from(s.broad);
                sum += broad * light.log(&views[usize::from(s.view)], point);
                weight += broad;
            }
        }
        light.mean = if weight > 0.0 { sum / weight } else { 0.0 };
        light
    }

    /// Logarithm of the factor by which the point is brighter in the view than the mean.
    pub(super) fn log(&self, view: &Prepared, point: &SurfacePoint) -> f64 {
        let normal = Vector3::from(point.normal.map(f64::from));
        let turned = view.cam_from_obj().rotation * normal;
        dot(&self.moving, &basis(&turned)) + dot(&self.still, &basis(&normal)) - self.mean
    }

    /// Divides the shading out of the sightings' factors.
    pub(super) fn remove(
        &self,
        points: &[SurfacePoint],
        views: &[Prepared],
        sightings: &mut [Vec<Sighting>],
    ) {
        sightings.par_iter_mut().zip(points).for_each(|(list, point)| {
            for s in list {
                let brightness = self.log(&views[usize::from(s.view)], point).exp() as f32;
                s.factor = s.factor.map(|f| f / brightness);
            }
        });
    }
}

/// The shading by the normal in the camera's frame.
fn moving(points: &[Vec<Row>], views: usize) -> Terms {
    let mut terms = [0.0; TERMS];
    let mut x = DVector::zeros(views + TERMS);
    let mut sigma = f64::INFINITY;
    for _ in 0..ROUNDS {
        let errors: Vec<f64> = points.par_iter().flat_map_iter(|rows| residuals(rows, &x, sigma)).collect();
        sigma = deviation(errors).max(LEAST_SIGMA);
        let Some(next) = solve(points, &x, sigma, views) else { return terms };
        x = next;
    }
    terms.copy_from_slice(&x.as_slice()[views..]);
    terms
}

/// Sightings of some of the vertices that several views see.
fn rows(points: &[SurfacePoint], views: &[Prepared], sightings: &[Vec<Sighting>]) -> Vec<Vec<Row>> {
    let shared = sightings.iter().filter(|list| list.len() > 1).count();
    let step = shared.div_ceil(POINTS).max(1);
    let normals = points.iter().map(|p| Vector3::from(p.normal.map(f64::from)));
    let points = sightings.iter().zip(normals).filter(|(list, _)| list.len() > 1).step_by(step);
    let points = points.map(|(list, normal)| {
        let row = |s: &Sighting| {
            let view = usize::from(s.view);
            let usable = s.color.iter().all(|v| *v < CLIPPED) && s.color.iter().any(|v| *v > DARK);
            let log = s.color.iter().map(|v| f64::from(v.max(DARK)).ln()).sum::<f64>() / 3.0;
            let basis = basis(&(views[view].cam_from_obj().rotation * normal));
            usable.then(|| Row { view, log, weight: f64::from(s.broad), basis })
        };
        list.iter().filter_map(row).collect::<Vec<_>>()
    });
    points.filter(|rows| rows.len() > 1).collect()
}

/// Weighted residuals of a point against its own mean, and their robust weights.
fn residuals(rows: &[Row], x: &DVector<f64>, sigma: f64) -> Vec<f64> {
    let count = x.len() - TERMS;
    let light = &x.as_slice()[count..];
    let bare: Vec<f64> = rows
        .iter()
        .map(|r| r.log - x[r.view] - r.basis.iter().zip(light).map(|(a, b)| a * b).sum::<f64>())
        .collect();
    let mut mean = weighted_mean(rows.iter().map(|r| r.weight).zip(bare.iter().copied()));
    // The albedo is robust, too.
    if sigma.is_finite() {
        for _ in 0..3 {
            let weights = rows.iter().zip(&bare).map(|(r, b)| r.weight * cauchy((b - mean) / sigma));
            mean = weighted_mean(weights.zip(bare.iter().copied()));
        }
    }
    bare.into_iter().map(|b| b - mean).collect()
}

fn weighted_mean(pairs: impl Iterator<Item = (f64, f64)>) -> f64 {
    let (sum, weight) = pairs.fold((0.0, 0.0), |(sum, weight), (w, v)| (sum + w * v, weight + w));
    sum / weight
}

/// One step of the reweighted least squares: exposures of the views, then the terms of the light.
fn solve(points: &[Vec<Row>], x: &DVector<f64>, sigma: f64, count: usize) -> Option<DVector<f64>> {
    let size = count + TERMS;
    // Chunks of fixed size, added in their order: the result doesn't depend on the number of threads.
    let parts: Vec<_> = points
        .par_chunks(512)
        .map(|chunk| {
            let (mut h, mut g) = (DMatrix::zeros(size, size), DVector::zeros(size));
            chunk.iter().for_each(|rows| add_point(rows, x, sigma, &mut h, &mut g));
            (h, g)
        })
        .collect();
    let (mut h, mut g) = (DMatrix::zeros(size, size), DVector::zeros(size));
    for (part, right) in parts {
        h += part;
        g += right;
    }
    let scale = 1.0 / (sigma * sigma * CORRELATED);
    h *= scale;
    g *= scale;
    for i in 0..size {
        h[(i, i)] += i.checked_sub(count).map_or(EXPOSURE.powi(-2), prior);
    }
    Some(h.cholesky()?.solve(&g))
}

/// Adds a point's equations, its albedo eliminated: every row less their weighted mean.
fn add_point(rows: &[Row], x: &DVector<f64>, sigma: f64, h: &mut DMatrix<f64>, g: &mut DVector<f64>) {
    let count = x.len() - TERMS;
    let errors = residuals(rows, x, sigma);
    let weights: Vec<f64> = rows.iter().zip(&errors).map(|(r, e)| r.weight * cauchy(e / sigma)).collect();
    let total: f64 = weights.iter().sum();
    let mean_log = rows.iter().zip(&weights).map(|(r, w)| w * r.log).sum::<f64>() / total;
    let mean: Terms =
        std::array::from_fn(|k| rows.iter().zip(&weights).map(|(r, w)| w * r.basis[k]).sum::<f64>() / total);
    for (r, &w) in rows.iter().zip(&weights) {
        let log = r.log - mean_log;
        let own: Terms = std::array::from_fn(|k| r.basis[k] - mean[k]);
        h[(r.view, r.view)] += w;
        g[r.view] += w * log;
        for (q, &u) in rows.iter().zip(&weights) {
            h[(r.view, q.view)] -= w * u / total;
        }
        for i in 0..TERMS {
            h[(r.view, count + i)] += w * own[i];
            h[(count + i, r.view)] += w * own[i];
            g[count + i] += w * own[i] * log;
            for j in 0..TERMS {
                h[(count + i, count + j)] += w * own[i] * own[j];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::super::polynomial::tests::directions;
    use super::*;

    /// Values from -1 to 1 that follow no pattern.
    fn noise(i: usize) -> f64 {
        ((i as f64 * 12.9898).sin() * 43_758.545_3).rem_euclid(1.0) * 2.0 - 1.0
    }

    fn truth() -> Terms {
        std::array::from_fn(|k| {
            noise(k + 1000) * [0.3, 0.15, 0.03][if k < 3 { 0 } else { 1 + usize::from(k > 7) }]
        })
    }

    /// What views all around see of points with albedos and exposures of their own; one sighting of ten is wrong.
    fn lit(normals: usize, views: usize) -> Vec<Vec<Row>> {
        let rotations: Vec<_> = directions(views)
            .map(|d| UnitQuaternion::new(d * 2.5) * UnitQuaternion::new(d.yzx() * 1.3))
            .collect();
        let points = directions(normals).enumerate().map(|(i, normal)| {
            let row = |(view, rotation): (usize, &UnitQuaternion<f64>)| {
                let turned = rotation * normal;
                let basis = basis(&turned);
                let mut log = 4.0 + noise(i) + 0.2 * noise(view + 500) + dot(&basis, &truth());
                if (i + 3 * view) % 10 == 0 {
                    log += 0.8;
                }
                (turned.z < -0.2).then_some(Row { view, log, weight: -turned.z, basis })
            };
            rotations.iter().enumerate().filter_map(row).collect::<Vec<_>>()
        });
        points.filter(|rows| rows.len() > 1).collect()
    }

    #[test]
    fn a_known_light_is_found_among_albedos_exposures_and_outliers() {
        let found = moving(&lit(1500, 14), 14);
        // What no camera sees doesn't matter, nor does a constant.
        let seen: Vec<f64> = directions(3000)
            .filter(|n| n.z < -0.3)
            .map(|n| dot(&basis(&n), &found) - dot(&basis(&n), &truth()))
            .collect();
        let mean = seen.iter().sum::<f64>() / seen.len() as f64;
        let error = (seen.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / seen.len() as f64).sqrt();
        let shading: f64 = truth().iter().map(|t| t * t).sum::<f64>().sqrt();
        assert!(shading > 0.3 && error < 0.02, "{error} of {shading}");
    }

    #[test]
    fn a_single_view_tells_nothing() {
        assert_eq!(moving(&lit(300, 1), 1), [0.0; TERMS]);
    }
}
