//! Changes of resolution.

use super::map::Map;
use rayon::prelude::*;

/// Means of blocks of `size` x `size` pixels; incomplete blocks at the right and at the bottom are left out.
pub(crate) fn average_pool(map: &Map, size: usize) -> Map {
    let size = size.max(1);
    let mut out = Map::zeros(map.channels(), map.width() / size, map.height() / size);
    let share = 1.0 / (size * size) as f32;
    for c in 0..map.channels() {
        for y in 0..out.height() {
            let line = out.row_mut(c, y);
            for row in (y * size..(y + 1) * size).map(|y| map.row(c, y)) {
                for (sum, block) in line.iter_mut().zip(row.chunks_exact(size)) {
                    *sum += block.iter().sum::<f32>();
                }
            }
            line.iter_mut().for_each(|v| *v *= share);
        }
    }
    out
}

/// Adds `map`, bilinearly enlarged to the size of `target`, to `target`. Pixels are squares about their centres (the
/// convention called `align_corners = false`); beyond the outermost centres the values are constant.
pub(crate) fn add_upsampled(target: &mut Map, map: &Map) {
    let (width, height) = (target.width(), target.height());
    if map.width() == 0 || map.height() == 0 || target.channels() != map.channels() {
        return;
    }
    let columns: Vec<_> = (0..width).map(|x| neighbours(x, width, map.width())).collect();
    let rows: Vec<_> = (0..height).map(|y| neighbours(y, height, map.height())).collect();
    let (plane, stride) = (target.plane(), target.stride());
    let add = |(c, channel): (usize, &mut [f32])| {
        // First along the rows, which are few, then a plain blend of two of them for each row of the target.
        let mut wide = vec![0.0_f32; map.height() * width];
        for (y, line) in wide.chunks_exact_mut(width.max(1)).enumerate() {
            let row = map.row(c, y);
            for (value, &(i, j, t)) in line.iter_mut().zip(&columns) {
                *value = row[i] + t * (row[j] - row[i]);
            }
        }
        for (y, &(i, j, t)) in rows.iter().enumerate() {
            let (above, below) = (&wide[i * width..(i + 1) * width], &wide[j * width..(j + 1) * width]);
            let line = &mut channel[(y + 1) * stride + 1..][..width];
            for ((value, a), b) in line.iter_mut().zip(above).zip(below) {
                *value += a + t * (b - a);
            }
        }
    };
    let channels = target.channels();
    let data = &mut target.data_mut()[..channels * plane];
    if rayon::current_num_threads() > 1 && channels > 1 {
        data.par_chunks_exact_mut(plane).enumerate().with_min_len(channels.div_ceil(16)).for_each(add);
    } else {
        data.chunks_exact_mut(plane).enumerate().for_each(add);
    }
}

/// The two pixels of `from` between which pixel `x` of `to` lies, and the share of the second.
fn neighbours(x: usize, to: usize, from: usize) -> (usize, usize, f32) {
    let at = ((x as f32 + 0.5) * (from as f32 / to as f32) - 0.5).max(0.0);
    let first = (at as usize).min(from - 1);
    (first, (first + 1).min(from - 1), at - first as f32)
}

/// Blocks of `size` x `size` pixels of the only channel become the channels of one pixel: channel `dy * size + dx`.
pub(crate) fn pixel_unshuffle(map: &Map, size: usize) -> Map {
    let size = size.max(1);
    let mut out = Map::zeros(size * size, map.width() / size, map.height() / size);
    for c in 0..size * size {
        for y in 0..out.height() {
            let row = map.row(0, y * size + c / size);
            for (value, block) in out.row_mut(c, y).iter_mut().zip(row.chunks_exact(size)) {
                *value = block[c % size];
            }
        }
    }
    out
}

/// The inverse of [`pixel_unshuffle`] for a map of `size * size` channels.
pub(crate) fn pixel_shuffle(map: &Map, size: usize) -> Map {
    let mut out = Map::zeros(1, map.width() * size, map.height() * size);
    for c in 0..(size * size).min(map.channels()) {
        for y in 0..map.height() {
            let row = out.row_mut(0, y * size + c / size);
            for (block, value) in row.chunks_exact_mut(size).zip(map.row(c, y)) {
                block[c % size] = *value;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlarging_keeps_ramps_between_the_outermost_centres() {
        let ramp = |c: usize, x: f32, y: f32| 1.0 + c as f32 + 2.0 * x - 3.0 * y;
        let small = Map::from_fn(3, 5, 4, |c, x, y| ramp(c, x as f32, y as f32));
        for factor in [1, 2, 4, 8] {
            let mut big = Map::from_fn(3, 5 * factor, 4 * factor, |_, _, _| 10.0);
            add_upsampled(&mut big, &small);
            let centre = |x: usize, last: f32| ((x as f32 + 0.5) / factor as f32 - 0.5).clamp(0.0, last);
            for c in 0..3 {
                for y in 0..4 * factor {
                    for x in 0..5 * factor {
                        let want = 10.0 + ramp(c, centre(x, 4.0), centre(y, 3.0));
                        assert!((big.at(c, x, y) - want).abs() < 1e-4);
                    }
                }
            }
        }
    }

    #[test]
    fn shuffling_undoes_unshuffling() {
        let image = Map::from_fn(1, 24, 16, |_, x, y| (y * 24 + x) as f32);
        let cells = pixel_unshuffle(&image, 8);
        assert_eq!((cells.channels(), cells.width(), cells.height()), (64, 3, 2));
        assert_eq!(cells.at(8 * 5 + 3, 2, 1), image.at(0, 16 + 3, 8 + 5));
        assert_eq!(pixel_shuffle(&cells, 8).to_dense(), image.to_dense());
    }

    #[test]
    fn pooling_is_the_mean_of_blocks() {
        let map = Map::from_fn(2, 9, 8, |c, x, y| (c + x + 10 * y) as f32);
        let pooled = average_pool(&map, 4);
        assert_eq!((pooled.width(), pooled.height()), (2, 2));
        assert!((pooled.at(1, 1, 1) - (1.0 + 5.5 + 55.0)).abs() < 1e-4);
    }

    #[test]
    fn the_normalised_image_has_mean_0_and_variance_1_and_repeats_its_edges() {
        let image = rgbd_io::Image::from_fn(30, 20, |x, y| (x * x + 3 * y) as f32);
        let map = Map::normalised(&image, 32);
        assert_eq!((map.width(), map.height()), (32, 32));
        let inside: Vec<f32> = (0..20).flat_map(|y| map.row(0, y)[..30].to_vec()).collect();
        let mean = inside.iter().sum::<f32>() / 600.0;
        let variance = inside.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 600.0;
        assert!(mean.abs() < 1e-5 && (variance - 1.0).abs() < 1e-4);
        assert_eq!(map.at(0, 31, 31), map.at(0, 29, 19));
        assert!(Map::normalised(&rgbd_io::Image::filled(3, 3, 7.0), 32).to_dense().iter().all(|v| *v == 0.0));
    }
}
