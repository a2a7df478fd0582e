"""Other programs on the frames of `hot_path`, interleaved with it.

Needs: pip install numpy scipy opencv-python-headless; and the bench, built by `cargo bench --bench hot_path --no-run`.
Run on one core, as `taskset -c 0 python benches/peers.py target/release/deps/hot_path-<hash> [WIDTH HEIGHT [REPETITIONS]]`.

Everything gets one thread, and what counts is the processor's time. `cv2.remap` gets its maps given (ours finds them) and does nothing else; MOG2 and KNN take a
camera that stands still; NumPy and SciPy do update, surprise and block means of a prior that is given.
"""

import subprocess
import sys
import tempfile
import time

import cv2
import numpy as np
from scipy.special import digamma, gammaln

VIEWS, PLANES = 7, 10


def update_and_surprise(a0, b0, t0, s0, x, f=0.8, xi=0.003, s_min=0.05, s_max=5.0):
    """(10), (12) to (15), (16) to (23) of three channels, then means over 4x4 pixels."""
    sp = np.clip(s0 * np.exp(np.minimum(xi * b0 / a0, 80.0)), s_min, s_max)
    a = f * a0 + 0.5
    b = f * b0 + (x - t0) ** 2 / (2 * (sp + 1))
    s = sp / (sp + 1)
    t = t0 + s * (x - t0)
    surprise = (
        a0 * np.log(b / b0) + (a - a0) * digamma(a) + gammaln(a0) - gammaln(a)
        + (b0 - b) * a / b + np.log(s0 / s) / 2 + ((t - t0) ** 2 * a / b + s) / (2 * s0) - 0.5
    ).sum(axis=0)
    height, width = surprise.shape
    return surprise.reshape(height // 4, 4, width // 4, 4).mean(axis=(1, 3))


def main(bench, width=320, height=240, repetitions=50):
    width, height, repetitions = int(width), int(height), int(repetitions)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    with tempfile.NamedTemporaryFile() as frames_file:
        ours = subprocess.Popen(
            [bench, "serve", frames_file.name, str(width), str(height)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )

        def whole(preset):
            ours.stdin.write(preset + "\n")
            ours.stdin.flush()
            return float(ours.stdout.readline())

        whole("paper")  # The frames are written now.
        frames = np.fromfile(frames_file.name, np.uint8).reshape(-1, height, width, 3)

    planes = rng.random((VIEWS * PLANES, height, width), np.float32) * 100
    interleaved = rng.random((VIEWS, 3, height, width, 4), np.float32)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    maps = [
        (1.01 * x + 0.02 * y + 4 * i + 3 * np.sin(y / 30), 0.99 * y - 0.02 * x + 2 * i)
        for i in range(VIEWS)
    ]
    shape = (3, height, width)
    prior = (
        rng.uniform(0.5, 2.5, shape[1:]), rng.uniform(1, 200, shape),
        rng.uniform(0, 255, shape), rng.uniform(0.05, 5, shape),
    )
    mog2 = cv2.createBackgroundSubtractorMOG2()
    knn = cv2.createBackgroundSubtractorKNN()

    def remap():
        for index in range(VIEWS * PLANES):
            cv2.remap(planes[index], *maps[index // PLANES], cv2.INTER_LINEAR)

    def remap_interleaved():
        for index in range(VIEWS):
            for group in range(3):
                cv2.remap(interleaved[index, group], *maps[index], cv2.INTER_LINEAR)

    def timed(work):
        start = time.process_time()
        work()
        return (time.process_time() - start) * 1e3

    rows = {
        "ours, paper": lambda _: whole("paper"),
        "ours, robust": lambda _: whole("robust"),
        "cv2.remap 7x10 planes": lambda _: timed(remap),
        "cv2.remap 7x3 interleaved": lambda _: timed(remap_interleaved),
        "cv2 MOG2": lambda frame: timed(lambda: mog2.apply(frame)),
        "cv2 KNN": lambda frame: timed(lambda: knn.apply(frame)),
        "NumPy + SciPy update": lambda frame: timed(
            lambda: update_and_surprise(*prior, frame.transpose(2, 0, 1).astype(np.float64))
        ),
    }
    times = {name: [] for name in rows}
    for repetition in range(repetitions):
        frame = frames[repetition % len(frames)]
        for name, row in rows.items():
            times[name].append(row(frame))
    ours.stdin.close()
    ours.wait()
    paper = min(times["ours, paper"])
    print(f"{width}x{height}, ms of the processor, {repetitions} interleaved repetitions: least, median, least / ours (paper)")
    for name, values in times.items():
        print(f"{name:28} {min(values):8.2f} {np.median(values):8.2f} {min(values) / paper:6.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
