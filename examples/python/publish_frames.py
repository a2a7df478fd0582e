"""Publish frames to `surprised` and print what surprises it. The camera here is made up: put your own into `look`.

    pip install eclipse-zenoh==1.10.2 grpcio-tools numpy
    surprised serve -l tcp/127.0.0.1:7447
    python publish_frames.py tcp/127.0.0.1:7447
"""

import json
import sys
import time

import numpy as np
import zenoh
from surprised_proto import Frame, Image, Rejection, SurpriseReport, encoding

PLACE, ROBOT, CAMERA = "lab", "robot1", "front"
KEY = f"surprised/{PLACE}/{ROBOT}/{CAMERA}"


def look(sequence: int) -> tuple[np.ndarray, np.ndarray]:
    """A papered wall two metres ahead, rgb8; its depth in metres. After thirty frames a red box stands before it."""
    paper = np.random.default_rng(1).integers(60, 180, (30, 40, 3), np.uint8)
    rgb, depth_m = np.kron(paper, np.ones((8, 8, 1), np.uint8)), np.full((240, 320), 2.0, np.float32)
    if sequence >= 30:
        rgb[80:160, 130:190], depth_m[80:160, 130:190] = (200, 20, 20), 1.9
    rgb += np.random.default_rng(sequence).integers(0, 7, rgb.shape, np.uint8)  # a sensor's noise
    return rgb, depth_m


def frame(sequence: int) -> Frame:
    rgb, depth_m = look(sequence)
    message = Frame(
        sequence=sequence,
        image=Image(encoding="rgb8", width=320, height=240, data=rgb.tobytes()),  # or a whole jpeg or png file
        depth=Image(encoding="32FC1", width=320, height=240, data=depth_m.tobytes()),  # metres; or 16UC1: millimetres
    )
    message.stamp.GetCurrentTime()
    message.world_from_camera.position.z = 1.0  # metres; camera axes: x right, y down, z forward
    message.world_from_camera.orientation.w = 1.0
    lens = message.calibration.middle
    lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy = 320, 240, 300, 300, 159.5, 119.5
    return message


def on_answer(sample: zenoh.Sample) -> None:
    if str(sample.key_expr).endswith("/rejected"):
        rejection = Rejection.FromString(sample.payload.to_bytes())
        print(f"frame {rejection.sequence} refused ({rejection.code}): {rejection.detail}", flush=True)
        return
    report = SurpriseReport.FromString(sample.payload.to_bytes())
    for region in report.regions:
        box = region.box
        where = f"x {box.x_min}..{box.x_max}, y {box.y_min}..{box.y_max}"
        print(f"frame {report.sequence}: surprised at {where} ({region.peak_surprise:.1f} nats)", flush=True)


config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps(sys.argv[1:2] or ["tcp/127.0.0.1:7447"]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    token = session.liveliness().declare_token(f"surprised/{PLACE}/@live/robot/{ROBOT}/{CAMERA}")
    answers = [session.declare_subscriber(f"{KEY}/surprise/{what}", on_answer) for what in ("report", "rejected")]
    frames = session.declare_publisher(
        f"{KEY}/frame", encoding=encoding(Frame), congestion_control=zenoh.CongestionControl.BLOCK
    )
    for sequence in range(60):
        frames.put(frame(sequence).SerializeToString())
        time.sleep(0.1)
