"""The description of the HTTP interface is one, is whole, and is kept, whatever is asked."""

import subprocess
import sys
from pathlib import Path

import pytest
import scene
from openapi_spec_validator import validate

PATHS = {
    "/healthz", "/readyz", "/metrics", "/events", "/api/v1/session", "/api/v1/info", "/api/v1/places",
    "/api/v1/places/{place}", "/api/v1/places/{place}/views", "/api/v1/places/{place}/events",
    "/api/v1/places/{place}/events/{event}", "/api/v1/places/{place}/events/{event}/{picture}",
    "/api/v1/places/{place}/timeline", "/api/v1/places/{place}/robots/{robot}/{camera}",
    "/api/v1/places/{place}/robots/{robot}/{camera}/{picture}",
}  # fmt: skip
CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"


@pytest.fixture
def description(daemon):
    return daemon.fetch_json("/openapi.json")


def test_it_is_valid(description):
    validate(description)


def test_it_has_every_path_and_every_error_is_a_problem(description):
    assert set(description["paths"]) >= PATHS
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            for status, response in operation["responses"].items():
                if status[0] in "45":
                    assert set(response["content"]) == {"application/problem+json"}, (path, method, status)


def test_messages_are_described_as_the_contract_has_them(description):
    event = description["components"]["schemas"]["Event"]
    assert event["properties"]["id"]["type"] == "string"
    assert event["properties"]["peak"]["properties"]["box"]["properties"]["x_min"]["type"] == "integer"


def test_whatever_is_asked_the_answer_is_as_described(daemon, place, settled, tmp_path):
    for _ in range(3):
        settled.show(scene.BOX)
    event = daemon.fetch_json(f"/api/v1/places/{place}/events")["events"][0]["id"]
    # Names that are there, so that not everything is unknown.
    settings = tmp_path / "schemathesis.toml"
    settings.write_text(
        f'[parameters]\n"path.place" = "{place}"\n"path.event" = "{event}"\n'
        f'"path.robot" = "{settled.robot}"\n"path.camera" = "{settled.camera}"\n'
    )
    tool = Path(sys.executable).with_name("schemathesis")
    for parameters in (["--config-file", str(settings)], []):
        done = subprocess.run(
            [
                tool, *parameters, "run", f"{daemon.http}/openapi.json", "--checks", CHECKS,
                "--exclude-path", "/events", "--max-examples", "15", "--seed", "1", "--phases", "coverage,fuzzing",
                "--no-color", "--request-timeout", "20",
            ],
            cwd=tmp_path, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert daemon.fetch("/readyz")[0] == 200
