//! `surprised simulate`: robots in a simulated world, over Zenoh like real ones, or written to a folder.

use std::path::PathBuf;

use tokio::sync::watch;

use super::{
    fleet::{self, Network, PaceOptions, Sensors, WorldOptions},
    output,
    replay::id,
};
use crate::{service::session::ZenohOptions, simulation::write};

/// Frames written of an endless script unless --frames says otherwise: one and a half minutes.
const WRITTEN_MAX: u64 = 630;

/// Drives simulated robots around a table with known truth
#[derive(Debug, clap::Args)]
pub struct Simulate {
    #[command(flatten)]
    world: WorldOptions,
    #[command(flatten)]
    pace: PaceOptions,
    /// Send measured depth and the robot's own pose, as a robot with a depth camera does; without it three images and the
    /// tracked markers, as the paper's robot does.
    #[arg(long)]
    depth: bool,
    /// Write the first robot's recording to this folder in TUM RGB-D layout, with masks, instead of publishing.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["rate", "lockstep"])]
    write: Option<PathBuf>,
    /// The place the robots say they are in.
    #[arg(long, value_parser = id, default_value = "kitchen")]
    place: String,
    /// Print one last line of JSON.
    #[arg(long)]
    json: bool,
    /// The Zenoh key below which everything is.
    #[arg(long, value_name = "KEY", default_value = "surprised")]
    root: String,
    #[command(flatten)]
    zenoh: ZenohOptions,
}

impl Simulate {
    /// Until the script's frames are over, or SIGINT or SIGTERM.
    ///
    /// # Errors
    /// A folder that cannot be written, or as [`fleet::drive`].
    pub async fn run(self) -> anyhow::Result<()> {
        let script = self.world.script();
        if let Some(folder) = self.write {
            let options = write::Options::whole(
                &script,
                self.world
                    .frames
                    .unwrap_or(WRITTEN_MAX.max(script.frames.unwrap_or(0))),
            );
            let summary = write::recording(&folder, &script, &options)?;
            return output::line(format_args!("{}: {summary:?}", folder.display()));
        }
        let sensors = if self.depth {
            Sensors::Depth
        } else {
            Sensors::Rig
        };
        let (stopper, stop) = watch::channel(false);
        let signals = super::serve::stop_signal()?;
        tokio::spawn(async move {
            signals.await;
            stopper.send_replace(true);
        });
        let network = Network {
            zenoh: self.zenoh,
            root: self.root,
            place: self.place,
        };
        let summary = fleet::drive(
            script,
            self.world.frames,
            sensors,
            &self.pace,
            &network,
            stop,
        )
        .await?;
        output::line(&summary)?;
        if self.json {
            output::line(serde_json::to_string(&summary)?)?;
        }
        Ok(())
    }
}
