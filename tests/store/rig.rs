//! Services that learn a place and store it: the real tasks on a runtime of their own, with small viewpoints.

// Every test takes the part it needs.
#![allow(dead_code)]

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use object_store::{ObjectStore, memory::InMemory, path::Path};
use surprised::{
    config::Settings,
    memory::{
        Memory,
        store::{PlaceOptions, PlaceStore, Role, Store},
    },
    model::{belief::Record, pose::Pose, viewpoint::Viewpoint},
    stages::select::select_nearest,
};
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::reference::{Random, scene};

/// Far beyond what anything here takes, also on a busy machine.
pub const DEADLINE: Duration = Duration::from_secs(60);
pub const PLACE: &str = "lab";
/// Between viewpoints that are new ones.
pub const STEP_M: f64 = 0.1;
const SIZE: (usize, usize) = (16, 12);

/// Where a suite's viewpoints are stored.
pub enum Backend {
    Folder(TempDir),
    Objects(Arc<dyn ObjectStore>, Path),
}

impl Backend {
    pub fn folder() -> Self {
        Self::Folder(TempDir::new().expect("a folder for tests"))
    }

    pub fn objects() -> Self {
        Self::Objects(Arc::new(InMemory::new()), Path::from("some/where"))
    }

    pub fn store(&self) -> Store {
        match self {
            Self::Folder(folder) => {
                Store::in_folder(folder.path().join("memory")).expect("a folder")
            }
            Self::Objects(objects, at) => Store::with_objects(objects.clone(), at.clone()),
        }
    }

    /// The objects themselves, to be looked at and damaged.
    pub fn objects_at(&self) -> (Arc<dyn ObjectStore>, Path) {
        match self {
            Self::Folder(folder) => {
                let root = folder.path().join("memory");
                let objects = object_store::local::LocalFileSystem::new_with_prefix(root);
                (
                    Arc::new(objects.expect("the folder is there")),
                    Path::default(),
                )
            }
            Self::Objects(objects, at) => (objects.clone(), at.clone()),
        }
    }
}

pub fn options() -> PlaceOptions {
    PlaceOptions {
        write_behind: Duration::from_millis(200),
        ..PlaceOptions::new(&Settings::robust())
    }
}

pub fn viewpoint_bytes() -> usize {
    any_viewpoint(0.0, 0).bytes()
}

pub fn at(x_m: f64) -> Pose {
    scene::pose([x_m, 0.0, 0.0], [0.0; 3])
}

/// Of noise that follows from the seed, which is its stamp as well.
pub fn any_viewpoint(x_m: f64, seed: u64) -> Viewpoint {
    let camera = scene::camera(SIZE.0, SIZE.1);
    let mut random = Random(seed);
    let records = (0..camera.pixels())
        .map(|_| {
            Record::pack(&scene::settled([
                random.uniform(0.0, 255.0) as f32,
                3.0,
                -4.0,
            ]))
        })
        .collect();
    let depth_m = (0..camera.pixels())
        .map(|_| random.uniform(1.0, 1.01) as f32)
        .collect();
    let mut viewpoint = scene::viewpoint(camera, &at(x_m), depth_m, records);
    viewpoint.stamp_ns = seed as i64;
    viewpoint
}

pub struct Service {
    runtime: Option<Runtime>,
    pub store: PlaceStore,
    pub memory: Memory,
    pub settings: Settings,
}

impl Service {
    pub fn start(store: &Store) -> Self {
        Self::with(store, PLACE, options())
    }

    pub fn with(store: &Store, place: &str, options: PlaceOptions) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .expect("a runtime");
        let settings = Settings {
            memory_bytes: options.memory_bytes,
            ..Settings::robust()
        };
        Self {
            store: PlaceStore::open(store, place, options, runtime.handle(), || {}),
            runtime: Some(runtime),
            memory: Memory::default(),
            settings,
        }
    }

    pub fn writer(store: &Store) -> Self {
        let mut service = Self::start(store);
        service.until("it writes the place", |service| {
            service.store.role() == Role::Writer
        });
        service
    }

    pub fn until(&mut self, what: &str, condition: impl Fn(&Self) -> bool) {
        let end = Instant::now() + DEADLINE;
        loop {
            self.store.sync(&mut self.memory);
            if condition(self) {
                return;
            }
            assert!(
                Instant::now() < end,
                "not in time: {what}; {:?}",
                self.store.status()
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// What a frame of noise at `x_m` does; the viewpoint's id.
    pub fn learn(&mut self, x_m: f64, seed: u64) -> u64 {
        self.store.may_learn().expect("it writes the place");
        self.store.bring(&mut self.memory, &at(x_m));
        let id = self.learn_in_ram(x_m, seed);
        self.store.sync(&mut self.memory);
        id
    }

    pub fn learn_in_ram(&mut self, x_m: f64, seed: u64) -> u64 {
        let views = self.memory.viewpoints().iter();
        let poses = views.map(|viewpoint| &viewpoint.world_from_camera);
        let selected = select_nearest(poses, &at(x_m), 1.0, 7, f64::INFINITY);
        let viewpoint = any_viewpoint(x_m, seed);
        let slot = self
            .memory
            .slot(&selected, &at(x_m), viewpoint.bytes(), &self.settings);
        self.memory.write(slot, viewpoint)
    }

    /// So many viewpoints in a row.
    pub fn learn_row(&mut self, count: usize) {
        for index in 0..count {
            self.learn(STEP_M * index as f64, index as u64);
        }
    }

    pub fn until_stored(&mut self) {
        self.until("everything is stored", |service| {
            service.store.status().pending == 0
        });
    }

    pub fn until_known(&mut self, count: usize) {
        self.until("everything is known", |service| {
            service.memory.known() == count
        });
    }

    /// Every viewpoint, loaded.
    pub fn content(&mut self) -> BTreeMap<u64, Viewpoint> {
        self.until("everything is loaded", |service| {
            service.memory.viewpoints().len() == service.memory.known()
        });
        let viewpoints = self.memory.viewpoints().iter();
        viewpoints
            .map(|viewpoint| (viewpoint.id, (**viewpoint).clone()))
            .collect()
    }

    /// As a service stops that is told to.
    pub fn stop(mut self) {
        assert!(
            self.store.close(&mut self.memory, DEADLINE),
            "everything could be stored"
        );
    }

    /// Its tasks are gone from one instant to the next.
    pub fn crash(mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(Duration::from_secs(5));
        }
    }
}
