//! Regions followed over time and across cameras: events. The paper stops at the region of a frame; here is what an
//! operator is told.
//!
//! A frame's regions, depth, evidence and pose -> events that are new, have news, or have ended.
//!
//! - *Which is which*: a region belongs to the event that it was in before (its id says so), else to the nearest one whose
//!   place is within [`SAME_WITHIN_M`], the size of a tabletop object, or within the larger one's half size, because
//!   cameras on two sides of a thing see centres that far apart; never beyond [`SAME_WITHIN_MAX_M`].
//! - *Where*: where its thing appears now; where that was before, it has left.
//! - *New*: in two frames. In the second it need not surprise any more, because a camera that stands still learns a thing
//!   at once: it is enough that its place still looks as it did when it surprised, rather than as it was expected. A
//!   flicker of one frame does not; it is dropped when its camera sees the place without it.
//! - *End*: [`CLEAR_LOOKS`] frames in a row, of any cameras, saw its place and nothing surprising there. A look counts if
//!   the place lies inside the image, nothing stands before it, and it appears at least half as large as when it was
//!   last seen. What nobody looks at does not end.
//! - *Unseen*: a connected area of at least [`UNSEEN_SHARE`] of a frame that has depth and that no viewpoint knows. It
//!   tells where surprise says nothing, so that silence is not taken for peace: a robot in a part of the place where none
//!   was before, or far off its pose. It is new when it is seen a second time (a wild pose does not come twice), grows
//!   with what lies beside it, and ends when most of it was seen again and is known.
//!
//! No clock: ages are counted in frames of the place, and stamps of different robots are never compared.

mod appearance;

mod picture;

mod unseen;

use std::sync::Arc;

use nalgebra::{Point3, Vector3};

use self::{
    appearance::Patch,
    unseen::{UNSEEN_KEPT, UNSEEN_SHARE, UnseenArea},
};
use crate::{
    config::Settings,
    model::{
        event::{EndReason, Event, Kind, Picture, Sighting, State},
        frame::{RgbImage, Source},
        report::{PixelBox, Region},
    },
    stages::{
        attend::{BLOCK, BlockMap, SAME_WITHIN_M, Scene},
        interpolate::prior::{COVERAGE, Prior},
    },
};

/// Events of a place that last at the same time. More is a changed place, not so many objects.
pub const OPEN_MAX: usize = 64;
/// Seen once so far.
const CANDIDATES_MAX: usize = 64;
/// How far apart the same thing may appear, metres: further than furniture is wide.
const SAME_WITHIN_MAX_M: f64 = 0.5;
/// How far apart parts of one unseen area may be, metres.
const SAME_AREA_WITHIN_M: f64 = 0.5;
/// Frames that make an event of a candidate.
const SIGHTINGS_MIN: u32 = 2;
/// Longer than a region may be missing and still be followed in the image.
pub const CLEAR_LOOKS: u32 = 8;
/// Frames of the place after which a candidate is forgotten.
const CANDIDATE_FRAMES: u64 = 64;
/// News that are only a later sighting are told as often, nanoseconds.
const UPDATE_EVERY_NS: u64 = 1_000_000_000;
/// A peak that rises by less is no news.
const PEAK_RISE: f32 = 1.1;
/// Pairs of camera and region that an event is known by.
const KNOWN_BY_MAX: usize = 64;
const ROBOTS_MAX: usize = 64;
/// Of an unseen area, to tell when it has been seen.
const POINTS_MAX: usize = 64;
/// Quarters of an unseen area that are known when it ends.
const KNOWN_OF_4: usize = 3;
/// What stands before a place hides it: nearer by this share of the distance and this length, metres, beyond its extent.
const OCCLUDED_SHARE: f64 = 0.05;
const OCCLUDED_M: f64 = 0.05;

/// A processed frame, as events look at it.
pub struct Look<'a> {
    pub source: &'a Source,
    pub stamp_ns: i64,
    pub sequence: u64,
    pub image: &'a RgbImage,
    pub scene: Scene<'a>,
    pub evidence: &'a BlockMap,
    /// Share of the pixels that no viewpoint saw, 0..1.
    pub unseen_share: f32,
    /// What was expected. Asked only where something is surprising or much is unseen.
    pub prior: &'a dyn Fn() -> &'a Prior,
}

impl<'a> Look<'a> {
    fn prior(&self) -> Option<&'a Prior> {
        let prior = (self.prior)();
        // An engine that lost its maps has none.
        let size = (self.scene.intrinsics.width, self.scene.intrinsics.height);
        ((prior.width, prior.height) == size).then_some(prior)
    }

    fn rgb(&self, x: usize, y: usize) -> [u8; 3] {
        let at = 3 * (y * self.image.width + x);
        [
            self.image.data[at],
            self.image.data[at + 1],
            self.image.data[at + 2],
        ]
    }

    fn sighting(&self, pixel_box: PixelBox, surprise: f32) -> Sighting {
        Sighting {
            source: self.source.clone(),
            stamp_ns: self.stamp_ns,
            sequence: self.sequence,
            pixel_box,
            surprise,
        }
    }
}

/// The events of a place that last.
#[derive(Debug, Clone, Default)]
pub struct Events {
    followed: Vec<Followed>,
    frames: u64,
    last_id: u64,
}

#[derive(Debug, Clone)]
struct Followed {
    event: Event,
    /// Told of; before that it is a candidate.
    told: Option<Told>,
    born: u64,
    /// The place's frame in which it was last.
    last_frame: u64,
    /// Looks in a row that saw its place without it.
    clear: u32,
    last_center: Option<Point3<f64>>,
    /// Half the box's longer side when it was last seen, pixels.
    half_size_px: f64,
    /// How good the picture's sighting is: not cut by the border, then surprise.
    best: Option<(bool, f32)>,
    /// By which ids which cameras report it.
    known_by: Vec<(Source, u64)>,
    /// Of a candidate: how it looked when it surprised.
    patches: Vec<Patch>,
    /// Of an unseen area: points of it in the world, and whether they are known by now.
    points: Vec<(Point3<f64>, bool)>,
}

/// What was told last.
#[derive(Debug, Clone)]
struct Told {
    stamp_ns: i64,
    peak: f32,
    robots: usize,
}

/// What a frame says about a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    /// It was not seen, or too small or hidden.
    Nothing,
    /// As expected.
    Clear,
    /// Still surprising, or unknown.
    Surprising,
}

impl Events {
    /// Follows a frame's regions, writes the ids of their events into them, and returns what has changed, at most
    /// `2 * OPEN_MAX` events.
    pub fn observe(
        &mut self,
        look: &Look,
        regions: &mut [Region],
        settings: &Settings,
    ) -> Vec<Event> {
        self.frames += 1;
        let mut changed = Vec::new();
        // Of each region, the id of what it belongs to.
        let mut ids = Vec::new();
        for region in regions.iter() {
            ids.push(self.sight_region(look, region, settings));
        }
        let follows_unseen = self
            .followed
            .iter()
            .any(|followed| followed.event.kind == Kind::Unseen);
        let least = if follows_unseen {
            UNSEEN_KEPT
        } else {
            UNSEEN_SHARE
        };
        let prior = (look.unseen_share >= least).then(|| look.prior()).flatten();
        if let Some(prior) = prior {
            for area in unseen::areas(prior, &look.scene) {
                self.sight_area(look, area);
            }
        }
        let frames = self.frames;
        self.followed.retain_mut(|followed| {
            let here = followed.last_frame == frames;
            let seen_again = if here {
                followed.event.sightings >= SIGHTINGS_MIN
            } else {
                followed.settle(look, prior, settings)
            };
            if followed.told.is_some() {
                return followed.go_on(look.stamp_ns, here, &mut changed);
            }
            if seen_again {
                followed.tell(look.stamp_ns, State::New, &mut changed);
                return true;
            }
            // The camera that saw it does not any more, or nobody does.
            let flickered = followed.clear > 0 && followed.event.last.source == *look.source;
            !flickered && followed.clear < CLEAR_LOOKS && followed.born + CANDIDATE_FRAMES > frames
        });
        self.make_room(look.stamp_ns, &mut changed);
        for (region, id) in regions.iter_mut().zip(ids) {
            let told = self
                .followed
                .iter()
                .any(|followed| followed.event.id == id && followed.told.is_some());
            region.event_id = if told { id } else { 0 };
        }
        changed
    }

    /// Goes on with an event that was told of before, as after a restart: what it looked like and who reports it under
    /// which id is found out anew. Nothing happens for one that is followed or has ended.
    pub fn resume(&mut self, event: Event) {
        let is_known = |followed: &Followed| followed.event.id == event.id;
        let told = self.followed.iter().filter(|f| f.told.is_some()).count();
        self.last_id = self.last_id.max(event.id);
        if !event.is_open() || self.followed.iter().any(is_known) || told >= OPEN_MAX {
            return;
        }
        let points = event.unseen_points.iter().map(|&point| (point, false));
        self.followed.push(Followed {
            told: Some(Told {
                stamp_ns: event.last_seen_ns,
                peak: event.peak_surprise,
                robots: event.robots.len(),
            }),
            born: self.frames,
            last_frame: self.frames,
            clear: 0,
            last_center: event.center_in_world,
            half_size_px: half_size_px(event.last.pixel_box),
            best: Some((true, event.peak_surprise)),
            known_by: Vec::new(),
            patches: Vec::new(),
            points: points.collect(),
            event,
        });
    }

    /// The id of the event or candidate that the region belongs to.
    fn sight_region(&mut self, look: &Look, region: &Region, settings: &Settings) -> u64 {
        let placed = region
            .center_in_world
            .map(|center| (center, extent(region.pixel_box, &center, &look.scene)));
        let sighting = look.sighting(region.pixel_box, region.peak_surprise);
        let index = self
            .event_of(look.source, region.id, placed.as_ref())
            .or_else(|| self.begin(Kind::Change, sighting.clone()));
        let Some(index) = index else {
            return 0;
        };
        let followed = &mut self.followed[index];
        if let Some((center, _)) = placed {
            followed.last_center = Some(center);
        }
        followed.known_by(look.source, region.id);
        followed.half_size_px = half_size_px(region.pixel_box);
        // A hand that puts a cup down is one region with it: what counts is where and what it is when the hand is gone.
        if followed.last_frame != self.frames
            && placed.is_some_and(|placed| followed.has_left_for(&placed))
        {
            followed.best = None;
        }
        let rank = (!region.touches_border, region.peak_surprise);
        if followed.best.is_none_or(|best| {
            (rank.0 && !best.0) || (rank.0 == best.0 && rank.1 > PEAK_RISE * best.1)
        }) {
            followed.best = Some(rank);
            followed.event.peak = sighting.clone();
            if let Some((center, extent)) = placed {
                followed.event.center_in_world = Some(center);
                followed.event.extent_in_world = extent;
            }
            followed.event.picture = Some(pictured(look, region.pixel_box));
            if let (None, Some(prior)) = (&followed.told, look.prior()) {
                followed.patches = appearance::patches(look, prior, region, settings);
            }
        }
        followed.sighted(sighting, self.frames);
        followed.event.id
    }

    /// The event that a region belongs to.
    fn event_of(
        &self,
        source: &Source,
        region_id: u64,
        placed: Option<&(Point3<f64>, Vector3<f64>)>,
    ) -> Option<usize> {
        let changes = || {
            let followed = self.followed.iter().enumerate();
            followed.filter(|(_, followed)| followed.event.kind == Kind::Change)
        };
        let known = changes().find(|(_, followed)| {
            followed
                .known_by
                .iter()
                .any(|(by, id)| by == source && *id == region_id)
        });
        if let Some((index, _)) = known {
            return Some(index);
        }
        let (center, extent) = placed?;
        changes()
            .filter_map(|(index, followed)| {
                let event = &followed.event;
                let distances = [event.center_in_world, followed.last_center]
                    .into_iter()
                    .flatten()
                    .map(|other| (other - center).norm());
                let distance_m = distances.min_by(f64::total_cmp)?;
                (distance_m < followed.reach_m(extent)).then_some((index, distance_m))
            })
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(index, _)| index)
    }

    fn sight_area(&mut self, look: &Look, area: UnseenArea) {
        let (center, extent) = area.bounds;
        let near = self.followed.iter().position(|followed| {
            let event = &followed.event;
            let other = event.center_in_world.filter(|_| event.kind == Kind::Unseen);
            other.is_some_and(|other| {
                let gap = (other - center).abs() - extent - event.extent_in_world;
                gap.max() < SAME_AREA_WITHIN_M
            })
        });
        let sighting = look.sighting(area.pixel_box, 0.0);
        let index = match near {
            Some(index) => index,
            None if area.share < UNSEEN_SHARE => return,
            None => {
                let Some(index) = self.begin(Kind::Unseen, sighting.clone()) else {
                    return;
                };
                self.followed[index].event.center_in_world = Some(center);
                self.followed[index].event.extent_in_world = extent;
                index
            }
        };
        let followed = &mut self.followed[index];
        let event = &mut followed.event;
        if area.share > event.unseen_share {
            event.unseen_share = area.share;
            event.peak = sighting.clone();
            event.picture = Some(pictured(look, area.pixel_box));
        }
        (event.center_in_world, event.extent_in_world) = {
            let own = (
                event.center_in_world.unwrap_or(center),
                event.extent_in_world,
            );
            let (center, extent) = united(own, area.bounds);
            (Some(center), extent)
        };
        followed
            .points
            .extend(area.points.into_iter().map(|point| (point, false)));
        while followed.points.len() > POINTS_MAX {
            let mut odd = false;
            followed.points.retain(|_| {
                odd = !odd;
                odd
            });
        }
        followed.sighted(sighting, self.frames);
    }

    /// A candidate; its index. `None` where this frame alone brought too many.
    fn begin(&mut self, kind: Kind, sighting: Sighting) -> Option<usize> {
        let candidates = || {
            let followed = self.followed.iter().enumerate();
            followed.filter(|(_, followed)| followed.told.is_none())
        };
        if candidates().count() == CANDIDATES_MAX {
            let (oldest, _) = candidates()
                .filter(|(_, followed)| followed.last_frame < self.frames)
                .min_by_key(|(_, followed)| followed.last_frame)?;
            self.followed.remove(oldest);
        }
        let microseconds = u64::try_from(sighting.stamp_ns / 1000).unwrap_or(0);
        self.last_id = microseconds.max(self.last_id + 1);
        self.followed.push(Followed {
            event: Event {
                id: self.last_id,
                kind,
                state: State::New,
                first_seen_ns: sighting.stamp_ns,
                last_seen_ns: sighting.stamp_ns,
                ended_ns: None,
                center_in_world: None,
                extent_in_world: Vector3::zeros(),
                peak_surprise: 0.0,
                unseen_share: 0.0,
                unseen_points: Vec::new(),
                sightings: 0,
                robots: Vec::new(),
                peak: sighting.clone(),
                last: sighting,
                picture: None,
            },
            told: None,
            born: self.frames,
            last_frame: 0,
            clear: 0,
            last_center: None,
            half_size_px: 0.0,
            best: None,
            known_by: Vec::new(),
            patches: Vec::new(),
            points: Vec::new(),
        });
        Some(self.followed.len() - 1)
    }

    /// Ends what nobody has seen for longest where too many events last.
    fn make_room(&mut self, stamp_ns: i64, changed: &mut Vec<Event>) {
        loop {
            let told = || {
                let followed = self.followed.iter().enumerate();
                followed.filter(|(_, followed)| followed.told.is_some())
            };
            if told().count() <= OPEN_MAX {
                return;
            }
            let Some((longest, _)) = told().min_by_key(|(_, followed)| followed.last_frame) else {
                return;
            };
            let mut event = self.followed.remove(longest).event;
            event.state = State::End(EndReason::NoRoom);
            event.ended_ns = Some(stamp_ns);
            changed.push(event);
        }
    }
}

impl Followed {
    /// How far from its place something of the given half sizes is still the same, metres.
    fn reach_m(&self, extent: &Vector3<f64>) -> f64 {
        SAME_WITHIN_M
            .max(extent.max())
            .max(self.event.extent_in_world.max())
            .min(SAME_WITHIN_MAX_M)
    }

    fn has_left_for(&self, (center, extent): &(Point3<f64>, Vector3<f64>)) -> bool {
        let before = self.event.center_in_world;
        before.is_some_and(|before| (before - center).norm() >= self.reach_m(extent))
    }

    fn known_by(&mut self, source: &Source, region_id: u64) {
        let known = self.known_by.iter();
        let mut known = known.filter(|(by, id)| by == source && *id == region_id);
        if known.next().is_some() {
            return;
        }
        if self.known_by.len() == KNOWN_BY_MAX {
            self.known_by.remove(0);
        }
        self.known_by.push((source.clone(), region_id));
    }

    /// Counts it once a frame.
    fn sighted(&mut self, sighting: Sighting, frame: u64) {
        let event = &mut self.event;
        if self.last_frame != frame || event.sightings == 0 {
            event.sightings = event.sightings.saturating_add(1);
        }
        self.last_frame = frame;
        self.clear = 0;
        event.peak_surprise = event.peak_surprise.max(sighting.surprise);
        event.last_seen_ns = sighting.stamp_ns;
        let robot = &sighting.source.robot;
        if !event.robots.contains(robot) && event.robots.len() < ROBOTS_MAX {
            event.robots.push(robot.clone());
        }
        event.last = sighting;
    }

    /// Hears what a frame in which it was not says about it; whether that makes an event of a candidate.
    fn settle(&mut self, look: &Look, prior: Option<&Prior>, settings: &Settings) -> bool {
        if self.told.is_none() && appearance::is_still_there(&self.patches, look) == Some(true) {
            return true;
        }
        let verdict = match (self.event.kind, self.event.center_in_world) {
            (Kind::Change, Some(center)) => self.look_at(&center, look, settings),
            // Without a place it is where its camera looks.
            (Kind::Change, None) if self.event.last.source == *look.source => Verdict::Clear,
            (Kind::Change, None) => Verdict::Nothing,
            (Kind::Unseen, _) => self.look_around(look, prior),
        };
        match verdict {
            Verdict::Nothing => {}
            Verdict::Clear => self.clear += 1,
            Verdict::Surprising => self.clear = 0,
        }
        // What was never seen is known as soon as it has been: the second look need not find it unseen.
        self.event.kind == Kind::Unseen && verdict != Verdict::Nothing
    }

    /// Of an event: tells what has changed. False when it has ended.
    fn go_on(&mut self, stamp_ns: i64, here: bool, changed: &mut Vec<Event>) -> bool {
        if self.clear >= CLEAR_LOOKS {
            self.event.ended_ns = Some(stamp_ns);
            self.tell(stamp_ns, State::End(EndReason::SeenAgain), changed);
            return false;
        }
        let news = self.told.as_ref().is_some_and(|told| {
            here && (told.robots < self.event.robots.len()
                || told.peak * PEAK_RISE < self.event.peak_surprise
                // Robots' clocks may differ.
                || stamp_ns.abs_diff(told.stamp_ns) >= UPDATE_EVERY_NS)
        });
        if news {
            self.tell(stamp_ns, State::Update, changed);
        }
        true
    }

    fn tell(&mut self, stamp_ns: i64, state: State, changed: &mut Vec<Event>) {
        self.patches = Vec::new();
        self.event.state = state;
        let unknown = self.points.iter().filter(|(_, known)| !known);
        self.event.unseen_points = unknown.map(|(point, _)| *point).collect();
        self.told = Some(Told {
            stamp_ns,
            peak: self.event.peak_surprise,
            robots: self.event.robots.len(),
        });
        changed.push(self.event.clone());
    }

    fn look_at(&self, center: &Point3<f64>, look: &Look, settings: &Settings) -> Verdict {
        let extent_m = self.event.extent_in_world.max();
        let Some((u, v, z_m)) = in_image(center, &look.scene, extent_m, settings.border_px) else {
            return Verdict::Nothing;
        };
        let half_size_px = extent_m * look.scene.intrinsics.fx / z_m;
        if 2.0 * half_size_px < self.half_size_px {
            return Verdict::Nothing;
        }
        let blocks = look.evidence;
        let around = |at: usize, size: usize| {
            let block = (at / BLOCK).min(size.saturating_sub(1));
            block.saturating_sub(1)..(block + 2).min(size)
        };
        let most = around(v, blocks.height)
            .flat_map(|y| around(u, blocks.width).map(move |x| (x, y)))
            .map(|(x, y)| blocks.data[y * blocks.width + x])
            .fold(0.0, f32::max);
        if most > settings.surprise_threshold {
            Verdict::Surprising
        } else {
            Verdict::Clear
        }
    }

    /// Marks what is known by now. `prior`: `None` where everything that is seen is known.
    fn look_around(&mut self, look: &Look, prior: Option<&Prior>) -> Verdict {
        let mut seen = false;
        for (point, known) in &mut self.points {
            let Some((u, v, _)) = in_image(point, &look.scene, 0.0, 0) else {
                continue;
            };
            seen = true;
            *known |= prior.is_none_or(|prior| prior.row(v).plane(COVERAGE)[u] > 0.0);
        }
        let known = self.points.iter().filter(|(_, known)| *known).count();
        // The rest lay at the border, where nobody may look again.
        let enough = KNOWN_OF_4 * self.points.len() <= 4 * known;
        match (seen, enough) {
            (false, _) => Verdict::Nothing,
            (true, true) => Verdict::Clear,
            (true, false) => Verdict::Surprising,
        }
    }
}

/// Half of a box's longer side.
fn half_size_px(pixel_box: PixelBox) -> f64 {
    let side = |min: u32, max: u32| f64::from(max.saturating_sub(min));
    let PixelBox {
        x_min,
        y_min,
        x_max,
        y_max,
    } = pixel_box;
    side(x_min, x_max).max(side(y_min, y_max)) / 2.0
}

/// The pixel where a point in the world is seen, and its depth, metres; `None` outside of the image without its border
/// strip, and where something stands before it.
fn in_image(
    point: &Point3<f64>,
    scene: &Scene,
    extent_m: f64,
    border_px: usize,
) -> Option<(usize, usize, f64)> {
    let in_camera = scene.world_from_camera.inverse_transform_point(point);
    let (u, v) = scene.intrinsics.project(&in_camera)?;
    let (u, v) = (u.round(), v.round());
    let inside =
        |at: f64, size: usize| at >= border_px as f64 && at < size.saturating_sub(border_px) as f64;
    let (width, height) = (scene.intrinsics.width, scene.intrinsics.height);
    if !inside(u, width) || !inside(v, height) {
        return None;
    }
    let (u, v) = (u as usize, v as usize);
    let depth_m = f64::from(scene.depth_m[v * width + u]);
    let z_m = in_camera.z;
    let before_m = extent_m + (OCCLUDED_SHARE * z_m).max(OCCLUDED_M);
    // Where nothing was measured nothing is known to stand before it.
    let hidden = depth_m > 0.0 && depth_m < z_m - before_m;
    (!hidden).then_some((u, v, z_m))
}

/// Half sizes of the axis-parallel box in the world around a region: its box at its centre's depth, as deep as its
/// shorter side.
fn extent(pixel_box: PixelBox, center: &Point3<f64>, scene: &Scene) -> Vector3<f64> {
    let z_m = scene.world_from_camera.inverse_transform_point(center).z;
    let half =
        |min: u32, max: u32, focal: f64| f64::from(max.saturating_sub(min)) / 2.0 * z_m / focal;
    let right_m = half(pixel_box.x_min, pixel_box.x_max, scene.intrinsics.fx);
    let down_m = half(pixel_box.y_min, pixel_box.y_max, scene.intrinsics.fy);
    let ahead_m = right_m.min(down_m);
    let axes = scene.world_from_camera.rotation.to_rotation_matrix();
    axes.matrix().abs() * Vector3::new(right_m, down_m, ahead_m)
}

type Bounds = (Point3<f64>, Vector3<f64>);

/// The box around two boxes, each a centre and half sizes.
fn united(a: Bounds, b: Bounds) -> Bounds {
    let low = (a.0.coords - a.1).inf(&(b.0.coords - b.1));
    let high = (a.0.coords + a.1).sup(&(b.0.coords + b.1));
    (Point3::from((low + high) / 2.0), (high - low) / 2.0)
}

fn pictured(look: &Look, pixel_box: PixelBox) -> Arc<Picture> {
    Arc::new(picture::picture(look.image, look.prior(), pixel_box))
}
