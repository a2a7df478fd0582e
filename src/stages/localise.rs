//! Computes the pose of the marker plate from the tracked positions of its LEDs: the rotation R and translation t that
//! minimise sum |R p_i + t - m_i|^2 (paper section III-B, reference [28]: Arun, Huang and Blostein 1987).
//! In: LED positions in the plate's frame (metres, origin at the front-left LED) and in the world (metres, `None` where
//! untracked). Out: `world_from_plate`, the RMS distance that remains, and which marker was recovered from the others.
//! The paper takes t from the front-left LED alone; here all LEDs share in it, which is less noisy and survives the loss
//! of that one. How "an erroneous or missing pose of a single LED can be recovered" is left open: a marker is wrong if
//! the fit of all misses by more than a tolerance and the fit without this one does not.
//! No shader twin: four points a frame.

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

use crate::model::{camera::Plate, pose::Pose, refusal::Refusal};

/// Markers without which no rotation can be had.
pub const MIN_MARKERS: usize = 3;

/// RMS distance, metres, that a fit of trustworthy markers stays below: with 0.3 mm noise an axis, four markers pass it
/// once in ten million frames.
pub const TOLERANCE_M: f64 = 1e-3;

/// How thin, relative to its length, a set of markers may be and still count as a plane rather than a line.
const MIN_THICKNESS: f64 = 0.02;

#[derive(Debug, Clone, PartialEq)]
pub struct PlateFit {
    pub world_from_plate: Pose,
    /// RMS distance between fitted and measured markers, over those that were used.
    pub residual_m: f64,
    /// The marker that was missing or wrong and plays no part in the fit.
    pub recovered: Option<usize>,
}

#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LocaliseError {
    #[error(
        "the plate has {expected} markers but {got} were given: send all, the unseen ones as not visible"
    )]
    Count { expected: usize, got: usize },
    #[error(
        "{visible} markers are tracked, but at most one may be missing and the rotation needs {MIN_MARKERS}: is the plate hidden?"
    )]
    TooFew { visible: usize },
    #[error(
        "the tracked markers lie on a line, which leaves the rotation about it open: mount one beside it"
    )]
    Collinear,
    #[error(
        "the markers are a mirror image of the plate: are two of them exchanged, or an axis of the tracker turned round?"
    )]
    Mirrored,
    #[error("the markers do not fit the plate: {:.1} mm RMS is the best of any choice; does marker_in_plate count metres, in the markers' order?", residual_m * 1e3)]
    Inconsistent { residual_m: f64 },
    #[error("a marker's position is not a finite number: send what is not seen as not visible")]
    NotFinite,
}

impl LocaliseError {
    /// One word for programs, as in `Rejection.code`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Count { .. } => "marker_count",
            Self::TooFew { .. } => "too_few_markers",
            Self::Collinear => "markers_collinear",
            Self::Mirrored => "markers_mirrored",
            Self::Inconsistent { .. } => "markers_inconsistent",
            Self::NotFinite => "marker_not_finite",
        }
    }
}

impl From<LocaliseError> for Refusal {
    fn from(error: LocaliseError) -> Self {
        Self::new(error.code(), error.to_string())
    }
}

/// `world_from_camera` of the camera that carries the plate, from its tracked markers (world, metres).
///
/// # Errors
/// As [`fit_plate`], with [`TOLERANCE_M`].
pub fn world_from_camera(
    plate: &Plate,
    marker_in_world: &[Option<Point3<f64>>],
) -> Result<Pose, LocaliseError> {
    let fit = fit_plate(&plate.marker_in_plate, marker_in_world, TOLERANCE_M)?;
    Ok(fit.world_from_plate * plate.camera_from_plate.inverse())
}

/// Fits the plate to its tracked markers (same order, metres). One marker may be missing, or, if four or more are there,
/// wrong. `tolerance_m` is the RMS distance above which markers disagree, e.g. [`TOLERANCE_M`].
///
/// A *flat* plate and its mirror image cannot be told apart by their markers: one is the other turned over. Markers that
/// were exchanged in pairs so that a flat plate is mirrored give an upside-down pose, not an error.
pub fn fit_plate(
    marker_in_plate: &[Point3<f64>],
    marker_in_world: &[Option<Point3<f64>>],
    tolerance_m: f64,
) -> Result<PlateFit, LocaliseError> {
    if marker_in_plate.len() != marker_in_world.len() {
        return Err(LocaliseError::Count {
            expected: marker_in_plate.len(),
            got: marker_in_world.len(),
        });
    }
    let tracked: Vec<Pair> = marker_in_plate
        .iter()
        .zip(marker_in_world)
        .enumerate()
        .filter_map(|(index, (&in_plate, in_world))| {
            in_world.map(|in_world| Pair {
                index,
                in_plate,
                in_world,
            })
        })
        .collect();
    if tracked.iter().any(|pair| {
        pair.in_plate
            .iter()
            .chain(pair.in_world.iter())
            .any(|value| !value.is_finite())
    }) {
        return Err(LocaliseError::NotFinite);
    }
    let missing = marker_in_plate.len() - tracked.len();
    if tracked.len() < MIN_MARKERS || missing > 1 {
        return Err(LocaliseError::TooFew {
            visible: tracked.len(),
        });
    }

    let all = rigid_fit(&tracked)?;
    if all.residual_m <= tolerance_m {
        return Ok(PlateFit {
            recovered: (0..marker_in_plate.len())
                .find(|index| tracked.iter().all(|pair| pair.index != *index)),
            ..all
        });
    }
    if mirror_residual_m(&tracked) <= tolerance_m {
        return Err(LocaliseError::Mirrored);
    }
    // One marker may be wrong, if none is missing as well: three alone cannot tell which of them is.
    let best = if tracked.len() > MIN_MARKERS && missing == 0 {
        (0..tracked.len())
            .filter_map(|wrong| {
                let mut others = tracked.clone();
                let wrong = others.remove(wrong).index;
                let fit = rigid_fit(&others).ok()?;
                Some(PlateFit {
                    recovered: Some(wrong),
                    ..fit
                })
            })
            .min_by(|a, b| a.residual_m.total_cmp(&b.residual_m))
    } else {
        None
    };
    match best {
        Some(fit) if fit.residual_m <= tolerance_m => Ok(fit),
        best => Err(LocaliseError::Inconsistent {
            residual_m: best.map_or(all.residual_m, |fit| fit.residual_m),
        }),
    }
}

#[derive(Debug, Clone, Copy)]
struct Pair {
    index: usize,
    in_plate: Point3<f64>,
    in_world: Point3<f64>,
}

fn centroid(points: impl ExactSizeIterator<Item = Point3<f64>>) -> Point3<f64> {
    let count = points.len() as f64;
    Point3::from(points.map(|point| point.coords).sum::<Vector3<f64>>() / count)
}

/// Centroids, and U, V of the SVD of H = sum (p_i - p)(m_i - m)^T = U S V^T.
struct Alignment {
    plate: Point3<f64>,
    world: Point3<f64>,
    u: Matrix3<f64>,
    v: Matrix3<f64>,
}

impl Alignment {
    fn of(pairs: &[Pair]) -> Self {
        let plate = centroid(pairs.iter().map(|pair| pair.in_plate));
        let world = centroid(pairs.iter().map(|pair| pair.in_world));
        let h: Matrix3<f64> = pairs
            .iter()
            .map(|pair| (pair.in_plate - plate) * (pair.in_world - world).transpose())
            .sum();
        let svd = h.svd(true, true);
        let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
            unreachable!("both were asked for")
        };
        Self {
            plate,
            world,
            u,
            v: v_t.transpose(),
        }
    }

    /// R = V diag(1, 1, sign) U^T; nalgebra sorts the singular values, so the sign turns the least one.
    fn rotation(&self, sign: f64) -> Matrix3<f64> {
        self.v * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * self.u.transpose()
    }

    fn determinant_sign(&self) -> f64 {
        (self.u.determinant() * self.v.determinant()).signum()
    }

    fn residual_m(&self, rotation: &Matrix3<f64>, pairs: &[Pair]) -> f64 {
        let sum: f64 = pairs
            .iter()
            .map(|pair| {
                (rotation * (pair.in_plate - self.plate) - (pair.in_world - self.world))
                    .norm_squared()
            })
            .sum();
        (sum / pairs.len() as f64).sqrt()
    }
}

fn rigid_fit(pairs: &[Pair]) -> Result<PlateFit, LocaliseError> {
    if collinear(pairs.iter().map(|pair| pair.in_plate))
        || collinear(pairs.iter().map(|pair| pair.in_world))
    {
        return Err(LocaliseError::Collinear);
    }
    let alignment = Alignment::of(pairs);
    let rotation = alignment.rotation(alignment.determinant_sign());
    let residual_m = alignment.residual_m(&rotation, pairs);
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = alignment.world.coords - rotation * alignment.plate.coords;
    Ok(PlateFit {
        world_from_plate: Pose::from_parts(translation.into(), rotation),
        residual_m,
        recovered: None,
    })
}

/// What would remain if the plate could be mirrored.
fn mirror_residual_m(pairs: &[Pair]) -> f64 {
    let alignment = Alignment::of(pairs);
    alignment.residual_m(&alignment.rotation(-alignment.determinant_sign()), pairs)
}

fn collinear(points: impl ExactSizeIterator<Item = Point3<f64>> + Clone) -> bool {
    let center = centroid(points.clone());
    let spread: Matrix3<f64> = points
        .map(|point| (point - center) * (point - center).transpose())
        .sum();
    // Squares of the extents, greatest first.
    let extents = spread.svd(false, false).singular_values;
    extents[1] <= extents[0] * MIN_THICKNESS * MIN_THICKNESS
}
