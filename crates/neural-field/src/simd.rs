//! Run-time choice of instruction set: the same generic code, compiled once more for AVX2 with fused multiply-add.
#![allow(unsafe_code)]

use crate::pass;
use crate::query as evaluate;
use crate::tile::{Model, RayPose, Scratch, Tile, TileGradient};

/// Whether fused multiply-add is one instruction in code compiled without run-time detection.
const BASELINE_FMA: bool = cfg!(any(target_feature = "fma", target_arch = "aarch64"));

#[cfg(target_arch = "x86_64")]
fn has_avx2_fma() -> bool {
    std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
}

macro_rules! dispatch {
    ($(#[$doc:meta])* $name:ident => $kernel:path, ($($arg:ident: $ty:ty),*)) => {
        $(#[$doc])*
        pub(crate) fn $name($($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn wide($($arg: $ty),*) {
                    $kernel($($arg),*);
                }
                if has_avx2_fma() {
                    // SAFETY: the two features that `wide` is compiled for were just detected on this processor.
                    unsafe { wide($($arg),*) };
                    return;
                }
            }
            narrow::$name($($arg),*);
        }
    };
}

dispatch!(
    /// [`pass::run_tile`] in `f32`.
    run_tile => pass::run_tile::<f32, true>,
    (model: &Model<'_, f32>, poses: &[RayPose<f32>], tile: &Tile<f32>, scratch: &mut Scratch<f32>,
     out: &mut TileGradient<f32>, grad: &mut [f32])
);
dispatch!(
    /// [`evaluate::query`] in `f32`.
    query => evaluate::query::<f32, true>,
    (model: &Model<'_, f32>, lanes: usize, pos: &[f32], scratch: &mut Scratch<f32>, slopes: bool)
);
dispatch!(
    /// [`evaluate::query_color`] in `f32`.
    query_color => evaluate::query_color::<f32, true>,
    (model: &Model<'_, f32>, lanes: usize, dirs: &[[f32; 3]], scratch: &mut Scratch<f32>)
);
dispatch!(
    /// [`crate::adam::update`] in `f32`.
    adam => crate::adam::update,
    (rate: crate::adam::Rate, value: &mut [f32], grad: &mut [f32], moments: &mut [[f32; 2]])
);

#[cfg(feature = "bench")]
dispatch!(
    /// [`crate::bench::multiply_add`].
    multiply_add => crate::bench::multiply_add::<true>,
    (sums: &mut [[f32; 8]; 12], rounds: usize)
);
#[cfg(feature = "bench")]
dispatch!(
    /// [`crate::grid::Grid::encode`] in `f32`.
    encode => crate::bench::encode,
    (grid: &crate::grid::Grid<f32>, lanes: usize, pos: &[f32], scratch: &mut Scratch<f32>)
);
#[cfg(feature = "bench")]
dispatch!(
    /// [`crate::pass::layer_forward`] of the first geometry layer in `f32`.
    layer => crate::bench::layer::<true>,
    (model: &Model<'_, f32>, lanes: usize, scratch: &mut Scratch<f32>)
);

/// The portable versions.
mod narrow {
    use super::*;

    pub(super) fn run_tile(
        model: &Model<'_, f32>,
        poses: &[RayPose<f32>],
        tile: &Tile<f32>,
        scratch: &mut Scratch<f32>,
        out: &mut TileGradient<f32>,
        grad: &mut [f32],
    ) {
        pass::run_tile::<f32, BASELINE_FMA>(model, poses, tile, scratch, out, grad);
    }

    pub(super) fn query(
        model: &Model<'_, f32>,
        lanes: usize,
        pos: &[f32],
        s: &mut Scratch<f32>,
        slopes: bool,
    ) {
        evaluate::query::<f32, BASELINE_FMA>(model, lanes, pos, s, slopes);
    }

    pub(super) fn query_color(model: &Model<'_, f32>, lanes: usize, dirs: &[[f32; 3]], s: &mut Scratch<f32>) {
        evaluate::query_color::<f32, BASELINE_FMA>(model, lanes, dirs, s);
    }

    #[cfg(feature = "bench")]
    pub(super) fn multiply_add(sums: &mut [[f32; 8]; 12], rounds: usize) {
        crate::bench::multiply_add::<BASELINE_FMA>(sums, rounds);
    }

    #[cfg(feature = "bench")]
    pub(super) fn encode(grid: &crate::grid::Grid<f32>, lanes: usize, pos: &[f32], s: &mut Scratch<f32>) {
        crate::bench::encode(grid, lanes, pos, s);
    }

    #[cfg(feature = "bench")]
    pub(super) fn layer(model: &Model<'_, f32>, lanes: usize, s: &mut Scratch<f32>) {
        crate::bench::layer::<BASELINE_FMA>(model, lanes, s);
    }

    pub(super) fn adam(
        rate: crate::adam::Rate,
        value: &mut [f32],
        grad: &mut [f32],
        moments: &mut [[f32; 2]],
    ) {
        crate::adam::update(rate, value, grad, moments);
    }
}
