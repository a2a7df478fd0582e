//! Who writes a place in a folder, however several services come to it: one, until it stops or is gone.

use std::{
    fs::File,
    path::Path,
    sync::Barrier,
    time::{Duration, Instant},
};

use surprised::memory::store::{Role, Store};

use super::rig::{Backend, PLACE, Service, options};

/// New ones, each of which two services open at the same time.
const PLACES: usize = 24;
/// Several looks at a lease.
const WATCHED: Duration = Duration::from_secs(4);

fn name(place: usize) -> String {
    format!("place{place}")
}

fn writes(service: &Service) -> bool {
    service.store.role() == Role::Writer
}

fn reads(service: &Service) -> bool {
    matches!(service.store.role(), Role::Reader { .. })
}

/// Services of all places, each started at the same time as another one's.
fn start_all(store: &Store, both: &Barrier) -> Vec<Service> {
    let places = (0..PLACES).map(|place| {
        both.wait();
        Service::with(store, &name(place), options())
    });
    places.collect()
}

#[test]
fn of_two_services_that_open_a_new_place_at_once_one_writes_it_and_stays() {
    let backend = Backend::folder();
    let both = Barrier::new(2);
    let (mut ours, mut theirs) = std::thread::scope(|scope| {
        let theirs = scope.spawn(|| start_all(&backend.store(), &both));
        let ours = start_all(&backend.store(), &both);
        (ours, theirs.join().expect("they start"))
    });
    // Who has written each place so far.
    let mut wrote = [[false; 2]; PLACES];
    let began = Instant::now();
    while began.elapsed() < WATCHED {
        for (place, wrote) in wrote.iter_mut().enumerate() {
            for (service, wrote) in [&mut ours[place], &mut theirs[place]]
                .into_iter()
                .zip(wrote)
            {
                service.store.sync(&mut service.memory);
                if !*wrote && writes(service) {
                    *wrote = true;
                    service.learn(0.0, place as u64);
                }
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let mut left = Vec::new();
    for (place, (ours, theirs)) in ours.into_iter().zip(theirs).enumerate() {
        let status = [&ours, &theirs].map(|service| service.store.status());
        let told = format!("place {place}: {:?}, {status:?}", wrote[place]);
        assert!(wrote[place][0] != wrote[place][1], "{told}");
        assert!(status.iter().all(|status| status.lost == 0), "{told}");
        assert!(status.iter().all(|status| status.epoch <= 1), "{told}");
        let (writer, reader) = if wrote[place][0] {
            (ours, theirs)
        } else {
            (theirs, ours)
        };
        assert!(writes(&writer) && reads(&reader), "{told}");
        writer.stop();
        left.push(reader);
    }
    for mut service in left {
        service.until("it has taken over", |service| {
            writes(service) && service.memory.known() == 1
        });
        service.stop();
    }
}

/// As the process does that writes the place, or is about to.
fn lock(place: &Path) -> File {
    std::fs::create_dir_all(place).expect("a folder");
    let file = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(place.join("lock"))
        .expect("a file");
    file.try_lock().expect("nobody has locked it");
    file
}

fn watch(service: &mut Service, condition: impl Fn(&Service) -> bool) {
    let began = Instant::now();
    while began.elapsed() < WATCHED {
        service.store.sync(&mut service.memory);
        assert!(condition(service), "{:?}", service.store.status());
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn nobody_takes_a_place_that_another_one_has_locked_and_is_about_to_take() {
    let backend = Backend::folder();
    let store = backend.store();
    let Backend::Folder(folder) = &backend else {
        unreachable!("it is one");
    };
    let place = folder.path().join("memory").join(PLACE);
    // A new place, and one whose last writer has stopped.
    for epoch in 1..=2 {
        let file = lock(&place);
        let mut service = Service::start(&store);
        service.until("it reads", |service| service.store.role() != Role::Unread);
        watch(&mut service, reads);
        drop(file);
        service.until("it writes the place", writes);
        assert_eq!(service.store.status().epoch, epoch);
        service.stop();
    }
}

#[test]
fn who_has_taken_over_from_a_process_that_hangs_stays_when_that_goes_on() {
    let backend = Backend::folder();
    let Backend::Folder(folder) = &backend else {
        unreachable!("it is one");
    };
    let place = folder.path().join("memory").join(PLACE);
    let hanging = lock(&place);
    let content = r#"{"holder":"a process that hangs","beat":3,"released":false,"locked":true}"#;
    std::fs::create_dir_all(place.join("lease")).expect("a folder");
    std::fs::write(place.join("lease/0000000000000001"), content).expect("written");

    let mut second = Service::writer(&backend.store());
    second.learn(0.0, 1);
    let mut third = Service::start(&backend.store());
    third.until("it reads", reads);
    // It finds that it has lost the place.
    drop(hanging);
    watch(&mut third, reads);
    assert!(writes(&second), "{:?}", second.store.status());
    second.until_stored();
    // It has locked the place meanwhile: nobody need wait for its lease to expire.
    second.crash();
    let gone = Instant::now();
    third.until("it has taken over", |service| {
        writes(service) && service.memory.known() == 1
    });
    assert!(gone.elapsed() < Duration::from_secs(4), "it waited");
    third.stop();
}
