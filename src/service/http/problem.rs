//! Errors as RFC 9457 has them.

use std::borrow::Cow;

use axum::{
    extract::rejection::{JsonRejection, PathRejection, QueryRejection},
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use utoipa::{IntoResponses, ToSchema};

use crate::model::refusal::Refusal;

pub const PROBLEM_JSON: &str = "application/problem+json";

#[derive(Debug)]
pub struct Problem {
    status: StatusCode,
    code: &'static str,
    detail: Cow<'static, str>,
}

/// As it goes out.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Problem)]
pub struct Document {
    /// Always about:blank: `code` says what it is.
    #[serde(rename = "type")]
    kind: &'static str,
    title: Option<&'static str>,
    status: u16,
    /// One word, for programs.
    code: &'static str,
    /// One sentence, for people: what is wrong and what to do.
    detail: Cow<'static, str>,
}

/// For the description: how it may end otherwise.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "described, not made")]
pub enum Refused {
    /// What is wrong with it, or no token
    #[response(status = "4XX", content_type = "application/problem+json")]
    Refused(Document),
}

/// For the description: how a question to a place may end otherwise.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "described, not made")]
pub enum Unanswered {
    /// What is wrong with it, or no token
    #[response(status = "4XX", content_type = "application/problem+json")]
    Refused(Document),
    /// Busy
    #[response(status = 503, content_type = "application/problem+json")]
    Busy(Document),
    /// Late
    #[response(status = 504, content_type = "application/problem+json")]
    Late(Document),
}

impl Problem {
    pub fn new(
        status: StatusCode,
        code: &'static str,
        detail: impl Into<Cow<'static, str>>,
    ) -> Self {
        Self {
            status,
            code,
            detail: detail.into(),
        }
    }

    pub fn not_found(detail: &'static str) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not_found", detail)
    }

    fn bad_request(detail: String) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad_request", detail)
    }

    /// Of a status that a layer gave without a word.
    pub fn of(status: StatusCode) -> Self {
        let (code, detail) = match status {
            StatusCode::PAYLOAD_TOO_LARGE => (
                "body_too_large",
                "the request's body is longer than a mebibyte: send less",
            ),
            StatusCode::GATEWAY_TIMEOUT => (
                "timeout",
                "no answer in time: is the camera still sending frames, or the place busy?",
            ),
            StatusCode::METHOD_NOT_ALLOWED => {
                ("method", "this path has other methods: see /openapi.json")
            }
            status if status.is_client_error() => ("bad_request", "the request cannot be read"),
            _ => ("internal", "this is a bug; the log says more"),
        };
        Self::new(status, code, detail)
    }
}

impl From<Refusal> for Problem {
    fn from(refusal: Refusal) -> Self {
        let status = match refusal.code {
            "busy" | "closing" | "memory_unread" => StatusCode::SERVICE_UNAVAILABLE,
            "late" => StatusCode::GATEWAY_TIMEOUT,
            "unknown_camera" | "unknown_place" => StatusCode::NOT_FOUND,
            "message_too_large" => StatusCode::PAYLOAD_TOO_LARGE,
            "media_type" => StatusCode::UNSUPPORTED_MEDIA_TYPE,
            _ => StatusCode::BAD_REQUEST,
        };
        Self::new(status, refusal.code, refusal.detail)
    }
}

impl From<PathRejection> for Problem {
    fn from(rejection: PathRejection) -> Self {
        Self::bad_request(rejection.body_text())
    }
}

impl From<QueryRejection> for Problem {
    fn from(rejection: QueryRejection) -> Self {
        Self::bad_request(rejection.body_text())
    }
}

impl From<JsonRejection> for Problem {
    fn from(rejection: JsonRejection) -> Self {
        match rejection.status() {
            status @ StatusCode::PAYLOAD_TOO_LARGE => Self::of(status),
            status @ StatusCode::UNSUPPORTED_MEDIA_TYPE => Self::new(
                status,
                "media_type",
                "send JSON, with the header Content-Type: application/json",
            ),
            _ => Self::bad_request(rejection.body_text()),
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let document = Document {
            kind: "about:blank",
            title: self.status.canonical_reason(),
            status: self.status.as_u16(),
            code: self.code,
            detail: self.detail,
        };
        let body = serde_json::to_string(&document).expect("problems map to JSON");
        let headers = [(header::CONTENT_TYPE, PROBLEM_JSON)];
        (self.status, headers, body).into_response()
    }
}
