//! From per-frame errors to one number.

/// Area under the recall curve between 0 and `max_error`, in percent.
///
/// VOC style, as the published tables compute it (PoseCNN, BundleTrack): with the errors below `max_error`
/// sorted, recall at the k-th is `k/n`, `n` counts all frames, and the area is the sum of
/// `(e_k - e_{k-1}) * recall_k`, the last recall holding up to `max_error`. This upper staircase is too high by
/// at most `1/n`.
///
/// `errors`: one per frame, any unit; infinite and NaN ones (missing poses) are infinitely wrong. Without any
/// error below `max_error`, without frames, or with a `max_error` that is not positive, the area is 0.
pub fn auc(errors: &[f64], max_error: f64) -> f64 {
    if !(max_error > 0.0 && max_error.is_finite()) {
        return 0.0;
    }
    let mut good: Vec<f64> = errors.iter().copied().filter(|e| *e < max_error).collect();
    good.sort_by(f64::total_cmp);
    let (mut area, mut previous, mut recall) = (0.0, 0.0, 0.0);
    for (k, &e) in good.iter().enumerate() {
        recall = (k + 1) as f64 / errors.len() as f64;
        area += (e - previous) * recall;
        previous = e;
    }
    area += (max_error - previous) * recall;
    100.0 * area / max_error
}

/// Fraction of `errors` that are at most each of `thresholds` (same unit). NaN is above every threshold.
pub fn recall_curve(errors: &[f64], thresholds: &[f64]) -> Vec<f64> {
    let n = errors.len().max(1) as f64;
    thresholds.iter().map(|t| errors.iter().filter(|e| *e <= t).count() as f64 / n).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_areas() {
        assert_eq!(auc(&[0.0; 7], 0.1), 100.0);
        assert_eq!(auc(&[0.2, 5.0], 0.1), 0.0);
        assert_eq!(auc(&[], 0.1), 0.0);
        assert_eq!(auc(&[f64::NAN, f64::INFINITY], 0.1), 0.0);
        // Recall 1/2 from 0 to 0.05 (the upper staircase) and on to the end.
        assert!((auc(&[0.05, 0.2], 0.1) - 50.0).abs() < 1e-12);
        // 0.02 * 1/4 + 0.02 * 2/4 + 0.04 * 3/4 + 0.02 * 3/4.
        assert!((auc(&[0.08, f64::NAN, 0.02, 0.04], 0.1) - 60.0).abs() < 1e-12);
        // The limit itself is not below the limit.
        assert_eq!(auc(&[0.1], 0.1), 0.0);
        assert_eq!(auc(&[0.0], f64::NAN), 0.0);
    }

    #[test]
    fn recall_counts() {
        let errors = [0.0, 0.01, 0.03, f64::NAN];
        assert_eq!(recall_curve(&errors, &[0.0, 0.01, 0.02, 1.0]), [0.25, 0.5, 0.5, 0.75]);
        assert_eq!(recall_curve(&[], &[1.0]), [0.0]);
    }
}
