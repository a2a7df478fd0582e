//! Ten thousand random or mutated messages: no panic, no growth, and an honest robot is served as before.

use surprised::{
    config::Settings,
    wire::{
        decode::{self, Limits, PicturedDepth},
        encode, keys, proto,
    },
};

use crate::{
    rig::{ROOT, Rig, calibration, camera, next_report, posed},
    rigs::rig_frame,
};

const MESSAGES: usize = 10_000;

/// Deterministic noise: splitmix64.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }

    /// A message with some bytes changed, cut, doubled, or none of it left.
    fn mutated(&mut self, mut bytes: Vec<u8>) -> Vec<u8> {
        match self.below(8) {
            0 => (0..self.below(200)).map(|_| self.next() as u8).collect(),
            1 => {
                bytes.truncate(self.below(bytes.len()));
                bytes
            }
            2 => {
                let from = self.below(bytes.len());
                bytes.extend_from_within(from..);
                bytes
            }
            _ => {
                // Mostly in the head, where the fields are.
                for _ in 0..=self.below(4) {
                    let end = if self.below(2) == 0 {
                        bytes.len()
                    } else {
                        bytes.len().min(120)
                    };
                    let at = self.below(end);
                    bytes[at] = self.next() as u8;
                }
                bytes
            }
        }
    }
}

/// Small frames in every encoding, with everything in them that a frame can carry.
fn seeds() -> Vec<Vec<u8>> {
    let head = camera("lab", "mallory");
    let good = proto::Frame {
        calibration: Some(calibration()),
        pose_position_sd: 0.01,
        ..posed(&head, 1)
    };
    let encodings: [(&str, image::ImageFormat); 2] = [
        ("jpeg", image::ImageFormat::Jpeg),
        ("png", image::ImageFormat::Png),
    ];
    let mut seeds = vec![encode::bytes(&good), encode::bytes(&rig_frame(&head, 1))];
    for (encoding, format) in encodings {
        let rgb = good.image.clone().expect("an image");
        let picture =
            image::RgbImage::from_raw(rgb.width, rgb.height, rgb.data).expect("sizes agree");
        let mut data = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut data, format).expect("in memory");
        let mut frame = good.clone();
        frame.image = Some(proto::Image {
            encoding: encoding.to_owned(),
            width: rgb.width,
            height: rgb.height,
            step: 0,
            data: data.into_inner(),
        });
        let mut depth = std::io::Cursor::new(Vec::new());
        image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(
            rgb.width,
            rgb.height,
            image::Luma([2000]),
        )
        .write_to(&mut depth, image::ImageFormat::Png)
        .expect("in memory");
        frame.depth = Some(proto::Image {
            encoding: "png".to_owned(),
            data: depth.into_inner(),
            ..proto::Image::default()
        });
        seeds.push(encode::bytes(&frame));
    }
    seeds
}

#[test]
fn decoding_nonsense_gives_a_refusal_or_a_sane_frame() {
    let limits = Limits::new(&Settings::robust());
    let seeds = seeds();
    let mut noise = Noise(1);
    let (mut frames, mut refused) = (0, 0);
    for index in 0..MESSAGES {
        let bytes = noise.mutated(seeds[index % seeds.len()].clone());
        let decoded = decode::message::<proto::Frame>(&bytes)
            .and_then(decode::frame)
            .and_then(|frame| frame.pictures(limits).map(|pictures| (frame, pictures)));
        match decoded {
            Ok((frame, pictures)) => {
                frames += 1;
                let pixels = pictures.image.width * pictures.image.height;
                assert_eq!(pictures.image.data.len(), 3 * pixels);
                match pictures.depth {
                    PicturedDepth::Given(depth_m) => {
                        assert_eq!(depth_m.len(), pixels);
                        assert!(depth_m.iter().all(|z| z.is_finite() && *z >= 0.0));
                    }
                    PicturedDepth::Sides { left, right } => {
                        for side in [left, right] {
                            assert_eq!(side.data.len(), side.width * side.height);
                        }
                    }
                }
                if let Some(pose) = frame.world_from_camera {
                    assert!((pose.rotation.norm() - 1.0).abs() < 1e-6);
                }
            }
            Err(refusal) => {
                refused += 1;
                assert!(!refusal.detail.is_empty());
            }
        }
        // The other messages share most of the checks.
        drop(decode::pose_sample(&bytes));
        drop(decode::markers_sample(&bytes));
        drop(
            decode::message(&bytes)
                .and_then(|message: proto::Calibration| decode::calibration(&message)),
        );
    }
    assert!(
        frames > 100 && refused > 100,
        "{frames} frames, {refused} refused"
    );
}

fn resident_bytes() -> usize {
    let pages = std::fs::read_to_string("/proc/self/statm").expect("Linux tells");
    let resident = pages.split(' ').nth(1).and_then(|text| text.parse().ok());
    4096 * resident.unwrap_or(0usize)
}

#[tokio::test(flavor = "multi_thread")]
async fn ten_thousand_messages_of_nonsense_harm_nobody() {
    let rig = Rig::start(&["pose_wait_s=0", "memory_bytes=2000000"]).await;
    let honest = camera("lab", "anna");
    let reports = rig.subscribe(&honest, keys::REPORT).await;
    rig.put_calibration(&honest).await;
    rig.put(&honest, keys::FRAME, &posed(&honest, 1)).await;
    next_report(&reports).await;

    let seeds = seeds();
    let mut noise = Noise(2);
    let mut settled = 0;
    for index in 0..MESSAGES {
        let leaf = [
            keys::FRAME,
            keys::FRAME,
            keys::POSE,
            keys::MARKERS,
            keys::CALIBRATION,
        ][noise.below(5)];
        // Robots and places as many as names allow, and names that are none.
        let key = match noise.below(10) {
            0 => format!("{ROOT}/p{}/r/c/{leaf}", noise.below(1000)),
            1 => format!("{ROOT}/lab/r{}/c/{leaf}", noise.below(1000)),
            2 => format!("{ROOT}/LAB/Ä{}/c/{leaf}", noise.below(1000)),
            _ => format!("{ROOT}/lab/mallory/head/{leaf}"),
        };
        let encoding = match (noise.below(10), leaf) {
            (0, _) => zenoh::bytes::Encoding::TEXT_PLAIN,
            (_, keys::POSE) => keys::encoding::<proto::PoseSample>(),
            (_, keys::MARKERS) => keys::encoding::<proto::Markers>(),
            (_, keys::CALIBRATION) => keys::encoding::<proto::Calibration>(),
            _ => keys::encoding::<proto::Frame>(),
        };
        let seed = seeds[noise.below(seeds.len())].clone();
        rig.session
            .put(key, noise.mutated(seed))
            .encoding(encoding)
            .congestion_control(zenoh::qos::CongestionControl::Block)
            .await
            .expect("put");
        if index == MESSAGES / 2 {
            rig.status("lab").await;
            settled = resident_bytes();
        }
        if index % 1000 == 999 {
            let sequence = 2 + index as u64 / 1000;
            rig.put(&honest, keys::FRAME, &posed(&honest, sequence))
                .await;
            assert_eq!(next_report(&reports).await.sequence, sequence);
        }
    }
    let status = rig.status("lab").await;
    assert!(status["cameras"].as_array().expect("a list").len() <= 64);
    assert!(
        status["memory_bytes"].as_u64() <= Some(2_000_000),
        "{status}"
    );
    let honest = status["cameras"]
        .as_array()
        .expect("a list")
        .iter()
        .find(|camera| camera["robot"] == "anna")
        .expect("it is known");
    assert_eq!(honest["refused"], serde_json::json!({}));
    let grown = resident_bytes().saturating_sub(settled);
    assert!(
        grown < 64 << 20,
        "grown by {grown} bytes in the second half"
    );
    rig.stop().await.expect("no worker failed");
}
