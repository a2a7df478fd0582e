"""What Prometheus scrapes: read by Prometheus' own parser, and true."""

import pytest
import scene
from daemon import ask, await_condition, prior_request, refusal
from prometheus_client.openmetrics.parser import text_string_to_metric_families


@pytest.fixture
def scrape(daemon):
    def scrape():
        status, content_type, body = daemon.fetch("/metrics")
        assert status == 200 and content_type == "application/openmetrics-text; version=1.0.0; charset=utf-8"
        return {family.name: family for family in text_string_to_metric_families(body.decode())}

    return scrape


def value(families, sample: str, **labels) -> float:
    found = [
        each.value
        for family in families.values()
        for each in family.samples
        if each.name == sample and each.labels == labels
    ]
    assert len(found) == 1, f"{len(found)} of {sample} {labels}"
    return found[0]


def test_frames_are_counted_by_what_became_of_them(scrape, place, settled):
    settled.put(b"no frame at all")
    settled.expect_rejection()
    # The status follows the report.
    await_condition(
        "the rejection is counted",
        lambda: value(scrape(), "surprised_frames_rejected_total", place=place, reason="undecodable") == 1,
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


def test_no_label_grows_with_robots(scrape, settled):
    labels = {label for family in scrape().values() for sample in family.samples for label in sample.labels}
    assert labels <= {
        "place", "reason", "stage", "le", "kind", "outcome", "state", "status", "queue", "engine", "version", "pass",
    }  # fmt: skip
