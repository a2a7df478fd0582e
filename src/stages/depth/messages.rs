//! The inner loop of belief propagation: what one colour of one row sends to its neighbours, and what it believes.
//! Vectors run over pixels and the loop over labels, so that the minimum over labels needs no shuffle.

use super::lanes::{Lanes, for_each_isa};
use crate::isa::Isa;
use std::mem::MaybeUninit;

/// Neighbours in the order of the message planes. A message sent towards `k` is received as from `3 - k`. Those that
/// may be stored one index off, towards RIGHT and LEFT, are received in the two inner planes, so what a shifted store
/// writes beyond them falls into the padding of the same block.
pub(super) const ABOVE: usize = 0;
pub(super) const RIGHT: usize = 1;
pub(super) const LEFT: usize = 2;
pub(super) const BELOW: usize = 3;

/// One colour of one row, as sender.
pub(super) struct Sender<'a> {
    pub labels: usize,
    pub half: usize,
    pub stride: usize,
    /// Of the sender's pixels: 0 = the first is x = 0, 1 = it is x = 1.
    pub parity: usize,
    /// `[label][index]`
    pub costs: &'a [u8],
    /// `[neighbour][label][index]`, received.
    pub received: &'a [u8],
    /// What is received follows in memory for the next row, but not yet in the cache.
    pub ask_for_next: bool,
    /// `[neighbour][index]` steps, then as many truncations, of the edge towards that neighbour; both are 0 where
    /// sender or neighbour are outside the image, so that nothing is said across the border.
    pub weights: &'a [u8],
}

impl Sender<'_> {
    fn check(&self) {
        assert!(self.stride > self.half && self.stride >= 64 && self.labels >= 2);
        assert!(self.costs.len() >= self.labels * self.stride);
        assert!(self.received.len() >= 4 * self.labels * self.stride);
        assert!(self.weights.len() >= 8 * self.stride);
    }

    /// A vector must not be longer than the padded row.
    fn isa(&self, isa: Isa) -> Isa {
        if self.half < 64 {
            isa.min(Isa::Avx2)
        } else {
            isa
        }
        .or_best_available()
    }
}

/// Message update of min-sum belief propagation with truncated linear smoothness (Felzenszwalb and Huttenlocher 2006,
/// section 3.1): towards each neighbour `k`,
/// `m(l) = min(min_l' h(l') + step |l - l'|, min h + truncation) - min h`, `h = cost + all messages but the one from k`.
///
/// `row_above`, `row` and `row_below` are the blocks of the other colour, `[neighbour][label][index]`, where the
/// messages are received.
pub(super) fn send(
    isa: Isa,
    sender: &Sender<'_>,
    row_above: &mut [u8],
    row: &mut [u8],
    row_below: &mut [u8],
) {
    sender.check();
    let plane = sender.labels * sender.stride;
    assert!(row_above.len() >= 4 * plane && row.len() >= 4 * plane && row_below.len() >= 4 * plane);
    // SAFETY: `isa` is available. The kernel reads `labels` half rows of `stride` bytes from each plane, all inside
    // the slices as asserted. It stores vectors that start at 0 or end at `half` at most (or are 32 long, in rows
    // shorter than that), moved by at most one: towards the left, index -1 of plane RIGHT's first label is the last
    // byte of plane ABOVE; towards the right, `half + 1 <= stride` keeps the last label inside plane LEFT. The
    // slices are disjoint by their borrows, so what is stored is never what is read.
    unsafe {
        let above = row_above.as_mut_ptr().add(BELOW * plane);
        let below = row_below.as_mut_ptr().add(ABOVE * plane);
        let right = row.as_mut_ptr().add(LEFT * plane + sender.parity);
        let left = row.as_mut_ptr().add(RIGHT * plane + sender.parity).sub(1);
        send_dispatched(sender.isa(isa), sender, [above, right, left, below]);
    }
}

for_each_isa! {
    unsafe fn send_dispatched = send_kernel(sender: &Sender<'_>, sent: [*mut u8; 4])
}

/// # Safety
/// As [`send`] says.
#[allow(clippy::needless_range_loop, reason = "four arrays share the index")]
#[inline(always)]
unsafe fn send_kernel<V: Lanes>(sender: &Sender<'_>, sent: [*mut u8; 4]) {
    let Sender {
        labels,
        half,
        stride,
        ..
    } = *sender;
    let plane = labels * stride;
    for start in super::checkerboard::Checkerboard::vector_starts(half, V::N) {
        // SAFETY: see `send`.
        unsafe {
            let costs = sender.costs.as_ptr().add(start);
            let received = sender.received.as_ptr().add(start);
            let weights = sender.weights.as_ptr().add(start);
            let sent = [
                sent[0].add(start),
                sent[1].add(start),
                sent[2].add(start),
                sent[3].add(start),
            ];
            // Plain loops: a closure would be a function of its own, without the vector instructions.
            let mut step = [V::splat(0); 4];
            let mut truncation = [V::splat(0); 4];
            for k in 0..4 {
                step[k] = V::load(weights.add(k * stride));
                truncation[k] = V::load(weights.add((4 + k) * stride));
            }

            // Lower envelope from below; the running minimum of the sums is that of the envelope.
            let mut envelope = [V::splat(255); 4];
            let mut least = [V::splat(255); 4];
            for label in 0..labels {
                let at = label * stride;
                // The same pixels one row on are next.
                V::prefetch(costs.wrapping_add(at + 2 * plane));
                if sender.ask_for_next {
                    for k in 0..4 {
                        V::prefetch(received.wrapping_add((4 + k) * plane + at));
                    }
                }
                let mut from = [V::splat(0); 4];
                for k in 0..4 {
                    from[k] = V::load(received.add(k * plane + at));
                }
                // At most 4 d + 1 + 4 d <= 249 for a truncation d <= 31.
                let sum = V::load(costs.add(at))
                    .add(from[0].add(from[1]))
                    .add(from[2].add(from[3]));
                for k in 0..4 {
                    envelope[k] = sum.sub(from[k]).min(envelope[k].add_saturating(step[k]));
                    least[k] = least[k].min(envelope[k]);
                    envelope[k].store(sent[k].add(at));
                }
            }
            // And from above, starting at the truncation.
            let mut highest = [V::splat(0); 4];
            for k in 0..4 {
                highest[k] = least[k].add_saturating(truncation[k]);
                envelope[k] = highest[k];
            }
            for label in (0..labels).rev() {
                let at = label * stride;
                for k in 0..4 {
                    let forward = V::load(sent[k].add(at)).min(highest[k]);
                    envelope[k] = forward.min(envelope[k].add_saturating(step[k]));
                    envelope[k].sub(least[k]).store(sent[k].add(at));
                }
            }
        }
    }
}

/// Labels so far apart are the same depth, more or less.
const NEARBY: u8 = 2;

/// What a pixel believes in the end: the costs of its labels with all messages added, around the least.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Belief {
    /// The lowest of the cheapest labels.
    pub label: u8,
    pub cost: u8,
    /// Least cost among the labels more than [`NEARBY`] away from `label`; 255 if there is none.
    pub rival_cost: u8,
}

impl Belief {
    /// By how much any other depth costs more.
    pub fn margin(&self) -> u8 {
        self.rival_cost - self.cost
    }
}

/// The beliefs of one colour of a row into that row of pixels, `width` long.
pub(super) fn believe(isa: Isa, sender: &Sender<'_>, width: usize, row: &mut [Belief]) {
    sender.check();
    assert_eq!(row.len(), width);
    assert!(sender.labels <= 256);
    // SAFETY: `isa` is available, and the slices hold what the kernel reads, as asserted.
    unsafe { believe_dispatched(sender.isa(isa), sender, row) }
}

for_each_isa! {
    unsafe fn believe_dispatched = believe_kernel(sender: &Sender<'_>, row: &mut [Belief])
}

/// # Safety
/// As [`believe`] says.
#[inline(always)]
unsafe fn believe_kernel<V: Lanes>(sender: &Sender<'_>, row: &mut [Belief]) {
    let Sender {
        labels,
        half,
        stride,
        parity,
        ..
    } = *sender;
    let plane = labels * stride;
    let mut sums = [const { MaybeUninit::<u8>::uninit() }; 256 * 64];
    let sums: *mut u8 = sums.as_mut_ptr().cast();
    let (mut label_of, mut cost_of, mut rival_of) = ([0_u8; 64], [0_u8; 64], [0_u8; 64]);
    for start in super::checkerboard::Checkerboard::vector_starts(half, V::N) {
        // SAFETY: see `believe`; `sums` holds 256 labels of at most 64 lanes,
        // each written before it is read.
        unsafe {
            let costs = sender.costs.as_ptr().add(start);
            let received = sender.received.as_ptr().add(start);
            let mut cost = V::splat(255);
            let mut best = V::splat(0);
            for label in 0..labels {
                let at = label * stride;
                let mut sum = V::load(costs.add(at));
                for k in 0..4 {
                    sum = sum.add(V::load(received.add(k * plane + at)));
                }
                best = best.replace_where_less(sum, cost, V::splat(label as u8));
                cost = cost.min(sum);
                sum.store(sums.add(label * V::N));
            }
            let mut rival = V::splat(255);
            for label in 0..labels {
                let sum = V::load(sums.add(label * V::N));
                let label = V::splat(label as u8);
                let away = label.sub_saturating(best).max(best.sub_saturating(label));
                rival = rival.replace_where_less(V::splat(NEARBY), away, rival.min(sum));
            }
            best.store(label_of.as_mut_ptr());
            cost.store(cost_of.as_mut_ptr());
            rival.store(rival_of.as_mut_ptr());
        }
        for lane in 0..V::N {
            // The padding of a short or odd row is outside the image.
            if let Some(belief) = row.get_mut(2 * (start + lane) + parity) {
                *belief = Belief {
                    label: label_of[lane],
                    cost: cost_of[lane],
                    rival_cost: rival_of[lane],
                };
            }
        }
    }
}
