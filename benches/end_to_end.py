"""From published frame to received report, and how many robots a machine sustains.

Needs: pip install -r tests/python/requirements.txt; and `cargo build --release`.
Run as `python benches/end_to_end.py [--preset paper] [--seconds 10] [--first 10] [--step 10] [--noise 10] [--stored]
[--set NAME=VALUE]`.

Robots publish 320x240 frames over Zenoh (TCP on this machine), seven a second each: a JPEG, depth as 16-bit millimetres
with noise, a pose. `--noise` is of the pictures, grey levels: with 10 of them a JPEG of quality 90 is as large as a
camera's. `--stored`: what is learnt is stored in a folder, else it ends with the service. The messages are made before;
while it runs a robot puts a stamp before one and sends it. First one robot: time from putting a frame to its report,
beside the same bytes sent there and back by a process that does nothing else. Then more and more robots, in as many
places as there are cores, each time on a fresh service, until a frame has no report. Robots and service share the
machine; processor time is that of all threads, of the service and of the robots, after the warm-up.

What a machine sustains depends on who else is on it: of a virtual one with two cores of a Xeon the same frame took 7.3 ms
and 11.7 within an hour, with nothing else in it. So what is to be compared is run in turn.

**Hurry** (`views_busy`), in turn with a service that knows none (`--set views_busy=7`), twice 6 s each, in a slow hour: of
14, 16 and 18 robots these left out 0 and 10, 24 and 96, 63 and 172 frames, with medians of 31 and 85, 100 and 240, 217
and 244 ms; with hurry (four views of seven, 17 to 82 % of the frames) 0 and 0, 0 and 0, 27 and 0, with 56 and 41, 56 and
55, 113 and 81 ms. With three views 18 robots are sustained twice.

Of an hour that was better, on a service without hurry whose robots moved by whole pixels: frames of 171 KiB of which the
JPEG is 21 (one run of 6 s each); the echo takes 0.9 ms (99th percentile 10 ms).

`robust`: one robot's report comes after 13.3 ms (26), of which comparing takes 8.0, refining the pose 2.7, remembering
0.7, decoding 0.5 and everything else in the service 0.3. Of sixteen robots after 10.6 ms (47): a frame costs 14.3 ms of
processor in the service and 0.5 in the robots, which take 3 % of the machine. Eighteen are at the edge: in three of
four runs 18 to 36 of 756 frames had no report, in one all had (29 ms, 97). With `--set threads=1` on the service, where
each place's thread works alone, all had in both of two runs between those (17 ms, 34 to 86). `paper`: 13.0 ms (15), of
twenty-two robots 122 ms (225) at 11.1 ms of processor a frame, twenty-four are too many.

With `--noise 10` the JPEG has 34 KiB: decoding takes 0.6 ms, a frame costs 14.0 ms, sixteen robots are sustained too.
With `--stored` a frame costs 16.9 ms: fourteen robots are sustained (52 ms, 151), sixteen are not.

What is not the engine's is 7 % of the service's time: unpacking the JPEG 4, Zenoh and tokio 2.
"""

import argparse
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zenoh
from PIL import Image as Picture

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "examples" / "python"), str(ROOT / "tests" / "python")]

from daemon import Daemon, await_condition, free_port, open_session  # noqa: E402
from surprised_proto import Frame, Image, SurpriseReport, encoding  # noqa: E402

WIDTH, HEIGHT, FOCAL, DISTANCE_M = 320, 240, 300.0, 2.0
FPS = 7.0
# Pixels that the wall moves from one frame to the next, there and back. No robot moves by whole ones: then every pixel would
# lie on the border of two quads and be drawn for both.
SHIFT, FRAMES = np.array([2.9, 0.3]), 32
WARM_UP_S = 3.0
# Longer than this for a report is never.
PATIENCE_S = 3.0


def frames(noise: float) -> tuple[list[bytes], float]:
    """Frames without stamp and sequence: a camera that moves along a wall. And the mean size of their JPEGs, bytes."""
    rng = np.random.default_rng(1)
    width, height = (np.array([WIDTH, HEIGHT]) + SHIFT * FRAMES).astype(int) + 1
    coarse = rng.integers(40, 215, (height // 8, width // 8, 3), np.uint8)
    wall = Picture.fromarray(coarse).resize((width, height), Picture.Resampling.BICUBIC)
    made, jpeg_bytes = [], 0
    for index in range(FRAMES):
        x, y = SHIFT * index
        moved = wall.transform(
            (WIDTH, HEIGHT), Picture.Transform.AFFINE, (1, 0, x, 0, 1, y), Picture.Resampling.BICUBIC
        )
        seen = moved + rng.normal(0.0, noise, (HEIGHT, WIDTH, 3))
        file = io.BytesIO()
        Picture.fromarray(seen.round().clip(0, 255).astype(np.uint8)).save(file, "jpeg", quality=90)
        jpeg_bytes += len(file.getvalue())
        depth = rng.normal(1000 * DISTANCE_M, 2.0, (HEIGHT, WIDTH)).round().astype("<u2")
        message = Frame(
            image=Image(encoding="jpeg", width=WIDTH, height=HEIGHT, data=file.getvalue()),
            depth=Image(encoding="16UC1", width=WIDTH, height=HEIGHT, data=depth.tobytes()),
        )
        message.world_from_camera.position.x = x * DISTANCE_M / FOCAL
        message.world_from_camera.position.y = y * DISTANCE_M / FOCAL
        message.world_from_camera.orientation.w = 1.0
        lens = message.calibration.middle
        lens.width, lens.height, lens.fx, lens.fy = WIDTH, HEIGHT, FOCAL, FOCAL
        lens.cx, lens.cy = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
        made.append(message.SerializeToString())
    return made + made[-2:0:-1], jpeg_bytes / FRAMES


def processor_s(process: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass
class Run:
    """What came of some seconds of robots."""

    put: int
    # Seconds until the reports that came.
    took: list[float]
    service_s: float
    robots_s: float
    wall_s: float
    # Of a frame's way in the service, milliseconds a frame, by part.
    stages_ms: dict[str, float]

    def describe(self) -> str:
        frames = max(1, len(self.took))
        machine_s = self.wall_s * (os.cpu_count() or 1)
        return (
            f"{describe(self.took)}; {self.put - len(self.took)} of {self.put} frames without a report; a frame costs"
            f" {1e3 * self.service_s / frames:.1f} ms of processor in the service,"
            f" {1e3 * self.robots_s / frames:.1f} ms in the robots, which take {self.robots_s / machine_s:.1%} of the"
            f" machine, the service {self.service_s / machine_s:.0%}"
        )


class Robots:
    """Publish in turn, so that the load is even, and remember when each frame left and its report came."""

    def __init__(self, session, count: int, places: int, bodies: list[bytes]):
        self.bodies = bodies
        self.left, self.took = {}, {}
        self.keys = [f"surprised/place{i % places}/robot{i}/front" for i in range(count)]
        self.subscriber = session.declare_subscriber("surprised/*/*/*/surprise/report", self._reported)
        self.publishers = [
            session.declare_publisher(
                f"{key}/frame", encoding=encoding(Frame), congestion_control=zenoh.CongestionControl.BLOCK
            )
            for key in self.keys
        ]
        for publisher in self.publishers:
            await_condition("the service listens for frames", lambda: publisher.matching_status.matching)

    def _reported(self, sample):
        now = time.perf_counter()
        report = SurpriseReport.FromString(sample.payload.to_bytes())
        key = (f"surprised/{report.place}/{report.robot}/{report.camera}", report.sequence)
        if left := self.left.get(key):
            self.took[key] = now - left

    def run(self, seconds: float, daemon: Daemon) -> Run:
        """Counts after the warm-up only."""
        service = daemon.process.pid
        start = time.perf_counter()
        counted = set()
        begun = None
        turn = 0
        while (due := start + turn / (FPS * len(self.keys))) < start + WARM_UP_S + seconds:
            if (wait := due - time.perf_counter()) > 0:
                time.sleep(wait)
            robot, sequence = turn % len(self.keys), 1 + turn // len(self.keys)
            head = Frame(sequence=sequence)
            head.stamp.FromNanoseconds(time.time_ns())
            # Messages that follow each other are one.
            payload = head.SerializeToString() + self.bodies[(sequence + 5 * robot) % len(self.bodies)]
            key = (self.keys[robot], sequence)
            self.left[key] = time.perf_counter()
            self.publishers[robot].put(payload)
            if due >= start + WARM_UP_S:
                begun = begun or (time.perf_counter(), processor_s(service), time.process_time())
                counted.add(key)
            turn += 1
        end = time.perf_counter() + PATIENCE_S
        while time.perf_counter() < end and not counted <= self.took.keys():
            time.sleep(0.05)
        assert begun, "the robots ran for longer than the warm-up"
        now = (time.perf_counter(), processor_s(service), time.process_time())
        wall_s, service_s, robots_s = (after - before for before, after in zip(begun, now, strict=True))
        took = [self.took[key] for key in counted if key in self.took]
        stages = stages_ms(daemon.fetch("/metrics")[2].decode())
        return Run(len(counted), took, service_s, robots_s, wall_s, stages)


def echo(endpoint: str) -> None:
    """Sends back what it gets, until its input ends."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        back = session.declare_publisher("back", congestion_control=zenoh.CongestionControl.BLOCK)
        with session.declare_subscriber("there", lambda sample: back.put(sample.payload)):
            print("ready", flush=True)
            sys.stdin.read()


def echo_times(bodies: list[bytes], seconds: float) -> list[float]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    child = subprocess.Popen(
        [sys.executable, __file__, "--echo", endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    child.stdout.readline()
    times, came = [], threading.Event()
    with open_session(endpoint) as session:
        subscriber = session.declare_subscriber("back", lambda _: came.set())
        there = session.declare_publisher("there", congestion_control=zenoh.CongestionControl.BLOCK)
        await_condition("the echo listens", lambda: there.matching_status.matching)
        for turn in range(int(seconds * FPS)):
            came.clear()
            start = time.perf_counter()
            there.put(bodies[turn % len(bodies)])
            if came.wait(PATIENCE_S):
                times.append(time.perf_counter() - start)
            time.sleep(max(0.0, 1 / FPS - (time.perf_counter() - start)))
        subscriber.undeclare()
    child.stdin.close()
    child.wait()
    return times


def stages_ms(metrics: str) -> dict[str, float]:
    """Means over all places and frames so far."""
    sums: dict[tuple[str, str], float] = {}
    for of, stage, value in re.findall(r'^surprised_stage_seconds_(sum|count)\{.*stage="(\w+)".*\} (\S+)', metrics, re.M):
        sums[of, stage] = sums.get((of, stage), 0.0) + float(value)
    return {stage: 1e3 * total / sums["count", stage] for (of, stage), total in sums.items() if of == "sum"}


def describe(seconds: list[float]) -> str:
    if not seconds:
        return "none came"
    median, late = np.percentile(seconds, [50, 99]) * 1e3
    return f"median {median:.1f} ms, 99th percentile {late:.1f} ms"


def serve(options, robots: int, bodies: list[bytes]) -> Run:
    folder = tempfile.TemporaryDirectory()
    memory = Path(folder.name).as_uri() if options.stored else "memory://"
    settings = [f"--set={pair}" for pair in options.set]
    daemon = Daemon("--preset", options.preset, "--engine", "cpu", "--memory", memory, *settings)
    try:
        with open_session(daemon.endpoint) as session:
            places = min(robots, os.cpu_count() or 1)
            return Robots(session, robots, places, bodies).run(options.seconds, daemon)
    finally:
        daemon.end()
        folder.cleanup()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="robust")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--first", type=int, default=10)
    parser.add_argument("--step", type=int, default=10)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--stored", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--echo", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.echo:
        echo(options.echo)
        return
    bodies, jpeg_bytes = frames(options.noise)
    size = np.mean([len(body) for body in bodies]) / 1024
    sizes = f"frames of {size:.0f} KiB, {jpeg_bytes / 1024:.0f} of them JPEG"
    print(f"{sizes}, {options.preset}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"echo: {describe(echo_times(bodies, options.seconds))}", flush=True)
    run = serve(options, 1, bodies)
    print(f"1 robot: {run.describe()}", flush=True)
    print(f"of it: {', '.join(f'{stage} {ms:.2f} ms' for stage, ms in run.stages_ms.items())}", flush=True)
    sustained, robots = 0, options.first
    while True:
        run = serve(options, robots, bodies)
        print(f"{robots} robots: {run.describe()}", flush=True)
        if len(run.took) < run.put:
            break
        sustained, robots = robots, robots + options.step
    print(f"sustained: {sustained} robots at {FPS:.0f} frames a second")


if __name__ == "__main__":
    main()
