"""Watching: what comes, what is missed and found again, and that watchers cost the service nothing."""

import http.client
import json
import socket
import urllib.parse

import pytest
import scene
from daemon import Daemon, Robot, await_condition, open_session
from sse import Stream

CLIENTS_MAX = 256


@pytest.fixture
def own_daemon(binary):
    daemon = Daemon()
    yield daemon
    daemon.end()


def test_a_watcher_sees_the_cameras_as_they_are(daemon, place, settled):
    with Stream(daemon) as stream:
        hello = stream.next("hello").data
        assert hello["resumed"] is False and hello["boot"] == daemon.fetch_json("/api/v1/info")["boot"]
        settled.show(scene.BOX)

        def has_it(data):
            cameras = data["places"][0]["cameras"]
            return data["places"][0]["place"] == place and cameras and cameras[0]["frames"] == 9

        state = stream.next("state", has_it).data["places"][0]
    camera = state["cameras"][0]
    assert (camera["robot"], camera["camera"]) == (settled.robot, settled.camera)
    assert camera["last_sequence"] == 9 and camera["max_surprise"] > 6 and camera["max_surprise_since"] > 6
    assert camera["pose"]["position"] == pytest.approx([0, 0, 1], abs=0.02)
    assert camera["image"] == {"width": scene.WIDTH, "height": scene.HEIGHT}
    assert camera["intrinsics"]["fx"] == scene.FOCAL
    box = tuple(camera["boxes"][0][corner] for corner in ("x_min", "y_min", "x_max", "y_max"))
    assert scene.overlap(box, scene.BOX) >= 0.6
    assert abs(camera["last_frame_ms"] - hello["now_ms"]) < 60_000


def test_a_watcher_of_one_place_hears_of_no_other(daemon, session, place, settled):
    with Stream(daemon, f"/events?place={place}") as stream:
        Robot(session, place + "x").show()
        settled.show()
        for _ in range(2):
            assert stream.next("state").data["places"][0]["place"] == place


def test_who_comes_back_gets_the_events_that_it_missed(daemon, place, settled):
    path = f"/events?place={place}"
    with Stream(daemon, path) as stream:
        assert stream.next("hello").data["resumed"] is False
        for _ in range(2):
            settled.show(scene.BOX)
        last = stream.next("event", lambda data: data["kind"] == "change")
    for _ in range(15):
        settled.show(scene.BOX)
    with Stream(daemon, path, {"Last-Event-ID": last.id}) as stream:
        assert stream.next("hello").data["resumed"] is True
        missed = stream.next("event", lambda data: data["kind"] == "change")
        assert missed.data["id"] == last.data["id"] and missed.data["state"] in {"update", "end"}
        assert int(missed.id.partition("-")[2]) > int(last.id.partition("-")[2])


@pytest.mark.parametrize("known", ["12-1", "nonsense", "-", "1-999999999999999999999999", ""])
def test_who_knows_nothing_of_this_process_looks_anew(daemon, place, settled, known):
    with Stream(daemon, headers={"Last-Event-ID": known}) as stream:
        assert stream.next("hello").data["resumed"] is False
        assert stream.next("state").data["places"]


def test_the_stream_ends_with_the_service(own_daemon):
    with Stream(own_daemon) as stream:
        stream.next("hello")
        assert own_daemon.stop() == 0
        stream.ends()


def test_one_too_many_is_told_so_and_goes_in_when_another_leaves(own_daemon):
    address = urllib.parse.urlsplit(own_daemon.http)

    def connect():
        connection = http.client.HTTPConnection(address.hostname, address.port, timeout=30)
        connection.request("GET", "/events")
        return connection, connection.getresponse()

    watchers = [connect() for _ in range(CLIENTS_MAX)]
    assert all(response.status == 200 for _, response in watchers)
    _, refused = connect()
    assert refused.status == 503 and json.loads(refused.read())["code"] == "too_many_clients"
    watchers[0][1].close()
    watchers[0][0].close()
    await_condition("there is room again", lambda: connect()[1].status == 200)


def stuck_watcher(daemon) -> socket.socket:
    address = urllib.parse.urlsplit(daemon.http)
    stuck = socket.socket()
    stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stuck.connect((address.hostname, address.port))
    stuck.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    return stuck


def test_a_watcher_that_never_reads_costs_no_frame_and_is_counted(own_daemon):
    with open_session(own_daemon.endpoint) as session, stuck_watcher(own_daemon):
        robots = [Robot(session, "kitchen", f"robot{number}") for number in range(4)]
        for _ in range(300):
            for robot in robots:
                robot.show()
        await_condition(
            "every frame is counted", lambda: own_daemon.fetch_json("/api/v1/places/kitchen")["frames"] == 1200
        )
        with Stream(own_daemon) as stream:
            stream.next("hello")
    await_condition(
        "nobody watches any more", lambda: b"surprised_sse_clients 0\n" in own_daemon.fetch("/metrics")[2]
    )


def test_a_watcher_that_never_reads_does_not_keep_the_service_from_stopping(own_daemon):
    with open_session(own_daemon.endpoint) as session:
        stuck = stuck_watcher(own_daemon)
        robot = Robot(session, "kitchen")
        for _ in range(20):
            robot.show()
        assert own_daemon.stop() == 0, own_daemon.log()
        stuck.close()
