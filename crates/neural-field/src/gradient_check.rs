//! The whole training step against central differences, in `f64`: grid, both networks and poses, per loss and all.

use crate::grid::{FEATURES, Grid, mix};
use crate::mlp::Networks;
use crate::pass::run_tile;
use crate::pose::PoseCorrections;
use crate::tile::{Model, RAYS, Scratch, Tile, TileGradient, loss};
use nalgebra::{Isometry3, Vector3, Vector6};

const FREE: usize = 4;
const BAND: usize = 8;
const CENTRAL: usize = 4;
const FRAMES: usize = 3;

/// Parameters of the step, to be nudged one at a time.
#[derive(Clone)]
struct Problem {
    grid: Grid<f64>,
    networks: Networks,
    weights: Vec<f64>,
    poses: PoseCorrections,
    tiles: Vec<Tile<f64>>,
}

fn random(seed: &mut u64) -> f64 {
    *seed += 1;
    (mix(*seed) >> 11) as f64 / (1u64 << 53) as f64
}

fn between(seed: &mut u64, lo: f64, hi: f64) -> f64 {
    lo + (hi - lo) * random(seed)
}

/// Rays of all frames through the middle of the volume with every kind of target; `only` keeps a single loss.
fn problem(only: Option<usize>, log2_table: u32) -> Problem {
    let mut s = 10_000;
    let grid = Grid::new(2, (5, 11), log2_table, 0.5, 1);
    let networks = Networks::new(grid.width(), 16, 7, (3, FRAMES));
    let mut weights: Vec<f64> = networks.init(5);
    for w in &mut weights {
        *w += between(&mut s, -0.1, 0.1);
    }
    let initial: Vec<_> = (0..FRAMES)
        .map(|f| {
            let turn = Vector3::new(0.4, 2.0 * f as f64, 0.3);
            let r = Isometry3::rotation(turn).rotation;
            Isometry3::from_parts(
                (r * Vector3::new(0.02, -0.03, -0.5) + Vector3::new(0.1, 0.2, 0.3)).into(),
                r,
            )
        })
        .collect();
    let mut poses = PoseCorrections::new(&initial, [0.1, 0.2, 0.3], 0.4, 0.03, 0.4);
    for theta in &mut poses.theta {
        *theta = Vector6::from_fn(|_, _| between(&mut s, -0.8, 0.8));
    }
    let on = |l: usize| only.is_none_or(|o| o == l);
    let tiles = (0..3)
        .map(|_| {
            let lanes = RAYS * (FREE + BAND);
            let mut tile = Tile::new(lanes, RAYS * CENTRAL);
            tile.has_color = on(loss::COLOR);
            tile.has_eikonal = on(loss::EIKONAL);
            for r in 0..RAYS {
                tile.frame[r] = (random(&mut s) * FRAMES as f64) as usize;
                let d = Vector3::new(between(&mut s, -0.1, 0.1), between(&mut s, -0.1, 0.1), 1.0).normalize();
                tile.dir[r] = d.into();
                tile.color[r] = [0; 3].map(|_| random(&mut s));
                tile.w_color[r] = if on(loss::COLOR) { between(&mut s, 0.5, 2.0) } else { 0.0 };
            }
            for l in 0..lanes {
                tile.t[l] = between(&mut s, 1.0, 1.5);
                tile.target[l] = between(&mut s, -1.0, 1.0);
                let mut weight = |l: usize| if on(l) { between(&mut s, 0.5, 2.0) } else { 0.0 };
                tile.w_surface[l] = weight(loss::SURFACE);
                tile.w_empty[l] = weight(loss::EMPTY);
                tile.w_uncertain[l] = weight(loss::UNCERTAIN);
            }
            for l in 0..RAYS * CENTRAL {
                tile.bell[l] = between(&mut s, 0.1, 0.4);
                tile.w_eikonal[l] = between(&mut s, 0.5, 2.0);
            }
            tile
        })
        .collect();
    Problem { grid, networks, weights, poses, tiles }
}

struct Gradient {
    loss: f64,
    grid: Vec<Vec<f64>>,
    weights: Vec<f64>,
    theta: Vec<Vector6<f64>>,
}

impl Problem {
    fn evaluate(&self) -> Gradient {
        let model =
            Model { grid: &self.grid, networks: &self.networks, weights: &self.weights, truncation: 0.3 };
        let poses = self.poses.ray_poses::<f64>();
        let mut weights = vec![0.0; self.networks.len];
        let mut grid: Vec<Vec<f64>> = self.grid.tables.iter().map(|t| vec![0.0; t.len()]).collect();
        let mut twists = [Vector6::zeros(); FRAMES];
        let mut total = 0.0;
        for tile in &self.tiles {
            let mut scratch = Scratch::new(tile.lanes, tile.central, &self.networks);
            let mut out = TileGradient::new(tile.lanes, tile.central, &self.networks);
            run_tile::<f64, false>(&model, &poses, tile, &mut scratch, &mut out, &mut weights);
            total += out.losses.iter().sum::<f64>();
            for r in 0..RAYS {
                twists[out.frame[r]] += Vector6::from(out.twist[r]);
            }
            for (l, (level, grad)) in self.grid.levels.iter().zip(&mut grid).enumerate() {
                let mut touched = vec![0; level.len.div_ceil(512)];
                scatter(level, l, &out, grad, &mut touched);
            }
        }
        let theta = (0..FRAMES).map(|f| self.poses.theta_gradient(f, &twists[f])).collect();
        Gradient { loss: total, grid, weights, theta }
    }

    /// Largest error over parameters picked from every family, relative to the family's largest gradient.
    fn worst(&self) -> f64 {
        let exact = self.evaluate();
        let mut worst: f64 = 0.0;
        let mut families: Vec<Vec<(f64, f64)>> = Vec::new();
        let mut s = 99;
        for l in 0..self.grid.tables.len() {
            let live: Vec<usize> = (0..exact.grid[l].len()).filter(|&i| exact.grid[l][i] != 0.0).collect();
            families.push(
                (0..40.min(live.len()))
                    .map(|_| {
                        let i = live[(random(&mut s) * live.len() as f64) as usize];
                        (exact.grid[l][i], self.difference(|p, h| p.grid.tables[l][i] += h))
                    })
                    .collect(),
            );
        }
        for layer in self.networks.geometry.iter().chain(&self.networks.color) {
            for range in [layer.weights(), layer.bias()] {
                families.push(
                    (0..12)
                        .map(|_| {
                            let i = range.start + (random(&mut s) * range.len() as f64) as usize;
                            (exact.weights[i], self.difference(|p, h| p.weights[i] += h))
                        })
                        .collect(),
                );
            }
        }
        families.push(
            (0..FRAMES)
                .flat_map(|f| self.networks.codes.of(f))
                .map(|i| (exact.weights[i], self.difference(|p, h| p.weights[i] += h)))
                .collect(),
        );
        families.push(
            (0..FRAMES)
                .flat_map(|f| (0..6).map(move |a| (f, a)))
                .map(|(f, a)| (exact.theta[f][a], self.difference(|p, h| p.poses.theta[f][a] += h)))
                .collect(),
        );
        for family in &families {
            let scale = family.iter().fold(1e-6f64, |m, (e, d)| m.max(e.abs()).max(d.abs()));
            for (e, d) in family {
                worst = worst.max((e - d).abs() / scale);
            }
        }
        worst
    }

    fn difference(&self, nudge: impl Fn(&mut Problem, f64)) -> f64 {
        let h = 1e-6;
        let at = |h: f64| {
            let mut p = self.clone();
            nudge(&mut p, h);
            p.evaluate().loss
        };
        (at(h) - at(-h)) / (2.0 * h)
    }
}

fn scatter(
    level: &crate::grid::Level,
    l: usize,
    out: &TileGradient<f64>,
    grad: &mut [f64],
    touched: &mut [u64],
) {
    let (n, m, row) = (out.lanes, out.central, FEATURES * l);
    for lane in 0..n {
        let p = [0, 1, 2].map(|a| out.pos[a * n + lane]);
        let value = [out.enc[row * n + lane], out.enc[(row + 1) * n + lane]];
        let slope = (out.has_eikonal && lane >= n - m).then(|| {
            let c = lane + m - n;
            ([0, 1, 2].map(|a| out.gamma[a * m + c]), [out.v[row * m + c], out.v[(row + 1) * m + c]])
        });
        level.scatter(p, value, slope, grad, touched);
    }
}

#[test]
fn every_loss_alone() {
    for l in 0..loss::COUNT {
        let p = problem(Some(l), 20);
        assert!(p.evaluate().loss > 1e-3, "loss {l} is not exercised");
        let worst = p.worst();
        println!("loss {l}: {worst:.2e}");
        assert!(worst < 1e-4, "loss {l}: {worst:.2e}");
    }
}

#[test]
fn all_losses_together_dense_and_hashed() {
    for log2_table in [20, 8] {
        let worst = problem(None, log2_table).worst();
        println!("all: {worst:.2e}");
        assert!(worst < 1e-4, "{worst:.2e}");
    }
}

#[test]
fn single_precision_agrees_with_double() {
    // The same tile through the dispatched f32 path and through f64.
    let p = problem(None, 20);
    let exact = p.evaluate();
    let narrow = |v: &[f64]| v.iter().map(|x| *x as f32).collect::<Vec<f32>>();
    let grid =
        Grid { levels: p.grid.levels.clone(), tables: p.grid.tables.iter().map(|t| narrow(t)).collect() };
    let weights = narrow(&p.weights);
    let model = Model { grid: &grid, networks: &p.networks, weights: &weights, truncation: 0.3 };
    let poses = p.poses.ray_poses::<f32>();
    let mut grad = vec![0.0f32; p.networks.len];
    let mut total = 0.0;
    for t in &p.tiles {
        let mut tile = Tile::<f32>::new(t.lanes, t.central);
        tile.frame = t.frame;
        tile.dir = t.dir.map(|d| d.map(|v| v as f32));
        tile.color = t.color.map(|d| d.map(|v| v as f32));
        tile.w_color = t.w_color.map(|v| v as f32);
        tile.t = narrow(&t.t);
        tile.target = narrow(&t.target);
        tile.w_surface = narrow(&t.w_surface);
        tile.w_empty = narrow(&t.w_empty);
        tile.w_uncertain = narrow(&t.w_uncertain);
        tile.bell = narrow(&t.bell);
        tile.w_eikonal = narrow(&t.w_eikonal);
        tile.has_color = t.has_color;
        tile.has_eikonal = t.has_eikonal;
        let mut scratch = Scratch::new(tile.lanes, tile.central, &p.networks);
        let mut out = TileGradient::new(tile.lanes, tile.central, &p.networks);
        crate::simd::run_tile(&model, &poses, &tile, &mut scratch, &mut out, &mut grad);
        total += out.losses.iter().map(|v| f64::from(*v)).sum::<f64>();
    }
    assert!((total - exact.loss).abs() < 1e-4 * exact.loss);
    let scale = exact.weights.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    for (g, e) in grad.iter().zip(&exact.weights) {
        assert!((f64::from(*g) - e).abs() < 1e-4 * scale);
    }
}
