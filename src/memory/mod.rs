//! What a place remembers: its viewpoints, how they grow and which one a new posterior replaces.

pub mod visit;

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

/// The viewpoints of one place, in the order they were made.
#[derive(Debug, Default)]
pub struct Memory {
    viewpoints: Vec<Viewpoint>,
    bytes: usize,
    last_id: u64,
    replaced_for_room: u64,
    /// Kept beyond [`LINEAR`] viewpoints.
    tree: ViewTree,
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
    pub fn viewpoints(&self) -> &[Viewpoint] {
        &self.viewpoints
    }

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
        if self.viewpoints.len() <= LINEAR {
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
        if self.bytes + bytes > settings.memory_bytes {
            return Slot::Reuse(nearest);
        }
        Slot::Append
    }

    /// Puts a viewpoint where [`Self::slot`] said and returns its id. A new viewpoint gets a new id; an updated one keeps
    /// its id and its home, and counts the update.
    pub fn write(&mut self, slot: Slot, viewpoint: Viewpoint) -> u64 {
        self.replace(slot, viewpoint).0
    }

    /// As [`Self::write`], and gives back what was there before.
    pub fn replace(&mut self, slot: Slot, mut viewpoint: Viewpoint) -> (u64, Option<Viewpoint>) {
        if let Slot::Overwrite(index) = slot {
            let old = &self.viewpoints[index];
            viewpoint.id = old.id;
            viewpoint.world_from_home = old.world_from_home;
            viewpoint.updates = old.updates + 1;
        } else {
            self.last_id += 1;
            viewpoint.id = self.last_id;
            viewpoint.updates = 1;
        }
        let id = viewpoint.id;
        let written = match slot {
            Slot::Append => self.viewpoints.len(),
            Slot::Overwrite(index) | Slot::Reuse(index) => index,
        };
        self.bytes += viewpoint.bytes();
        let old = match slot {
            Slot::Append => {
                self.viewpoints.push(viewpoint);
                None
            }
            Slot::Overwrite(index) | Slot::Reuse(index) => {
                let old = std::mem::replace(&mut self.viewpoints[index], viewpoint);
                self.bytes -= old.bytes();
                self.replaced_for_room += u64::from(matches!(slot, Slot::Reuse(_)));
                Some(old)
            }
        };
        self.index(written);
        (id, old)
    }
}
