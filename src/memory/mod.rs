//! What a place remembers: its viewpoints, how they grow, which one a new posterior replaces, and what is forgotten.
//!
//! Viewpoints may be stored durably; then the memory is what is in RAM of them, and an index of the others.

pub mod forget;

pub mod residency;

pub mod store;

pub mod visit;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use self::residency::{Absent, Change, Mark};
use crate::{
    config::{Replacement, Settings},
    model::{
        pose::{Pose, view_distance_m},
        viewpoint::Viewpoint,
    },
    stages::{
        select::{Nearest, select_into},
        view_tree::ViewTree,
    },
};

/// Up to so many viewpoints are looked at one by one for each selection: a few microseconds.
const LINEAR: usize = 256;

/// The viewpoints of one place.
#[derive(Debug, Default)]
pub struct Memory {
    /// Those in RAM.
    viewpoints: Vec<Arc<Viewpoint>>,
    /// One for each of them.
    marks: Vec<Mark>,
    /// Those that are only stored, by id.
    absent: BTreeMap<u64, Absent>,
    /// Ids of what changed since somebody took the changes; `None` where nobody stores them.
    changed: Option<BTreeSet<u64>>,
    /// Counts frames and questions: what they need is used most recently.
    turn: u64,
    bytes: usize,
    last_id: u64,
    replaced_for_room: u64,
    evicted: u64,
    /// Kept beyond [`LINEAR`] viewpoints.
    tree: ViewTree,
    /// Viewpoints came or went, so the tree says nothing until it is built again.
    tree_stale: bool,
}

/// Which state of a viewpoint is stored: under which lease it was written, and its revision. Later ones are greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Version {
    pub epoch: u64,
    pub revision: u64,
}

/// Where a posterior goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slot {
    Append,
    /// The viewpoint at this index of [`Memory::viewpoints`] is updated.
    Overwrite(usize),
    /// The viewpoint at this index is forgotten to make room.
    Reuse(usize),
}

impl Memory {
    /// Those in RAM; in the order they were made where all are.
    pub fn viewpoints(&self) -> &[Arc<Viewpoint>] {
        &self.viewpoints
    }

    /// Of the viewpoints in RAM.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// How often a viewpoint was overwritten only because the budget was full.
    pub fn replaced_for_room(&self) -> u64 {
        self.replaced_for_room
    }

    /// The indices of the viewpoints nearest to a pose, as [`select_into`] gives them.
    pub fn select(&self, world_from_camera: &Pose, settings: &Settings, selected: &mut Vec<usize>) {
        let Settings {
            metres_per_radian,
            views,
            view_distance_max_m,
            ..
        } = *settings;
        if self.viewpoints.len() <= LINEAR || self.tree_stale {
            select_into(
                self.viewpoints.iter().map(|view| &view.world_from_camera),
                world_from_camera,
                metres_per_radian,
                views,
                view_distance_max_m,
                selected,
            );
            return;
        }
        let mut nearest = Nearest::new(views);
        self.tree.offer(
            |index| &self.viewpoints[index].world_from_camera,
            world_from_camera,
            metres_per_radian,
            &mut nearest,
        );
        nearest.within(view_distance_max_m, selected);
    }

    /// Keeps the tree true to the viewpoints after a write.
    fn index(&mut self, written: usize) {
        let count = self.viewpoints.len();
        if count <= LINEAR {
            return;
        }
        if self.tree_stale {
            self.tree_stale = false;
            let poses = self.viewpoints.iter().map(|view| &view.world_from_camera);
            self.tree.build(poses);
            return;
        }
        self.tree.changed(written);
        // Building takes as long as looking at several times `count` poses: where both cost the same a frame.
        let loose = self.tree.loose();
        if count == LINEAR + 1 || (loose > LINEAR && loose * loose > 8 * count) {
            let poses = self.viewpoints.iter().map(|view| &view.world_from_camera);
            self.tree.build(poses);
        }
    }

    /// The slot for a posterior of `bytes` at a pose whose nearest viewpoints are `selected`, nearest first.
    pub fn slot(
        &self,
        selected: &[usize],
        world_from_camera: &Pose,
        bytes: usize,
        settings: &Settings,
    ) -> Slot {
        let Some(&nearest) = selected.first() else {
            return Slot::Append;
        };
        let (append, overwritten) = match settings.replacement {
            Replacement::AppendThenNearest => {
                (self.viewpoints.len() < settings.viewpoints, nearest)
            }
            Replacement::GrowHome => {
                let home_distance_m = |index: &usize| {
                    let home = &self.viewpoints[*index].world_from_home;
                    view_distance_m(home, world_from_camera, settings.metres_per_radian)
                };
                let (index, distance_m) = selected
                    .iter()
                    .map(|index| (*index, home_distance_m(index)))
                    .min_by(|a, b| a.1.total_cmp(&b.1))
                    .expect("at least the nearest is selected");
                (distance_m > settings.grow_distance_m, index)
            }
        };
        if !append {
            return Slot::Overwrite(overwritten);
        }
        let excess = (self.bytes + bytes).saturating_sub(settings.memory_bytes);
        if excess > self.evictable_bytes(excess) {
            return Slot::Reuse(nearest);
        }
        Slot::Append
    }

    /// Puts a viewpoint where [`Self::slot`] said and returns its id. A new viewpoint gets a new id; an updated one keeps
    /// its id and its home, and counts the update.
    pub fn write(&mut self, slot: Slot, viewpoint: Viewpoint) -> u64 {
        self.replace(slot, Arc::new(viewpoint)).0
    }

    /// As [`Self::write`], of a viewpoint that nobody else has, and gives back what was there before.
    pub fn replace(
        &mut self,
        slot: Slot,
        mut viewpoint: Arc<Viewpoint>,
    ) -> (u64, Option<Arc<Viewpoint>>) {
        let written = Arc::get_mut(&mut viewpoint).expect("a new viewpoint has one owner");
        if let Slot::Overwrite(index) = slot {
            let old = &self.viewpoints[index];
            written.id = old.id;
            written.world_from_home = old.world_from_home;
            written.updates = old.updates + 1;
        } else {
            self.last_id += 1;
            written.id = self.last_id;
            written.updates = 1;
        }
        let id = viewpoint.id;
        let written = match slot {
            Slot::Append => self.viewpoints.len(),
            Slot::Overwrite(index) | Slot::Reuse(index) => index,
        };
        self.bytes += viewpoint.bytes();
        let new = Mark::new(self.turn);
        let old = match slot {
            Slot::Append => {
                self.viewpoints.push(viewpoint);
                self.marks.push(new);
                None
            }
            Slot::Overwrite(index) | Slot::Reuse(index) => {
                let old = std::mem::replace(&mut self.viewpoints[index], viewpoint);
                self.bytes -= old.bytes();
                if let Slot::Reuse(_) = slot {
                    self.replaced_for_room += 1;
                    self.marks[index] = new;
                    self.note(old.id);
                } else {
                    self.marks[index].change(self.turn);
                }
                Some(old)
            }
        };
        self.note(id);
        self.index(written);
        (id, old)
    }

    /// Notes that a viewpoint changed or went.
    fn note(&mut self, id: u64) {
        if let Some(changed) = &mut self.changed {
            changed.insert(id);
        }
    }

    /// What changed since this was asked last; the first time, everything changes from now on are kept for.
    pub fn take_changes(&mut self) -> Vec<Change> {
        let changed = self.changed.replace(BTreeSet::new()).unwrap_or_default();
        changed
            .into_iter()
            .map(|id| match self.index_of(id) {
                Some(index) => Change::Written {
                    viewpoint: self.viewpoints[index].clone(),
                    revision: self.marks[index].revision,
                },
                None => Change::Removed(id),
            })
            .collect()
    }

    fn index_of(&self, id: u64) -> Option<usize> {
        self.viewpoints.iter().position(|held| held.id == id)
    }
}
