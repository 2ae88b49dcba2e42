//! The pinhole camera.

/// Pinhole intrinsics in pixels, OpenCV camera (x right, y down, z forward), pixel centres at integers.
///
/// `fx` and `fy` may differ (non-square pixels).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, pixels.
    pub cx: f64,
    /// Principal point, pixels.
    pub cy: f64,
}

impl Intrinsics {
    /// The pixel `[u, v]` on which the camera-frame point `p` (metres) falls; `None` at or behind the camera.
    #[inline]
    pub fn project(&self, p: [f64; 3]) -> Option<[f64; 2]> {
        (p[2] > 0.0).then(|| [self.fx * p[0] / p[2] + self.cx, self.fy * p[1] / p[2] + self.cy])
    }

    /// The camera-frame point (metres) seen at pixel `(u, v)` with z-depth `z` (metres).
    #[inline]
    pub fn unproject(&self, u: f64, v: f64, z: f64) -> [f64; 3] {
        [(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z]
    }

    /// The intrinsics after the image was resized by `sx` and `sy` (new size over old size), with pixel centres
    /// at integers: a pixel `u` goes to `(u + 0.5) * sx - 0.5`.
    pub fn scaled(&self, sx: f64, sy: f64) -> Self {
        Self {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: (self.cx + 0.5) * sx - 0.5,
            cy: (self.cy + 0.5) * sy - 0.5,
        }
    }

    /// The intrinsics of the sub-image whose top-left pixel is `(x0, y0)`.
    pub fn cropped(&self, x0: usize, y0: usize) -> Self {
        Self { cx: self.cx - x0 as f64, cy: self.cy - y0 as f64, ..*self }
    }

    /// Whether all four numbers are finite and the focal lengths positive.
    pub fn is_valid(&self) -> bool {
        [self.fx, self.fy, self.cx, self.cy].iter().all(|v| v.is_finite()) && self.fx > 0.0 && self.fy > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera() -> impl Strategy<Value = Intrinsics> {
        (50.0..2000.0, 50.0..2000.0, 0.0..1000.0, 0.0..1000.0).prop_map(|(fx, fy, cx, cy)| Intrinsics {
            fx,
            fy,
            cx,
            cy,
        })
    }

    fn close(a: [f64; 2], b: [f64; 2]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-7)
    }

    #[test]
    fn nothing_projects_from_behind() {
        let k = Intrinsics { fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
        for z in [0.0, -1.0, f64::NAN] {
            assert_eq!(k.project([0.0, 0.0, z]), None);
        }
        assert_eq!(k.project([0.1, -0.2, 1.0]), Some([370.0, 140.0]));
        assert!(!Intrinsics { fx: f64::NAN, ..k }.is_valid() && !Intrinsics { fy: 0.0, ..k }.is_valid());
    }

    proptest! {
        #[test]
        fn unproject_inverts_project(k in camera(), u in -100.0..2000.0, v in -100.0..2000.0, z in 0.05..20.0) {
            let back = k.project(k.unproject(u, v, z)).unwrap();
            prop_assert!(close(back, [u, v]));
            prop_assert_eq!(k.unproject(u, v, z)[2], z);
        }

        /// Resizing moves a pixel as documented, and the ray through it stays.
        #[test]
        fn scaling_keeps_rays(k in camera(), u in 0.0..1000.0, v in 0.0..1000.0, sx in 0.1..4.0, sy in 0.1..4.0) {
            let moved = k.scaled(sx, sy).project(k.unproject(u, v, 1.3)).unwrap();
            prop_assert!(close(moved, [(u + 0.5) * sx - 0.5, (v + 0.5) * sy - 0.5]));
            let back = k.scaled(sx, sy).scaled(1.0 / sx, 1.0 / sy);
            prop_assert!((back.fx - k.fx).abs() < 1e-7 && (back.cy - k.cy).abs() < 1e-7);
        }

        #[test]
        fn cropping_keeps_rays(k in camera(), u in 0.0..1000.0, v in 0.0..1000.0, x in 0usize..500, y in 0usize..500) {
            let moved = k.cropped(x, y).project(k.unproject(u, v, 0.7)).unwrap();
            prop_assert!(close(moved, [u - x as f64, v - y as f64]));
        }

        /// Resizing a crop is cropping the resized image, for whole factors.
        #[test]
        fn crop_and_scale_commute(k in camera(), x in 0usize..500, y in 0usize..500, s in 1usize..5) {
            let a = k.cropped(x, y).scaled(s as f64, s as f64);
            let b = k.scaled(s as f64, s as f64).cropped(x * s, y * s);
            prop_assert!(close([a.cx, a.cy], [b.cx, b.cy]) && a.fx == b.fx);
        }
    }
}
