//! Which viewpoints lie in the arenas, and where: the least recently used make room. Counted in pixels; the arenas hold
//! [`BYTES_PER_PIXEL`] of each.

/// Of the viewpoint in a coarse one.
pub const COARSE_PIXELS: u64 = 4;
/// Depth and record; coarse depth, luminance and variance.
pub const BYTES_PER_PIXEL: u64 = 4 + 32 + (4 + 8) / COARSE_PIXELS;

/// What tells a viewpoint from what it was before or, in a memory that began anew, from another of its name: how often
/// it was updated, and when it was written.
pub type Version = (u64, i64);

#[derive(Debug, Clone, Copy)]
struct Held {
    id: u64,
    version: Version,
    first: u64,
    pixels: u64,
    /// In which recall it was last used.
    used: u64,
}

/// Where a viewpoint lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// It is there, from this pixel on.
    Held(u64),
    /// It belongs there, but must be brought.
    Empty(u64),
}

#[derive(Debug)]
pub struct Residency {
    capacity: u64,
    capacity_max: u64,
    held: Vec<Held>,
    recall: u64,
    evicted: u64,
}

impl Residency {
    pub fn new(capacity: u64, capacity_max: u64) -> Self {
        Self {
            capacity: capacity.min(capacity_max),
            capacity_max,
            held: Vec::new(),
            recall: 0,
            evicted: 0,
        }
    }

    /// Pixels that the arenas must hold.
    pub fn capacity(&self) -> u64 {
        self.capacity
    }

    /// Pixels of the viewpoints that are there.
    pub fn pixels(&self) -> u64 {
        self.held.iter().map(|held| held.pixels).sum()
    }

    pub fn evicted(&self) -> u64 {
        self.evicted
    }

    /// Where a viewpoint lies.
    pub fn first(&self, id: u64) -> Option<u64> {
        let held = self.held.iter().find(|held| held.id == id);
        held.map(|held| held.first)
    }

    /// Begins a recall: what is placed from here on stays until the next one begins. Where the bound has fallen below
    /// what there is, everything makes room.
    pub fn begin(&mut self, capacity_max: u64) {
        self.recall += 1;
        self.capacity_max = capacity_max;
        if self.capacity > capacity_max {
            self.capacity = capacity_max;
            self.evicted += self.held.len() as u64;
            self.held.clear();
        }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.held.clear();
    }

    /// Room for a viewpoint; `None`: there is none beside the others of this recall.
    pub fn place(&mut self, id: u64, version: Version, pixels: u64) -> Option<Place> {
        if let Some(index) = self.held.iter().position(|held| held.id == id) {
            let held = &mut self.held[index];
            if held.pixels == pixels {
                held.used = self.recall;
                let current = held.version == version;
                held.version = version;
                return Some(if current {
                    Place::Held(held.first)
                } else {
                    Place::Empty(held.first)
                });
            }
            self.held.swap_remove(index);
        }
        let first = loop {
            if let Some(first) = self.gap(pixels) {
                break first;
            }
            if self.capacity < self.capacity_max {
                self.capacity = (2 * self.capacity)
                    .max(self.capacity + pixels)
                    .min(self.capacity_max);
                continue;
            }
            let oldest = (0..self.held.len())
                .filter(|&index| self.held[index].used < self.recall)
                .min_by_key(|&index| self.held[index].used)?;
            self.held.swap_remove(oldest);
            self.evicted += 1;
        };
        self.held.push(Held {
            id,
            version,
            first,
            pixels,
            used: self.recall,
        });
        Some(Place::Empty(first))
    }

    /// The first run of so many free pixels.
    fn gap(&self, pixels: u64) -> Option<u64> {
        let mut held: Vec<(u64, u64)> = self.held.iter().map(|h| (h.first, h.pixels)).collect();
        held.sort_unstable();
        let mut free = 0;
        for (first, length) in held {
            if first - free >= pixels {
                return Some(free);
            }
            free = first + length;
        }
        (free + pixels <= self.capacity).then_some(free)
    }
}
