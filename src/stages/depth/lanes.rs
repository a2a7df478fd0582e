//! Vectors of unsigned bytes, one a pixel: the same kernel source is compiled once for each instruction set.
//!
//! A kernel is a generic `#[inline(always)]` function over [`Lanes`], called from one `#[target_feature]` function an
//! instruction set ([`for_each_isa`]); there it and these methods are inlined, so each operation is one instruction.

/// `N` unsigned bytes.
///
/// # Safety
/// Every method may execute instructions of the implementing type's instruction set: call them only where
/// [`Isa`](crate::isa::Isa) says that the processor has it.
pub unsafe trait Lanes: Copy {
    const N: usize;

    unsafe fn splat(value: u8) -> Self;
    /// Asks for the cache line at any address, which need not be valid.
    unsafe fn prefetch(at: *const u8);
    /// # Safety
    /// `N` readable bytes at `from`; no alignment asked.
    unsafe fn load(from: *const u8) -> Self;
    /// # Safety
    /// `N` writable bytes at `to`; no alignment asked.
    unsafe fn store(self, to: *mut u8);
    /// The caller knows that no lane overflows.
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn add_saturating(self, other: Self) -> Self;
    /// The caller knows that no lane is negative.
    unsafe fn sub(self, other: Self) -> Self;
    unsafe fn sub_saturating(self, other: Self) -> Self;
    unsafe fn min(self, other: Self) -> Self;
    unsafe fn max(self, other: Self) -> Self;
    /// (a + b + 1) / 2
    unsafe fn average(self, other: Self) -> Self;
    /// Per lane: `then` where `a < b`, else `self`.
    unsafe fn replace_where_less(self, a: Self, b: Self, then: Self) -> Self;
}

/// Bytes in an array, for the compiler to vectorise with what the target guarantees.
#[derive(Clone, Copy)]
pub struct PortableLanes([u8; 16]);

impl PortableLanes {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(u8, u8) -> u8) -> Self {
        Self(std::array::from_fn(|i| f(self.0[i], other.0[i])))
    }
}

// SAFETY: uses no instruction beyond the compilation target's.
unsafe impl Lanes for PortableLanes {
    const N: usize = 16;

    #[inline(always)]
    unsafe fn splat(value: u8) -> Self {
        Self([value; 16])
    }
    #[inline(always)]
    unsafe fn prefetch(_at: *const u8) {}
    #[inline(always)]
    unsafe fn load(from: *const u8) -> Self {
        // SAFETY: the caller grants N readable bytes; an array of bytes needs no alignment.
        unsafe { Self(from.cast::<[u8; 16]>().read()) }
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut u8) {
        // SAFETY: the caller grants N writable bytes; an array of bytes needs no alignment.
        unsafe { to.cast::<[u8; 16]>().write(self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        self.zip(other, u8::wrapping_add)
    }
    #[inline(always)]
    unsafe fn add_saturating(self, other: Self) -> Self {
        self.zip(other, u8::saturating_add)
    }
    #[inline(always)]
    unsafe fn sub(self, other: Self) -> Self {
        self.zip(other, u8::wrapping_sub)
    }
    #[inline(always)]
    unsafe fn sub_saturating(self, other: Self) -> Self {
        self.zip(other, u8::saturating_sub)
    }
    #[inline(always)]
    unsafe fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    unsafe fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    unsafe fn average(self, other: Self) -> Self {
        self.zip(other, |a, b| ((u16::from(a) + u16::from(b) + 1) >> 1) as u8)
    }
    #[inline(always)]
    unsafe fn replace_where_less(self, a: Self, b: Self, then: Self) -> Self {
        Self(std::array::from_fn(|i| {
            if a.0[i] < b.0[i] {
                then.0[i]
            } else {
                self.0[i]
            }
        }))
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2Lanes, Avx512Lanes};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Lanes;
    use std::arch::x86_64::*;

    /// 32 bytes in one 256-bit register.
    #[derive(Clone, Copy)]
    pub struct Avx2Lanes(__m256i);

    /// 64 bytes in one 512-bit register.
    #[derive(Clone, Copy)]
    pub struct Avx512Lanes(__m512i);

    macro_rules! lanes {
        ($lanes:ident, $n:literal, $splat:ident, $load:ident, $store:ident, $add:ident, $adds:ident, $sub:ident, $subs:ident,
         $min:ident, $max:ident, $avg:ident, |$keep:ident, $a:ident, $b:ident, $then:ident| $blend:expr) => {
            // SAFETY (of each call): the trait's caller knows that the processor has the instruction set, and grants
            // the bytes of the two that take a pointer.
            unsafe impl Lanes for $lanes {
                const N: usize = $n;

                #[inline(always)]
                unsafe fn splat(value: u8) -> Self {
                    unsafe { Self($splat(value.cast_signed())) }
                }
                #[inline(always)]
                unsafe fn prefetch(at: *const u8) {
                    unsafe { _mm_prefetch::<_MM_HINT_T0>(at.cast()) }
                }
                #[inline(always)]
                unsafe fn load(from: *const u8) -> Self {
                    unsafe { Self($load(from.cast())) }
                }
                #[inline(always)]
                unsafe fn store(self, to: *mut u8) {
                    unsafe { $store(to.cast(), self.0) }
                }
                #[inline(always)]
                unsafe fn add(self, other: Self) -> Self {
                    unsafe { Self($add(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn add_saturating(self, other: Self) -> Self {
                    unsafe { Self($adds(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn sub(self, other: Self) -> Self {
                    unsafe { Self($sub(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn sub_saturating(self, other: Self) -> Self {
                    unsafe { Self($subs(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn min(self, other: Self) -> Self {
                    unsafe { Self($min(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn max(self, other: Self) -> Self {
                    unsafe { Self($max(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn average(self, other: Self) -> Self {
                    unsafe { Self($avg(self.0, other.0)) }
                }
                #[inline(always)]
                unsafe fn replace_where_less(self, a: Self, b: Self, then: Self) -> Self {
                    let ($keep, $a, $b, $then) = (self.0, a.0, b.0, then.0);
                    unsafe { Self($blend) }
                }
            }
        };
    }

    lanes!(
        Avx2Lanes,
        32,
        _mm256_set1_epi8,
        _mm256_loadu_si256,
        _mm256_storeu_si256,
        _mm256_add_epi8,
        _mm256_adds_epu8,
        _mm256_sub_epi8,
        _mm256_subs_epu8,
        _mm256_min_epu8,
        _mm256_max_epu8,
        _mm256_avg_epu8,
        // a < b is not (max(a, b) == a); bytes have no unsigned comparison in AVX2.
        |keep, a, b, then| _mm256_blendv_epi8(
            then,
            keep,
            _mm256_cmpeq_epi8(_mm256_max_epu8(a, b), a)
        )
    );

    lanes!(
        Avx512Lanes,
        64,
        _mm512_set1_epi8,
        _mm512_loadu_si512,
        _mm512_storeu_si512,
        _mm512_add_epi8,
        _mm512_adds_epu8,
        _mm512_sub_epi8,
        _mm512_subs_epu8,
        _mm512_min_epu8,
        _mm512_max_epu8,
        _mm512_avg_epu8,
        |keep, a, b, then| _mm512_mask_mov_epi8(keep, _mm512_cmplt_epu8_mask(a, b), then)
    );
}

/// Defines `$name(isa, arguments)`, which runs the generic kernel `$kernel` compiled for that instruction set.
///
/// # Safety
/// The function it defines asks what `$kernel` asks, and an `isa` that the processor has.
macro_rules! for_each_isa {
    ($(#[$doc:meta])* $vis:vis unsafe fn $name:ident = $kernel:ident($($arg:ident: $ty:ty),* $(,)?)) => {
        $(#[$doc])*
        #[allow(unused_unsafe, clippy::too_many_arguments, reason = "some kernels are safe code; arguments are passed on")]
        $vis unsafe fn $name(isa: $crate::isa::Isa, $($arg: $ty),*) {
            use $crate::isa::Isa;
            use $crate::stages::depth::lanes;

            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma,f16c")]
            #[allow(unused_unsafe, clippy::too_many_arguments, reason = "some kernels are safe code; arguments are passed on")]
            unsafe fn avx2($($arg: $ty),*) {
                // SAFETY: this function's features are those of the lanes; the rest is the kernel's, passed on.
                unsafe { $kernel::<lanes::Avx2Lanes>($($arg),*) }
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma,f16c,avx512f,avx512bw,avx512dq,avx512vl")]
            #[allow(unused_unsafe, clippy::too_many_arguments, reason = "some kernels are safe code; arguments are passed on")]
            unsafe fn avx512($($arg: $ty),*) {
                // SAFETY: as above.
                unsafe { $kernel::<lanes::Avx512Lanes>($($arg),*) }
            }
            // SAFETY: the caller knows that the processor has `isa`, and grants what the kernel asks.
            unsafe {
                match isa {
                    #[cfg(target_arch = "x86_64")]
                    Isa::Avx512 => avx512($($arg),*),
                    #[cfg(target_arch = "x86_64")]
                    Isa::Avx2 => avx2($($arg),*),
                    _ => $kernel::<lanes::PortableLanes>($($arg),*),
                }
            }
        }
    };
}
pub(crate) use for_each_isa;
