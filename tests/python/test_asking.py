"""Modes, forgetting and next views, from the official Python client and the command line."""

import json
import subprocess

import scene
from daemon import BINARY, DEADLINE_S, ask, refusal, remembered
from surprised_proto import ForgetReply, ForgetRequest, Mode, NextViewReply, NextViewRequest, Sphere, encoding


def query(daemon, *arguments) -> subprocess.CompletedProcess:
    return subprocess.run(
        [BINARY, "query", *arguments, "-e", daemon.endpoint], capture_output=True, text=True, timeout=DEADLINE_S
    )


def told(daemon, *arguments):
    done = query(daemon, *arguments)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_frozen_robot_reports_and_is_never_got_used_to(session, place, settled):
    before = remembered(session, place)
    session.put(f"{settled.key}/mode", Mode(mode="freeze").SerializeToString(), encoding=encoding(Mode))
    for _ in range(40):
        report = settled.show(scene.BOX)
        assert report.regions and not report.learned
    assert remembered(session, place) == before
    assert Mode.FromString(ask(session, f"{settled.key}/mode").payload.to_bytes()).mode == "freeze"


def test_the_command_line_switches_a_camera_and_a_place(daemon, place, settled):
    camera = ["--robot", settled.robot, "--camera", settled.camera]
    assert told(daemon, "mode", "--place", place, *camera) == {"mode": "learn"}
    assert told(daemon, "mode", "--place", place, *camera, "--set", "observe") == {"mode": "observe"}
    assert not settled.show().learned
    assert told(daemon, "mode", "--place", place, "--set", "learn") == {"mode": "learn"}
    assert settled.show().learned
    assert query(daemon, "mode", "--place", place, "--set", "sleep").returncode == 2


def test_a_forgotten_corner_is_unknown(session, place, settled):
    # The wall is at z = 3; its upper left quarter lies at negative x and y.
    request = ForgetRequest(sphere=Sphere(radius=0.4))
    request.sphere.center.x, request.sphere.center.y, request.sphere.center.z = -0.5, -0.4, 3.0
    reply = ForgetReply.FromString(ask(session, f"surprised/{place}/@memory/forget", request).payload.to_bytes())
    assert reply.viewpoints_removed == 0 and reply.viewpoints_changed > 0
    assert reply.pixels > 1000 * reply.viewpoints_changed
    assert settled.show().coverage < 0.92
    assert "nothing to forget is named" in refusal(session, f"surprised/{place}/@memory/forget")


def test_the_command_line_forgets_a_place(daemon, place, settled):
    reply = told(daemon, "forget", "--place", place, "--everything")
    assert int(reply["viewpoints_removed"]) > 0 and int(reply["viewpoints_left"]) == 0
    assert settled.show().coverage == 0
    assert query(daemon, "forget", "--place", place).returncode == 1


def test_next_view_ranks_candidates_and_the_command_line_a_ring(daemon, session, place, settled):
    request = NextViewRequest()
    lens = settled.next_frame().calibration.middle
    request.intrinsics.CopyFrom(lens)
    for x in (0.0, 0.4, 50.0):
        pose = request.candidates.add()
        pose.position.x, pose.position.z, pose.orientation.w = x, 1.0, 1.0
    reply = ask(session, f"surprised/{place}/@memory/next_view", request)
    views = NextViewReply.FromString(reply.payload.to_bytes()).views
    assert [view.index for view in views] == [2, 1, 0]
    assert views[0].covered == 0 and views[2].covered > 0.9
    ring = told(
        daemon, "next-view", "--place", place, "--robot", settled.robot, "--camera", settled.camera, "--count", "4"
    )
    assert len(ring["views"]) == 4 and ring["views"][3]["index"] == 0, "straight ahead teaches least"


def test_the_command_line_evaluates_a_picture(daemon, place, settled, tmp_path):
    rgb, depth_m = scene.look(scene.BOX)
    (tmp_path / "image.png").write_bytes(scene.picture_file(rgb, "png"))
    (tmp_path / "depth.png").write_bytes(scene.picture_file((depth_m * 1000).astype("uint16"), "png"))
    lens = settled.next_frame().calibration.middle
    report = told(
        daemon, "evaluate", "--place", place, "--image", tmp_path / "image.png", "--depth", tmp_path / "depth.png",
        "--pose", "0,0,1,0,0,0,1",
        "--intrinsics", f"{lens.fx},{lens.fy},{lens.cx},{lens.cy},{lens.width},{lens.height}",
    )
    box = report["regions"][0]["box"]
    found = tuple(box.get(name, 0) for name in ("x_min", "y_min", "x_max", "y_max"))
    assert scene.overlap(found, scene.BOX) > 0.6
    assert not report["learned"]
