//! The passes and what each of them binds: the table that the pipelines are made from, and that a test holds against
//! the shaders.

/// A buffer that passes share. Its name is that of the variable in the shaders.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slot {
    Frame,
    Rules,
    Views,
    DepthArena,
    RecordArena,
    Nearest,
    Triangles,
    PriorSpread,
    PriorLevel,
    PriorSigma,
    PriorEarlier,
    Image,
    Histogram,
    Exposure,
    SurpriseMap,
    PosteriorRecords,
    BlockMeans,
    BlockMedians,
    /// As [`Self::Frame`], of half the image.
    HalfFrame,
    /// As [`Self::Views`], of the viewpoints at half resolution.
    CoarseViews,
    CoarseDepthArena,
    LevelArena,
    /// Of the pass's own level.
    Level,
    Pyramid,
    PartialSums,
    Estimate,
    /// As [`Self::Views`], before a camera that is where its pose says.
    GivenViews,
}

impl Slot {
    pub fn name(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Rules => "rules",
            Self::Views => "views",
            Self::DepthArena => "depth_arena",
            Self::RecordArena => "record_arena",
            Self::Nearest => "nearest",
            Self::Triangles => "triangles",
            Self::PriorSpread => "prior_spread",
            Self::PriorLevel => "prior_level",
            Self::PriorSigma => "prior_sigma",
            Self::PriorEarlier => "prior_earlier",
            Self::Image => "image",
            Self::Histogram => "histogram",
            Self::Exposure => "exposure",
            Self::SurpriseMap => "surprise_map",
            Self::PosteriorRecords => "posterior_records",
            Self::BlockMeans => "block_means",
            Self::BlockMedians => "block_medians",
            Self::HalfFrame => "frame",
            Self::CoarseViews => "views",
            Self::CoarseDepthArena => "depth_arena",
            Self::LevelArena => "level_arena",
            Self::Level => "level",
            Self::Pyramid => "pyramid",
            Self::PartialSums => "partial_sums",
            Self::Estimate => "estimate",
            Self::GivenViews => "given_views",
        }
    }
}

/// An entry point of a shader.
#[derive(Debug)]
pub struct Pass {
    pub label: &'static str,
    pub source: &'static str,
    /// The same with half precision, for cards that have it.
    pub source_f16: Option<&'static str>,
    pub entry: &'static str,
    pub workgroup: [u32; 3],
    /// Binding numbers of group 0.
    pub bindings: &'static [(u32, Slot)],
}

macro_rules! shader {
    ($($file:literal),*) => {
        concat!($(include_str!(concat!("../../../shaders/", $file)), "\n"),*)
    };
}

const PROJECT: &str = shader!("layout.wgsl", "project.wgsl", "passes/project.wgsl");
const PREDICT: &str = shader!(
    "layout.wgsl",
    "belief.wgsl",
    "image.wgsl",
    "project.wgsl",
    "refine.wgsl",
    "passes/predict.wgsl"
);
const COMPARE: &str = shader!("layout.wgsl", "refine.wgsl", "passes/compare.wgsl");
const SOLVE: &str = shader!("layout.wgsl", "refine.wgsl", "passes/solve.wgsl");
const PLACE_VIEWS: &str = shader!("layout.wgsl", "refine.wgsl", "passes/place.wgsl");
const MERGE: &str = shader!(
    "layout.wgsl",
    "belief.wgsl",
    "records.wgsl",
    "project.wgsl",
    "merge.wgsl",
    "passes/merge.wgsl"
);
/// An extension is enabled before anything else.
const MERGE_F16: &str = shader!(
    "records_f16.wgsl",
    "layout.wgsl",
    "belief.wgsl",
    "project.wgsl",
    "merge.wgsl",
    "passes/merge.wgsl"
);
const EXPOSURE: &str = shader!(
    "layout.wgsl",
    "belief.wgsl",
    "image.wgsl",
    "exposure.wgsl",
    "passes/exposure.wgsl"
);
const SCORE: &str = shader!(
    "layout.wgsl",
    "lanes.wgsl",
    "belief.wgsl",
    "image.wgsl",
    "update.wgsl",
    "surprise.wgsl",
    "score.wgsl",
    "passes/score.wgsl"
);
const ATTEND: &str = shader!("layout.wgsl", "attend.wgsl", "passes/attend.wgsl");

const DRAWN: &[(u32, Slot)] = &[
    (0, Slot::Frame),
    (2, Slot::Views),
    (3, Slot::DepthArena),
    (4, Slot::Nearest),
    (5, Slot::Triangles),
];

const DRAWN_COARSE: &[(u32, Slot)] = &[
    (0, Slot::HalfFrame),
    (2, Slot::CoarseViews),
    (3, Slot::CoarseDepthArena),
    (4, Slot::Nearest),
    (5, Slot::Triangles),
];

const SOLVED: &[(u32, Slot)] = &[
    (0, Slot::Level),
    (1, Slot::Estimate),
    (2, Slot::Histogram),
    (3, Slot::PartialSums),
];

/// One invocation a quad and view.
pub const PROJECT_DEPTH: usize = 0;
pub const PROJECT_TRIANGLE: usize = 1;
/// One a pixel.
pub const MERGE_VIEWS: usize = 2;
/// One for [`EXPOSE_PIXELS`] pixels.
pub const EXPOSE: usize = 3;
/// One workgroup.
pub const GAIN: usize = 4;
/// One a pixel.
pub const SCORE_PIXELS: usize = 5;
/// One a block.
pub const BLOCK_MEANS: usize = 6;
pub const BLOCK_MEDIANS: usize = 7;
/// One a quad and view, at half resolution.
pub const PROJECT_COARSE_DEPTH: usize = 8;
pub const PROJECT_COARSE_TRIANGLE: usize = 9;
/// One a pixel of a level.
pub const EXPECT: usize = 10;
pub const HALVE: usize = 11;
/// One for [`REFINE_PIXELS`] pixels of a level.
pub const DEPTHS: usize = 12;
pub const MAGNITUDES: usize = 13;
pub const ACCUMULATE: usize = 14;
/// One workgroup.
pub const BEGIN: usize = 15;
pub const STEP: usize = 16;
pub const JUDGE: usize = 17;
/// One a view.
pub const PLACE: usize = 18;

/// Pixels of one invocation of [`EXPOSE`].
pub const EXPOSE_PIXELS: u32 = 32;
/// Pixels of one invocation of [`DEPTHS`], [`MAGNITUDES`] and [`ACCUMULATE`].
pub const REFINE_PIXELS: u32 = 16;
/// Invocations of their workgroups.
pub const REFINE_THREADS: u32 = 64;
/// What [`ACCUMULATE`] adds up.
pub const SUMS: u32 = 47;
/// Bins of the histogram, and the count of the seen pixels.
pub const HISTOGRAM_WORDS: u64 = 2048 + 1;

/// What compares a frame, in its order, and then what refines its pose before that.
pub const PASSES: [Pass; 19] = [
    Pass {
        label: "project depth",
        source: PROJECT,
        source_f16: None,
        entry: "project_depth",
        workgroup: [8, 8, 1],
        bindings: DRAWN,
    },
    Pass {
        label: "project triangle",
        source: PROJECT,
        source_f16: None,
        entry: "project_triangle",
        workgroup: [8, 8, 1],
        bindings: DRAWN,
    },
    Pass {
        label: "merge",
        source: MERGE,
        source_f16: Some(MERGE_F16),
        entry: "merge",
        workgroup: [8, 8, 1],
        bindings: &[
            (0, Slot::Frame),
            (1, Slot::Rules),
            (2, Slot::Views),
            (3, Slot::DepthArena),
            (4, Slot::RecordArena),
            (5, Slot::Nearest),
            (6, Slot::Triangles),
            (7, Slot::PriorSpread),
            (8, Slot::PriorLevel),
            (9, Slot::PriorSigma),
            (10, Slot::PriorEarlier),
        ],
    },
    Pass {
        label: "expose",
        source: EXPOSURE,
        source_f16: None,
        entry: "expose",
        workgroup: [256, 1, 1],
        bindings: &[
            (0, Slot::Frame),
            (2, Slot::PriorLevel),
            (3, Slot::PriorEarlier),
            (4, Slot::Image),
            (5, Slot::Histogram),
        ],
    },
    Pass {
        label: "gain",
        source: EXPOSURE,
        source_f16: None,
        entry: "gain",
        workgroup: [256, 1, 1],
        bindings: &[(1, Slot::Rules), (5, Slot::Histogram), (6, Slot::Exposure)],
    },
    Pass {
        label: "score",
        source: SCORE,
        source_f16: None,
        entry: "score",
        workgroup: [8, 8, 1],
        bindings: &[
            (0, Slot::Frame),
            (1, Slot::Rules),
            (2, Slot::Exposure),
            (3, Slot::PriorSpread),
            (4, Slot::PriorLevel),
            (5, Slot::PriorSigma),
            (6, Slot::PriorEarlier),
            (7, Slot::Image),
            (8, Slot::SurpriseMap),
            (9, Slot::PosteriorRecords),
        ],
    },
    Pass {
        label: "block means",
        source: ATTEND,
        source_f16: None,
        entry: "means",
        workgroup: [8, 8, 1],
        bindings: &[
            (0, Slot::Frame),
            (1, Slot::SurpriseMap),
            (2, Slot::BlockMeans),
        ],
    },
    Pass {
        label: "block medians",
        source: ATTEND,
        source_f16: None,
        entry: "median",
        workgroup: [8, 8, 1],
        bindings: &[
            (0, Slot::Frame),
            (2, Slot::BlockMeans),
            (3, Slot::BlockMedians),
        ],
    },
    Pass {
        label: "project coarse depth",
        source: PROJECT,
        source_f16: None,
        entry: "project_depth",
        workgroup: [8, 8, 1],
        bindings: DRAWN_COARSE,
    },
    Pass {
        label: "project coarse triangle",
        source: PROJECT,
        source_f16: None,
        entry: "project_triangle",
        workgroup: [8, 8, 1],
        bindings: DRAWN_COARSE,
    },
    Pass {
        label: "expect",
        source: PREDICT,
        source_f16: None,
        entry: "expect",
        workgroup: [8, 8, 1],
        bindings: &[
            (0, Slot::HalfFrame),
            (1, Slot::CoarseViews),
            (2, Slot::Level),
            (3, Slot::CoarseDepthArena),
            (4, Slot::LevelArena),
            (5, Slot::Nearest),
            (6, Slot::Triangles),
            (7, Slot::Image),
            (8, Slot::Pyramid),
        ],
    },
    Pass {
        label: "halve",
        source: PREDICT,
        source_f16: None,
        entry: "halve",
        workgroup: [8, 8, 1],
        bindings: &[(2, Slot::Level), (8, Slot::Pyramid)],
    },
    Pass {
        label: "depths",
        source: COMPARE,
        source_f16: None,
        entry: "depths",
        workgroup: [REFINE_THREADS, 1, 1],
        bindings: &[(0, Slot::Level), (2, Slot::Pyramid), (3, Slot::Histogram)],
    },
    Pass {
        label: "magnitudes",
        source: COMPARE,
        source_f16: None,
        entry: "magnitudes",
        workgroup: [REFINE_THREADS, 1, 1],
        bindings: &[
            (0, Slot::Level),
            (1, Slot::Estimate),
            (2, Slot::Pyramid),
            (3, Slot::Histogram),
        ],
    },
    Pass {
        label: "accumulate",
        source: COMPARE,
        source_f16: None,
        entry: "accumulate",
        workgroup: [REFINE_THREADS, 1, 1],
        bindings: &[
            (0, Slot::Level),
            (1, Slot::Estimate),
            (2, Slot::Pyramid),
            (3, Slot::Histogram),
            (4, Slot::PartialSums),
        ],
    },
    Pass {
        label: "begin",
        source: SOLVE,
        source_f16: None,
        entry: "begin",
        workgroup: [REFINE_THREADS, 1, 1],
        bindings: &[(0, Slot::Level), (1, Slot::Estimate), (2, Slot::Histogram)],
    },
    Pass {
        label: "step",
        source: SOLVE,
        source_f16: None,
        entry: "step",
        workgroup: [REFINE_THREADS, 1, 1],
        bindings: SOLVED,
    },
    Pass {
        label: "judge",
        source: SOLVE,
        source_f16: None,
        entry: "judge",
        workgroup: [REFINE_THREADS, 1, 1],
        bindings: SOLVED,
    },
    Pass {
        label: "place",
        source: PLACE_VIEWS,
        source_f16: None,
        entry: "place",
        workgroup: [16, 1, 1],
        bindings: &[
            (0, Slot::Frame),
            (1, Slot::Level),
            (2, Slot::Estimate),
            (3, Slot::GivenViews),
            (4, Slot::Views),
        ],
    },
];
