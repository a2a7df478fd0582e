//! Size and speed of stored viewpoints beside others that could have been, on viewpoints that a pipeline learnt from real
//! recordings: `cargo bench --bench store -- FOLDER...`, each a recording in TUM RGB-D layout.
//!
//! `10000@FOLDER=PLACES` makes a place of so many viewpoints of a recording instead, in a row of 3 cm steps, in the folder
//! PLACES (8 GB for 10,000), for `benches/large_place.py`, which walks a robot through it.
//!
//! Measured with an earlier program of the same transforms on two cores of a shared machine, 320x240 pixels of 2.76 MB
//! raw (32 bytes of belief and 4 of depth a pixel), milliseconds a viewpoint:
//!
//! ```text
//!                                       revisit (32 views)           kitchen (6 views)
//!                                       size    write   read         size    write   read
//! as it lies, lz4                       55.3 %   7.0                 31.4 %   3.0
//! as it lies, zstd 1                    44.4 %  11.9                 23.7 %   5.3
//! planes, bytes apart, lz4              38.4 %  12.6     5.5         26.3 %  12.8     9.5
//! planes, bytes apart, zstd 1           34.1 %  10.2     6.6         22.1 %   6.5     1.9
//! differences, bytes apart, lz4         36.8 %  12.2     5.4         25.7 %   5.4     3.2
//! differences, bytes apart, zstd 1      31.2 %  14.5     5.2         21.0 %   6.5     2.2     chosen
//! differences, bytes apart, zstd 3      30.7 %  16.9     3.9         20.5 %  12.8     2.6
//! ```
//!
//! Since then the table of what came before has 2^12 entries, bytes are taken apart eight records at once, and the
//! working memory is kept: sizes are 31.3 and 21.0 %. On viewpoints of `end_to_end.py` (two sets, of which the smaller
//! table makes 2.5 and 0.8 % more bytes), beside builds, least time of a thread: packed in 5.3 -> 3.9 ms, unpacked in
//! 3.8 -> 2.8.
//!
//! Differences to the left neighbour, small ones of either sign as small numbers, do as well as those to a plane through
//! three neighbours (32.9 %, three times as long). Level 3 of zstd takes twice the time for two percent. The checksum
//! takes 0.3 ms.

use std::{
    cell::RefCell,
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use surprised::{
    config::Settings,
    dataset::Recording,
    memory::{
        Memory, Slot, Version,
        store::{
            PlaceOptions, PlaceStore, Store,
            form::{self, Encoder, Label},
        },
    },
    model::{belief::Record, frame::Source, pose::Pose, viewpoint::Viewpoint},
    pipeline::Pipeline,
};

/// Frames of a recording that are learnt.
const FRAMES_MAX: usize = 60;
const REPETITIONS: usize = 3;

fn main() {
    // Cargo adds options of its own.
    let words = std::env::args()
        .skip(1)
        .filter(|word| !word.starts_with("--"));
    for folder in words {
        if let Some((count, folders)) = folder.split_once('@') {
            let (folder, places) = folders.split_once('=').expect("COUNT@FOLDER=PLACES");
            let viewpoints = learn(Path::new(folder));
            make_large_place(
                &viewpoints,
                count.parse().expect("a number"),
                Path::new(places),
            );
            continue;
        }
        let viewpoints = learn(Path::new(&folder));
        println!("{folder}: {} viewpoints", viewpoints.len());
        println!("{:36} {:>7} {:>9} {:>9}", "", "size", "write ms", "read ms");
        for (name, compress, decompress) in others() {
            table(name, &viewpoints, |viewpoint| {
                let raw = raw(viewpoint);
                let began = Instant::now();
                let packed = compress(&raw);
                let write_s = began.elapsed().as_secs_f64();
                let began = Instant::now();
                assert_eq!(decompress(&packed, raw.len()).len(), raw.len());
                (packed.len(), write_s, began.elapsed().as_secs_f64())
            });
        }
        let encoder = RefCell::new(Encoder::default());
        table("the stored form, whole", &viewpoints, |viewpoint| {
            let label = Label {
                place: "bench".to_owned(),
                version: Version::default(),
                settings_hash: 0,
            };
            let began = Instant::now();
            let object = encoder.borrow_mut().encode(&label, viewpoint);
            let write_s = began.elapsed().as_secs_f64();
            let began = Instant::now();
            let (_, read) = form::decode(&object, usize::MAX).expect("it was just made");
            let read_s = began.elapsed().as_secs_f64();
            assert!(read == *viewpoint, "it is read as it was");
            (object.len(), write_s, read_s)
        });
    }
}

/// Stores so many viewpoints along a way, as place `row`.
fn make_large_place(viewpoints: &[Arc<Viewpoint>], count: usize, places: &Path) {
    const STEP_M: f64 = 0.03;
    let settings = Settings {
        memory_bytes: 256 << 20,
        ..Settings::robust()
    };
    let store = Store::in_folder(places.to_owned()).expect("a folder");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let options = PlaceOptions::new(&settings);
    let place = PlaceStore::open(&store, "row", options, runtime.handle(), || {});
    let mut memory = Memory::default();
    while place.may_learn().is_err() {
        place.wait_read(Duration::from_millis(20));
    }
    place.sync(&mut memory);
    let began = Instant::now();
    for index in 0..count {
        let mut viewpoint = (*viewpoints[index % viewpoints.len()]).clone();
        viewpoint.world_from_camera = Pose::translation(STEP_M * index as f64, 0.0, 0.0);
        viewpoint.world_from_home = viewpoint.world_from_camera;
        memory.begin_turn();
        memory.write(Slot::Append, viewpoint);
        place.sync(&mut memory);
        while memory.bytes() > settings.memory_bytes / 2 && place.status().pending > 64 {
            std::thread::sleep(Duration::from_millis(5));
            place.sync(&mut memory);
        }
    }
    assert!(
        place.close(&mut memory, Duration::from_secs(600)),
        "all is stored"
    );
    println!(
        "{count} viewpoints stored in {:.0} s, {:.0} MB on disk",
        began.elapsed().as_secs_f64(),
        place.status().stored_bytes as f64 / 1e6
    );
}

fn learn(folder: &Path) -> Vec<Arc<Viewpoint>> {
    let recording = Recording::open(folder).expect("a recording");
    let pool = rayon::ThreadPoolBuilder::new().build().expect("threads");
    let mut pipeline = Pipeline::new(Settings::robust(), Arc::new(pool));
    let source = Source {
        robot: "bench".into(),
        camera: "camera".into(),
    };
    for index in 0..recording.entries.len().min(FRAMES_MAX) {
        let frame = recording.frame(index, &source).expect("a frame");
        pipeline.process(&frame).expect("a good frame");
    }
    pipeline.memory().viewpoints().to_vec()
}

fn raw(viewpoint: &Viewpoint) -> Vec<u8> {
    let mut raw = bytemuck::cast_slice::<Record, u8>(&viewpoint.records).to_vec();
    raw.extend_from_slice(bytemuck::cast_slice(&viewpoint.mesh.depth_m));
    raw
}

type Other = (
    &'static str,
    fn(&[u8]) -> Vec<u8>,
    fn(&[u8], usize) -> Vec<u8>,
);

fn others() -> [Other; 3] {
    [
        ("as it lies", |raw| raw.to_vec(), |raw, _| raw.to_vec()),
        (
            "as it lies, lz4",
            lz4_flex::block::compress,
            |packed, size| lz4_flex::block::decompress(packed, size).expect("it was just packed"),
        ),
        (
            "as it lies, zstd 1",
            |raw| zstd::bulk::compress(raw, 1).expect("memory to memory"),
            |packed, size| zstd::bulk::decompress(packed, size).expect("it was just packed"),
        ),
    ]
}

/// The least time of a few, in the mean over the viewpoints.
fn table(
    name: &str,
    viewpoints: &[Arc<Viewpoint>],
    measure: impl Fn(&Viewpoint) -> (usize, f64, f64),
) {
    let (mut size, mut raw_size, mut write_s, mut read_s) = (0, 0, 0.0, 0.0);
    for viewpoint in viewpoints {
        let mut least = (0, f64::INFINITY, f64::INFINITY);
        for _ in 0..REPETITIONS {
            let (size, write_s, read_s) = measure(viewpoint);
            least = (size, write_s.min(least.1), read_s.min(least.2));
        }
        size += least.0;
        raw_size += raw(viewpoint).len();
        write_s += least.1;
        read_s += least.2;
    }
    let count = viewpoints.len() as f64;
    println!(
        "{name:36} {:6.1} % {:9.2} {:9.2}",
        100.0 * size as f64 / raw_size as f64,
        1e3 * write_s / count,
        1e3 * read_s / count
    );
}
