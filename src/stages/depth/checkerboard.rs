//! How images lie in memory for the sweep and the messages: the two colours of a checkerboard apart, so that sixteen
//! to sixty-four neighbours of one colour fill a vector, and all labels of a row together, so that a row's work stays
//! in the cache.
//!
//! Pixel `(x, y)` has colour `(x + y) & 1` and stands at index `x / 2` of that colour's half row. Seen from index `i`
//! of colour `c` in row `y`, with parity `p = (y + c) & 1` and so `x = 2 i + p`, the pixels above and below stand at
//! `i` of the other colour, and so does the one to the right if `p = 0`, to the left if `p = 1`; the remaining
//! neighbour stands at `i - 1` or `i + 1`.

/// Bytes that start on a cache line.
#[derive(Default)]
pub(super) struct AlignedBytes {
    bytes: Vec<u8>,
    start: usize,
    len: usize,
}

const LINE: usize = 64;

impl AlignedBytes {
    pub fn zeroed(len: usize) -> Self {
        let bytes = vec![0; len + LINE];
        let start = bytes.as_ptr().align_offset(LINE);
        Self { bytes, start, len }
    }
}

impl std::ops::Deref for AlignedBytes {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        &self.bytes[self.start..self.start + self.len]
    }
}

impl std::ops::DerefMut for AlignedBytes {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.bytes[self.start..self.start + self.len]
    }
}

/// The checkerboard of an image of `width` x `height` pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Checkerboard {
    pub width: usize,
    pub height: usize,
    /// Pixels in a half row; with an odd width, one colour's last stands outside the image.
    pub half: usize,
    /// Bytes from one half row to the next: at least `half + 1`, so that a store shifted by one pixel stays in the
    /// padding, and at least 64, so that one vector of 32 may be shifted likewise however narrow the image is.
    pub stride: usize,
}

impl Checkerboard {
    pub fn new(width: usize, height: usize) -> Self {
        assert!(width > 0 && height > 0, "an image has pixels");
        let half = width.div_ceil(2);
        let lines = (half + 1).div_ceil(LINE);
        // With an odd number of lines, the labels of one pixel spread over all sets of the cache.
        let stride = (lines | 1) * LINE;
        Self {
            width,
            height,
            half,
            stride,
        }
    }

    /// The image whose pixels are 2x2 of this one's; an odd last row or column makes smaller ones.
    pub fn coarser(&self) -> Self {
        Self::new(self.half, self.height.div_ceil(2))
    }

    /// Where the pixels of colour `colour` begin in row `y`: `x = 2 * index + parity`.
    pub fn parity(y: usize, colour: usize) -> usize {
        (y + colour) & 1
    }

    /// First indices of the vectors of `lanes` that cover a half row; the last is moved back to end with the row,
    /// unless the row is shorter than a vector.
    #[inline(always)]
    pub fn vector_starts(half: usize, lanes: usize) -> impl Iterator<Item = usize> {
        (0..half.div_ceil(lanes))
            .map(move |vector| (vector * lanes).min(half.saturating_sub(lanes)))
    }
}

/// One byte a pixel and label: a matching cost, 0 = certain.
///
/// Laid out `[row][colour][label][index]`.
pub struct CostVolume {
    pub(super) board: Checkerboard,
    pub(super) labels: usize,
    pub(super) bytes: AlignedBytes,
}

impl CostVolume {
    /// All costs zero.
    pub fn new(width: usize, height: usize, labels: usize) -> Self {
        assert!(
            (2..=256).contains(&labels),
            "labels are bytes, and one is no choice"
        );
        let board = Checkerboard::new(width, height);
        let bytes = AlignedBytes::zeroed(height * 2 * labels * board.stride);
        Self {
            board,
            labels,
            bytes,
        }
    }

    pub fn labels(&self) -> usize {
        self.labels
    }

    pub(super) fn row_bytes(&self) -> usize {
        2 * self.labels * self.board.stride
    }

    /// The labels of one colour in row `y`: `[label][index]`.
    pub(super) fn half_row(&self, y: usize, colour: usize) -> &[u8] {
        let bytes = self.labels * self.board.stride;
        &self.bytes[(y * 2 + colour) * bytes..][..bytes]
    }
}

/// One row of a cost volume, to be filled.
pub struct CostRow<'a> {
    pub(super) y: usize,
    pub(super) board: &'a Checkerboard,
    pub(super) labels: usize,
    /// `[colour][label][index]`
    pub(super) bytes: &'a mut [u8],
}

impl CostRow<'_> {
    pub fn set(&mut self, x: usize, label: usize, cost: u8) {
        let Checkerboard { width, stride, .. } = *self.board;
        assert!(x < width && label < self.labels);
        self.bytes[(((x + self.y) & 1) * self.labels + label) * stride + x / 2] = cost;
    }
}
