//! An object store that can be cut off, that answers slowly, and that is interrupted while it writes.

use std::{
    collections::VecDeque,
    fmt,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use async_trait::async_trait;
use futures_util::{StreamExt, stream::BoxStream};
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result, path::Path,
};

#[derive(Debug)]
pub struct Flaky {
    inner: Arc<dyn ObjectStore>,
    cut: AtomicBool,
    held: AtomicBool,
    get_ms: AtomicU64,
    interrupted: Mutex<VecDeque<Interrupted>>,
}

/// What is left of an object whose put has no answer.
#[derive(Debug, Clone, Copy)]
pub enum Interrupted {
    Whole,
    Half,
}

impl Flaky {
    pub fn new(inner: Arc<dyn ObjectStore>) -> Arc<Self> {
        Arc::new(Self {
            inner,
            cut: AtomicBool::new(false),
            held: AtomicBool::new(false),
            get_ms: AtomicU64::new(0),
            interrupted: Mutex::default(),
        })
    }

    pub fn cut_off(&self, cut: bool) {
        self.cut.store(cut, Ordering::Relaxed);
    }

    /// The next writes of viewpoints and modes, one after the other.
    pub fn interrupt(&self, puts: impl IntoIterator<Item = Interrupted>) {
        self.interrupted.lock().expect("no panic").extend(puts);
    }

    /// How many of them have not come yet.
    pub fn to_interrupt(&self) -> usize {
        self.interrupted.lock().expect("no panic").len()
    }

    /// Reads have no answer until they are let go.
    pub fn hold_reads(&self, held: bool) {
        self.held.store(held, Ordering::Relaxed);
    }

    pub fn slow_reads(&self, delay: Duration) {
        self.get_ms
            .store(delay.as_millis() as u64, Ordering::Relaxed);
    }

    fn check(&self) -> Result<()> {
        if self.cut.load(Ordering::Relaxed) {
            return Err(Error::Generic {
                store: "flaky",
                source: "cut off".into(),
            });
        }
        Ok(())
    }
}

impl fmt::Display for Flaky {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "flaky {}", self.inner)
    }
}

#[async_trait]
impl ObjectStore for Flaky {
    async fn put_opts(
        &self,
        path: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        self.check()?;
        let next = if path.as_ref().contains("/lease/") {
            None
        } else {
            self.interrupted.lock().expect("no panic").pop_front()
        };
        let Some(interrupted) = next else {
            return self.inner.put_opts(path, payload, options).await;
        };
        let bytes: Vec<u8> = payload.iter().flatten().copied().collect();
        let kept = match interrupted {
            Interrupted::Whole => bytes.len(),
            Interrupted::Half => bytes.len() / 2,
        };
        let payload = bytes[..kept].to_vec().into();
        self.inner.put_opts(path, payload, options).await?;
        Err(Error::Generic {
            store: "flaky",
            source: "no answer".into(),
        })
    }

    async fn put_multipart_opts(
        &self,
        path: &Path,
        options: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.check()?;
        self.inner.put_multipart_opts(path, options).await
    }

    async fn get_opts(&self, path: &Path, options: GetOptions) -> Result<GetResult> {
        self.check()?;
        tokio::time::sleep(Duration::from_millis(self.get_ms.load(Ordering::Relaxed))).await;
        while self.held.load(Ordering::Relaxed) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        self.inner.get_opts(path, options).await
    }

    fn delete_stream(
        &self,
        paths: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        match self.check() {
            Ok(()) => self.inner.delete_stream(paths),
            Err(error) => futures_util::stream::once(async { Err(error) }).boxed(),
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        match self.check() {
            Ok(()) => self.inner.list(prefix),
            Err(error) => futures_util::stream::once(async { Err(error) }).boxed(),
        }
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.check()?;
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.check()?;
        self.inner.copy_opts(from, to, options).await
    }
}
