"""Who may come in over HTTP: safe unless told otherwise, and no secret in the log."""

import http.client
import json
import subprocess
import urllib.parse

import pytest
from daemon import BINARY, DEADLINE_S, Daemon, free_port
from sse import Stream

TOKEN = "correct-horse-battery-staple"
GUARDED = ["/metrics", "/events", "/api/v1/info", "/api/v1/places", "/api/v1/places/x", "/api/v1/places/x/events"]


@pytest.fixture(scope="module")
def token_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("secrets") / "token"
    file.write_text(TOKEN + "\n")
    return file


@pytest.fixture(scope="module")
def guarded(binary, token_file):
    daemon = Daemon("--http-token-file", str(token_file))
    yield daemon
    daemon.end()


def request(daemon, method, path, headers=None, body=None):
    """Status, headers, body."""
    address = urllib.parse.urlsplit(daemon.http)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=DEADLINE_S)
    connection.request(method, path, body, headers or {})
    response = connection.getresponse()
    # A stream has no end.
    text = b"" if response.headers.get("Content-Type", "").startswith("text/event-stream") else response.read()
    connection.close()
    return response.status, response.headers, text


def serve(*arguments):
    return subprocess.run(
        [BINARY, "serve", "-l", "tcp/127.0.0.1:0", *arguments],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=DEADLINE_S,
    )  # fmt: skip


@pytest.mark.parametrize("address", ["0.0.0.0", "[::]"])
def test_an_address_that_others_reach_is_refused_without_a_token(binary, address):
    done = serve("--http", f"{address}:{free_port()}")
    assert done.returncode == 64
    assert "--http-token-file" in done.stderr and "--http-no-token" in done.stderr


@pytest.mark.parametrize("content", ["short", "two words that are long", "", "caf\u00e9-caf\u00e9-caf\u00e9-caf\u00e9"])
def test_a_token_that_is_none_is_refused_and_not_shown(binary, tmp_path, content):
    file = tmp_path / "token"
    file.write_text(content)
    done = serve("--http", f"127.0.0.1:{free_port()}", "--http-token-file", str(file))
    assert done.returncode == 64 and str(file) in done.stderr
    assert not content or content not in done.stderr


def test_a_token_file_that_is_not_there_is_named(binary, tmp_path):
    done = serve("--http-token-file", str(tmp_path / "nowhere"))
    assert done.returncode == 64 and "nowhere" in done.stderr


@pytest.mark.parametrize("path", GUARDED)
def test_without_the_token_there_is_nothing(guarded, path):
    for headers in ({}, {"Authorization": f"Bearer {TOKEN}x"}, {"Authorization": f"Basic {TOKEN}"},
                    {"Authorization": "Bearer"}, {"Cookie": f"surprised_session={TOKEN}"}):  # fmt: skip
        status, answer, body = request(guarded, "GET", path, headers)
        assert status == 401 and answer["WWW-Authenticate"] == "Bearer"
        assert answer["Content-Type"] == "application/problem+json" and json.loads(body)["code"] == "unauthorized"


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/openapi.json", "/api/v1/session"])
def test_what_tells_nothing_needs_no_token(guarded, path):
    assert request(guarded, "GET", path)[0] == 200


def test_with_the_token_everything_is_there(guarded):
    for path in GUARDED:
        status = request(guarded, "GET", path, {"Authorization": f"Bearer {TOKEN}"})[0]
        assert status == (404 if path.startswith("/api/v1/places/") else 200), path


def test_a_browser_signs_in_once_and_watches_with_its_cookie(guarded):
    wrong = json.dumps({"token": "something else entirely"})
    kind = {"Content-Type": "application/json"}
    assert request(guarded, "POST", "/api/v1/session", kind, wrong)[0] == 401
    status, headers, _ = request(guarded, "POST", "/api/v1/session", kind, json.dumps({"token": TOKEN}))
    assert status == 204
    pair, *attributes = headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= set(attributes)
    assert TOKEN not in pair
    cookie = {"Cookie": f"other=1; {pair}"}
    assert json.loads(request(guarded, "GET", "/api/v1/session", cookie)[2]) == {"required": True, "signed_in": True}
    assert request(guarded, "GET", "/api/v1/places", cookie)[0] == 200
    with Stream(guarded, headers=cookie) as stream:
        stream.next("hello")
    status, headers, _ = request(guarded, "DELETE", "/api/v1/session", cookie)
    assert status == 204 and headers["Set-Cookie"].startswith("surprised_session=;") and "Max-Age=0" in headers["Set-Cookie"]


def test_the_log_has_no_secret(binary, token_file, monkeypatch):
    monkeypatch.setenv("RUST_LOG", "trace")
    daemon = Daemon("--http-token-file", str(token_file))
    try:
        for headers in ({"Authorization": f"Bearer {TOKEN}"}, {"Authorization": "Bearer nearly-the-token-but-not"}):
            request(daemon, "GET", "/api/v1/info", headers)
        body = json.dumps({"token": TOKEN})
        cookie = request(daemon, "POST", "/api/v1/session", {"Content-Type": "application/json"}, body)[1]["Set-Cookie"]
        request(daemon, "GET", "/api/v1/info", {"Cookie": cookie.split(";")[0]})
        info = request(daemon, "GET", "/api/v1/info", {"Authorization": f"Bearer {TOKEN}"})[2].decode()
        daemon.stop()
        log = daemon.log()
        assert len(log) > 1000, "everything was logged"
        for secret in (TOKEN, "nearly-the-token", cookie.split(";")[0].partition("=")[2]):
            assert secret not in log and secret not in info
    finally:
        daemon.end()


def test_without_a_token_names_that_were_made_to_lead_here_are_refused(daemon):
    for host in ("evil.example", "evil.example:8080", "localhost.evil.example"):
        status, headers, body = request(daemon, "GET", "/api/v1/places", {"Host": host})
        assert status == 403 and json.loads(body)["code"] == "host"
    for host in ("localhost:8080", "127.0.0.1", "[::1]:80"):
        assert request(daemon, "GET", "/api/v1/places", {"Host": host})[0] == 200


@pytest.mark.parametrize("path", ["/healthz", "/api/v1/places", "/nothing", "/metrics"])
def test_a_browser_is_told_to_do_no_more_than_is_needed(daemon, path):
    headers = request(daemon, "GET", path)[1]
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy and "frame-ancestors 'none'" in policy
    assert headers["X-Content-Type-Options"] == "nosniff" and headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cache-Control"] == "no-store"
    assert "Access-Control-Allow-Origin" not in headers


def test_errors_of_every_layer_are_problem_documents(daemon):
    json_kind = {"Content-Type": "application/json"}
    for method, path, headers, body, expected in [
        ("PUT", "/api/v1/places", {}, b"", 405),
        ("POST", "/api/v1/session", json_kind, b"{", 400),
        ("POST", "/api/v1/session", json_kind, b"{}", 400),
        ("POST", "/api/v1/session", {}, b"{}", 415),
        ("POST", "/api/v1/session", json_kind, b"x" * ((1 << 20) + 9), 413),
        ("GET", "/api/v1/places/%FF", {}, None, 400),
        ("GET", "/api/v1/places/x/events?limit=none", {}, None, 400),
    ]:
        status, answer, text = request(daemon, method, path, headers, body)
        assert status == expected and answer["Content-Type"] == "application/problem+json", (method, path, status, text)
        assert json.loads(text)["status"] == expected
