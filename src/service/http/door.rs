//! The door: the token or its cookie, names that lead here by a trick, and the headers that keep a browser from doing
//! more than the page needs.

use std::{fmt::Write, net::IpAddr, sync::Arc};

use axum::{
    extract::{Request, State},
    http::{HeaderMap, HeaderValue, Method, StatusCode, header},
    middleware::Next,
    response::{IntoResponse, Response},
};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{
    extract::Json,
    problem::{PROBLEM_JSON, Problem},
};
use crate::service::{
    access::{HttpAccess, Token},
    metrics::Metrics,
};

pub const COOKIE: &str = "surprised_session";

/// Everything the page is made of comes from here, and it talks to nobody else.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

#[derive(Debug)]
pub struct Door {
    access: HttpAccess,
    /// What a browser that brought the token has in its cookie while this process lives.
    session: Token,
    metrics: Arc<Metrics>,
}

impl Door {
    /// # Errors
    /// The system has no random numbers.
    pub fn new(access: HttpAccess, metrics: Arc<Metrics>) -> std::io::Result<Self> {
        let mut random = [0u8; 32];
        getrandom::fill(&mut random).map_err(std::io::Error::other)?;
        let session = random.iter().fold(String::new(), |mut hex, byte| {
            write!(hex, "{byte:02x}").expect("writing to memory does not fail");
            hex
        });
        Ok(Self {
            access,
            session: Token::new(&session).expect("hexadecimal digits are a token"),
            metrics,
        })
    }

    fn lets_in(&self, headers: &HeaderMap) -> bool {
        let Some(token) = &self.access.token else {
            return true;
        };
        let brought = headers
            .get(header::AUTHORIZATION)
            .and_then(|value| value.to_str().ok())
            .and_then(|value| value.split_once(' '))
            .filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"))
            .is_some_and(|(_, brought)| token.is(brought.trim()));
        brought || self.is_signed_in(headers)
    }

    fn is_signed_in(&self, headers: &HeaderMap) -> bool {
        headers
            .get_all(header::COOKIE)
            .iter()
            .filter_map(|value| value.to_str().ok())
            .flat_map(|value| value.split(';'))
            .filter_map(|pair| pair.trim().split_once('='))
            .any(|(name, value)| name == COOKIE && self.session.is(value))
    }

    /// Without a token nothing but the browser stands between other sites' pages and what changes something here: it sends
    /// such requests for them, and says where they are from. With one there is a cookie that it does not send for others.
    fn is_for_another_site(&self, method: &Method, headers: &HeaderMap) -> bool {
        if self.access.token.is_some() || method.is_safe() {
            return false;
        }
        if let Some(site) = headers.get("sec-fetch-site") {
            return site != "same-origin" && site != "none";
        }
        // Programs send no origin.
        let Some(origin) = headers.get(header::ORIGIN) else {
            return false;
        };
        let origin = origin
            .to_str()
            .ok()
            .and_then(|origin| origin.split_once("://"));
        let host = headers
            .get(header::HOST)
            .and_then(|host| host.to_str().ok());
        match (origin, host) {
            (Some((_, from)), Some(host)) => !from.eq_ignore_ascii_case(host),
            _ => true,
        }
    }

    /// Without a token whoever is on this machine may come in, but not pages of other sites whose name was made to lead
    /// here (DNS rebinding).
    fn knows_host(&self, headers: &HeaderMap) -> bool {
        if self.access.token.is_some() || self.access.open {
            return true;
        }
        // Browsers always send it.
        let Some(host) = headers.get(header::HOST) else {
            return true;
        };
        host.to_str().is_ok_and(is_here)
    }
}

/// `localhost` or a number, with a port or without.
fn is_here(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    let bare = name.trim_start_matches('[').trim_end_matches(']');
    let name = name.to_ascii_lowercase();
    name == "localhost" || name.ends_with(".localhost") || bare.parse::<IpAddr>().is_ok()
}

/// For every request.
pub async fn guard(State(door): State<Arc<Door>>, request: Request, next: Next) -> Response {
    let mut response = if door.is_for_another_site(request.method(), request.headers()) {
        Problem::new(
            StatusCode::FORBIDDEN,
            "origin",
            "a page of another site asked for this: only this service's own page may change something from a browser",
        )
        .into_response()
    } else if door.knows_host(request.headers()) {
        next.run(request).await
    } else {
        Problem::new(
            StatusCode::FORBIDDEN,
            "host",
            "this name does not belong to this service: use its address or localhost",
        )
        .into_response()
    };
    let status = response.status();
    let is_problem = response
        .headers()
        .get(header::CONTENT_TYPE)
        .is_some_and(|kind| kind == PROBLEM_JSON);
    // Layers below answer in plain words or not at all.
    if (status.is_client_error() || status.is_server_error()) && !is_problem {
        let allow = response.headers_mut().remove(header::ALLOW);
        response = Problem::of(status).into_response();
        if let Some(allow) = allow {
            response.headers_mut().insert(header::ALLOW, allow);
        }
    }
    door.metrics.response(status.as_u16());
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, CONTENT_SECURITY_POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    for (name, value) in [
        ("cross-origin-opener-policy", "same-origin"),
        ("cross-origin-resource-policy", "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers
        .entry(header::CACHE_CONTROL)
        .or_insert(HeaderValue::from_static("no-store"));
    response
}

/// For what only those may have who brought the token.
pub async fn token(State(door): State<Arc<Door>>, request: Request, next: Next) -> Response {
    if door.lets_in(request.headers()) {
        return next.run(request).await;
    }
    door.metrics.unauthorized.inc();
    let problem = unauthorized("send the header Authorization: Bearer and the token, or sign in");
    let scheme = [(header::WWW_AUTHENTICATE, "Bearer")];
    (scheme, problem).into_response()
}

fn unauthorized(detail: &'static str) -> Problem {
    Problem::new(StatusCode::UNAUTHORIZED, "unauthorized", detail)
}

#[derive(Debug, Serialize, ToSchema)]
pub struct Session {
    /// Whether a token is needed at all.
    required: bool,
    /// Whether this request has what is needed.
    signed_in: bool,
}

#[derive(Deserialize, ToSchema)]
pub struct SignIn {
    token: String,
}

/// Whether a token is needed, and whether it is there
#[utoipa::path(get, path = "/api/v1/session", tag = "session", security(()),
    responses((status = 200, body = Session)))]
pub async fn session(State(door): State<Arc<Door>>, headers: HeaderMap) -> axum::Json<Session> {
    axum::Json(Session {
        required: door.access.token.is_some(),
        signed_in: door.lets_in(&headers),
    })
}

/// Gives a browser a cookie for the token
#[utoipa::path(post, path = "/api/v1/session", tag = "session", security(()),
    request_body = SignIn,
    responses(
        (status = 204, description = "The cookie is set; also where no token is needed"),
        super::problem::Refused,
    ))]
pub async fn sign_in(
    State(door): State<Arc<Door>>,
    Json(SignIn { token }): Json<SignIn>,
) -> Result<Response, Problem> {
    if door
        .access
        .token
        .as_ref()
        .is_some_and(|own| !own.is(&token))
    {
        door.metrics.unauthorized.inc();
        return Err(unauthorized("this is not the token"));
    }
    Ok(cookie(door.session.value(), ""))
}

/// Takes the cookie away
#[utoipa::path(delete, path = "/api/v1/session", tag = "session", security(()),
    responses((status = 204, description = "The cookie is gone")))]
pub async fn sign_out() -> Response {
    cookie("", "; Max-Age=0")
}

fn cookie(value: &str, more: &str) -> Response {
    let cookie = format!("{COOKIE}={value}; Path=/; HttpOnly; SameSite=Strict{more}");
    (StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]).into_response()
}

#[cfg(test)]
mod tests {
    use super::is_here;

    #[test]
    fn only_numbers_and_localhost_are_here() {
        for host in [
            "localhost",
            "localhost:8080",
            "LOCALHOST",
            "fleet.localhost:1",
            "127.0.0.1:8080",
            "[::1]:8080",
            "[::1]",
            "192.0.2.7",
        ] {
            assert!(is_here(host), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:8080",
            "localhost.evil.example",
            "",
            "127.0.0.1.evil.example:80",
        ] {
            assert!(!is_here(host), "{host}");
        }
    }
}
