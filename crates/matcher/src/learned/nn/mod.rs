//! The few operations the networks are made of, on feature maps with a margin of zeros.
//!
//! Every map carries one pixel of zeros around each channel. A 3x3 convolution then needs no case for the edges: along
//! the *whole* channel, rows joined end to end, an output is a weighted sum of the inputs at nine fixed distances. What
//! that computes in the two margin columns of a row is thrown away. A convolution with stride 2 is the same sum on the
//! four images of even and odd rows and columns. One inner loop ([`simd`]) serves all of them, and matching too.

mod conv;
mod map;
mod resample;
pub(crate) mod simd;
mod tile;

pub(crate) use conv::{After, Conv};
pub(crate) use map::Map;
pub(crate) use resample::{add_upsampled, average_pool, pixel_shuffle, pixel_unshuffle};
pub(crate) use tile::{LANES, OUTPUTS, Strip};
