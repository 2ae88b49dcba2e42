//! The part of an image that a mask needs.

/// A box of pixels of an image; values of them are kept row by row.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    left: usize,
    top: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Window {
    /// The pixels of the box `[u0, v0, u1, v1]` (inclusive) and those within `margin` of it, as far as the image goes.
    pub(crate) fn around(
        [u0, v0, u1, v1]: [usize; 4],
        margin: usize,
        (width, height): (usize, usize),
    ) -> Self {
        let (left, top) = (u0.saturating_sub(margin), v0.saturating_sub(margin));
        let end = |last: usize, size: usize| last.saturating_add(margin).saturating_add(1).min(size);
        Self {
            left,
            top,
            width: end(u1, width).saturating_sub(left),
            height: end(v1, height).saturating_sub(top),
        }
    }

    /// The upper left pixel `[u, v]`.
    pub(crate) fn start(&self) -> [usize; 2] {
        [self.left, self.top]
    }

    /// Number of pixels.
    pub(crate) fn len(&self) -> usize {
        self.width * self.height
    }

    /// The pixels `(u, v)` of the image, in the order of their values.
    pub(crate) fn pixels(self) -> impl Iterator<Item = (usize, usize)> {
        (0..self.len()).map(move |i| (self.left + i % self.width, self.top + i / self.width))
    }

    /// Where the value of a pixel of the window is.
    #[cfg(test)]
    pub(crate) fn at(&self, (u, v): (usize, usize)) -> usize {
        (v - self.top) * self.width + u - self.left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_ends_with_the_image_and_finds_its_pixels() {
        let window = Window::around([3, 0, 9, 4], 2, (10, 50));
        assert_eq!((window.width, window.height, window.len()), (9, 7, 63));
        for (i, pixel) in window.pixels().enumerate() {
            assert_eq!(window.at(pixel), i);
        }
        let all = Window::around([3, 0, 9, 4], usize::MAX, (10, 50));
        assert_eq!((all.width, all.height), (10, 50));
    }
}
