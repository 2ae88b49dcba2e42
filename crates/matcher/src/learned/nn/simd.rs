//! Run-time choice of instruction set: the same generic code, compiled once more for AVX2 with fused multiply-add.
#![allow(unsafe_code)]

use super::tile::{self, Strip};

/// Whether fused multiply-add is one instruction in code compiled without run-time detection.
const BASELINE_FMA: bool = cfg!(any(target_feature = "fma", target_arch = "aarch64"));

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn wide_strip(strip: &Strip<'_>, out: &mut [&mut [f32]]) {
    tile::strip::<2, true>(strip, out);
}

/// Computes a strip of a convolution; `out` has a slice for each output, all of the same length.
pub(crate) fn strip(strip: &Strip<'_>, out: &mut [&mut [f32]]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
        // SAFETY: the two features that `wide_strip` is compiled for were just detected on this processor.
        unsafe { wide_strip(strip, out) };
        return;
    }
    portable_strip(strip, out);
}

/// [`strip`] with the instructions every processor of the target has.
pub(crate) fn portable_strip(strip: &Strip<'_>, out: &mut [&mut [f32]]) {
    // Half-size registers: fewer pixels at a time stay in them.
    tile::strip::<1, BASELINE_FMA>(strip, out);
}
