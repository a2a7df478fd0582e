//! How much of the lamp and of the sky a point sees.
//!
//! In: a point on a surface. Out: two shares, 0..1. Both are sampled; a tile looks for them at as few of its points as
//! their differences allow.

use std::sync::LazyLock;

use nalgebra::{Matrix3, Point3, Vector3};

use super::{
    Path, Scratch, Seen, Tracer,
    tiles::{TILE, Tile},
};
use crate::{
    isa::{Isa, for_each_isa},
    lanes::{LANES, Lanes},
    model::{camera::Intrinsics, pose::Pose},
    simulation::{
        casters::Beam,
        scene::{Hit, Light, Scene},
        shapes::{Ball, Bounds, Directions, PLAIN},
    },
};

/// Things farther than this do not dim the sky light, metres.
const SKY_REACH: f64 = 0.26;
/// Share of light that one pane of glass lets through to what is in its shadow.
const GLASS_SHADOW: f32 = 0.9;
/// Points in a mirror or behind glass that are no farther apart than this cube's side share their light, metres: about a
/// pixel on the table.
const CELL_M: f64 = 0.004;
/// Of a smaller part in the pixel, shadows are not looked for.
const WEAK: f32 = 0.3;

/// Primitive and part.
pub(super) type Face = (u32, u32);

pub(super) fn face_of(hit: &Hit) -> Face {
    (hit.primitive as u32, hit.crossing.part as u32)
}

/// How much of the sky and of the lamp a point on a surface sees, 0..1. Light changes slowly over a surface, so
/// neighbouring pixels on the same face of the same primitive share it.
#[derive(Clone, Copy)]
pub(super) struct Lit {
    pub(super) face: Face,
    pub(super) sky: f32,
    pub(super) lamp: f32,
}

/// The light on everything that a camera sees.
pub struct LitView {
    /// Of every pixel, row by row.
    pub(super) lit: Vec<Lit>,
    depth_m: Vec<f32>,
    camera: Intrinsics,
    eye: Point3<f64>,
    /// Of the world: turns and scales it to `(u, v, 1)` times depth; rows.
    pixels_from_world: [Vector3<f64>; 3],
}

/// Depths that differ by more, relative to themselves, are not of one place on a face.
const SAME_DEPTH: f32 = 0.03;
/// Of the four pixels around a point, those that show its face must have so much of the weight.
const ENOUGH: f32 = 0.2;

impl LitView {
    pub(super) fn new(
        lit: Vec<Lit>,
        depth_m: Vec<f32>,
        camera: Intrinsics,
        world_from_camera: &Pose,
    ) -> Self {
        let pixels_from_camera = Matrix3::new(
            camera.fx, 0.0, camera.cx, //
            0.0, camera.fy, camera.cy, //
            0.0, 0.0, 1.0,
        );
        let pixels_from_world =
            pixels_from_camera * world_from_camera.rotation.inverse().to_rotation_matrix();
        Self {
            lit,
            depth_m,
            camera,
            eye: Point3::from(world_from_camera.translation.vector),
            pixels_from_world: [0, 1, 2].map(|row| pixels_from_world.row(row).transpose()),
        }
    }

    /// The light on a point, if the camera sees the place: from the pixels around it that show the same face.
    // Asked for most pixels of the side cameras.
    #[inline(always)]
    pub(super) fn light_at(&self, hit: &Hit, point: &Point3<f64>) -> Option<Lit> {
        let from_eye = point - self.eye;
        let [u, v, depth_m] = self
            .pixels_from_world
            .each_ref()
            .map(|row| row.x * from_eye.x + row.y * from_eye.y + row.z * from_eye.z);
        if depth_m <= 0.0 {
            return None;
        }
        let nearness = depth_m.recip();
        let (u, v) = (u * nearness, v * nearness);
        let Intrinsics { width, height, .. } = self.camera;
        // Also false for what is not a number.
        let inside = u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64;
        if !inside {
            return None;
        }
        // Of 32 bits, signed: the quickest conversion that truncates.
        let (column, row) = (u as i32 as usize, v as i32 as usize);
        let (right, down) = ((u - column as f64) as f32, (v - row as f64) as f32);
        let face = face_of(hit);
        let depth_m = depth_m as f32;
        let (mut weight, mut sky, mut lamp) = (0.0, 0.0, 0.0);
        let last = (column + 2).min(width);
        for (row, along) in [(row, 1.0 - down), (row + 1, down)] {
            // Rectified cameras meet in whole rows.
            if along < 1e-4 || row >= height {
                continue;
            }
            let places = row * width + column..row * width + last;
            let lits = self.lit[places.clone()].iter().zip(&self.depth_m[places]);
            for ((lit, there_m), across) in lits.zip([1.0 - right, right]) {
                let same = lit.face == face && (there_m - depth_m).abs() < SAME_DEPTH * depth_m;
                let near = if same { across * along } else { 0.0 };
                weight += near;
                sky += near * lit.sky;
                lamp += near * lit.lamp;
            }
        }
        (weight > ENOUGH).then(|| {
            let share = weight.recip();
            Lit {
                face,
                sky: sky * share,
                lamp: lamp * share,
            }
        })
    }
}

/// Nothing, or glass, which has no light of its own.
pub(super) const UNLIT: Lit = Lit {
    face: (u32::MAX, 0),
    sky: 1.0,
    lamp: 1.0,
};

/// Lamp shares that differ by more are the edge of a shadow, where each pixel is looked at.
const SHADOW_EDGE: f32 = 0.08;
/// Shares of the lamp and of the sky that differ by less, across a tile, are looked for at few of its points.
const LEVEL: [f32; 2] = [0.06, 0.08];

/// Points spread evenly over the unit disc, x and y: a sunflower's seeds. They are the same everywhere, so that shadows
/// belong to the world, not to whoever looks.
static SEEDS: LazyLock<[Lanes; 2]> = LazyLock::new(|| {
    const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
    let polar = |index: usize| {
        let radius = ((index as f64 + 0.5) / LANES as f64).sqrt();
        (radius, index as f64 * GOLDEN_ANGLE)
    };
    let place = |of: fn(f64) -> f64| {
        std::array::from_fn(|index| {
            let (radius, angle) = polar(index);
            (radius * of(angle)) as f32
        })
    };
    [place(f64::cos), place(f64::sin)]
});

for_each_isa! {
    /// Share of the lamp that these primitives leave to a point; `rays` lead from there to places on the lamp.
    fn lamp_left(scene: &Scene, casters: &[u32], point: &Point3<f64>, rays: &Directions, share: &mut f32) = lamp_left_kernel;
}

#[inline(always)]
fn lamp_left_kernel(
    scene: &Scene,
    casters: &[u32],
    point: &Point3<f64>,
    rays: &Directions,
    share: &mut f32,
) {
    let mut left = [1.0; LANES];
    for &caster in casters {
        let primitive = &scene.primitives()[caster as usize];
        let mut nearest = [1.0; LANES];
        primitive.shape.approach::<PLAIN>(point, rays, &mut nearest);
        let passed = if primitive.is_glass() {
            GLASS_SHADOW
        } else {
            0.0
        };
        for lane in 0..LANES {
            left[lane] *= if nearest[lane] < 1.0 { passed } else { 1.0 };
        }
        if left == [0.0; LANES] {
            break;
        }
    }
    *share = left.iter().sum::<f32>() / LANES as f32;
}

for_each_isa! {
    /// Share of the sky that these primitives leave to a point, as near as [`SKY_REACH`] in the directions of `rays`, of
    /// unit length.
    fn sky_left(scene: &Scene, casters: &[u32], point: &Point3<f64>, rays: &Directions, share: &mut f32) = sky_left_kernel;
}

#[inline(always)]
fn sky_left_kernel(
    scene: &Scene,
    casters: &[u32],
    point: &Point3<f64>,
    rays: &Directions,
    share: &mut f32,
) {
    let mut nearest = [SKY_REACH as f32; LANES];
    for &caster in casters {
        scene.primitives()[caster as usize]
            .shape
            .approach::<PLAIN>(point, rays, &mut nearest);
    }
    let hidden = 1.0 - nearest.iter().sum::<f32>() / (SKY_REACH as f32 * LANES as f32);
    *share = 1.0 - 0.9 * hidden;
}

/// Rays towards [`SEEDS`] on the disc that `right` and `forward` span, and `middle` farther.
#[inline(always)]
fn fan(
    right: Vector3<f32>,
    forward: Vector3<f32>,
    middle: impl Fn(usize) -> Vector3<f32>,
) -> Directions {
    let mut rays = [[0.0; LANES]; 3];
    let [xs, ys] = &*SEEDS;
    for lane in 0..LANES {
        let ray = middle(lane) + right * xs[lane] + forward * ys[lane];
        for axis in 0..3 {
            rays[axis][lane] = ray[axis];
        }
    }
    rays
}

fn basis(normal: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if normal.z.abs() < 0.9 {
        Vector3::z()
    } else {
        Vector3::x()
    };
    let right = helper.cross(normal).normalize();
    (right, normal.cross(&right))
}

/// The coarsest lattice in a tile: the distance of its points, and the first.
const COARSE: usize = 4;
const MIDST: usize = 2;

/// Light that hardly changes over a tile's face.
struct Level([[Lit; 2]; 2]);

impl Level {
    /// Of the four points of the coarsest lattice, if they show one face and differ by less than [`LEVEL`].
    fn between(known: &[[Option<Lit>; TILE]; TILE]) -> Option<Self> {
        const THERE: usize = MIDST + COARSE;
        let corners = [
            [known[MIDST][MIDST]?, known[MIDST][THERE]?],
            [known[THERE][MIDST]?, known[THERE][THERE]?],
        ];
        let all = corners.as_flattened();
        let range = |of: fn(&Lit) -> f32| {
            let least = all.iter().map(of).fold(f32::INFINITY, f32::min);
            all.iter().map(of).fold(0.0, f32::max) - least
        };
        (all.iter().all(|lit| lit.face == all[0].face)
            && range(|lit| lit.lamp) < LEVEL[0]
            && range(|lit| lit.sky) < LEVEL[1])
            .then_some(Self(corners))
    }

    fn face(&self) -> Face {
        self.0[0][0].face
    }

    /// Linear in both directions, so that neighbouring tiles join.
    fn at(&self, column: usize, row: usize) -> Lit {
        let share = |i: usize| (i as f32 - MIDST as f32) / COARSE as f32;
        let (across, down) = (share(column), share(row));
        let [upper, lower] = &self.0;
        let of = |value: fn(&Lit) -> f32| {
            let along =
                |row: &[Lit; 2]| value(&row[0]) + (value(&row[1]) - value(&row[0])) * across;
            let (upper, lower) = (along(upper), along(lower));
            (upper + (lower - upper) * down).clamp(0.0, 1.0)
        };
        Lit {
            face: self.face(),
            sky: of(|lit| lit.sky),
            lamp: of(|lit| lit.lamp),
        }
    }
}

/// Mean light of the points of the same face at most `reach` pixels away, the nearer ones counting more, if there are
/// `enough` and they differ by less than `lamp_range` and `sky_range`.
fn shared(
    known: &[[Option<Lit>; TILE]; TILE],
    face: Face,
    (column, row): (usize, usize),
    reach: usize,
    enough: usize,
    [lamp_range, sky_range]: [f32; 2],
) -> Option<Lit> {
    let (mut count, mut weight, mut sky, mut lamp) = (0, 0.0, 0.0, 0.0);
    let (mut low, mut high) = ([1.0f32; 2], [0.0f32; 2]);
    for there_row in row.saturating_sub(reach)..(row + reach + 1).min(TILE) {
        for there_column in column.saturating_sub(reach)..(column + reach + 1).min(TILE) {
            let Some(lit) = known[there_row][there_column].filter(|lit| lit.face == face) else {
                continue;
            };
            let (across, down) = (there_column.abs_diff(column), there_row.abs_diff(row));
            let near = 1.0 / (across * across + down * down) as f32;
            count += 1;
            weight += near;
            sky += near * lit.sky;
            lamp += near * lit.lamp;
            low = [low[0].min(lit.lamp), low[1].min(lit.sky)];
            high = [high[0].max(lit.lamp), high[1].max(lit.sky)];
        }
    }
    (count >= enough && high[0] - low[0] < lamp_range && high[1] - low[1] < sky_range).then(|| {
        Lit {
            face,
            sky: sky / weight,
            lamp: lamp / weight,
        }
    })
}

/// May something in these bounds hide a part of a lamp of this radius, `length` away in `direction`? Never wrong if it
/// says no.
fn in_beam(
    bounds: &Bounds,
    point: &Point3<f64>,
    direction: &Vector3<f64>,
    length: f64,
    radius: f64,
) -> bool {
    let center = bounds.center() - point;
    let half = bounds.half();
    let along = center.dot(direction);
    let reach = half.dot(&direction.abs());
    if along + reach <= 0.0 {
        return false;
    }
    // The beam is no wider within the bounds than at their far end.
    let margin = radius * ((along + reach) / length).min(1.0);
    let grown = half.add_scalar(margin);
    // Separating axes of the segment and the grown box: the three sides, then the three cross products.
    let middle = center - direction * (length * 0.5);
    let arm = direction * (length * 0.5);
    let arm_size = arm.abs();
    (0..3).all(|i| middle[i].abs() <= grown[i] + arm_size[i])
        && (0..3).all(|i| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            (middle[j] * arm[k] - middle[k] * arm[j]).abs()
                <= grown[j] * arm_size[k] + grown[k] * arm_size[j] + 1e-12
        })
}

impl Tracer<'_> {
    /// Finds what may shade any of the points that a tile sees.
    fn look_around(&self, isa: Isa, tile: &mut Tile, seen: &[Seen]) {
        tile.reach = Bounds::of(
            seen.iter()
                .filter_map(|(_, path, _, hit)| hit.map(|hit| path.ray.at(hit.crossing.t))),
        );
        if tile.reach.min.x > tile.reach.max.x {
            return;
        }
        // Room for the further samples of its pixels.
        let spare = Vector3::from_element(2e-3);
        tile.reach.min -= spare;
        tile.reach.max += spare;
        let center = tile.reach.center();
        let half = tile.reach.half();
        let lamp = &self.lighting.lamp;
        let axis = lamp.center - center;
        let length = axis.norm();
        let direction = axis / length;
        let beam = Beam {
            from: center,
            from_radius: half.norm(),
            direction,
            length,
            lamp_radius: lamp.radius,
        };
        let bounds = |index: u32| &self.scene.bounds()[index as usize];
        let casters = self.scene.casters(Light::Lamp);
        casters.in_beam(isa, &beam, &mut tile.lamp);
        tile.lamp.retain(|&index| {
            let grown = Bounds {
                min: bounds(index).min - half,
                max: bounds(index).max + half,
            };
            in_beam(&grown, &center, &direction, length, lamp.radius)
        });
        let about = Ball {
            center,
            radius: half.norm() + SKY_REACH,
        };
        self.scene
            .casters(Light::Sky)
            .near(isa, &about, &mut tile.sky);
        tile.sky.retain(|&index| {
            let apart = (bounds(index).center() - center).abs() - bounds(index).half() - half;
            apart.max() < SKY_REACH
        });
    }

    /// Finds the light on every point that a tile sees: exactly at every sixteenth pixel, at every fourth where those
    /// of the tile, `columns` wide, differ, and between these where the edge of a shadow is; at none that the camera
    /// `beside` sees too.
    pub(super) fn light(
        &self,
        tile: &mut Tile,
        seen: &[Seen],
        beside: Option<&LitView>,
        lit: &mut [Lit],
        columns: usize,
        scratch: &mut Scratch,
    ) {
        let places = || {
            let rows = seen.chunks(columns).enumerate();
            rows.flat_map(|(row, line)| {
                let places = line.iter().enumerate();
                places.map(move |(column, seen)| (column, row, seen))
            })
        };
        let mut known = [[None::<Lit>; TILE]; TILE];
        if let Some(beside) = beside {
            let mut all = true;
            for (column, row, &(at, ref path, _, hit)) in places() {
                let Some(hit) = hit else {
                    continue;
                };
                let light = beside.light_at(&hit, &path.ray.at(hit.crossing.t));
                known[row][column] = light;
                match light {
                    Some(light) => lit[at] = light,
                    None => all = false,
                }
            }
            if all {
                return;
            }
        }
        self.look_around(scratch.isa, tile, seen);
        let tile = &*tile;
        if tile.lamp.is_empty() && tile.sky.is_empty() {
            for (at, path, _, hit) in seen {
                if let Some(hit) = hit {
                    lit[*at] = self.unshaded(path, hit);
                }
            }
            return;
        }
        for step in [COARSE, 2, 1] {
            // The coarsest lattice is centred in the tile.
            let phase = step / COARSE * MIDST;
            let on_lattice = |i: usize| i % step == phase;
            let before = known;
            for (column, row, &(at, ref path, _, hit)) in places() {
                let Some(hit) = hit else {
                    continue;
                };
                if known[row][column].is_some() || !on_lattice(column) || !on_lattice(row) {
                    continue;
                }
                let face = face_of(&hit);
                let shared = match step {
                    COARSE => None,
                    2 => shared(&before, face, (column, row), TILE, 3, LEVEL),
                    _ => shared(&before, face, (column, row), 1, 1, [SHADOW_EDGE, 1.0])
                        .or_else(|| shared(&before, face, (column, row), 2, 3, LEVEL)),
                };
                let light = shared.unwrap_or_else(|| self.light_on(path, &hit, scratch));
                known[row][column] = Some(light);
                lit[at] = light;
            }
            let Some(level) = (step == COARSE).then(|| Level::between(&known)).flatten() else {
                continue;
            };
            for (column, row, &(at, _, _, hit)) in places() {
                let same = hit.is_some_and(|hit| face_of(&hit) == level.face());
                if same && known[row][column].is_none() {
                    let light = level.at(column, row);
                    known[row][column] = Some(light);
                    lit[at] = light;
                }
            }
        }
    }

    /// The light on a point that nothing shades: all of the lamp, unless it is turned away from it.
    fn unshaded(&self, path: &Path, hit: &Hit) -> Lit {
        let primitive = &self.scene.primitives()[hit.primitive];
        if primitive.is_glass() {
            return UNLIT;
        }
        let point = path.ray.at(hit.crossing.t);
        let outward = primitive.shape.normal(&point, hit.crossing.part);
        let facing = path.ray.direction.dot(&outward) < 0.0;
        let towards = outward.dot(&(self.lighting.lamp.center - point)) > 0.0;
        Lit {
            face: face_of(hit),
            sky: 1.0,
            lamp: f32::from(facing == towards),
        }
    }

    /// [`Self::light_on`] what is seen in a mirror or through glass. Points of a face that lie close together share it.
    pub(super) fn light_beyond(&self, path: &Path, hit: &Hit, scratch: &mut Scratch) -> Lit {
        if path.bounces == 0 || path.weight < WEAK {
            return self.light_on(path, hit, scratch);
        }
        let point = path.ray.at(hit.crossing.t);
        let cell = (point.coords / CELL_M).map(|x| x.floor() as i32);
        let place = (face_of(hit), [cell.x, cell.y, cell.z]);
        if let Some(lit) = scratch.beyond.get(&place) {
            return *lit;
        }
        let lit = self.light_on(path, hit, scratch);
        scratch.beyond.insert(place, lit);
        lit
    }

    pub(super) fn light_on(&self, path: &Path, hit: &Hit, scratch: &mut Scratch) -> Lit {
        let primitive = &self.scene.primitives()[hit.primitive];
        if primitive.is_glass() {
            return UNLIT;
        }
        if path.weight < WEAK {
            return Lit {
                face: face_of(hit),
                sky: 0.85,
                lamp: 0.8,
            };
        }
        let point = path.ray.at(hit.crossing.t);
        let outward = primitive.shape.normal(&point, hit.crossing.part);
        let facing = path.ray.direction.dot(&outward) < 0.0;
        let normal = if facing { outward } else { -outward };
        let own = (!primitive.hollow).then_some(hit.primitive as u32);
        Lit {
            face: face_of(hit),
            sky: self.sky_share(&point, &normal, own, scratch),
            lamp: if normal.dot(&(self.lighting.lamp.center - point)) > 0.0 {
                self.lamp_share(&point, own, scratch)
            } else {
                0.0
            },
        }
    }

    /// Share of the sky that near things leave to the point, 0..1.
    fn sky_share(
        &self,
        point: &Point3<f64>,
        normal: &Vector3<f64>,
        own: Option<u32>,
        scratch: &mut Scratch,
    ) -> f32 {
        let center = point + normal * (SKY_REACH * 0.5);
        let about = Ball {
            center,
            radius: SKY_REACH * 0.9,
        };
        let casters = &mut scratch.casters;
        self.scene
            .casters(Light::Sky)
            .near(scratch.isa, &about, casters);
        casters.retain(|&index| {
            let bounds = &self.scene.bounds()[index as usize];
            let nearest = center.sup(&bounds.min).inf(&bounds.max);
            Some(index) != own
                && (nearest - center).norm_squared() < SKY_REACH * SKY_REACH * 0.8
                // Not wholly behind the surface.
                && normal.dot(&(bounds.center() - point)) + normal.abs().dot(&bounds.half()) > 1e-3
        });
        if scratch.casters.is_empty() {
            return 1.0;
        }
        let (right, forward) = basis(normal);
        let [xs, ys] = &*SEEDS;
        let rays = fan(right.cast(), forward.cast(), |lane| {
            let (x, y) = (xs[lane], ys[lane]);
            normal.cast() * (1.0 - x * x - y * y).sqrt()
        });
        let mut share = 1.0;
        sky_left(
            scratch.isa,
            self.scene,
            &scratch.casters,
            point,
            &rays,
            &mut share,
        );
        share
    }

    /// Share of the lamp that the point sees, 0..1.
    fn lamp_share(&self, point: &Point3<f64>, own: Option<u32>, scratch: &mut Scratch) -> f32 {
        let lamp = &self.lighting.lamp;
        let axis = lamp.center - point;
        let length = axis.norm();
        let direction = axis / length;
        let beam = Beam {
            from: *point,
            from_radius: 0.0,
            direction,
            length,
            lamp_radius: lamp.radius,
        };
        let casters = &mut scratch.casters;
        self.scene
            .casters(Light::Lamp)
            .in_beam(scratch.isa, &beam, casters);
        casters.retain(|&index| {
            let bounds = &self.scene.bounds()[index as usize];
            Some(index) != own && in_beam(bounds, point, &direction, length, lamp.radius)
        });
        if scratch.casters.is_empty() {
            return 1.0;
        }
        let (right, forward) = basis(&direction);
        let scaled = |vector: Vector3<f64>| (vector * lamp.radius).cast();
        let axis: Vector3<f32> = axis.cast();
        let rays = fan(scaled(right), scaled(forward), |_| axis);
        let mut share = 1.0;
        lamp_left(
            scratch.isa,
            self.scene,
            &scratch.casters,
            point,
            &rays,
            &mut share,
        );
        share
    }
}
