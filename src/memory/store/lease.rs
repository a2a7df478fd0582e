//! Who may write a place: at most one service at a time.
//!
//! Leases are numbered: the holder of epoch N made the object `lease/N` by a put that only one of many can win, and
//! writes it anew every [`RENEW_EVERY`]. Clocks are never compared: whoever wants the place watches the latest lease,
//! and takes it for abandoned when it has not changed for [`EXPIRES_AFTER`] of the watcher's own time. The holder stops
//! writing earlier, [`TRUSTED_FOR`] after it began its last renewal that succeeded, so that clocks may also run at
//! rates that differ by a third. Then the watcher makes `lease/N+1`.
//!
//! Whatever is still on its way from the old holder is of epoch N and harms nothing of epoch N+1 (see `shelf`).
//!
//! A clean stop says so in the lease, and the next one need not wait. On disk the holder also keeps a file locked, which
//! the system unlocks when the process is gone, however it went: whoever can lock that file need not wait either, if the
//! lease says that its holder had locked it. A file that is locked is that of the holder, or of one that is about to make
//! a lease: the place is left to it unless it hangs, that is, nothing has changed for [`EXPIRES_AFTER`]. Who takes over
//! from such a one holds no lock, says so, and locks the file as soon as it can.

use std::{
    fs::{File, TryLockError},
    time::{Duration, Instant},
};

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::shelf::{Result, Shelf};

pub const RENEW_EVERY: Duration = Duration::from_secs(1);
pub const TRUSTED_FOR: Duration = Duration::from_secs(4);
pub const EXPIRES_AFTER: Duration = Duration::from_secs(6);

/// What a lease says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Content {
    /// For people: which process on which machine.
    holder: String,
    /// Which renewal.
    beat: u64,
    /// The holder has stopped.
    released: bool,
    /// The holder has locked the file: where that is not locked any more, it is gone.
    #[serde(default)]
    locked: bool,
}

/// A place that is ours to write.
#[derive(Debug)]
pub struct Lease {
    pub epoch: u64,
    content: Content,
    /// When the last renewal that succeeded began.
    renewed: Instant,
    /// Kept locked.
    lock: Option<File>,
}

/// How a look at the latest lease ended.
#[derive(Debug)]
pub enum Looked {
    Taken(Lease),
    /// By whom.
    Held(String),
}

/// Watches a lease that somebody else holds.
#[derive(Debug, Default)]
pub struct Watcher {
    /// The latest lease, if there is one, and since when that has not changed.
    seen: Option<(Option<(u64, Bytes)>, Instant)>,
}

/// Which process on which machine this is, for people.
pub fn own_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname")
        .map(|name| name.trim().to_owned())
        .or_else(|_| std::env::var("HOSTNAME"))
        .unwrap_or_else(|_| "a machine".to_owned());
    format!("process {} on {host}", std::process::id())
}

impl Watcher {
    /// Takes the place if nobody holds it. `epoch_min` is greater than every epoch that is known otherwise.
    pub async fn look(&mut self, shelf: &Shelf, name: &str, epoch_min: u64) -> Result<Looked> {
        // First, so that whoever has locked the file sees what the one before it has left.
        let lock = shelf.lock_file().and_then(lock);
        let latest = shelf.latest_lease().await?;
        let since = match &self.seen {
            Some((seen, since)) if *seen == latest => *since,
            _ => Instant::now(),
        };
        // What cannot be read says nothing, but it can still be seen to change.
        let content: Option<Content> = latest
            .as_ref()
            .and_then(|(_, bytes)| serde_json::from_slice(bytes).ok());
        let unheld = latest.is_none() || content.as_ref().is_some_and(|content| content.released);
        let free = match lock {
            Some(LockState::Ours(_)) => {
                unheld || content.as_ref().is_some_and(|content| content.locked)
            }
            Some(LockState::Others) => false,
            None => unheld,
        };
        let epoch = latest
            .as_ref()
            .map_or(epoch_min, |(epoch, _)| epoch_min.max(epoch + 1));
        self.seen = Some((latest, since));
        if !free && since.elapsed() < EXPIRES_AFTER {
            let holder = content.filter(|content| !content.released);
            return Ok(Looked::Held(holder.map_or_else(
                || "another service".to_owned(),
                |content| content.holder,
            )));
        }
        let lock = match lock {
            Some(LockState::Ours(file)) => Some(file),
            Some(LockState::Others) => {
                // It stopped renewing but still runs: epochs keep the two apart.
                tracing::warn!("the process that wrote this place hangs: taking over");
                None
            }
            None => None,
        };
        let content = Content {
            holder: name.to_owned(),
            beat: 0,
            released: false,
            locked: lock.is_some(),
        };
        let began = Instant::now();
        if !shelf.create_lease(epoch, content.bytes()).await? {
            return Ok(Looked::Held("another service".to_owned()));
        }
        self.seen = None;
        Ok(Looked::Taken(Lease {
            epoch,
            content,
            renewed: began,
            lock,
        }))
    }
}

impl Lease {
    /// Until when this lease allows to write.
    pub fn trusted_until(&self) -> Instant {
        self.renewed + TRUSTED_FOR
    }

    /// False: somebody has taken the place.
    pub async fn renew(&mut self, shelf: &Shelf) -> Result<bool> {
        let began = Instant::now();
        if self.lock.is_none()
            && let Some(LockState::Ours(file)) = shelf.lock_file().and_then(lock)
        {
            self.lock = Some(file);
        }
        self.content.beat += 1;
        self.content.locked = self.lock.is_some();
        shelf.renew_lease(self.epoch, self.content.bytes()).await?;
        let epochs = shelf.lease_epochs().await?;
        if epochs.iter().any(|&epoch| epoch > self.epoch) {
            return Ok(false);
        }
        self.renewed = began;
        Ok(true)
    }

    /// Lets others have the place at once.
    pub async fn release(mut self, shelf: &Shelf) -> Result<()> {
        self.content.released = true;
        shelf.renew_lease(self.epoch, self.content.bytes()).await
    }
}

impl Content {
    fn bytes(&self) -> Bytes {
        serde_json::to_vec(self)
            .expect("a lease is plain words and numbers")
            .into()
    }
}

#[derive(Debug)]
enum LockState {
    Ours(File),
    Others,
}

/// `None` where files cannot be locked: then leases expire by time alone.
fn lock(path: std::path::PathBuf) -> Option<LockState> {
    std::fs::create_dir_all(path.parent()?).ok()?;
    let file = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(path)
        .ok()?;
    match file.try_lock() {
        Ok(()) => Some(LockState::Ours(file)),
        Err(TryLockError::WouldBlock) => Some(LockState::Others),
        Err(TryLockError::Error(_)) => None,
    }
}
