//! A process that learns may be killed at any instant: what was learnt up to `write_behind` before is there, nothing is
//! torn, and the next one goes on.
//!
//! This file is its own child: with `CHILD` set it learns in that folder until it is killed, and prints what it has
//! learnt and when.

mod reference;

#[path = "store/rig.rs"]
mod rig;

use std::{
    collections::BTreeMap,
    env,
    io::{BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

use libtest_mimic::{Arguments, Failed, Trial};
use reference::Random;
use rig::{PLACE, STEP_M, Service, any_viewpoint};
use surprised::memory::store::{PlaceOptions, Role, Store};
use tempfile::TempDir;

const CHILD: &str = "SURPRISED_KILLS_CHILD";
const SEED: &str = "SURPRISED_KILLS_SEED";
const WRITE_BEHIND: Duration = Duration::from_secs(1);
const KILLS: usize = 200;
/// Places that are killed at the same time: most of it is waiting.
const LANES: usize = 4;
const LIFE_MAX: Duration = Duration::from_millis(2000);
/// Where the viewpoints are; each is written again every so often.
const POSES: usize = 30;

fn main() {
    if let Some(folder) = env::var_os(CHILD) {
        learn_until_killed(&PathBuf::from(folder));
    }
    let trial = Trial::test(
        "killed_at_200_random_instants_it_loses_no_more_than_it_says",
        || {
            let lanes = (0..LANES).map(|lane| std::thread::spawn(move || kill_often(lane)));
            let lanes: Vec<_> = lanes.collect();
            for lane in lanes {
                lane.join().map_err(|_| Failed::from("see above"))?;
            }
            Ok(())
        },
    );
    libtest_mimic::run(&Arguments::from_args(), vec![trial]).exit();
}

/// Nanoseconds on a clock that all processes share.
fn monotonic_ns() -> u64 {
    let mut now = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: the pointer is to a timespec of our own.
    let result = unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &mut now) };
    assert_eq!(result, 0, "there is a monotonic clock");
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

fn service(folder: &Path) -> Service {
    let store = Store::in_folder(folder.to_owned()).expect("a folder");
    let options = PlaceOptions {
        write_behind: WRITE_BEHIND,
        ..rig::options()
    };
    let mut service = Service::with(&store, PLACE, options);
    service.until("it writes the place and knows it", |service| {
        service.store.role() == Role::Writer
            && service.memory.known() == service.store.status().stored_viewpoints
    });
    service
}

fn learn_until_killed(folder: &Path) -> ! {
    let seed = env::var(SEED).expect("the parent gives it");
    let mut random = Random(seed.parse().expect("a number"));
    let mut service = service(folder);
    let mut out = std::io::stdout().lock();
    loop {
        let x_m = STEP_M * random.below(POSES) as f64;
        let id = service.learn(x_m, random.below(1 << 40) as u64);
        let learnt = service
            .memory
            .viewpoints()
            .iter()
            .find(|view| view.id == id);
        let updates = learnt.expect("it was learnt").updates;
        // The parent reads on after the kill: what is written is not lost.
        writeln!(out, "{} {id} {updates}", monotonic_ns())
            .and_then(|()| out.flush())
            .expect("the parent reads");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn kill_often(lane: usize) {
    let folder = TempDir::new().expect("a folder");
    let mut random = Random(lane as u64);
    // Updates that must be there, by id.
    let mut durable = BTreeMap::<u64, u64>::new();
    let (mut lines, mut lost_ms_max) = (0, 0.0f64);
    for kill in 0..KILLS / LANES {
        let mut child = Command::new(env::current_exe().expect("this file"))
            .env(CHILD, folder.path())
            .env(SEED, (1000 * lane + kill).to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a child");
        let output = child.stdout.take().expect("it is piped");
        let reader = std::thread::spawn(move || {
            let lines = BufReader::new(output).lines();
            // The last line may be cut off.
            let numbers = lines.map_while(Result::ok).filter_map(|line| {
                let mut numbers = line.split(' ').map(|number| number.parse::<u64>().ok());
                Some((numbers.next()??, numbers.next()??, numbers.next()??))
            });
            numbers.collect::<Vec<_>>()
        });
        std::thread::sleep(LIFE_MAX.mul_f64(random.uniform(0.0, 1.0)));
        let killed_ns = monotonic_ns();
        child.kill().expect("it runs until then");
        child.wait().expect("it is gone");
        let learnt = reader.join().expect("its output is read");
        lines += learnt.len();

        let mut newest = durable.clone();
        for &(at_ns, id, updates) in &learnt {
            newest.insert(id, updates);
            if at_ns + WRITE_BEHIND.as_nanos() as u64 <= killed_ns {
                durable.insert(id, updates);
            }
        }
        let mut service = service(folder.path());
        let status = service.store.status();
        assert_eq!(status.damaged, 0, "torn: {:?}", status.damaged_names);
        let content = service.content();
        for (id, updates) in &durable {
            let found = content.get(id).map(|viewpoint| viewpoint.updates);
            assert!(
                found >= Some(*updates),
                "kill {kill}: viewpoint {id} was there {updates} times, now {found:?}"
            );
        }
        for (id, viewpoint) in &content {
            // One more than printed: it was killed in between.
            let most = newest.get(id).map_or(1, |updates| updates + 1);
            assert!(viewpoint.updates <= most, "viewpoint {id} is from nowhere");
            let seed = viewpoint.stamp_ns as u64;
            let x_m = viewpoint.world_from_camera.translation.x;
            let as_learnt = any_viewpoint(x_m, seed);
            assert_eq!(viewpoint.records, as_learnt.records, "viewpoint {id}");
            assert_eq!(viewpoint.mesh, as_learnt.mesh, "viewpoint {id}");
        }
        for &(at_ns, id, updates) in &learnt {
            if content.get(&id).is_none_or(|found| found.updates < updates) {
                lost_ms_max = lost_ms_max.max(killed_ns.saturating_sub(at_ns) as f64 / 1e6);
            }
        }
        durable = content
            .iter()
            .map(|(&id, found)| (id, found.updates))
            .collect();
        service.stop();
    }
    println!(
        "lane {lane}: {} kills, {lines} frames learnt, at most the last {lost_ms_max:.0} ms lost",
        KILLS / LANES
    );
    assert!(
        lines > 100 * KILLS / LANES,
        "only {lines} frames were learnt"
    );
    assert_eq!(durable.len(), POSES);
}
