//! Is depth registered to colour? Where depth jumps, one thing ends and another begins, and mostly the colour changes
//! there too. If the two images agree better when one is shifted, they were not taken through the same lens.

use crate::Image;

/// Half the width of the searched square, in steps.
const REACH: usize = 16;
const SIDE: usize = 2 * REACH + 1;
/// The image's width over this is one step (pixels): the search reaches 5 % of the width to each side.
const STEPS_PER_WIDTH: usize = 320;
/// Depth edges of one frame that are looked at.
const EDGES: usize = 3000;
/// A depth that jumps by this share of itself is an edge.
const JUMP: f32 = 0.06;
/// Colour gradients above this (of 255) count no more: one glaring edge must not outvote all others.
const STRONG: f32 = 60.0;

/// Gathers evidence over several frames.
#[derive(Clone, Debug, Default)]
pub struct Registration {
    /// Sum of colour gradients at the depth edges, for each shift of the depth edges.
    score: Vec<f64>,
    edges: usize,
    step: usize,
}

/// By how much depth has to be shifted to fit colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shift {
    /// To the right and down, pixels.
    pub pixels: [i32; 2],
    /// Colour gradient at the shifted depth edges over that at the depth edges as they are.
    pub gain: f64,
}

impl Registration {
    /// Looks at a frame; colour and depth (metres, 0 = missing) must be of one size.
    pub fn add(&mut self, color: &Image<[u8; 3]>, depth: &Image<f32>) {
        let (w, h) = color.size();
        if depth.size() != (w, h) || w < 4 * REACH || h < 4 * REACH {
            return;
        }
        let step = (w / STEPS_PER_WIDTH).max(1);
        if self.score.is_empty() {
            (self.score, self.step) = (vec![0.0; SIDE * SIDE], step);
        }
        if step != self.step {
            return;
        }
        let gradient = gradient(color);
        let margin = REACH * step + 1;
        let edges = edges(depth, margin);
        let stride = edges.len().div_ceil(EDGES).max(1);
        for (x, y) in edges.iter().step_by(stride) {
            self.edges += 1;
            for j in 0..SIDE {
                let row = gradient.row(y + j * step - REACH * step);
                for i in 0..SIDE {
                    self.score[j * SIDE + i] += f64::from(row[x + i * step - REACH * step]);
                }
            }
        }
    }

    /// Depth edges looked at so far.
    #[must_use]
    pub fn edges(&self) -> usize {
        self.edges
    }

    /// The shift, if the images fit clearly better with one; `None` also when there is too little to tell by.
    #[must_use]
    pub fn shift(&self) -> Option<Shift> {
        const MIN_EDGES: usize = 400;
        /// Shifts below this many steps are the width of an edge.
        const MIN_STEPS: f64 = 4.0;
        /// How much better the shifted edges have to fit, and how far above all other shifts they have to stand.
        const MIN_GAIN: f64 = 1.2;
        const MIN_DEVIATIONS: f64 = 3.5;
        if self.edges < MIN_EDGES {
            return None;
        }
        // Edges are a few pixels wide and frayed: what fits is a neighbourhood.
        let smooth = |j: usize, i: usize| {
            let (js, is) = (j.saturating_sub(1)..(j + 2).min(SIDE), i.saturating_sub(1)..(i + 2).min(SIDE));
            let count = js.len() * is.len();
            js.flat_map(|j| is.clone().map(move |i| self.score[j * SIDE + i])).sum::<f64>() / count as f64
        };
        let all: Vec<f64> = (0..SIDE * SIDE).map(|k| smooth(k / SIDE, k % SIDE)).collect();
        let best = (0..all.len()).max_by(|a, b| all[*a].total_cmp(&all[*b]))?;
        let (mean, own) = (all.iter().sum::<f64>() / all.len() as f64, all[REACH * SIDE + REACH]);
        let deviation = (all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len() as f64).sqrt();
        let steps = [(best % SIDE) as i32 - REACH as i32, (best / SIDE) as i32 - REACH as i32];
        let far = f64::from(steps[0]).hypot(f64::from(steps[1])) >= MIN_STEPS;
        let gain = all[best] / own.max(f64::MIN_POSITIVE);
        let clear = gain > MIN_GAIN && all[best] > mean + MIN_DEVIATIONS * deviation;
        (far && clear).then(|| Shift { pixels: steps.map(|s| s * self.step as i32), gain })
    }
}

/// Length of the colour gradient, at most [`STRONG`].
fn gradient(color: &Image<[u8; 3]>) -> Image<f32> {
    let (w, h) = color.size();
    let at = |x: usize, y: usize| {
        let [r, g, b] = color[(x.min(w - 1), y.min(h - 1))].map(f32::from);
        [r, g, b]
    };
    Image::from_fn(w, h, |x, y| {
        let (here, right, below) = (at(x, y), at(x + 1, y), at(x, y + 1));
        let channel = |k: usize| (right[k] - here[k]).hypot(below[k] - here[k]);
        channel(0).max(channel(1)).max(channel(2)).min(STRONG)
    })
}

/// Pixels next to which depth jumps, at least `margin` from the border.
fn edges(depth: &Image<f32>, margin: usize) -> Vec<(usize, usize)> {
    let (w, h) = depth.size();
    let jumps = |a: f32, b: f32| a > 0.0 && b > 0.0 && (a - b).abs() > JUMP * a.min(b);
    let mut found = Vec::new();
    for y in margin..h.saturating_sub(margin + 1) {
        let (row, below) = (depth.row(y), depth.row(y + 1));
        for x in margin..w.saturating_sub(margin + 1) {
            // Two pixels on: sensors leave a gap or a ramp at an edge.
            let ahead = row[x + 1..(x + 3).min(w)].iter().any(|d| jumps(row[x], *d));
            if ahead || jumps(row[x], below[x]) {
                found.push((x, y));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A printed square in front of a wall; depth is shifted by (`dx`, `dy`).
    fn scene(dx: i32, dy: i32) -> (Image<[u8; 3]>, Image<f32>) {
        let inside = |x: i32, y: i32| (60..110).contains(&x) && (40..85).contains(&y);
        let color = Image::from_fn(160, 120, |x, y| {
            let texture = ((x * 37 + y * 57) % 23) as u8;
            if inside(x as i32, y as i32) {
                [190 - texture, 60 + texture, 50]
            } else {
                [90, 100 + texture, 110]
            }
        });
        let depth =
            Image::from_fn(160, 120, |x, y| if inside(x as i32 - dx, y as i32 - dy) { 0.5 } else { 1.0 });
        (color, depth)
    }

    fn shift(dx: i32, dy: i32) -> Option<Shift> {
        let (color, depth) = scene(dx, dy);
        let mut registration = Registration::default();
        (0..3).for_each(|_| registration.add(&color, &depth));
        registration.shift()
    }

    #[test]
    fn a_shift_is_found_and_its_absence_too() {
        assert_eq!(shift(0, 0), None);
        assert_eq!(shift(1, 1), None);
        for (dx, dy) in [(9, 0), (0, -8), (-7, 6)] {
            let found = shift(dx, dy).unwrap();
            let off = [found.pixels[0] + dx, found.pixels[1] + dy];
            assert!(off.iter().all(|o| o.abs() <= 1), "{dx} {dy}: {found:?}");
            assert!(found.gain > 1.2);
        }
    }

    #[test]
    fn nothing_to_tell_by_says_nothing() {
        let mut registration = Registration::default();
        registration.add(&Image::filled(160, 120, [90; 3]), &Image::filled(160, 120, 1.0));
        registration.add(&Image::filled(3, 3, [90; 3]), &Image::filled(3, 3, 1.0));
        registration.add(&Image::filled(160, 120, [90; 3]), &Image::filled(16, 12, 1.0));
        assert_eq!((registration.edges(), registration.shift()), (0, None));
    }
}
