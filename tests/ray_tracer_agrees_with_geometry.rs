//! Depth, masks, refraction and the rig's geometry agree with closed forms.

use nalgebra::{Point3, Vector3};
use surprised::{
    model::{camera::Intrinsics, pose::Pose},
    simulation::{
        objects::{Builder, Kind, matte},
        rig::{Rig, looking},
        room::on_table,
        scene::{Finish, Material, ObjectId, Scene},
        script::{Script, Views},
        shapes::{Frustum, Ray, Shape, Sphere},
        story::PERSON,
        texture::{Pattern, rgb},
        tracer::{Lighting, Rendering, Tracer, camera_ray, refracted},
    },
};

const DEPTH_TOLERANCE_M: f32 = 1e-5;
const THING: ObjectId = ObjectId(7);

fn camera() -> Intrinsics {
    Rig::default().intrinsics
}

fn grey() -> Material {
    matte(Pattern::Plain([0.5; 3]))
}

fn render(builder: Builder, pose: &Pose) -> Rendering {
    let scene = Scene::new(builder.primitives);
    let lighting = Lighting::default();
    Tracer {
        scene: &scene,
        lighting: &lighting,
    }
    .render(&camera(), pose)
}

/// Compares depth with `expected(ray) -> metres along the ray`, and the object map with where that exists.
fn agrees(rendering: &Rendering, pose: &Pose, expected: impl Fn(&Ray) -> Option<f64>) {
    let camera = camera();
    let mut covered = 0;
    for row in 0..camera.height {
        for column in 0..camera.width {
            let at = row * camera.width + column;
            let (ray, cos) = camera_ray(&camera, pose, column as f64, row as f64);
            let expected = expected(&ray);
            assert_eq!(
                rendering.object[at] == THING,
                expected.is_some(),
                "mask at ({column}, {row})"
            );
            let depth = expected.map_or(0.0, |t| (t * cos) as f32);
            assert!(
                (rendering.depth_m[at] - depth).abs() < DEPTH_TOLERANCE_M,
                "({column}, {row}): {} instead of {depth}",
                rendering.depth_m[at]
            );
            covered += usize::from(expected.is_some());
        }
    }
    assert!(covered > 1000, "the test shows something: {covered} pixels");
}

#[test]
fn a_plane_has_its_depth() {
    let pose = looking(Point3::new(0.3, -1.4, 1.1), Point3::new(0.0, 0.0, 0.4));
    let mut builder = Builder::new(THING);
    builder.cuboid(
        Point3::new(0.0, 0.0, -0.5),
        [200.0, 200.0, 0.5],
        0.3,
        grey(),
    );
    let rendering = render(builder, &pose);
    agrees(&rendering, &pose, |ray| {
        let t = -ray.origin.z / ray.direction.z;
        let hit = ray.origin + ray.direction * t;
        (t > 0.0 && hit.coords.xy().norm() < 100.0).then_some(t)
    });
}

#[test]
fn a_sphere_has_its_depth() {
    let pose = looking(Point3::new(0.2, -1.3, 0.9), Point3::new(0.05, 0.0, 0.7));
    let (center, radius) = (Point3::new(0.0, 0.1, 0.72), 0.31);
    let mut builder = Builder::new(THING);
    builder.sphere(center, radius, grey());
    let rendering = render(builder, &pose);
    agrees(&rendering, &pose, |ray| {
        let offset = ray.origin - center;
        let b = offset.dot(&ray.direction);
        let discriminant = b * b - offset.norm_squared() + radius * radius;
        (discriminant >= 0.0).then(|| -b - discriminant.sqrt())
    });
}

#[test]
fn an_upright_cylinder_has_its_depth() {
    let pose = looking(Point3::new(-0.4, -1.2, 1.0), Point3::new(0.0, 0.0, 0.6));
    let (radius, height) = (0.22, 0.5);
    let foot = Point3::new(0.05, 0.02, 0.4);
    let mut builder = Builder::new(THING);
    builder.add(
        Shape::Frustum(
            Frustum::new(foot, foot + Vector3::z() * height, radius, radius)
                .with_base()
                .with_top(),
        ),
        grey(),
    );
    let rendering = render(builder, &pose);
    agrees(&rendering, &pose, |ray| {
        let offset = ray.origin - foot;
        let top = (height - offset.z) / ray.direction.z;
        let on_top = offset.xy() + ray.direction.xy() * top;
        if top > 0.0 && on_top.norm() <= radius {
            return Some(top);
        }
        let a = ray.direction.xy().norm_squared();
        let b = offset.xy().dot(&ray.direction.xy());
        let c = offset.xy().norm_squared() - radius * radius;
        let t = (-b - (b * b - a * c).sqrt()) / a;
        let z = offset.z + t * ray.direction.z;
        (0.0..=height).contains(&z).then_some(t)
    });
}

#[test]
fn light_bends_as_snell_says() {
    for index in [1.33, 1.52, 2.4] {
        for degrees in [0.0f64, 5.0, 30.0, 60.0, 85.0] {
            let angle = degrees.to_radians();
            let direction = Vector3::new(angle.sin(), 0.0, -angle.cos());
            let inside = refracted(&direction, &Vector3::z(), 1.0 / index).unwrap();
            assert!((inside.norm() - 1.0).abs() < 1e-12);
            assert!(
                (inside.x - angle.sin() / index).abs() < 1e-12,
                "sin a = n sin b"
            );
            let outside = refracted(&inside, &Vector3::z(), index).unwrap();
            assert!(
                (outside - direction).norm() < 1e-9,
                "the way back is the way there"
            );
        }
        let critical = (1.0 / index).asin();
        for (off, bends) in [(-1e-6, true), (1e-6, false)] {
            let angle: f64 = critical + off;
            let direction = Vector3::new(angle.sin(), 0.0, -angle.cos());
            assert_eq!(refracted(&direction, &Vector3::z(), index).is_some(), bends);
        }
    }
}

/// A pane of thickness d shifts what is behind it by d sin(a - b) / cos(b); seen in the picture, not in a formula's copy.
#[test]
fn a_pane_of_glass_shifts_what_is_behind_it() {
    let index = 1.52;
    let thickness = 0.4;
    let camera = camera();
    let wall_y = 1.0;
    let eye = Point3::new(0.0, -1.0, 0.0);
    let pose = looking(eye, Point3::origin());
    // Behind the pane a dark half and a bright half, split at an x that a bent ray reaches exactly.
    let column = 250usize;
    let (ray, _) = camera_ray(&camera, &pose, column as f64, 119.0);
    let sin = ray.direction.x / ray.direction.xy().norm();
    let a = sin.asin();
    let b = (sin / index).asin();
    let straight = (wall_y - eye.y) * a.tan();
    let bent = straight - thickness * (a.tan() - b.tan());
    let picture = |pane: bool| {
        let mut builder = Builder::new(THING);
        let dark = matte(Pattern::Plain([0.02; 3]));
        let bright = matte(Pattern::Plain(rgb(0xffffff)));
        builder.cuboid(
            Point3::new(bent - 5.0, wall_y + 0.05, -5.0),
            [10.0, 0.1, 10.0],
            0.0,
            dark,
        );
        builder.cuboid(
            Point3::new(bent + 5.0, wall_y + 0.05, -5.0),
            [10.0, 0.1, 10.0],
            0.0,
            bright,
        );
        if pane {
            let glass = Material {
                pattern: Pattern::Plain([1.0; 3]),
                finish: Finish::Glass { index },
            };
            builder.cuboid(
                Point3::new(0.0, -0.2, -2.0),
                [8.0, thickness, 4.0],
                0.0,
                glass,
            );
        }
        render(builder, &pose)
    };
    let edge = |rendering: &Rendering| {
        let row = &rendering.radiance[119 * camera.width..120 * camera.width];
        // Where the row is half way between dark and bright, by linear interpolation of the mixed pixel.
        let (low, high) = (row[column - 8][1], row[column + 8][1]);
        let half = (low + high) * 0.5;
        (column - 8..column + 8)
            .find(|&at| row[at][1] <= half && row[at + 1][1] > half)
            .expect("an edge")
    };
    let seen = edge(&picture(true));
    assert!(
        seen.abs_diff(column) <= 1,
        "the edge is seen at {seen}, not {column}"
    );
    // Without the pane the same edge is far from there.
    let direct = camera.fx * bent / (wall_y - eye.y) + camera.cx;
    assert!(
        (direct - column as f64).abs() > 3.0,
        "the pane matters: {direct}"
    );
}

#[test]
fn a_pane_has_its_own_depth_and_lets_depth_through() {
    let pose = looking(Point3::new(0.0, -1.0, 0.0), Point3::origin());
    let mut builder = Builder::new(THING);
    builder.cuboid(Point3::new(0.0, 1.05, -5.0), [10.0, 0.1, 10.0], 0.0, grey());
    let glass = Material {
        pattern: Pattern::Plain([1.0; 3]),
        finish: Finish::Glass { index: 1.5 },
    };
    builder.cuboid(Point3::new(0.0, 0.0, -2.0), [8.0, 0.02, 4.0], 0.0, glass);
    let rendering = render(builder, &pose);
    let middle = 120 * 320 + 160;
    assert!((rendering.depth_m[middle] - 0.99).abs() < DEPTH_TOLERANCE_M);
    assert!((rendering.depth_through_glass_m[middle] - 2.0).abs() < DEPTH_TOLERANCE_M);
}

/// Whatever a side camera sees at its depth, a ray from the middle camera to that point meets there, or something nearer.
#[test]
fn left_middle_and_right_see_one_world() {
    let script = Script::tabletop(1);
    let capture = script.capture(0, 799, Views::Triple);
    let scene = script.scene(799.0);
    let rig = &script.stations[0].rig;
    let camera = &rig.intrinsics;
    let (left, right) = capture.sides.as_ref().unwrap();
    for (side, middle_from_side) in [
        (left, &rig.middle_from_left),
        (right, &rig.middle_from_right),
    ] {
        let (mut same, mut hidden, mut through) = (0, 0, 0);
        for row in 0..camera.height {
            for column in 0..camera.width {
                let at = row * camera.width + column;
                let z = f64::from(side.depth_m[at]);
                let in_middle = middle_from_side * camera.unproject(column as f64, row as f64, z);
                let Some((u, v)) = camera.project(&in_middle) else {
                    continue;
                };
                assert!((v - row as f64).abs() < 1e-4, "rectified: the same row");
                if !(0.0..camera.width as f64).contains(&u) {
                    continue;
                }
                let (ray, cos) = camera_ray(camera, &capture.world_from_camera, u, v);
                let hit = scene
                    .nearest(&ray, 1e-7, f64::INFINITY, |_| true)
                    .expect("a closed room");
                let seen = hit.crossing.t * cos;
                if (seen - in_middle.z).abs() < 1e-5 {
                    same += 1;
                    assert_eq!(scene.primitives()[hit.primitive].object, side.object[at]);
                } else if seen < in_middle.z {
                    hidden += 1;
                } else {
                    through += 1;
                }
            }
        }
        println!("same {same}, hidden {hidden}, through {through}");
        assert!(same > 60_000);
        assert!(hidden < same / 20);
        // Depth is single precision: a ray may just miss a rim.
        assert!(
            through < same / 10_000,
            "{through} rays went through what the side camera sees"
        );
    }
}

#[test]
fn a_mask_is_the_same_before_and_while_the_thing_stands() {
    // Nothing moves between these two stretches but the item; the robot's path is the same function of the frame.
    let with = Script::tabletop(1);
    let capture = with.capture(0, 464, Views::Middle);
    let glass = &capture.middle.masks[0];
    assert!(glass.iter().filter(|&&value| value == 255).count() > 300);
    assert_eq!(glass, &capture.middle.mask_of(with.story.items[0].id));

    // The same world without it: the silhouette it would have must be the one it has.
    let pose = capture.world_from_camera;
    let mut builder = Builder::new(ObjectId(3));
    builder.cuboid(Point3::new(0.0, 0.0, 0.65), [1.4, 0.9, 0.1], 0.0, grey());
    builder.sphere(Point3::new(-0.05, -0.25, 0.8), 0.05, grey());
    let empty = Scene::new(builder.primitives.clone());
    let lighting = Lighting::default();
    let scene = |scene: &Scene| {
        Tracer {
            scene,
            lighting: &lighting,
        }
        .render(&camera(), &pose)
    };
    let thing = Kind::BlackCup.build(&on_table(-0.1, -0.13, 0.4), THING);
    let would = surprised::simulation::tracer::depth_alone(&thing, &camera(), &pose);
    let before = scene(&empty);
    builder.primitives.extend(thing);
    let after = scene(&Scene::new(builder.primitives));
    let mut seen = 0;
    for (at, would) in would.iter().enumerate() {
        let would_be = would.is_finite() && *would <= before.depth_m[at];
        let is = after.object[at] == THING;
        assert_eq!(would_be, is, "pixel {at}");
        seen += usize::from(is);
    }
    assert!(seen > 300);
}

#[test]
fn the_person_is_seen_while_events_last() {
    let script = Script::tabletop(1);
    for (frame, there) in [
        (320, false),
        (345, true),
        (400, false),
        (662, true),
        (675, true),
        (970, true),
        (1000, false),
    ] {
        let capture = script.capture(0, frame - 1, Views::Middle);
        let pixels = capture
            .middle
            .object
            .iter()
            .filter(|&&object| object == PERSON)
            .count();
        assert_eq!(pixels > 200, there, "frame {frame}: {pixels} pixels");
    }
}

#[test]
fn a_ray_inside_a_sphere_meets_its_far_side() {
    let sphere = Shape::Sphere(Sphere {
        center: Point3::origin(),
        radius: 1.0,
    });
    let ray = Ray {
        origin: Point3::new(0.25, 0.0, 0.0),
        direction: Vector3::x(),
    };
    let crossing = sphere.crossing(&ray, 1e-7, f64::INFINITY).unwrap();
    assert!((crossing.t - 0.75).abs() < 1e-12);
}

#[test]
fn the_edge_of_a_shadow_is_as_soft_as_the_lamp_is_wide() {
    const BOARD_M: f64 = 0.5;
    let pose = looking(Point3::new(-0.2, -1.3, 1.5), Point3::new(-0.25, 0.05, 0.0));
    let lit = Lighting::default();
    let lamp = &lit.lamp;
    let mut dark = lit.clone();
    dark.lamp.irradiance = [0.0; 3];
    let scene = |board: bool| {
        let mut builder = Builder::new(ObjectId::ROOM);
        builder.cuboid(Point3::new(0.0, 0.0, -0.1), [20.0, 20.0, 0.1], 0.0, grey());
        if board {
            let thin = [0.3, 0.3, 1e-3];
            builder.cuboid(Point3::new(0.0, 0.0, BOARD_M), thin, 0.0, grey());
        }
        Scene::new(builder.primitives)
    };
    let green = |scene: &Scene, lighting: &Lighting| -> Vec<f32> {
        let rendering = Tracer { scene, lighting }.render(&camera(), &pose);
        rendering.radiance.iter().map(|colour| colour[1]).collect()
    };
    let (bare, boarded) = (scene(false), scene(true));
    let (all, none, some) = (
        green(&bare, &lit),
        green(&bare, &dark),
        green(&boarded, &lit),
    );
    // The share of the lamp that the board leaves to a point of the floor, from many points of the lamp.
    let left_by_board = |point: &Point3<f64>| {
        let axis = (lamp.center - point).normalize();
        let right = axis.cross(&Vector3::y()).normalize();
        let up = axis.cross(&right);
        let steps = || (-15..=15).map(|step| f64::from(step) / 15.5);
        let (mut seen, mut count) = (0.0, 0.0);
        for (x, y) in steps().flat_map(|x| steps().map(move |y| (x, y))) {
            if x * x + y * y <= 1.0 {
                let towards = lamp.center + (right * x + up * y) * lamp.radius - point;
                let through = point + towards * (BOARD_M / towards.z);
                let hidden = through.x.abs() < 0.15 && through.y.abs() < 0.15;
                seen += f64::from(!hidden);
                count += 1.0;
            }
        }
        seen / count
    };
    let (mut soft, mut wrong) = (0, 0.0);
    for row in 0..camera().height {
        for column in 0..camera().width {
            let at = row * camera().width + column;
            let (ray, _) = camera_ray(&camera(), &pose, column as f64, row as f64);
            let over_board = ray.at((BOARD_M - ray.origin.z) / ray.direction.z);
            // The board itself, and what is mixed with it at its rim.
            if over_board.x.abs().max(over_board.y.abs()) < 0.17 {
                continue;
            }
            let point = ray.at(-ray.origin.z / ray.direction.z);
            let share = f64::from((some[at] - none[at]) / (all[at] - none[at]));
            let expected = left_by_board(&point);
            if (0.1..0.9).contains(&expected) {
                soft += 1;
                wrong += (share - expected).abs();
            }
        }
    }
    assert!(soft > 1000, "the edge is wide: {soft} pixels");
    // Neighbouring pixels share light: single ones may be off by more.
    let wrong = wrong / f64::from(soft);
    assert!(wrong < 0.1, "off by {wrong} of the lamp on average");
}
