//! Plain HTTP/1.1 to the service of a rig.

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
};

use crate::rig::{Rig, patient};

pub struct Page {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Page {
    pub fn json(&self) -> serde_json::Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }
}

/// `method` with its path; `head` are whole lines.
pub async fn send(rig: &Rig, method: &str, head: &[&str], body: &[u8]) -> Page {
    let mut stream = TcpStream::connect(rig.http).await.expect("connects");
    let mut request = format!("{method} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n");
    for line in head {
        request += &format!("{line}\r\n");
    }
    request += &format!("Content-Length: {}\r\n\r\n", body.len());
    stream.write_all(request.as_bytes()).await.expect("written");
    stream.write_all(body).await.expect("written");
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

pub async fn send_json(rig: &Rig, method: &str, body: serde_json::Value) -> Page {
    send(rig, method, &[], body.to_string().as_bytes()).await
}
