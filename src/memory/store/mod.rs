//! Memory that lasts: every viewpoint as one object in a folder or an object store.
//!
//! ```text
//! worker ──changes──> pending ──writer──> objects          one a viewpoint; the newest state wins
//!        <──loaded─── loader <──wanted──  worker, ahead of the robots' way
//!        <──known──── keeper <──────────  listing, heads; the lease
//! ```
//!
//! Nothing here makes a frame wait but a viewpoint that is needed for it and is not in RAM. What is bounded, and what
//! happens beyond it:
//!
//! | queue | bound | beyond it |
//! |---|---|---|
//! | pending changes | one a viewpoint; they keep in RAM what the memory's own budget counts | the newest state wins; what is not stored cannot leave RAM, and when that fills the budget the nearest viewpoint is replaced, as without a store |
//! | modes to be written | one, of the place | the newest wins |
//! | events to be written | one an event that the service tells of | the newest state wins |
//! | calibrations to be written | one a camera, of as many as the worker knows | the newest wins |
//! | wanted and loaded | [`loader::LOADS_MAX`], and a quarter of the memory's budget | what is only expected to be needed is dropped and counted |
//!
//! A change is written half of `write_behind_s` after it came, so that the other half is left for the writing. What took
//! longer all the same is counted as late: frames never wait for a slow store. While the store cannot be reached, the
//! service goes on in RAM, tries again ever less often, up to every [`RETRY_MAX`], and says so.

pub mod archive;

pub mod form;

mod keeper;

mod lease;

mod loader;

mod modes;

mod notes;

mod place;

pub mod planes;

mod shared;

mod shelf;

mod way;

mod writer;

use std::{path::PathBuf, sync::Arc, time::Duration};

use futures_util::StreamExt;
use object_store::{
    BackoffConfig, ClientOptions, ObjectStore, RetryConfig, aws::AmazonS3Builder,
    local::LocalFileSystem, path::Path,
};
use url::Url;

use self::shelf::Shelf;
pub use self::{
    place::{Brought, PlaceStore},
    shared::{PlaceOptions, ROLES, Role, StoreStatus},
};

/// The longest pause between two tries to reach the store.
pub const RETRY_MAX: Duration = Duration::from_secs(8);
const RETRY_FIRST: Duration = Duration::from_millis(250);
/// A request that takes longer has failed.
const REQUEST_WITHIN: Duration = Duration::from_secs(10);
const CONNECT_WITHIN: Duration = Duration::from_secs(3);

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error(
        "--memory {0}: write it as file:///folder, s3://bucket/prefix, or memory:// for a memory that ends with the service"
    )]
    Url(String),
    #[error(
        "--memory: this user has no home and so no folder for data: name one, as file:///folder"
    )]
    NoHome,
    #[error("--memory {folder}: the folder cannot be made or opened: {error}")]
    Folder {
        folder: String,
        error: std::io::Error,
    },
    #[error("--memory {url}: {error}")]
    Options {
        url: String,
        error: object_store::Error,
    },
    #[error("the store cannot be reached: {0}")]
    Reach(#[from] object_store::Error),
}

/// Where the viewpoints of all places lie.
#[derive(Debug, Clone)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    at: Path,
    /// The same on this machine's disk.
    folder: Option<PathBuf>,
}

impl Store {
    /// Of a URL, without reaching for it; `None`: `memory://`, nothing lasts. Keys for S3 come from the environment, as
    /// `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION` and `AWS_ENDPOINT`.
    ///
    /// # Errors
    /// A URL that is none or of an unknown kind, and a folder that cannot be made.
    pub fn open(text: &str) -> Result<Option<Self>, StoreError> {
        let wrong = || StoreError::Url(text.to_owned());
        let url = Url::parse(text).map_err(|_| wrong())?;
        match url.scheme() {
            "memory" => Ok(None),
            "file" => {
                let folder = url.to_file_path().map_err(|()| wrong())?;
                Self::in_folder(folder).map(Some)
            }
            "s3" => Self::in_bucket(text, &url).map(Some),
            _ => Err(wrong()),
        }
    }

    /// In the folder where programs keep this user's data.
    ///
    /// # Errors
    /// A user without a home, and a folder that cannot be made.
    pub fn in_data_folder() -> Result<Self, StoreError> {
        use etcetera::BaseStrategy;
        let strategy =
            etcetera::base_strategy::choose_native_strategy().map_err(|_| StoreError::NoHome)?;
        Self::in_folder(strategy.data_dir().join("surprised").join("memory"))
    }

    /// # Errors
    /// A folder that cannot be made.
    pub fn in_folder(folder: PathBuf) -> Result<Self, StoreError> {
        let failed = |error| StoreError::Folder {
            folder: folder.display().to_string(),
            error,
        };
        std::fs::create_dir_all(&folder).map_err(failed)?;
        let objects = LocalFileSystem::new_with_prefix(&folder)
            .map_err(|error| failed(std::io::Error::other(error)))?
            .with_fsync(true);
        Ok(Self {
            objects: Arc::new(objects),
            at: Path::default(),
            folder: Some(folder),
        })
    }

    fn in_bucket(text: &str, url: &Url) -> Result<Self, StoreError> {
        let failed = |error| StoreError::Options {
            url: text.to_owned(),
            error,
        };
        // Somebody else may have chosen already; there is only one to choose.
        drop(rustls::crypto::ring::default_provider().install_default());
        let client = ClientOptions::new()
            .with_timeout(REQUEST_WITHIN)
            .with_connect_timeout(CONNECT_WITHIN);
        // Plain HTTP only for who says so: AWS_ALLOW_HTTP.
        let client = match std::env::var("AWS_ALLOW_HTTP").as_deref() {
            Ok("true" | "1") => client.with_allow_http(true),
            _ => client,
        };
        // Tried again here, where it is known what is newest.
        let retry = RetryConfig {
            max_retries: 1,
            retry_timeout: REQUEST_WITHIN,
            backoff: BackoffConfig::default(),
        };
        let objects = AmazonS3Builder::from_env()
            .with_url(text)
            .with_client_options(client)
            .with_retry(retry)
            .build()
            .map_err(failed)?;
        let at = Path::from_url_path(url.path()).map_err(|error| failed(error.into()))?;
        Ok(Self::with_objects(Arc::new(objects), at))
    }

    /// Any object store that knows puts which fail where an object is already.
    pub fn with_objects(objects: Arc<dyn ObjectStore>, at: Path) -> Self {
        Self {
            objects,
            at,
            folder: None,
        }
    }

    /// Names of the places of which there are viewpoints or events.
    ///
    /// # Errors
    /// A store that cannot be reached.
    pub async fn places(&self) -> Result<Vec<String>, StoreError> {
        let mut places = Vec::new();
        let all = self.objects.list_with_delimiter(Some(&self.at)).await?;
        for place in all.common_prefixes {
            if let Some(name) = place.filename()
                && self.has(name).await?
            {
                places.push(name.to_owned());
            }
        }
        places.sort();
        Ok(places)
    }

    /// Whether there are viewpoints or events of a place.
    ///
    /// # Errors
    /// A store that cannot be reached.
    pub async fn has(&self, place: &str) -> Result<bool, StoreError> {
        for folder in [shelf::VIEWPOINTS, notes::Kind::Event.folder()] {
            let folder = self.at.clone().join(place).join(folder);
            let first = self.objects.list(Some(&folder)).next().await;
            if first.transpose()?.is_some() {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn shelf(&self, place: &str) -> Shelf {
        Shelf::new(
            self.objects.clone(),
            self.at.clone().join(place),
            self.folder.as_ref().map(|folder| folder.join(place)),
        )
    }
}

/// Pauses between tries: doubled from one to the next.
#[derive(Debug, Default)]
struct Backoff {
    failures: u32,
}

impl Backoff {
    fn next(&mut self) -> Duration {
        let pause = RETRY_FIRST.saturating_mul(1 << self.failures.min(16));
        self.failures += 1;
        pause.min(RETRY_MAX)
    }
}
