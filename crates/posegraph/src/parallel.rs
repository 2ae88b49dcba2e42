//! Loops over edges: on all cores with the feature `rayon`, in turn without. Both keep the order of the results, so
//! that sums over them do not depend on it.

/// Calls `f` on every item.
pub(crate) fn for_each_mut<T: Send>(items: &mut [T], f: impl Fn(&mut T) + Send + Sync) {
    #[cfg(feature = "rayon")]
    {
        use rayon::prelude::*;
        items.par_iter_mut().for_each(f);
    }
    #[cfg(not(feature = "rayon"))]
    items.iter_mut().for_each(f);
}

/// Replaces `results` by `f` of every item, in order.
pub(crate) fn map_into<T: Sync, R: Send>(
    items: &[T],
    results: &mut Vec<R>,
    f: impl Fn(&T) -> R + Send + Sync,
) {
    #[cfg(feature = "rayon")]
    {
        use rayon::prelude::*;
        items.par_iter().map(f).collect_into_vec(results);
    }
    #[cfg(not(feature = "rayon"))]
    {
        results.clear();
        results.extend(items.iter().map(f));
    }
}
