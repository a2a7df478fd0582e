//! The page for people: files of this program, without a build step and without anything from elsewhere. They hold no
//! data: what they show comes from the API, with its token.

use axum::{Router, http::header, routing::get};

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";

macro_rules! asset {
    ($kind:expr, $name:literal) => {
        (
            concat!("/assets/", $name),
            $kind,
            include_str!(concat!("page/", $name)),
        )
    };
}

/// Path, content type and text.
const FILES: [(&str, &str, &str); 16] = [
    ("/", HTML, include_str!("page/index.html")),
    asset!(CSS, "app.css"),
    asset!(SVG, "icon.svg"),
    asset!(SCRIPT, "app.js"),
    asset!(SCRIPT, "camera.js"),
    asset!(SCRIPT, "dom.js"),
    asset!(SCRIPT, "events.js"),
    asset!(SCRIPT, "geometry.js"),
    asset!(SCRIPT, "map.js"),
    asset!(SCRIPT, "pictures.js"),
    asset!(SCRIPT, "robots.js"),
    asset!(SCRIPT, "service.js"),
    asset!(SCRIPT, "store.js"),
    asset!(SCRIPT, "timeline.js"),
    asset!(SCRIPT, "verdict.js"),
    asset!(SCRIPT, "words.js"),
];

/// `/` and what it is made of.
pub fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    FILES
        .into_iter()
        .fold(Router::new(), |router, (path, kind, text)| {
            let headers = [
                (header::CONTENT_TYPE, kind),
                // Another version of the service has another page.
                (header::CACHE_CONTROL, "no-cache"),
            ];
            router.route(path, get(move || async move { (headers, text) }))
        })
}
