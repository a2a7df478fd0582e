//! Every setting of the science and the service: unit, default, bound, reason. A preset gives all of them; a file and
//! `--set name=value` change single ones; the whole is validated before anything opens.

use std::{collections::BTreeMap, net::SocketAddr};

use serde::{Deserialize, Serialize};

use crate::model::{mode::Mode, pose::PoseNoise};

/// Which defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Preset {
    /// The paper to the letter where it is explicit.
    Paper,
    /// Measured on real images to be better.
    #[default]
    Robust,
}

/// What a pixel that no viewpoint saw is believed to be before its first observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UnseenStart {
    /// alpha 1, beta 1, tau 0, sigma 5, then the update (section V): beta takes a hundred frames to forget tau 0.
    Paper,
    /// Starts at the observation itself with [`Settings::unseen_variance`].
    Observation,
}

/// Where a posterior goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Replacement {
    /// Append until [`Settings::viewpoints`] are held, then overwrite the nearest of the seven.
    AppendThenNearest,
    /// Overwrite the selected viewpoint whose home is nearest; append if that is farther than
    /// [`Settings::grow_distance_m`].
    GrowHome,
}

/// What regions, scores and thresholds look at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Evidence {
    /// Means of 4x4 blocks (section V-A).
    Blocks,
    /// The median over 3x3 block means: single-block flashes are noise. Objects below about 12x12 px are lost.
    BlockMedian,
}

/// What is set for one robot; what is not is as for all.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotSettings {
    pub pose_position_sd_m: Option<f64>,
    pub pose_rotation_sd_rad: Option<f64>,
    pub mode: Option<Mode>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// f of (12), (13): share of the past kept at an update. 0.5..=0.9: alpha settles at 0.5/(1-f), and the
    /// polynomial for the surprise's gamma terms is exact to 1e-6 up to there.
    pub forgetting: f32,
    /// xi of (10): how much uncertainty speeds up learning. The optimum is flat between 0.001 and 0.03.
    pub xi: f32,
    /// Bounds of sigma_p in (10). Results hardly depend on the lower one; 2..5 serve as the upper.
    pub sigma_min: f32,
    pub sigma_max: f32,

    /// How many nearest viewpoints are recalled (section III-D: seven). At most 16: votes are bit masks and the
    /// work grows with it.
    pub views: usize,
    /// Of these, how many are recalled of a frame that others wait for, or that took the place of one nobody had time
    /// for. With four the cup of `tabletop` is found as well as with seven, and a frame that is left out finds nothing.
    /// As many as `views`: a frame never costs less.
    pub views_busy: usize,
    /// Views farther than this, metres of view distance, are left out beyond the three nearest, and also among these where
    /// one is thirty times nearer: where viewpoints are sparse the seventh sees another side of things, and edges flash.
    /// 1e6 = no limit, as in the paper.
    pub view_distance_max_m: f64,
    /// Metres of view distance that one radian between viewing directions counts for. Insensitive from 0.3 to 3.
    pub metres_per_radian: f64,
    /// A mesh is cut where depth jumps by more than this share. Insensitive from 2 to 15 %.
    pub mesh_cut: f32,

    /// Correct the pose against the expected image before scoring (step 1).
    pub refine_pose: bool,
    /// Assumed pose error where a frame does not say, standard deviation per axis, metres and radians. At least
    /// 2 mm and 0.2 degrees are assumed in any case: less lets refinement trust a tracker too much.
    pub pose_position_sd_m: f64,
    pub pose_rotation_sd_rad: f64,

    /// The same for single robots, by their name: `--set robots.NAME.pose_position_sd_m=0.01`.
    #[serde(default)]
    pub robots: BTreeMap<String, RobotSettings>,

    /// Views whose depth is far from the median are outvoted (step 2a).
    pub depth_vote: bool,
    /// How far, as a share of the median.
    pub depth_vote_tolerance: f32,
    /// Views whose colour is far from the medoid are outvoted (step 2b).
    pub colour_vote: bool,
    /// Views written during this visit count little until rewritten often (step 2).
    pub fresh_views: bool,
    /// Disagreement of the views adds to the variance: beta += alpha * Var_views(tau) (step 2c).
    pub view_variance: bool,
    /// Remember what was there before (steps 2d, 5, 6).
    pub earlier_appearance: bool,
    /// Evaluate (10) once more after the observation for tau and sigma (step 5).
    pub second_look: bool,

    pub unseen_start: UnseenStart,
    /// Grey levels squared; of a pixel seen once.
    pub unseen_variance: f32,
    /// Divide the observation by one scalar a frame, the median of Y/tau_Y (step 3).
    pub exposure_gain: bool,
    /// Pixel error at edges that refinement leaves, standard deviation; for the score only (step 4). 0 = none.
    pub edge_error_px: f32,

    pub replacement: Replacement,
    /// Where `append_then_nearest` stops appending (section V: 200).
    pub viewpoints: usize,
    /// Home distance from which `grow_home` appends, metres of view distance.
    pub grow_distance_m: f64,
    /// Budget of one place's viewpoints in RAM, bytes. When it is full the nearest of the selected is replaced.
    /// Where viewpoints are stored, those that are not needed leave RAM first.
    pub memory_bytes: usize,
    /// A crash loses at most what was learnt in the last so many seconds; a clean stop loses nothing. Less writes what
    /// changes often more often.
    pub write_behind_s: f64,

    pub evidence: Evidence,
    /// Nats of evidence from which a block seeds a region. 6 separates well on every recording measured.
    pub surprise_threshold: f32,
    /// A region reaches to where the box-filtered map falls below this share of its seed.
    pub region_fraction: f32,
    /// Strip along the border that seeds no region, pixels: predictions often end there.
    pub border_px: usize,
    /// Regions reported a frame. A frame with more is a changed place, not so many objects.
    pub regions_max: usize,

    /// Frames with more pixels are refused before they are decoded.
    pub image_pixels_max: usize,
    /// Depth outside is taken as none, metres.
    pub depth_min_m: f32,
    pub depth_max_m: f32,
    /// Where depth is computed from three cameras: how many depths are tried at every pixel, at equal distances of
    /// 1/depth. Half a pixel of shift between two cameras from one to the next is as fine as the images tell; time
    /// grows with it. A label is a byte: at most 255.
    pub depth_labels: usize,
    /// Nearest and farthest of them, metres. What is nearer is taken for something else; a far end of 1e6 is infinity.
    pub depth_near_m: f64,
    pub depth_far_m: f64,
    /// What a camera's frames do to the memory until somebody says otherwise: `learn`, `observe` or `freeze`.
    pub mode: Mode,
    /// How long a frame without a pose waits for one from the `pose` or `markers` key, seconds.
    pub pose_wait_s: f64,
    /// Pull mode: how often the service gets each robot's `frame` key, per second. 0 = robots push.
    pub pull_hz: f64,

    /// Threads of the engine; 0 = one a core.
    pub threads: usize,
}

/// 320x240 viewpoints take 3 MB: room for 330.
const MEMORY_BYTES: usize = 1 << 30;

impl Settings {
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Paper => Self::paper(),
            Preset::Robust => Self::robust(),
        }
    }

    pub fn paper() -> Self {
        Self {
            xi: 0.003,
            views_busy: 7,
            view_distance_max_m: 1e6,
            refine_pose: false,
            depth_vote: false,
            colour_vote: false,
            fresh_views: false,
            view_variance: false,
            earlier_appearance: false,
            second_look: false,
            unseen_start: UnseenStart::Paper,
            exposure_gain: false,
            edge_error_px: 0.0,
            replacement: Replacement::AppendThenNearest,
            evidence: Evidence::Blocks,
            ..Self::robust()
        }
    }

    pub fn robust() -> Self {
        Self {
            forgetting: 0.8,
            xi: 0.01,
            sigma_min: 0.05,
            sigma_max: 5.0,
            views: 7,
            views_busy: 4,
            view_distance_max_m: 0.16,
            metres_per_radian: 1.0,
            mesh_cut: 0.05,
            refine_pose: true,
            pose_position_sd_m: 0.002,
            pose_rotation_sd_rad: 0.2_f64.to_radians(),
            robots: BTreeMap::new(),
            depth_vote: true,
            depth_vote_tolerance: 0.03,
            colour_vote: true,
            fresh_views: true,
            view_variance: true,
            earlier_appearance: true,
            second_look: true,
            unseen_start: UnseenStart::Observation,
            unseen_variance: 100.0,
            exposure_gain: true,
            edge_error_px: 0.5,
            replacement: Replacement::GrowHome,
            viewpoints: 200,
            grow_distance_m: 0.025,
            memory_bytes: MEMORY_BYTES,
            write_behind_s: 2.0,
            evidence: Evidence::BlockMedian,
            surprise_threshold: 6.0,
            region_fraction: 0.3,
            border_px: 16,
            regions_max: 16,
            image_pixels_max: 8_000_000,
            depth_min_m: 0.05,
            depth_max_m: 100.0,
            depth_labels: 64,
            depth_near_m: 0.4,
            depth_far_m: 20.0,
            mode: Mode::Learn,
            pose_wait_s: 0.2,
            pull_hz: 0.0,
            threads: 0,
        }
    }

    /// A preset with a settings file's text (TOML) and then `name=value` pairs laid over it, validated.
    ///
    /// # Errors
    /// Unknown names, values of the wrong type and values out of bounds, each naming the setting.
    pub fn layered(
        preset: Preset,
        file: Option<&str>,
        pairs: &[String],
    ) -> Result<Self, ConfigError> {
        let mut table = toml::Table::try_from(Self::preset(preset))
            .expect("settings are a flat table of numbers and words");
        if let Some(text) = file {
            table.extend(text.parse::<toml::Table>().map_err(ConfigError::File)?);
        }
        for pair in pairs {
            let (name, value) = pair
                .split_once('=')
                .ok_or_else(|| ConfigError::Pair(pair.clone()))?;
            let (name, value) = (name.trim(), value.trim());
            let slot = match name.strip_prefix("robots.").and_then(|n| n.split_once('.')) {
                None => table.entry(name.to_owned()),
                Some((robot, of_robot)) => robot_table(&mut table, robot)
                    .ok_or_else(|| ConfigError::Unknown(name.to_owned()))?
                    .entry(of_robot.to_owned()),
            };
            // A bare word is a string and `3` is good enough for `3.0`, as a person would type it.
            let parsed = format!("value = {value}")
                .parse::<toml::Table>()
                .ok()
                .and_then(|mut parsed| parsed.remove("value"))
                .unwrap_or_else(|| toml::Value::String(value.to_owned()));
            let is_float = |known: &toml::Value| known.is_float();
            match (slot, parsed) {
                (toml::map::Entry::Vacant(_), _) if !name.starts_with("robots.") => {
                    return Err(ConfigError::Unknown(name.to_owned()));
                }
                (toml::map::Entry::Vacant(slot), parsed) => {
                    slot.insert(parsed);
                }
                (toml::map::Entry::Occupied(mut slot), toml::Value::Integer(whole))
                    if is_float(slot.get()) =>
                {
                    slot.insert(toml::Value::Float(whole as f64));
                }
                (toml::map::Entry::Occupied(mut slot), parsed) => {
                    slot.insert(parsed);
                }
            }
        }
        let settings: Self = table.try_into().map_err(ConfigError::File)?;
        settings.validate()?;
        Ok(settings)
    }

    /// The pose noise of a robot whose frames do not say.
    pub fn pose_noise(&self, robot: &str) -> PoseNoise {
        let own = self.robots.get(robot).copied().unwrap_or_default();
        PoseNoise {
            position_m: own.pose_position_sd_m.unwrap_or(self.pose_position_sd_m),
            rotation_rad: own
                .pose_rotation_sd_rad
                .unwrap_or(self.pose_rotation_sd_rad),
        }
    }

    /// How a robot's cameras begin.
    pub fn mode(&self, robot: &str) -> Mode {
        let own = self.robots.get(robot).and_then(|robot| robot.mode);
        own.unwrap_or(self.mode)
    }

    /// # Errors
    /// The first setting out of its bounds, with the bounds.
    pub fn validate(&self) -> Result<(), ConfigError> {
        fn within<T: PartialOrd + std::fmt::Display>(
            name: &'static str,
            value: T,
            low: T,
            high: T,
        ) -> Result<(), ConfigError> {
            // Written so that NaN fails.
            if value >= low && value <= high {
                return Ok(());
            }
            Err(ConfigError::Bound {
                name,
                value: value.to_string(),
                low: low.to_string(),
                high: high.to_string(),
            })
        }
        within("forgetting", self.forgetting, 0.5, 0.9)?;
        within("xi", self.xi, 0.0, 10.0)?;
        within("sigma_min", self.sigma_min, 1e-3, 100.0)?;
        within("sigma_max", self.sigma_max, self.sigma_min, 1000.0)?;
        within("views", self.views, 1, 16)?;
        within("views_busy", self.views_busy, 1, 16)?;
        within("view_distance_max_m", self.view_distance_max_m, 0.0, 1e6)?;
        within("metres_per_radian", self.metres_per_radian, 0.0, 100.0)?;
        within("mesh_cut", self.mesh_cut, 1e-3, 1.0)?;
        within("pose_position_sd_m", self.pose_position_sd_m, 0.0, 1.0)?;
        within("pose_rotation_sd_rad", self.pose_rotation_sd_rad, 0.0, 1.0)?;
        within("depth_vote_tolerance", self.depth_vote_tolerance, 1e-3, 1.0)?;
        within("unseen_variance", self.unseen_variance, 1.0, 1e4)?;
        within("edge_error_px", self.edge_error_px, 0.0, 10.0)?;
        within("viewpoints", self.viewpoints, 1, 1_000_000)?;
        within("grow_distance_m", self.grow_distance_m, 0.0, 100.0)?;
        within("memory_bytes", self.memory_bytes, 1 << 20, 1 << 46)?;
        within("write_behind_s", self.write_behind_s, 0.1, 3600.0)?;
        within("surprise_threshold", self.surprise_threshold, 0.01, 1e6)?;
        within("region_fraction", self.region_fraction, 0.01, 1.0)?;
        within("border_px", self.border_px, 0, 1000)?;
        within("regions_max", self.regions_max, 1, 1000)?;
        within("image_pixels_max", self.image_pixels_max, 64, 64_000_000)?;
        within("depth_min_m", self.depth_min_m, 1e-3, 1e3)?;
        within("depth_max_m", self.depth_max_m, self.depth_min_m, 1e4)?;
        within("depth_labels", self.depth_labels, 2, 255)?;
        within("depth_near_m", self.depth_near_m, 1e-2, 1e3)?;
        within(
            "depth_far_m",
            self.depth_far_m,
            1.1 * self.depth_near_m,
            1e6,
        )?;
        within("pose_wait_s", self.pose_wait_s, 0.0, 10.0)?;
        within("pull_hz", self.pull_hz, 0.0, 1000.0)?;
        for robot in self.robots.values() {
            let position_sd_m = robot.pose_position_sd_m.unwrap_or(0.0);
            within("robots.*.pose_position_sd_m", position_sd_m, 0.0, 1.0)?;
            let rotation_sd_rad = robot.pose_rotation_sd_rad.unwrap_or(0.0);
            within("robots.*.pose_rotation_sd_rad", rotation_sd_rad, 0.0, 1.0)?;
        }
        within("threads", self.threads, 0, 1024)
    }
}

/// The settings of one robot, made if there are none yet; `None` where something else stands in their place.
fn robot_table<'a>(settings: &'a mut toml::Table, robot: &str) -> Option<&'a mut toml::Table> {
    let empty = || toml::Value::Table(toml::Table::new());
    settings
        .entry("robots")
        .or_insert_with(empty)
        .as_table_mut()?
        .entry(robot)
        .or_insert_with(empty)
        .as_table_mut()
}

/// With the kinds of values as a person would call them.
fn in_words(error: &toml::de::Error) -> String {
    let mut text = error.to_string();
    for (kind, words) in [
        ("expected usize", "expected a whole number"),
        ("expected f32", "expected a number"),
        ("expected f64", "expected a number"),
        ("unit variant, expected string only", "expected a word"),
    ] {
        text = text.replace(kind, words);
    }
    text.trim_end().replace("\nin `", " in `")
}

#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{0}")]
    Memory(String),
    #[error("settings: {}", in_words(.0))]
    File(toml::de::Error),
    #[error("{option} {file}: {error}")]
    Read {
        option: &'static str,
        file: String,
        error: std::io::Error,
    },
    #[error(
        "--root {0}: a root is a Zenoh key without wildcards, such as surprised or site/surprised"
    )]
    Root(String),
    #[error("Zenoh: {0}")]
    Zenoh(String),
    #[error(
        "--http {0} can be reached from elsewhere: give --http-token-file FILE, listen on 127.0.0.1 behind a proxy, or say --http-no-token to let everybody in"
    )]
    NoToken(SocketAddr),
    #[error(
        "--http-token-file {0}: a token is one line of 16 to 1024 visible ASCII characters without spaces, such as `openssl rand -hex 32` makes"
    )]
    Token(String),
    #[error("--set {0}: write it as name=value")]
    Pair(String),
    #[error(
        "there is no setting called `{0}`; `surprised serve --help` says where they are listed"
    )]
    Unknown(String),
    #[error("settings: no robot can be called `{0}`: names are made of a-z, 0-9, _ and -")]
    Robot(String),
    #[error("setting `{name}` is {value}, but must be between {low} and {high}")]
    Bound {
        name: &'static str,
        value: String,
        low: String,
        high: String,
    },
}
