//! Sums of squared distances to planes and points.

/// `Q(x) = x' A x + 2 b' x + c`, a weighted sum of squared distances; zero everywhere by default.
#[derive(Clone, Debug, Default)]
pub(crate) struct Quadric {
    /// Upper triangle of `A`: xx, xy, xz, yy, yz, zz.
    a: [f64; 6],
    b: [f64; 3],
    c: f64,
    weight: f64,
}

impl Quadric {
    /// Squared distance to the plane through `p` with unit normal `n`, times `weight`.
    pub(crate) fn plane(n: [f64; 3], p: [f64; 3], weight: f64) -> Self {
        let d = -(n[0] * p[0] + n[1] * p[1] + n[2] * p[2]);
        let a = [n[0] * n[0], n[0] * n[1], n[0] * n[2], n[1] * n[1], n[1] * n[2], n[2] * n[2]];
        Self { a: a.map(|v| v * weight), b: n.map(|v| v * d * weight), c: d * d * weight, weight }
    }

    /// Squared distance to `p`, times `weight`.
    pub(crate) fn point(p: [f64; 3], weight: f64) -> Self {
        Self {
            a: [weight, 0.0, 0.0, weight, 0.0, weight],
            b: p.map(|v| -v * weight),
            c: p.iter().map(|v| v * v).sum::<f64>() * weight,
            weight,
        }
    }

    pub(crate) fn add(&mut self, other: &Self) {
        self.a.iter_mut().zip(other.a).for_each(|(a, o)| *a += o);
        self.b.iter_mut().zip(other.b).for_each(|(b, o)| *b += o);
        self.c += other.c;
        self.weight += other.weight;
    }

    /// Sum of the weights that were added.
    pub(crate) fn weight(&self) -> f64 {
        self.weight
    }

    pub(crate) fn at(&self, [x, y, z]: [f64; 3]) -> f64 {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        xx * x * x
            + yy * y * y
            + zz * z * z
            + 2.0 * (xy * x * y + xz * x * z + yz * y * z + self.b[0] * x + self.b[1] * y + self.b[2] * z)
            + self.c
    }

    /// Where it is least; `None` when that is not one well-defined point.
    pub(crate) fn minimum(&self) -> Option<[f64; 3]> {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        // Cofactors of the symmetric matrix.
        let (c00, c01, c02) = (yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy);
        let (c11, c12, c22) = (xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy);
        let det = xx * c00 + xy * c01 + xz * c02;
        let scale = (xx + yy + zz) / 3.0;
        // Written so that a NaN fails it.
        let regular = det.abs() > 1e-15 * scale.powi(3);
        if !regular {
            return None;
        }
        let [bx, by, bz] = self.b.map(|v| -v / det);
        let p =
            [c00 * bx + c01 * by + c02 * bz, c01 * bx + c11 * by + c12 * bz, c02 * bx + c12 * by + c22 * bz];
        p.iter().all(|v| v.is_finite()).then_some(p)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_planes_meet_in_the_minimum() {
        let corner = [0.3, -0.2, 0.5];
        let mut q = Quadric::default();
        for n in [[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.6, -0.8]] {
            q.add(&Quadric::plane(n, corner, 2.0));
        }
        let m = q.minimum().unwrap();
        assert!((0..3).all(|k| (m[k] - corner[k]).abs() < 1e-12), "{m:?}");
        assert!(q.at(m).abs() < 1e-12);
        // One unit along x: planes one and two are 1 and 0.6 away.
        assert!((q.at([1.3, -0.2, 0.5]) - 2.0 * (1.0 + 0.36)).abs() < 1e-12);
    }

    #[test]
    fn a_plane_alone_has_no_least_point_but_one_with_a_pull() {
        let mut q = Quadric::plane([0.0, 0.0, 1.0], [0.0, 0.0, 2.0], 1.0);
        assert!(q.minimum().is_none());
        q.add(&Quadric::point([1.0, 1.0, 2.0], 1e-6));
        let m = q.minimum().unwrap();
        assert!((m[0] - 1.0).abs() < 1e-6 && (m[2] - 2.0).abs() < 1e-9, "{m:?}");
    }
}
