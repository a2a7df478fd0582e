"""How the service starts and ends."""

import signal
import subprocess

import pytest
from daemon import BINARY, DEADLINE_S, Daemon, Robot, ask, free_port, open_session


@pytest.fixture
def own_daemon(binary):
    daemon = Daemon()
    yield daemon
    daemon.end()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_0_after_the_last_frame_is_finished(own_daemon, how):
    with open_session(own_daemon.endpoint) as session:
        robot = Robot(session, "place")
        robot.show()
        message = robot.next_frame()
        robot.put(message)
        # What came after the frame is answered: the frame is there, perhaps not yet done.
        ask(session, "surprised/place/@memory/views")
        assert own_daemon.stop(how) == 0, own_daemon.log()
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
        ("views=many", ["views", "many", "a whole number"]),
        ("robots.R1.mode=learn", ["R1", "a-z"]),
        ("views", ["views", "name=value"]),
    ],
)
def test_a_wrong_setting_exits_64_with_a_sentence(setting, words):
    result = run("serve", "-l", f"tcp/127.0.0.1:{free_port()}", "--http", "off", "--set", setting)
    assert result.returncode == 64, result
    assert all(word in result.stderr for word in words), result.stderr
    assert "panicked" not in result.stderr


def test_who_reads_no_further_ends_a_command_quietly(own_daemon):
    with open_session(own_daemon.endpoint) as session:
        Robot(session, "place").show()
        command = subprocess.Popen(
            [BINARY, "query", "status", "--place", "place", "-e", own_daemon.endpoint],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        command.stdout.close()
        told = command.stderr.read()
        assert command.wait(DEADLINE_S) == 0 and "status" not in told and "panicked" not in told, told


LENS = "300,300,159.5,119.5,320.5,240"


@pytest.mark.parametrize(
    "arguments",
    [
        ["sing"],
        ["serve", "--loudly"],
        ["serve", "--preset", "best"],
        ["serve", "--http"],
        ["evaluate", "somewhere", "--rig"],
        ["evaluate", "somewhere", "--ignore-world", "1,two,2,3,4"],
        ["export", "LAB", "file"],
        ["query", "status", "--place", "LAB"],
        ["query", "prior", "--place", "lab", "--pose", "0,0,0,0,0,0,1", "--intrinsics", LENS, "--out", "x.png"],
        [],
    ],
)
def test_wrong_arguments_exit_2(arguments):
    result = run(*arguments)
    assert result.returncode == 2 and result.stderr, result
