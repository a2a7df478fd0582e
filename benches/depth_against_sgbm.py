"""Depth from three cameras against OpenCV's semi-global matching (StereoSGBM, eight directions, two cameras).

    python3 -m venv target/venv && target/venv/bin/pip install opencv-python-headless
    target/venv/bin/python benches/depth_against_sgbm.py ../shared/data/tsukuba

Prints the time of the processor for one thread and of the clock for two, best and median of the repetitions in turns.
A Xeon with AVX-512, two cores, with real-time priority (`chrt -f 10`) beside a run of the tests; best of 24, milliseconds,
and their share of SGBM's; 64 labels.

    size     threads  SGBM-HH, 2 cameras  ours, 3 cameras  ours, 2 cameras
    320x240  1         19.5               21.1 (1.08)      19.3 (0.99)
    320x240  2                            17.4 (0.62)      15.2 (0.55)
    640x480  1        163.9               93.6 (0.57)      89.2 (0.54)
    640x480  2        166.4               60.6 (0.36)      55.2 (0.33)
"""

import pathlib
import subprocess
import sys
import tempfile
import time

import cv2
import numpy as np

REPETITIONS = 40
# Ours are half a pixel apart, as where bad pixels are counted; SGBM's are a pixel, and finer by its parabola.
LABELS = 64


class Ours:
    """The bench binary; one line in, milliseconds out."""

    def __init__(self):
        subprocess.run(["cargo", "build", "--release", "--bench", "depth"], check=True)
        found = subprocess.run(
            ["cargo", "bench", "--bench", "depth", "--no-run"], check=True, capture_output=True, text=True
        )
        binary = found.stderr.rsplit("(", 1)[1].split(")")[0]
        self.process = subprocess.Popen([binary], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def run(self, folder, cameras, threads):
        self.process.stdin.write(f"{folder} {LABELS} {(LABELS - 1) / 2} {cameras} {threads}\n")
        self.process.stdin.flush()
        wall, processor = map(float, self.process.stdout.readline().split())
        return processor if threads == 1 else wall


def sgbm(disparities, block):
    return cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=block,
        P1=8 * block * block,
        P2=32 * block * block,
        disp12MaxDiff=1,
        uniquenessRatio=0,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )


def timed(matcher, left, right, threads):
    cv2.setNumThreads(threads)
    clock = time.process_time if threads == 1 else time.perf_counter
    start = clock()
    matcher.compute(left, right)
    return (clock() - start) * 1e3


def speed(ours, scene):
    print(f"{LABELS} labels, best / median ms of {REPETITIONS} in turns")
    for width, height in [(320, 240), (640, 480)]:
        with tempfile.TemporaryDirectory() as folder:
            images = {}
            for name in ["left", "middle", "right", "disparity"]:
                image = cv2.imread(str(scene / f"{name}.png"), cv2.IMREAD_UNCHANGED)
                how = cv2.INTER_NEAREST if name == "disparity" else cv2.INTER_AREA
                image = cv2.resize(image, (width, height), interpolation=how)
                cv2.imwrite(f"{folder}/{name}.png", image)
                images[name] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
            for threads in [1, 2]:
                matcher = sgbm(LABELS, 3)
                times = {"SGBM-HH, 2 cameras": [], "ours, 3 cameras": [], "ours, 2 cameras": []}
                for _ in range(REPETITIONS):
                    times["SGBM-HH, 2 cameras"].append(timed(matcher, images["middle"], images["right"], threads))
                    times["ours, 3 cameras"].append(ours.run(folder, 3, threads))
                    times["ours, 2 cameras"].append(ours.run(folder, 2, threads))
                best = min(times["SGBM-HH, 2 cameras"])
                for name, ms in times.items():
                    print(
                        f"{width}x{height} {threads} thr  {name:20} {min(ms):7.2f} / {np.median(ms):7.2f}"
                        f"   {min(ms) / best:.2f} of SGBM's best"
                    )


def quality(scene):
    """SGBM's bad pixels, dense: its gaps are filled from the side that is farther, as is usual."""
    middle, right = (cv2.imread(str(scene / f"{name}.png"), cv2.IMREAD_GRAYSCALE) for name in ["middle", "right"])
    truth = cv2.imread(str(scene / "disparity.png"), cv2.IMREAD_UNCHANGED) / 16.0
    known = truth > 0
    jumps = np.zeros(truth.shape, np.uint8)
    for axis in [0, 1]:
        other = np.roll(truth, -1, axis)
        jump = (np.abs(truth - other) > 1) & known & (other > 0)
        jump[-1 if axis == 0 else slice(None), -1 if axis == 1 else slice(None)] = False
        jumps |= jump.astype(np.uint8)
    near = cv2.dilate(jumps, np.ones((9, 9), np.uint8)) > 0
    disparities = int(np.ceil(truth.max() / 16 + 1e-9) * 16)
    for block in [1, 3, 5]:
        # A margin lets it see all disparities at the left border too.
        pad = lambda image: cv2.copyMakeBorder(image, 0, 0, disparities, 0, cv2.BORDER_REPLICATE)
        raw = sgbm(disparities, block).compute(pad(middle), pad(right))[:, disparities:] / 16.0
        invalid = raw < 0
        dense = raw.copy()
        for row in dense:
            valid = np.flatnonzero(row >= 0)
            for x in np.flatnonzero(row < 0):
                at = np.searchsorted(valid, x)
                row[x] = min(row[i] for i in valid[max(at - 1, 0) : at + 1])
        bad = np.abs(dense - truth) > 1
        print(
            f"SGBM-HH block {block}: bad > 1 px {100 * bad[known].mean():.2f} %, > 0.5 px"
            f" {100 * (np.abs(dense - truth) > 0.5)[known].mean():.2f} %, near discontinuities"
            f" {100 * bad[known & near].mean():.2f} %, of valid {100 * bad[known & ~invalid].mean():.2f} %,"
            f" invalid {100 * invalid[known].mean():.2f} %"
        )


if __name__ == "__main__":
    scene = pathlib.Path(sys.argv[1])
    quality(scene)
    speed(Ours(), scene)
