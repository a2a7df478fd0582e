"""Simulated robots are on the network like real ones: frames, calibration and a token, and the truth beside them."""

import json
import re
import subprocess
import threading
from collections import defaultdict

import pytest
import zenoh
from daemon import BINARY, await_condition
from surprised_proto import Frame

ROBOTS, FRAMES = 2, 3


class Seen:
    """Everything that is published in a place."""

    def __init__(self, session: zenoh.Session, place: str):
        self._lock = threading.Lock()
        self.samples = defaultdict(list)
        self.tokens = set()
        self._subscribers = [
            session.declare_subscriber(f"surprised/{place}/*/*/*", self._take),
            session.liveliness().declare_subscriber(f"surprised/{place}/@live/robot/**", self._note, history=True),
        ]

    def _take(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self.samples[str(sample.key_expr)].append(sample.payload.to_bytes())

    def _note(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self.tokens.add((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

    def of(self, key: str) -> list[bytes]:
        with self._lock:
            return list(self.samples[key])


def simulate(daemon, place: str, *more: str) -> dict:
    """Its last line."""
    command = [BINARY, "simulate", "-e", daemon.endpoint, "--place", place, "--robots", str(ROBOTS)]
    done = subprocess.run(
        [*command, "--frames", str(FRAMES), *more, "--json"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("sensors", ["three cameras", "depth camera"])
def test_every_robot_sends_what_it_sees_and_where_it_is(daemon, session, place, sensors):
    depth = sensors == "depth camera"
    seen = Seen(session, place)
    summary = simulate(daemon, place, "--lockstep", *(["--depth"] if depth else []))
    assert summary["frames"] == summary["reports"] + summary["refused"] == ROBOTS * FRAMES

    for robot in range(ROBOTS):
        camera = f"surprised/{place}/robot{robot}/front"
        await_condition("all frames have come", lambda key=camera: len(seen.of(f"{key}/frame")) == FRAMES)
        frames = [Frame.FromString(payload) for payload in seen.of(f"{camera}/frame")]
        assert [frame.sequence for frame in frames] == list(range(FRAMES))
        for frame in frames:
            assert frame.image.encoding == "jpeg" and frame.image.data[:2] == b"\xff\xd8"
            lens = frame.calibration.middle
            assert (lens.width, lens.height) == (320, 240) and lens.fx > 0
            assert frame.HasField("depth") == frame.HasField("world_from_camera") == depth
            assert frame.HasField("left") == frame.HasField("right") == frame.HasField("markers") == (not depth)
            if not depth:
                assert (frame.left.width, frame.right.height) == (320, 240)
                assert len(frame.markers.markers) == len(frame.calibration.marker_in_plate) == 4

        # The side key gives way where the network is busy.
        await_condition("a truth has come", lambda key=camera: seen.of(f"{key}/truth"))
        truths = [json.loads(payload) for payload in seen.of(f"{camera}/truth")]
        assert {truth["sequence"] for truth in truths} <= set(range(FRAMES))
        assert len({tuple(truth["world_from_camera"]["position"]) for truth in truths}) == len(truths)

        token = f"surprised/{place}/@live/robot/robot{robot}/front"
        for there in (True, False):
            await_condition(f"the token is there: {there}", lambda sign=(token, there): sign in seen.tokens)


def test_without_a_service_nothing_is_sent_and_the_error_says_so(daemon):
    done = subprocess.run(
        [BINARY, "simulate", "-e", daemon.endpoint, "--root", "elsewhere", "--frames", "1"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    # Which of the two says it first is chance.
    assert re.search(r"nobody takes frames at elsewhere/kitchen/robot[01]/front/frame", done.stderr), done.stderr
