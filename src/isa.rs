//! Which instructions the hot loops are compiled for, chosen when the service starts.

/// Ordered: each includes the ones before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Isa {
    /// What the target guarantees: SSE2 on x86-64, NEON on aarch64.
    Portable,
    /// AVX2, FMA, F16C, BMI: x86-64 processors since 2013.
    Avx2,
    /// AVX-512 F, BW, DQ, VL.
    Avx512,
}

impl Isa {
    /// The best that this processor has.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("f16c")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2");
            let avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl");
            match (avx2, avx512) {
                (true, true) => Self::Avx512,
                (true, false) => Self::Avx2,
                _ => Self::Portable,
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        Self::Portable
    }

    /// Every one that this processor has, so that tests can compare them.
    pub fn available() -> impl Iterator<Item = Self> {
        let best = Self::detect();
        [Self::Portable, Self::Avx2, Self::Avx512]
            .into_iter()
            .filter(move |isa| *isa <= best)
    }

    /// This one, or the best that the processor has if it lacks it: the only way from a wish to an `Isa` that may be
    /// dispatched on.
    pub fn or_best_available(self) -> Self {
        self.min(Self::detect())
    }
}

/// Compiles a kernel, an `#[inline(always)]` function, once for each instruction set, and picks by the first argument. A
/// kernel with a twin for AVX names both. No floating-point operation is fused or reordered, so the results are the same to the bit.
macro_rules! for_each_isa {
    ($(#[$doc:meta])* $visibility:vis fn $name:ident($($argument:ident: $kind:ty),* $(,)?) = $kernel:path;) => {
        $crate::isa::for_each_isa! {
            $(#[$doc])*
            $visibility fn $name($($argument: $kind),*) = $kernel, avx $kernel;
        }
    };
    ($(#[$doc:meta])* $visibility:vis fn $name:ident($($argument:ident: $kind:ty),* $(,)?) = $kernel:path, avx $avx:path;) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        $visibility fn $name(isa: $crate::isa::Isa, $($argument: $kind),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,f16c,bmi1,bmi2")]
                #[allow(clippy::too_many_arguments)]
                fn avx2($($argument: $kind),*) {
                    $avx($($argument),*)
                }
                #[target_feature(enable = "avx2,f16c,bmi1,bmi2,avx512f,avx512bw,avx512dq,avx512vl")]
                #[allow(clippy::too_many_arguments)]
                fn avx512($($argument: $kind),*) {
                    $avx($($argument),*)
                }
                match isa {
                    // SAFETY: an `Isa` beyond `Portable` is only made where the processor has it.
                    $crate::isa::Isa::Avx512 => return unsafe { avx512($($argument),*) },
                    // SAFETY: as above.
                    $crate::isa::Isa::Avx2 => return unsafe { avx2($($argument),*) },
                    $crate::isa::Isa::Portable => {}
                }
            }
            let _ = isa;
            $kernel($($argument),*)
        }
    };
}
pub(crate) use for_each_isa;
