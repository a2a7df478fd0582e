import itertools

import pytest
from daemon import BINARY, Daemon, Robot, open_session

_numbers = itertools.count(1)


@pytest.fixture(scope="session", autouse=True)
def binary():
    assert BINARY.exists(), f"{BINARY} is missing: cargo build --release"


@pytest.fixture(scope="module")
def shared_daemon(binary):
    """One service for the tests of a file; each of them has a place of its own."""
    daemon = Daemon()
    yield daemon
    daemon.end()


@pytest.fixture
def daemon(shared_daemon):
    yield shared_daemon
    assert shared_daemon.process.poll() is None, f"the service is gone:\n{shared_daemon.log()}"


@pytest.fixture
def session(daemon):
    with open_session(daemon.endpoint) as session:
        yield session


@pytest.fixture
def place():
    return f"place{next(_numbers)}"


@pytest.fixture
def robot(session, place):
    return Robot(session, place)


@pytest.fixture
def settled(robot):
    """A robot whose place knows the wall: eight frames of it."""
    for _ in range(8):
        assert not robot.show().regions
    return robot
