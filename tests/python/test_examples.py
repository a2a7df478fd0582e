"""The examples run as they are written, and the README shows them as they are."""

import os
import re
import subprocess
import sys

import pytest
import scene
from daemon import BINARY, DEADLINE_S, ROOT, Daemon, Robot, open_session

EXAMPLES = ROOT / "examples" / "python"


def run(name, daemon, folder):
    return subprocess.run(
        [sys.executable, EXAMPLES / name, daemon.endpoint],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=2 * DEADLINE_S,
    )


def test_publish_frames_prints_the_box_that_appears_and_ask_prior_knows_the_wall(daemon, tmp_path):
    published = run("publish_frames.py", daemon, tmp_path)
    assert published.returncode == 0, published.stderr
    assert "refused" not in published.stdout
    first = re.match(r"frame (\d+): surprised at x (\d+)\.\.(\d+), y (\d+)\.\.(\d+)", published.stdout)
    assert first, published.stdout
    sequence, x_min, x_max, y_min, y_max = map(int, first.groups())
    # The box of the example stands at x 130..190, y 80..160 from frame 30 on.
    assert sequence >= 30
    assert max(abs(x_min - 130), abs(x_max - 190), abs(y_min - 80), abs(y_max - 160)) <= 12, first[0]

    asked = run("ask_prior.py", daemon, tmp_path)
    assert asked.returncode == 0, asked.stderr
    share = re.match(r"(\d+) % was seen before", asked.stdout)
    assert share and int(share[1]) >= 95, asked.stdout
    assert (tmp_path / "expected.png").read_bytes().startswith(b"\x89PNG")

    planned = run("next_view.py", daemon, tmp_path)
    assert planned.returncode == 0, planned.stderr
    lines = planned.stdout.splitlines()
    assert len(lines) == 8 and sorted(int(line.split()[0]) for line in lines) == list(range(0, 360, 45))
    # The camera never turned: what lies ahead of it is known best, so it teaches least.
    assert lines[-1].startswith("0 degrees"), planned.stdout


@pytest.fixture
def own_daemon(binary):
    daemon = Daemon()
    yield daemon
    daemon.end()


def test_watch_events_tells_what_lasts_and_what_comes(own_daemon):
    with open_session(own_daemon.endpoint) as session:
        robot = Robot(session, "lab", "watched")
        for _ in range(8):
            robot.show()
        for _ in range(2):
            robot.show(scene.BOX)
        watching = subprocess.Popen(
            [sys.executable, EXAMPLES / "watch_events.py", own_daemon.endpoint], stdout=subprocess.PIPE, text=True
        )
        try:
            lines = iter(watching.stdout.readline, "")
            assert any(re.search(r"\d+ change new: [\d.]+ nats at \(.*\) m, seen by watched", line) for line in lines)
            for _ in range(30):
                robot.show(scene.BOX)
            assert any("change end" in line for line in lines)
        finally:
            watching.kill()
            watching.communicate()


def test_ask_prior_says_so_when_nobody_answers(daemon, tmp_path):
    script = (EXAMPLES / "ask_prior.py").read_text().replace('"lab"', '"attic"')
    (tmp_path / "ask.py").write_text(script)
    asked = subprocess.run(
        [sys.executable, tmp_path / "ask.py", daemon.endpoint],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(EXAMPLES)},
        capture_output=True,
        text=True,
        timeout=2 * DEADLINE_S,
    )
    assert asked.returncode == 1 and "attic" in asked.stderr


def test_the_readme_shows_the_example_as_it_is():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert blocks
    script = (EXAMPLES / "publish_frames.py").read_text()
    for block in blocks:
        assert block.strip() in script


def test_every_option_of_the_readme_exists():
    for line in re.findall(r"(?:surprised|--) (serve|replay|query|evaluate) ([^`\n]*)", (ROOT / "README.md").read_text()):
        command, rest = line
        known = subprocess.run([BINARY, command, "--help"], capture_output=True, text=True, check=True).stdout
        for option in re.findall(r"(?<![\w-])--?[a-z][a-z-]*", rest):
            assert option in known, f"`surprised {command}` has no {option}"
