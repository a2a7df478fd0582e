"""What a fleet tool sees over HTTP."""

import io
import json
import re

import numpy as np
import pytest
import scene
from PIL import Image as Picture


def picture(daemon, path) -> np.ndarray:
    status, content_type, body = daemon.fetch(path)
    assert (status, content_type) == (200, "image/png"), body
    return np.asarray(Picture.open(io.BytesIO(body)))


def test_health_and_readiness(daemon):
    assert daemon.fetch("/healthz")[0] == 200
    assert daemon.fetch("/readyz")[0] == 200


def test_the_status_page_is_one_document_without_outside_parts(daemon):
    status, content_type, body = daemon.fetch("/")
    assert status == 200 and content_type.startswith("text/html")
    assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", body.decode())


def test_the_api_description_lists_every_endpoint(daemon):
    paths = daemon.fetch_json("/openapi.json")["paths"]
    for path in (
        "/healthz",
        "/readyz",
        "/metrics",
        "/events",
        "/api/v1/info",
        "/api/v1/places",
        "/api/v1/places/{place}",
        "/api/v1/places/{place}/views",
        "/api/v1/places/{place}/prior",
    ):
        assert path in paths, f"{path} is not among {list(paths)}"


def test_metrics_are_openmetrics(daemon, settled):
    status, content_type, body = daemon.fetch("/metrics")
    assert status == 200 and content_type.startswith("application/openmetrics-text; version=1.0.0")
    text = body.decode()
    assert text.endswith("# EOF\n")
    processed = [
        line for line in text.splitlines() if settled.place in line and "processed" in line and not line.startswith("#")
    ]
    assert len(processed) == 1 and float(processed[0].split()[-1]) == 8, text


def test_places_robots_and_views(daemon, place, settled):
    assert place in json.dumps(daemon.fetch_json("/api/v1/places"))
    assert settled.robot in json.dumps(daemon.fetch_json(f"/api/v1/places/{place}"))
    views = daemon.fetch_json(f"/api/v1/places/{place}/views")
    views = views["views"] if isinstance(views, dict) else views
    assert views
    robot = daemon.fetch_json(f"/api/v1/places/{place}/robots/{settled.robot}/{settled.camera}")
    assert str(settled.sequence) in json.dumps(robot)


def test_info_tells_the_version(daemon):
    assert re.search(r"\d+\.\d+\.\d+", json.dumps(daemon.fetch_json("/api/v1/info")))


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


def test_the_prior_over_http(daemon, place, settled):
    body = {
        "worldFromCamera": {"position": {"z": 1.0}, "orientation": {"w": 1.0}},
        "intrinsics": {
            "width": scene.WIDTH,
            "height": scene.HEIGHT,
            "fx": scene.FOCAL,
            "fy": scene.FOCAL,
            "cx": (scene.WIDTH - 1) / 2,
            "cy": (scene.HEIGHT - 1) / 2,
        },
    }
    status, content_type, reply = daemon.fetch(f"/api/v1/places/{place}/prior", body)
    assert status == 200 and content_type.startswith(("application/json", "image/png")), reply
    if content_type.startswith("application/json"):
        assert json.loads(reply)["covered"] > 0.9
    status, content_type, reply = daemon.fetch(f"/api/v1/places/{place}/prior", {"intrinsics": {"fx": -1}})
    assert 400 <= status < 500 and content_type.startswith("application/problem+json"), reply
    assert json.loads(reply)["detail"]


@pytest.mark.parametrize(
    "path", ["/nothing", "/api/v1/places/nowhere", "/api/v1/places/nowhere/robots/no/body/frame.png"]
)
def test_what_is_not_there_is_a_problem_document(daemon, path):
    status, content_type, body = daemon.fetch(path)
    assert status == 404 and content_type.startswith("application/problem+json")
    assert json.loads(body)["status"] == 404
