//! Which viewpoints are in RAM, and which are only known: of those the head is, so that what is near a pose can be told
//! without them. Only what is stored may leave RAM, least recently used first.

use std::sync::Arc;

use super::{Memory, Version};
use crate::model::{
    pose::{Pose, view_distance_m},
    viewpoint::{Head, Viewpoint},
};

/// What is known about a viewpoint in RAM beside itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mark {
    /// Rises with every change.
    pub revision: u64,
    stored: Option<Version>,
    /// In which turn it was needed last.
    used: u64,
}

/// A viewpoint that is stored and not in RAM.
#[derive(Debug, Clone)]
pub(super) struct Absent {
    head: Head,
    stored: Version,
}

/// What somebody must do to the stored viewpoints to make them what the memory is.
#[derive(Debug, Clone)]
pub enum Change {
    Written {
        viewpoint: Arc<Viewpoint>,
        revision: u64,
    },
    Removed(u64),
}

impl Mark {
    pub(super) fn new(turn: u64) -> Self {
        Self {
            revision: 1,
            stored: None,
            used: turn,
        }
    }

    pub(super) fn change(&mut self, turn: u64) {
        self.revision += 1;
        self.used = turn;
    }

    fn is_durable(&self) -> bool {
        self.stored
            .is_some_and(|stored| stored.revision == self.revision)
    }
}

impl Memory {
    /// Viewpoints in RAM and elsewhere.
    pub fn known(&self) -> usize {
        self.viewpoints.len() + self.absent.len()
    }

    /// Of all viewpoints, by id.
    pub fn heads(&self) -> Vec<Head> {
        let here = self.viewpoints.iter().map(|viewpoint| viewpoint.head());
        let absent = self.absent.values().map(|absent| absent.head.clone());
        let mut heads: Vec<Head> = here.chain(absent).collect();
        heads.sort_by_key(|head| head.id);
        heads
    }

    /// Of those that are not in RAM, by id.
    pub(super) fn absent_heads(&self) -> impl Iterator<Item = &Head> {
        self.absent.values().map(|absent| &absent.head)
    }

    /// Notes that the viewpoint at this index has changed.
    pub(super) fn touch(&mut self, index: usize) {
        self.marks[index].change(self.turn);
        self.note(self.viewpoints[index].id);
    }

    /// Some that are not in RAM.
    pub fn some_absent(&self, count: usize) -> Vec<u64> {
        self.absent.keys().take(count).copied().collect()
    }

    /// Those of these viewpoints that are known and not in RAM.
    pub fn absent_of(&self, ids: &[u64]) -> Vec<u64> {
        let absent = ids.iter().filter(|id| self.absent.contains_key(id));
        absent.copied().collect()
    }

    /// Viewpoints that left RAM.
    pub fn evicted(&self) -> u64 {
        self.evicted
    }

    /// Begins a turn: what is needed from here on stays until the next one begins.
    pub fn begin_turn(&mut self) {
        self.turn += 1;
    }

    /// Ids of those of the `count` viewpoints nearest to a pose that are not in RAM, nearest first. The others count as
    /// used now.
    pub fn need(
        &mut self,
        world_from_camera: &Pose,
        count: usize,
        metres_per_radian: f64,
    ) -> Vec<u64> {
        #[derive(Clone, Copy)]
        enum Where {
            Here(usize),
            Absent(u64),
        }
        let here = self.viewpoints.iter().enumerate();
        let here = here.map(|(index, view)| (&view.world_from_camera, Where::Here(index)));
        let absent = self.absent.iter();
        let absent = absent.map(|(&id, view)| (&view.head.world_from_camera, Where::Absent(id)));
        let mut nearest: Vec<(f64, Where)> = Vec::with_capacity(count + 1);
        let position = world_from_camera.translation.vector;
        for (view, place) in here.chain(absent) {
            let farthest_m = match nearest.last() {
                Some(last) if nearest.len() >= count => last.0,
                _ => f64::INFINITY,
            };
            // Of a large place's viewpoints nearly all are too far by their position alone.
            if (view.translation.vector - position).norm_squared() >= farthest_m * farthest_m {
                continue;
            }
            let distance_m = view_distance_m(view, world_from_camera, metres_per_radian);
            let rank = nearest.partition_point(|near| near.0 <= distance_m);
            nearest.insert(rank, (distance_m, place));
            nearest.truncate(count);
        }
        let mut needed = Vec::new();
        for (_, place) in nearest {
            match place {
                Where::Here(index) => self.marks[index].used = self.turn,
                Where::Absent(id) => needed.push(id),
            }
        }
        needed
    }

    /// Gives ids only beyond this one from here on.
    pub fn reserve_ids(&mut self, id: u64) {
        self.last_id = self.last_id.max(id);
    }

    /// Learns that a viewpoint is stored. What is in RAM of an earlier state goes.
    pub fn know(&mut self, head: Head, stored: Version) {
        self.reserve_ids(head.id);
        if let Some(index) = self.index_of(head.id) {
            if self.marks[index].stored == Some(stored) {
                return;
            }
            self.drop_resident(index);
        }
        self.absent.insert(head.id, Absent { head, stored });
    }

    /// Takes a stored viewpoint into RAM, unless it is known in another state by now.
    pub fn admit(&mut self, viewpoint: Arc<Viewpoint>, stored: Version) {
        let wanted = self.absent.get(&viewpoint.id);
        if wanted.is_none_or(|absent| absent.stored != stored) {
            return;
        }
        self.absent.remove(&viewpoint.id);
        self.bytes += viewpoint.bytes();
        self.viewpoints.push(viewpoint);
        self.tree_stale = true;
        self.marks.push(Mark {
            revision: stored.revision,
            stored: Some(stored),
            used: self.turn,
        });
    }

    /// Learns that a state of a viewpoint has been stored.
    pub fn mark_stored(&mut self, id: u64, stored: Version) {
        if let Some(index) = self.index_of(id) {
            self.marks[index].stored = Some(stored);
        }
    }

    /// Learns that a viewpoint is not stored any more, by somebody else's doing.
    pub fn lose(&mut self, id: u64) {
        self.absent.remove(&id);
        if let Some(index) = self.index_of(id) {
            self.drop_resident(index);
        }
    }

    /// Removes viewpoints for good, wherever they are; how many.
    pub fn remove(&mut self, mut gone: impl FnMut(&Head) -> bool) -> usize {
        let ids: Vec<u64> = self
            .heads()
            .iter()
            .filter(|head| gone(head))
            .map(|head| head.id)
            .collect();
        for &id in &ids {
            self.lose(id);
            self.note(id);
        }
        ids.len()
    }

    /// Forgets everything that is not stored, and everything that is: as if it were made anew. Ids go on.
    pub fn reset(&mut self) {
        *self = Self {
            changed: self.changed.as_ref().map(|_| Default::default()),
            turn: self.turn,
            last_id: self.last_id,
            replaced_for_room: self.replaced_for_room,
            evicted: self.evicted,
            ..Self::default()
        };
    }

    /// Bytes that may leave RAM, counted up to where they are enough.
    pub(super) fn evictable_bytes(&self, enough: usize) -> usize {
        if enough == 0 {
            return 0;
        }
        let mut bytes = 0;
        for (viewpoint, mark) in self.viewpoints.iter().zip(&self.marks) {
            if mark.is_durable() && mark.used < self.turn {
                bytes += viewpoint.bytes();
                if bytes >= enough {
                    break;
                }
            }
        }
        bytes
    }

    /// Lets stored viewpoints leave RAM, least recently used first, until no more than `bytes_max` are used. Those of
    /// the present turn stay.
    pub fn evict(&mut self, bytes_max: usize) {
        if self.bytes <= bytes_max {
            return;
        }
        let mut oldest: Vec<(u64, u64)> = self
            .viewpoints
            .iter()
            .zip(&self.marks)
            .filter(|(_, mark)| mark.is_durable() && mark.used < self.turn)
            .map(|(viewpoint, mark)| (mark.used, viewpoint.id))
            .collect();
        oldest.sort_unstable();
        for (_, id) in oldest {
            if self.bytes <= bytes_max {
                return;
            }
            let Some(index) = self.index_of(id) else {
                continue;
            };
            let (head, stored) = (self.viewpoints[index].head(), self.marks[index].stored);
            self.drop_resident(index);
            self.evicted += 1;
            if let Some(stored) = stored {
                self.absent.insert(id, Absent { head, stored });
            }
        }
    }

    fn drop_resident(&mut self, index: usize) {
        let gone = self.viewpoints.remove(index);
        self.tree_stale = true;
        self.marks.remove(index);
        self.bytes -= gone.bytes();
    }
}
