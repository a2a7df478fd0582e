"""The demo does what the README says: robots learn a table, things are put on it, and every one of them is noticed."""

import json
import subprocess

from daemon import BINARY

# The first event of the patrol comes after 350 quiet frames and takes at most 84.
FRAMES = 450


def test_everything_that_is_put_on_the_table_is_noticed():
    done = subprocess.run(
        [BINARY, "demo", "--robots", "1", "--frames", str(FRAMES), "--lockstep", "--http", "off", "--json"],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["placed"] >= 1
    assert summary["noticed"] == summary["placed"]
    assert summary["reports"] == summary["frames"] > 0.9 * FRAMES
    assert " nats at (" in done.stdout


def test_a_rig_of_three_cameras_and_markers_needs_neither_depth_nor_pose():
    done = subprocess.run(
        [BINARY, "demo", "--rig", "--robots", "1", "--frames", "12", "--lockstep", "--http", "off", "--json"],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["frames"] == 12
    assert summary["reports"] + summary["refused"] == 12
    assert summary["reports"] >= 10
