//! `surprised demo`: the whole thing in one process: the service, simulated robots, and the page.

use anyhow::Context;
use tokio::sync::watch;

use super::{
    fleet::{self, Network, PaceOptions, Sensors, WorldOptions},
    options::ServiceOptions,
    output,
    serve::stop_signal,
};
use crate::service::{Service, session::ZenohOptions};

/// Shows it at work: service, two simulated robots and the page in one process
#[derive(Debug, clap::Args)]
pub struct Demo {
    #[command(flatten)]
    world: WorldOptions,
    #[command(flatten)]
    pace: PaceOptions,
    /// Robots with three cameras and tracked markers, as the paper's, instead of depth cameras: rendering two of them and
    /// computing their depth in real time takes four cores.
    #[arg(long)]
    rig: bool,
    /// Print one last line of JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    options: ServiceOptions,
}

impl Demo {
    /// Until the robots have sent their frames, or SIGINT or SIGTERM.
    ///
    /// # Errors
    /// As [`Service::start`] and [`fleet::drive`].
    pub async fn run(self) -> anyhow::Result<()> {
        let mut options = self.options.options(false)?;
        if options.zenoh.listen.is_empty() {
            // The robots are in this process; others may be let in with --listen.
            options.zenoh.listen = vec!["tcp/127.0.0.1:0".to_owned()];
        }
        let sensors = if self.rig {
            Sensors::Rig
        } else {
            Sensors::Depth
        };
        let root = options.root.clone();
        let service = Service::start(options).await?;
        let endpoint = service
            .locators()
            .first()
            .context("the service listens nowhere: give it --listen tcp/127.0.0.1:0")?
            .clone();
        match service.http_addr() {
            Some(addr) => output::line(format_args!(
                "The page is at http://{addr}/ - Ctrl-C ends it"
            ))?,
            None => output::line("no HTTP - Ctrl-C ends it")?,
        }
        let eyes = match sensors {
            Sensors::Depth => "a depth camera",
            Sensors::Rig => "three cameras and tracked markers",
        };
        output::line(format_args!(
            "Robots: {}, each with {eyes}. They get to know the table first; then things come and go.",
            self.world.robots
        ))?;

        let (stopper, stop) = watch::channel(false);
        let signals = stop_signal()?;
        let stop_robots = stopper.clone();
        tokio::spawn(async move {
            signals.await;
            stop_robots.send_replace(true);
        });
        let (served, robots_gone) = watch::channel(false);
        let mut robots_gone = robots_gone;
        let service = tokio::spawn(async move {
            let outcome = service
                .run(async move {
                    // Also when the sender is gone.
                    drop(robots_gone.wait_for(|gone| *gone).await);
                })
                .await;
            // Robots of a service that failed need not go on.
            stopper.send_replace(true);
            outcome
        });
        let network = Network {
            zenoh: ZenohOptions {
                mode: Some("client".to_owned()),
                connect: vec![endpoint],
                ..ZenohOptions::default()
            },
            root,
            place: PLACE.to_owned(),
        };
        let driven = fleet::drive(
            self.world.script(),
            self.world.frames,
            sensors,
            &self.pace,
            &network,
            stop,
        )
        .await;
        served.send_replace(true);
        service.await.context("the service failed")??;
        let summary = driven?;
        output::line(&summary)?;
        if self.json {
            output::line(serde_json::to_string(&summary)?)?;
        }
        Ok(())
    }
}

/// Where the simulated table stands.
const PLACE: &str = "kitchen";
