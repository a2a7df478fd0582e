"""The release binary as a child process, and robots that talk to it with the official Python client."""

import contextlib
import json
import os
import queue
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

import zenoh

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "examples" / "python"))

import scene  # noqa: E402
from surprised_proto import (  # noqa: E402
    Frame,
    PriorReply,
    PriorRequest,
    Rejection,
    SurpriseReport,
    ViewsReply,
    encoding,
)

BINARY = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release" / "surprised"
# Far beyond what anything here takes, also on a busy machine.
DEADLINE_S = 30.0


def free_port() -> int:
    """One that the system gives to nobody who asks for any port: it is still free when somebody listens on it."""
    while True:
        port = random.randrange(10_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as listener:
            listener.bind(("127.0.0.1", port))
            return port


def await_condition(what: str, condition, within_s: float = DEADLINE_S, every_s: float = 0.02):
    """The first true value of `condition()`."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(every_s)
    raise AssertionError(f"not within {within_s} s: {what}")


class Daemon:
    """`surprised serve`; ready when made."""

    def __init__(self, *arguments: str):
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.http = f"http://127.0.0.1:{free_port()}"
        # What tests learn is nothing that lasts, unless they say where.
        memory = [] if "--memory" in arguments else ["--memory", "memory://"]
        self._log = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            [BINARY, "serve", *memory, "-l", self.endpoint, "--http", self.http.removeprefix("http://"), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
        )
        try:
            await_condition("the service is ready", self._ready)
        except BaseException:
            self.process.kill()
            raise AssertionError(f"the service did not come up:\n{self.log()}") from None

    def _ready(self) -> bool:
        if self.process.poll() is not None:
            raise AssertionError(f"the service ended with {self.process.returncode}")
        with contextlib.suppress(OSError):
            return self.fetch("/readyz")[0] == 200
        return False

    def log(self) -> str:
        self._log.seek(0)
        return self._log.read()

    def fetch(self, path: str, body=None) -> tuple[int, str, bytes]:
        """Status, content type, body of a GET, or of a POST of `body` as JSON."""
        request = urllib.request.Request(self.http + path)
        if body is not None:
            request.data = json.dumps(body).encode()
            request.add_header("Content-Type", "application/json")
        try:
            with urllib.request.urlopen(request, timeout=DEADLINE_S) as response:
                return response.status, response.headers.get("Content-Type", ""), response.read()
        except urllib.error.HTTPError as error:
            return error.code, error.headers.get("Content-Type", ""), error.read()

    def fetch_json(self, path: str):
        status, content_type, body = self.fetch(path)
        assert status == 200 and content_type.startswith("application/json"), (path, status, content_type, body)
        return json.loads(body)

    def stop(self, how: signal.Signals = signal.SIGTERM) -> int:
        """The exit code."""
        self.process.send_signal(how)
        try:
            return self.process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running {DEADLINE_S} s after {how.name}:\n{self.log()}") from None

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._log.close()


def open_session(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


class Robot:
    """Publishes frames and waits for what the service says about each."""

    def __init__(self, session: zenoh.Session, place: str, robot: str = "robot1", camera: str = "front"):
        self.session, self.place, self.robot, self.camera = session, place, robot, camera
        self.key = f"surprised/{place}/{robot}/{camera}"
        self.sequence = 0
        self.stamp_ns = 1_700_000_000_000_000_000
        self.answers: queue.SimpleQueue = queue.SimpleQueue()
        self._subscribers = [
            session.declare_subscriber(f"{self.key}/surprise/{name}", self._receive(cls))
            for name, cls in (("report", SurpriseReport), ("rejected", Rejection))
        ]
        self._publisher = session.declare_publisher(
            f"{self.key}/frame", encoding=encoding(Frame), congestion_control=zenoh.CongestionControl.BLOCK
        )
        await_condition("the service listens for frames", lambda: self._publisher.matching_status.matching)

    def _receive(self, cls):
        return lambda sample: self.answers.put(cls.FromString(sample.payload.to_bytes()))

    def next_frame(self, box=None) -> Frame:
        self.sequence += 1
        self.stamp_ns += 100_000_000
        return scene.frame(self.sequence, self.stamp_ns, box)

    def put(self, message) -> None:
        self._publisher.put(message if isinstance(message, bytes) else message.SerializeToString())

    def answer(self):
        """The next report or rejection."""
        try:
            return self.answers.get(timeout=DEADLINE_S)
        except queue.Empty:
            raise AssertionError(f"no answer on {self.key}/surprise within {DEADLINE_S} s") from None

    def show(self, box=None) -> SurpriseReport:
        """Publishes a good frame; its report."""
        message = self.next_frame(box)
        self.put(message)
        return self.expect_report(message)

    def expect_report(self, message: Frame) -> SurpriseReport:
        answer = self.answer()
        assert isinstance(answer, SurpriseReport), f"refused: {answer}"
        assert answer.sequence == message.sequence
        return answer

    def expect_rejection(self) -> Rejection:
        answer = self.answer()
        assert isinstance(answer, Rejection), f"not refused: {answer}"
        return answer


def ask(session: zenoh.Session, selector: str, request=None) -> zenoh.Sample:
    """The only reply to a query."""
    more = {} if request is None else {"payload": request.SerializeToString(), "encoding": encoding(request)}
    replies = list(session.get(selector, timeout=DEADLINE_S, **more))
    assert len(replies) == 1, f"{len(replies)} replies to {selector}"
    assert replies[0].ok is not None, replies[0].err.payload.to_string()
    return replies[0].ok


def refusal(session: zenoh.Session, selector: str, request=None) -> str:
    """The sentence with which a query is refused."""
    more = {} if request is None else {"payload": request.SerializeToString(), "encoding": encoding(request)}
    replies = list(session.get(selector, timeout=DEADLINE_S, **more))
    assert len(replies) == 1 and replies[0].err is not None, f"{selector} was not refused"
    return replies[0].err.payload.to_string()


def prior_request(*planes: str) -> PriorRequest:
    """At the pose and with the camera of `scene.frame`."""
    like = scene.frame(0, 0)
    return PriorRequest(
        world_from_camera=like.world_from_camera, intrinsics=like.calibration.middle, planes=planes
    )


def remembered(session: zenoh.Session, place: str):
    """Everything of a place's memory that can be seen from outside; equal only if nothing changed, bit for bit."""
    views = ViewsReply.FromString(ask(session, f"surprised/{place}/@memory/views").payload.to_bytes()).views
    request = prior_request("parameters", "depth", "coverage")
    prior = PriorReply.FromString(ask(session, f"surprised/{place}/@memory/prior", request).payload.to_bytes())
    assert prior.covered > 0.5 and prior.parameters, "the memory is empty: nothing could be seen to change"
    return [(view.id, view.updates) for view in views], prior.SerializeToString()
