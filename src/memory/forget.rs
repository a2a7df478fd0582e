//! What is taken out of the memory: a region of the world, a span of time, or everything.
//!
//! A region: every pixel whose point in the world lies in it is cleared in every viewpoint, so that it is unseen wherever
//! it is recalled; a viewpoint of which nothing is left goes. A span: viewpoints that were written last within it go.
//! Both: pixels in the region, of viewpoints written in the span. Pixels without depth lie nowhere; they are never
//! recalled.
//!
//! It can be done in steps with frames in between: what frames write meanwhile is gone through as well, so that in the
//! end nothing of the region is held by anybody, also not what a frame brought from one viewpoint into another.

use std::{collections::HashMap, ops::Range, sync::Arc};

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::{
    memory::Memory,
    model::viewpoint::{Head, Viewpoint},
};

/// Part of the world, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Region {
    Sphere {
        center: Point3<f64>,
        radius_m: f64,
    },
    /// Along the world's axes; its faces belong to it.
    Box {
        min: Point3<f64>,
        max: Point3<f64>,
    },
}

impl Region {
    #[inline(always)]
    pub fn contains(&self, point_in_world: &Point3<f64>) -> bool {
        match self {
            Self::Sphere { center, radius_m } => {
                (point_in_world - center).norm_squared() <= radius_m * radius_m
            }
            Self::Box { min, max } => {
                (0..3).all(|axis| (min[axis]..=max[axis]).contains(&point_in_world[axis]))
            }
        }
    }
}

/// Of everything, what to forget.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Forget {
    /// `None`: whole viewpoints.
    pub region: Option<Region>,
    /// Capture times of what viewpoints were written with last, nanoseconds since the epoch; `None`: any.
    pub span_ns: Option<Range<i64>>,
}

/// What was forgotten.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Forgotten {
    /// Ids of viewpoints that are gone.
    pub removed: Vec<u64>,
    /// Ids of viewpoints that lost pixels, and may have gone after all.
    pub changed: Vec<u64>,
    /// Pixels with depth of all these.
    pub pixels: u64,
}

/// How often a viewpoint had been updated, and with what stamp, when it was gone through.
type Written = (u64, i64);

/// Forgetting under way.
#[derive(Debug)]
pub struct Forgetting {
    what: Forget,
    gone_through: HashMap<u64, Written>,
    forgotten: Forgotten,
}

impl Forgetting {
    pub fn new(what: Forget) -> Self {
        Self {
            what,
            gone_through: HashMap::new(),
            forgotten: Forgotten::default(),
        }
    }

    /// So far.
    pub fn forgotten(&self) -> &Forgotten {
        &self.forgotten
    }

    fn is_pending(&self, id: u64, written: Written) -> bool {
        let in_span = |span: &Range<i64>| span.contains(&written.1);
        self.what.span_ns.as_ref().is_none_or(in_span)
            && self.gone_through.get(&id) != Some(&written)
    }

    fn is_head_pending(&self, head: &Head) -> bool {
        self.is_pending(head.id, (head.updates, head.stamp_ns))
    }
}

/// A viewpoint that was gone through.
struct Cleared {
    index: usize,
    id: u64,
    written: Written,
    pixels: u64,
    /// Something of it.
    left: bool,
    bytes_before: usize,
    bytes: usize,
}

fn written(viewpoint: &Viewpoint) -> Written {
    (viewpoint.updates, viewpoint.stamp_ns)
}

impl Memory {
    /// Goes on forgetting, over at most so many viewpoints; whether all is done. Uses the threads it is called on.
    pub fn forget(&mut self, forgetting: &mut Forgetting, viewpoints_max: usize) -> bool {
        let region = forgetting.what.region;
        if region.is_none() {
            // What goes whole need not be loaded; its pixels are not counted.
            let absent = self.absent_to_forget(forgetting, usize::MAX);
            forgetting.forgotten.removed.extend(&absent);
            self.remove(|head| absent.binary_search(&head.id).is_ok());
        }
        let mut pending: Vec<(usize, &mut Arc<Viewpoint>)> = self
            .viewpoints
            .iter_mut()
            .enumerate()
            .filter(|(_, viewpoint)| forgetting.is_pending(viewpoint.id, written(viewpoint)))
            .take(viewpoints_max)
            .collect();
        let is_last = pending.len() < viewpoints_max;
        let cleared: Vec<Cleared> = pending
            .par_iter_mut()
            .map(|(index, viewpoint)| {
                let bytes_before = viewpoint.bytes();
                let pixels = clear(viewpoint, region);
                Cleared {
                    index: *index,
                    id: viewpoint.id,
                    written: written(viewpoint),
                    pixels,
                    left: region.is_some() && !(pixels > 0 && viewpoint.is_empty()),
                    bytes_before,
                    bytes: viewpoint.bytes(),
                }
            })
            .collect();
        let mut gone = Vec::new();
        for one in cleared {
            let Cleared {
                index,
                id,
                written,
                pixels,
                left,
                ..
            } = one;
            // Around what was forgotten its surface has other parts.
            self.bytes = self.bytes - one.bytes_before + one.bytes;
            forgetting.forgotten.pixels += pixels;
            if !left {
                forgetting.forgotten.removed.push(id);
                gone.push(id);
            } else if pixels > 0 {
                self.touch(index);
                if !forgetting.forgotten.changed.contains(&id) {
                    forgetting.forgotten.changed.push(id);
                }
            }
            forgetting.gone_through.insert(id, written);
        }
        gone.sort_unstable();
        self.remove(|head| gone.binary_search(&head.id).is_ok());
        is_last && self.absent_to_forget(forgetting, 1).is_empty()
    }

    /// Ids of viewpoints that are not in RAM and have yet to be gone through, rising, at most so many.
    pub fn absent_to_forget(&self, forgetting: &Forgetting, count: usize) -> Vec<u64> {
        let absent = self.absent_heads();
        let pending = absent.filter(|head| forgetting.is_head_pending(head));
        pending.map(|head| head.id).take(count).collect()
    }
}

/// Clears the pixels whose points lie in the region, all of them without one, and returns how many had depth. What goes
/// whole is only counted.
fn clear(viewpoint: &mut Arc<Viewpoint>, region: Option<Region>) -> u64 {
    let Some(region) = region else {
        return viewpoint.mesh.depth_m.iter().filter(|&&z| z > 0.0).count() as u64;
    };
    let camera = viewpoint.mesh.intrinsics;
    let world_from_camera = &viewpoint.world_from_camera;
    let in_world = |ray: Vector3<f64>| world_from_camera.rotation * ray;
    // Of a pixel at depth 1: the first column's ray, and what a column adds.
    let per_column = in_world(Vector3::new(1.0 / camera.fx, 0.0, 0.0));
    let mut gone = Vec::with_capacity(camera.pixels());
    for (v, row) in viewpoint
        .mesh
        .depth_m
        .chunks_exact(camera.width)
        .enumerate()
    {
        let first = in_world(camera.unproject(0.0, v as f64, 1.0).coords);
        gone.extend(row.iter().enumerate().map(|(u, &z)| {
            let ray = first + per_column * u as f64;
            let point = world_from_camera.translation.vector + ray * f64::from(z);
            (z > 0.0) & region.contains(&point.into())
        }));
    }
    let pixels = gone.iter().filter(|gone| **gone).count() as u64;
    if pixels > 0 {
        // Who stores it meanwhile keeps what it was.
        Arc::make_mut(viewpoint).clear(&gone);
    }
    pixels
}
