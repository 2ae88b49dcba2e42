//! Run-time choice of instruction set: the same loops, compiled once more for registers of eight numbers (AVX2).
//!
//! Nothing is fused or reordered, so that results are the same bits with and without.
#![allow(unsafe_code)]

use crate::cloud::Cloud;
use crate::jacobian::{MatchSums, RowSums};
use crate::lanes;
use crate::matches::Matches;
use crate::moments;
use crate::options::Gates;
use crate::transform::Rigid;

macro_rules! dispatch {
    ($(#[$doc:meta])* $name:ident => $kernel:path, ($($arg:ident: $ty:ty),*) -> $result:ty) => {
        $(#[$doc])*
        pub(crate) fn $name($($arg: $ty),*) -> $result {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide($($arg: $ty),*) -> $result {
                    $kernel($($arg),*)
                }
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the feature that `wide` is compiled for was just detected on this processor.
                    return unsafe { wide($($arg),*) };
                }
            }
            $kernel($($arg),*)
        }
    };
}

dispatch!(
    /// [`lanes::cost`].
    dense_cost => lanes::cost, (blocks: &[lanes::Block], pose: &Rigid<f32>, delta: f32) -> f64
);
dispatch!(
    /// [`lanes::linearise`].
    dense_sums => lanes::linearise, (blocks: &[lanes::Block], pose: &Rigid<f32>, delta: f32) -> (RowSums, f64)
);
dispatch!(
    /// [`moments::cost`].
    feature_cost => moments::cost,
    (blocks: &[moments::Block], poses: (&Rigid<f32>, &Rigid<f32>), delta: f32) -> f64
);
dispatch!(
    /// [`moments::sums`].
    feature_sums => moments::sums,
    (blocks: &[moments::Block], poses: (&Rigid<f32>, &Rigid<f32>), delta: f32) -> (MatchSums, f64)
);
dispatch!(
    /// [`Matches::search`].
    search => Matches::search,
    (matches: &mut Matches, transform: &Rigid<f32>, clouds: (&Cloud<'_>, &Cloud<'_>), gates: &Gates, stride: usize) -> ()
);
