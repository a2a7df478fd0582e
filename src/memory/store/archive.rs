//! A place as one file, to be kept or moved.
//!
//! ```text
//! bytes
//!     8  magic: 0x89 "SPLACE" LF
//!     4  version of this form: 2
//!        for every object of the place, viewpoints first:
//!     8    its bytes, L
//!     1    what it is: 1 a viewpoint (see `form`), 2 an event, 3 a camera's calibration (see `notes`),
//!          4 what was said about modes (see `modes`)
//!     8    its id; 0 of modes
//!     L    the object
//!     8  0: no more
//!     8  how many there were
//!     8  checksum of everything before, as of an object
//! ```
//!
//! Version 1, which is still read, has viewpoints alone, and neither their kind nor their id beside them. Numbers are
//! little-endian. A file is written aside and renamed when it is whole; one that is read is checked from end to end
//! before anything of it is stored. Neither holds more than a few viewpoints at a time.

use std::{
    fs::File,
    io::{self, BufReader, BufWriter, Read, Seek, Write},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use bytes::Bytes;
use crc_fast::{CrcAlgorithm, Digest};
use object_store::Error;

use super::{
    Store, StoreError,
    form::{self, FormError, Label},
    lease::{EXPIRES_AFTER, Lease, Looked, RENEW_EVERY, Watcher, own_name},
    modes,
    notes::{self, Kind},
    shelf::Shelf,
};
use crate::memory::Version;

const MAGIC: [u8; 8] = *b"\x89SPLACE\n";
const VERSION: u32 = 2;
/// Of viewpoints alone.
const VERSION_BEFORE: u32 = 1;
/// How often an object may have been written anew while it was read.
const TRIES: usize = 10;
/// Between two looks at a lease.
const LOOK_EVERY: Duration = Duration::from_millis(500);

#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    #[error("nothing is stored of place {place}; there is: {known}")]
    Unknown { place: String, known: String },
    #[error("{}: {error}", .file.display())]
    File { file: PathBuf, error: io::Error },
    #[error("{}: {what}: this is no exported place, or it is damaged", .file.display())]
    Damaged { file: PathBuf, what: String },
    #[error(
        "something is stored of place {place} already: import under a name of which there is nothing"
    )]
    NotEmpty { place: String },
    #[error(
        "place {place} is written by {holder}: stop that service first, or import under another name"
    )]
    Held { place: String, holder: String },
    #[error("the place was taken over by another service meanwhile; what was imported is removed")]
    Lost,
    #[error("{what} {id} of place {place} cannot be read: {error}")]
    Object {
        place: String,
        what: &'static str,
        id: u64,
        error: FormError,
    },
    #[error("the store cannot be used: {0}")]
    Objects(#[from] Error),
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// What was exported or imported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Archived {
    pub viewpoints: u64,
    pub events: u64,
    /// Of all objects.
    pub bytes: u64,
}

impl Archived {
    fn count(&mut self, what: What, bytes: u64) {
        self.viewpoints += u64::from(what == What::Viewpoint);
        self.events += u64::from(what == What::Note(Kind::Event));
        self.bytes += bytes;
    }
}

/// What an object is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    Viewpoint,
    Note(Kind),
    Modes,
}

impl What {
    /// As they follow each other in a file.
    const ALL: [Self; 4] = [
        Self::Viewpoint,
        Self::Note(Kind::Event),
        Self::Note(Kind::Calibration),
        Self::Modes,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Viewpoint => "viewpoint",
            Self::Note(kind) => kind.name(),
            Self::Modes => "modes",
        }
    }

    fn code(self) -> u8 {
        match self {
            Self::Viewpoint => 1,
            Self::Note(Kind::Event) => 2,
            Self::Note(Kind::Calibration) => 3,
            Self::Modes => 4,
        }
    }

    fn check(self, object: &Bytes) -> Result<(), FormError> {
        match self {
            Self::Viewpoint => form::check(object),
            Self::Note(_) => notes::opened(object).map(drop),
            Self::Modes => modes::decode(object).map(drop),
        }
    }

    /// Of each object its newest state.
    async fn newest(self, shelf: &Shelf) -> Result<States, Error> {
        let listed: Vec<(u64, Version)> = match self {
            Self::Viewpoint => {
                let viewpoints = shelf.list().await?.viewpoints;
                let states = viewpoints.iter().map(|listed| (listed.id, listed.version));
                states.collect()
            }
            Self::Note(kind) => shelf.list_notes(kind).await?,
            Self::Modes => {
                let versions = shelf.list_modes().await?;
                versions.into_iter().map(|version| (0, version)).collect()
            }
        };
        let mut states = States::new();
        for (id, version) in listed {
            let state = states.entry(id).or_default();
            *state = version.max(*state);
        }
        Ok(states)
    }

    async fn get(self, shelf: &Shelf, id: u64, version: Version) -> Result<Option<Bytes>, Error> {
        match self {
            Self::Viewpoint => shelf.get(id, version, u64::MAX).await,
            Self::Note(kind) => shelf.get_note(kind, id, version, u64::MAX).await,
            Self::Modes => shelf.get_modes(version, u64::MAX).await,
        }
    }

    async fn put(
        self,
        shelf: &Shelf,
        id: u64,
        version: Version,
        object: Bytes,
    ) -> Result<(), Error> {
        match self {
            Self::Viewpoint => shelf.put(id, version, object).await,
            Self::Note(kind) => shelf.put_note(kind, id, version, object).await,
            Self::Modes => shelf.put_modes(version, object).await,
        }
    }

    async fn delete(self, shelf: &Shelf, id: u64, version: Version) -> Result<(), Error> {
        match self {
            Self::Viewpoint => shelf.delete(&[(id, version)], true).await,
            Self::Note(kind) => shelf.delete_notes(kind, &[(id, version)]).await,
            Self::Modes => shelf.delete_modes(&[version]).await,
        }
    }
}

impl Store {
    /// Writes a place to a file. Services may go on with it meanwhile; of each object a state is written that was stored
    /// during that time.
    ///
    /// # Errors
    /// A place of which nothing is stored, a damaged object, a file or a store that cannot be used.
    pub async fn export(&self, place: &str, file: &Path) -> Result<Archived, ArchiveError> {
        let failed = |error| ArchiveError::File {
            file: file.to_owned(),
            error,
        };
        let shelf = self.shelf(place);
        if !self.has(place).await? {
            let mut known = self.places().await?.join(", ");
            if known.is_empty() {
                known = "nothing".to_owned();
            }
            let place = place.to_owned();
            return Err(ArchiveError::Unknown { place, known });
        }
        // In the same folder, so that it can be renamed.
        let folder = match file.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let aside = tempfile::NamedTempFile::new_in(folder).map_err(failed)?;
        let mut out = Checked::new(BufWriter::new(aside));
        let mut archived = Archived::default();
        out.put(&MAGIC)
            .and_then(|()| out.put(&VERSION.to_le_bytes()))
            .map_err(failed)?;
        let mut count = 0u64;
        for what in What::ALL {
            let mut states = what.newest(&shelf).await?;
            for id in states.keys().copied().collect::<Vec<_>>() {
                let Some(object) = state_of(&shelf, what, id, &mut states).await? else {
                    // Forgotten meanwhile.
                    continue;
                };
                what.check(&object).map_err(|error| ArchiveError::Object {
                    place: place.to_owned(),
                    what: what.name(),
                    id,
                    error,
                })?;
                let bytes = object.len() as u64;
                out.put(&bytes.to_le_bytes())
                    .and_then(|()| out.put(&[what.code()]))
                    .and_then(|()| out.put(&id.to_le_bytes()))
                    .and_then(|()| out.put(&object))
                    .map_err(failed)?;
                count += 1;
                archived.count(what, bytes);
            }
        }
        let end = || -> io::Result<()> {
            out.put(&0u64.to_le_bytes())?;
            out.put(&count.to_le_bytes())?;
            let sum = out.digest.finalize();
            out.inner.write_all(&sum.to_le_bytes())?;
            let aside = out.inner.into_inner().map_err(|error| error.into_error())?;
            aside.as_file().sync_all()?;
            aside.persist(file).map_err(|error| error.error)?;
            Ok(())
        };
        end().map_err(failed)?;
        Ok(archived)
    }

    /// Stores an exported place under a name of which nothing is stored.
    ///
    /// # Errors
    /// A damaged file, before anything is stored; a name that is taken; a store that cannot be used: then what was
    /// stored is removed again, if it can be.
    pub async fn import(&self, place: &str, file: &Path) -> Result<Archived, ArchiveError> {
        let open = || {
            File::open(file).map_err(|error| ArchiveError::File {
                file: file.to_owned(),
                error,
            })
        };
        let mut source = Archive::open(open()?, file)?;
        while source.next()?.is_some() {}

        let shelf = self.shelf(place);
        let mut lease = take(&shelf, place).await?;
        let imported = fill(&shelf, place, &mut lease, Archive::open(open()?, file)?).await;
        let imported = match imported {
            Err((stored, error)) => {
                for (what, id, version) in stored {
                    if let Err(error) = what.delete(&shelf, id, version).await {
                        tracing::error!("what was imported could not be removed again: {error}");
                    }
                }
                Err(error)
            }
            Ok(archived) => Ok(archived),
        };
        lease.release(&shelf).await?;
        imported
    }
}

type States = std::collections::BTreeMap<u64, Version>;

/// The object, in whichever state it is now.
async fn state_of(
    shelf: &Shelf,
    what: What,
    id: u64,
    states: &mut States,
) -> Result<Option<Bytes>, Error> {
    for _ in 0..TRIES {
        let Some(&version) = states.get(&id) else {
            return Ok(None);
        };
        match what.get(shelf, id, version).await {
            Err(Error::NotFound { .. }) => *states = what.newest(shelf).await?,
            got => return got,
        }
    }
    Ok(None)
}

/// The lease of a place that nobody writes. Somebody may have gone without a word.
async fn take(shelf: &Shelf, place: &str) -> Result<Lease, ArchiveError> {
    let mut epoch_min = None;
    for what in What::ALL {
        let states = what.newest(shelf).await?;
        epoch_min = epoch_min.max(states.values().map(|version| version.epoch).max());
    }
    let mut watcher = Watcher::default();
    let began = Instant::now();
    loop {
        let looked = watcher
            .look(shelf, &own_name(), epoch_min.unwrap_or(0) + 1)
            .await?;
        match looked {
            Looked::Taken(lease) => return Ok(lease),
            Looked::Held(holder) if began.elapsed() > EXPIRES_AFTER + RENEW_EVERY => {
                let place = place.to_owned();
                return Err(ArchiveError::Held { place, holder });
            }
            Looked::Held(_) => tokio::time::sleep(LOOK_EVERY).await,
        }
    }
}

type Stored = Vec<(What, u64, Version)>;

async fn fill(
    shelf: &Shelf,
    place: &str,
    lease: &mut Lease,
    mut source: Archive,
) -> Result<Archived, (Stored, ArchiveError)> {
    let mut stored = Stored::new();
    let work = async {
        // What was said of modes and calibrations before anything else came is overruled by what the place brings.
        for what in [What::Viewpoint, What::Note(Kind::Event)] {
            if !what.newest(shelf).await?.is_empty() {
                let place = place.to_owned();
                return Err(ArchiveError::NotEmpty { place });
            }
        }
        let mut archived = Archived::default();
        let mut renewed = Instant::now();
        while let Some(Entry { what, id, object }) = source.next()? {
            if renewed.elapsed() >= RENEW_EVERY {
                renewed = Instant::now();
                if !lease.renew(shelf).await? {
                    return Err(ArchiveError::Lost);
                }
            }
            let mut version = Version {
                epoch: lease.epoch,
                revision: 1,
            };
            let mut object = object;
            if what == What::Viewpoint {
                let read = form::decode_head(&object).map_err(|error| source.damaged(&error))?;
                version.revision = read.label.version.revision;
                let label = Label {
                    place: place.to_owned(),
                    version,
                    settings_hash: read.label.settings_hash,
                };
                let relabelled = form::relabel(&object, &label);
                object = relabelled.map_err(|error| source.damaged(&error))?.into();
            }
            archived.count(what, object.len() as u64);
            // Before: whether a put that failed has left something is not known.
            stored.push((what, id, version));
            what.put(shelf, id, version, object).await?;
        }
        Ok(archived)
    };
    let result = work.await;
    result.map_err(|error| (stored, error))
}

/// Writes and sums up.
struct Checked<W> {
    inner: W,
    digest: Digest,
}

impl<W: Write> Checked<W> {
    fn new(inner: W) -> Self {
        Self {
            inner,
            digest: Digest::new(CrcAlgorithm::Crc64Nvme),
        }
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.digest.update(bytes);
        self.inner.write_all(bytes)
    }
}

/// One of a file's objects, which is whole.
struct Entry {
    what: What,
    id: u64,
    object: Bytes,
}

/// Reads one object after the other, and in the end says whether the whole was right.
struct Archive {
    file: PathBuf,
    reader: BufReader<File>,
    digest: Digest,
    left: u64,
    version: u32,
    objects: u64,
}

impl Archive {
    fn open(mut reader: File, file: &Path) -> Result<Self, ArchiveError> {
        let left = reader.seek(io::SeekFrom::End(0));
        let left = left.and_then(|left| reader.rewind().map(|()| left));
        let mut archive = Self {
            file: file.to_owned(),
            reader: BufReader::new(reader),
            digest: Digest::new(CrcAlgorithm::Crc64Nvme),
            left: left.map_err(|error| ArchiveError::File {
                file: file.to_owned(),
                error,
            })?,
            version: 0,
            objects: 0,
        };
        if archive.take(8)? != MAGIC {
            return Err(archive.damaged(&"it begins otherwise"));
        }
        let version = archive.take(4)?;
        let known = [VERSION_BEFORE, VERSION].map(|known| (known, known.to_le_bytes()));
        let known = known.into_iter().find(|(_, bytes)| *bytes == *version);
        let (version, _) = known.ok_or_else(|| archive.damaged(&"its version is not known"))?;
        archive.version = version;
        Ok(archive)
    }

    /// The next object; `None` after the last, if the file is whole.
    fn next(&mut self) -> Result<Option<Entry>, ArchiveError> {
        let bytes = self.number()?;
        if bytes > 0 {
            let (what, id) = match self.version {
                VERSION_BEFORE => (What::Viewpoint, None),
                _ => {
                    let code = self.take(1)?[0];
                    let what = What::ALL.into_iter().find(|what| what.code() == code);
                    let what = what.ok_or_else(|| self.damaged(&"something unknown is in it"))?;
                    (what, Some(self.number()?))
                }
            };
            let object = Bytes::from(self.take(bytes)?);
            what.check(&object).map_err(|error| self.damaged(&error))?;
            let id = match what {
                What::Viewpoint => {
                    let read = form::decode_head(&object);
                    Some(read.map_err(|error| self.damaged(&error))?.head.id)
                }
                _ => id,
            };
            self.objects += 1;
            let id = id.unwrap_or_default();
            return Ok(Some(Entry { what, id, object }));
        }
        if self.number()? != self.objects {
            return Err(self.damaged(&"some of it is missing"));
        }
        let sum = self.digest.finalize();
        if self.number()? != sum || self.left > 0 {
            return Err(self.damaged(&"its checksum or its length is wrong"));
        }
        Ok(None)
    }

    fn number(&mut self) -> Result<u64, ArchiveError> {
        let bytes = self.take(8)?;
        let number = bytes.try_into().expect("eight bytes were taken");
        Ok(u64::from_le_bytes(number))
    }

    fn take(&mut self, bytes: u64) -> Result<Vec<u8>, ArchiveError> {
        if bytes > self.left {
            return Err(self.damaged(&"it ends early"));
        }
        self.left -= bytes;
        let mut taken = vec![0; bytes as usize];
        self.reader
            .read_exact(&mut taken)
            .map_err(|error| ArchiveError::File {
                file: self.file.clone(),
                error,
            })?;
        self.digest.update(&taken);
        Ok(taken)
    }

    fn damaged(&self, what: &dyn std::fmt::Display) -> ArchiveError {
        ArchiveError::Damaged {
            file: self.file.clone(),
            what: what.to_string(),
        }
    }
}
