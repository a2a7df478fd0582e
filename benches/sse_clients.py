"""What watchers cost: frames of one hour, without anybody at `/events` and with 200 who read and one who never does.

Needs: pip install -r tests/python/requirements.txt; and target/release/surprised. Run as

    python benches/sse_clients.py [--clients 200] [--rounds 2] [--frames 3600]

Two robots publish a frame a second each, stamped so, as fast as the service answers; every 60 frames a box stands before
the wall for three, so that there are events. Both ways are run in turn. Printed for each: from a frame's publication to its
report (median, 99th percentile), the service's own time from arrival to report (mean), its processor time, and its memory
when the places are learnt and at the end. The readers share the processor with the service: its own times tell what the
service pays.

2 shared cores, an hour of stamps (7200 frames), two rounds in turn:

| watchers | publication to report: median, p99 | service's own mean | processor a frame | memory after learning, at the end |
|---|---|---|---|---|
| none | 4.0, 18 ms; 8.3, 24 ms | 4.8; 8.2 ms | 2.6; 2.6 ms | 80.5, 81.6 MiB; 80.0, 81.1 MiB |
| 200, and one that never reads | 8.7, 24 ms; 11.3, 27 ms | 7.8; 10.9 ms | 2.8; 3.0 ms | 93.9, 95.1 MiB; 93.1, 94.4 MiB |

The waits are the machine's, which others used as well; the processor time is not.
"""

import argparse
import resource
import selectors
import socket
import statistics
import sys
import threading
import time
import urllib.parse
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "examples" / "python"), str(ROOT / "tests" / "python")]

import scene  # noqa: E402
from daemon import Daemon, Robot, open_session  # noqa: E402
from prometheus_client.openmetrics.parser import text_string_to_metric_families  # noqa: E402

WARM_FRAMES = 60
TICKS = 100


class Watchers:
    """Open connections to `/events`, read by one thread; one more is never read."""

    def __init__(self, daemon: Daemon, count: int):
        self.bytes = 0
        self._selector = selectors.DefaultSelector()
        address = urllib.parse.urlsplit(daemon.http)
        request = b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n"
        for _ in range(count):
            connection = socket.create_connection((address.hostname, address.port))
            connection.sendall(request)
            self._selector.register(connection, selectors.EVENT_READ)
        self.stuck = socket.socket()
        self.stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.stuck.connect((address.hostname, address.port))
        self.stuck.sendall(request)
        self._open = True
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while self._open:
            for key, _ in self._selector.select(0.1):
                got = key.fileobj.recv(1 << 16)
                self.bytes += len(got)
                assert got, "the service closed a connection that was read"

    def close(self) -> None:
        self._open = False
        self._thread.join()
        for key in list(self._selector.get_map().values()):
            key.fileobj.close()
        self.stuck.close()


def memory_mib(daemon: Daemon) -> float:
    status = Path(f"/proc/{daemon.process.pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def processor_s(daemon: Daemon) -> float:
    fields = Path(f"/proc/{daemon.process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def metrics(daemon: Daemon) -> dict[str, float]:
    """Sums over labels."""
    sums: dict[str, float] = {}
    for family in text_string_to_metric_families(daemon.fetch("/metrics")[2].decode()):
        for sample in family.samples:
            sums[sample.name] = sums.get(sample.name, 0.0) + sample.value
    return sums


def hour(clients: int, frames: int) -> dict[str, float]:
    daemon = Daemon()
    try:
        with open_session(daemon.endpoint) as session:
            robots = [Robot(session, "kitchen", f"robot{number}") for number in range(2)]
            pictures = {box: scene.frame(0, 0, box) for box in (None, scene.BOX)}

            def show(robot: Robot, box) -> float:
                message = pictures[box]
                robot.sequence += 1
                robot.stamp_ns += 1_000_000_000
                message.sequence = robot.sequence
                message.stamp.FromNanoseconds(robot.stamp_ns)
                payload = message.SerializeToString()
                began = time.perf_counter()
                robot.put(payload)
                robot.expect_report(message)
                return time.perf_counter() - began

            for index in range(WARM_FRAMES):
                for robot in robots:
                    show(robot, scene.BOX if index % 20 < 3 else None)
            watchers = Watchers(daemon, clients) if clients else None
            before, memory_before, processor_before = metrics(daemon), memory_mib(daemon), processor_s(daemon)
            began = time.perf_counter()
            waits = [show(robot, scene.BOX if index % 60 < 3 else None) for index in range(frames) for robot in robots]
            took = time.perf_counter() - began
            after = metrics(daemon)
            result = {
                "median_ms": 1e3 * statistics.median(waits),
                "p99_ms": 1e3 * statistics.quantiles(waits, n=100)[98],
                "own_mean_ms": 1e3
                * (after["surprised_frame_seconds_sum"] - before["surprised_frame_seconds_sum"])
                / (after["surprised_frame_seconds_count"] - before["surprised_frame_seconds_count"]),
                "processor_ms_a_frame": 1e3 * (processor_s(daemon) - processor_before) / len(waits),
                "memory_before_mib": memory_before,
                "memory_after_mib": memory_mib(daemon),
                "events": after["surprised_events_total"],
                "lagged": after["surprised_sse_lagged_total"],
                "watchers": after["surprised_sse_clients"],
                "took_s": took,
            }
            if watchers:
                result["read_mib"] = watchers.bytes / 2**20
                watchers.close()
            return result
    finally:
        daemon.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=3600, help="of each robot, one a second of stamps")
    options = parser.parse_args()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    for round_ in range(options.rounds):
        for clients in (0, options.clients):
            result = hour(clients, options.frames)
            numbers = "  ".join(f"{name} {value:.2f}" for name, value in result.items())
            print(f"round {round_ + 1}, {clients:3d} read, {int(clients > 0)} does not:  {numbers}", flush=True)


if __name__ == "__main__":
    main()
