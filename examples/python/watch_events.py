"""Follow what happens in a place: first what lasts already, then every change, as one line each.

    pip install eclipse-zenoh==1.10.2 grpcio-tools
    python watch_events.py tcp/127.0.0.1:7447
"""

import json
import queue
import sys

import zenoh
from surprised_proto import Event

KEY = "surprised/lab/@events/*"


def tell(sample) -> None:
    event = Event.FromString(sample.payload.to_bytes())
    center, robots = event.center_in_world, ", ".join(event.robots)
    print(
        f"{event.id} {event.kind} {event.state}: {event.peak_surprise:.1f} nats"
        f" at ({center.x:.2f}, {center.y:.2f}, {center.z:.2f}) m, seen by {robots}",
        flush=True,
    )


config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps(sys.argv[1:2] or ["tcp/127.0.0.1:7447"]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    # Subscribed before asking, so that nothing falls in between; what is in both is told twice.
    changes = queue.SimpleQueue()
    subscriber = session.declare_subscriber(KEY, changes.put)
    for reply in session.get(KEY, timeout=10.0):
        if reply.ok is not None:
            tell(reply.ok)
    try:
        while True:
            tell(changes.get())
    except KeyboardInterrupt:
        pass
