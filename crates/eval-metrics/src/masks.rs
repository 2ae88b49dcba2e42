//! Region and boundary agreement of masks (Perazzi et al., *A benchmark dataset and evaluation methodology for video
//! object segmentation*, CVPR 2016).

/// A mask by reference: row-major, not zero on the object.
#[derive(Clone, Copy, Debug)]
pub struct MaskRef<'a> {
    pixels: &'a [u8],
    width: usize,
}

/// Width of the band in which boundaries agree, as a share of the image's diagonal: what DAVIS uses.
pub const BOUNDARY_TOLERANCE: f64 = 0.008;

impl<'a> MaskRef<'a> {
    /// `None` unless `pixels` are whole rows of `width` pixels.
    pub fn new(pixels: &'a [u8], width: usize) -> Option<Self> {
        (width > 0 && pixels.len().is_multiple_of(width)).then_some(Self { pixels, width })
    }

    fn height(&self) -> usize {
        self.pixels.len() / self.width
    }

    fn at(&self, x: usize, y: usize) -> bool {
        self.pixels[y * self.width + x] != 0
    }

    /// Pixels that differ from the neighbour to the right, below, or below to the right.
    fn boundary(&self) -> Boundary {
        let (width, height) = (self.width, self.height());
        let (mut is_boundary, mut pixels) = (vec![false; width * height], Vec::new());
        for y in 0..height {
            for x in 0..width {
                let here = self.at(x, y);
                let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
                if [(right, y), (x, below), (right, below)].iter().any(|&(u, v)| self.at(u, v) != here) {
                    is_boundary[y * width + x] = true;
                    pixels.push([x, y]);
                }
            }
        }
        Boundary { is_boundary, pixels, width, height }
    }
}

/// Region similarity J: intersection over union. 1 when both masks are empty; `None` for different sizes.
pub fn region_similarity(mask: MaskRef<'_>, truth: MaskRef<'_>) -> Option<f64> {
    if mask.width != truth.width || mask.pixels.len() != truth.pixels.len() {
        return None;
    }
    let (mut both, mut any) = (0_usize, 0_usize);
    for (a, b) in mask.pixels.iter().zip(truth.pixels) {
        both += usize::from(*a != 0 && *b != 0);
        any += usize::from(*a != 0 || *b != 0);
    }
    Some(if any == 0 { 1.0 } else { both as f64 / any as f64 })
}

/// Contour accuracy F: harmonic mean of the share of the mask's boundary that lies within `tolerance` (share of the
/// diagonal, rounded up to whole pixels) of the true one, and of the share of the true one near the mask's.
///
/// 1 when neither has a boundary, 0 when one has; `None` for different sizes.
pub fn boundary_f(mask: MaskRef<'_>, truth: MaskRef<'_>, tolerance: f64) -> Option<f64> {
    if mask.width != truth.width || mask.pixels.len() != truth.pixels.len() {
        return None;
    }
    let diagonal = (mask.width as f64).hypot(mask.height() as f64);
    let radius = (tolerance * diagonal).ceil().max(0.0) as usize;
    let (found, real) = (mask.boundary(), truth.boundary());
    if found.pixels.is_empty() && real.pixels.is_empty() {
        return Some(1.0);
    }
    let (precision, recall) = (found.share_near(&real, radius), real.share_near(&found, radius));
    Some(if precision + recall == 0.0 { 0.0 } else { 2.0 * precision * recall / (precision + recall) })
}

struct Boundary {
    is_boundary: Vec<bool>,
    pixels: Vec<[usize; 2]>,
    width: usize,
    height: usize,
}

impl Boundary {
    /// Share of the boundary that has a pixel of `other` within `radius` pixels; 0 without a boundary.
    fn share_near(&self, other: &Self, radius: usize) -> f64 {
        let near = self.pixels.iter().filter(|[x, y]| other.has_near(*x, *y, radius)).count();
        near as f64 / self.pixels.len().max(1) as f64
    }

    fn has_near(&self, x: usize, y: usize, radius: usize) -> bool {
        let rows = y.saturating_sub(radius)..(y + radius + 1).min(self.height);
        rows.into_iter().any(|v| {
            let dy = v.abs_diff(y);
            let reach = (radius * radius - dy * dy).isqrt();
            let row = v * self.width;
            let columns = row + x.saturating_sub(reach)..row + (x + reach + 1).min(self.width);
            self.is_boundary[columns].contains(&true)
        })
    }
}
