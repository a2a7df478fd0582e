//! Writes what has changed, some time after it changed: newest states only, several at once. What changes again and again
//! is written once in that time. What is said about modes is written at once.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, PoisonError},
    time::Instant,
};

use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::{task::spawn_blocking, time};

use super::{
    Backoff,
    form::{Encoder, Label},
    modes,
    notes::{self, Kind},
    shared::{Known, News, Pending, Role, Shared},
    shelf,
};
use crate::{memory::Version, model::mode::Modes};

/// Packing one takes some milliseconds of a processor, and most of a write is waiting.
const WRITES_AT_ONCE: usize = 4;
/// Under this name the writer has trouble.
const WRITING: &str = "writing";

/// What is to be done next.
enum Due {
    Batch {
        epoch: u64,
        changes: Vec<(u64, Pending)>,
    },
    Modes {
        version: Version,
        said: Modes,
    },
    Notes {
        kind: Kind,
        epoch: u64,
        changes: BTreeMap<u64, Option<Bytes>>,
    },
    At(Instant),
    Nothing,
    End,
}

/// Until the place is closed and nothing is left that can be written.
pub async fn write(shared: Arc<Shared>) {
    let mut backoff = Backoff::default();
    // Earlier states that are still there.
    let mut superseded = Vec::new();
    let encoders = Encoders::default();
    loop {
        match due(&shared) {
            Due::End => return,
            Due::Nothing => {
                encoders.clear();
                shared.for_writer.notified().await;
            }
            Due::At(instant) => {
                // Whichever comes first.
                let _ = time::timeout_at(instant.into(), shared.for_writer.notified()).await;
            }
            Due::Batch { epoch, changes } => {
                if write_batch(&shared, epoch, changes, &mut superseded, &encoders).await {
                    backoff = Backoff::default();
                } else {
                    time::sleep(backoff.next()).await;
                }
            }
            Due::Modes { version, said } => {
                let written = write_modes(&shared, version, said).await;
                note_written(&shared, written, &mut backoff).await;
            }
            Due::Notes {
                kind,
                epoch,
                changes,
            } => {
                let written = notes::write(&shared, kind, epoch, changes).await;
                note_written(&shared, written, &mut backoff).await;
            }
        }
    }
}

/// Says how it went, and waits after a failure.
async fn note_written(shared: &Shared, written: shelf::Result<()>, backoff: &mut Backoff) {
    let trouble = written.err().map(|error| error.to_string());
    let failed = trouble.is_some();
    shared.trouble(WRITING, trouble);
    shared.tell_worker();
    if failed {
        shared.lock().counters.write_failures += 1;
        time::sleep(backoff.next()).await;
    } else {
        *backoff = Backoff::default();
    }
}

fn due(shared: &Shared) -> Due {
    let mut state = shared.lock();
    let epoch = state.epoch;
    if !state.modes_said.is_empty() && state.may_write(epoch) {
        // Of the states of one epoch the last counts.
        let last = state.modes_version.filter(|last| last.epoch == epoch);
        let revision = last.map_or(1, |last| last.revision + 1);
        return Due::Modes {
            version: Version { epoch, revision },
            said: state.modes_said.clone(),
        };
    }
    let write_behind = shared.options.write_behind_half();
    let pending = state.pending.values();
    let pending = pending.map(|pending| pending.since + write_behind);
    let notes = state.events.due.into_iter().chain(state.calibrations.due);
    let Some(at) = pending.chain(notes).min() else {
        return if state.closing {
            Due::End
        } else {
            Due::Nothing
        };
    };
    if !state.may_write(epoch) {
        // A renewal tells.
        let gone = state.closing && state.role != Role::Writer;
        return if gone { Due::End } else { Due::Nothing };
    }
    if !state.closing && Instant::now() < at {
        return Due::At(at);
    }
    for kind in Kind::ALL {
        let notes = state.notes(kind);
        if notes.due.take().is_some() {
            let changes = std::mem::take(&mut notes.pending);
            notes.writing = changes.len();
            return Due::Notes {
                kind,
                epoch,
                changes,
            };
        }
    }
    let (closing, now) = (state.closing, Instant::now());
    let is_due = |pending: &Pending| closing || pending.since + write_behind <= now;
    // What changed later may change again before it has to be written. But nothing goes before what came in its room is
    // stored: that may be all that is known there.
    let mut pending = state.pending.values();
    let all = pending.any(|pending| pending.written.is_none() && is_due(pending));
    let changes: Vec<(u64, Pending)> = state
        .pending
        .extract_if(.., |_, pending| all || is_due(pending))
        .collect();
    state.writing = changes.len();
    Due::Batch { epoch, changes }
}

/// Stores what holds after this was said, beside what held before.
async fn write_modes(shared: &Shared, version: Version, said: Modes) -> shelf::Result<()> {
    let (modes, before) = {
        let state = shared.lock();
        (state.modes.then(&said), state.modes_version)
    };
    let object = modes::encode(&modes).into();
    shared.shelf.put_modes(version, object).await?;
    {
        let mut state = shared.lock();
        if state.role != Role::Writer || state.epoch != version.epoch {
            return Ok(());
        }
        // What was said while this was written is said after it.
        if state.modes_said == said {
            state.modes_said = Modes::default();
        }
        state.modes = modes;
        state.modes_version = Some(version);
    }
    if let Some(before) = before {
        shared.shelf.delete_modes(&[before]).await?;
    }
    Ok(())
}

/// At most as many as are in use at once, kept as long as there is something to be written.
#[derive(Default)]
struct Encoders(Mutex<Vec<Encoder>>);

impl Encoders {
    fn take(&self) -> Encoder {
        let idle = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop();
        idle.unwrap_or_default()
    }

    fn put_back(&self, encoder: Encoder) {
        let mut idle = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        idle.push(encoder);
    }

    fn clear(&self) {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clear();
    }
}

/// False if some of it failed; that is pending again.
async fn write_batch(
    shared: &Arc<Shared>,
    epoch: u64,
    changes: Vec<(u64, Pending)>,
    superseded: &mut Vec<(u64, Version)>,
    encoders: &Encoders,
) -> bool {
    let (written, removed): (Vec<_>, Vec<_>) = changes
        .into_iter()
        .partition(|(_, pending)| pending.written.is_some());
    let mut trouble = None;
    let mut writes = stream::iter(written)
        .map(|(id, pending)| async move {
            let done = write_one(shared, epoch, &pending, encoders).await;
            (id, pending, done)
        })
        .buffer_unordered(WRITES_AT_ONCE);
    while let Some((id, pending, done)) = writes.next().await {
        match done {
            Ok(Some(known)) => superseded.extend(note_stored(shared, known, pending.since)),
            Ok(None) => put_back(shared, epoch, id, pending),
            Err(error) => {
                trouble = Some(error.to_string());
                put_back(shared, epoch, id, pending);
            }
        }
    }
    drop(writes);

    let (gone, earlier): (Vec<_>, Vec<_>) = superseded
        .drain(..)
        .partition(|(id, _)| removed.iter().any(|(removed, _)| removed == id));
    if let Err(error) = shared.shelf.delete(&earlier, false).await {
        trouble = Some(error.to_string());
        superseded.extend(earlier);
    }
    let is_removed = remove(shared, epoch, &removed, &gone).await;
    if !matches!(is_removed, Ok(true)) {
        superseded.extend(gone);
        for (id, pending) in removed {
            put_back(shared, epoch, id, pending);
        }
    }
    if let Err(error) = is_removed {
        trouble = Some(error.to_string());
    }

    let done = trouble.is_none();
    let mut state = shared.lock();
    state.writing = 0;
    state.counters.write_failures += u64::from(!done);
    drop(state);
    shared.trouble(WRITING, trouble);
    shared.tell_worker();
    done
}

/// `None` if the lease does not allow it any more.
async fn write_one(
    shared: &Arc<Shared>,
    epoch: u64,
    pending: &Pending,
    encoders: &Encoders,
) -> shelf::Result<Option<Known>> {
    let Some((viewpoint, revision)) = pending.written.clone() else {
        return Ok(None);
    };
    let version = Version { epoch, revision };
    let label = Label {
        place: shared.place.to_string(),
        version,
        settings_hash: shared.options.settings_hash,
    };
    let (head, id) = (viewpoint.head(), viewpoint.id);
    let mut encoder = encoders.take();
    let packed = spawn_blocking(move || (encoder.encode(&label, &viewpoint), encoder)).await;
    let (object, encoder) = packed.map_err(|source| object_store::Error::JoinError { source })?;
    encoders.put_back(encoder);
    if !shared.lock().may_write(epoch) {
        return Ok(None);
    }
    let bytes = object.len() as u64;
    shared.shelf.put(id, version, object.into()).await?;
    Ok(Some(Known {
        head,
        version,
        bytes,
    }))
}

/// The state that was stored before, which is superseded.
fn note_stored(shared: &Shared, known: Known, since: Instant) -> Option<(u64, Version)> {
    let (id, version, bytes) = (known.head.id, known.version, known.bytes);
    let mut state = shared.lock();
    let before = state.catalogue.insert(id, known);
    state.news.push(News::Stored(id, version));
    let counters = &mut state.counters;
    counters.written += 1;
    counters.written_bytes += bytes;
    counters.late += u64::from(since.elapsed() > shared.options.write_behind);
    before
        .filter(|before| before.version != version)
        .map(|before| (id, before.version))
}

/// Deletes viewpoints for good, earlier states first: a crash in between leaves the newest. False if the lease does not
/// allow it any more.
async fn remove(
    shared: &Shared,
    epoch: u64,
    removed: &[(u64, Pending)],
    earlier: &[(u64, Version)],
) -> shelf::Result<bool> {
    if removed.is_empty() {
        return Ok(true);
    }
    let mut states = earlier.to_vec();
    {
        let state = shared.lock();
        if !state.may_write(epoch) {
            return Ok(false);
        }
        states.extend(removed.iter().filter_map(|(id, _)| {
            let known = state.catalogue.get(id)?;
            Some((*id, known.version))
        }));
    }
    shared.shelf.delete(&states, true).await?;
    let mut state = shared.lock();
    for (id, _) in removed {
        if state.catalogue.remove(id).is_some() {
            state.counters.removed += 1;
        }
    }
    Ok(true)
}

/// What changed since then stays; it has been lacking for longer. What another service has taken is not ours to write.
fn put_back(shared: &Shared, epoch: u64, id: u64, pending: Pending) {
    let mut state = shared.lock();
    if state.role != Role::Writer || state.epoch != epoch {
        return;
    }
    match state.pending.get_mut(&id) {
        Some(newer) => newer.since = pending.since,
        None => {
            state.pending.insert(id, pending);
        }
    }
}
