//! The Zenoh session: the official command line options, and what a service sets differently from Zenoh's defaults.

use std::path::PathBuf;

use zenoh::{Config, Wait};

use crate::config::ConfigError;

/// Named and applied as in Zenoh's own programs.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Zenoh options")]
pub struct ZenohOptions {
    /// A Zenoh configuration file (JSON5 or YAML). Without it ZENOH_CONFIG is honoured.
    #[arg(short, long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Arbitrary configuration, as KEY:VALUE with a JSON5 value. May be repeated; wins over everything else.
    #[arg(long, value_name = "KEY:VALUE")]
    pub cfg: Vec<String>,
    /// The mode of the session.
    #[arg(short, long, value_parser = ["peer", "client", "router"])]
    pub mode: Option<String>,
    /// Endpoints to connect to, such as tcp/192.0.2.1:7447. May be repeated.
    #[arg(short = 'e', long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Endpoints to listen on, such as tcp/[::]:7447. May be repeated.
    #[arg(short, long, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// Do not look for other sessions by multicast. This is so unless the configuration asks for it.
    #[arg(long)]
    pub no_multicast_scouting: bool,
}

/// What Zenoh would accept; a service that serves small images need not.
const ZENOH_MESSAGE_BYTES_MAX: &str = "1073741824";

impl ZenohOptions {
    /// `message_bytes_max`: messages twice as long are dropped unseen unless the configuration says otherwise.
    ///
    /// # Errors
    /// Files and values that Zenoh refuses.
    pub fn config(&self, message_bytes_max: usize) -> Result<Config, ConfigError> {
        let mut config = match &self.config {
            Some(path) => Config::from_file(path)
                .map_err(|error| ConfigError::Zenoh(format!("-c {}: {error}", path.display())))?,
            None if std::env::var_os(Config::DEFAULT_CONFIG_PATH_ENV).is_some() => {
                Config::from_env().map_err(|error| {
                    ConfigError::Zenoh(format!("{}: {error}", Config::DEFAULT_CONFIG_PATH_ENV))
                })?
            }
            None => Config::default(),
        };
        let mut set = |key: &str, value: &str| {
            config
                .insert_json5(key, value)
                .map_err(|error| ConfigError::Zenoh(format!("{key} cannot be {value}: {error}")))
        };
        if let Some(mode) = &self.mode {
            set("mode", &json(mode))?;
        }
        if !self.connect.is_empty() {
            set("connect/endpoints", &json(&self.connect))?;
        }
        if !self.listen.is_empty() {
            set("listen/endpoints", &json(&self.listen))?;
        }
        if self.no_multicast_scouting {
            set("scouting/multicast/enabled", "false")?;
        }
        let defaults = [
            // Found by accident is worse than not found.
            ("scouting/multicast/enabled", "null", "false".to_owned()),
            // A service outlives its router: it waits for it and comes back to it.
            ("connect/timeout_ms", "null", "-1".to_owned()),
            ("connect/exit_on_failure", "null", "false".to_owned()),
            // Storages and histories need stamps on what is published.
            ("timestamping/enabled", "null", "true".to_owned()),
            (
                "transport/link/rx/max_message_size",
                ZENOH_MESSAGE_BYTES_MAX,
                // What is longer than may be taken is refused with a reason, unless it is twice as long.
                message_bytes_max.saturating_mul(2).to_string(),
            ),
        ];
        for (key, unset, value) in defaults {
            if config.get_json(key).is_ok_and(|now| now == unset) {
                config
                    .insert_json5(key, &value)
                    .map_err(|error| ConfigError::Zenoh(format!("{key}: {error}")))?;
            }
        }
        for pair in &self.cfg {
            let (key, value) = pair.split_once(':').ok_or_else(|| {
                ConfigError::Zenoh(format!("--cfg {pair}: write it as KEY:VALUE"))
            })?;
            config
                .insert_json5(key, value)
                .map_err(|error| ConfigError::Zenoh(format!("--cfg {pair}: {error}")))?;
        }
        Ok(config)
    }
}

fn json(value: &impl serde::Serialize) -> String {
    serde_json::to_string(value).expect("text is JSON")
}

/// Where a session listens, as endpoints for others to connect to.
pub fn locators(session: &zenoh::Session) -> Vec<String> {
    let locators = session.info().locators().wait();
    locators.iter().map(ToString::to_string).collect()
}
