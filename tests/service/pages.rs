//! HTTP: readiness, status, views, the camera's pictures, and problems as problem+json.

use surprised::wire::keys;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};

use crate::rig::{Rig, camera, next_report, patient, posed};

struct Page {
    status: u16,
    head: String,
    body: Vec<u8>,
}

impl Page {
    fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }
}

async fn get(rig: &Rig, path: &str) -> Page {
    let mut stream = TcpStream::connect(rig.http).await.expect("connects");
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.expect("written");
    let mut bytes = Vec::new();
    patient(stream.read_to_end(&mut bytes)).await.expect("read");
    let end = bytes
        .windows(4)
        .position(|four| four == b"\r\n\r\n")
        .expect("a head");
    let head = String::from_utf8_lossy(&bytes[..end]).to_ascii_lowercase();
    Page {
        status: head[9..12].parse().expect("a status"),
        body: bytes[end + 4..].to_vec(),
        head,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_show_what_the_service_knows() {
    let rig = Rig::start(&[]).await;
    assert_eq!(get(&rig, "/healthz").await.status, 200);
    assert_eq!(get(&rig, "/readyz").await.status, 200);
    let info = get(&rig, "/api/v1/info").await.json();
    assert_eq!(
        (&info["name"], &info["settings"]["views"]),
        (&"surprised".into(), &7.into())
    );
    assert_eq!(
        get(&rig, "/api/v1/places").await.json()["places"],
        serde_json::json!([])
    );

    let head = camera("lab", "anna");
    let reports = rig.subscribe(&head, keys::REPORT).await;
    rig.put_calibration(&head).await;
    rig.put(&head, keys::FRAME, &posed(&head, 1)).await;
    next_report(&reports).await;
    rig.status_when("lab", |status| status["frames"] == 1).await;

    assert_eq!(get(&rig, "/api/v1/places").await.json()["places"][0], "lab");
    let status = get(&rig, "/api/v1/places/lab").await.json();
    assert_eq!(
        (&status["frames"], &status["viewpoints"]),
        (&1.into(), &1.into())
    );
    let views = get(&rig, "/api/v1/places/lab/views").await.json();
    assert_eq!(views["views"][0]["camera"], "head");
    let path = "/api/v1/places/lab/robots/anna/head";
    assert_eq!(get(&rig, path).await.json()["report"]["sequence"], "1");
    for picture in ["frame", "expected", "surprise", "uncertainty"] {
        let page = get(&rig, &format!("{path}/{picture}.png")).await;
        assert!(
            page.head.contains("content-type: image/png"),
            "{}",
            page.head
        );
        let picture = image::load_from_memory(&page.body).expect("a png");
        assert_eq!((picture.width(), picture.height()), (64, 48));
    }
    for missing in [
        "/nowhere",
        "/api/v1/places/attic",
        "/api/v1/places/lab/robots/anna/foot",
        "/api/v1/places/lab/robots/anna/head/sound.png",
        "/api/v1/places/lab/robots/bert/head/frame.png",
    ] {
        let page = get(&rig, missing).await;
        assert_eq!(page.status, 404, "{missing}");
        assert!(
            page.head.contains("application/problem+json"),
            "{}",
            page.head
        );
        assert!(page.json()["detail"].is_string());
    }
    rig.stop().await.expect("a clean stop");
}
