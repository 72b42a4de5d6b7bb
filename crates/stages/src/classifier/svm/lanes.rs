//! Arithmetic on eight numbers side by side, compiled for AVX2 and for any processor.
//!
//! The compiler makes vector instructions of [`Lanes`]' loops of fixed length. [`for_instruction_set!`] compiles a
//! function for both and picks one when the program runs. Both give the same bits, because neither fuses a multiplication
//! with an addition, which rounds once in place of twice.

/// Numbers that are computed side by side: two AVX2 registers.
pub const LANES: usize = 8;

/// [`LANES`] numbers in memory, aligned for vector loads.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(align(64))]
pub struct Aligned(pub [f64; LANES]);

/// [`LANES`] numbers in registers.
#[derive(Debug, Clone, Copy)]
pub struct Lanes([f64; LANES]);

#[allow(clippy::should_implement_trait, reason = "the operations are named alike, and not all have an operator")]
impl Lanes {
    #[inline(always)]
    fn each(operation: impl Fn(usize) -> f64) -> Self {
        let mut result = [0.0; LANES];
        for (lane, value) in result.iter_mut().enumerate() {
            *value = operation(lane);
        }
        Self(result)
    }

    #[inline(always)]
    pub fn splat(value: f64) -> Self {
        Self([value; LANES])
    }

    #[inline(always)]
    pub fn load(values: &[f64; LANES]) -> Self {
        Self(*values)
    }

    #[inline(always)]
    pub fn store(self, values: &mut [f64; LANES]) {
        *values = self.0;
    }

    #[inline(always)]
    pub fn load_f32(values: &[f32; LANES]) -> Self {
        Self::each(|lane| values[lane].into())
    }

    #[inline(always)]
    pub fn store_f32(self, values: &mut [f32; LANES]) {
        *values = self.0.map(|value| value as f32);
    }

    #[inline(always)]
    pub fn add(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] + other.0[lane])
    }

    #[inline(always)]
    pub fn subtract(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] - other.0[lane])
    }

    #[inline(always)]
    pub fn multiply(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] * other.0[lane])
    }

    #[inline(always)]
    pub fn divide(self, other: Self) -> Self {
        Self::each(|lane| self.0[lane] / other.0[lane])
    }

    /// `self · factor + addend`.
    #[inline(always)]
    pub fn multiply_add(self, factor: Self, addend: Self) -> Self {
        Self::each(|lane| self.0[lane] * factor.0[lane] + addend.0[lane])
    }

    /// `addend - self · factor`.
    #[inline(always)]
    pub fn negated_multiply_add(self, factor: Self, addend: Self) -> Self {
        Self::each(|lane| addend.0[lane] - self.0[lane] * factor.0[lane])
    }

    /// The larger of each two; `other` where `self` is NaN.
    #[inline(always)]
    pub fn max(self, other: Self) -> Self {
        Self::each(|lane| if self.0[lane] > other.0[lane] { self.0[lane] } else { other.0[lane] })
    }

    /// `chosen` where `self >= limit`, else `otherwise`; `otherwise` where `self` is NaN.
    #[inline(always)]
    pub fn if_at_least(self, limit: Self, chosen: Self, otherwise: Self) -> Self {
        Self::each(|lane| if self.0[lane] >= limit.0[lane] { chosen.0[lane] } else { otherwise.0[lane] })
    }

    /// 2^n of integers n that [`ROUNDING`] was added to.
    #[inline(always)]
    fn power_of_two(self) -> Self {
        Self::each(|lane| f64::from_bits((self.0[lane].to_bits() << 52).wrapping_add(1023 << 52)))
    }
}

/// The instructions that functions are compiled for. Only [`InstructionSet::detect`] (and tests) make one, so a value
/// is proof that the processor has them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InstructionSet {
    has_avx2: bool,
}

impl InstructionSet {
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        let has_avx2 = is_x86_feature_detected!("avx2");
        #[cfg(not(target_arch = "x86_64"))]
        let has_avx2 = false;
        Self { has_avx2 }
    }

    pub fn has_avx2(self) -> bool {
        self.has_avx2
    }

    /// All that the processor has, for tests.
    pub fn available() -> Vec<Self> {
        let mut all = vec![Self { has_avx2: false }, Self::detect()];
        all.dedup();
        all
    }
}

/// `fn name(instruction_set, arguments)`, which runs `body(arguments)` compiled for the instruction set. The
/// body and all that it calls with lanes must be `#[inline(always)]`, or it is compiled for the baseline.
#[doc(hidden)]
#[macro_export]
macro_rules! for_instruction_set {
    ($(#[$attribute:meta])* fn $name:ident($($argument:ident: $kind:ty),* $(,)?) = $body:ident) => {
        $(#[$attribute])*
        fn $name(instruction_set: $crate::classifier::svm::lanes::InstructionSet, $($argument: $kind),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn avx2($($argument: $kind),*) {
                    $body($($argument),*);
                }
                if instruction_set.has_avx2() {
                    // SAFETY: the processor has AVX2.
                    return unsafe { avx2($($argument),*) };
                }
            }
            let _ = instruction_set;
            $body($($argument),*);
        }
    };
}
pub use for_instruction_set;

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
pub fn exp(x: Lanes) -> Lanes {
    exp_of_degree::<13>(x)
}

/// As [`exp`] with a relative error below 1e-9, enough for what is rounded to single precision.
#[inline(always)]
pub fn rough_exp(x: Lanes) -> Lanes {
    exp_of_degree::<8>(x)
}

#[inline(always)]
fn exp_of_degree<const DEGREE: usize>(x: Lanes) -> Lanes {
    let smallest = Lanes::splat(SMALLEST_EXPONENT);
    let bounded = x.max(smallest);
    let shifted = bounded.multiply_add(Lanes::splat(std::f64::consts::LOG2_E), Lanes::splat(ROUNDING));
    let n = shifted.subtract(Lanes::splat(ROUNDING));
    let r = n.negated_multiply_add(Lanes::splat(LN_2_HIGH), bounded);
    let r = n.negated_multiply_add(Lanes::splat(LN_2_LOW), r);
    let mut sum = Lanes::splat(TAYLOR[DEGREE - 2]);
    let mut order = DEGREE - 2;
    while order > 0 {
        order -= 1;
        sum = sum.multiply_add(r, Lanes::splat(TAYLOR[order]));
    }
    let power = Lanes::splat(1.0).add(r.multiply(r).multiply_add(sum, r));
    x.if_at_least(smallest, power.multiply(shifted.power_of_two()), Lanes::splat(0.0))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    for_instruction_set! {
        fn exps(values: &mut [f64], rough: &mut [f64]) = exps_body
    }

    #[inline(always)]
    fn exps_body(values: &mut [f64], rough: &mut [f64]) {
        for (values, rough) in values.as_chunks_mut::<LANES>().0.iter_mut().zip(rough.as_chunks_mut().0) {
            rough_exp(Lanes::load(values)).store(rough);
            exp(Lanes::load(values)).store(values);
        }
    }

    #[test]
    fn exp_is_within_one_ulp_of_libms_and_the_same_with_every_instruction_set() {
        // libm's is within one itself, so two apart is the bound that can be seen.
        let xs: Vec<f64> = (0..200_000)
            .map(|step| -f64::from(step) * 0.003_539)
            .chain([-0.0, -1e-300, -1e-17, -0.5, -1.0, -2.0, -3.0, -4.0])
            .collect();
        let mut first = None;
        for instruction_set in InstructionSet::available() {
            let (mut values, mut rough) = (xs.clone(), xs.clone());
            exps(instruction_set, &mut values, &mut rough);
            for ((&x, value), rough) in xs.iter().zip(&values).zip(&rough) {
                let expected = libm::exp(x);
                let ulps = value.to_bits().abs_diff(expected.to_bits());
                assert!(ulps <= 2, "{instruction_set:?} {x} {value} {expected}");
                assert!((rough / expected - 1.0).abs() < 1e-9, "{instruction_set:?} {x} {rough} {expected}");
            }
            let found = (values, rough);
            assert!(first.get_or_insert_with(|| found.clone()) == &found, "{instruction_set:?}");
        }
    }

    #[test]
    fn exp_at_its_ends() {
        for instruction_set in InstructionSet::available() {
            let mut values = [0.0, -0.0, -708.0, -708.1, -1e9, f64::MIN, f64::NEG_INFINITY, f64::NAN];
            let mut rough = values;
            exps(instruction_set, &mut values, &mut rough);
            assert_eq!(values[..2], [1.0, 1.0]);
            assert!((values[2] / libm::exp(-708.0) - 1.0).abs() < 1e-15);
            assert_eq!(values[3..], [0.0; 5]);
            assert_eq!((rough[..2].to_vec(), rough[3..].to_vec()), (vec![1.0; 2], vec![0.0; 5]));
        }
    }
}
