//! The recall passes over one strip of rows: every view's mesh is drawn into a map, then the rows are merged.

use crate::{
    isa::{Isa, for_each_isa},
    model::viewpoint::VIEWS_MAX,
    stages::interpolate::{
        gather::Portable,
        merge::{MergeRules, MergeScratch, MergeView, merge_row},
        prior::PLANES,
        project::{ProjectScratch, Projector, draw},
        sample::{Sample, map_size},
    },
};

#[cfg(target_arch = "x86_64")]
use crate::stages::interpolate::gather::Avx;

for_each_isa! {
    fn merge(
        views: &[MergeView<'_>],
        maps: &[&[Sample]],
        rules: MergeRules,
        width: usize,
        row: &mut [f32],
        scratch: &mut MergeScratch,
    ) = merge_row::<Portable>, avx merge_row::<Avx>;
}

/// Working memory of one thread.
#[derive(Default)]
pub struct StripScratch {
    /// One map a view.
    maps: Vec<Sample>,
    project: ProjectScratch,
    merge: MergeScratch,
}

impl StripScratch {
    /// Rows from `first_row` on, as many as `rows` holds.
    #[allow(clippy::too_many_arguments)]
    pub fn recall(
        &mut self,
        isa: Isa,
        projectors: &[Projector],
        views: &[MergeView],
        rules: MergeRules,
        width: usize,
        first_row: usize,
        rows: &mut [f32],
    ) {
        let height = rows.len() / (width * PLANES);
        let map_size = map_size(width * height);
        self.maps.clear();
        self.maps.resize(map_size * views.len(), 0);
        if rows.is_empty() {
            return;
        }
        for (projector, map) in projectors.iter().zip(self.maps.chunks_exact_mut(map_size)) {
            draw(
                isa,
                projector,
                width,
                first_row..first_row + height,
                map,
                &mut self.project,
            );
        }
        for (y, row) in rows.chunks_exact_mut(width * PLANES).enumerate() {
            let mut maps: [&[Sample]; VIEWS_MAX] = [&[]; VIEWS_MAX];
            for (slot, map) in maps.iter_mut().zip(self.maps.chunks_exact(map_size)) {
                *slot = &map[y * width..][..width];
            }
            let scratch = &mut self.merge;
            merge(isa, views, &maps[..views.len()], rules, width, row, scratch);
        }
    }
}
