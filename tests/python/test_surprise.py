"""Frames go in, reports with boxes come out."""

import numpy as np
import pytest
import scene
import zenoh
from daemon import Robot
from surprised_proto import Image, PoseSample, StampedImage, encoding


def test_a_new_object_gets_a_box_around_it(settled):
    report = settled.show(scene.BOX)
    best = max(report.regions, key=lambda region: region.peak_surprise)
    assert scene.overlap(scene.corners(best.box), scene.BOX) >= 0.6
    assert not best.touches_border
    # Between the wall and the camera at z = 1, near the optical axis.
    assert 2.85 < best.center_in_world.z < 3.05 and abs(best.center_in_world.x) < 0.2


def test_what_is_seen_again_is_no_longer_surprising(settled):
    assert settled.show(scene.BOX).regions
    for _ in range(15):
        report = settled.show(scene.BOX)
    assert not report.regions


def test_a_place_never_seen_is_unknown_and_not_surprising(robot):
    report = robot.show(scene.BOX)
    assert report.coverage == 0 and not report.regions and report.max_surprise == 0
    assert report.learned and report.viewpoint_id in {0, 1}


def test_a_report_names_its_frame(robot):
    message = robot.next_frame()
    robot.put(message)
    report = robot.expect_report(message)
    assert report.stamp == message.stamp
    assert (report.place, report.robot, report.camera) == (robot.place, robot.robot, robot.camera)
    assert (report.width, report.height) == (scene.WIDTH, scene.HEIGHT)
    assert report.processing_seconds > 0


def test_a_robot_is_surprised_by_what_differs_from_what_another_saw(session, place, settled):
    other = Robot(session, place, "robot2", "rear")
    report = other.show(scene.BOX)
    assert report.coverage > 0.9
    assert any(scene.overlap(scene.corners(region.box), scene.BOX) >= 0.6 for region in report.regions)


def test_places_do_not_know_each_other(session, place, settled):
    report = Robot(session, place + "x").show()
    assert report.coverage == 0


@pytest.mark.parametrize(
    "encode",
    [
        pytest.param(
            lambda rgb, depth_m: (
                Image(encoding="bgr8", width=scene.WIDTH, height=scene.HEIGHT, data=rgb[..., ::-1].tobytes()),
                Image(
                    encoding="16UC1",
                    width=scene.WIDTH,
                    height=scene.HEIGHT,
                    data=(depth_m * 1000).round().astype("<u2").tobytes(),
                ),
            ),
            id="bgr8 and 16UC1",
        ),
        pytest.param(
            lambda rgb, depth_m: (
                Image(encoding="jpeg", data=scene.picture_file(rgb, "jpeg")),
                Image(encoding="png", data=scene.picture_file((depth_m * 1000).round().astype(np.uint16), "png")),
            ),
            id="jpeg and png",
        ),
        pytest.param(
            lambda rgb, depth_m: (
                Image(encoding="png", data=scene.picture_file(rgb, "png")),
                Image(
                    encoding="32FC1",
                    width=scene.WIDTH,
                    height=scene.HEIGHT,
                    step=4 * scene.WIDTH + 12,
                    data=np.pad(depth_m, ((0, 0), (0, 3))).tobytes(),
                ),
            ),
            id="png and padded 32FC1",
        ),
    ],
)
def test_the_same_picture_in_another_encoding_is_the_same_picture(settled, encode):
    message = settled.next_frame()
    image, depth = encode(*scene.look())
    message.image.CopyFrom(image)
    message.depth.CopyFrom(depth)
    settled.put(message)
    report = settled.expect_report(message)
    assert not report.regions and report.coverage > 0.9


def test_maps_come_while_someone_subscribes(session, settled):
    maps = {
        name: session.declare_subscriber(f"{settled.key}/surprise/{name}")
        for name in ("map", "blocks", "expected", "uncertainty", "coverage")
    }
    # Declarations take a moment to reach the service: frames are shown until each map has come.
    received: dict[str, StampedImage] = {}
    for _ in range(50):
        report = settled.show()
        for name, subscriber in maps.items():
            while (sample := subscriber.try_recv()) is not None:
                received[name] = StampedImage.FromString(sample.payload.to_bytes())
        if len(received) == len(maps):
            break
    assert set(received) == set(maps)
    assert all(0 < image.sequence <= report.sequence for image in received.values())
    pixels = scene.WIDTH * scene.HEIGHT
    assert received["map"].image.encoding == received["uncertainty"].image.encoding == "32FC1"
    assert len(received["map"].image.data) == len(received["uncertainty"].image.data) == 4 * pixels
    assert len(received["blocks"].image.data) == 4 * pixels // 16
    assert received["coverage"].image.encoding == "mono8" and len(received["coverage"].image.data) == pixels
    assert received["expected"].image.data.startswith(b"\x89PNG")


def test_a_frame_without_a_pose_gets_the_one_between_the_samples_around_it(session, settled):
    message = settled.next_frame(scene.BOX)
    message.ClearField("world_from_camera")
    for offset_ns, x in ((-50_000_000, -0.001), (50_000_000, 0.001)):
        sample = PoseSample()
        sample.stamp.FromNanoseconds(settled.stamp_ns + offset_ns)
        sample.world_from_camera.position.x = x
        sample.world_from_camera.position.z = 1.0
        sample.world_from_camera.orientation.w = 1.0
        session.put(
            f"{settled.key}/pose",
            sample.SerializeToString(),
            encoding=encoding(PoseSample),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
    settled.put(message)
    report = settled.expect_report(message)
    assert abs(report.world_from_camera.position.x) < 5e-4
    assert any(scene.overlap(scene.corners(region.box), scene.BOX) >= 0.6 for region in report.regions)
