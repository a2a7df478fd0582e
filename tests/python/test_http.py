"""What a fleet tool sees over HTTP."""

import io
import json
import re

import numpy as np
import pytest
import scene
from daemon import await_condition
from PIL import Image as Picture


def picture(daemon, path) -> np.ndarray:
    status, content_type, body = daemon.fetch(path)
    assert (status, content_type) == (200, "image/png"), body
    return np.asarray(Picture.open(io.BytesIO(body)))


def test_health_and_readiness(daemon):
    assert daemon.fetch("/healthz")[0] == 200
    assert daemon.fetch("/readyz")[0] == 200


def test_places_robots_and_views(daemon, place, settled):
    assert place in daemon.fetch_json("/api/v1/places")["places"]
    # The status follows the report.
    await_condition("the last frame is counted", lambda: daemon.fetch_json(f"/api/v1/places/{place}")["frames"] == 8)
    status = daemon.fetch_json(f"/api/v1/places/{place}")
    assert status["refused"] == 0
    views = daemon.fetch_json(f"/api/v1/places/{place}/views")["views"]
    assert len(views) == status["viewpoints"] and views[0]["robot"] == settled.robot
    camera = daemon.fetch_json(f"/api/v1/places/{place}/robots/{settled.robot}/{settled.camera}")
    assert camera["status"]["last_sequence"] == settled.sequence
    assert camera["report"]["coverage"] > 0.9


def test_info_tells_the_version_and_every_setting(daemon):
    info = daemon.fetch_json("/api/v1/info")
    assert re.fullmatch(r"\d+\.\d+\.\d+", info["version"])
    assert info["settings"]["views"] == 7


def test_the_service_tells_the_endpoint_that_robots_connect_to(daemon):
    assert daemon.endpoint in daemon.fetch_json("/api/v1/info")["zenoh"]["locators"]


def test_pictures_of_the_last_frame(daemon, place, settled):
    settled.show(scene.BOX)
    base = f"/api/v1/places/{place}/robots/{settled.robot}/{settled.camera}"
    rgb, _ = scene.look(scene.BOX)
    assert (picture(daemon, f"{base}/frame.png")[..., :3] == rgb).all()
    for name in ("expected", "surprise", "uncertainty"):
        assert picture(daemon, f"{base}/{name}.png").shape[:2] == (scene.HEIGHT, scene.WIDTH)
    # The expected image has no box in it yet.
    x_min, y_min, x_max, y_max = scene.BOX
    inside = picture(daemon, f"{base}/expected.png")[y_min + 4 : y_max - 4, x_min + 4 : x_max - 4, :3].astype(int)
    assert np.median(np.abs(inside - scene.wall()[y_min + 4 : y_max - 4, x_min + 4 : x_max - 4])) < 8


@pytest.mark.parametrize(
    "path", ["/nothing", "/api/v1/places/nowhere", "/api/v1/places/nowhere/robots/no/body/frame.png"]
)
def test_what_is_not_there_is_a_problem_document(daemon, path):
    status, content_type, body = daemon.fetch(path)
    assert status == 404 and content_type.startswith("application/problem+json")
    assert json.loads(body)["status"] == 404
