"""Ask the memory of a place what it expects to see from a pose: writes `expected.png` and says how much is known.

    pip install eclipse-zenoh==1.10.2 grpcio-tools numpy
    python ask_prior.py tcp/127.0.0.1:7447
"""

import json
import sys

import numpy as np
import zenoh
from surprised_proto import PriorReply, PriorRequest, encoding

PLACE = "lab"

request = PriorRequest(planes=["expected", "uncertainty", "depth"])
request.world_from_camera.position.z = 1.0  # metres; camera axes: x right, y down, z forward
request.world_from_camera.orientation.w = 1.0
lens = request.intrinsics
lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy = 320, 240, 300, 300, 159.5, 119.5

config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps(sys.argv[1:2] or ["tcp/127.0.0.1:7447"]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    for reply in session.get(
        f"surprised/{PLACE}/@memory/prior",
        payload=request.SerializeToString(),
        encoding=encoding(PriorRequest),
        timeout=10.0,
    ):
        if reply.err is not None:
            sys.exit(f"refused: {reply.err.payload.to_string()}")
        prior = PriorReply.FromString(reply.ok.payload.to_bytes())
        with open("expected.png", "wb") as file:
            file.write(prior.expected.data)
        variance = np.frombuffer(prior.uncertainty.data, "<f4")
        print(f"{100 * prior.covered:.0f} % was seen before, by viewpoints {list(prior.viewpoints_used)}")
        print(f"expected variance: median {np.nanmedian(variance):.1f} grey levels squared")
        break
    else:
        sys.exit(f"nobody answers for {PLACE}: is `surprised serve` running, and has it seen a frame of this place?")
