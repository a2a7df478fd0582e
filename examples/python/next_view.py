"""Ask the memory from where a picture would teach most: ranks eight directions around where a robot is, best first.

    pip install eclipse-zenoh==1.10.2 grpcio-tools
    python next_view.py tcp/127.0.0.1:7447
"""

import json
import math
import sys

import zenoh
from surprised_proto import NextViewReply, NextViewRequest, Ring, encoding

PLACE, ROBOT, CAMERA = "lab", "robot1", "front"

# Steps of 0.3 m in eight directions, each looking where it goes. Or fill `candidates` with poses and `intrinsics`.
request = NextViewRequest(ring=Ring(robot=ROBOT, camera=CAMERA, radius=0.3, count=8))
config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps(sys.argv[1:2] or ["tcp/127.0.0.1:7447"]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    key = f"surprised/{PLACE}/@memory/next_view"
    replies = session.get(key, payload=request.SerializeToString(), encoding=encoding(NextViewRequest), timeout=10.0)
    for reply in replies:
        if reply.err is not None:
            sys.exit(f"refused: {reply.err.payload.to_string()}")
        for view in NextViewReply.FromString(reply.ok.payload.to_bytes()).views:
            turn = math.degrees(2 * math.pi * view.index / request.ring.count)
            print(f"{turn:.0f} degrees to the right: {100 * view.covered:.0f} % known, teaches {view.reduction:.0f}")
        break
    else:
        sys.exit(f"nobody answers for {PLACE}: is `surprised serve` running, and has it seen a frame of this place?")
