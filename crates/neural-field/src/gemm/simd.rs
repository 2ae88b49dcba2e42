//! Rows of two factors side by side, with one check of their lengths for all of them.
#![allow(unsafe_code)]

use std::marker::PhantomData;

/// Equally long windows of two slices that move on by a stride each: what one step of a product's inner loop reads.
pub(super) struct Steps<'a, R> {
    a: *const R,
    b: *const R,
    strides: (usize, usize),
    widths: (usize, usize),
    left: usize,
    slices: PhantomData<&'a [R]>,
}

/// A slice, where its first window starts, from window to window, and the length of a window.
pub(super) type Windows<'a, R> = (&'a [R], usize, usize, usize);

impl<'a, R> Steps<'a, R> {
    /// `count` windows of both; panics where the last would not be inside of its slice.
    #[inline(always)]
    pub(super) fn new(count: usize, a: Windows<'a, R>, b: Windows<'a, R>) -> Self {
        let fits = |(x, from, stride, width): Windows<'a, R>| {
            let last = count.saturating_sub(1).checked_mul(stride).and_then(|last| last.checked_add(from));
            count == 0 || last.and_then(|last| last.checked_add(width)).is_some_and(|end| end <= x.len())
        };
        assert!(fits(a) && fits(b));
        Self {
            a: a.0.as_ptr().wrapping_add(a.1),
            b: b.0.as_ptr().wrapping_add(b.1),
            strides: (a.2, b.2),
            widths: (a.3, b.3),
            left: count,
            slices: PhantomData,
        }
    }
}

impl<'a, R> Iterator for Steps<'a, R> {
    type Item = (&'a [R], &'a [R]);

    #[inline(always)]
    fn next(&mut self) -> Option<Self::Item> {
        self.left = self.left.checked_sub(1)?;
        // SAFETY: `new` has checked that all windows, of which `left` counts the rest, are inside of the slices, which are
        // borrowed for `'a`.
        let windows = unsafe {
            (
                std::slice::from_raw_parts(self.a, self.widths.0),
                std::slice::from_raw_parts(self.b, self.widths.1),
            )
        };
        // Beyond the last window the pointers are not followed.
        self.a = self.a.wrapping_add(self.strides.0);
        self.b = self.b.wrapping_add(self.strides.1);
        Some(windows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_move_by_their_strides() {
        let (a, b) = ([0, 1, 2, 3, 4, 5], [10, 11, 12, 13]);
        let seen: Vec<_> = Steps::new(3, (&a, 1, 2, 1), (&b, 0, 1, 2)).collect();
        assert_eq!(seen, [(&a[1..2], &b[0..2]), (&a[3..4], &b[1..3]), (&a[5..6], &b[2..4])]);
        assert_eq!(Steps::new(0, (&a, 9, 2, 1), (&b, 0, 1, 2)).count(), 0);
    }

    #[test]
    fn windows_outside_are_refused() {
        let x = [0; 8];
        for windows in
            [(&x[..], 0, 4, 5), (&x[..], 1, 7, 1), (&x[..], 0, usize::MAX, 1), (&x[..], usize::MAX, 1, 1)]
        {
            assert!(std::panic::catch_unwind(|| Steps::new(2, windows, (&x, 0, 1, 1))).is_err());
            assert!(std::panic::catch_unwind(|| Steps::new(2, (&x, 0, 1, 1), windows)).is_err());
        }
    }
}
