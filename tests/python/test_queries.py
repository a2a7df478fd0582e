"""What the memory answers over Zenoh."""

import io
import json
import subprocess

import numpy as np
import scene
from daemon import BINARY, DEADLINE_S, ask, prior_request, refusal, remembered
from PIL import Image as Picture
from surprised_proto import EvaluateReply, EvaluateRequest, PriorReply, ViewsReply

PIXELS = scene.WIDTH * scene.HEIGHT


def prior(session, place, *planes):
    return PriorReply.FromString(
        ask(session, f"surprised/{place}/@memory/prior", prior_request(*planes)).payload.to_bytes()
    )


def test_the_prior_has_every_plane_that_was_asked_for(session, place, settled):
    reply = prior(session, place, "expected", "uncertainty", "coverage", "depth", "parameters")

    expected = np.asarray(Picture.open(io.BytesIO(reply.expected.data)))
    assert expected.shape == (scene.HEIGHT, scene.WIDTH, 3)
    coverage = np.frombuffer(reply.coverage.data, np.uint8).reshape(scene.HEIGHT, scene.WIDTH)
    seen = coverage > 0
    assert reply.covered == np.float32(seen.mean()) and seen.mean() > 0.9
    # The middle of each patch of wallpaper; edges may be blurred by refinement.
    rows, columns = np.mgrid[4 : scene.HEIGHT : 8, 4 : scene.WIDTH : 8]
    inner = seen[rows, columns]
    assert inner.mean() > 0.9
    assert np.abs(expected[rows, columns].astype(int) - scene.wall()[rows, columns])[inner].max() <= 4

    uncertainty = np.frombuffer(reply.uncertainty.data, "<f4").reshape(coverage.shape)
    assert (uncertainty[seen] > 0).all()
    depth_m = np.frombuffer(reply.depth.data, "<f4").reshape(coverage.shape)
    assert np.abs(depth_m[seen] - 2.0).max() < 0.01

    # alpha, beta*3, tau*3, sigma*3.
    planes = np.frombuffer(reply.parameters, "<f4").reshape(10, scene.HEIGHT, scene.WIDTH)
    alpha, beta, tau = planes[0], planes[1:4], planes[4:7]
    assert ((alpha[seen] >= 1.0) & (alpha[seen] <= 2.51)).all()
    np.testing.assert_allclose((beta / alpha).sum(axis=0)[seen], uncertainty[seen], rtol=1e-4)
    luma = scene.wall() @ np.array([0.299, 0.587, 0.114])
    assert np.abs(tau[0][rows, columns] - luma[rows, columns])[inner].max() <= 4


def test_the_prior_says_expected_and_coverage_when_no_plane_is_named(session, place, settled):
    reply = prior(session, place)
    assert reply.expected.data and reply.coverage.data
    assert not (reply.uncertainty.data or reply.depth.data or reply.parameters)


def test_asking_changes_nothing(session, place, settled):
    before = remembered(session, place)
    for _ in range(3):
        prior(session, place, "parameters")
    assert remembered(session, place) == before


def selector(place, **parameters):
    return f"surprised/{place}/@memory/prior?" + ";".join(f"{name}={value}" for name, value in parameters.items())


POSE = dict(x=0, y=0, z=1, qx=0, qy=0, qz=0, qw=1)
LENS = dict(
    width=scene.WIDTH,
    height=scene.HEIGHT,
    fx=scene.FOCAL,
    fy=scene.FOCAL,
    cx=(scene.WIDTH - 1) / 2,
    cy=(scene.HEIGHT - 1) / 2,
)


def test_selector_parameters_do_where_there_is_no_protobuf(session, place, settled):
    reply = PriorReply.FromString(ask(session, selector(place, **POSE, **LENS)).payload.to_bytes())
    assert reply == prior(session, place)


def test_a_plain_get_can_have_json(session, place, settled):
    sample = ask(session, selector(place, **POSE, **LENS, planes="coverage", format="json"))
    assert str(sample.encoding).startswith("application/json")
    reply = json.loads(sample.payload.to_string())
    assert reply["covered"] > 0.9 and reply["coverage"]["encoding"] == "mono8"
    views = json.loads(ask(session, f"surprised/{place}/@memory/views?format=json").payload.to_string())["views"]
    assert [int(view["id"]) for view in views] == [view for view, _ in remembered(session, place)[0]]


def test_a_bad_request_is_refused_with_a_sentence(session, place, settled):
    request = prior_request("expected")
    request.intrinsics.fx = -1
    assert "focal" in refusal(session, f"surprised/{place}/@memory/prior", request)
    request = prior_request("taste")
    assert "plane is unknown" in refusal(session, f"surprised/{place}/@memory/prior", request)
    request = prior_request()
    request.intrinsics.width = request.intrinsics.height = 100_000
    assert "100000" in refusal(session, f"surprised/{place}/@memory/prior", request)


def test_evaluate_tells_how_surprising_a_frame_would_be_and_learns_nothing(session, place, settled):
    before = remembered(session, place)
    request = EvaluateRequest(frame=settled.next_frame(scene.BOX))
    reply = EvaluateReply.FromString(
        ask(session, f"surprised/{place}/@memory/evaluate", request).payload.to_bytes()
    )
    assert any(scene.overlap(scene.corners(region.box), scene.BOX) >= 0.6 for region in reply.report.regions)
    assert not reply.report.learned
    nats = np.frombuffer(reply.map.data, "<f4").reshape(scene.HEIGHT, scene.WIDTH)
    x_min, y_min, x_max, y_max = scene.BOX
    assert nats[y_min + 8 : y_max - 8, x_min + 8 : x_max - 8].mean() > 6
    assert remembered(session, place) == before


def test_views_names_every_viewpoint(session, place, settled):
    views = ViewsReply.FromString(ask(session, f"surprised/{place}/@memory/views").payload.to_bytes()).views
    assert views and all((view.robot, view.camera) == (settled.robot, settled.camera) for view in views)
    assert sum(view.updates for view in views) == 8
    assert all(abs(view.world_from_camera.position.z - 1) < 0.01 for view in views)


def test_status_answers(session, place, settled):
    status = json.loads(ask(session, f"surprised/{place}/@memory/status").payload.to_string())
    assert (status["place"], status["frames"], status["refused"]) == (place, 8, 0)


def test_a_place_nobody_has_seen_is_unknown(session, daemon):
    assert "unknown_place" in refusal(session, "surprised/nowhere/@memory/views")


def test_the_command_line_asks_for_a_picture_of_the_prior(daemon, place, settled, tmp_path):
    path = tmp_path / "prior.png"
    done = subprocess.run(
        [BINARY, "query", "prior", "--place", place, "-e", daemon.endpoint, "--out", path]
        + ["--pose", "0,0,0,0,0,0,1", "--intrinsics", "60,60,31.5,23.5,64,48"],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    assert done.returncode == 0, done.stderr
    assert path.read_bytes().startswith(b"\x89PNG")
    wrong = subprocess.run(
        [BINARY, "query", "prior", "--place", "p", "--out", path, "--pose", "0,0", "--intrinsics", "1,1,1,1,64,48"],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    assert wrong.returncode == 2 and "7 numbers" in wrong.stderr
