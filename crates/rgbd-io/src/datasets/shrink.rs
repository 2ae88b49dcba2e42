//! Images a whole number of times smaller.

use crate::Image;

/// The pixel in the middle of every block.
pub(super) fn nearest<T: Copy>(image: Image<T>, divisor: usize) -> Image<T> {
    if divisor <= 1 {
        return image;
    }
    let (w, h) = (image.width() / divisor, image.height() / divisor);
    let middle = divisor / 2;
    Image::from_fn(w, h, |x, y| image[(x * divisor + middle, y * divisor + middle)])
}

/// The mean of every block, rounded.
pub(super) fn average(image: Image<[u8; 3]>, divisor: usize) -> Image<[u8; 3]> {
    if divisor <= 1 {
        return image;
    }
    let (w, h) = (image.width() / divisor, image.height() / divisor);
    let n = (divisor * divisor) as u64;
    Image::from_fn(w, h, |x, y| {
        let mut sum = [n / 2; 3];
        for row in y * divisor..(y + 1) * divisor {
            for pixel in image.row(row).iter().skip(x * divisor).take(divisor) {
                sum = std::array::from_fn(|k| sum[k] + u64::from(pixel[k]));
            }
        }
        sum.map(|s| (s / n) as u8)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_become_pixels() {
        let image = Image::from_fn(8, 7, |x, y| (10 * x + y) as u8);
        let small = nearest(image.clone(), 3);
        assert_eq!((small.size(), small.pixels()), ((2, 2), &[11, 41, 14, 44][..]));
        let rgb = image.map(|v| [*v, 0, 255]);
        assert_eq!(average(rgb.clone(), 3).pixels()[..2], [[11, 0, 255], [41, 0, 255]]);
        assert_eq!(average(rgb.clone(), 1), rgb);
        assert_eq!(nearest(image.clone(), 1), image);
    }
}
