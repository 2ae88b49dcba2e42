//! Where to put samples on a ray. Every function appends to or edits a caller's buffer and allocates nothing else;
//! random numbers come from a closure that returns uniform numbers in [0, 1), so any generator will do.

/// Appends `n` stratified-uniform samples over the concatenated length of the intervals, ascending.
///
/// The total length is cut into `n` equal strata with one uniform sample each, then laid over the intervals in
/// order, so that each metre of occupied ray is sampled alike (BundleSDF, section 3.4; stratification as in NeRF,
/// Mildenhall et al. 2020, eq. 2). `intervals` as [`VoxelOctree::intervals`](crate::VoxelOctree::intervals) gives
/// them. Intervals that are not finite or not of positive length are skipped; nothing is appended when none is left.
pub fn stratified(intervals: &[[f32; 2]], n: usize, mut uniform: impl FnMut() -> f32, out: &mut Vec<f32>) {
    let total = length(intervals);
    if total <= 0.0 {
        return;
    }
    let mut rest = intervals.iter().filter(|i| is_proper(i));
    let Some(mut current) = rest.next() else { return };
    // Occupied length before the current interval.
    let mut before = 0.0f64;
    out.reserve(n);
    for i in 0..n {
        let s = (i as f64 + unit(uniform())) / n as f64 * total;
        while s - before > span(current) {
            let Some(next) = rest.next() else { break };
            before += span(current);
            current = next;
        }
        out.push(((f64::from(current[0]) + (s - before)) as f32).clamp(current[0], current[1]));
    }
}

/// Appends `n` stratified-uniform samples in `[lo, hi]`, ascending: the band around a measured depth.
///
/// Nothing is appended unless `lo < hi` and both are finite.
pub fn band(lo: f32, hi: f32, n: usize, mut uniform: impl FnMut() -> f32, out: &mut Vec<f32>) {
    if !is_proper(&[lo, hi]) {
        return;
    }
    let step = (f64::from(hi) - f64::from(lo)) / n as f64;
    out.extend((0..n).map(|i| ((f64::from(lo) + (i as f64 + unit(uniform())) * step) as f32).clamp(lo, hi)));
}

/// Cuts sorted intervals at `t_max`: what lies beyond is dropped, an interval across it is shortened.
///
/// A ray with depth `d` is sampled up to `d` plus the truncation distance only. NaN leaves the intervals unchanged.
pub fn clip(intervals: &mut Vec<[f32; 2]>, t_max: f32) {
    if t_max.is_nan() {
        return;
    }
    intervals.retain_mut(|i| {
        i[1] = i[1].min(t_max);
        i[0] < i[1]
    });
}

/// Total length of the intervals, in the ray's parameter. Improper intervals count as nothing.
#[must_use]
pub fn length(intervals: &[[f32; 2]]) -> f64 {
    intervals.iter().filter(|i| is_proper(i)).map(span).sum()
}

fn span(interval: &[f32; 2]) -> f64 {
    f64::from(interval[1]) - f64::from(interval[0])
}

fn is_proper(interval: &[f32; 2]) -> bool {
    interval[0] < interval[1] && interval[0].is_finite() && interval[1].is_finite()
}

/// A generator's number, made safe: NaN and negatives count as 0.
fn unit(u: f32) -> f64 {
    if u > 0.0 { f64::from(u.min(1.0)) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn midpoints_fall_where_the_length_is() {
        let mut out = Vec::new();
        stratified(&[[0.0, 1.0], [5.0, 8.0]], 4, || 0.5, &mut out);
        assert_eq!(out, [0.5, 5.5, 6.5, 7.5]);
        band(1.0, 2.0, 2, || 0.5, &mut out);
        assert_eq!(out[4..], [1.25, 1.75]);
    }

    #[test]
    fn improper_input_appends_nothing() {
        let mut out = Vec::new();
        for bad in [[f32::NAN, 1.0], [2.0, 1.0], [1.0, 1.0], [0.0, f32::INFINITY]] {
            stratified(&[bad], 4, || 0.5, &mut out);
            band(bad[0], bad[1], 4, || 0.5, &mut out);
        }
        stratified(&[], 4, || 0.5, &mut out);
        stratified(&[[0.0, 1.0]], 0, || 0.5, &mut out);
        band(0.0, 1.0, 0, || 0.5, &mut out);
        assert!(out.is_empty());
        // A broken generator keeps to the interval.
        stratified(&[[0.0, 1.0], [2.0, 3.0]], 3, || f32::NAN, &mut out);
        stratified(&[[0.0, 1.0], [2.0, 3.0]], 3, || 7.0, &mut out);
        assert!(out.iter().all(|t| (0.0..=1.0).contains(t) || (2.0..=3.0).contains(t)));
    }

    #[test]
    fn clip_cuts_and_drops() {
        let all = vec![[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]];
        for (t_max, want) in [(2.5, vec![[0.0, 1.0], [2.0, 2.5]]), (2.0, vec![[0.0, 1.0]]), (-1.0, vec![])] {
            let mut i = all.clone();
            clip(&mut i, t_max);
            assert_eq!(i, want);
        }
        let mut i = all.clone();
        clip(&mut i, f32::NAN);
        assert_eq!(i, all);
    }
}
