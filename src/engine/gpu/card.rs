//! The card that the places of a process share: its device and pipelines, what happens when these are lost, and how much
//! of its memory each place may keep viewpoints in.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicBool, Ordering},
};

use super::{
    super::EngineError,
    device::{Device, Lost},
};

pub use super::device::Adapters;

/// Of all places' viewpoints together: what seven viewpoints of 2 megapixels or 180 of 320x240 take, a share of a small
/// card's memory.
const ARENA_BYTES_MAX: u64 = 512 << 20;

/// How a card is chosen and used.
#[derive(Debug, Clone, Copy)]
pub struct CardRules {
    pub adapters: Adapters,
    /// Whether the processor takes over when the device is lost and there is no other.
    pub falls_back: bool,
    /// Of all places' viewpoints together. What a single recall needs is granted beyond it.
    pub arena_bytes_max: u64,
    /// Whether the card's half precision is used where it has any. What is computed is the same.
    pub half_precision: bool,
}

impl CardRules {
    /// A graphics card, or else the processor.
    pub fn auto() -> Self {
        Self {
            adapters: Adapters::Real,
            falls_back: true,
            arena_bytes_max: ARENA_BYTES_MAX,
            half_precision: true,
        }
    }

    /// Any adapter, and nothing else.
    pub fn any() -> Self {
        Self {
            adapters: Adapters::Any,
            falls_back: false,
            arena_bytes_max: ARENA_BYTES_MAX,
            half_precision: true,
        }
    }
}

pub struct Card {
    rules: CardRules,
    device: Mutex<Arc<Device>>,
    /// The last device that was opened has not been found lost, or another is there.
    works: AtomicBool,
    replacing: AtomicBool,
    unplugged: AtomicBool,
    places: Arc<()>,
}

/// A place's claim to its share of the card's memory, until it is dropped.
#[derive(Debug)]
pub struct Share {
    places: Arc<()>,
    arena_bytes_max: u64,
}

impl Share {
    /// Shrinks when places are added.
    pub fn bytes(&self) -> u64 {
        // The card holds one, too.
        let places = Arc::strong_count(&self.places) - 1;
        self.arena_bytes_max / places.max(1) as u64
    }
}

impl Card {
    /// # Errors
    /// No adapter, or one that gives no device.
    pub fn open(rules: CardRules) -> Result<Arc<Self>, EngineError> {
        match Device::open(rules.adapters, rules.half_precision) {
            Ok(Some(device)) => Ok(Arc::new(Self {
                rules,
                device: Mutex::new(Arc::new(device)),
                works: AtomicBool::new(true),
                replacing: AtomicBool::new(false),
                unplugged: AtomicBool::new(false),
                places: Arc::default(),
            })),
            Ok(None) => Err(EngineError::NoAdapter),
            Err(Lost(reason)) => Err(EngineError::Lost(reason)),
        }
    }

    /// Whether there is a device that works, as far as is known.
    pub fn works(&self) -> bool {
        self.works.load(Ordering::Acquire)
    }

    /// Whether frames must wait for a device.
    pub fn is_awaited(&self) -> bool {
        let lasts = !self.works() && !self.rules.falls_back;
        lasts || self.replacing.load(Ordering::Acquire)
    }

    /// Gives the device up, as when a driver fails: the next call of every place finds it lost and opens another.
    pub fn destroy_device(&self) {
        self.lock().device.destroy();
    }

    /// As when the card is taken out: the device is lost, and no other is found.
    pub fn unplug(&self) {
        self.unplugged.store(true, Ordering::Release);
        self.destroy_device();
    }

    /// Whether its half precision is used.
    pub fn has_half_precision(&self) -> bool {
        self.lock().half_precision
    }

    pub(in crate::engine) fn falls_back(&self) -> bool {
        self.rules.falls_back
    }

    pub(super) fn share(&self) -> Share {
        Share {
            places: Arc::clone(&self.places),
            arena_bytes_max: self.rules.arena_bytes_max,
        }
    }

    pub(super) fn device(&self) -> Arc<Device> {
        Arc::clone(&self.lock())
    }

    /// Another device in place of a lost one: what some other place has opened by now, or a new one.
    pub(super) fn replace(&self, lost: &Arc<Device>) -> Result<Arc<Device>, Lost> {
        let mut device = self.lock();
        if !Arc::ptr_eq(&device, lost) && device.check().is_ok() {
            return Ok(Arc::clone(&device));
        }
        self.replacing.store(true, Ordering::Release);
        let opened = if self.unplugged.load(Ordering::Acquire) {
            Ok(None)
        } else {
            Device::open(self.rules.adapters, self.rules.half_precision)
        };
        let opened = opened.and_then(|found| {
            let found = found.ok_or_else(|| Lost("no adapter is left".to_owned()))?;
            *device = Arc::new(found);
            Ok(Arc::clone(&device))
        });
        self.works.store(opened.is_ok(), Ordering::Release);
        self.replacing.store(false, Ordering::Release);
        opened
    }

    fn lock(&self) -> MutexGuard<'_, Arc<Device>> {
        // A device is replaced whole or not at all.
        self.device.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
