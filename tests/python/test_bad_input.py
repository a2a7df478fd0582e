"""Every kind of bad frame: refused with a reason, the memory as it was, the service goes on."""

import itertools
import math

import numpy as np
import pytest
import scene
from daemon import Robot, remembered
from surprised_proto import Calibration, Frame, Image, Rejection, encoding


def set_image(**fields):
    def spoil(frame):
        for name, value in fields.items():
            setattr(frame.image, name, value)

    return spoil


def set_position(x):
    def spoil(frame):
        frame.world_from_camera.position.x = x

    return spoil


def set_orientation(w):
    def spoil(frame):
        frame.world_from_camera.orientation.w = w

    return spoil


def set_lens(**fields):
    def spoil(frame):
        for name, value in fields.items():
            setattr(frame.calibration.middle, name, value)

    return spoil


def set_depth(values, encoding="32FC1"):
    def spoil(frame):
        height, width = values.shape
        frame.depth.CopyFrom(Image(encoding=encoding, width=width, height=height, data=values.tobytes()))

    return spoil


def clear(*names):
    def spoil(frame):
        for name in names:
            frame.ClearField(name)

    return spoil


@pytest.fixture
def place():
    """One for all tests here: a service has room for sixteen, and nothing that is refused changes it."""
    return "wall"


@pytest.fixture
def robot(session, place):
    return Robot(session, place, f"robot{next(NUMBERS)}")


@pytest.fixture
def settled(robot):
    """A robot at a place that knows the wall."""
    for _ in range(3):
        assert not robot.show().regions
    return robot


NUMBERS = itertools.count(1)
METRES = np.full((scene.HEIGHT, scene.WIDTH), 2.0, np.float32)

# What is done to a good frame; the code and some words of the sentence that come back.
def two_markers(message):
    message.ClearField("world_from_camera")
    message.calibration.camera_from_plate.position.SetInParent()
    message.calibration.camera_from_plate.orientation.w = 1.0
    for index, (x, y) in enumerate([(0, 0), (0.2, 0), (0.2, -0.1), (0, -0.1)]):
        message.calibration.marker_in_plate.add(x=x, y=y)
        marker = message.markers.markers.add(visible=index < 2)
        marker.position.x, marker.position.y = x, y
    message.markers.stamp.CopyFrom(message.stamp)


BAD = {
    "unknown image encoding": (set_image(encoding="yuv422"), "image_encoding", "yuv422"),
    "bytes that are no jpeg": (set_image(encoding="jpeg", data=b"\xff\xd8 no more"), "image_data", "jpeg"),
    "bytes that are no png": (set_image(encoding="png", data=b"nothing"), "image_data", "png"),
    "half a png": (
        set_image(encoding="png", data=scene.picture_file(scene.wall(), "png")[:700]),
        "image_data",
        "cut short",
    ),
    "fewer bytes than pixels": (set_image(data=b"\0" * 1000), "byte_count", "1000 bytes"),
    "more bytes than pixels": (set_image(data=b"\0" * 99999), "byte_count", "99999 bytes"),
    "rows shorter than pixels": (set_image(step=100), "step", "100 bytes"),
    "no pixels": (set_image(width=0, height=0, data=b""), "side", "0x0"),
    "endless rows": (set_image(width=2**32 - 1, height=2**32 - 1), "side", "4294967295x4294967295"),
    "a jpeg of another size than stated": (
        set_image(encoding="jpeg", width=99, data=scene.picture_file(scene.wall(), "jpeg")),
        "image_size",
        "99x120",
    ),
    "a calibration for another size": (set_lens(width=320, height=240), "image_size", "320x240"),
    "raw image above the limit": (set_image(width=4000, height=3000), "image_too_large", "4000x3000"),
    "a small png that unpacks to more than the limit": (
        set_image(encoding="png", width=0, height=0, data=scene.picture_file(np.zeros((3000, 4000), np.uint8), "png")),
        "image_too_large",
        "4000x3000",
    ),
    "NaN position": (set_position(math.nan), "bad_pose", "finite"),
    "infinite position": (set_position(math.inf), "bad_pose", "finite"),
    "position off the earth": (set_position(1e9), "bad_pose", "metres"),
    "quaternion twice too long": (set_orientation(2.0), "bad_pose", "quaternion"),
    "quaternion all zero": (set_orientation(0.0), "bad_pose", "quaternion"),
    "NaN quaternion": (set_orientation(math.nan), "bad_pose", "quaternion"),
    "half a pose": (lambda frame: frame.world_from_camera.ClearField("orientation"), "bad_pose", "orientation"),
    "focal length zero": (set_lens(fx=0.0), "focal_length", "0 and 150"),
    "focal length negative": (set_lens(fy=-300.0), "focal_length", "-300"),
    "focal length NaN": (set_lens(fx=math.nan), "focal_length", "NaN"),
    "principal point outside": (set_lens(cx=1000.0), "principal_point", "1000"),
    "unknown distortion": (set_lens(distortion_model="fisheye"), "distortion", "fisheye"),
    "negative pose noise": (lambda frame: setattr(frame, "pose_position_sd", -1.0), "pose_noise", "-1"),
    "no stamp": (clear("stamp"), "no_stamp", "capture time"),
    "no image": (clear("image"), "no_image", "image"),
    "no pose": (clear("world_from_camera"), "no_pose", "pose"),
    "two markers of four": (two_markers, "too_few_markers", "marker"),
    "no depth": (clear("depth"), "no_depth", "depth"),
    "depth all zero": (set_depth(METRES * 0), "no_depth", "depth"),
    "depth all NaN": (set_depth(METRES * np.nan), "no_depth", "depth"),
    "depth at another resolution": (set_depth(METRES[::2, ::2]), "depth_size", "register the depth"),
    "depth as a jpeg": (
        lambda frame: frame.depth.CopyFrom(Image(encoding="jpeg", data=scene.picture_file(scene.wall(), "jpeg"))),
        "depth_encoding",
        "16UC1",
    ),
    "metres where millimetres belong": (set_depth(METRES.astype("<u2"), "16UC1"), "depth_unit", "is its unit right?"),
    "millimetres where metres belong": (set_depth(METRES * 1000), "depth_unit", "is its unit right?"),
    "a stamp before the last": (
        lambda frame: frame.stamp.FromNanoseconds(1_000_000_000),
        "stamp_order",
        "order of capture",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_frame_is_refused_with_its_reason_and_changes_nothing(session, place, settled, what):
    spoil, code, words = BAD[what]
    before = remembered(session, place)
    message = settled.next_frame()
    spoil(message)

    settled.put(message)

    rejection = settled.expect_rejection()
    assert rejection.code == code, rejection
    assert words in rejection.detail, rejection
    assert rejection.key == f"{settled.key}/frame"
    assert rejection.sequence == message.sequence
    assert remembered(session, place) == before
    assert settled.show().learned
    assert remembered(session, place) != before


@pytest.mark.parametrize(
    "payload, of, code, words",
    [
        (b"\x0a\xff\xff\xff\xff", encoding(Frame), "undecodable", "surprised.v1.Frame"),
        (b"{}", "application/json", "wrong_encoding", "application/json"),
        (scene.frame(1, 1).SerializeToString(), "", "wrong_encoding", "application/protobuf;surprised.v1.Frame"),
        (scene.frame(1, 1).image.SerializeToString(), encoding(Image), "wrong_encoding", "surprised.v1.Image"),
    ],
    ids=["bytes that are no message", "json", "no encoding", "another message"],
)
def test_a_bad_sample_is_refused_with_its_reason_and_changes_nothing(
    session, place, settled, payload, of, code, words
):
    before = remembered(session, place)

    session.put(f"{settled.key}/frame", payload, encoding=of)

    rejection = settled.expect_rejection()
    assert rejection.code == code and words in rejection.detail, rejection
    assert remembered(session, place) == before
    assert settled.show().learned


def test_a_frame_without_calibration_is_refused_until_one_is_published(session, place, robot):
    message = robot.next_frame()
    calibration = Calibration()
    calibration.CopyFrom(message.calibration)
    message.ClearField("calibration")
    robot.put(message)
    assert robot.expect_rejection().code == "no_calibration"

    session.put(f"{robot.key}/calibration", calibration.SerializeToString(), encoding=encoding(Calibration))
    message = robot.next_frame()
    message.ClearField("calibration")
    robot.put(message)
    assert robot.expect_report(message).learned


def test_one_robots_nonsense_never_touches_anothers_frames(session, place, settled):
    wild = Robot(session, place, "wild")
    wild.show()
    assert settled.show().learned
    before = remembered(session, place)
    for spoil, _, _ in BAD.values():
        message = wild.next_frame()
        spoil(message)
        wild.put(message)
        wild.expect_rejection()
    assert remembered(session, place) == before
    report = settled.show()
    assert report.learned and not report.regions and settled.answers.empty()


def test_a_reset_clock_does_not_lock_a_robot_out(settled):
    settled.stamp_ns -= 3600 * 10**9
    # Some may be refused as going back; then the clock is taken as reset.
    for _ in range(20):
        message = settled.next_frame()
        settled.put(message)
        if not isinstance(settled.answer(), Rejection):
            break
    else:
        raise AssertionError("twenty frames after the clock was set back are all refused")
    assert settled.show().learned


def test_one_stamp_far_in_the_future_does_not_lock_a_robot_out(settled):
    message = settled.next_frame()
    message.stamp.FromNanoseconds(settled.stamp_ns + 10 * 365 * 86400 * 10**9)
    settled.put(message)
    settled.answer()
    for _ in range(20):
        message = settled.next_frame()
        settled.put(message)
        if not isinstance(settled.answer(), Rejection):
            break
    else:
        raise AssertionError("twenty good frames after one wild stamp are all refused")
    assert settled.show().learned


def test_what_was_refused_is_counted_by_reason(daemon, settled):
    for _ in range(3):
        message = settled.next_frame()
        message.ClearField("depth")
        settled.put(message)
        settled.expect_rejection()
    cameras = daemon.fetch_json(f"/api/v1/places/{settled.place}")["cameras"]
    status = next(camera for camera in cameras if camera["robot"] == settled.robot)
    assert status["refused"] == {"no_depth": 3}
    assert "depth" in status["last_refusal"]
