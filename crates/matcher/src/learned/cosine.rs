//! Mutual nearest neighbours of descriptors of length 1.

use super::nn::{LANES, OUTPUTS, Strip, simd};
use crate::matching::{Descriptors, Features, Match};

/// Pairs that are each other's nearest by the cosine `c` of their descriptors, if it exceeds `m = min_cosine`.
/// Confidence is `1 - ((1 - c) / (1 - m))^2`: the squared ratio of the distance to the largest one that counts.
pub(super) fn mutual_nearest(a: &Features, b: &Features, min_cosine: f32) -> Vec<Match> {
    let (Descriptors::F32 { len, values: da }, Descriptors::F32 { len: len_b, values: db }) =
        (&a.descriptors, &b.descriptors)
    else {
        return Vec::new();
    };
    let len = *len;
    let whole = |f: &Features, values: &[f32]| values.len() == f.len() * len;
    if len == 0 || len != *len_b || a.is_empty() || b.is_empty() || !whole(a, da) || !whole(b, db) {
        return Vec::new();
    }
    // The products are a 1x1 convolution: descriptors of `b` are the pixels, those of `a` the weights.
    let count = b.len();
    let mut planes = vec![0.0_f32; len * count + LANES];
    for (j, descriptor) in db.chunks_exact(len).enumerate() {
        for (d, &value) in descriptor.iter().enumerate() {
            planes[d * count + j] = value;
        }
    }
    let offsets: Vec<usize> = (0..len).map(|d| d * count).collect();
    let mut weights = vec![[0.0_f32; OUTPUTS]; len];
    let mut cosines = vec![0.0_f32; OUTPUTS * count];
    let mut forward = vec![Best::default(); a.len()];
    let mut backward = vec![Best::default(); count];
    for (block, descriptors) in da.chunks(OUTPUTS * len).enumerate() {
        for (o, descriptor) in descriptors.chunks_exact(len).enumerate() {
            weights.iter_mut().zip(descriptor).for_each(|(w, v)| w[o] = *v);
        }
        let mut lines: Vec<&mut [f32]> =
            cosines.chunks_exact_mut(count).take(descriptors.len() / len).collect();
        let strip = Strip {
            input: &planes,
            offsets: &offsets,
            weights: &weights,
            bias: [0.0; OUTPUTS],
            add: None,
            relu: false,
        };
        simd::strip(&strip, &mut lines);
        for (o, line) in lines.iter().enumerate() {
            let i = block * OUTPUTS + o;
            for ((j, &cosine), back) in line.iter().enumerate().zip(&mut backward) {
                forward[i].offer(cosine, j);
                back.offer(cosine, i);
            }
        }
    }
    let mut matches = Vec::new();
    for (i, best) in forward.iter().enumerate() {
        let j = best.index;
        let ratio = (1.0 - best.cosine) / (1.0 - min_cosine);
        if best.cosine > min_cosine && backward.get(j).is_some_and(|back| back.index == i) {
            let confidence = (1.0 - ratio * ratio).clamp(0.0, 1.0);
            matches.push(Match { a: a.points[i], b: b.points[j], confidence });
        }
    }
    matches
}

/// The most similar so far.
#[derive(Clone, Copy)]
struct Best {
    cosine: f32,
    index: usize,
}

impl Default for Best {
    fn default() -> Self {
        Self { cosine: f32::NEG_INFINITY, index: usize::MAX }
    }
}

impl Best {
    #[inline]
    fn offer(&mut self, cosine: f32, index: usize) {
        if cosine > self.cosine {
            *self = Self { cosine, index };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn features(descriptors: &[[f32; 3]]) -> Features {
        let unit = |d: &[f32; 3]| {
            let norm = d.iter().map(|v| v * v).sum::<f32>().sqrt();
            d.map(|v| v / norm)
        };
        Features {
            points: (0..descriptors.len()).map(|i| [i as f32, 0.0]).collect(),
            scales: vec![1.0; descriptors.len()],
            descriptors: Descriptors::F32 { len: 3, values: descriptors.iter().flat_map(unit).collect() },
        }
    }

    #[test]
    fn matches_are_mutual_and_similar() {
        let a = features(&[
            [1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.9, 0.2, 0.0],
            [0.0, 0.0, 1.0],
            [-1.0, -1.0, 0.0],
        ]);
        let b = features(&[[0.0, 1.0, 0.1], [1.0, 0.05, 0.0], [-0.1, -0.3, 0.8]]);
        let matches = mutual_nearest(&a, &b, 0.75);
        // a[2] is nearest to b[1], but b[1] is nearer to a[0]; a[4] is like none.
        let pairs: Vec<_> = matches.iter().map(|m| (m.a[0] as usize, m.b[0] as usize)).collect();
        assert_eq!(pairs, [(0, 1), (1, 0), (3, 2)]);
        assert!(matches[0].confidence > 0.99 && matches[2].confidence < matches[1].confidence);
        assert_eq!(mutual_nearest(&a, &b, 0.95).len(), 2);
    }

    #[test]
    fn empty_and_foreign_features_have_no_matches() {
        let one = features(&[[1.0, 0.0, 0.0]]);
        assert_eq!(mutual_nearest(&one, &one, 0.75).len(), 1);
        let foreign = [
            Features::default(),
            Features { descriptors: Descriptors::F32 { len: 2, values: vec![1.0, 0.0] }, ..one.clone() },
            Features { descriptors: Descriptors::F32 { len: 3, values: vec![1.0, 0.0] }, ..one.clone() },
            Features { descriptors: Descriptors::U8 { len: 3, values: vec![1, 0, 0] }, ..one.clone() },
            features(&[[f32::NAN, 0.0, 0.0]]),
        ];
        for other in foreign {
            assert!(mutual_nearest(&one, &other, 0.75).is_empty());
            assert!(mutual_nearest(&other, &one, 0.75).is_empty());
        }
        assert!(
            mutual_nearest(&one, &one, 1.0).is_empty() && mutual_nearest(&one, &one, f32::NAN).is_empty()
        );
    }
}
