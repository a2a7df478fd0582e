//! Where the objects of a place lie, below the store's URL:
//!
//! ```text
//! PLACE/viewpoints/ID-EPOCH-REVISION    one object a viewpoint (see `form`); numbers in hexadecimal
//! PLACE/lease/EPOCH                     who writes the place (see `lease`)
//! PLACE/modes/EPOCH-REVISION            what was said about modes (see `modes`)
//! PLACE/events/ID-EPOCH-REVISION        what is kept of an event (see `notes`)
//! PLACE/calibrations/ID-EPOCH-REVISION  a camera's calibration (see `notes`); ID is the checksum of ROBOT/CAMERA
//! PLACE/damaged/...                     what could not be read, under the name it had
//! PLACE/lock                            on disk only: locked by the process that writes the place
//! ```
//!
//! An object is written once, under a name that no other state has, by a put that fails where there is one already; the
//! state before is deleted after. So nothing is ever overwritten: a crash leaves the old state, both or the new one,
//! and a writer that has lost the place cannot harm what its successor, whose epoch is greater, has written.
//!
//! On disk an object is written aside, synced, linked to its name, and the folder synced: `object_store` does that when
//! asked to. It does not sync folders after deleting, which matters where something was forgotten; that is done here.

use std::{path::PathBuf, sync::Arc};

use bytes::Bytes;
use futures_util::TryStreamExt;
use object_store::{
    Error, GetOptions, GetRange, ObjectStore, ObjectStoreExt, PutMode, PutOptions, path::Path,
};

use super::{form::HEAD_BYTES_MAX, notes::Kind};
use crate::memory::Version;

pub const VIEWPOINTS: &str = "viewpoints";
const LEASE: &str = "lease";
const MODES: &str = "modes";
const DAMAGED: &str = "damaged";
const LOCK: &str = "lock";

pub type Result<T> = std::result::Result<T, Error>;

/// What a store's listing says of one stored viewpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Listed {
    pub id: u64,
    pub version: Version,
    pub bytes: u64,
}

/// Everything below `viewpoints`.
#[derive(Debug, Default)]
pub struct Listing {
    pub viewpoints: Vec<Listed>,
    /// Names that no viewpoint has.
    pub strangers: Vec<Path>,
}

#[derive(Debug, Clone)]
pub struct Shelf {
    objects: Arc<dyn ObjectStore>,
    at: Path,
    /// The same on this machine's disk.
    folder: Option<PathBuf>,
}

impl Shelf {
    pub fn new(objects: Arc<dyn ObjectStore>, at: Path, folder: Option<PathBuf>) -> Self {
        Self {
            objects,
            at,
            folder,
        }
    }

    pub fn viewpoint(&self, id: u64, version: Version) -> Path {
        self.state(VIEWPOINTS, id, version)
    }

    pub fn note(&self, kind: Kind, id: u64, version: Version) -> Path {
        self.state(kind.folder(), id, version)
    }

    fn state(&self, folder: &str, id: u64, version: Version) -> Path {
        let Version { epoch, revision } = version;
        self.at
            .clone()
            .join(folder)
            .join(format!("{id:016x}-{epoch:08x}-{revision:016x}"))
    }

    pub fn modes(&self, version: Version) -> Path {
        let Version { epoch, revision } = version;
        self.at
            .clone()
            .join(MODES)
            .join(format!("{epoch:08x}-{revision:016x}"))
    }

    fn lease(&self, epoch: u64) -> Path {
        self.at.clone().join(LEASE).join(format!("{epoch:016x}"))
    }

    /// The file that the writing process locks.
    pub fn lock_file(&self) -> Option<PathBuf> {
        self.folder.as_ref().map(|folder| folder.join(LOCK))
    }

    pub async fn list(&self) -> Result<Listing> {
        let mut listing = Listing::default();
        let mut objects = self.objects.list(Some(&self.at.clone().join(VIEWPOINTS)));
        while let Some(object) = objects.try_next().await? {
            match object.location.filename().and_then(parse) {
                Some((id, version)) => listing.viewpoints.push(Listed {
                    id,
                    version,
                    bytes: object.size,
                }),
                None => listing.strangers.push(object.location),
            }
        }
        Ok(listing)
    }

    /// Enough of the object's beginning for its head.
    pub async fn get_head(&self, id: u64, version: Version) -> Result<Bytes> {
        let options = GetOptions {
            range: Some(GetRange::Bounded(0..HEAD_BYTES_MAX as u64)),
            ..GetOptions::default()
        };
        let path = self.viewpoint(id, version);
        self.objects.get_opts(&path, options).await?.bytes().await
    }

    /// The whole object; `None` if it is larger than `bytes_max`, which is not read.
    pub async fn get(&self, id: u64, version: Version, bytes_max: u64) -> Result<Option<Bytes>> {
        self.get_whole(&self.viewpoint(id, version), bytes_max)
            .await
    }

    async fn get_whole(&self, path: &Path, bytes_max: u64) -> Result<Option<Bytes>> {
        let object = self.objects.get(path).await?;
        if object.meta.size > bytes_max {
            return Ok(None);
        }
        object.bytes().await.map(Some)
    }

    /// Writes an object once; nothing happens where it is already as it should be.
    pub async fn put(&self, id: u64, version: Version, object: Bytes) -> Result<()> {
        self.put_once(&self.viewpoint(id, version), object).await
    }

    /// Only the holder of the epoch makes such a name: where there is one already, an answer was lost on the way, or
    /// the store was while it wrote. What it has then is believed only if it is whole.
    async fn put_once(&self, path: &Path, object: Bytes) -> Result<()> {
        match self.create(path, object.clone()).await {
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => {}
            result => return result,
        }
        let there = self.objects.get(path).await?;
        if there.meta.size == object.len() as u64 && there.bytes().await? == object {
            return Ok(());
        }
        tracing::warn!("{path} was left incomplete by the store: it is written again");
        self.objects.put(path, object.into()).await?;
        Ok(())
    }

    /// Which states of the modes there are, rising.
    pub async fn list_modes(&self) -> Result<Vec<Version>> {
        let mut versions = Vec::new();
        let mut objects = self.objects.list(Some(&self.at.clone().join(MODES)));
        while let Some(object) = objects.try_next().await? {
            let name = object.location.filename().unwrap_or("");
            // The form of a viewpoint's name without its id.
            if let Some((_, version)) = parse(&format!("0-{name}")) {
                versions.push(version);
            }
        }
        versions.sort_unstable();
        Ok(versions)
    }

    /// `None` if it is larger than `bytes_max`, which is not read.
    pub async fn get_modes(&self, version: Version, bytes_max: u64) -> Result<Option<Bytes>> {
        self.get_whole(&self.modes(version), bytes_max).await
    }

    pub async fn put_modes(&self, version: Version, object: Bytes) -> Result<()> {
        self.put_once(&self.modes(version), object).await
    }

    pub async fn delete_modes(&self, versions: &[Version]) -> Result<()> {
        for &version in versions {
            self.delete_one(&self.modes(version)).await?;
        }
        Ok(())
    }

    async fn delete_one(&self, path: &Path) -> Result<()> {
        match self.objects.delete(path).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// All states of all notes of a kind.
    pub async fn list_notes(&self, kind: Kind) -> Result<Vec<(u64, Version)>> {
        let folder = self.at.clone().join(kind.folder());
        let objects = self.objects.list(Some(&folder));
        let states = objects.try_filter_map(async |object| {
            let name = object.location.filename();
            Ok(name.and_then(parse))
        });
        states.try_collect().await
    }

    /// `None` if it is larger than `bytes_max`, which is not read.
    pub async fn get_note(
        &self,
        kind: Kind,
        id: u64,
        version: Version,
        bytes_max: u64,
    ) -> Result<Option<Bytes>> {
        self.get_whole(&self.note(kind, id, version), bytes_max)
            .await
    }

    pub async fn put_note(
        &self,
        kind: Kind,
        id: u64,
        version: Version,
        object: Bytes,
    ) -> Result<()> {
        self.put_once(&self.note(kind, id, version), object).await
    }

    pub async fn delete_notes(&self, kind: Kind, states: &[(u64, Version)]) -> Result<()> {
        for &(id, version) in states {
            self.delete_one(&self.note(kind, id, version)).await?;
        }
        Ok(())
    }

    async fn create(&self, path: &Path, object: Bytes) -> Result<()> {
        let options = PutOptions::from(PutMode::Create);
        self.objects.put_opts(path, object.into(), options).await?;
        Ok(())
    }

    /// Deletes states of viewpoints; those that are not there are none. Deleted for good where `synced`.
    pub async fn delete(&self, states: &[(u64, Version)], synced: bool) -> Result<()> {
        for &(id, version) in states {
            self.delete_one(&self.viewpoint(id, version)).await?;
        }
        if synced && let Some(folder) = &self.folder {
            let folder = folder.join(VIEWPOINTS);
            on_disk(move || std::fs::File::open(folder)?.sync_all()).await?;
        }
        Ok(())
    }

    /// Moves an object to where nobody reads it; its new path.
    pub async fn set_aside(&self, id: u64, version: Version) -> Result<Path> {
        self.move_aside(&self.viewpoint(id, version)).await
    }

    pub async fn set_modes_aside(&self, version: Version) -> Result<Path> {
        let path = self.modes(version);
        let name = path.filename().unwrap_or("nameless");
        self.rename_aside(&path, &format!("modes-{name}")).await
    }

    pub async fn set_note_aside(&self, kind: Kind, id: u64, version: Version) -> Result<Path> {
        let path = self.note(kind, id, version);
        let name = path.filename().unwrap_or("nameless");
        let aside = format!("{}-{name}", kind.name());
        self.rename_aside(&path, &aside).await
    }

    pub async fn move_aside(&self, path: &Path) -> Result<Path> {
        self.rename_aside(path, path.filename().unwrap_or("nameless"))
            .await
    }

    async fn rename_aside(&self, path: &Path, name: &str) -> Result<Path> {
        let aside = self.at.clone().join(DAMAGED).join(name);
        self.objects.rename(path, &aside).await?;
        Ok(aside)
    }

    /// Paths of what was set aside, at most so many, and how many there are.
    pub async fn damaged(&self, names_max: usize) -> Result<(Vec<String>, u64)> {
        let (mut names, mut count) = (Vec::new(), 0);
        let mut objects = self.objects.list(Some(&self.at.clone().join(DAMAGED)));
        while let Some(object) = objects.try_next().await? {
            count += 1;
            if names.len() < names_max {
                names.push(object.location.to_string());
            }
        }
        Ok((names, count))
    }

    /// The greatest epoch of which there is a lease, and what it says.
    pub async fn latest_lease(&self) -> Result<Option<(u64, Bytes)>> {
        let mut epochs = self.lease_epochs().await?;
        epochs.sort_unstable();
        while let Some(epoch) = epochs.pop() {
            match self.objects.get(&self.lease(epoch)).await {
                Ok(object) => return Ok(Some((epoch, object.bytes().await?))),
                // A newer one came meanwhile, and this one was deleted.
                Err(Error::NotFound { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(None)
    }

    pub async fn lease_epochs(&self) -> Result<Vec<u64>> {
        let objects = self.objects.list(Some(&self.at.clone().join(LEASE)));
        let epochs = objects.try_filter_map(async |object| {
            let name = object.location.filename().unwrap_or("");
            Ok(u64::from_str_radix(name, 16).ok())
        });
        epochs.try_collect().await
    }

    /// Makes the lease of an epoch; false where there is one.
    pub async fn create_lease(&self, epoch: u64, content: Bytes) -> Result<bool> {
        match self.create(&self.lease(epoch), content).await {
            Ok(()) => Ok(true),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Writes one's own lease anew.
    pub async fn renew_lease(&self, epoch: u64, content: Bytes) -> Result<()> {
        self.objects.put(&self.lease(epoch), content.into()).await?;
        Ok(())
    }

    /// Deletes the leases before an epoch.
    pub async fn delete_leases_before(&self, epoch: u64) -> Result<()> {
        for earlier in self.lease_epochs().await? {
            if earlier < epoch {
                self.delete_one(&self.lease(earlier)).await?;
            }
        }
        Ok(())
    }

    /// Deletes what a crash left half written on disk: `object_store` writes aside to names with `#`, and never lists
    /// them. Only for who writes the place.
    pub async fn sweep(&self) -> Result<()> {
        let Some(folder) = &self.folder else {
            return Ok(());
        };
        let notes = Kind::ALL.map(Kind::folder);
        let names = [VIEWPOINTS, MODES].into_iter().chain(notes);
        let folders: Vec<PathBuf> = names.map(|name| folder.join(name)).collect();
        on_disk(move || folders.iter().try_for_each(|folder| sweep_folder(folder))).await
    }
}

fn sweep_folder(folder: &std::path::Path) -> std::io::Result<()> {
    let entries = match std::fs::read_dir(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        entries => entries?,
    };
    for entry in entries {
        let entry = entry?;
        if entry.file_name().to_string_lossy().contains('#') {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

async fn on_disk(work: impl FnOnce() -> std::io::Result<()> + Send + 'static) -> Result<()> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|source| Error::JoinError { source })?
        .map_err(|error| Error::Generic {
            store: "LocalFileSystem",
            source: error.into(),
        })
}

fn parse(name: &str) -> Option<(u64, Version)> {
    let hex = |text: &str| u64::from_str_radix(text, 16).ok();
    let mut parts = name.split('-');
    let id = hex(parts.next()?)?;
    let epoch = hex(parts.next()?)?;
    let revision = hex(parts.next()?)?;
    parts
        .next()
        .is_none()
        .then_some((id, Version { epoch, revision }))
}
