//! The room around the table, and the person who comes to it. Metres; the world's origin is on the floor below the
//! middle of the table, x to the right and y away from where robot 0 drives, z up.

use nalgebra::{Point3, Rotation3, Vector3};

use super::{
    objects::{Builder, Placement, matte, plain},
    scene::{Finish, Material, ObjectId, Primitive},
    shapes::{Frustum, Shape},
    texture::{Pattern, rgb},
};

pub const TABLE_HEIGHT_M: f64 = 0.75;
const TABLE_SIZE_M: [f64; 2] = [1.45, 0.92];
/// Far below the thickness of anything that stands on the table.
const ON_CLOTH_M: f64 = 1e-3;

/// Whether a point of the world that the room itself shows lies on the tablecloth's upper side.
pub fn is_on_cloth(point: &Point3<f64>) -> bool {
    let [width, depth] = TABLE_SIZE_M;
    (point.z - TABLE_HEIGHT_M).abs() < ON_CLOTH_M
        && point.x.abs() < 0.5 * width
        && point.y.abs() < 0.5 * depth
}

const FLOOR_M: f64 = 7.0;

/// A point on the table.
pub fn on_table(x: f64, y: f64, yaw_rad: f64) -> Placement {
    Placement {
        foot: Point3::new(x, y, TABLE_HEIGHT_M),
        yaw_rad,
    }
}

/// Walls, floor and furniture: everything that never moves and has no name.
pub fn room() -> Vec<Primitive> {
    let mut room = Builder::new(ObjectId::ROOM);
    let at = Point3::new;
    let planks = |seed| {
        matte(Pattern::Planks {
            light: rgb(0xb98a58),
            dark: rgb(0x7d5430),
            width: 0.11,
            seed,
        })
    };
    let paper = |seed, ground, figure| {
        matte(Pattern::Wallpaper {
            ground: rgb(ground),
            figure: rgb(figure),
            seed,
        })
    };
    room.cuboid(at(0.0, 0.0, -0.1), [FLOOR_M, FLOOR_M, 0.1], 0.0, planks(1));
    room.cuboid(
        at(0.0, 2.05, 0.0),
        [5.2, 0.1, 2.8],
        0.0,
        paper(2, 0xd9cfb4, 0x9fae93),
    );
    room.cuboid(
        at(-2.45, -0.4, 0.0),
        [0.1, 5.0, 2.8],
        0.0,
        paper(3, 0xc9d0cf, 0x8fa3ab),
    );
    room.cuboid(
        at(2.45, -0.4, 0.0),
        [0.1, 5.0, 2.8],
        0.0,
        paper(4, 0xd8c3ae, 0xb08d78),
    );
    for wall in &mut room.primitives {
        wall.casts_shadow = false;
    }
    let white = plain(0xe6e0d2);
    room.cuboid(at(0.0, 1.99, 0.0), [5.0, 0.03, 0.12], 0.0, white.clone());
    room.cuboid(at(-2.39, -0.4, 0.0), [0.03, 5.0, 0.12], 0.0, white.clone());
    room.cuboid(at(2.39, -0.4, 0.0), [0.03, 5.0, 0.12], 0.0, white);
    table(&mut room);
    chair(&mut room, at(0.28, 0.78, 0.0), 0.15);
    chair(&mut room, at(-0.95, 0.62, 0.0), 0.9);
    let near = room.primitives.len();
    sideboard(&mut room);
    for (center, size, yaw, seed) in [
        (at(-0.62, 1.985, 1.05), (0.62, 0.46), 0.0, 3),
        (at(0.42, 1.985, 1.22), (0.42, 0.34), 0.0, 9),
        (at(1.25, 1.985, 0.95), (0.70, 0.52), 0.0, 15),
        (
            at(-2.385, 0.55, 1.05),
            (0.74, 0.50),
            std::f64::consts::FRAC_PI_2,
            27,
        ),
        (
            at(-2.385, -0.55, 1.0),
            (0.50, 0.62),
            std::f64::consts::FRAC_PI_2,
            39,
        ),
        (
            at(2.385, 0.5, 1.05),
            (0.8, 0.5),
            std::f64::consts::FRAC_PI_2,
            51,
        ),
    ] {
        let (width, height): (f64, f64) = size;
        let picture = Pattern::Picture {
            width: width as f32,
            height: height as f32,
            seed,
        };
        room.cuboid(center, [width, 0.03, height], yaw, matte(picture));
    }
    room.cuboid(at(-2.38, 1.45, 0.0), [0.05, 0.85, 2.05], 0.0, planks(11));
    bookshelf(&mut room, at(1.75, 1.86, 0.0));
    for background in &mut room.primitives[near..] {
        background.casts_shadow = false;
    }
    room.primitives
}

fn table(room: &mut Builder) {
    let cloth = Pattern::Cloth {
        ground: rgb(0xece5d3),
        warp: rgb(0x9c3f3a),
        weft: rgb(0x4d6d94),
        seed: 17,
    };
    let [width, depth] = TABLE_SIZE_M;
    let slab = 0.028;
    room.cuboid(
        Point3::new(0.0, 0.0, TABLE_HEIGHT_M - slab),
        [width, depth, slab],
        0.0,
        matte(cloth.clone()),
    );
    // The cloth hangs over the edges.
    let hang = 0.17;
    for (x, y, size) in [
        (0.0, -depth * 0.5, [width + 0.008, 0.004, hang]),
        (0.0, depth * 0.5, [width + 0.008, 0.004, hang]),
        (-width * 0.5, 0.0, [0.004, depth + 0.008, hang]),
        (width * 0.5, 0.0, [0.004, depth + 0.008, hang]),
    ] {
        room.cuboid(
            Point3::new(x, y, TABLE_HEIGHT_M - hang),
            size,
            0.0,
            matte(cloth.clone()),
        );
    }
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let foot = Point3::new(x * (width * 0.5 - 0.08), y * (depth * 0.5 - 0.08), 0.0);
        room.cuboid(
            foot,
            [0.06, 0.06, TABLE_HEIGHT_M - slab],
            0.0,
            plain(0x6b4a2c),
        );
    }
}

fn sideboard(room: &mut Builder) {
    let oak = |seed| {
        matte(Pattern::Planks {
            light: rgb(0x9c6b40),
            dark: rgb(0x5e3b20),
            width: 0.2,
            seed,
        })
    };
    let at = Point3::new;
    room.cuboid(at(-0.25, 1.76, 0.0), [1.7, 0.42, 0.80], 0.0, oak(5));
    room.cuboid(at(-0.25, 1.75, 0.80), [1.76, 0.46, 0.03], 0.0, oak(6));
    for x in [-0.81, -0.25, 0.31] {
        room.cuboid(
            at(x, 1.545, 0.08),
            [0.52, 0.012, 0.66],
            0.0,
            oak(7 + (x * 10.0) as i32 as u32),
        );
        room.sphere(at(x + 0.2, 1.53, 0.45), 0.014, plain(0xc9a24a));
    }
    // A radio, a row of books, a lamp, a vase.
    room.cuboid(
        at(0.25, 1.72, 0.83),
        [0.32, 0.14, 0.19],
        0.08,
        plain(0x3c4f4a),
    );
    room.cuboid(
        at(0.20, 1.645, 0.85),
        [0.17, 0.01, 0.14],
        0.08,
        matte(Pattern::Rings {
            a: rgb(0xb9a888),
            b: rgb(0x59503f),
            period: 0.016,
            share_of_b: 0.5,
        }),
    );
    room.sphere(at(0.355, 1.655, 0.95), 0.025, plain(0xd8c9a0));
    row_of_books(room, at(-0.95, 1.75, 0.83), 9, 100);
    let up = Vector3::z();
    let lamp = at(-0.35, 1.76, 0.83);
    room.add(
        Shape::Frustum(Frustum::new(lamp, lamp + up * 0.02, 0.07, 0.06).with_top()),
        plain(0x54402c),
    );
    room.tube(
        &[(lamp, 0.012), (lamp + up * 0.24, 0.012)],
        &plain(0x54402c),
    );
    room.add(
        Shape::Frustum(Frustum::new(lamp + up * 0.22, lamp + up * 0.40, 0.135, 0.085).with_top()),
        matte(Pattern::Knit {
            a: rgb(0xf1dfae),
            b: rgb(0xe4c98a),
            period: 0.03,
        }),
    );
}

fn row_of_books(room: &mut Builder, start: Point3<f64>, count: u32, seed: u32) {
    const INKS: [u32; 7] = [
        0x8a2f2a, 0x2d4f73, 0xc9a13f, 0x3d6b4d, 0x5b3f66, 0xb8673a, 0x2f3337,
    ];
    let mut x = start.x;
    for index in 0..count {
        let pick = (index * 5 + seed) % 7;
        let width = 0.022 + 0.004 * f64::from((index * 3 + seed) % 5);
        let height = 0.19 + 0.012 * f64::from((index * 2 + seed) % 6);
        let spine = Pattern::Spine {
            ground: rgb(INKS[pick as usize]),
            ink: rgb(0xe9dfc0),
            seed: seed + index,
        };
        room.cuboid(
            Point3::new(x + width * 0.5, start.y, start.z),
            [width, 0.15, height],
            0.0,
            matte(spine),
        );
        x += width + 0.001;
    }
}

fn bookshelf(room: &mut Builder, foot: Point3<f64>) {
    let wood = plain(0x8a6844);
    for x in [-0.46, 0.46] {
        room.cuboid(
            foot + Vector3::new(x, 0.0, 0.0),
            [0.025, 0.26, 1.75],
            0.0,
            wood.clone(),
        );
    }
    for (level, z) in [0.1, 0.45, 0.80, 1.15, 1.5].into_iter().enumerate() {
        room.cuboid(
            foot + Vector3::new(0.0, 0.0, z),
            [0.92, 0.26, 0.022],
            0.0,
            wood.clone(),
        );
        let start = foot + Vector3::new(-0.43, 0.0, z + 0.022);
        row_of_books(
            room,
            start,
            14 + 4 * (level as u32 % 3),
            200 + 31 * level as u32,
        );
    }
}

fn chair(room: &mut Builder, foot: Point3<f64>, yaw_rad: f64) {
    let place = Placement { foot, yaw_rad };
    let (sin, cos) = place.yaw_rad.sin_cos();
    let at = |x: f64, y: f64, z: f64| foot + Vector3::new(x * cos - y * sin, x * sin + y * cos, z);
    let wood = Material {
        pattern: Pattern::Planks {
            light: rgb(0x7a5233),
            dark: rgb(0x553519),
            width: 0.06,
            seed: 30,
        },
        finish: Finish::Matte,
    };
    room.cuboid(
        at(0.0, 0.0, 0.43),
        [0.42, 0.42, 0.03],
        yaw_rad,
        wood.clone(),
    );
    for (x, y) in [(-0.18, -0.18), (0.18, -0.18), (-0.18, 0.18), (0.18, 0.18)] {
        let height = if y > 0.0 { 1.0 } else { 0.43 };
        room.cuboid(at(x, y, 0.0), [0.035, 0.035, height], yaw_rad, wood.clone());
    }
    for z in [0.60, 0.74, 0.88] {
        room.cuboid(at(0.0, 0.18, z), [0.36, 0.02, 0.07], yaw_rad, wood.clone());
    }
}

/// How a person stands: where, and where the reaching hand is (its palm).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Person {
    /// On the floor; the person faces along +x.
    pub foot: Point3<f64>,
    pub palm: Point3<f64>,
    /// Radius of what the hand holds, metres.
    pub grip_radius_m: f64,
}

impl Person {
    /// Where the palm is when the arm hangs.
    pub fn resting_palm(foot: Point3<f64>) -> Point3<f64> {
        foot + Vector3::new(0.16, -0.27, 0.92)
    }

    pub fn build(&self, object: ObjectId) -> Vec<Primitive> {
        let mut body = Builder::new(object);
        let shirt = matte(Pattern::Knit {
            a: rgb(0x27496d),
            b: rgb(0xd9d4c3),
            period: 0.05,
        });
        let skin = matte(Pattern::Mottled {
            a: rgb(0xd9a183),
            b: rgb(0xc98a6c),
            size: 0.05,
            seed: 2,
        });
        let trousers = matte(Pattern::Mottled {
            a: rgb(0x3d4247),
            b: rgb(0x2b2f35),
            size: 0.03,
            seed: 4,
        });
        let foot = self.foot;
        let at = |x: f64, y: f64, z: f64| foot + Vector3::new(x, y, z);
        // Leaning forward as far as the hand has to go.
        let lean_rad = (((self.palm - foot).x - 0.40) * 1.1).clamp(0.0, 0.65);
        let bend = Rotation3::from_axis_angle(&Vector3::y_axis(), lean_rad);
        let above_hip = |x: f64, y: f64, z: f64| at(0.0, 0.0, 0.92) + bend * Vector3::new(x, y, z);
        for y in [-0.1, 0.1] {
            body.tube(
                &[
                    (at(0.0, y, 0.05), 0.06),
                    (at(0.02, y, 0.5), 0.065),
                    (at(0.0, y, 0.9), 0.09),
                ],
                &trousers,
            );
        }
        body.ellipsoid(
            above_hip(0.0, 0.0, 0.05),
            [0.13, 0.19, 0.16],
            bend,
            trousers,
        );
        body.ellipsoid(
            above_hip(0.0, 0.0, 0.30),
            [0.125, 0.195, 0.32],
            bend,
            shirt.clone(),
        );
        body.tube(
            &[
                (above_hip(0.0, -0.15, 0.50), 0.075),
                (above_hip(0.0, 0.15, 0.50), 0.075),
            ],
            &shirt,
        );
        body.tube(
            &[
                (above_hip(0.01, 0.0, 0.55), 0.055),
                (above_hip(0.03, 0.0, 0.66), 0.05),
            ],
            &skin,
        );
        let head = above_hip(0.06, 0.0, 0.76);
        body.ellipsoid(
            head,
            [0.095, 0.078, 0.12],
            Rotation3::identity(),
            skin.clone(),
        );
        body.ellipsoid(
            head + Vector3::new(-0.02, 0.0, 0.03),
            [0.098, 0.086, 0.112],
            Rotation3::identity(),
            plain(0x3a2618),
        );
        // The other arm hangs.
        let (sleeve, upper, lower) = (0.055, 0.05, 0.036);
        let other = above_hip(0.0, 0.21, 0.49);
        body.tube(&[(other, sleeve), (at(-0.02, 0.27, 1.12), upper)], &shirt);
        body.tube(
            &[
                (at(-0.02, 0.27, 1.12), 0.042),
                (at(0.1, 0.28, 0.90), lower),
                (at(0.12, 0.28, 0.82), 0.04),
            ],
            &skin,
        );

        let shoulder = above_hip(0.02, -0.20, 0.49);
        let towards = self.palm - shoulder;
        let flat = Vector3::new(towards.x, towards.y, 0.0).normalize();
        let wrist = self.palm - flat * 0.085 + Vector3::z() * 0.02;
        let elbow = elbow(shoulder, wrist, 0.30, 0.28);
        body.tube(&[(shoulder, sleeve + 0.01), (elbow, upper)], &shirt);
        let cuff = elbow + (wrist - elbow) * 0.35;
        body.tube(&[(elbow, upper), (cuff, 0.046)], &shirt);
        body.tube(&[(cuff, 0.040), (wrist, 0.029)], &skin);
        self.hand(&mut body, wrist, flat, &skin);
        body.primitives
    }

    /// Palm behind what is held, fingers round its far side, the thumb round the near one.
    fn hand(&self, body: &mut Builder, wrist: Point3<f64>, forward: Vector3<f64>, skin: &Material) {
        let left = Vector3::z().cross(&forward);
        let grip = self.grip_radius_m + 0.009;
        let held = self.palm + forward * (grip + 0.012);
        body.tube(
            &[(wrist, 0.028), (self.palm - forward * 0.012, 0.030)],
            skin,
        );
        let around = |angle: f64, up: f64| {
            held - forward * (grip * angle.cos()) + left * (grip * angle.sin()) + Vector3::z() * up
        };
        for finger in 0..4 {
            let up = 0.030 - 0.019 * f64::from(finger);
            let reach = [1.9, 2.15, 2.1, 1.8][finger as usize];
            let points: Vec<_> = (0..5)
                .map(|joint| {
                    (
                        around(0.25 + (reach - 0.25) * f64::from(joint) / 4.0, up),
                        0.0088,
                    )
                })
                .collect();
            body.tube(&points, skin);
        }
        let thumb: Vec<_> = (0..4)
            .map(|joint| {
                (
                    around(
                        -0.3 - 0.38 * f64::from(joint),
                        0.012 + 0.008 * f64::from(joint),
                    ),
                    0.0105,
                )
            })
            .collect();
        body.tube(&thumb, skin);
    }
}

/// Where the elbow goes: on the circle that both bones allow, as low and as far out as possible; a target out of reach
/// stretches the arm.
fn elbow(shoulder: Point3<f64>, wrist: Point3<f64>, upper: f64, lower: f64) -> Point3<f64> {
    let span = wrist - shoulder;
    let distance = span.norm();
    let along = span / distance;
    let stretch = (distance / (upper + lower - 1e-3)).max(1.0);
    let (upper, lower) = (upper * stretch, lower * stretch);
    let share = (upper * upper - lower * lower + distance * distance) / (2.0 * distance);
    let height = (upper * upper - share * share).max(0.0).sqrt();
    let down = Vector3::new(-0.1, -0.45, -1.0);
    let outward = (down - along * down.dot(&along)).normalize();
    shoulder + along * share + outward * height
}
