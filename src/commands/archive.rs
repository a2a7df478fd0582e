//! `surprised export` and `surprised import`: a stored place as one file.

use std::path::PathBuf;

use super::{options::stored_memory, output, replay::id};
use crate::memory::store::{Store, archive::Archived};

/// Write what is remembered of a place to a file
#[derive(Debug, clap::Args)]
pub struct Export {
    #[command(flatten)]
    of: PlaceAndFile,
}

/// Store an exported place, under its name or another one of which nothing is stored
#[derive(Debug, clap::Args)]
pub struct Import {
    #[command(flatten)]
    of: PlaceAndFile,
}

#[derive(Debug, clap::Args)]
struct PlaceAndFile {
    #[arg(value_name = "PLACE", value_parser = id)]
    place: String,
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Where memories last, as for serve; without it, this user's data folder.
    #[arg(long, value_name = "URL")]
    memory: Option<String>,
}

impl PlaceAndFile {
    fn store(&self) -> anyhow::Result<Store> {
        let store = stored_memory(self.memory.as_deref())?;
        store
            .ok_or_else(|| anyhow::anyhow!("nothing lasts in memory://: name a folder or a bucket"))
    }

    fn print(&self, done: &str, archived: Archived) -> anyhow::Result<()> {
        output::line(format_args!(
            "{}: {} viewpoints and {} events, {:.1} MB {done} {}",
            self.place,
            archived.viewpoints,
            archived.events,
            archived.bytes as f64 / 1e6,
            self.file.display()
        ))
    }
}

impl Export {
    /// # Errors
    /// As [`Store::export`].
    pub async fn run(self) -> anyhow::Result<()> {
        let archived = self
            .of
            .store()?
            .export(&self.of.place, &self.of.file)
            .await?;
        self.of.print("written to", archived)
    }
}

impl Import {
    /// # Errors
    /// As [`Store::import`].
    pub async fn run(self) -> anyhow::Result<()> {
        let archived = self
            .of
            .store()?
            .import(&self.of.place, &self.of.file)
            .await?;
        self.of.print("stored from", archived)
    }
}
