//! A place's events as others may have them: the latest state of each, for HTTP and for whoever comes late.
//!
//! `<root>/<place>/@events/<id>`: every change is put there; a get on `<root>/<place>/@events/*` answers with the latest
//! state of those that last and of those that ended lately. A plain queryable rather than a publisher's cache: any client
//! can ask it, and it needs no declaration for each event.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, atomic::Ordering},
};

use tokio::sync::mpsc;
use zenoh::{
    Session, Wait,
    bytes::Encoding,
    key_expr::KeyExpr,
    qos::{CongestionControl, Priority},
    query::{Query, Queryable},
};

use super::{ingest::IngestCounters, places::Places};
use crate::{
    model::event::{Event, Picture},
    wire::{
        encode::{self, EVENT_STATES},
        keys, proto,
    },
};

/// Ended events that are still told of.
pub const ENDED_MAX: usize = 256;
/// Queries for events that wait to be answered.
const QUERIES_MAX: usize = 16;

/// What a place's worker publishes when its events change; readers take the latest.
#[derive(Debug, Clone, Default)]
pub struct PlaceEvents {
    open: BTreeMap<u64, Kept>,
    /// The latest last.
    ended: VecDeque<Arc<proto::Event>>,
}

#[derive(Debug, Clone)]
struct Kept {
    message: Arc<proto::Event>,
    /// Of which the message's pictures are.
    picture: Option<Arc<Picture>>,
}

impl PlaceEvents {
    /// Takes an event's new state and returns its message, and the id of the event that is told of no more.
    pub fn put(&mut self, event: &Event, place: &str) -> (Arc<proto::Event>, Option<u64>) {
        let before = self.open.remove(&event.id);
        let mut message = encode::event(event, place);
        match (&before, &event.picture) {
            // Packing pictures takes longer than all the rest.
            (Some(before), now) if before.has(now.as_ref()) => {
                message.picture.clone_from(&before.message.picture);
                message
                    .expected_picture
                    .clone_from(&before.message.expected_picture);
            }
            (_, Some(picture)) => {
                (message.picture, message.expected_picture) = encode::event_pictures(picture);
            }
            (_, None) => {}
        }
        let message = Arc::new(message);
        let picture = event.picture.clone();
        let gone = self.keep(message.clone(), picture);
        (message, gone)
    }

    /// Takes an event that was told of before, with its pictures; the id of the event that is told of no more.
    pub fn restore(&mut self, message: proto::Event) -> Option<u64> {
        self.open.remove(&message.id);
        self.ended.retain(|event| event.id != message.id);
        let gone = self.keep(Arc::new(message), None);
        self.ended
            .make_contiguous()
            .sort_by_key(|event| event.ended.map(|at| (at.seconds, at.nanos)));
        gone
    }

    fn keep(&mut self, message: Arc<proto::Event>, picture: Option<Arc<Picture>>) -> Option<u64> {
        if message.state != EVENT_STATES[2] {
            self.open.insert(message.id, Kept { message, picture });
            return None;
        }
        self.ended.push_back(message);
        let over = self.ended.len() > ENDED_MAX;
        let gone = over.then(|| self.ended.pop_front()).flatten();
        gone.map(|event| event.id)
    }

    /// Those that last, the newest first.
    pub fn open(&self) -> impl ExactSizeIterator<Item = &Arc<proto::Event>> {
        self.open.values().rev().map(|kept| &kept.message)
    }

    /// Those that ended lately, the latest first.
    pub fn ended(&self) -> impl ExactSizeIterator<Item = &Arc<proto::Event>> {
        self.ended.iter().rev()
    }

    pub fn get(&self, id: u64) -> Option<&Arc<proto::Event>> {
        let open = self.open.get(&id).map(|kept| &kept.message);
        open.or_else(|| self.ended.iter().find(|event| event.id == id))
    }
}

impl Kept {
    /// Whether the message's pictures are those of an event whose picture is `now`. One that goes on after a restart has
    /// none until it has a new one.
    fn has(&self, now: Option<&Arc<Picture>>) -> bool {
        match (&self.picture, now) {
            (Some(packed), Some(now)) => Arc::ptr_eq(packed, now),
            (packed, None) => packed.is_none(),
            (None, Some(_)) => false,
        }
    }
}

/// Puts an event's new state on its key: urgent, and not to be lost.
pub fn publish(session: &Session, root: &str, event: &proto::Event) {
    let sent = session
        .put(
            keys::event(root, &event.place, event.id),
            encode::bytes(event),
        )
        .encoding(keys::encoding::<proto::Event>())
        .congestion_control(CongestionControl::Block)
        .priority(Priority::InteractiveHigh)
        .express(true)
        .wait();
    // Only a session that is closing refuses.
    if let Err(error) = sent {
        tracing::debug!("not published: {error}");
    }
}

/// Answers gets for events; dropping the queryable ends it.
///
/// # Errors
/// What Zenoh says when the session is closing.
pub fn start(places: &Arc<Places>, counters: Arc<IngestCounters>) -> zenoh::Result<Queryable<()>> {
    let (sender, mut queries) = mpsc::channel::<Query>(QUERIES_MAX);
    let queryable = places
        .session
        .declare_queryable(keys::event(&places.root, "*", "*"))
        .complete(true)
        .callback(move |query| {
            // Dropping a query ends it without a reply: replying is nothing for a callback.
            if sender.try_send(query).is_err() {
                counters.queries_dropped.fetch_add(1, Ordering::Relaxed);
            }
        })
        .wait()?;
    let places = Arc::downgrade(places);
    tokio::spawn(async move {
        while let Some(query) = queries.recv().await {
            let Some(places) = places.upgrade() else {
                return;
            };
            answer(&places, &query).await;
        }
    });
    Ok(queryable)
}

async fn answer(places: &Places, query: &Query) {
    let json = query.parameters().get("format") == Some("json");
    for (_, place) in places.all() {
        let events = place.events.borrow().clone();
        for event in events.open().chain(events.ended()) {
            let key = keys::event(&places.root, &event.place, event.id);
            let asked =
                KeyExpr::try_from(key.as_str()).is_ok_and(|key| query.key_expr().intersects(&key));
            if !asked {
                continue;
            }
            let (bytes, encoding) = if json {
                let text = encode::json(&**event).to_string();
                (text.into_bytes(), Encoding::APPLICATION_JSON)
            } else {
                (encode::bytes(&**event), keys::encoding::<proto::Event>())
            };
            if let Err(error) = query.reply(&key, bytes).encoding(encoding).await {
                tracing::debug!("no reply on {key}: {error}");
            }
        }
    }
}
