//! Compares what a service reports with what really happened: which placed things were noticed, and which regions had no
//! reason.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    afterimage::Afterimages,
    script::{Capture, Script},
    story::PERSON,
};
use crate::model::{camera::Intrinsics, report::PixelBox};

/// A thing smaller than this in an image is not expected to be noticed there, pixels: evidence blocks need 12x12.
const VISIBLE_PX: usize = 144;
/// Visible in so many frames, a thing can be noticed.
const VISIBLE_FRAMES: u32 = 3;
/// Overlap of a region's box with a thing's from which it is the thing.
const SAME_IOU: f64 = 0.2;
/// A region this close to something that changed has a reason (its shadow, its reflection), pixels.
const NEAR_PX: u32 = 8;
/// What a person hid or shaded may surprise for so long after the person is gone, frames. Where the person itself was,
/// surprise tells nothing until a camera has come back: see [`Afterimages`].
const PERSON_ECHO: u32 = 7;

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Thing {
    /// It was put down, or taken away, since the first frame.
    changed: bool,
    placed: bool,
    visible: u32,
    noticed: bool,
}

/// Of one camera.
#[derive(Debug, Clone, Default)]
struct Watch {
    standing_at_first: Option<BTreeSet<usize>>,
    since_person: Option<u32>,
}

/// The verdict so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Verdict {
    /// Things that were put down where some robot could see them well.
    pub placed: usize,
    pub noticed: usize,
    /// Followed regions that never had a reason.
    pub false_alarms: usize,
}

pub struct Judge {
    names: Vec<&'static str>,
    /// Of each station.
    cameras: Vec<Intrinsics>,
    things: Vec<Thing>,
    watches: BTreeMap<usize, Watch>,
    /// All stations share a memory.
    afterimages: Afterimages,
    /// Whether a followed region ever had a reason, by its id.
    regions: BTreeMap<u64, bool>,
}

impl Judge {
    pub fn new(script: &Script) -> Self {
        let items = &script.story.items;
        Self {
            names: items.iter().map(|item| item.name).collect(),
            cameras: script
                .stations
                .iter()
                .map(|station| station.rig.intrinsics)
                .collect(),
            things: vec![Thing::default(); items.len()],
            watches: BTreeMap::new(),
            afterimages: Afterimages::default(),
            regions: BTreeMap::new(),
        }
    }

    /// A frame of a station with the regions, `(id, box)`, that were reported for it. Returns what each one is; `None`
    /// where nothing there has changed.
    pub fn take(
        &mut self,
        station: usize,
        capture: &Capture,
        regions: &[(u64, PixelBox)],
    ) -> Vec<Option<&'static str>> {
        let standing: BTreeSet<usize> = capture.moment.standing.iter().copied().collect();
        let watch = self.watches.entry(station).or_default();
        let first = watch
            .standing_at_first
            .get_or_insert_with(|| standing.clone());
        for (index, thing) in self.things.iter_mut().enumerate() {
            let (stood, stands) = (first.contains(&index), standing.contains(&index));
            thing.placed |= stands && !stood;
            thing.changed |= stands != stood;
        }
        watch.since_person = match (&capture.moment.person, watch.since_person) {
            (Some(_), _) => Some(0),
            (None, since) => since.map(|frames| frames + 1),
        };
        let person_echoes = watch
            .since_person
            .is_some_and(|frames| frames <= PERSON_ECHO);

        let width = capture.middle.image.width;
        let boxes: Vec<Option<(PixelBox, usize)>> = capture
            .middle
            .masks
            .iter()
            .map(|mask| bounds(mask.iter().map(|&value| value != 0), width))
            .collect();
        for (index, thing) in self.things.iter_mut().enumerate() {
            let visible = boxes[index].is_some_and(|(_, pixels)| pixels >= VISIBLE_PX);
            thing.visible += u32::from(thing.placed && standing.contains(&index) && visible);
        }
        let person = bounds(capture.middle.object.iter().map(|&id| id == PERSON), width);
        let camera = &self.cameras[station];
        let afterimage = self.afterimages.squares(camera, &capture.world_from_camera);
        self.afterimages
            .look(station, camera, &capture.world_from_camera, &capture.middle);

        regions
            .iter()
            .map(|&(id, region)| {
                // What covers most of the region's box; else what is near it.
                let thing = (0..self.things.len())
                    .filter(|&index| {
                        self.things[index].changed
                            && boxes[index].is_some_and(|(thing, _)| near(&thing, &region))
                    })
                    .map(|index| {
                        let mask = &capture.middle.masks[index];
                        (covered(&region, width, |pixel| mask[pixel] != 0), index)
                    })
                    .max();
                if let Some((_, index)) = thing
                    && standing.contains(&index)
                    && boxes[index].is_some_and(|(thing, _)| is_same(&thing, &region))
                {
                    self.things[index].noticed = true;
                }
                let by_person = person.filter(|(person, _)| near(person, &region)).map(|_| {
                    covered(&region, width, |pixel| {
                        capture.middle.object[pixel] == PERSON
                    })
                });
                let reason = match (thing, by_person) {
                    (Some((by_thing, index)), by_person)
                        if by_person.is_none_or(|p| p <= by_thing) =>
                    {
                        Some(self.names[index])
                    }
                    (_, Some(_)) => Some("person"),
                    _ if person_echoes || afterimage.touch(&region, NEAR_PX) => {
                        Some("where the person was")
                    }
                    _ => None,
                };
                *self.regions.entry(id).or_default() |= reason.is_some();
                reason
            })
            .collect()
    }

    pub fn verdict(&self) -> Verdict {
        let placed = self
            .things
            .iter()
            .filter(|thing| thing.placed && thing.visible >= VISIBLE_FRAMES);
        Verdict {
            placed: placed.clone().count(),
            noticed: placed.filter(|thing| thing.noticed).count(),
            false_alarms: self.regions.values().filter(|reason| !**reason).count(),
        }
    }
}

/// Bounding box and number of the pixels that are set.
fn bounds(set: impl Iterator<Item = bool>, width: usize) -> Option<(PixelBox, usize)> {
    let mut found: Option<(PixelBox, usize)> = None;
    for (pixel, _) in set.enumerate().filter(|(_, set)| *set) {
        let (x, y) = ((pixel % width) as u32, (pixel / width) as u32);
        let (around, count) = found.get_or_insert((
            PixelBox {
                x_min: x,
                y_min: y,
                x_max: x + 1,
                y_max: y + 1,
            },
            0,
        ));
        around.x_min = around.x_min.min(x);
        around.x_max = around.x_max.max(x + 1);
        around.y_max = around.y_max.max(y + 1);
        *count += 1;
    }
    found
}

/// How many pixels of a box are set.
fn covered(region: &PixelBox, width: usize, set: impl Fn(usize) -> bool) -> usize {
    (region.y_min..region.y_max)
        .flat_map(|y| (region.x_min..region.x_max).map(move |x| y as usize * width + x as usize))
        .filter(|&pixel| set(pixel))
        .count()
}

fn near(thing: &PixelBox, region: &PixelBox) -> bool {
    thing.x_min < region.x_max + NEAR_PX
        && region.x_min < thing.x_max + NEAR_PX
        && thing.y_min < region.y_max + NEAR_PX
        && region.y_min < thing.y_max + NEAR_PX
}

/// The region's centre lies on the thing, or the boxes overlap well.
fn is_same(thing: &PixelBox, region: &PixelBox) -> bool {
    let (x, y) = (
        (region.x_min + region.x_max) / 2,
        (region.y_min + region.y_max) / 2,
    );
    let inside = (thing.x_min..thing.x_max).contains(&x) && (thing.y_min..thing.y_max).contains(&y);
    inside || thing.iou(region) >= SAME_IOU
}
