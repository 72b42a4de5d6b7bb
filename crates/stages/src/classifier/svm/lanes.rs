//! Arithmetic on eight numbers side by side, with the best vector instructions that the processor has.
//!
//! [`Lanes`] has three implementors: plain arrays, AVX2 and AVX-512. Code that is generic over it is compiled for each
//! by [`for_instruction_set!`], which picks one when the program runs. AVX2 and AVX-512 do the same operations in the
//! same order and give the same bits; without fused multiply-add the last bits differ. Left to itself, the compiler
//! turned the loop over features into gathers, three times slower.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Numbers that are computed side by side: what an AVX-512 register holds.
pub(super) const LANES: usize = 8;

/// [`LANES`] numbers in memory, where vector loads want them.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(align(64))]
pub(super) struct Aligned(pub(super) [f64; LANES]);

/// [`LANES`] numbers in registers.
///
/// The implementors other than arrays may be named only where their instructions are available: in functions that
/// [`for_instruction_set!`] calls.
pub(super) trait Lanes: Copy {
    /// Rows of a kernel that are computed at once: as many as there are registers for their sums.
    const KERNEL_ROWS: usize;
    fn splat(value: f64) -> Self;
    fn load(values: &[f64; LANES]) -> Self;
    fn store(self, values: &mut [f64; LANES]);
    fn load_f32(values: &[f32; LANES]) -> Self;
    fn store_f32(self, values: &mut [f32; LANES]);
    fn add(self, other: Self) -> Self;
    fn subtract(self, other: Self) -> Self;
    fn multiply(self, other: Self) -> Self;
    fn divide(self, other: Self) -> Self;
    /// `self · factor + addend`.
    fn multiply_add(self, factor: Self, addend: Self) -> Self;
    /// `addend - self · factor`.
    fn negated_multiply_add(self, factor: Self, addend: Self) -> Self;
    /// The larger of each two; `other` where `self` is NaN.
    fn max(self, other: Self) -> Self;
    /// `chosen` where `self >= limit`, else `otherwise`; `otherwise` where `self` is NaN.
    fn if_at_least(self, limit: Self, chosen: Self, otherwise: Self) -> Self;
    /// 2^n of integers n that [`ROUNDING`] was added to.
    fn power_of_two(self) -> Self;
}

/// Plain arrays, for any processor.
#[derive(Clone, Copy)]
pub(super) struct Portable([f64; LANES]);

impl Portable {
    #[inline(always)]
    fn each(operation: impl Fn(usize) -> f64) -> Self {
        let mut result = [0.0; LANES];
        for (lane, value) in result.iter_mut().enumerate() {
            *value = operation(lane);
        }
        Self(result)
    }
}

/// `a b + c`, fused where the baseline of the target can; elsewhere `mul_add` is a slow library call.
#[inline(always)]
fn multiply_add(a: f64, b: f64, c: f64) -> f64 {
    if cfg!(any(target_arch = "aarch64", target_feature = "fma")) { a.mul_add(b, c) } else { a * b + c }
}

impl Lanes for Portable {
    const KERNEL_ROWS: usize = 2;
    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value; LANES])
    }
    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        Self(*values)
    }
    #[inline(always)]
    fn store(self, values: &mut [f64; LANES]) {
        *values = self.0;
    }
    #[inline(always)]
    fn load_f32(values: &[f32; LANES]) -> Self {
        Self::each(|lane| values[lane].into())
    }
    #[inline(always)]
    fn store_f32(self, values: &mut [f32; LANES]) {
        *values = self.0.map(|value| value as f32);
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] + other.0[lane])
    }
    #[inline(always)]
    fn subtract(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] - other.0[lane])
    }
    #[inline(always)]
    fn multiply(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] * other.0[lane])
    }
    #[inline(always)]
    fn divide(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] / other.0[lane])
    }
    #[inline(always)]
    fn multiply_add(self, factor: Self, addend: Self) -> Self {
        Self::each(|lane| multiply_add(self.0[lane], factor.0[lane], addend.0[lane]))
    }
    #[inline(always)]
    fn negated_multiply_add(self, factor: Self, addend: Self) -> Self {
        Self::each(|lane| multiply_add(-self.0[lane], factor.0[lane], addend.0[lane]))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::each(|lane| if self.0[lane] > other.0[lane] { self.0[lane] } else { other.0[lane] })
    }
    #[inline(always)]
    fn if_at_least(self, limit: Self, chosen: Self, otherwise: Self) -> Self {
        Self::each(|lane| if self.0[lane] >= limit.0[lane] { chosen.0[lane] } else { otherwise.0[lane] })
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        Self::each(|lane| f64::from_bits((self.0[lane].to_bits() << 52).wrapping_add(1023 << 52)))
    }
}

/// Two registers of AVX2, with fused multiply-add.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(super) struct Avx2([__m256d; 2]);

// SAFETY of every block here: see the trait; loads and stores are within the arrays that they are given.
#[cfg(target_arch = "x86_64")]
impl Lanes for Avx2 {
    const KERNEL_ROWS: usize = 2;
    #[inline(always)]
    fn splat(value: f64) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_set1_pd(value); 2]) }
    }
    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_loadu_pd(values.as_ptr()), _mm256_loadu_pd(values.as_ptr().add(4))]) }
    }
    #[inline(always)]
    fn store(self, values: &mut [f64; LANES]) {
        // SAFETY: see above.
        unsafe {
            _mm256_storeu_pd(values.as_mut_ptr(), self.0[0]);
            _mm256_storeu_pd(values.as_mut_ptr().add(4), self.0[1]);
        }
    }
    #[inline(always)]
    fn load_f32(values: &[f32; LANES]) -> Self {
        // SAFETY: see above.
        unsafe {
            let (low, high) = (_mm_loadu_ps(values.as_ptr()), _mm_loadu_ps(values.as_ptr().add(4)));
            Self([_mm256_cvtps_pd(low), _mm256_cvtps_pd(high)])
        }
    }
    #[inline(always)]
    fn store_f32(self, values: &mut [f32; LANES]) {
        // SAFETY: see above.
        unsafe {
            _mm_storeu_ps(values.as_mut_ptr(), _mm256_cvtpd_ps(self.0[0]));
            _mm_storeu_ps(values.as_mut_ptr().add(4), _mm256_cvtpd_ps(self.0[1]));
        }
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_add_pd(self.0[0], other.0[0]), _mm256_add_pd(self.0[1], other.0[1])]) }
    }
    #[inline(always)]
    fn subtract(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_sub_pd(self.0[0], other.0[0]), _mm256_sub_pd(self.0[1], other.0[1])]) }
    }
    #[inline(always)]
    fn multiply(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_mul_pd(self.0[0], other.0[0]), _mm256_mul_pd(self.0[1], other.0[1])]) }
    }
    #[inline(always)]
    fn divide(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_div_pd(self.0[0], other.0[0]), _mm256_div_pd(self.0[1], other.0[1])]) }
    }
    #[inline(always)]
    fn multiply_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see above.
        unsafe {
            Self([
                _mm256_fmadd_pd(self.0[0], factor.0[0], addend.0[0]),
                _mm256_fmadd_pd(self.0[1], factor.0[1], addend.0[1]),
            ])
        }
    }
    #[inline(always)]
    fn negated_multiply_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see above.
        unsafe {
            Self([
                _mm256_fnmadd_pd(self.0[0], factor.0[0], addend.0[0]),
                _mm256_fnmadd_pd(self.0[1], factor.0[1], addend.0[1]),
            ])
        }
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self([_mm256_max_pd(self.0[0], other.0[0]), _mm256_max_pd(self.0[1], other.0[1])]) }
    }
    #[inline(always)]
    fn if_at_least(self, limit: Self, chosen: Self, otherwise: Self) -> Self {
        // SAFETY: see above.
        unsafe {
            let low = _mm256_cmp_pd::<_CMP_GE_OQ>(self.0[0], limit.0[0]);
            let high = _mm256_cmp_pd::<_CMP_GE_OQ>(self.0[1], limit.0[1]);
            Self([
                _mm256_blendv_pd(otherwise.0[0], chosen.0[0], low),
                _mm256_blendv_pd(otherwise.0[1], chosen.0[1], high),
            ])
        }
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        // SAFETY: see above.
        unsafe {
            let bias = _mm256_set1_epi64x(1023 << 52);
            let low = _mm256_slli_epi64::<52>(_mm256_castpd_si256(self.0[0]));
            let high = _mm256_slli_epi64::<52>(_mm256_castpd_si256(self.0[1]));
            Self([_mm256_castsi256_pd(_mm256_add_epi64(low, bias)), _mm256_castsi256_pd(_mm256_add_epi64(high, bias))])
        }
    }
}

/// One register of AVX-512.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
pub(super) struct Avx512(__m512d);

// SAFETY of every block here: see the trait; loads and stores are within the arrays that they are given.
#[cfg(target_arch = "x86_64")]
impl Lanes for Avx512 {
    const KERNEL_ROWS: usize = 8;
    #[inline(always)]
    fn splat(value: f64) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_set1_pd(value)) }
    }
    #[inline(always)]
    fn load(values: &[f64; LANES]) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_loadu_pd(values.as_ptr())) }
    }
    #[inline(always)]
    fn store(self, values: &mut [f64; LANES]) {
        // SAFETY: see above.
        unsafe { _mm512_storeu_pd(values.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn load_f32(values: &[f32; LANES]) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_cvtps_pd(_mm256_loadu_ps(values.as_ptr()))) }
    }
    #[inline(always)]
    fn store_f32(self, values: &mut [f32; LANES]) {
        // SAFETY: see above.
        unsafe { _mm256_storeu_ps(values.as_mut_ptr(), _mm512_cvtpd_ps(self.0)) }
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_add_pd(self.0, other.0)) }
    }
    #[inline(always)]
    fn subtract(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_sub_pd(self.0, other.0)) }
    }
    #[inline(always)]
    fn multiply(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_mul_pd(self.0, other.0)) }
    }
    #[inline(always)]
    fn divide(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_div_pd(self.0, other.0)) }
    }
    #[inline(always)]
    fn multiply_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_fmadd_pd(self.0, factor.0, addend.0)) }
    }
    #[inline(always)]
    fn negated_multiply_add(self, factor: Self, addend: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_fnmadd_pd(self.0, factor.0, addend.0)) }
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_max_pd(self.0, other.0)) }
    }
    #[inline(always)]
    fn if_at_least(self, limit: Self, chosen: Self, otherwise: Self) -> Self {
        // SAFETY: see above.
        unsafe { Self(_mm512_mask_blend_pd(_mm512_cmp_pd_mask::<_CMP_GE_OQ>(self.0, limit.0), otherwise.0, chosen.0)) }
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        // SAFETY: see above.
        unsafe {
            let bits = _mm512_slli_epi64::<52>(_mm512_castpd_si512(self.0));
            Self(_mm512_castsi512_pd(_mm512_add_epi64(bits, _mm512_set1_epi64(1023 << 52))))
        }
    }
}

/// What the processor can do. Only [`InstructionSet::detect`] (and tests) make one, so that a
/// value is proof that the instructions are there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct InstructionSet(Kind);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl InstructionSet {
    /// The best of those the processor has.
    pub(super) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let has_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            let has_avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl");
            if has_avx2 && has_avx512 {
                return Self(Kind::Avx512);
            }
            if has_avx2 {
                return Self(Kind::Avx2);
            }
        }
        Self(Kind::Portable)
    }

    pub(super) fn kind(self) -> Kind {
        self.0
    }

    /// All that the processor has.
    #[cfg(test)]
    pub(super) fn available() -> Vec<Self> {
        let mut all = vec![Self(Kind::Portable)];
        #[cfg(target_arch = "x86_64")]
        match Self::detect().0 {
            Kind::Portable => {}
            Kind::Avx2 => all.push(Self(Kind::Avx2)),
            Kind::Avx512 => all.extend([Self(Kind::Avx2), Self(Kind::Avx512)]),
        }
        all
    }
}

/// `fn name(instruction_set, arguments)`, which runs `body::<impl Lanes>(arguments)` compiled for the instruction set.
/// The body and all that it calls with lanes must be `#[inline(always)]`, or it is compiled for the baseline.
macro_rules! for_instruction_set {
    ($(#[$attribute:meta])* fn $name:ident($($argument:ident: $kind:ty),* $(,)?) = $body:ident) => {
        $(#[$attribute])*
        fn $name(instruction_set: $crate::classifier::svm::lanes::InstructionSet, $($argument: $kind),*) {
            use $crate::classifier::svm::lanes;
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($argument: $kind),*) {
                $body::<lanes::Avx2>($($argument),*);
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
            fn avx512($($argument: $kind),*) {
                $body::<lanes::Avx512>($($argument),*);
            }
            match instruction_set.kind() {
                lanes::Kind::Portable => $body::<lanes::Portable>($($argument),*),
                #[cfg(target_arch = "x86_64")]
                // SAFETY: an `InstructionSet` of this kind is made only where the processor has AVX2 and FMA.
                lanes::Kind::Avx2 => unsafe { avx2($($argument),*) },
                #[cfg(target_arch = "x86_64")]
                // SAFETY: an `InstructionSet` of this kind is made only where the processor has all five features.
                lanes::Kind::Avx512 => unsafe { avx512($($argument),*) },
            }
        }
    };
}
pub(super) use for_instruction_set;

/// Below this, [`exp`] is 0: its true values are no normal numbers any more.
const SMALLEST_EXPONENT: f64 = -708.0;
/// 1.5 · 2^52: adding it rounds to an integer, which is then in the low bits.
const ROUNDING: f64 = 6_755_399_441_055_744.0;
/// ln 2 in two parts; the first has enough zeros at its end for its products with exponents to be exact. Split as in
/// fdlibm.
const LN_2_HIGH: f64 = 6.931_471_803_691_238e-1;
const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;
/// 1/2!, 1/3!, … 1/13!. On |r| <= ln 2 / 2 the first term left out is below 5e-18.
const TAYLOR: [f64; 12] = [
    1.0 / 2.0,
    1.0 / 6.0,
    1.0 / 24.0,
    1.0 / 120.0,
    1.0 / 720.0,
    1.0 / 5_040.0,
    1.0 / 40_320.0,
    1.0 / 362_880.0,
    1.0 / 3_628_800.0,
    1.0 / 39_916_800.0,
    1.0 / 479_001_600.0,
    1.0 / 6_227_020_800.0,
];

/// e^x for x <= 0, with an error below 1 ulp; 0 below x = -708 (where the true value is below 3.4e-308) and for NaN.
#[inline(always)]
pub(super) fn exp<L: Lanes>(x: L) -> L {
    exp_of_degree::<L, 13>(x)
}

/// As [`exp`] with a relative error below 1e-9, enough for what is rounded to single precision.
#[inline(always)]
pub(super) fn rough_exp<L: Lanes>(x: L) -> L {
    exp_of_degree::<L, 8>(x)
}

#[inline(always)]
fn exp_of_degree<L: Lanes, const DEGREE: usize>(x: L) -> L {
    let smallest = L::splat(SMALLEST_EXPONENT);
    let bounded = x.max(smallest);
    let shifted = bounded.multiply_add(L::splat(std::f64::consts::LOG2_E), L::splat(ROUNDING));
    let n = shifted.subtract(L::splat(ROUNDING));
    let r = n.negated_multiply_add(L::splat(LN_2_HIGH), bounded);
    let r = n.negated_multiply_add(L::splat(LN_2_LOW), r);
    let mut sum = L::splat(TAYLOR[DEGREE - 2]);
    let mut order = DEGREE - 2;
    while order > 0 {
        order -= 1;
        sum = sum.multiply_add(r, L::splat(TAYLOR[order]));
    }
    let power = L::splat(1.0).add(r.multiply(r).multiply_add(sum, r));
    x.if_at_least(smallest, power.multiply(shifted.power_of_two()), L::splat(0.0))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    for_instruction_set! {
        fn exps(values: &mut [f64], rough: &mut [f64]) = exps_body
    }

    #[inline(always)]
    fn exps_body<L: Lanes>(values: &mut [f64], rough: &mut [f64]) {
        for (values, rough) in values.as_chunks_mut::<LANES>().0.iter_mut().zip(rough.as_chunks_mut().0) {
            rough_exp(L::load(values)).store(rough);
            exp(L::load(values)).store(values);
        }
    }

    #[test]
    fn exp_is_within_one_ulp_of_the_standard_librarys() {
        // The standard library's is within one itself, so two apart is the bound that can be seen.
        let xs: Vec<f64> = (0..200_000)
            .map(|step| -f64::from(step) * 0.003_539)
            .chain([-0.0, -1e-300, -1e-17, -0.5, -1.0, -2.0, -3.0, -4.0])
            .collect();
        for instruction_set in InstructionSet::available() {
            let (mut values, mut rough) = (xs.clone(), xs.clone());
            exps(instruction_set, &mut values, &mut rough);
            for ((&x, value), rough) in xs.iter().zip(values).zip(rough) {
                let expected = x.exp();
                assert!(
                    value.to_bits().abs_diff(expected.to_bits()) <= 2,
                    "{instruction_set:?} {x} {value} {expected}"
                );
                assert!((rough / expected - 1.0).abs() < 1e-9, "{instruction_set:?} {x} {rough} {expected}");
            }
        }
    }

    #[test]
    fn exp_at_its_ends() {
        for instruction_set in InstructionSet::available() {
            let mut values = [0.0, -0.0, -708.0, -708.1, -1e9, f64::MIN, f64::NEG_INFINITY, f64::NAN];
            let mut rough = values;
            exps(instruction_set, &mut values, &mut rough);
            assert_eq!(values[..2], [1.0, 1.0]);
            assert!((values[2] / (-708.0_f64).exp() - 1.0).abs() < 1e-15);
            assert_eq!(values[3..], [0.0; 5]);
            assert_eq!((rough[..2].to_vec(), rough[3..].to_vec()), (vec![1.0; 2], vec![0.0; 5]));
        }
    }
}
