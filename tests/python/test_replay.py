"""`serve` and `replay --lockstep` over real Zenoh, on a real recording."""

import csv
import json
import os
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
import scene
from daemon import BINARY, DEADLINE_S, ROOT, open_session
from PIL import Image as Picture
from surprised_proto import SurpriseReport

DATA = Path(os.environ.get("SURPRISED_DATA", ROOT.parent / "shared" / "data"))


def replay(daemon, folder, place, *more: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [BINARY, "replay", folder, "--place", place, "--robot", "robot1", "-e", daemon.endpoint, *more],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=20 * DEADLINE_S,
    )


@pytest.fixture
def tabletop():
    folder = DATA / "tabletop"
    if not folder.is_dir():
        pytest.skip(f"no recordings: {folder} is absent; set SURPRISED_DATA")
    return folder


@pytest.fixture
def recording(tmp_path):
    """Twelve frames of the made-up wall; a box stands before it in the last two."""
    stamps = [f"{100 + index / 10:.6f}" for index in range(12)]
    for folder in ("rgb", "depth"):
        (tmp_path / folder).mkdir()
    for index, stamp in enumerate(stamps):
        rgb, depth_m = scene.look(scene.BOX if index >= 10 else None)
        Picture.fromarray(rgb).save(tmp_path / "rgb" / f"{stamp}.png")
        Picture.fromarray((depth_m * 5000).astype(np.uint16)).save(tmp_path / "depth" / f"{stamp}.png")
    for folder in ("rgb", "depth"):
        (tmp_path / f"{folder}.txt").write_text("".join(f"{stamp} {folder}/{stamp}.png\n" for stamp in stamps))
    (tmp_path / "groundtruth.txt").write_text("".join(f"{stamp} 0 0 1 0 0 0 1\n" for stamp in stamps))
    (tmp_path / "calibration.txt").write_text(
        f"{scene.FOCAL} {scene.FOCAL} {(scene.WIDTH - 1) / 2} {(scene.HEIGHT - 1) / 2}\n"
    )
    return tmp_path


def test_a_replay_prints_a_line_for_each_region_and_a_summary(daemon, recording, place):
    result = replay(daemon, recording, place, "--lockstep")
    assert result.returncode == 0, result.stderr
    *regions, summary = result.stdout.splitlines()
    assert regions and all(line.startswith(("frame 10 ", "frame 11 ")) for line in regions), result.stdout
    assert "12 frames" in summary and "12 reports" in summary, summary


def test_a_replay_at_a_rate_gets_its_reports_too(daemon, recording, place):
    result = replay(daemon, recording, place, "--rate", "20")
    assert result.returncode == 0, result.stderr
    assert "12 frames" in result.stdout.splitlines()[-1]


def test_a_recording_can_be_replayed_again(daemon, recording, place):
    assert replay(daemon, recording, place, "--lockstep").returncode == 0
    result = replay(daemon, recording, place, "--lockstep")
    assert result.returncode == 0, result.stderr
    # The robot's clock went back: that is believed from the third frame on.
    assert "12 frames, 10 reports, 2 refused" in result.stdout.splitlines()[-1]


def test_a_replay_to_nobody_fails_with_1_and_says_so(daemon, recording, place):
    result = replay(daemon, recording, place, "--lockstep", "--root", "nobody-listens-here")
    assert result.returncode == 1
    assert "surprised serve" in result.stderr, result.stderr


def test_a_folder_without_a_recording_fails_with_1_and_names_it(daemon, tmp_path, place):
    result = replay(daemon, tmp_path, place)
    assert result.returncode == 1
    assert "rgb.txt" in result.stderr and str(tmp_path) in result.stderr


def test_a_place_name_that_is_no_id_exits_2(daemon, recording):
    result = replay(daemon, recording, "Upper Floor")
    assert result.returncode == 2 and "Upper Floor" in result.stderr


def test_the_cup_on_the_table_is_found_in_four_of_five_frames_when_it_is_new(daemon, tabletop, place):
    reports: list[SurpriseReport] = []
    came = threading.Condition()

    def receive(sample):
        with came:
            reports.append(SurpriseReport.FromString(sample.payload.to_bytes()))
            came.notify()

    with open_session(daemon.endpoint) as session:
        session.declare_subscriber(f"surprised/{place}/robot1/*/surprise/report", receive)
        result = replay(daemon, tabletop, place, "--lockstep")
        assert result.returncode == 0, result.stderr
        frames = sum(1 for line in open(tabletop / "rgb.txt") if not line.startswith("#"))
        with came:
            assert came.wait_for(lambda: len(reports) >= frames, DEADLINE_S)
    assert len(reports) == frames

    # C forward: the dark cup is new there.
    with open(tabletop / "phases.csv") as file:
        rows = [row for row in csv.reader(file) if not row[0].startswith("#")]
    new = {row[0] for row in rows if row[1] == "C" and row[2] == "fwd"}
    assert len(new) > 10
    found = []
    for report in reports:
        stamp = f"{report.stamp.seconds}.{round(report.stamp.nanos / 1000):06d}"
        if stamp not in new:
            continue
        ys, xs = np.nonzero(np.asarray(Picture.open(tabletop / "mask" / "cup" / f"{stamp}.png")) > 127)
        cup = (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
        strongest = max(report.regions, key=lambda region: region.peak_surprise, default=None)
        found.append(strongest is not None and scene.overlap(scene.corners(strongest.box), cup) >= 0.5)
    assert len(found) == len(new)
    assert np.mean(found) >= 0.8, json.dumps([int(hit) for hit in found])
