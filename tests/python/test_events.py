"""What a robot sees becomes an event: on its key, for late joiners, over HTTP and in the stream."""

import io
import json
import queue

import numpy as np
import pytest
import scene
from daemon import DEADLINE_S, Robot, ask, await_condition
from PIL import Image as Picture
from sse import Stream
from surprised_proto import Event, encoding


@pytest.fixture
def told(session, place):
    """Every event of the place as it is put."""
    samples = queue.SimpleQueue()
    subscriber = session.declare_subscriber(f"surprised/{place}/@events/*", samples.put)

    def next_of(kind: str, state: str) -> Event:
        while True:
            try:
                sample = samples.get(timeout=DEADLINE_S)
            except queue.Empty:
                raise AssertionError(f"no {kind} was {state}") from None
            assert sample.encoding == encoding(Event)
            event = Event.FromString(sample.payload.to_bytes())
            assert str(sample.key_expr) == f"surprised/{place}/@events/{event.id}"
            if (event.kind, event.state) == (kind, state):
                return event

    yield next_of
    subscriber.undeclare()


@pytest.fixture
def observing(session, place, settled):
    """A robot that reports and does not learn."""
    ask(session, f"surprised/{place}/@memory/mode?set=observe")
    return settled


def listed(daemon, place, query="") -> dict:
    return daemon.fetch_json(f"/api/v1/places/{place}/events{query}")


def change(daemon, place) -> dict:
    """The open event that a box is."""
    events = [event for event in listed(daemon, place, "?state=open")["events"] if event["kind"] == "change"]
    assert len(events) == 1, events
    return events[0]


def test_a_box_becomes_an_event_in_its_second_frame(daemon, place, settled, told):
    with Stream(daemon, f"/events?place={place}") as stream:
        stream.next("hello")
        first = settled.show(scene.BOX)
        assert first.regions and first.regions[0].event_id == 0
        # A camera that stands still learns it at once: it is there, and not surprising any more.
        assert not settled.show(scene.BOX).regions
        event = told("change", "new")
        assert event.first_seen == event.last_seen == first.stamp
        assert list(event.robots) == [settled.robot] and event.sightings == 1 and event.peak_surprise > 6
        assert scene.overlap(scene.corners(event.peak.box), scene.BOX) >= 0.6
        assert 2.85 < event.center_in_world.z < 3.05
        assert 0.15 < event.extent_in_world.x < 0.4
        message = stream.next("event", lambda data: data["kind"] == "change")
        assert message.id and message.data["id"] == str(event.id)
        assert message.data == change(daemon, place)
        assert message.data == daemon.fetch_json(f"/api/v1/places/{place}/events/{event.id}")


def test_it_lasts_while_it_is_surprising_and_ends_when_it_is_gone(daemon, place, observing, told):
    for _ in range(30):
        report = observing.show(scene.BOX)
    event = told("change", "new")
    assert report.regions[0].event_id == event.id
    assert change(daemon, place)["sightings"] >= 20, "told of once a second"
    for _ in range(7):
        observing.show()
    assert change(daemon, place)["id"] == str(event.id)
    observing.show()
    ended = told("change", "end")
    assert ended.id == event.id and ended.sightings == 30 and ended.last_seen == report.stamp


def test_it_ends_when_its_place_is_as_expected(daemon, place, settled, told):
    for _ in range(2):
        settled.show(scene.BOX)
    event = told("change", "new")
    for _ in range(40):
        report = settled.show(scene.BOX)
    assert not report.regions
    ended = told("change", "end")
    assert (ended.id, ended.end_reason) == (event.id, "seen_again")
    assert ended.first_seen == event.first_seen and ended.ended.ToNanoseconds() > ended.last_seen.ToNanoseconds()
    events = listed(daemon, place, "?state=ended")["events"]
    assert str(event.id) in [event["id"] for event in events]
    assert not [event for event in listed(daemon, place, "?state=open")["events"] if event["kind"] == "change"]


def test_a_flicker_of_one_frame_is_no_event(daemon, place, observing):
    for _ in range(3):
        assert observing.show(scene.BOX).regions
        for _ in range(3):
            assert not observing.show().regions
    assert not [event for event in listed(daemon, place)["events"] if event["kind"] == "change"]


def test_who_comes_late_gets_the_latest_state(daemon, session, place, settled, told):
    for _ in range(2):
        settled.show(scene.BOX)
    event = told("change", "new")
    sample = ask(session, f"surprised/{place}/@events/{event.id}")
    assert sample.encoding == encoding(Event)
    assert Event.FromString(sample.payload.to_bytes()) == event
    every = list(session.get(f"surprised/{place}/@events/*?format=json", timeout=DEADLINE_S))
    ids = {json.loads(reply.ok.payload.to_string())["id"] for reply in every}
    assert ids == {event["id"] for event in listed(daemon, place)["events"]} and str(event.id) in ids


def test_another_robot_sees_the_same_event(session, place, observing, told):
    for _ in range(2):
        observing.show(scene.BOX)
    event = told("change", "new")
    other = Robot(session, place, "robot2", "rear")
    assert other.show(scene.BOX).regions[0].event_id == event.id
    joined = told("change", "update")
    assert joined.id == event.id and list(joined.robots) == [observing.robot, "robot2"]


def test_its_pictures_show_what_is_and_what_was(daemon, place, settled, told):
    for _ in range(2):
        settled.show(scene.BOX)
    event = told("change", "new")
    pictures = {}
    for name, message in (("seen", event.picture), ("expected", event.expected_picture)):
        status, content_type, body = daemon.fetch(f"/api/v1/places/{place}/events/{event.id}/{name}.jpg")
        assert (status, content_type) == (200, "image/jpeg")
        assert message.encoding == "jpeg" and message.data == body
        pictures[name] = np.asarray(Picture.open(io.BytesIO(body)), int)
        assert pictures[name].shape == (message.height, message.width, 3)
    height, width, _ = pictures["seen"].shape
    middle = np.s_[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4]
    red = np.median(pictures["seen"][middle].reshape(-1, 3), axis=0)
    assert red[0] > 150 and red[1] < 60, "the box is in the middle"
    wall = pictures["expected"][middle].reshape(-1, 3)
    assert np.median(wall[:, 0] - wall[:, 1]) < 100, "it was not expected"


def test_a_place_that_nobody_knows_is_told_as_unseen(daemon, place, robot, told):
    for _ in range(2):
        robot.show()
    event = told("unseen", "new")
    assert event.unseen_share > 0.9 and event.peak_surprise == 0
    assert event.extent_in_world.x > 0.5
    for _ in range(10):
        robot.show()
    assert told("unseen", "end").id == event.id


def test_the_surprise_of_the_last_minutes_is_there(daemon, place, settled):
    settled.show(scene.BOX)

    def cameras():
        timeline = daemon.fetch_json(f"/api/v1/places/{place}/timeline")
        assert timeline["seconds_per_point"] == 1
        return [camera for camera in timeline["cameras"] if sum(p["frames"] for p in camera["points"]) == 9]

    camera = await_condition("nine frames are on the timeline", cameras)[0]
    assert (camera["robot"], camera["camera"]) == (settled.robot, settled.camera)
    points = camera["points"]
    # Ten frames a second.
    assert [point["t"] for point in points] == sorted({point["t"] for point in points}) and len(points) <= 2
    assert points[-1]["max_surprise"] > 6


@pytest.mark.parametrize("path", ["1", "1/seen.jpg", "nonsense", "%FF", "-1"])
def test_an_event_that_is_not_there_is_a_problem(daemon, place, settled, path):
    status, content_type, _ = daemon.fetch(f"/api/v1/places/{place}/events/{path}")
    assert status in (400, 404) and content_type == "application/problem+json"
