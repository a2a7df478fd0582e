//! Everyday things, built from simple shapes. Metres; every thing stands on its own origin, z up.

use nalgebra::{Point3, Rotation3, Vector3};

use super::{
    scene::{Finish, Material, ObjectId, Primitive},
    shapes::{Disc, Ellipsoid, Frustum, Shape, Solid, Sphere},
    texture::{Label, Pattern, Rgb, rgb},
};

/// Index of refraction of drinking glasses.
pub const GLASS_INDEX: f64 = 1.52;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Glass,
    BlackCup,
    YellowMug,
    MilkCarton,
    CoffeeCan,
    Apple,
    CerealBox,
    Teapot,
    Books,
    FruitBowl,
    Plant,
    Breakfast,
    Candle,
}

/// Where a thing stands, and how it is turned about z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    pub foot: Point3<f64>,
    pub yaw_rad: f64,
}

impl Placement {
    fn at(&self, right: f64, forward: f64, up: f64) -> Point3<f64> {
        let (sin, cos) = self.yaw_rad.sin_cos();
        self.foot + Vector3::new(right * cos - forward * sin, right * sin + forward * cos, up)
    }
}

pub fn matte(pattern: Pattern) -> Material {
    Material {
        pattern,
        finish: Finish::Matte,
    }
}

pub fn plain(hex: u32) -> Material {
    matte(Pattern::Plain(rgb(hex)))
}

fn glossy(pattern: Pattern, reflectance: f32, sharpness: f32) -> Material {
    Material {
        pattern,
        finish: Finish::Glossy {
            reflectance,
            sharpness,
        },
    }
}

fn glazed(colour: Rgb) -> Material {
    glossy(Pattern::Plain(colour), 0.05, 300.0)
}

fn metal(hex: u32) -> Material {
    glossy(Pattern::Plain(rgb(hex)), 0.5, 120.0)
}

/// Collects the parts of one object.
pub struct Builder {
    object: ObjectId,
    pub primitives: Vec<Primitive>,
}

impl Builder {
    pub fn new(object: ObjectId) -> Self {
        Self {
            object,
            primitives: Vec::new(),
        }
    }

    pub fn add(&mut self, shape: Shape, material: Material) -> &mut Self {
        self.primitives.push(Primitive {
            shape,
            material,
            object: self.object,
            hollow: false,
            casts_shadow: true,
        });
        self
    }

    pub fn cuboid(
        &mut self,
        origin: Point3<f64>,
        size: [f64; 3],
        yaw_rad: f64,
        material: Material,
    ) -> &mut Self {
        self.add(
            Shape::Solid(Solid::cuboid(origin, size.into(), yaw_rad)),
            material,
        )
    }

    pub fn sphere(&mut self, center: Point3<f64>, radius: f64, material: Material) -> &mut Self {
        self.add(Shape::Sphere(Sphere { center, radius }), material)
    }

    pub fn ellipsoid(
        &mut self,
        center: Point3<f64>,
        semi_axes: [f64; 3],
        rotation: Rotation3<f64>,
        material: Material,
    ) -> &mut Self {
        self.add(
            Shape::Ellipsoid(Ellipsoid::new(center, semi_axes.into(), rotation)),
            material,
        )
    }

    /// A round bar through points of given radius, with round joints and ends.
    pub fn tube(&mut self, points: &[(Point3<f64>, f64)], material: &Material) -> &mut Self {
        for &(center, radius) in points {
            self.sphere(center, radius, material.clone());
        }
        for pair in points.windows(2) {
            let [(from, from_radius), (to, to_radius)] = [pair[0], pair[1]];
            self.add(
                Shape::Frustum(Frustum::new(from, to, from_radius, to_radius)),
                material.clone(),
            );
        }
        self
    }

    /// An open vessel with a wall of the given thickness.
    fn vessel(
        &mut self,
        foot: Point3<f64>,
        vessel: &Vessel,
        outside: &Material,
        inside: &Material,
    ) -> &mut Self {
        let Vessel {
            height,
            base_radius,
            top_radius,
            wall,
            floor,
        } = *vessel;
        let up = Vector3::z();
        let top = foot + up * height;
        // The inner wall runs parallel to the outer one.
        let inner_base = base_radius + (top_radius - base_radius) * floor / height - wall;
        self.add(
            Shape::Frustum(Frustum::new(foot, top, base_radius, top_radius).with_base()),
            outside.clone(),
        );
        self.add(
            Shape::Frustum(
                Frustum::new(foot + up * floor, top, inner_base, top_radius - wall).with_base(),
            ),
            inside.clone(),
        );
        if let Some(inner) = self.primitives.last_mut() {
            inner.hollow = true;
        }
        self.add(
            Shape::Disc(Disc {
                center: top,
                normal: up,
                inner_radius: top_radius - wall,
                radius: top_radius,
            }),
            outside.clone(),
        )
    }

    /// A half ring beside a vessel, in the vertical plane of `placement`'s right.
    fn handle(
        &mut self,
        placement: &Placement,
        reach: (f64, f64),
        middle: f64,
        half_height: f64,
        radius: f64,
        material: &Material,
    ) -> &mut Self {
        let points: Vec<_> = (0..=8)
            .map(|step| {
                let angle = std::f64::consts::PI * (f64::from(step) / 8.0 - 0.5);
                let point = placement.at(
                    reach.0 + reach.1 * angle.cos(),
                    0.0,
                    middle + half_height * angle.sin(),
                );
                (point, radius)
            })
            .collect();
        self.tube(&points, material)
    }
}

struct Vessel {
    height: f64,
    base_radius: f64,
    top_radius: f64,
    wall: f64,
    floor: f64,
}

impl Kind {
    /// As in masks' folder names and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Glass => "glass",
            Self::BlackCup => "cup",
            Self::YellowMug => "mug",
            Self::MilkCarton => "milk",
            Self::CoffeeCan => "coffee",
            Self::Apple => "apple",
            Self::CerealBox => "cereal",
            Self::Teapot => "teapot",
            Self::Books => "books",
            Self::FruitBowl => "fruit",
            Self::Plant => "plant",
            Self::Breakfast => "breakfast",
            Self::Candle => "candle",
        }
    }

    /// Where a hand takes hold of it: radius and height.
    pub fn grip_m(self) -> (f64, f64) {
        match self {
            Self::Glass => (0.036, 0.09),
            Self::BlackCup => (0.043, 0.06),
            Self::YellowMug => (0.042, 0.06),
            Self::MilkCarton => (0.045, 0.12),
            Self::CoffeeCan => (0.052, 0.10),
            _ => (0.04, 0.04),
        }
    }

    /// Its parts, standing at `placement`.
    pub fn build(self, placement: &Placement, object: ObjectId) -> Vec<Primitive> {
        let mut builder = Builder::new(object);
        let Placement { foot, yaw_rad } = *placement;
        match self {
            Self::Glass => {
                let glass = Material {
                    pattern: Pattern::Plain([1.0; 3]),
                    finish: Finish::Glass { index: GLASS_INDEX },
                };
                let tumbler = Vessel {
                    height: 0.155,
                    base_radius: 0.031,
                    top_radius: 0.041,
                    wall: 0.0028,
                    floor: 0.014,
                };
                // A hair above the table: two surfaces in one place would have no order.
                builder.vessel(foot + Vector3::z() * 1e-4, &tumbler, &glass, &glass);
            }
            Self::BlackCup => {
                let black = glazed(rgb(0x17171a));
                let cup = Vessel {
                    height: 0.088,
                    base_radius: 0.035,
                    top_radius: 0.045,
                    wall: 0.004,
                    floor: 0.006,
                };
                builder.vessel(foot, &cup, &black, &black);
                builder.handle(placement, (0.038, 0.030), 0.047, 0.026, 0.0055, &black);
            }
            Self::YellowMug => {
                let stripes = glossy(
                    Pattern::Rings {
                        a: rgb(0xe9b23a),
                        b: rgb(0x2d5d8a),
                        period: 0.045,
                        share_of_b: 0.35,
                    },
                    0.05,
                    300.0,
                );
                let mug = Vessel {
                    height: 0.098,
                    base_radius: 0.040,
                    top_radius: 0.042,
                    wall: 0.004,
                    floor: 0.006,
                };
                builder.vessel(foot, &mug, &stripes, &glazed(rgb(0xf1ebdc)));
                builder.handle(
                    placement,
                    (0.038, 0.028),
                    0.050,
                    0.030,
                    0.006,
                    &glazed(rgb(0xe9b23a)),
                );
            }
            Self::MilkCarton => {
                let paper = glossy(
                    Pattern::Label(Label {
                        ground: rgb(0xf3f3ee),
                        band: rgb(0x2f7fc1),
                        ink: rgb(0x123a6b),
                        text: "MILK",
                        letter: 0.021,
                        text_v: 0.142,
                        repeat: 0.3,
                        band_v: (0.0, 0.062),
                        seed: 3,
                    }),
                    0.03,
                    60.0,
                );
                builder.add(
                    Shape::Solid(Solid::gabled(
                        foot,
                        Vector3::new(0.085, 0.085, 0.225),
                        0.038,
                        yaw_rad,
                    )),
                    paper,
                );
                builder.cuboid(
                    placement.at(0.0, 0.0, 0.222),
                    [0.085, 0.005, 0.02],
                    yaw_rad,
                    plain(0xe9eef2),
                );
                builder.add(
                    Shape::Frustum(
                        Frustum::new(
                            placement.at(0.0, -0.021, 0.205),
                            placement.at(0.0, -0.030, 0.217),
                            0.013,
                            0.013,
                        )
                        .with_top(),
                    ),
                    glossy(Pattern::Plain(rgb(0xc8372d)), 0.04, 120.0),
                );
            }
            Self::CoffeeCan => {
                let label = glossy(
                    Pattern::Label(Label {
                        ground: rgb(0x7c1f1c),
                        band: rgb(0xd8a441),
                        ink: rgb(0xf6e7c3),
                        text: "COFFEE",
                        letter: 0.0165,
                        text_v: 0.098,
                        repeat: std::f32::consts::PI * 0.05,
                        band_v: (0.118, 0.138),
                        seed: 8,
                    }),
                    0.04,
                    140.0,
                );
                let up = Vector3::z();
                builder.add(
                    Shape::Frustum(
                        Frustum::new(foot, foot + up * 0.15, 0.05, 0.05)
                            .with_base()
                            .turned(yaw_rad - std::f64::consts::FRAC_PI_2),
                    ),
                    label,
                );
                let tin = metal(0xb9bcc0);
                builder.add(
                    Shape::Frustum(
                        Frustum::new(foot + up * 0.15, foot + up * 0.156, 0.0515, 0.0515)
                            .with_base()
                            .with_top(),
                    ),
                    tin.clone(),
                );
                builder.add(
                    Shape::Frustum(
                        Frustum::new(foot, foot + up * 0.005, 0.0515, 0.0515).with_top(),
                    ),
                    tin,
                );
            }
            Self::Apple => {
                apple(&mut builder, foot, 0.038, 0xb5302a, 0xd9b44a);
            }
            Self::CerealBox => {
                let print = matte(Pattern::Label(Label {
                    ground: rgb(0xe2742b),
                    band: rgb(0xf4d35e),
                    ink: rgb(0x5a1f12),
                    text: "OATS",
                    letter: 0.040,
                    text_v: 0.215,
                    repeat: 0.5,
                    band_v: (0.03, 0.12),
                    seed: 21,
                }));
                builder.cuboid(foot, [0.19, 0.06, 0.28], yaw_rad, print);
            }
            Self::Teapot => teapot(&mut builder, placement),
            Self::Books => {
                let mut level = 0.0;
                for (index, (width, depth, height, turn, hex)) in [
                    (0.24, 0.17, 0.035, 0.05, 0x2f4858),
                    (0.22, 0.155, 0.026, -0.16, 0xa23b2e),
                    (0.20, 0.14, 0.030, 0.22, 0xd0b469),
                    (0.17, 0.12, 0.018, -0.05, 0x3f6f5a),
                ]
                .into_iter()
                .enumerate()
                {
                    let cover = matte(Pattern::Mottled {
                        a: rgb(hex),
                        b: rgb(hex).map(|value| value * 1.5 + 0.01),
                        size: 0.05,
                        seed: 40 + index as u32,
                    });
                    let pages = matte(Pattern::Rings {
                        a: rgb(0xe8dfc8),
                        b: rgb(0xc9bc9c),
                        period: 0.004,
                        share_of_b: 0.4,
                    });
                    let yaw = yaw_rad + turn;
                    let base = |up: f64| placement.at(0.0, 0.0, level + up);
                    builder.cuboid(base(0.0), [width, depth, 0.004], yaw, cover.clone());
                    builder.cuboid(
                        base(0.004),
                        [width - 0.01, depth - 0.006, height - 0.008],
                        yaw,
                        pages,
                    );
                    builder.cuboid(base(height - 0.004), [width, depth, 0.004], yaw, cover);
                    level += height;
                }
            }
            Self::FruitBowl => {
                let bowl = Vessel {
                    height: 0.065,
                    base_radius: 0.055,
                    top_radius: 0.125,
                    wall: 0.006,
                    floor: 0.01,
                };
                let blue = glossy(
                    Pattern::Rings {
                        a: rgb(0xe9e6da),
                        b: rgb(0x35608f),
                        period: 0.033,
                        share_of_b: 0.4,
                    },
                    0.05,
                    250.0,
                );
                builder.vessel(foot, &bowl, &blue, &glazed(rgb(0xe9e6da)));
                apple(
                    &mut builder,
                    placement.at(-0.045, 0.035, 0.028),
                    0.038,
                    0xa9c13f,
                    0xc8432c,
                );
                apple(
                    &mut builder,
                    placement.at(0.045, 0.045, 0.028),
                    0.037,
                    0xb5302a,
                    0xd9a23a,
                );
                for (right, forward, up) in [
                    (-0.035, -0.045, 0.058),
                    (0.050, -0.035, 0.058),
                    (0.005, 0.005, 0.098),
                ] {
                    builder.sphere(placement.at(right, forward, up), 0.037, orange());
                }
            }
            Self::Plant => plant(&mut builder, placement),
            Self::Breakfast => {
                let plate = glazed(rgb(0xeceadf));
                let up = Vector3::z();
                builder.add(
                    Shape::Frustum(
                        Frustum::new(foot, foot + up * 0.006, 0.06, 0.075)
                            .with_base()
                            .with_top(),
                    ),
                    plate.clone(),
                );
                builder.add(
                    Shape::Frustum(Frustum::new(
                        foot + up * 0.006,
                        foot + up * 0.016,
                        0.075,
                        0.105,
                    )),
                    plate,
                );
                let crust = matte(Pattern::Mottled {
                    a: rgb(0xb9793a),
                    b: rgb(0x7a4217),
                    size: 0.02,
                    seed: 5,
                });
                let points: Vec<_> = (0..7)
                    .map(|step| {
                        let angle = -0.4 + f64::from(step) * 0.62;
                        let thick =
                            0.011 + 0.013 * (f64::from(step) / 6.0 * std::f64::consts::PI).sin();
                        (
                            placement.at(0.047 * angle.cos(), 0.047 * angle.sin(), 0.008 + thick),
                            thick,
                        )
                    })
                    .collect();
                builder.tube(&points, &crust);
                builder.cuboid(
                    placement.at(0.135, 0.0, 0.0),
                    [0.016, 0.10, 0.003],
                    yaw_rad,
                    metal(0xc9cbd0),
                );
                builder.cuboid(
                    placement.at(0.135, -0.095, 0.0),
                    [0.018, 0.09, 0.010],
                    yaw_rad,
                    plain(0x3b2a20),
                );
            }
            Self::Candle => {
                let up = Vector3::z();
                let brass = glossy(Pattern::Plain(rgb(0xb98b3c)), 0.35, 120.0);
                builder.add(
                    Shape::Frustum(Frustum::new(foot, foot + up * 0.012, 0.045, 0.030).with_top()),
                    brass.clone(),
                );
                builder.add(
                    Shape::Frustum(
                        Frustum::new(foot + up * 0.012, foot + up * 0.05, 0.014, 0.018).with_top(),
                    ),
                    brass,
                );
                builder.add(
                    Shape::Frustum(
                        Frustum::new(foot + up * 0.05, foot + up * 0.19, 0.012, 0.011).with_top(),
                    ),
                    glossy(Pattern::Plain(rgb(0xf2e9cf)), 0.03, 60.0),
                );
                builder.tube(
                    &[(foot + up * 0.19, 0.0015), (foot + up * 0.2, 0.0012)],
                    &plain(0x222222),
                );
            }
        }
        builder.primitives
    }
}

fn orange() -> Material {
    glossy(
        Pattern::Mottled {
            a: rgb(0xe8861e),
            b: rgb(0xd9680f),
            size: 0.006,
            seed: 77,
        },
        0.03,
        60.0,
    )
}

fn apple(builder: &mut Builder, foot: Point3<f64>, radius: f64, skin: u32, blush: u32) {
    let skin = glossy(
        Pattern::Mottled {
            a: rgb(skin),
            b: rgb(blush),
            size: 0.05,
            seed: skin,
        },
        0.04,
        120.0,
    );
    let center = foot + Vector3::z() * radius * 0.92;
    builder.ellipsoid(
        center,
        [radius, radius, radius * 0.92],
        Rotation3::identity(),
        skin,
    );
    let top = center + Vector3::z() * radius * 0.85;
    builder.tube(
        &[
            (top, 0.002),
            (top + Vector3::new(0.004, 0.0, 0.014), 0.0015),
        ],
        &plain(0x4a331d),
    );
}

fn teapot(builder: &mut Builder, placement: &Placement) {
    let glaze = glossy(
        Pattern::Mottled {
            a: rgb(0x2f6f6a),
            b: rgb(0x4f9a8c),
            size: 0.03,
            seed: 12,
        },
        0.06,
        350.0,
    );
    builder.ellipsoid(
        placement.at(0.0, 0.0, 0.066),
        [0.085, 0.085, 0.066],
        Rotation3::identity(),
        glaze.clone(),
    );
    builder.ellipsoid(
        placement.at(0.0, 0.0, 0.122),
        [0.046, 0.046, 0.020],
        Rotation3::identity(),
        glaze.clone(),
    );
    builder.sphere(placement.at(0.0, 0.0, 0.150), 0.012, glaze.clone());
    builder.tube(
        &[
            (placement.at(0.07, 0.0, 0.05), 0.020),
            (placement.at(0.105, 0.0, 0.078), 0.014),
            (placement.at(0.128, 0.0, 0.115), 0.010),
            (placement.at(0.142, 0.0, 0.128), 0.009),
        ],
        &glaze,
    );
    let back = Placement {
        yaw_rad: placement.yaw_rad + std::f64::consts::PI,
        ..*placement
    };
    builder.handle(&back, (0.072, 0.048), 0.075, 0.038, 0.0075, &glaze);
}

fn plant(builder: &mut Builder, placement: &Placement) {
    let clay = matte(Pattern::Mottled {
        a: rgb(0xb5623d),
        b: rgb(0x95492b),
        size: 0.03,
        seed: 6,
    });
    let up = Vector3::z();
    let foot = placement.foot;
    builder.add(
        Shape::Frustum(Frustum::new(foot, foot + up * 0.11, 0.050, 0.068).with_base()),
        clay.clone(),
    );
    builder.add(
        Shape::Frustum(
            Frustum::new(foot + up * 0.10, foot + up * 0.125, 0.074, 0.076)
                .with_base()
                .with_top(),
        ),
        clay,
    );
    builder.add(
        Shape::Disc(Disc {
            center: foot + up * 0.1255,
            normal: up,
            inner_radius: 0.0,
            radius: 0.068,
        }),
        plain(0x2b1d14),
    );
    for leaf in 0..22 {
        let ring = f64::from(leaf % 3);
        let turn = placement.yaw_rad + f64::from(leaf) * 2.399_963;
        let tilt = 0.35 + ring * 0.33;
        let length = 0.075 + 0.018 * f64::from((leaf * 7) % 5) / 4.0;
        let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), turn)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), tilt)
            * Rotation3::from_axis_angle(&Vector3::z_axis(), 0.5 * f64::from(leaf % 2));
        let root = foot + up * (0.13 + 0.075 * (2.0 - ring) * 0.5);
        let green = glossy(
            Pattern::Mottled {
                a: rgb([0x3f7d3a, 0x5a9a45, 0x2f6a34][leaf as usize % 3]),
                b: rgb(0x86b95c),
                size: 0.03,
                seed: leaf as u32,
            },
            0.03,
            40.0,
        );
        builder.ellipsoid(
            root + rotation * Vector3::new(0.0, 0.0, length),
            [0.006, 0.024, length],
            rotation,
            green.clone(),
        );
    }
}
