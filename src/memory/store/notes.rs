//! What is kept of a place beside its viewpoints, of each event and each camera's calibration: one object, whose content
//! is the service's; after it eight bytes, the checksum of everything before, little-endian. The newest state wins.

use std::{collections::BTreeMap, time::Instant};

use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::Error;

use super::{
    form::{FormError, checksum},
    shared::{Role, Shared},
    shelf::Result,
};
use crate::memory::Version;

const SUM_BYTES: usize = 8;
/// Of an event with its two small pictures; more is not read.
const BYTES_MAX: u64 = 1 << 20;
/// Most of a request is waiting.
const AT_ONCE: usize = 8;

/// What a note is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Event,
    Calibration,
}

impl Kind {
    pub const ALL: [Self; 2] = [Self::Event, Self::Calibration];

    pub fn name(self) -> &'static str {
        match self {
            Self::Event => "event",
            Self::Calibration => "calibration",
        }
    }

    /// Where they lie.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Event => "events",
            Self::Calibration => "calibrations",
        }
    }
}

/// Those of a kind, of a place.
#[derive(Debug, Default)]
pub struct Notes {
    /// To be written, or deleted where there is nothing.
    pub pending: BTreeMap<u64, Option<Bytes>>,
    /// By when.
    pub due: Option<Instant>,
    /// Being written now; not in `pending`.
    pub writing: usize,
    /// Under which names they are stored.
    stored: BTreeMap<u64, Version>,
    /// Read, and not taken by the worker yet.
    pub read: Vec<(u64, Bytes)>,
}

/// What of the stored ones is of no use.
#[derive(Debug)]
pub struct Useless {
    kind: Kind,
    superseded: Vec<(u64, Version)>,
    damaged: Vec<(u64, Version)>,
}

impl Notes {
    /// Until `by`, if the store can be reached.
    pub fn keep(&mut self, id: u64, content: Option<Bytes>, by: Instant) {
        self.pending.insert(id, content);
        self.due = Some(self.due.map_or(by, |due| due.min(by)));
    }

    pub fn unstored(&self) -> usize {
        self.pending.len() + self.writing
    }

    fn next_version(&self, id: u64, epoch: u64) -> Version {
        // Of the states of one epoch the last counts.
        let last = self.stored.get(&id).filter(|last| last.epoch == epoch);
        Version {
            epoch,
            revision: last.map_or(1, |last| last.revision + 1),
        }
    }
}

fn sealed(content: &[u8]) -> Bytes {
    let sum = checksum(content).to_le_bytes();
    [content, &sum].concat().into()
}

/// The content of an object.
///
/// # Errors
/// Bytes that were not written here, or damaged.
pub fn opened(object: &Bytes) -> std::result::Result<Bytes, FormError> {
    let got = object.len();
    let short = FormError::Short { got };
    let end = got.checked_sub(SUM_BYTES).ok_or(short)?;
    let (content, sum) = object.split_at(end);
    if *sum != checksum(content).to_le_bytes() {
        return Err(FormError::Checksum { part: "content" });
    }
    Ok(object.slice(..end))
}

/// Learns what is stored of a kind: of each the newest state that can be read.
pub async fn refresh(shared: &Shared, kind: Kind) -> Result<Useless> {
    let mut states: BTreeMap<u64, Vec<Version>> = BTreeMap::new();
    for (id, version) in shared.shelf.list_notes(kind).await? {
        states.entry(id).or_default().push(version);
    }
    let known = shared.lock().notes(kind).stored.clone();
    let reads = states.into_iter().map(async |(id, mut versions)| {
        versions.sort_unstable();
        let known = known.get(&id).copied();
        newest_readable(shared, kind, id, versions, known).await
    });
    let newest: Vec<Newest> = stream::iter(reads).buffered(AT_ONCE).try_collect().await?;
    let mut useless = Useless {
        kind,
        superseded: Vec::new(),
        damaged: Vec::new(),
    };
    let mut state = shared.lock();
    let notes = state.notes(kind);
    for mut one in newest {
        useless.superseded.append(&mut one.superseded);
        useless.damaged.append(&mut one.damaged);
        if let Some((id, version, content)) = one.read {
            notes.stored.insert(id, version);
            // What is to be written is newer.
            if !notes.pending.contains_key(&id) {
                notes.read.push((id, content));
            }
        }
    }
    Ok(useless)
}

#[derive(Default)]
struct Newest {
    read: Option<(u64, Version, Bytes)>,
    superseded: Vec<(u64, Version)>,
    damaged: Vec<(u64, Version)>,
}

/// `versions` rise; of `known` the content is known.
async fn newest_readable(
    shared: &Shared,
    kind: Kind,
    id: u64,
    mut versions: Vec<Version>,
    known: Option<Version>,
) -> Result<Newest> {
    let mut newest = Newest::default();
    while let Some(version) = versions.pop() {
        if known != Some(version) {
            let got = match shared.shelf.get_note(kind, id, version, BYTES_MAX).await {
                // Superseded meanwhile.
                Err(Error::NotFound { .. }) => continue,
                got => got?,
            };
            match got.map_or(Err(FormError::TooLong), |object| opened(&object)) {
                Ok(content) => newest.read = Some((id, version, content)),
                Err(error) => {
                    let path = shared.shelf.note(kind, id, version);
                    tracing::error!(
                        place = &*shared.place,
                        "the {} in {path} is lost: {error}",
                        kind.name()
                    );
                    if error.is_damage() {
                        newest.damaged.push((id, version));
                    }
                    continue;
                }
            }
        }
        break;
    }
    let superseded = versions.into_iter().map(|version| (id, version));
    newest.superseded.extend(superseded);
    Ok(newest)
}

/// Deletes what is superseded and sets aside what is damaged; how many. Only for who writes the place.
pub async fn tidy(shared: &Shared, useless: Useless) -> Result<usize> {
    let kind = useless.kind;
    shared.shelf.delete_notes(kind, &useless.superseded).await?;
    for &(id, version) in &useless.damaged {
        shared.shelf.set_note_aside(kind, id, version).await?;
    }
    Ok(useless.damaged.len())
}

/// Stores what changed; what fails is pending again.
pub async fn write(
    shared: &Shared,
    kind: Kind,
    epoch: u64,
    changes: BTreeMap<u64, Option<Bytes>>,
) -> Result<()> {
    let mut writes = stream::iter(changes)
        .map(async |(id, content)| {
            let done = write_one(shared, kind, epoch, id, content.as_ref()).await;
            (id, content, done)
        })
        .buffer_unordered(AT_ONCE);
    let mut failed = None;
    while let Some((id, content, done)) = writes.next().await {
        let mut state = shared.lock();
        state.notes(kind).writing -= 1;
        if let Err(error) = done {
            failed = Some(error);
            if state.role == Role::Writer && state.epoch == epoch {
                // What came since is newer.
                let notes = state.notes(kind);
                notes.pending.entry(id).or_insert(content);
                notes.due.get_or_insert_with(Instant::now);
            }
        }
    }
    failed.map_or(Ok(()), Err)
}

async fn write_one(
    shared: &Shared,
    kind: Kind,
    epoch: u64,
    id: u64,
    content: Option<&Bytes>,
) -> Result<()> {
    let (before, version) = {
        let mut state = shared.lock();
        let notes = state.notes(kind);
        (
            notes.stored.get(&id).copied(),
            notes.next_version(id, epoch),
        )
    };
    if let Some(content) = content {
        let object = sealed(content);
        shared.shelf.put_note(kind, id, version, object).await?;
    }
    {
        let mut state = shared.lock();
        if state.role != Role::Writer || state.epoch != epoch {
            return Ok(());
        }
        match content {
            Some(_) => state.notes(kind).stored.insert(id, version),
            None => state.notes(kind).stored.remove(&id),
        };
    }
    match before {
        Some(before) => shared.shelf.delete_notes(kind, &[(id, before)]).await,
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_kept_is_read_again_and_every_flipped_bit_and_every_cut_is_found() {
        let content = b"a cup where none was";
        let object = sealed(content);
        assert_eq!(opened(&object).as_deref(), Ok(&content[..]));
        for length in 0..object.len() {
            opened(&object.slice(..length)).expect_err("it was cut");
        }
        for bit in 0..8 * object.len() {
            let mut damaged = object.to_vec();
            damaged[bit / 8] ^= 1 << (bit % 8);
            let error = opened(&damaged.into()).expect_err("a bit was flipped");
            assert!(error.is_damage(), "bit {bit}: {error}");
        }
    }
}
