//! Owned images in row-major order.

/// A row-major image of `width` x `height` pixels; `(x, y)` is (right, down) and pixel centres lie at integers.
///
/// The three kinds in use: colour `Image<[u8; 3]>` (RGB), depth `Image<f32>` (metres, `0` = missing) and
/// [`Mask`] (`0` = background, anything else = object).
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Image<T> {
    width: usize,
    height: usize,
    pixels: Vec<T>,
}

/// An object mask: `0` is background, every other value is object.
pub type Mask = Image<u8>;

impl<T: Clone> Image<T> {
    /// An image with every pixel set to `value`.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self { width, height, pixels: vec![value; width * height] }
    }
}

impl<T> Image<T> {
    /// Wraps `pixels`; `None` unless there are exactly `width * height` of them.
    pub fn from_vec(width: usize, height: usize, pixels: Vec<T>) -> Option<Self> {
        (width.checked_mul(height) == Some(pixels.len())).then_some(Self { width, height, pixels })
    }

    /// An image whose pixel at `(x, y)` is `f(x, y)`.
    pub fn from_fn(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> T) -> Self {
        let mut pixels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                pixels.push(f(x, y));
            }
        }
        Self { width, height, pixels }
    }

    /// Pixels per row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// `(width, height)`.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Whether the image has no pixel.
    pub fn is_empty(&self) -> bool {
        self.pixels.is_empty()
    }

    /// The pixel at `(x, y)`, or `None` outside the image.
    pub fn get(&self, x: usize, y: usize) -> Option<&T> {
        if x < self.width { self.pixels.get(y * self.width + x) } else { None }
    }

    /// All pixels, row after row.
    pub fn pixels(&self) -> &[T] {
        &self.pixels
    }

    /// All pixels, row after row.
    pub fn pixels_mut(&mut self) -> &mut [T] {
        &mut self.pixels
    }

    /// Row `y`; empty below the image.
    pub fn row(&self, y: usize) -> &[T] {
        self.pixels.get(y * self.width..(y + 1) * self.width).unwrap_or(&[])
    }

    /// The pixels without the image around them.
    pub fn into_pixels(self) -> Vec<T> {
        self.pixels
    }

    /// An image of the same size with `f` applied to every pixel.
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Image<U> {
        Image { width: self.width, height: self.height, pixels: self.pixels.iter().map(f).collect() }
    }
}

/// # Panics
/// Outside the image, like slice indexing; [`Image::get`] is the fallible form.
impl<T> core::ops::Index<(usize, usize)> for Image<T> {
    type Output = T;

    fn index(&self, (x, y): (usize, usize)) -> &T {
        debug_assert!(x < self.width);
        &self.pixels[y * self.width + x]
    }
}

/// # Panics
/// Outside the image, like slice indexing.
impl<T> core::ops::IndexMut<(usize, usize)> for Image<T> {
    fn index_mut(&mut self, (x, y): (usize, usize)) -> &mut T {
        debug_assert!(x < self.width);
        &mut self.pixels[y * self.width + x]
    }
}
