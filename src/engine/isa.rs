//! Which vector instructions this processor has, found at run time: one binary serves every x86-64 and every other
//! architecture. What is computed never depends on the answer, only how fast.

/// Instruction sets that kernels are compiled for, least first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Isa {
    /// What the compilation target guarantees.
    Portable,
    /// AVX2, FMA and F16C, which came together.
    Avx2,
    /// AVX-512 F, BW, DQ and VL, and what `Avx2` has.
    Avx512,
}

impl Isa {
    /// The best this processor has.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("f16c");
            let avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl");
            if avx2 && avx512 {
                return Self::Avx512;
            }
            if avx2 {
                return Self::Avx2;
            }
        }
        Self::Portable
    }

    /// Every one this processor can run, so that tests can compare them.
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
