//! What is kept about a place's events beside its viewpoints: one object an event, whose content is the service's; after
//! it eight bytes, the checksum of everything before, little-endian. The newest state of an event wins.

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

/// Of a place.
#[derive(Debug, Default)]
pub struct EventNotes {
    /// To be written, or deleted where there is nothing.
    pub pending: BTreeMap<u64, Option<Bytes>>,
    /// Since when.
    pub since: Option<Instant>,
    /// Being written now; not in `pending`.
    pub writing: usize,
    /// Under which names they are stored.
    stored: BTreeMap<u64, Version>,
    /// Read, and not taken by the worker yet.
    pub read: Vec<(u64, Bytes)>,
}

/// What of the stored events is of no use.
#[derive(Debug, Default)]
pub struct Useless {
    superseded: Vec<(u64, Version)>,
    damaged: Vec<(u64, Version)>,
}

impl EventNotes {
    pub fn keep(&mut self, id: u64, content: Option<Bytes>) {
        self.pending.insert(id, content);
        self.since.get_or_insert_with(Instant::now);
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

fn opened(object: &Bytes) -> std::result::Result<Bytes, FormError> {
    let got = object.len();
    let short = FormError::Short { got };
    let end = got.checked_sub(SUM_BYTES).ok_or(short)?;
    let (content, sum) = object.split_at(end);
    if *sum != checksum(content).to_le_bytes() {
        return Err(FormError::Checksum { part: "event" });
    }
    Ok(object.slice(..end))
}

/// Learns what is stored: of each event the newest state that can be read.
pub async fn refresh(shared: &Shared) -> Result<Useless> {
    let mut states: BTreeMap<u64, Vec<Version>> = BTreeMap::new();
    for (id, version) in shared.shelf.list_events().await? {
        states.entry(id).or_default().push(version);
    }
    let known = shared.lock().events.stored.clone();
    let reads = states.into_iter().map(async |(id, mut versions)| {
        versions.sort_unstable();
        let known = known.get(&id).copied();
        newest_readable(shared, id, versions, known).await
    });
    let newest: Vec<Newest> = stream::iter(reads).buffered(AT_ONCE).try_collect().await?;
    let mut useless = Useless::default();
    let mut state = shared.lock();
    for Newest { read, mut rest } in newest {
        useless.superseded.append(&mut rest.superseded);
        useless.damaged.append(&mut rest.damaged);
        if let Some((id, version, content)) = read {
            state.events.stored.insert(id, version);
            state.events.read.push((id, content));
        }
    }
    Ok(useless)
}

#[derive(Default)]
struct Newest {
    read: Option<(u64, Version, Bytes)>,
    rest: Useless,
}

/// `versions` rise; of `known` the content is known.
async fn newest_readable(
    shared: &Shared,
    id: u64,
    mut versions: Vec<Version>,
    known: Option<Version>,
) -> Result<Newest> {
    let mut newest = Newest::default();
    while let Some(version) = versions.pop() {
        if known != Some(version) {
            let got = match shared.shelf.get_event(id, version, BYTES_MAX).await {
                // Superseded meanwhile.
                Err(Error::NotFound { .. }) => continue,
                got => got?,
            };
            match got.map_or(Err(FormError::TooLong), |object| opened(&object)) {
                Ok(content) => newest.read = Some((id, version, content)),
                Err(error) => {
                    let path = shared.shelf.event(id, version);
                    tracing::error!(
                        place = &*shared.place,
                        "the event in {path} is lost: {error}"
                    );
                    if error.is_damage() {
                        newest.rest.damaged.push((id, version));
                    }
                    continue;
                }
            }
        }
        break;
    }
    let superseded = versions.into_iter().map(|version| (id, version));
    newest.rest.superseded.extend(superseded);
    Ok(newest)
}

/// Deletes what is superseded and sets aside what is damaged; how many. Only for who writes the place.
pub async fn tidy(shared: &Shared, useless: Useless) -> Result<usize> {
    shared.shelf.delete_events(&useless.superseded).await?;
    for &(id, version) in &useless.damaged {
        shared.shelf.set_event_aside(id, version).await?;
    }
    Ok(useless.damaged.len())
}

/// Stores what changed; what fails is pending again.
pub async fn write(
    shared: &Shared,
    epoch: u64,
    changes: BTreeMap<u64, Option<Bytes>>,
) -> Result<()> {
    let mut writes = stream::iter(changes)
        .map(async |(id, content)| {
            let done = write_one(shared, epoch, id, content.as_ref()).await;
            (id, content, done)
        })
        .buffer_unordered(AT_ONCE);
    let mut failed = None;
    while let Some((id, content, done)) = writes.next().await {
        let mut state = shared.lock();
        state.events.writing -= 1;
        if let Err(error) = done {
            failed = Some(error);
            if state.role == Role::Writer && state.epoch == epoch {
                // What came since is newer.
                state.events.pending.entry(id).or_insert(content);
                state.events.since.get_or_insert_with(Instant::now);
            }
        }
    }
    failed.map_or(Ok(()), Err)
}

async fn write_one(shared: &Shared, epoch: u64, id: u64, content: Option<&Bytes>) -> Result<()> {
    let (before, version) = {
        let state = shared.lock();
        let before = state.events.stored.get(&id).copied();
        (before, state.events.next_version(id, epoch))
    };
    if let Some(content) = content {
        let object = sealed(content);
        shared.shelf.put_event(id, version, object).await?;
    }
    {
        let mut state = shared.lock();
        if state.role != Role::Writer || state.epoch != epoch {
            return Ok(());
        }
        match content {
            Some(_) => state.events.stored.insert(id, version),
            None => state.events.stored.remove(&id),
        };
    }
    match before {
        Some(before) => shared.shelf.delete_events(&[(id, before)]).await,
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
