//! Arithmetic on several numbers side by side.
//!
//! The loops here and in the modules that use them are plain Rust over arrays of [`LANES`] numbers, which the compiler
//! turns into vector instructions. Each is compiled for several instruction sets by [`for_instruction_set!`], and the
//! best one that the processor has is picked when the program runs. AVX2 and AVX-512 do the same operations in the same
//! order and give the same bits; without fused multiply-add the last bits differ.

/// Numbers that are computed side by side: what an AVX-512 register holds.
pub(super) const LANES: usize = 8;

/// [`LANES`] numbers where vector loads want them.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(align(64))]
pub(super) struct Lanes(pub(super) [f64; LANES]);

/// What the processor can do. Only [`InstructionSet::detect`] and [`InstructionSet::available`] make one, so that a
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

/// Whether the baseline of the target has fused multiply-add; where it has not, `mul_add` is a slow library call.
pub(super) const BASELINE_FMA: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));

/// `fn name(instruction_set, arguments)`, which runs `body::<FMA, WIDE>(arguments)` compiled for the instruction set.
/// `FMA` says whether multiply-add is fused, `WIDE` whether there are 32 vector registers of 8 lanes. The body and all
/// that it calls must be `#[inline(always)]`, or it is compiled for the baseline.
macro_rules! for_instruction_set {
    ($(#[$attribute:meta])* fn $name:ident($($argument:ident: $kind:ty),* $(,)?) = $body:ident) => {
        $(#[$attribute])*
        fn $name(instruction_set: $crate::classifier::svm::lanes::InstructionSet, $($argument: $kind),*) {
            use $crate::classifier::svm::lanes::{BASELINE_FMA, Kind};
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($argument: $kind),*) {
                $body::<true, false>($($argument),*);
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
            fn avx512($($argument: $kind),*) {
                $body::<true, true>($($argument),*);
            }
            match instruction_set.kind() {
                Kind::Portable => $body::<BASELINE_FMA, false>($($argument),*),
                #[cfg(target_arch = "x86_64")]
                // SAFETY: an `InstructionSet` of this kind is made only where the processor has AVX2 and FMA.
                Kind::Avx2 => unsafe { avx2($($argument),*) },
                #[cfg(target_arch = "x86_64")]
                // SAFETY: an `InstructionSet` of this kind is made only where the processor has all five features.
                Kind::Avx512 => unsafe { avx512($($argument),*) },
            }
        }
    };
}
pub(super) use for_instruction_set;

/// `a b + c`.
#[inline(always)]
pub(super) fn multiply_add<const FMA: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

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
pub(super) fn exp<const FMA: bool>(x: f64) -> f64 {
    exp_of_degree::<FMA, 13>(x)
}

/// As [`exp`] with a relative error below 1e-9, enough for what is rounded to single precision.
#[inline(always)]
pub(super) fn rough_exp<const FMA: bool>(x: f64) -> f64 {
    exp_of_degree::<FMA, 8>(x)
}

#[inline(always)]
fn exp_of_degree<const FMA: bool, const DEGREE: usize>(x: f64) -> f64 {
    let is_normal = x >= SMALLEST_EXPONENT;
    let x = if is_normal { x } else { SMALLEST_EXPONENT };
    let shifted = multiply_add::<FMA>(x, std::f64::consts::LOG2_E, ROUNDING);
    let n = shifted - ROUNDING;
    let r = multiply_add::<FMA>(-n, LN_2_LOW, multiply_add::<FMA>(-n, LN_2_HIGH, x));
    let mut sum = TAYLOR[DEGREE - 2];
    let mut order = DEGREE - 2;
    while order > 0 {
        order -= 1;
        sum = multiply_add::<FMA>(sum, r, TAYLOR[order]);
    }
    let power = 1.0 + multiply_add::<FMA>(r * r, sum, r);
    // 2^n, from the exponent's bits.
    let scale = f64::from_bits((shifted.to_bits() << 52).wrapping_add(1023 << 52));
    if is_normal { power * scale } else { 0.0 }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    for_instruction_set! {
        fn exps(values: &mut [f64], rough: &mut [f64]) = exps_body
    }

    #[inline(always)]
    fn exps_body<const FMA: bool, const WIDE: bool>(values: &mut [f64], rough: &mut [f64]) {
        for (value, rough) in values.iter_mut().zip(rough) {
            *rough = rough_exp::<FMA>(*value);
            *value = exp::<FMA>(*value);
        }
    }

    #[test]
    fn exp_is_within_one_ulp_of_the_standard_librarys() {
        // The standard library's is within one itself, so two apart is the bound that can be seen.
        let xs: Vec<f64> =
            (0..200_000).map(|step| -f64::from(step) * 0.003_539).chain([-0.0, -1e-300, -1e-17]).collect();
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
