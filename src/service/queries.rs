//! Questions to the memory over Zenoh: `<root>/<place>/@memory/{prior|evaluate|views|status}`.
//!
//! The request travels in the payload, or, in simple cases, in the selector's parameters, so that a plain `get` works:
//! `prior?x=..;y=..;z=..;qx=..;qy=..;qz=..;qw=..;fx=..;fy=..;cx=..;cy=..;width=..;height=..;planes=expected,coverage`.
//! `planes` wins over the payload's; `format=json` asks for JSON; `robot=..;camera=..` lends an evaluated frame that
//! camera's calibration and visit. Status is always JSON.

use std::sync::{Arc, atomic::Ordering};

use tokio::sync::{Semaphore, mpsc, oneshot};
use zenoh::{
    Wait,
    bytes::Encoding,
    query::{Parameters, Query, Queryable},
};

use super::{
    ask::{Answer, Ask},
    camera::busy,
    inbox::ASKS_MAX,
    ingest::IngestCounters,
    places::{Place, Places},
};
use crate::{
    model::{camera::Intrinsics, frame::Source, pose::Pose, refusal::Refusal},
    wire::{
        decode::{self, Limits},
        encode::{self, PriorPlane},
        keys, proto,
    },
};

/// Queries being answered, beside those in the places' own queues.
const QUERIES_MAX: usize = 4 * ASKS_MAX;

const QUESTIONS: [&str; 4] = ["prior", "evaluate", "views", "status"];

/// Declares the queryable; dropping it ends it.
///
/// # Errors
/// What Zenoh says when the session is closing.
pub fn start(places: &Arc<Places>, counters: Arc<IngestCounters>) -> zenoh::Result<Queryable<()>> {
    let (sender, mut queries) = mpsc::channel::<Query>(QUERIES_MAX);
    let queryable = places
        .session
        .declare_queryable(keys::memory(&places.root, "*", "*"))
        .complete(true)
        .callback(move |query| {
            // Dropping a query ends it without a reply: replying is nothing for a callback.
            if sender.try_send(query).is_err() {
                counters.queries_dropped.fetch_add(1, Ordering::Relaxed);
            }
        })
        .wait()?;
    let places = places.clone();
    let permits = Arc::new(Semaphore::new(QUERIES_MAX));
    tokio::spawn(async move {
        while let Some(query) = queries.recv().await {
            let Ok(permit) = permits.clone().try_acquire_owned() else {
                reply_refusal(&query, &busy()).await;
                continue;
            };
            let places = places.clone();
            tokio::spawn(async move {
                answer(&places, &query).await;
                drop(permit);
            });
        }
    });
    Ok(queryable)
}

/// What goes back: bytes with their encoding.
struct Payload(Vec<u8>, Encoding);

/// A query may name one place or, by wildcards, many; and one question or many.
async fn answer(places: &Places, query: &Query) {
    let mut matched = false;
    for (name, place) in places.all() {
        for question in QUESTIONS {
            let key = keys::memory(&places.root, &name, question);
            let asked = zenoh::key_expr::KeyExpr::try_from(key.as_str())
                .is_ok_and(|key| query.key_expr().intersects(&key));
            if !asked {
                continue;
            }
            matched = true;
            match reply_to(question, &place, query, Limits::new(&places.settings)).await {
                Ok(Payload(bytes, encoding)) => {
                    if let Err(error) = query.reply(&key, bytes).encoding(encoding).await {
                        tracing::debug!("no reply on {key}: {error}");
                    }
                }
                Err(refusal) => reply_refusal(query, &refusal).await,
            }
        }
    }
    // Wildcards ask whoever is there; one name asks for that place.
    if !matched && !query.key_expr().is_wild() {
        let refusal = Refusal::new(
            "unknown_place",
            format!(
                "{} is unknown: a place begins with its first frame, and is asked for {}",
                query.key_expr(),
                QUESTIONS.join(", ")
            ),
        );
        reply_refusal(query, &refusal).await;
    }
}

async fn reply_refusal(query: &Query, refusal: &Refusal) {
    let text = format!("{}: {refusal}", refusal.code);
    if let Err(error) = query.reply_err(text).encoding(Encoding::TEXT_PLAIN).await {
        tracing::debug!("no reply: {error}");
    }
}

async fn reply_to(
    question: &str,
    place: &Place,
    query: &Query,
    limits: Limits,
) -> Result<Payload, Refusal> {
    let parameters = query.parameters();
    match question {
        "prior" => {
            let request = prior_request(query)?;
            let (world_from_camera, intrinsics) = camera_of(&request, limits)?;
            let planes = planes(&request.planes)?;
            let reply = ask(place, |answer| Ask::Prior {
                world_from_camera,
                intrinsics,
                planes,
                answer,
            });
            payload(&reply.await?, parameters)
        }
        "evaluate" => {
            let request: proto::EvaluateRequest = decode::message(&body(query, limits)?)?;
            let frame = request.frame.ok_or_else(|| {
                Refusal::new("no_image", "the request has no frame: fill `frame`")
            })?;
            let camera = match (parameters.get("robot"), parameters.get("camera")) {
                (Some(robot), Some(camera)) if keys::is_id(robot) && keys::is_id(camera) => {
                    Some(Source {
                        robot: robot.into(),
                        camera: camera.into(),
                    })
                }
                (None, None) => None,
                _ => {
                    return Err(Refusal::new(
                        "bad_request",
                        "give both robot and camera as [a-z0-9_-]+, or none",
                    ));
                }
            };
            let reply = ask(place, |answer| Ask::Evaluate {
                frame: Box::new(frame),
                camera,
                answer,
            });
            payload(&reply.await?, parameters)
        }
        "views" => payload(
            &ask(place, |answer| Ask::Views { answer }).await?,
            parameters,
        ),
        _ => {
            let status = place.status.borrow().clone();
            let json = serde_json::to_vec(&*status).map_err(|error| {
                Refusal::new("status", format!("the status cannot be written: {error}"))
            })?;
            Ok(Payload(json, Encoding::APPLICATION_JSON))
        }
    }
}

/// Puts an ask and waits for its answer.
///
/// # Errors
/// `busy`, or whatever the worker says.
pub async fn ask<T>(place: &Place, make: impl FnOnce(Answer<T>) -> Ask) -> Result<T, Refusal> {
    let (sender, answer) = oneshot::channel();
    let ask = make(sender);
    let kind = ask.kind();
    let answered = match place.inbox.put_ask(ask) {
        Err(_full) => Err(busy()),
        Ok(()) => answer
            .await
            .unwrap_or_else(|_| Err(Refusal::new("closing", "the service is stopping"))),
    };
    let outcome = answered
        .as_ref()
        .map_or_else(|refusal| refusal.code, |_| "ok");
    place.metrics.query(kind, outcome);
    answered
}

fn payload<M: encode::Named>(message: &M, parameters: &Parameters<'_>) -> Result<Payload, Refusal> {
    match parameters.get("format") {
        None | Some("protobuf") => Ok(Payload(encode::bytes(message), keys::encoding::<M>())),
        Some("json") => Ok(Payload(
            encode::json(message).to_string().into_bytes(),
            Encoding::APPLICATION_JSON,
        )),
        Some(_) => Err(Refusal::new(
            "bad_request",
            "format is json or protobuf, which is also what comes without it",
        )),
    }
}

fn body(query: &Query, limits: Limits) -> Result<Vec<u8>, Refusal> {
    let payload = query.payload().ok_or_else(|| {
        Refusal::new(
            "bad_request",
            "the request has no payload: send the message that proto/surprised/v1/query.proto names",
        )
    })?;
    if payload.len() > limits.message_bytes_max() {
        return Err(Refusal::new(
            "message_too_large",
            "the request is larger than image_pixels_max allows: send smaller or compressed pictures",
        ));
    }
    Ok(payload.to_bytes().into_owned())
}

/// From the payload, or from the parameters where there is none.
fn prior_request(query: &Query) -> Result<proto::PriorRequest, Refusal> {
    let parameters = query.parameters();
    let mut request: proto::PriorRequest = match query.payload() {
        Some(payload) if !payload.is_empty() => decode::message(&payload.to_bytes())?,
        _ => {
            let number = |name: &str| -> Result<f64, Refusal> {
                parameters
                    .get(name)
                    .and_then(|text| text.parse().ok())
                    .ok_or_else(|| {
                        Refusal::new(
                            "bad_request",
                            format!(
                                "the parameter {name} is missing or no number: send a PriorRequest, or x y z qx qy qz qw fx fy cx cy width height"
                            ),
                        )
                    })
            };
            proto::PriorRequest {
                world_from_camera: Some(proto::Pose {
                    position: Some(proto::Vector3 {
                        x: number("x")?,
                        y: number("y")?,
                        z: number("z")?,
                    }),
                    orientation: Some(proto::Quaternion {
                        x: number("qx")?,
                        y: number("qy")?,
                        z: number("qz")?,
                        w: number("qw")?,
                    }),
                }),
                intrinsics: Some(proto::Intrinsics {
                    // Saturates; sizes are checked with the rest.
                    width: number("width")? as u32,
                    height: number("height")? as u32,
                    fx: number("fx")?,
                    fy: number("fy")?,
                    cx: number("cx")?,
                    cy: number("cy")?,
                    ..proto::Intrinsics::default()
                }),
                planes: Vec::new(),
            }
        }
    };
    if let Some(planes) = parameters.get("planes") {
        request.planes = planes.split(',').map(str::to_owned).collect();
    }
    Ok(request)
}

fn camera_of(request: &proto::PriorRequest, limits: Limits) -> Result<(Pose, Intrinsics), Refusal> {
    let (Some(pose), Some(intrinsics)) = (&request.world_from_camera, &request.intrinsics) else {
        return Err(Refusal::new(
            "bad_request",
            "the request needs a pose and intrinsics: fill both",
        ));
    };
    let intrinsics = decode::intrinsics(intrinsics)?.intrinsics;
    if intrinsics.pixels() > limits.image_pixels_max {
        return Err(Refusal::new(
            "image_too_large",
            format!(
                "{} pixels are more than image_pixels_max = {}: ask for a smaller image",
                intrinsics.pixels(),
                limits.image_pixels_max
            ),
        ));
    }
    Ok((decode::pose(pose)?, intrinsics))
}

fn planes(names: &[String]) -> Result<Vec<PriorPlane>, Refusal> {
    if names.is_empty() {
        return Ok(vec![PriorPlane::Expected, PriorPlane::Coverage]);
    }
    names
        .iter()
        .map(|name| {
            PriorPlane::parse(name).ok_or_else(|| {
                Refusal::new(
                    "bad_request",
                    "a plane is unknown: ask for expected, uncertainty, coverage, depth or parameters",
                )
            })
        })
        .collect()
}
