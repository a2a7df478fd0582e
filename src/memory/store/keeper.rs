//! Keeps a place: reads what is stored of it, takes its lease when nobody has it, renews it, and notices its loss.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::{Duration, Instant},
};

use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::Error;

use super::{
    Backoff,
    form::{self, FormError},
    lease::{Lease, Looked, RENEW_EVERY, Watcher},
    loader::{self, note_unreadable},
    modes,
    notes::{self, Kind, Notes},
    shared::{Known, NAMES_MAX, News, Role, Shared},
    shelf::{Listed, Result},
    writer,
};
use crate::{
    memory::Version,
    model::{mode::Modes, viewpoint::Head},
};

/// Heads read at once.
const HEADS_AT_ONCE: usize = 32;
/// A reader spends one part in so many of its time on listing what the writer wrote.
const REFRESH_SHARE: u32 = 20;
/// Under this name the keeper has trouble.
const REACHING: &str = "reaching";

/// Until the place is closed.
pub async fn keep(shared: Arc<Shared>) {
    let writer = tokio::spawn(writer::write(shared.clone()));
    let loader = tokio::spawn(loader::load(shared.clone()));
    let mut lease: Option<Lease> = None;
    let mut seeker = Seeker::default();
    let mut backoff = Backoff::default();
    loop {
        let tended = match lease.take() {
            Some(held) => tend(&shared, held).await,
            None => seek(&shared, &mut seeker).await,
        };
        let pause = match tended {
            Ok(held) => {
                lease = held;
                backoff = Backoff::default();
                shared.trouble(REACHING, None);
                RENEW_EVERY
            }
            Err((held, error)) => {
                lease = held;
                shared.trouble(REACHING, Some(error.to_string()));
                backoff.next()
            }
        };
        shared.tell_worker();
        if shared.lock().closing {
            break;
        }
        // A lease must not expire because the store was away for a moment.
        let pause = if lease.is_some() {
            pause.min(RENEW_EVERY)
        } else {
            pause
        };
        // Whichever comes first.
        let _ = tokio::time::timeout(pause, shared.for_keeper.notified()).await;
    }
    // The others end by themselves; what failed in them was told.
    drop(writer.await);
    loader.abort();
    if let Some(lease) = lease
        && let Err(error) = lease.release(&shared.shelf).await
    {
        tracing::warn!(
            place = &*shared.place,
            "the lease could not be released: {error}"
        );
    }
    shared.lock().closed = true;
    shared.tell_worker();
}

/// The lease as it is after, and what went wrong.
type Tended = std::result::Result<Option<Lease>, (Option<Lease>, Error)>;

/// Renews the lease.
async fn tend(shared: &Shared, mut lease: Lease) -> Tended {
    let renewed = lease.renew(&shared.shelf).await;
    match renewed {
        Ok(true) => {
            shared.lock().trusted_until = Some(lease.trusted_until());
            shared.for_writer.notify_one();
            match set_aside(shared).await {
                Ok(_) => Ok(Some(lease)),
                Err(error) => Err((Some(lease), error)),
            }
        }
        Ok(false) => {
            lost(shared);
            Ok(None)
        }
        Err(error) => Err((Some(lease), error)),
    }
}

/// Another service has taken the place: what is not stored here is of no use any more.
fn lost(shared: &Shared) {
    let mut state = shared.lock();
    let count = state.unstored() as u64;
    state.pending.clear();
    state.modes_said = Modes::default();
    state.modes_version = None;
    state.modes_told = false;
    state.events = Notes::default();
    state.calibrations = Notes::default();
    state.counters.lost += count;
    state.role = Role::Reader {
        holder: "another service".to_owned(),
    };
    state.trusted_until = None;
    state.news.clear();
    state.loaded.clear();
    state.catalogue.clear();
    state.news.push(News::Reset);
    state.stale = true;
    drop(state);
    shared.for_keeper.notify_one();
    tracing::error!(
        place = &*shared.place,
        "another service has taken this place over; {count} changes were not stored and are lost"
    );
}

/// What a service remembers that wants the place.
#[derive(Debug, Default)]
struct Seeker {
    watcher: Watcher,
    /// When the place was read last, and how long that took.
    refreshed: Option<(Instant, Duration)>,
}

/// Reads what is stored, and takes the place if nobody has it.
async fn seek(shared: &Shared, seeker: &mut Seeker) -> Tended {
    read_and_take(shared, seeker)
        .await
        .map_err(|error| (None, error))
}

async fn read_and_take(shared: &Shared, seeker: &mut Seeker) -> Result<Option<Lease>> {
    let (first, stale) = {
        let state = shared.lock();
        (state.role == Role::Unread, state.stale)
    };
    let due = |(at, took): (Instant, Duration)| at.elapsed() >= took * REFRESH_SHARE;
    if first || stale || seeker.refreshed.is_none_or(due) {
        let began = Instant::now();
        // Long where the place is large: most of it is done before there is a lease to renew.
        refresh(shared).await?;
        seeker.refreshed = Some((Instant::now(), began.elapsed()));
    }
    let epochs = shared
        .lock()
        .catalogue
        .values()
        .map(|known| known.version.epoch)
        .max();
    let epoch_min = epochs.unwrap_or(0) + 1;
    match seeker
        .watcher
        .look(&shared.shelf, &shared.name, epoch_min)
        .await?
    {
        Looked::Held(holder) => {
            if first {
                tracing::info!(
                    place = &*shared.place,
                    "{holder} writes this place; questions are answered from what is stored"
                );
            }
            shared.lock().role = Role::Reader { holder };
            Ok(None)
        }
        Looked::Taken(lease) => {
            // What was written last before the place was ours.
            let tidied = tidy(shared, &lease).await;
            if let Err(error) = tidied {
                if let Err(error) = lease.release(&shared.shelf).await {
                    tracing::debug!("the lease could not be released: {error}");
                }
                return Err(error);
            }
            Ok(Some(lease))
        }
    }
}

/// Makes the place ours: reads what came last, sets aside what is damaged, deletes what is superseded.
async fn tidy(shared: &Shared, lease: &Lease) -> Result<()> {
    shared.lock().epoch = lease.epoch;
    let read = refresh(shared).await?;
    shared.shelf.sweep().await?;
    shared.shelf.delete(&read.superseded, false).await?;
    shared.shelf.delete_modes(&read.modes_superseded).await?;
    for &version in &read.modes_damaged {
        shared.shelf.set_modes_aside(version).await?;
    }
    shared.shelf.delete_leases_before(lease.epoch).await?;
    for stranger in &read.strangers {
        shared.shelf.move_aside(stranger).await?;
    }
    let mut notes_damaged = 0;
    for useless in read.notes {
        notes_damaged += notes::tidy(shared, useless).await?;
    }
    let found =
        read.strangers.len() + read.modes_damaged.len() + notes_damaged + set_aside(shared).await?;
    // Also what was set aside in earlier times.
    let (names, count) = shared.shelf.damaged(NAMES_MAX).await?;
    let mut state = shared.lock();
    let recovered = state.catalogue.len();
    state.counters.damaged = count;
    state.counters.damaged_names = names.clone();
    state.counters.recovered = recovered;
    state.role = Role::Writer;
    state.trusted_until = Some(lease.trusted_until());
    drop(state);
    tracing::info!(
        place = &*shared.place,
        epoch = lease.epoch,
        "{recovered} viewpoints recovered, {found} damaged set aside{}",
        if names.is_empty() {
            String::new()
        } else {
            format!("; {count} are kept aside: {}", names.join(", "))
        }
    );
    shared.for_writer.notify_one();
    Ok(())
}

/// Moves damaged objects away from the others; how many. Only for who writes the place.
async fn set_aside(shared: &Shared) -> Result<usize> {
    let damaged: Vec<(u64, Version)> = {
        let state = shared.lock();
        let damaged = state
            .unreadable
            .iter()
            .filter(|(_, found)| found.is_damaged);
        damaged.map(|(&key, _)| key).collect()
    };
    for &(id, version) in &damaged {
        let path = match shared.shelf.set_aside(id, version).await {
            // Somebody else did, or deleted it.
            Err(Error::NotFound { .. }) => {
                shared.lock().unreadable.remove(&(id, version));
                continue;
            }
            moved => moved?,
        };
        tracing::error!(place = &*shared.place, "what is damaged is kept as {path}");
        let mut state = shared.lock();
        state.unreadable.remove(&(id, version));
        let counters = &mut state.counters;
        counters.damaged += 1;
        if counters.damaged_names.len() < NAMES_MAX {
            counters.damaged_names.push(path.to_string());
        }
    }
    Ok(damaged.len())
}

/// What is stored beside the viewpoints as they are.
#[derive(Debug, Default)]
struct Read {
    superseded: Vec<(u64, Version)>,
    strangers: Vec<object_store::path::Path>,
    modes_superseded: Vec<Version>,
    modes_damaged: Vec<Version>,
    notes: Vec<notes::Useless>,
}

/// Learns what is stored of the modes: the newest state that can be read.
async fn refresh_modes(shared: &Shared, read: &mut Read) -> Result<()> {
    let mut versions = shared.shelf.list_modes().await?;
    while let Some(version) = versions.pop() {
        if shared.lock().modes_version != Some(version) {
            let got = match shared.shelf.get_modes(version, modes::BYTES_MAX).await {
                // Superseded meanwhile.
                Err(Error::NotFound { .. }) => continue,
                got => got?,
            };
            let decoded = got.map_or(Err(FormError::TooLong), |bytes| modes::decode(&bytes));
            let stored = match decoded {
                Ok(stored) => stored,
                Err(error) => {
                    let path = shared.shelf.modes(version);
                    tracing::error!(
                        place = &*shared.place,
                        "the modes in {path} are not used, but what was said before: {error}"
                    );
                    if error.is_damage() {
                        read.modes_damaged.push(version);
                    }
                    continue;
                }
            };
            let mut state = shared.lock();
            state.modes = stored;
            state.modes_version = Some(version);
            state.modes_told = false;
        }
        break;
    }
    read.modes_superseded = versions;
    Ok(())
}

/// Makes the catalogue what the store says, and tells the worker. Only heads that are not known yet are read.
async fn refresh(shared: &Shared) -> Result<Read> {
    let listing = shared.shelf.list().await?;
    let mut states: BTreeMap<u64, Vec<Listed>> = BTreeMap::new();
    let unreadable = shared.lock().unreadable.clone();
    let id_max = listing.viewpoints.iter().map(|listed| listed.id).max();
    for listed in listing.viewpoints {
        if !unreadable.contains_key(&(listed.id, listed.version)) {
            states.entry(listed.id).or_default().push(listed);
        }
    }
    let mut read = Read {
        strangers: listing.strangers,
        ..Read::default()
    };
    refresh_modes(shared, &mut read).await?;
    for kind in Kind::ALL {
        read.notes.push(notes::refresh(shared, kind).await?);
    }
    let known: BTreeMap<u64, Version> = {
        let state = shared.lock();
        let catalogue = state.catalogue.iter();
        catalogue.map(|(&id, known)| (id, known.version)).collect()
    };
    let mut unknown = Vec::new();
    let mut kept = BTreeSet::new();
    for (id, mut states) in states {
        // The newest first.
        states.sort_by_key(|listed| std::cmp::Reverse(listed.version));
        if known.get(&id) == states.first().map(|newest| &newest.version) {
            kept.insert(id);
            read.superseded
                .extend(states[1..].iter().map(|listed| (id, listed.version)));
        } else {
            unknown.push(states);
        }
    }
    let mut heads = stream::iter(unknown)
        .map(|states| newest_readable(shared, states))
        .buffer_unordered(HEADS_AT_ONCE);
    let mut found = Vec::new();
    let mut other_settings = 0;
    while let Some(newest) = heads.try_next().await? {
        read.superseded.extend(newest.superseded);
        kept.extend(newest.vanished);
        for (id, version, error) in newest.damaged {
            note_unreadable(shared, id, version, &error);
        }
        if let Some((entry, settings_hash)) = newest.found {
            other_settings += usize::from(settings_hash != shared.options.settings_hash);
            found.push(entry);
        }
    }
    drop(heads);
    found.sort_by_key(|entry| entry.head.id);

    let mut state = shared.lock();
    state.news.push(News::Taken(id_max.unwrap_or(0)));
    let found_ids: BTreeSet<u64> = found.iter().map(|entry| entry.head.id).collect();
    let gone: Vec<u64> = known
        .keys()
        .filter(|id| !kept.contains(id) && !found_ids.contains(id))
        .copied()
        .collect();
    for id in gone {
        state.catalogue.remove(&id);
        state.news.push(News::Gone(id));
    }
    let heads: Vec<(Head, Version)> = found
        .iter()
        .map(|entry| (entry.head.clone(), entry.version))
        .collect();
    for entry in found {
        state.catalogue.insert(entry.head.id, entry);
    }
    if !heads.is_empty() {
        state.news.push(News::Known(heads));
    }
    state.counters.recovered = state.catalogue.len();
    state.counters.recovered_other_settings += other_settings;
    state.stale = false;
    Ok(read)
}

/// The newest state of a viewpoint whose head can be read.
#[derive(Debug, Default)]
struct Newest {
    found: Option<(Known, u64)>,
    superseded: Vec<(u64, Version)>,
    damaged: Vec<(u64, Version, FormError)>,
    /// Its id, if a state of it was deleted while it was looked for: a newer one is there by now.
    vanished: Option<u64>,
}

async fn newest_readable(shared: &Shared, states: Vec<Listed>) -> Result<Newest> {
    let mut newest = Newest::default();
    for Listed { id, version, bytes } in states {
        if newest.found.is_some() {
            newest.superseded.push((id, version));
            continue;
        }
        if bytes == 0 {
            newest
                .damaged
                .push((id, version, FormError::Short { got: 0 }));
            continue;
        }
        let got = match shared.shelf.get_head(id, version).await {
            Err(Error::NotFound { .. }) => {
                newest.vanished = Some(id);
                continue;
            }
            got => got?,
        };
        let checked = form::decode_head(&got).and_then(|read| {
            if *read.label.place != *shared.place
                || read.label.version != version
                || read.head.id != id
            {
                return Err(FormError::Value("name"));
            }
            if read.object_bytes != bytes {
                let said = read.object_bytes;
                return Err(FormError::Length { got: bytes, said });
            }
            Ok(read)
        });
        match checked {
            Ok(read) => {
                let known = Known {
                    head: read.head,
                    version,
                    bytes,
                };
                newest.found = Some((known, read.label.settings_hash));
            }
            Err(error) => newest.damaged.push((id, version, error)),
        }
    }
    Ok(newest)
}
