//! Options that several commands share.

use std::{net::SocketAddr, path::PathBuf};

use crate::{
    config::{ConfigError, Preset, Settings},
    engine::EngineKind,
    memory::store::{Store, StoreError},
    service::{self, session::ZenohOptions},
};

/// The science's and the service's settings.
#[derive(Debug, Clone, clap::Args)]
pub struct SettingsOptions {
    /// Which defaults.
    #[arg(long, value_enum, default_value_t = Preset::Robust)]
    pub preset: Preset,
    /// Settings laid over the preset, a TOML file of names and values.
    #[arg(long, value_name = "FILE")]
    pub settings: Option<PathBuf>,
    /// One setting, laid over the file's; may be repeated. A running service lists all on /api/v1/info.
    #[arg(long, value_name = "NAME=VALUE")]
    pub set: Vec<String>,
}

impl SettingsOptions {
    /// # Errors
    /// Files and values that are wrong.
    pub fn settings(&self) -> Result<Settings, ConfigError> {
        let file = self
            .settings
            .as_ref()
            .map(|path| {
                std::fs::read_to_string(path).map_err(|error| ConfigError::Read {
                    file: path.display().to_string(),
                    error,
                })
            })
            .transpose()?;
        Settings::layered(self.preset, file.as_deref(), &self.set)
    }
}

/// Everything a service needs.
#[derive(Debug, Clone, clap::Args)]
pub struct ServiceOptions {
    #[command(flatten)]
    pub settings: SettingsOptions,
    /// Where recall and surprise are computed.
    #[arg(long, value_enum, default_value_t)]
    pub engine: EngineKind,
    /// Where memories last: file:///folder, s3://bucket/prefix with the usual AWS_ variables, or memory:// for memories
    /// that end with the program. Without it serve keeps them in this user's data folder, and demo nowhere.
    #[arg(long, value_name = "URL")]
    pub memory: Option<String>,
    /// Address to serve HTTP on; off for none.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080", value_parser = http)]
    pub http: Http,
    /// The Zenoh key below which everything is.
    #[arg(long, value_name = "KEY", default_value = "surprised")]
    pub root: String,
    #[command(flatten)]
    pub zenoh: ZenohOptions,
}

impl ServiceOptions {
    /// # Errors
    /// Settings that are wrong, or a memory that cannot be opened.
    pub fn options(self, lasting: bool) -> Result<service::Options, ConfigError> {
        let settings = self.settings.settings()?;
        let memory = |error: StoreError| ConfigError::Memory(error.to_string());
        Ok(service::Options {
            settings,
            store: match self.memory {
                Some(url) => Store::open(&url).map_err(memory)?,
                None if lasting => Some(Store::in_data_folder().map_err(memory)?),
                None => None,
            },
            engine: self.engine,
            root: self.root,
            http: self.http.0,
            zenoh: self.zenoh,
        })
    }
}

/// `None`: off.
#[derive(Debug, Clone, Copy)]
pub struct Http(pub Option<SocketAddr>);

fn http(text: &str) -> Result<Http, String> {
    if text == "off" {
        return Ok(Http(None));
    }
    match text.parse() {
        Ok(addr) => Ok(Http(Some(addr))),
        Err(_) => Err("write it as 127.0.0.1:8080, or off".to_owned()),
    }
}
