//! A place as one file, to be kept or moved.
//!
//! ```text
//! bytes
//!     8  magic: 0x89 "SPLACE" LF
//!     4  version of this form: 1
//!        for every viewpoint:
//!     8    bytes of its object, L
//!     L    the object (see `form`)
//!     8  0: no more
//!     8  how many there were
//!     8  checksum of everything before, as of an object
//! ```
//!
//! Numbers are little-endian. A file is written aside and renamed when it is whole; one that is read is checked from end
//! to end before anything of it is stored. Neither holds more than a few viewpoints at a time.

use std::{
    fs::File,
    io::{self, BufReader, BufWriter, Read, Seek, Write},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use crc_fast::{CrcAlgorithm, Digest};
use object_store::Error;

use super::{
    Store, StoreError,
    form::{self, FormError, Label},
    lease::{EXPIRES_AFTER, Lease, Looked, RENEW_EVERY, Watcher, own_name},
    shelf::Shelf,
};
use crate::memory::Version;

const MAGIC: [u8; 8] = *b"\x89SPLACE\n";
const VERSION: u32 = 1;
/// How often a viewpoint may have been written anew while it was read.
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
    #[error("place {place} has viewpoints already: import under another name, or forget it first")]
    NotEmpty { place: String },
    #[error(
        "place {place} is written by {holder}: stop that service first, or import under another name"
    )]
    Held { place: String, holder: String },
    #[error("the place was taken over by another service meanwhile; what was imported is removed")]
    Lost,
    #[error("viewpoint {id} of place {place} cannot be read: {error}")]
    Viewpoint {
        place: String,
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
    /// Of their objects.
    pub bytes: u64,
}

impl Store {
    /// Writes a place to a file. Services may go on with it meanwhile; of each viewpoint a state is written that was
    /// stored during that time.
    ///
    /// # Errors
    /// A place of which nothing is stored, a damaged viewpoint, a file or a store that cannot be used.
    pub async fn export(&self, place: &str, file: &Path) -> Result<Archived, ArchiveError> {
        let failed = |error| ArchiveError::File {
            file: file.to_owned(),
            error,
        };
        let shelf = self.shelf(place);
        let mut states = newest(&shelf).await?;
        if states.is_empty() {
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
        for id in states.keys().copied().collect::<Vec<_>>() {
            let Some(object) = state_of(&shelf, id, &mut states).await? else {
                // Forgotten meanwhile.
                continue;
            };
            form::check(&object).map_err(|error| ArchiveError::Viewpoint {
                place: place.to_owned(),
                id,
                error,
            })?;
            let bytes = object.len() as u64;
            out.put(&bytes.to_le_bytes())
                .and_then(|()| out.put(&object))
                .map_err(failed)?;
            archived.viewpoints += 1;
            archived.bytes += bytes;
        }
        let end = || -> io::Result<()> {
            out.put(&0u64.to_le_bytes())?;
            out.put(&archived.viewpoints.to_le_bytes())?;
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
                if let Err(error) = shelf.delete(&stored, true).await {
                    tracing::error!("what was imported could not be removed again: {error}");
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

async fn newest(shelf: &Shelf) -> Result<States, Error> {
    let mut states = States::new();
    for listed in shelf.list().await?.viewpoints {
        let state = states.entry(listed.id).or_default();
        *state = listed.version.max(*state);
    }
    Ok(states)
}

/// The object of a viewpoint, in whichever state it is now.
async fn state_of(
    shelf: &Shelf,
    id: u64,
    states: &mut States,
) -> Result<Option<bytes::Bytes>, Error> {
    for _ in 0..TRIES {
        let Some(&version) = states.get(&id) else {
            return Ok(None);
        };
        match shelf.get(id, version, u64::MAX).await {
            Err(Error::NotFound { .. }) => *states = newest(shelf).await?,
            got => return got,
        }
    }
    Ok(None)
}

/// The lease of a place that nobody writes. Somebody may have gone without a word.
async fn take(shelf: &Shelf, place: &str) -> Result<Lease, ArchiveError> {
    let states = newest(shelf).await?;
    let epoch_min = states.values().map(|version| version.epoch).max();
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

type Stored = Vec<(u64, Version)>;

async fn fill(
    shelf: &Shelf,
    place: &str,
    lease: &mut Lease,
    mut source: Archive,
) -> Result<Archived, (Stored, ArchiveError)> {
    let mut stored = Stored::new();
    let work = async {
        if !newest(shelf).await?.is_empty() {
            let place = place.to_owned();
            return Err(ArchiveError::NotEmpty { place });
        }
        let mut archived = Archived::default();
        let mut renewed = Instant::now();
        while let Some(object) = source.next()? {
            if renewed.elapsed() >= RENEW_EVERY {
                renewed = Instant::now();
                if !lease.renew(shelf).await? {
                    return Err(ArchiveError::Lost);
                }
            }
            let read = form::decode_head(&object).map_err(|error| source.damaged(&error))?;
            let version = Version {
                epoch: lease.epoch,
                revision: read.label.version.revision,
            };
            let label = Label {
                place: place.to_owned(),
                version,
                settings_hash: read.label.settings_hash,
            };
            let object = form::relabel(&object, &label).map_err(|error| source.damaged(&error))?;
            archived.viewpoints += 1;
            archived.bytes += object.len() as u64;
            // Before: whether a put that failed has left something is not known.
            stored.push((read.head.id, version));
            shelf.put(read.head.id, version, object.into()).await?;
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

/// Reads one object after the other, and in the end says whether the whole was right.
struct Archive {
    file: PathBuf,
    reader: BufReader<File>,
    digest: Digest,
    left: u64,
    viewpoints: u64,
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
            viewpoints: 0,
        };
        if archive.take(8)? != MAGIC {
            return Err(archive.damaged(&"it begins otherwise"));
        }
        if archive.take(4)? != VERSION.to_le_bytes() {
            return Err(archive.damaged(&"its version is not known"));
        }
        Ok(archive)
    }

    /// The next object, which is whole; `None` after the last, if the file is.
    fn next(&mut self) -> Result<Option<Vec<u8>>, ArchiveError> {
        let bytes = self.number()?;
        if bytes > 0 {
            let object = self.take(bytes)?;
            form::check(&object).map_err(|error| self.damaged(&error))?;
            self.viewpoints += 1;
            return Ok(Some(object));
        }
        if self.number()? != self.viewpoints {
            return Err(self.damaged(&"viewpoints are missing"));
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
