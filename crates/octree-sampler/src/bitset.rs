//! A flat bit set over a dense grid, used only while an octree is built.

/// Bits of an `nx * ny * nz` grid, x fastest.
pub(crate) struct GridBits {
    dims: [usize; 3],
    words: Vec<u64>,
}

impl GridBits {
    pub(crate) fn new(dims: [usize; 3]) -> Self {
        Self { dims, words: vec![0; (dims[0] * dims[1] * dims[2]).div_ceil(64)] }
    }

    pub(crate) fn set(&mut self, cell: [usize; 3]) {
        let bit = cell[0] + self.dims[0] * (cell[1] + self.dims[1] * cell[2]);
        self.words[bit / 64] |= 1 << (bit % 64);
    }

    /// Dilates by `radius` cells in the 26-neighbourhood. No set bit may be closer than `radius` to the border:
    /// then shifting the flat array by one cell, row or plane never wraps a bit to a wrong row.
    pub(crate) fn dilate(&mut self, radius: usize) {
        for stride in [1, self.dims[0], self.dims[0] * self.dims[1]] {
            // A run of 2r+1 cells grows by up to 2r+1 on either side in one step without leaving a gap.
            let mut reached = 0;
            while reached < radius {
                let step = (2 * reached + 1).min(radius - reached);
                self.or_shifted_both_ways(step * stride);
                reached += step;
            }
        }
    }

    fn or_shifted_both_ways(&mut self, shift: usize) {
        let (word_shift, bit_shift) = (shift / 64, (shift % 64) as u32);
        let old = self.words.clone();
        let at = |i: usize| old.get(i).copied().unwrap_or(0);
        for (i, word) in self.words.iter_mut().enumerate() {
            let mut up = if i >= word_shift { at(i - word_shift) << bit_shift } else { 0 };
            let mut down = at(i + word_shift) >> bit_shift;
            if bit_shift > 0 {
                if i > word_shift {
                    up |= at(i - word_shift - 1) >> (64 - bit_shift);
                }
                down |= at(i + word_shift + 1) << (64 - bit_shift);
            }
            *word |= up | down;
        }
    }

    /// Set cells, in order x fastest.
    pub(crate) fn iter(&self) -> impl Iterator<Item = [usize; 3]> + '_ {
        let [nx, ny, _] = self.dims;
        self.words.iter().enumerate().flat_map(|(i, &word)| ones(word).map(move |b| 64 * i + b)).map(
            move |bit| {
                let row = bit / nx;
                [bit % nx, row % ny, row / ny]
            },
        )
    }
}

/// Positions of the set bits of a word, ascending.
pub(crate) fn ones(mut word: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        if word == 0 {
            return None;
        }
        let bit = word.trailing_zeros() as usize;
        word &= word - 1;
        Some(bit)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dilation_is_a_cube_for_every_radius() {
        for radius in 0..12usize {
            let dims = [2 * radius + 3, 2 * radius + 1, 2 * radius + 2];
            let mut bits = GridBits::new(dims);
            bits.set([radius + 1, radius, radius]);
            bits.dilate(radius);
            let cells: Vec<_> = bits.iter().collect();
            assert_eq!(cells.len(), (2 * radius + 1).pow(3), "radius {radius}");
            for c in cells {
                assert!(c[0] >= 1 && c[0] <= 2 * radius + 1 && c[1] <= 2 * radius && c[2] <= 2 * radius);
            }
        }
    }
}
