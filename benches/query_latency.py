"""How long questions take while two robots send seven frames a second, and how long frames take meanwhile.

Needs: pip install eclipse-zenoh==1.10.2 grpcio-tools numpy pillow; `cargo build --release`; the recording `revisit`. Run
as `python benches/query_latency.py [BINARY [SECONDS]]`. One asker asks one kind of question after another, each as soon
as the last was answered; then eight askers ask for priors at once. Everything goes over Zenoh on loopback.

On two quiet cores of a Xeon, 320x240, milliseconds (p50/p99): prior 9/27, with every plane 26/48, evaluate 13/31, views
0.3/1.0, status 0.2/2.4, next_view of 8 107/146, of 64 995/1031 (eight were asked), forget where nothing is 6/23, eight askers
for priors 88/127. Frames from sending to report: 16/20 while nobody asks, 14..26/27..71 meanwhile.

The same two cores while others kept twelve processes busy on them, so that the robots alone are more than they can do: prior
300/460, with every plane 700/727, evaluate 594/654, views 416/473, status 2.8/24, next_view of 8 4704 (one was asked), of 64
late, forget 565/600, eight askers for priors 4118/5081. Frames 346/501 while nobody asks, 390..738/505..1170 meanwhile: every
round of frames is followed by one pass for a question, however many wait.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import zenoh
from PIL import Image as Picture

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "examples" / "python"))

from surprised_proto import (  # noqa: E402
    EvaluateRequest,
    ForgetRequest,
    Frame,
    Image,
    NextViewRequest,
    PriorRequest,
    Ring,
    Sphere,
    SurpriseReport,
    encoding,
)

DATA = Path(os.environ.get("SURPRISED_DATA", ROOT / "../shared/data")) / "revisit"
FPS = 7.0


def lines(name):
    rows = (line.split() for line in (DATA / name).read_text().splitlines() if line[:1] != "#")
    return [row for row in rows if row]


def recording(count):
    """Frames as a robot would send them: the camera's jpeg, depth in millimetres."""
    fx, fy, cx, cy = map(float, lines("calibration.txt")[0])
    poses = {row[0]: list(map(float, row[1:])) for row in lines("groundtruth.txt")}
    depths = {row[0]: row[1] for row in lines("depth.txt")}
    for stamp, file in lines("rgb.txt")[:count]:
        depth = np.asarray(Picture.open(DATA / depths[stamp])).astype(np.uint32) // 5
        height, width = depth.shape
        frame = Frame(
            image=Image(encoding="jpeg", width=width, height=height, data=(DATA / file).read_bytes()),
            depth=Image(encoding="16UC1", width=width, height=height, data=depth.astype("<u2").tobytes()),
        )
        position, orientation = frame.world_from_camera.position, frame.world_from_camera.orientation
        position.x, position.y, position.z = poses[stamp][:3]
        orientation.x, orientation.y, orientation.z, orientation.w = poses[stamp][3:]
        lens = frame.calibration.middle
        lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy = width, height, fx, fy, cx, cy
        yield frame


class Robot(threading.Thread):
    """Goes through the frames to and fro until told to stop."""

    def __init__(self, session, name, frames, offset_s):
        super().__init__(daemon=True)
        self.frames, self.offset_s = frames, offset_s
        self.sent, self.latencies, self.stop = {}, [], threading.Event()
        key = f"surprised/lab/{name}/front"
        self.reports = session.declare_subscriber(f"{key}/surprise/report", self.on_report)
        self.publisher = session.declare_publisher(
            f"{key}/frame", encoding=encoding(Frame), congestion_control=zenoh.CongestionControl.BLOCK
        )

    def on_report(self, sample):
        now = time.perf_counter()
        report = SurpriseReport.FromString(sample.payload.to_bytes())
        self.latencies.append(now - self.sent.pop(report.sequence, now))

    def run(self):
        way = list(range(len(self.frames))) + list(range(len(self.frames) - 2, 0, -1))
        sequence, due = 0, time.perf_counter() + self.offset_s
        while not self.stop.is_set():
            frame = self.frames[way[sequence % len(way)]]
            sequence += 1
            frame.sequence = sequence
            frame.stamp.GetCurrentTime()
            payload = frame.SerializeToString()
            time.sleep(max(0.0, due - time.perf_counter()))
            self.sent[sequence] = time.perf_counter()
            self.publisher.put(payload)
            due += 1 / FPS

    def taken(self):
        taken, self.latencies = self.latencies, []
        return taken


def figures(seconds):
    if not seconds:
        return "-"
    p50, p99 = np.percentile(np.array(seconds) * 1e3, [50, 99])
    return f"{p50:6.1f} {p99:7.1f} {max(seconds) * 1e3:7.1f}"


def main(binary=ROOT / "target" / "release" / "surprised", seconds=8.0):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
    # Stored as anybody's memory is, but nobody's is touched.
    folder = tempfile.TemporaryDirectory()
    service = subprocess.Popen(
        [binary, "serve", "-l", endpoint, "--http", "off", "--memory", Path(folder.name).as_uri()],
        stderr=subprocess.DEVNULL,
    )
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    time.sleep(1.0)
    frames = list(recording(60))
    like = frames[30]
    prior = PriorRequest(world_from_camera=like.world_from_camera, intrinsics=like.calibration.middle)
    every = PriorRequest(planes=["expected", "uncertainty", "coverage", "depth", "parameters"])
    every.MergeFrom(prior)
    evaluated = Frame()
    evaluated.CopyFrom(like)
    evaluated.stamp.GetCurrentTime()
    nowhere = Sphere(radius=0.5)
    nowhere.center.x = nowhere.center.y = nowhere.center.z = 1000.0
    questions = [
        ("prior: expected, coverage", "prior", prior),
        ("prior: every plane", "prior", every),
        ("evaluate", "evaluate", EvaluateRequest(frame=evaluated)),
        ("views", "views", None),
        ("status", "status", None),
        ("next_view: ring of 8", "next_view", NextViewRequest(ring=Ring(robot="r1", camera="front", radius=0.3))),
        ("next_view: ring of 64", "next_view", NextViewRequest(ring=Ring(robot="r1", camera="front", count=64))),
        ("forget: where nothing is", "forget", ForgetRequest(sphere=nowhere)),
    ]
    try:
        with zenoh.open(config) as session:
            robots = [Robot(session, f"r{n}", [Frame.FromString(f.SerializeToString()) for f in frames], n / FPS / 2)
                      for n in (1, 2)]
            for robot in robots:
                robot.start()
            time.sleep(len(frames) / FPS)

            def ask(name, request, until, answered, refused):
                payload = {} if request is None else {"payload": request.SerializeToString()}
                while time.perf_counter() < until:
                    begin = time.perf_counter()
                    for reply in session.get(f"surprised/lab/@memory/{name}", timeout=20.0, **payload):
                        (answered if reply.ok is not None else refused).append(time.perf_counter() - begin)

            print(f"{'question':<28}{'asked':>6}{'busy':>6}   p50 ms     p99     max | frames: p50 ms  p99     max")
            for askers, (label, name, request) in [(0, ("nobody asks", "", None))] + [(1, q) for q in questions] + [
                (8, ("8 askers, prior", "prior", prior))
            ]:
                for robot in robots:
                    robot.taken()
                answered, refused, until = [], [], time.perf_counter() + seconds
                threads = [
                    threading.Thread(target=ask, args=(name, request, until, answered, refused)) for _ in range(askers)
                ]
                for thread in threads:
                    thread.start()
                time.sleep(max(0.0, until - time.perf_counter()))
                for thread in threads:
                    thread.join()
                taken = [latency for robot in robots for latency in robot.taken()]
                print(f"{label:<28}{len(answered):6}{len(refused):6}   {figures(answered):<24} | {figures(taken)}", flush=True)
            for robot in robots:
                robot.stop.set()
                robot.join()
    finally:
        service.terminate()
        service.wait()
        folder.cleanup()


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(float, sys.argv[2:3]))
