"""What Prometheus scrapes: read by Prometheus' own parser, and true."""

import pytest
import scene
from daemon import Daemon, Robot, ask, await_condition, open_session, prior_request, refusal
from prometheus_client.openmetrics.parser import text_string_to_metric_families


def scraped(daemon):
    status, content_type, body = daemon.fetch("/metrics")
    assert status == 200 and content_type == "application/openmetrics-text; version=1.0.0; charset=utf-8"
    return {family.name: family for family in text_string_to_metric_families(body.decode())}


@pytest.fixture
def scrape(daemon):
    return lambda: scraped(daemon)


def values(families, sample: str, **labels) -> list[float]:
    return [
        each.value
        for family in families.values()
        for each in family.samples
        if each.name == sample and each.labels == labels
    ]


def value(families, sample: str, **labels) -> float:
    found = values(families, sample, **labels)
    assert len(found) == 1, f"{len(found)} of {sample} {labels}"
    return found[0]


def test_frames_are_counted_by_what_became_of_them(scrape, place, settled):
    settled.put(b"no frame at all")
    settled.expect_rejection()
    # The status follows the report, and a reason is only there once there was one.
    await_condition(
        "the rejection is counted",
        lambda: values(scrape(), "surprised_frames_rejected_total", place=place, reason="undecodable") == [1],
    )
    families = scrape()
    assert value(families, "surprised_frames_received_total", place=place) == 9
    assert value(families, "surprised_frames_processed_total", place=place) == 8
    assert value(families, "surprised_frames_rejected_total", place=place, reason="undecodable") == 1
    assert value(families, "surprised_frames_dropped_total", place=place, reason="replaced") == 0
    assert value(families, "surprised_received_bytes_total", place=place) > 8 * scene.WIDTH * scene.HEIGHT * 7
    assert value(families, "surprised_viewpoints", place=place) >= 1
    assert 0 < value(families, "surprised_memory_bytes", place=place) < value(
        families, "surprised_memory_max_bytes", place=place
    )
    assert value(families, "surprised_cameras", place=place) == 1


def test_lost_frames_are_counted(scrape, place, settled):
    settled.sequence += 5
    settled.show()
    await_condition(
        "the gap is counted",
        lambda: value(scrape(), "surprised_frames_dropped_total", place=place, reason="lost") == 5,
    )


def test_every_part_of_a_frames_way_is_timed(scrape, place, settled):
    await_condition(
        "the last frame is timed", lambda: value(scrape(), "surprised_frame_seconds_count", place=place) == 8
    )
    families = scrape()
    parts = 0.0
    for stage in ("decode", "depth", "refine", "compare", "attend", "remember", "publish"):
        assert value(families, "surprised_stage_seconds_count", place=place, stage=stage) == 8
        parts += value(families, "surprised_stage_seconds_sum", place=place, stage=stage)
    assert value(families, "surprised_frame_seconds_count", place=place) == 8
    assert value(families, "surprised_frame_seconds_sum", place=place) >= parts > 0
    assert value(families, "surprised_frame_seconds_bucket", place=place, le="+Inf") == 8


def test_queries_are_counted_by_kind_and_outcome(scrape, session, place, settled):
    def count(kind, outcome):
        # Nothing is told before the first.
        queries = scrape().get("surprised_queries")
        return sum(
            sample.value
            for sample in (queries.samples if queries else [])
            if sample.labels == {"kind": kind, "outcome": outcome}
        )

    before = count("prior", "ok")
    ask(session, f"surprised/{place}/@memory/prior", prior_request())
    assert count("prior", "ok") == before + 1
    broken = prior_request()
    broken.world_from_camera.orientation.w = 5
    code = refusal(session, f"surprised/{place}/@memory/prior", broken).split(":")[0]
    assert count("prior", code) >= 1, code


def test_events_and_the_engine_are_told(scrape, place, settled):
    for _ in range(2):
        settled.show(scene.BOX)
    labels = {"place": place, "kind": "change", "state": "new"}
    await_condition(
        "the event is counted",
        lambda: any(
            sample.labels == labels and sample.value == 1
            for family in scrape().values()
            for sample in family.samples
            if sample.name == "surprised_events_total"
        )
        and value(scrape(), "surprised_events_open", place=place) >= 1,
    )
    families = scrape()
    engines = [sample for sample in families["surprised_engine"].samples if sample.labels["place"] == place]
    assert len(engines) == 1 and engines[0].labels["engine"] and engines[0].value == 1
    for queue in ("frames", "poses", "asks"):
        assert value(families, "surprised_queue_depth", place=place, queue=queue) == 0
    assert families["surprised_build"].samples[0].labels["version"]


def test_a_stored_memory_is_told_of(tmp_path):
    def when(daemon, what, **expected):
        def there():
            samples = [sample for family in scraped(daemon).values() for sample in family.samples]
            return all(
                any(s.name == f"surprised_{name}" and s.labels == {"place": "lab"} and s.value == number for s in samples)
                for name, number in expected.items()
            )

        await_condition(what, there)
        return scraped(daemon)

    def role(families) -> str:
        states = {sample.labels["role"]: sample.value for sample in families["surprised_store_role"].samples}
        assert states.keys() == {"unread", "reader", "writer"} and sum(states.values()) == 1
        return max(states, key=states.get)

    url = (tmp_path / "memory").as_uri()
    first, second = Daemon("--memory", url), None
    try:
        with open_session(first.endpoint) as session:
            robot = Robot(session, "lab")
            for _ in range(6):
                robot.show()
            families = when(first, "all is stored", store_pending=0, store_viewpoints=1)
            assert role(families) == "writer"
            of = {
                name: value(families, f"surprised_{name}", place="lab")
                for name in (
                    "memory_hits_total", "memory_misses_total", "memory_misses_incomplete_total",
                    "memory_miss_seconds_total", "viewpoints_known", "viewpoints_evicted_total", "store_written_total",
                    "store_written_bytes_total", "store_bytes", "store_late_total", "store_write_failures_total",
                    "store_removed_total", "store_lost_total", "store_damaged", "store_recovered", "store_loaded_total",
                    "store_read_failures_total", "store_not_prefetched_total", "store_trouble",
                    "store_pending_age_seconds", "store_left_unread",
                )
            }  # fmt: skip
            assert of.pop("memory_hits_total") == 6 and of.pop("viewpoints_known") == 1
            assert 1 <= of.pop("store_written_total") <= 6
            assert of.pop("store_written_bytes_total") >= of.pop("store_bytes") > 1000
            # A busy machine may be late.
            del of["store_late_total"]
            assert not any(of.values()), of

            second = Daemon("--memory", url)
            families = when(second, "it has read the place", store_viewpoints=1, store_loaded_total=1)
            assert role(families) == "reader"
            assert value(families, "surprised_store_recovered", place="lab") == 1
            ask(session, "surprised/lab/@memory/forget?everything=true")
            when(first, "it is forgotten", store_viewpoints=0, store_removed_total=1)
    finally:
        for daemon in filter(None, (first, second)):
            daemon.end()


def test_no_label_grows_with_robots(scrape, settled):
    labels = {label for family in scrape().values() for sample in family.samples for label in sample.labels}
    assert labels <= {
        "place", "reason", "stage", "le", "kind", "outcome", "state", "status", "queue", "engine", "version", "pass",
        "role",
    }  # fmt: skip
