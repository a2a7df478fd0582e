//! Questions over Zenoh: `<root>/<place>/@memory/{prior|evaluate|views|status|next_view|forget|mode}` and
//! `<root>/<place>/<robot>/<camera>/mode`.
//!
//! The request travels in the payload, as protobuf or with the encoding `application/json` as JSON, or, in simple cases,
//! in the selector's parameters, so that a plain `get` works:
//!
//! ```text
//! prior?x=..;y=..;z=..;qx=..;qy=..;qz=..;qw=..;fx=..;fy=..;cx=..;cy=..;width=..;height=..;planes=expected,coverage
//! evaluate?robot=..;camera=..        whose calibration and visit the frame in the payload borrows
//! views?after=..;limit=..
//! next_view?robot=..;camera=..;radius=..;count=..          a ring around where the camera was last
//! forget?sphere=x,y,z,radius | box=x,y,z,x,y,z  ;since=..;until=..  (seconds since 1970)  | everything=true
//! mode?set=learn|observe|freeze      without `set` it is only told
//! ```
//!
//! `forget` must name one place; the others may ask many by wildcards. Parameters win over the payload's; `format=json` asks for JSON. Status is always JSON.

use std::sync::{Arc, atomic::Ordering};

use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use zenoh::{
    Wait,
    bytes::Encoding,
    key_expr::KeyExpr,
    query::{Parameters, Query, Queryable},
};

use super::{
    inbox::ASKS_MAX,
    ingest::IngestCounters,
    places::Place,
    questions::{Held, Questions, camera_named},
};
use crate::{
    model::{mode::Mode, refusal::Refusal},
    wire::{
        decode::{
            self,
            questions::{bad, json, mode},
        },
        encode,
        keys::{self, CameraPath},
        proto,
    },
};

/// Queries being answered, beside those in the places' own queues.
const QUERIES_MAX: usize = 4 * ASKS_MAX;

const FORGET: &str = "forget";

const QUESTIONS: [&str; 7] = [
    "prior",
    "evaluate",
    "views",
    "status",
    "next_view",
    FORGET,
    keys::MODE,
];

/// Declares the queryables; dropping them ends them.
///
/// # Errors
/// What Zenoh says when the session is closing.
pub fn start(
    questions: &Arc<Questions>,
    counters: &Arc<IngestCounters>,
) -> zenoh::Result<[Queryable<()>; 2]> {
    let (sender, mut queries) = mpsc::channel::<Query>(QUERIES_MAX);
    let places = &questions.places;
    let declare = |key: String| {
        let (sender, counters) = (sender.clone(), counters.clone());
        let session = &places.session;
        session
            .declare_queryable(key)
            .complete(true)
            .callback(move |query| {
                // Dropping a query ends it without a reply: replying is nothing for a callback.
                if sender.try_send(query).is_err() {
                    counters.queries_dropped.fetch_add(1, Ordering::Relaxed);
                }
            })
            .wait()
    };
    let queryables = [
        declare(keys::memory(&places.root, "*", "*"))?,
        declare(keys::every_camera(&places.root, keys::MODE))?,
    ];
    let questions = questions.clone();
    let permits = Arc::new(Semaphore::new(QUERIES_MAX));
    tokio::spawn(async move {
        while let Some(query) = queries.recv().await {
            let Ok(permit) = permits.clone().try_acquire_owned() else {
                reply_refusal(&query, &questions.busy()).await;
                continue;
            };
            let questions = questions.clone();
            tokio::spawn(async move {
                answer(&questions, &query).await;
                drop(permit);
            });
        }
    });
    Ok(queryables)
}

/// What goes back: bytes with their encoding.
struct Payload(Vec<u8>, Encoding);

/// A query may name one place or, by wildcards, many; and one question or many.
async fn answer(questions: &Questions, query: &Query) {
    let key = query.key_expr();
    if key.is_wild() {
        answer_all(questions, query).await;
        return;
    }
    let root = &questions.places.root;
    let camera = CameraPath::parse(root, key.as_str());
    let replied = match camera.filter(|path| path.key(root, keys::MODE) == key.as_str()) {
        Some(camera) => mode_of(questions, &camera, query).await,
        None => answer_one(questions, query).await,
    };
    reply(query, key.as_str(), replied).await;
}

async fn answer_one(questions: &Questions, query: &Query) -> Result<Held<Payload>, Refusal> {
    let key = query.key_expr().as_str();
    let unknown = || {
        Refusal::new(
            "unknown_place",
            format!(
                "{key} is unknown: a place begins with its first frame, and is asked for {}",
                QUESTIONS.join(", ")
            ),
        )
    };
    let (name, question) = keys::parse_memory(&questions.places.root, key).ok_or_else(unknown)?;
    if question == keys::MODE {
        // A place may be told before anything has come.
        return mode_of_place(questions, name, query).await;
    }
    if !QUESTIONS.contains(&question) {
        return Err(unknown());
    }
    let place = questions.places.known(name).await?;
    reply_to(question, name, &place, query, questions).await
}

/// Whoever is there answers; nobody else is missed.
async fn answer_all(questions: &Questions, query: &Query) {
    let asked =
        |key: &str| KeyExpr::try_from(key).is_ok_and(|one| query.key_expr().intersects(&one));
    let root = &questions.places.root;
    for (name, place) in questions.places.all() {
        // What cannot be undone is asked of one place by its name.
        for question in QUESTIONS.into_iter().filter(|&question| question != FORGET) {
            let key = keys::memory(root, &name, question);
            if asked(&key) {
                let replied = reply_to(question, &name, &place, query, questions).await;
                reply(query, &key, replied).await;
            }
        }
        for source in place.inbox.cameras().into_keys() {
            let camera = CameraPath {
                place: name.clone(),
                source,
            };
            let key = camera.key(root, keys::MODE);
            if asked(&key) {
                reply(query, &key, mode_of(questions, &camera, query).await).await;
            }
        }
    }
}

async fn reply(query: &Query, key: &str, replied: Result<Held<Payload>, Refusal>) {
    match replied {
        Ok(Held {
            reply: Payload(bytes, encoding),
            room: _room,
        }) => {
            if let Err(error) = query.reply(key, bytes).encoding(encoding).await {
                tracing::debug!("no reply on {key}: {error}");
            }
        }
        Err(refusal) => reply_refusal(query, &refusal).await,
    }
}

async fn reply_refusal(query: &Query, refusal: &Refusal) {
    let text = format!("{}: {refusal}", refusal.code);
    if let Err(error) = query.reply_err(text).encoding(Encoding::TEXT_PLAIN).await {
        tracing::debug!("no reply: {error}");
    }
}

async fn mode_of(
    questions: &Questions,
    camera: &CameraPath,
    query: &Query,
) -> Result<Held<Payload>, Refusal> {
    known(keys::MODE, query.parameters())?;
    let mode = questions.mode(camera, mode_to_set(query)?).await?;
    payload(&encode::mode(mode), query.parameters(), None)
}

async fn mode_of_place(
    questions: &Questions,
    place: &str,
    query: &Query,
) -> Result<Held<Payload>, Refusal> {
    let mode = questions.mode_of_place(place, mode_to_set(query)?).await?;
    payload(&encode::mode(mode), query.parameters(), None)
}

fn mode_to_set(query: &Query) -> Result<Option<Mode>, Refusal> {
    query.parameters().get("set").map(mode).transpose()
}

async fn reply_to(
    question: &str,
    name: &str,
    place: &Place,
    query: &Query,
    questions: &Questions,
) -> Result<Held<Payload>, Refusal> {
    let parameters = query.parameters();
    known(question, parameters)?;
    match question {
        "prior" => {
            let (request, _room) = request(query, questions)?;
            let request = prior_parameters(request, parameters)?;
            let Held { reply, room } = questions.prior(place, &request).await?;
            payload(&reply, parameters, room)
        }
        "evaluate" => {
            let (request, _room) = request(query, questions)?;
            if request == proto::EvaluateRequest::default() {
                return Err(bad(
                    "the request has no payload: send an EvaluateRequest with a frame",
                ));
            }
            let camera = camera_parameters(parameters)?;
            let evaluated = questions.evaluate(name, place, request, camera);
            let Held { reply, room } = evaluated.await?;
            payload(&reply, parameters, room)
        }
        "views" => {
            let (request, _room) = request(query, questions)?;
            let mut request: proto::ViewsRequest = request;
            set_number(parameters, "after", &mut request.after)?;
            set_number(parameters, "limit", &mut request.limit)?;
            payload(&questions.views(place, &request).await?, parameters, None)
        }
        "next_view" => {
            let (request, _room) = request(query, questions)?;
            let request = ring_parameters(request, parameters)?;
            let reply = questions.next_view(place, &request).await?;
            payload(&reply, parameters, None)
        }
        FORGET => {
            let (request, _room) = request(query, questions)?;
            let request = forget_parameters(request, parameters)?;
            payload(&questions.forget(place, &request).await?, parameters, None)
        }
        keys::MODE => mode_of_place(questions, name, query).await,
        _ => {
            let status = place.status.borrow().clone();
            let json = serde_json::to_vec(&*status).map_err(|error| {
                Refusal::new("status", format!("the status cannot be written: {error}"))
            })?;
            Ok(Held {
                reply: Payload(json, Encoding::APPLICATION_JSON),
                room: None,
            })
        }
    }
}

/// Refuses what no question of this kind has: a misspelt region must not become a larger one.
fn known(question: &str, parameters: &Parameters<'_>) -> Result<(), Refusal> {
    let own: &[&str] = match question {
        "prior" => &[
            "x", "y", "z", "qx", "qy", "qz", "qw", "fx", "fy", "cx", "cy", "width", "height",
            "planes",
        ],
        "evaluate" => &["robot", "camera"],
        "views" => &["after", "limit"],
        "next_view" => &["robot", "camera", "radius", "count"],
        FORGET => &["sphere", "box", "since", "until", "everything"],
        keys::MODE => &["set"],
        _ => &[],
    };
    // Zenoh's own begin with an underscore.
    let unknown = parameters.iter().find(|(name, _)| {
        !name.is_empty() && !name.starts_with('_') && *name != "format" && !own.contains(name)
    });
    match unknown {
        None => Ok(()),
        Some((name, _)) => Err(bad(format!(
            "{question} has no parameter {name}: it has {}",
            [own, &["format"]].concat().join(", ")
        ))),
    }
}

fn payload<M: encode::Named>(
    message: &M,
    parameters: &Parameters<'_>,
    room: Option<OwnedSemaphorePermit>,
) -> Result<Held<Payload>, Refusal> {
    let reply = match parameters.get("format") {
        None | Some("protobuf") => Payload(encode::bytes(message), keys::encoding::<M>()),
        Some("json") => Payload(
            encode::json(message).to_string().into_bytes(),
            Encoding::APPLICATION_JSON,
        ),
        Some(_) => {
            return Err(bad(
                "format is json or protobuf, which is also what comes without it",
            ));
        }
    };
    Ok(Held { reply, room })
}

/// The payload's, an empty one where there is none; with the room that it takes up.
fn request<M: encode::Named + Default>(
    query: &Query,
    questions: &Questions,
) -> Result<(M, Option<OwnedSemaphorePermit>), Refusal> {
    let Some(payload) = query.payload().filter(|payload| !payload.is_empty()) else {
        return Ok((M::default(), None));
    };
    if payload.len() > questions.limits.message_bytes_max() {
        return Err(Refusal::new(
            "message_too_large",
            "the request is larger than image_pixels_max allows: send smaller or compressed pictures",
        ));
    }
    let room = questions.room(payload.len())?;
    let bytes = payload.to_bytes();
    let message = if query.encoding() == Some(&Encoding::APPLICATION_JSON) {
        json(&bytes)?
    } else {
        decode::message(&bytes)?
    };
    Ok((message, Some(room)))
}

fn number<T: std::str::FromStr>(
    parameters: &Parameters<'_>,
    name: &str,
) -> Result<Option<T>, Refusal> {
    match parameters.get(name) {
        None => Ok(None),
        Some(text) => text
            .trim()
            .parse()
            .map(Some)
            .map_err(|_| bad(format!("the parameter {name} is no number of its kind"))),
    }
}

fn set_number<T: std::str::FromStr>(
    parameters: &Parameters<'_>,
    name: &str,
    value: &mut T,
) -> Result<(), Refusal> {
    if let Some(given) = number(parameters, name)? {
        *value = given;
    }
    Ok(())
}

/// `name=a,b,...`
fn numbers<const N: usize>(
    parameters: &Parameters<'_>,
    name: &str,
) -> Result<Option<[f64; N]>, Refusal> {
    let Some(text) = parameters.get(name) else {
        return Ok(None);
    };
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|number| number.trim().parse().ok())
        .collect();
    let numbers = numbers.and_then(|numbers| numbers.try_into().ok());
    numbers.map(Some).ok_or_else(|| {
        bad(format!(
            "the parameter {name} must be {N} numbers with commas between them"
        ))
    })
}

fn vector([x, y, z]: [f64; 3]) -> Option<proto::Vector3> {
    Some(proto::Vector3 { x, y, z })
}

fn camera_parameters(
    parameters: &Parameters<'_>,
) -> Result<Option<crate::model::frame::Source>, Refusal> {
    let name = |name| parameters.get(name).unwrap_or_default();
    camera_named(name("robot"), name("camera"))
}

fn prior_parameters(
    mut request: proto::PriorRequest,
    parameters: &Parameters<'_>,
) -> Result<proto::PriorRequest, Refusal> {
    if request.world_from_camera.is_none() && request.intrinsics.is_none() {
        let needed = |name: &str| -> Result<f64, Refusal> {
            number(parameters, name)?.ok_or_else(|| {
                bad(format!(
                    "the parameter {name} is missing: send a PriorRequest, or x y z qx qy qz qw fx fy cx cy width height"
                ))
            })
        };
        request.world_from_camera = Some(proto::Pose {
            position: vector([needed("x")?, needed("y")?, needed("z")?]),
            orientation: Some(proto::Quaternion {
                x: needed("qx")?,
                y: needed("qy")?,
                z: needed("qz")?,
                w: needed("qw")?,
            }),
        });
        request.intrinsics = Some(proto::Intrinsics {
            // Saturates; sizes are checked with the rest.
            width: needed("width")? as u32,
            height: needed("height")? as u32,
            fx: needed("fx")?,
            fy: needed("fy")?,
            cx: needed("cx")?,
            cy: needed("cy")?,
            ..proto::Intrinsics::default()
        });
    }
    if let Some(planes) = parameters.get("planes") {
        request.planes = planes.split(',').map(str::to_owned).collect();
    }
    Ok(request)
}

fn ring_parameters(
    mut request: proto::NextViewRequest,
    parameters: &Parameters<'_>,
) -> Result<proto::NextViewRequest, Refusal> {
    if !["robot", "camera", "radius", "count"]
        .iter()
        .any(|name| parameters.contains_key(*name))
    {
        return Ok(request);
    }
    let ring = request.ring.get_or_insert_default();
    for (name, value) in [("robot", &mut ring.robot), ("camera", &mut ring.camera)] {
        if let Some(given) = parameters.get(name) {
            given.clone_into(value);
        }
    }
    set_number(parameters, "radius", &mut ring.radius)?;
    set_number(parameters, "count", &mut ring.count)?;
    Ok(request)
}

fn forget_parameters(
    mut request: proto::ForgetRequest,
    parameters: &Parameters<'_>,
) -> Result<proto::ForgetRequest, Refusal> {
    if let Some([x, y, z, radius]) = numbers(parameters, "sphere")? {
        request.sphere = Some(proto::Sphere {
            center: vector([x, y, z]),
            radius,
        });
    }
    if let Some([x0, y0, z0, x1, y1, z1]) = numbers(parameters, "box")? {
        request.r#box = Some(proto::WorldBox {
            min: vector([x0, y0, z0]),
            max: vector([x1, y1, z1]),
        });
    }
    for name in ["since", "until"] {
        let Some(seconds) = number::<f64>(parameters, name)? else {
            continue;
        };
        let span = request.span.get_or_insert_default();
        let end = match name {
            "since" => &mut span.since,
            _ => &mut span.until,
        };
        if !seconds.is_finite() {
            return Err(bad(format!(
                "the parameter {name} must be finite: seconds since 1970"
            )));
        }
        // Saturates.
        *end = Some(encode::timestamp((seconds * 1e9).round() as i64));
    }
    match parameters.get("everything") {
        None | Some("false") => {}
        Some("true") => request.everything = true,
        Some(_) => return Err(bad("everything is true or false")),
    }
    Ok(request)
}
