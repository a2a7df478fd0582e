//! Options that several commands share.

use std::{net::SocketAddr, path::PathBuf};

use crate::{
    config::{ConfigError, Preset, Settings},
    engine::EngineKind,
    memory::store::Store,
    service::{
        self,
        access::{HttpAccess, Token},
        session::ZenohOptions,
    },
    wire::keys::is_id,
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
                    option: "--settings",
                    file: path.display().to_string(),
                    error,
                })
            })
            .transpose()?;
        let settings = Settings::layered(self.preset, file.as_deref(), &self.set)?;
        match settings.robots.keys().find(|robot| !is_id(robot)) {
            Some(robot) => Err(ConfigError::Robot(robot.clone())),
            None => Ok(settings),
        }
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
    /// File with the token that requests over HTTP must carry; needed where --http is not on loopback.
    #[arg(long, value_name = "FILE")]
    pub http_token_file: Option<PathBuf>,
    /// Let everybody in who can reach the HTTP address.
    #[arg(long, conflicts_with = "http_token_file")]
    pub http_no_token: bool,
    /// The Zenoh key below which everything is.
    #[arg(long, value_name = "KEY", default_value = "surprised")]
    pub root: String,
    #[command(flatten)]
    pub zenoh: ZenohOptions,
}

impl ServiceOptions {
    /// # Errors
    /// Settings that are wrong, a token that cannot be used, or a memory that cannot be opened.
    pub fn options(self, lasting: bool) -> Result<service::Options, ConfigError> {
        Ok(service::Options {
            settings: self.settings.settings()?,
            store: match &self.memory {
                None if !lasting => None,
                url => stored_memory(url.as_deref())?,
            },
            engine: self.engine,
            root: self.root,
            http: self.http.0,
            http_access: HttpAccess {
                token: self
                    .http_token_file
                    .as_deref()
                    .map(Token::read)
                    .transpose()?,
                open: self.http_no_token,
            },
            zenoh: self.zenoh,
        })
    }
}

/// Where memories last: at a URL, or else in this user's data folder. `None`: nowhere.
///
/// # Errors
/// A memory that cannot be opened.
pub fn stored_memory(url: Option<&str>) -> Result<Option<Store>, ConfigError> {
    let store = match url {
        Some(url) => Store::open(url),
        None => Store::in_data_folder().map(Some),
    };
    store.map_err(|error| ConfigError::Memory(error.to_string()))
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
