//! Run-time choice of instruction set: the same generic code, compiled once for every set worth having.
#![allow(unsafe_code)]

use crate::real::{Baseline, Isa, Kernel};

/// Vectors of eight, sixteen registers.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug)]
struct Avx2;

#[cfg(target_arch = "x86_64")]
impl Isa for Avx2 {
    type F32 = x86::F32x8;
    const BLOCK: (usize, usize) = (12, 2);

    #[inline(always)]
    fn call<K: Kernel>(kernel: K) {
        #[target_feature(enable = "avx2,fma")]
        fn compiled<K: Kernel>(kernel: K) {
            kernel.run::<Avx2>();
        }
        // SAFETY: only [`Set::call`] and kernels that it runs get here, after the features were detected.
        unsafe { compiled(kernel) }
    }
}

/// Vectors of sixteen, 32 registers.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug)]
struct Avx512;

#[cfg(target_arch = "x86_64")]
impl Isa for Avx512 {
    type F32 = x86::F32x16;
    const BLOCK: (usize, usize) = (24, 4);

    #[inline(always)]
    fn call<K: Kernel>(kernel: K) {
        #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
        fn compiled<K: Kernel>(kernel: K) {
            kernel.run::<Avx512>();
        }
        // SAFETY: only [`Set::call`] and kernels that it runs get here, after the features were detected.
        unsafe { compiled(kernel) }
    }
}

/// Asks for what is at `x[at]` to come into the cache; nothing where there is no such place.
#[inline(always)]
pub(crate) fn prefetch<T>(x: &[T], at: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: every processor of 64 bits has the instruction, which reads nothing and fails nowhere.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(x.as_ptr().wrapping_add(at).cast()) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (x, at);
}

/// An instruction set that this processor has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Set(Known);

/// Made by [`Set::all`] alone, after detection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Known {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Set {
    /// The sets that this processor has, the best last.
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        let mut known = vec![Known::Baseline];
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::is_x86_feature_detected as has;
            let avx2 = has!("avx2") && has!("fma");
            if avx2 {
                known.push(Known::Avx2);
            }
            if avx2 && has!("avx512f") && has!("avx512vl") && has!("avx512bw") && has!("avx512dq") {
                known.push(Known::Avx512);
            }
        }
        known.into_iter().map(Self)
    }

    /// The best one.
    pub(crate) fn best() -> Self {
        static BEST: std::sync::OnceLock<Set> = std::sync::OnceLock::new();
        *BEST.get_or_init(|| Self::all().last().unwrap_or(Self(Known::Baseline)))
    }

    /// Runs a kernel with this set.
    pub(crate) fn call(self, kernel: impl Kernel) {
        match self.0 {
            Known::Baseline => Baseline::call(kernel),
            #[cfg(target_arch = "x86_64")]
            Known::Avx2 => Avx2::call(kernel),
            #[cfg(target_arch = "x86_64")]
            Known::Avx512 => Avx512::call(kernel),
        }
    }

    /// Its name, for people.
    #[cfg(feature = "bench")]
    pub(crate) fn name(self) -> &'static str {
        match self.0 {
            Known::Baseline => "the target's baseline",
            #[cfg(target_arch = "x86_64")]
            Known::Avx2 => "AVX2",
            #[cfg(target_arch = "x86_64")]
            Known::Avx512 => "AVX-512",
        }
    }
}

/// Vectors of x86. Code that uses the wider ones is reached through [`Set`] alone, hence only where the processor has
/// them; those of four are in every processor of 64 bits.
#[cfg(target_arch = "x86_64")]
pub(crate) mod x86 {
    use crate::lanes::Lanes;
    use std::arch::x86_64::*;

    #[derive(Clone, Copy, Debug)]
    pub(crate) struct F32x4(__m128);

    #[derive(Clone, Copy, Debug)]
    pub(crate) struct F32x8(__m256);

    #[derive(Clone, Copy, Debug)]
    pub(crate) struct F32x16(__m512);

    /// What the types share: loads and stores, and functions of vectors as one expression of intrinsics.
    macro_rules! lanes {
        ($n:literal, $splat:ident, $load:ident, $store:ident, $splat64:ident, $cast:ident;
         $($name:ident($a:ident $(, $arg:ident)*) = $body:expr;)*) => {
            const N: usize = $n;
            type Eight = F32x8;

            #[inline(always)]
            fn splat(x: f32) -> Self {
                // SAFETY: the processor has the instruction, see the module.
                Self(unsafe { $splat(x) })
            }

            #[inline(always)]
            fn splat_pair(x: &[f32; 2]) -> Self {
                // One load of both. SAFETY: the processor has the instruction, see the module; eight bytes are there to
                // read.
                Self(unsafe { $cast($splat64(x.as_ptr().cast::<f64>().read_unaligned())) })
            }

            #[inline(always)]
            fn load(x: &[f32], from: usize) -> Self {
                let x: &[f32] = &x[from..from + $n];
                // SAFETY: the processor has the instruction, see the module; as many numbers are there to read.
                Self(unsafe { $load(x.as_ptr()) })
            }

            #[inline(always)]
            fn store(self, x: &mut [f32], from: usize) {
                let x: &mut [f32] = &mut x[from..from + $n];
                // SAFETY: the processor has the instruction, see the module; as many numbers are there to write.
                unsafe { $store(x.as_mut_ptr(), self.0) }
            }

            $(#[inline(always)]
            fn $name(self, $($arg: Self),*) -> Self {
                let $a = self.0;
                $(let $arg = $arg.0;)*
                // SAFETY: the processor has the instructions, see the module; they touch no memory.
                Self(unsafe { $body })
            })*

            #[inline(always)]
            fn transpose_quads(rows: [Self; 4]) -> [Self; 4] {
                let [a, b, c, d] = rows;
                let (ab, cd) = (a.interleave_low(b), c.interleave_low(d));
                let (ab_high, cd_high) = (a.interleave_high(b), c.interleave_high(d));
                [ab.low_pairs(cd), ab.high_pairs(cd), ab_high.low_pairs(cd_high), ab_high.high_pairs(cd_high)]
            }
        };
    }

    /// Functions of one type that are not in the trait.
    macro_rules! interleave {
        ($t:ident, $low:ident, $high:ident) => {
            impl $t {
                #[inline(always)]
                fn interleave_low(self, b: Self) -> Self {
                    // SAFETY: the processor has the instruction, see the module; it touches no memory.
                    Self(unsafe { $low(self.0, b.0) })
                }

                #[inline(always)]
                fn interleave_high(self, b: Self) -> Self {
                    // SAFETY: the processor has the instruction, see the module; it touches no memory.
                    Self(unsafe { $high(self.0, b.0) })
                }
            }
        };
    }
    interleave!(F32x4, _mm_unpacklo_ps, _mm_unpackhi_ps);
    interleave!(F32x8, _mm256_unpacklo_ps, _mm256_unpackhi_ps);
    interleave!(F32x16, _mm512_unpacklo_ps, _mm512_unpackhi_ps);

    impl F32x4 {
        /// Where a quad starts in `x`.
        #[inline(always)]
        fn at(x: &[f32], from: &[u32], k: usize, place: usize, offset: usize) -> Self {
            Self::load(x, from[4 * k + place] as usize + offset)
        }
    }

    impl F32x8 {
        #[inline(always)]
        fn of_halves(low: F32x4, high: F32x4) -> Self {
            // SAFETY: the processor has the instruction, see the module; it touches no memory.
            Self(unsafe { _mm256_set_m128(high.0, low.0) })
        }
    }

    impl Lanes<f32> for F32x4 {
        lanes! {
            4, _mm_set1_ps, _mm_loadu_ps, _mm_storeu_ps, _mm_set1_pd, _mm_castpd_ps;
            add(a, b) = _mm_add_ps(a, b);
            sub(a, b) = _mm_sub_ps(a, b);
            mul(a, b) = _mm_mul_ps(a, b);
            div(a, b) = _mm_div_ps(a, b);
            sqrt(a) = _mm_sqrt_ps(a);
            madd(a, b, c) = _mm_add_ps(_mm_mul_ps(a, b), c);
            positive(a) = _mm_max_ps(a, _mm_setzero_ps());
            min(a, b) = _mm_min_ps(a, b);
            trunc(a) = _mm_cvtepi32_ps(_mm_cvttps_epi32(a));
            gate(a, v) = _mm_and_ps(_mm_cmpgt_ps(a, _mm_setzero_ps()), v);
            low_pairs(a, b) = _mm_movelh_ps(a, b);
            high_pairs(a, b) = _mm_movehl_ps(b, a);
        }

        #[inline(always)]
        fn less(self, b: Self) -> u32 {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            unsafe { _mm_movemask_ps(_mm_cmplt_ps(self.0, b.0)) as u32 }
        }

        #[inline(always)]
        fn spread(x: &[f32], from: usize) -> Self {
            Self::splat(x[from])
        }

        #[inline(always)]
        fn repeat(x: &[f32], from: usize) -> Self {
            Self::load(x, from)
        }

        #[inline(always)]
        fn load_quads(x: &[f32], from: &[u32], place: usize, offset: usize) -> Self {
            Self::at(x, from, 0, place, offset)
        }

        #[inline(always)]
        fn store_quads(self, x: &mut [f32], place: usize, stride: usize) {
            self.store(x, place * stride);
        }

        #[inline(always)]
        fn store_ints(self, x: &mut [u32], from: usize) {
            let x: &mut [u32] = &mut x[from..from + 4];
            // SAFETY: every processor has the instructions; as many numbers are there to write.
            unsafe { _mm_storeu_si128(x.as_mut_ptr().cast(), _mm_cvttps_epi32(self.0)) }
        }

        #[inline(always)]
        fn splat_in_quads(self, place: usize) -> Self {
            let a = self.0;
            // SAFETY: every processor has the instruction; it touches no memory.
            Self(unsafe {
                match place {
                    0 => _mm_shuffle_ps::<0x00>(a, a),
                    1 => _mm_shuffle_ps::<0x55>(a, a),
                    2 => _mm_shuffle_ps::<0xaa>(a, a),
                    _ => _mm_shuffle_ps::<0xff>(a, a),
                }
            })
        }

        #[inline(always)]
        fn eight(self) -> F32x8 {
            // SAFETY: where there are vectors of eight, the processor has the instruction; it touches no memory.
            F32x8(unsafe { _mm256_zextps128_ps256(self.0) })
        }

        #[inline(always)]
        fn total(self) -> f32 {
            let two = self.add(self.high_pairs(self));
            // SAFETY: every processor has the instructions; they touch no memory.
            unsafe { _mm_cvtss_f32(_mm_add_ss(two.0, _mm_shuffle_ps::<1>(two.0, two.0))) }
        }
    }

    impl Lanes<f32> for F32x8 {
        lanes! {
            8, _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_set1_pd, _mm256_castpd_ps;
            add(a, b) = _mm256_add_ps(a, b);
            sub(a, b) = _mm256_sub_ps(a, b);
            mul(a, b) = _mm256_mul_ps(a, b);
            div(a, b) = _mm256_div_ps(a, b);
            sqrt(a) = _mm256_sqrt_ps(a);
            madd(a, b, c) = _mm256_fmadd_ps(a, b, c);
            positive(a) = _mm256_max_ps(a, _mm256_setzero_ps());
            min(a, b) = _mm256_min_ps(a, b);
            trunc(a) = _mm256_round_ps::<{ _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC }>(a);
            gate(a, v) = _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(a, _mm256_setzero_ps()), v);
            low_pairs(a, b) = _mm256_shuffle_ps::<0x44>(a, b);
            high_pairs(a, b) = _mm256_shuffle_ps::<0xee>(a, b);
        }

        #[inline(always)]
        fn less(self, b: Self) -> u32 {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, b.0)) as u32 }
        }

        #[inline(always)]
        fn spread(x: &[f32], from: usize) -> Self {
            let x = &x[from..from + 2];
            Self::of_halves(F32x4::splat(x[0]), F32x4::splat(x[1]))
        }

        #[inline(always)]
        fn repeat(x: &[f32], from: usize) -> Self {
            let quad = F32x4::load(x, from);
            Self::of_halves(quad, quad)
        }

        #[inline(always)]
        fn load_quads(x: &[f32], from: &[u32], place: usize, offset: usize) -> Self {
            let low = F32x4::at(x, from, 0, place, offset);
            let high = F32x4::at(x, from, 1, place, offset);
            Self::of_halves(low, high)
        }

        #[inline(always)]
        fn store_quads(self, x: &mut [f32], place: usize, stride: usize) {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            let (low, high) = unsafe { (_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0)) };
            F32x4(low).store(x, place * stride);
            F32x4(high).store(x, (4 + place) * stride);
        }

        #[inline(always)]
        fn store_ints(self, x: &mut [u32], from: usize) {
            let x: &mut [u32] = &mut x[from..from + 8];
            // SAFETY: the processor has the instructions, see the module; as many numbers are there to write.
            unsafe { _mm256_storeu_si256(x.as_mut_ptr().cast(), _mm256_cvttps_epi32(self.0)) }
        }

        #[inline(always)]
        fn splat_in_quads(self, place: usize) -> Self {
            let a = self.0;
            // SAFETY: the processor has the instruction, see the module; it touches no memory.
            Self(unsafe {
                match place {
                    0 => _mm256_permute_ps::<0x00>(a),
                    1 => _mm256_permute_ps::<0x55>(a),
                    2 => _mm256_permute_ps::<0xaa>(a),
                    _ => _mm256_permute_ps::<0xff>(a),
                }
            })
        }

        #[inline(always)]
        fn eight(self) -> F32x8 {
            self
        }

        #[inline(always)]
        fn total(self) -> f32 {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            let (low, high) = unsafe { (_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0)) };
            F32x4(low).add(F32x4(high)).total()
        }
    }

    impl Lanes<f32> for F32x16 {
        lanes! {
            16, _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_set1_pd, _mm512_castpd_ps;
            add(a, b) = _mm512_add_ps(a, b);
            sub(a, b) = _mm512_sub_ps(a, b);
            mul(a, b) = _mm512_mul_ps(a, b);
            div(a, b) = _mm512_div_ps(a, b);
            sqrt(a) = _mm512_sqrt_ps(a);
            madd(a, b, c) = _mm512_fmadd_ps(a, b, c);
            positive(a) = _mm512_max_ps(a, _mm512_setzero_ps());
            min(a, b) = _mm512_min_ps(a, b);
            trunc(a) = _mm512_roundscale_ps::<{ _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC }>(a);
            gate(a, v) = _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, _mm512_setzero_ps()), v);
            low_pairs(a, b) = _mm512_shuffle_ps::<0x44>(a, b);
            high_pairs(a, b) = _mm512_shuffle_ps::<0xee>(a, b);
        }

        #[inline(always)]
        fn less(self, b: Self) -> u32 {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            unsafe { u32::from(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, b.0)) }
        }

        #[inline(always)]
        fn spread(x: &[f32], from: usize) -> Self {
            let quad = F32x4::load(x, from);
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            Self(unsafe {
                let places = _mm512_set_epi32(3, 3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0);
                _mm512_permutexvar_ps(places, _mm512_castps128_ps512(quad.0))
            })
        }

        #[inline(always)]
        fn repeat(x: &[f32], from: usize) -> Self {
            let quad = F32x4::load(x, from);
            // SAFETY: the processor has the instruction, see the module; it touches no memory.
            Self(unsafe { _mm512_broadcast_f32x4(quad.0) })
        }

        #[inline(always)]
        fn load_quads(x: &[f32], from: &[u32], place: usize, offset: usize) -> Self {
            let q0 = F32x4::at(x, from, 0, place, offset).0;
            let q1 = F32x4::at(x, from, 1, place, offset).0;
            let q2 = F32x4::at(x, from, 2, place, offset).0;
            let q3 = F32x4::at(x, from, 3, place, offset).0;
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            Self(unsafe {
                let two = _mm512_insertf32x4::<1>(_mm512_castps128_ps512(q0), q1);
                _mm512_insertf32x4::<3>(_mm512_insertf32x4::<2>(two, q2), q3)
            })
        }

        #[inline(always)]
        fn store_quads(self, x: &mut [f32], place: usize, stride: usize) {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            let (low, high) =
                unsafe { (_mm512_castps512_ps256(self.0), _mm512_extractf32x8_ps::<1>(self.0)) };
            F32x8(low).store_quads(x, place, stride);
            F32x8(high).store_quads(x, 8 + place, stride);
        }

        #[inline(always)]
        fn store_ints(self, x: &mut [u32], from: usize) {
            let x: &mut [u32] = &mut x[from..from + 16];
            // SAFETY: the processor has the instructions, see the module; as many numbers are there to write.
            unsafe { _mm512_storeu_si512(x.as_mut_ptr().cast(), _mm512_cvttps_epi32(self.0)) }
        }

        #[inline(always)]
        fn splat_in_quads(self, place: usize) -> Self {
            let a = self.0;
            // SAFETY: the processor has the instruction, see the module; it touches no memory.
            Self(unsafe {
                match place {
                    0 => _mm512_permute_ps::<0x00>(a),
                    1 => _mm512_permute_ps::<0x55>(a),
                    2 => _mm512_permute_ps::<0xaa>(a),
                    _ => _mm512_permute_ps::<0xff>(a),
                }
            })
        }

        #[inline(always)]
        fn eight(self) -> F32x8 {
            // SAFETY: the processor has the instructions, see the module; they touch no memory.
            let (low, high) =
                unsafe { (_mm512_castps512_ps256(self.0), _mm512_extractf32x8_ps::<1>(self.0)) };
            F32x8(low).add(F32x8(high))
        }

        #[inline(always)]
        fn total(self) -> f32 {
            self.eight().total()
        }
    }
}
