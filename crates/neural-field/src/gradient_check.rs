//! The whole training step against central differences, in `f64`: grid, both networks and poses, per loss and all.

use crate::grid::{FEATURES, GROUP, Grid, mix};
use crate::mlp::Networks;
use crate::pass::{FinishTiles, RunTile};
use crate::pose::PoseCorrections;
use crate::real::{Baseline, Isa};
use crate::scatter::{Scatter, Vertices};
use crate::simd::Set;
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

struct Gradient<R> {
    loss: R,
    grid: Vec<Vec<R>>,
    weights: Vec<R>,
    /// By a left perturbation of each frame's pose.
    twists: Vec<[R; 6]>,
}

impl Problem {
    fn evaluate(&self) -> Gradient<f64> {
        let flipped = self.networks.flip_all(&self.weights);
        let model = Model {
            grid: &self.grid,
            networks: &self.networks,
            weights: &self.weights,
            flipped: &flipped,
            truncation: 0.3,
        };
        let poses = self.poses.ray_poses::<f64>();
        let mut weights = vec![0.0; self.networks.len];
        let mut grid: Vec<Vec<f64>> = self.grid.tables.iter().map(|t| vec![0.0; t.len()]).collect();
        let mut twists = vec![[0.0; 6]; FRAMES];
        let mut total = 0.0;
        for tile in &self.tiles {
            let mut scratch = Scratch::new(tile.lanes, tile.central, &self.networks);
            let mut out = TileGradient::new(tile.lanes, tile.central, &self.networks);
            let (model, poses, scratch) = (&model, &poses, &mut scratch);
            Baseline::call(RunTile { model, poses, tile, scratch, out: &mut out, grad: &mut weights });
            Baseline::call(FinishTiles { model, scratch, grad: &mut weights });
            total += out.losses.iter().sum::<f64>();
            for (frame, twist) in out.frame.iter().zip(out.twist) {
                for (sum, v) in twists[*frame].iter_mut().zip(twist) {
                    *sum += v;
                }
            }
            for (l, (level, grad)) in self.grid.levels.iter().zip(&mut grid).enumerate() {
                let mut touched = vec![0; level.len.div_ceil(GROUP)];
                let mut to = Vertices { first: 0, grad, touched: &mut touched };
                Baseline::call(Scatter { level, l, tile: &out, to: &mut to });
            }
        }
        Gradient { loss: total, grid, weights, twists }
    }

    /// Largest error over parameters picked from every family, relative to the family's largest gradient.
    fn worst(&self) -> f64 {
        let exact = self.evaluate();
        let theta: Vec<_> =
            (0..FRAMES).map(|f| self.poses.theta_gradient(f, &Vector6::from(exact.twists[f]))).collect();
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
                .map(|(f, a)| (theta[f][a], self.difference(|p, h| p.poses.theta[f][a] += h)))
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

/// The gradients of a problem's tiles in single precision, on an instruction set.
fn single(p: &Problem, set: Set) -> Gradient<f32> {
    let narrow = |v: &[f64]| v.iter().map(|x| *x as f32).collect::<Vec<f32>>();
    let tables = p.grid.tables.iter().map(|t| narrow(t)).collect();
    let grid = Grid { levels: p.grid.levels.clone(), tables };
    let weights = narrow(&p.weights);
    let flipped = p.networks.flip_all(&weights);
    let networks = &p.networks;
    let model = Model { grid: &grid, networks, weights: &weights, flipped: &flipped, truncation: 0.3 };
    let poses = p.poses.ray_poses::<f32>();
    let mut gradient = Gradient {
        loss: 0.0,
        grid: grid.tables.iter().map(|t| vec![0.0; t.len()]).collect(),
        weights: vec![0.0; networks.len],
        twists: vec![[0.0; 6]; FRAMES],
    };
    let mut touched: Vec<Vec<u8>> = grid.levels.iter().map(|l| vec![0; l.len.div_ceil(GROUP)]).collect();
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
        let mut scratch = Scratch::new(tile.lanes, tile.central, networks);
        let mut out = TileGradient::new(tile.lanes, tile.central, networks);
        let (model, poses, tile, scratch) = (&model, &poses, &tile, &mut scratch);
        set.call(RunTile { model, poses, tile, scratch, out: &mut out, grad: &mut gradient.weights });
        set.call(FinishTiles { model, scratch, grad: &mut gradient.weights });
        gradient.loss += out.losses.iter().sum::<f32>();
        for (frame, twist) in out.frame.iter().zip(out.twist) {
            for (sum, v) in gradient.twists[*frame].iter_mut().zip(twist) {
                *sum += v;
            }
        }
        // In two parts, as training does it.
        for (l, (level, grad)) in grid.levels.iter().zip(&mut gradient.grid).enumerate() {
            let middle = (level.len / 2).next_multiple_of(GROUP);
            let (low, high) = grad.split_at_mut(FEATURES * middle);
            let (low_touched, high_touched) = touched[l].split_at_mut(middle / GROUP);
            for (first, grad, touched) in [(0, low, low_touched), (middle, high, high_touched)] {
                set.call(Scatter { level, l, tile: &out, to: &mut Vertices { first, grad, touched } });
            }
        }
    }
    for (grad, touched) in gradient.grid.iter().zip(touched) {
        for (g, touched) in grad.chunks(GROUP * FEATURES).zip(touched) {
            assert_eq!(touched == 1, g.iter().any(|v| *v != 0.0));
        }
    }
    gradient
}

/// Largest difference of any number, relative to the largest of its family.
fn worst_difference(a: &Gradient<f32>, b: &Gradient<f64>, networks: &Networks) -> f64 {
    let family = |a: &[f32], b: &[f64]| {
        let scale = b.iter().fold(1e-12f64, |m, v| m.max(v.abs()));
        a.iter().zip(b).fold(0.0f64, |m, (a, b)| m.max((f64::from(*a) - b).abs() / scale))
    };
    let mut worst = family(&[a.loss], &[b.loss]);
    for (a, b) in a.grid.iter().zip(&b.grid) {
        worst = worst.max(family(a, b));
    }
    for layer in networks.geometry.iter().chain(&networks.color) {
        for range in [layer.weights(), layer.bias()] {
            worst = worst.max(family(&a.weights[range.clone()], &b.weights[range]));
        }
    }
    worst.max(family(a.twists.as_flattened(), b.twists.as_flattened()))
}

#[test]
fn every_instruction_set_agrees_with_double_precision() {
    for log2_table in [20, 8] {
        let p = problem(None, log2_table);
        let exact = p.evaluate();
        for set in Set::all() {
            let worst = worst_difference(&single(&p, set), &exact, &p.networks);
            println!("{set:?}: {worst:.1e}");
            assert!(worst < 1e-5, "{set:?}: {worst:.1e}");
        }
    }
}

/// What an earlier tile has left in the buffers is gone where no sample has a gradient.
#[test]
fn tiles_without_gradients_leave_none() {
    let p = problem(None, 20);
    let weights = p.weights.clone();
    let flipped = p.networks.flip_all(&weights);
    let (grid, networks) = (&p.grid, &p.networks);
    let model = &Model { grid, networks, weights: &weights, flipped: &flipped, truncation: 0.3 };
    let poses = &p.poses.ray_poses::<f64>();
    let mut tile = p.tiles[0].clone();
    let scratch = &mut Scratch::new(tile.lanes, tile.central, networks);
    let mut out = TileGradient::new(tile.lanes, tile.central, networks);
    let mut grad = vec![0.0; networks.len];
    Baseline::call(RunTile { model, poses, tile: &tile, scratch, out: &mut out, grad: &mut grad });
    Baseline::call(FinishTiles { model, scratch, grad: &mut grad });
    assert!(out.enc.iter().chain(out.twist.as_flattened()).chain(&grad).any(|v| *v != 0.0));
    for weights in [&mut tile.w_surface, &mut tile.w_empty, &mut tile.w_uncertain] {
        weights.fill(0.0);
    }
    (tile.has_color, tile.has_eikonal) = (false, false);
    grad.fill(0.0);
    Baseline::call(RunTile { model, poses, tile: &tile, scratch, out: &mut out, grad: &mut grad });
    Baseline::call(FinishTiles { model, scratch, grad: &mut grad });
    assert!(out.enc.iter().chain(out.twist.as_flattened()).chain(&grad).all(|v| *v == 0.0));
}
