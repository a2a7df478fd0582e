"""A place far larger than RAM: what the process needs in all, how often a frame waits for the disk, and how long frames take.

Needs what `query_latency.py` needs, and a place made by `cargo bench --bench store -- 10000@RECORDING=PLACES`. Run as
`python benches/large_place.py PLACES [BINARY [FRAMES]]`. The robot walks along the row of viewpoints at 0.3 m/s and seven
frames a second, the first half without learning (every frame recalls what is stored), the second half learning. The disk's
cache is dropped before where the user may.

10,000 viewpoints of 320x240 (8.6 GB on disk), two cores of a shared Xeon (load 4 to 6, of others): known 0.9 s after the
start. Of the first seven frames two waited, at the place where the robot appears; of the 193 after them none, learning
neither: hit rate 1, 277 and 326 viewpoints loaded ahead. Frames p50/p99 39/73 ms observing, 38/80 ms learning, nothing
late. With a budget of 256 MiB the viewpoints took 254 and the whole process at most 439 MiB. Before blocks of their size went
back to the system it took 1029 MiB, and rising.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import zenoh
from query_latency import ROOT, Frame, SurpriseReport, encoding, recording

FPS = 7.0
SPEED_M_S = 0.3
BEGIN_M = 100.0
#: A second: what comes first is nowhere near what was needed before, and says nothing about speed yet.
FRAMES_TO_START = 7
#: Of viewpoints in RAM.
BUDGET = 256 << 20


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class Service:
    def __init__(self, binary, places):
        self.endpoint, self.http = f"tcp/127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
        self.began = time.perf_counter()
        self.process = subprocess.Popen(
            [binary, "serve", "-l", self.endpoint, "--http", self.http, "--memory", Path(places).resolve().as_uri(),
             "--set", f"memory_bytes={BUDGET}"],
            stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def fetch(self, path):
        with urllib.request.urlopen(f"http://{self.http}{path}", timeout=10) as response:
            return response.read().decode()

    def metrics(self):
        """Of the place, by name without labels."""
        found = re.findall(r'^surprised_(\w+)\{place="row"\} ([\d.e+-]+)$', self.fetch("/metrics"), re.MULTILINE)
        return {name: float(number) for name, number in found}

    def until_read(self):
        while True:
            try:
                if self.metrics().get("store_viewpoints", 0) > 0:
                    return time.perf_counter() - self.began
            except OSError:
                pass
            assert self.process.poll() is None, "the service is gone"
            time.sleep(0.05)

    def memory_mib(self):
        """Of the whole process: the most it had at once, and what it has now."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return [int(re.search(rf"^{name}:\s+(\d+) kB", status, re.MULTILINE)[1]) / 1024 for name in ("VmHWM", "VmRSS")]


def main(places, binary=ROOT / "target" / "release" / "surprised", frames=500):
    try:
        os.sync()
        Path("/proc/sys/vm/drop_caches").write_text("1")
    except OSError:
        print("the disk's cache is warm")
    service = Service(binary, places)
    try:
        took = service.until_read()
        known = service.metrics()["viewpoints_known"]
        print(f"{known:.0f} viewpoints known {took:.2f} s after the start, {service.memory_mib()[0]:.0f} MiB")
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps([service.endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        pictures = list(recording(60))
        with zenoh.open(config) as session:
            sent, latencies, learnt = {}, [], [0]

            def on_report(sample):
                now = time.perf_counter()
                report = SurpriseReport.FromString(sample.payload.to_bytes())
                latencies.append(now - sent.pop(report.sequence, now))
                learnt[0] += report.learned

            key = "surprised/row/r1/front"
            _reports = session.declare_subscriber(f"{key}/surprise/report", on_report)
            publisher = session.declare_publisher(
                f"{key}/frame", encoding=encoding(Frame), congestion_control=zenoh.CongestionControl.BLOCK
            )
            sequence, due = 0, time.perf_counter() + 0.5
            for mode in ("observe", "learn"):
                list(session.get(f"{key}/mode?set={mode}"))
                before = service.metrics()
                latencies.clear()
                for number in range(frames // 2):
                    if number == FRAMES_TO_START:
                        start = service.metrics()
                        waited, before = start["memory_misses_total"] - before.get("memory_misses_total", 0.0), start
                        print(f"{mode}: of the first {number} frames {waited:.0f} waited")
                    frame = pictures[sequence % len(pictures)]
                    frame.sequence = sequence = sequence + 1
                    frame.stamp.GetCurrentTime()
                    position, orientation = frame.world_from_camera.position, frame.world_from_camera.orientation
                    position.x, position.y, position.z = BEGIN_M + SPEED_M_S * sequence / FPS, 0.0, 0.0
                    orientation.x, orientation.y, orientation.z, orientation.w = 0.0, 0.0, 0.0, 1.0
                    payload = frame.SerializeToString()
                    time.sleep(max(0.0, due - time.perf_counter()))
                    sent[sequence] = time.perf_counter()
                    publisher.put(payload)
                    due += 1 / FPS
                time.sleep(1.0)
                after = service.metrics()
                since = {name: after[name] - before.get(name, 0.0) for name in after}
                hits, misses = since["memory_hits_total"], since["memory_misses_total"]
                p50, p99 = np.percentile(np.array(latencies) * 1e3, [50, 99])
                print(
                    f"{mode}: {len(latencies)} reports, {learnt[0]} learnt; hit rate {hits / max(1, hits + misses):.4f}"
                    f" ({misses:.0f} waited {1e3 * since['memory_miss_seconds_total']:.0f} ms,"
                    f" {since['memory_misses_incomplete_total']:.0f} went on without), {since['store_loaded_total']:.0f} loaded,"
                    f" {since['viewpoints_evicted_total']:.0f} left RAM, {since['store_written_total']:.0f} written,"
                    f" {since['store_late_total']:.0f} late; frames p50 {p50:.1f} p99 {p99:.1f}"
                    f" max {1e3 * max(latencies):.1f} ms; viewpoints in RAM {after['memory_bytes'] / 2**20:.0f} MiB,"
                    " process at most {:.0f}, now {:.0f} MiB".format(*service.memory_mib()),
                    flush=True,
                )
    finally:
        service.process.send_signal(signal.SIGTERM)
        service.process.wait()


if __name__ == "__main__":
    main(sys.argv[1], *sys.argv[2:3], *map(int, sys.argv[3:4]))
