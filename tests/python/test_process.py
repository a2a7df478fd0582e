"""How the service starts and ends."""

import contextlib
import signal
import subprocess

import pytest
from daemon import BINARY, DEADLINE_S, Daemon, Robot, free_port, open_session


@pytest.fixture
def own_daemon(binary):
    with contextlib.closing(contextlib.ExitStack()) as stack:
        daemon = Daemon()
        stack.callback(daemon.end)
        yield daemon


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_0_after_the_last_frame_is_finished(own_daemon, how):
    with open_session(own_daemon.endpoint) as session:
        robot = Robot(session, "place")
        robot.show()
        message = robot.next_frame()
        robot.put(message)
        robot.expect_report(message)
        assert own_daemon.stop(how) == 0, own_daemon.log()


def test_the_frame_at_work_when_the_signal_comes_still_gets_its_report(own_daemon):
    with open_session(own_daemon.endpoint) as session:
        robot = Robot(session, "place")
        first = robot.show().processing_seconds
        assert first > 0
        message = robot.next_frame()
        robot.put(message)
        # Counted as received before anything is computed.
        own_daemon.await_received("place", 2)
        assert own_daemon.stop() == 0, own_daemon.log()
        robot.expect_report(message)


def test_a_second_service_on_the_same_port_fails_with_1_and_a_sentence(own_daemon):
    result = run("serve", "-l", own_daemon.endpoint, "--http", "off")
    assert result.returncode == 1
    assert own_daemon.endpoint.removeprefix("tcp/") in result.stderr


def run(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [BINARY, *arguments], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=DEADLINE_S
    )


@pytest.mark.parametrize(
    "setting, words",
    [
        ("forgetting=0.99", ["forgetting", "0.5", "0.9"]),
        ("colour=blue", ["colour", "no setting"]),
        ("views=many", ["views", "many"]),
        ("views", ["views", "name=value"]),
    ],
)
def test_a_wrong_setting_exits_64_with_a_sentence(setting, words):
    result = run("serve", "-l", f"tcp/127.0.0.1:{free_port()}", "--http", "off", "--set", setting)
    assert result.returncode == 64, result
    assert all(word in result.stderr for word in words), result.stderr
    assert "panicked" not in result.stderr


@pytest.mark.parametrize(
    "arguments", [["sing"], ["serve", "--loudly"], ["serve", "--preset", "best"], ["serve", "--http"], []]
)
def test_wrong_arguments_exit_2(arguments):
    result = run(*arguments)
    assert result.returncode == 2 and result.stderr, result
