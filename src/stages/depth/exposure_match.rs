//! Side images get the middle one's exposure before they are compared.
//! In: luminance of the two, of whole images or of pixels that show the same. Out: a line from grey levels to grey levels.
//! Open in the paper: all of it.

/// Grey level of the middle image from one of a side image: `gain * level + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Exposure {
    gain: f64,
    offset: f64,
}

impl Exposure {
    pub const SAME: Self = Self {
        gain: 1.0,
        offset: 0.0,
    };

    /// A line through the tenth, fiftieth and ninetieth hundredth of both distributions of luminance.
    pub fn matching(middle: &[u8], side: &[u8]) -> Self {
        let quantiles = |image: &[u8]| {
            let mut count = [0_usize; 256];
            for value in image {
                count[usize::from(*value)] += 1;
            }
            [0.1, 0.5, 0.9].map(|part| {
                let sought = part * image.len() as f64;
                let mut below = 0.0;
                for (value, n) in count.iter().enumerate() {
                    let n = *n as f64;
                    if below + n > sought {
                        // Levels are rounded: below one, the share of those that are passed tells where.
                        return value as f64 - 0.5 + (sought - below) / n;
                    }
                    below += n;
                }
                255.0
            })
        };
        let (middle, side) = (quantiles(middle), quantiles(side));
        if side[2] - side[0] < 8.0 {
            return Self::SAME;
        }
        let gain = ((middle[2] - middle[0]) / (side[2] - side[0])).clamp(0.5, 2.0);
        let offset = (0..3).map(|i| middle[i] - gain * side[i]).sum::<f64>() / 3.0;
        Self { gain, offset }
    }

    /// [`Self::SAME`] if it changes what cameras mostly deliver by less than two images of one exposure differ anyway,
    /// as they do not show quite the same.
    pub fn unless_unnoticed(self) -> Self {
        const UNNOTICED: f64 = 2.5;
        let change = |level: f64| (self.gain * level + self.offset - level).abs();
        if change(32.0).max(change(224.0)) <= UNNOTICED {
            Self::SAME
        } else {
            self
        }
    }

    /// First `first`, then this.
    pub fn after(self, first: Self) -> Self {
        Self {
            gain: self.gain * first.gain,
            offset: self.gain * first.offset + self.offset,
        }
    }

    /// Of every grey level.
    pub fn table(self) -> [u8; 256] {
        std::array::from_fn(|value| {
            (self.gain * value as f64 + self.offset)
                .round()
                .clamp(0.0, 255.0) as u8
        })
    }
}
