//! Feature maps.

use super::tile::LANES;
use rgbd_io::Image;
use std::cell::RefCell;

/// Buffers kept for the next maps of a thread. A pass needs some ten megabytes again and again: given back each time, the
/// pages fault in anew, which took a fifth of the time.
const SPARES: usize = 24;
thread_local! {
    static SPARE: RefCell<Vec<Vec<f32>>> = const { RefCell::new(Vec::new()) };
}

/// `len` zeros, in the smallest spare buffer that has room and is not four times too large.
fn zeros(len: usize) -> Vec<f32> {
    let fits = |b: &Vec<f32>| (len..=len.saturating_mul(4)).contains(&b.capacity());
    let take = |spare: &mut Vec<Vec<f32>>| {
        let (index, _) =
            spare.iter().enumerate().filter(|(_, b)| fits(b)).min_by_key(|(_, b)| b.capacity())?;
        Some(spare.swap_remove(index))
    };
    match SPARE.try_with(|spare| take(&mut spare.borrow_mut())) {
        Ok(Some(mut buffer)) => {
            buffer.clear();
            buffer.resize(len, 0.0);
            buffer
        }
        _ => vec![0.0; len],
    }
}

/// Keeps a buffer; of too many, the smallest goes.
fn keep(buffer: Vec<f32>) {
    // During a thread's end there is nothing to keep it for.
    let _ = SPARE.try_with(|spare| {
        let mut spare = spare.borrow_mut();
        spare.push(buffer);
        if spare.len() > SPARES
            && let Some((index, _)) = spare.iter().enumerate().min_by_key(|(_, b)| b.capacity())
        {
            spare.swap_remove(index);
        }
    });
}

/// A stack of channels (C x H x W, `f32`), each with a margin of one zero pixel, and [`LANES`] values after the last.
#[derive(Debug)]
pub(crate) struct Map {
    channels: usize,
    width: usize,
    height: usize,
    data: Vec<f32>,
}

impl Drop for Map {
    fn drop(&mut self) {
        keep(std::mem::take(&mut self.data));
    }
}

impl Map {
    /// A map of zeros.
    pub(crate) fn zeros(channels: usize, width: usize, height: usize) -> Self {
        let data = zeros(channels * (width + 2) * (height + 2) + LANES);
        Self { channels, width, height, data }
    }

    /// A map whose value in channel `c` at `(x, y)` is `f(c, x, y)`.
    pub(crate) fn from_fn(
        channels: usize,
        width: usize,
        height: usize,
        mut f: impl FnMut(usize, usize, usize) -> f32,
    ) -> Self {
        let mut map = Self::zeros(channels, width, height);
        for c in 0..channels {
            for y in 0..height {
                for (x, value) in map.row_mut(c, y).iter_mut().enumerate() {
                    *value = f(c, x, y);
                }
            }
        }
        map
    }

    /// `image` as the only channel, with mean 0 and variance 1 (instance normalisation: biased variance, epsilon 1e-5).
    /// The last column and row are repeated until the sides are multiples of `multiple`; they do not count in the
    /// statistics.
    pub(crate) fn normalised(image: &Image<f32>, multiple: usize) -> Self {
        let count = image.pixels().len().max(1) as f64;
        let mean = image.pixels().iter().map(|&v| f64::from(v)).sum::<f64>() / count;
        let variance = image.pixels().iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / count;
        let gain = 1.0 / (variance + 1e-5).sqrt();
        let (width, height) =
            (image.width().next_multiple_of(multiple), image.height().next_multiple_of(multiple));
        let mut map = Self::zeros(1, width, height);
        for y in 0..height {
            let from = image.row(y.min(image.height().saturating_sub(1)));
            let line = map.row_mut(0, y);
            for (value, v) in line.iter_mut().zip(from) {
                *value = ((f64::from(*v) - mean) * gain) as f32;
            }
            let inside = from.len().min(line.len());
            let last = inside.checked_sub(1).map_or(0.0, |i| line[i]);
            line[inside..].fill(last);
        }
        map
    }

    pub(crate) fn channels(&self) -> usize {
        self.channels
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    pub(crate) fn height(&self) -> usize {
        self.height
    }

    /// Values from a row to the next.
    pub(crate) fn stride(&self) -> usize {
        self.width + 2
    }

    /// Values from a channel to the next.
    pub(crate) fn plane(&self) -> usize {
        (self.width + 2) * (self.height + 2)
    }

    /// Everything, margins and the values after the last channel included.
    pub(crate) fn data(&self) -> &[f32] {
        &self.data
    }

    pub(crate) fn data_mut(&mut self) -> &mut [f32] {
        &mut self.data
    }

    /// Row `y` of channel `c`, without its margin.
    pub(crate) fn row(&self, c: usize, y: usize) -> &[f32] {
        let first = self.first(c, y);
        &self.data[first..first + self.width]
    }

    pub(crate) fn row_mut(&mut self, c: usize, y: usize) -> &mut [f32] {
        let (first, width) = (self.first(c, y), self.width);
        &mut self.data[first..first + width]
    }

    fn first(&self, c: usize, y: usize) -> usize {
        c * self.plane() + (y + 1) * self.stride() + 1
    }

    /// The value in channel `c` at `(x, y)`.
    #[inline]
    pub(crate) fn at(&self, c: usize, x: usize, y: usize) -> f32 {
        self.data[self.first(c, y) + x]
    }

    /// Makes the margin columns zero.
    pub(crate) fn clear_margin(&mut self) {
        let (stride, end) = (self.stride(), self.channels * self.plane());
        for row in self.data[..end].chunks_exact_mut(stride) {
            row[0] = 0.0;
            row[stride - 1] = 0.0;
        }
    }

    /// Divides the vector of channel values at each pixel by its length.
    pub(crate) fn normalise_pixels(&mut self) {
        let plane = self.plane();
        let end = self.channels * plane;
        let mut gains = vec![0.0_f32; plane];
        for channel in self.data[..end].chunks_exact(plane) {
            for (sum, v) in gains.iter_mut().zip(channel) {
                *sum += v * v;
            }
        }
        gains.iter_mut().for_each(|g| *g = 1.0 / g.sqrt().max(1e-12));
        for channel in self.data[..end].chunks_exact_mut(plane) {
            for (v, gain) in channel.iter_mut().zip(&gains) {
                *v *= gain;
            }
        }
    }

    /// The values without margins: channel after channel, row after row.
    pub(crate) fn to_dense(&self) -> Vec<f32> {
        let rows = (0..self.channels).flat_map(|c| (0..self.height).map(move |y| (c, y)));
        rows.flat_map(|(c, y)| self.row(c, y).iter().copied()).collect()
    }
}
