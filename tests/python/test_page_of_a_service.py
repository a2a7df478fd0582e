"""The page of a service that robots come to, send nonsense to, and leave."""

import re

import pytest
import scene
from browser import DESKTOP, browser, visit
from daemon import Daemon, Robot, open_session
from surprised_proto import Frame


@pytest.fixture(scope="module")
def chromium():
    with browser() as chromium:
        yield chromium


@pytest.fixture
def fresh():
    """A service that nothing has come to."""
    daemon = Daemon()
    yield daemon
    daemon.end()


def card_of(page, robot: Robot):
    return page.locator(f'.card[data-camera="{robot.robot}/{robot.camera}"]')


def test_it_says_that_nothing_has_arrived_and_what_to_do(chromium, fresh):
    with visit(chromium, fresh.http, **DESKTOP) as visited, open_session(fresh.endpoint) as session:
        page = visited.page
        page.get_by_role("heading", name="Nothing has arrived yet").wait_for()
        page.locator("#empty-command", has_text=f"surprised simulate -e {fresh.endpoint}").wait_for()
        visited.shot("empty")
        robot = Robot(session, "attic")
        robot.show()
        page.get_by_role("heading", name="Nothing has arrived yet").wait_for(state="hidden")
        card_of(page, robot).wait_for()
        page.get_by_role("link", name="attic").wait_for()


def test_a_refused_frame_is_there_with_its_reason_in_words(chromium, daemon, settled):
    with visit(chromium, f"{daemon.http}/#/{settled.place}", **DESKTOP) as visited:
        card = card_of(visited.page, settled)
        card.wait_for()
        bad: Frame = settled.next_frame()
        bad.ClearField("depth")
        settled.put(bad)
        detail = settled.expect_rejection().detail
        card.locator(".refusal", has_text=detail).wait_for()
        card.locator(".numbers", has_text="1 refused").wait_for()


def test_boxes_are_those_of_the_picture_that_is_shown(chromium, daemon, settled):
    with visit(chromium, f"{daemon.http}/#/{settled.place}", **DESKTOP) as visited:
        card = card_of(visited.page, settled)
        card.wait_for()
        report = settled.show(scene.BOX)
        card.get_by_role("img", name=re.compile(rf"sees, frame {report.sequence}, ")).wait_for()
        drawn = card.locator("figure").first.locator(".box")
        assert drawn.count() == len(report.regions) >= 1
        want = report.regions[0].box
        assert [float(drawn.first.get_attribute(name)) for name in ("x", "y", "width", "height")] == [
            want.x_min,
            want.y_min,
            want.x_max - want.x_min,
            want.y_max - want.y_min,
        ]


def test_pictures_are_fetched_only_while_somebody_can_see_them(chromium, daemon, settled):
    small = {"viewport": {"width": 400, "height": 300}}
    with visit(chromium, f"{daemon.http}/#/{settled.place}", **small) as visited:
        page = visited.page
        card = card_of(page, settled)
        card.scroll_into_view_if_needed()
        report = settled.show()
        card.get_by_role("img", name=f"sees, frame {report.sequence}").wait_for()
        card.get_by_role("img", name=f"expected, frame {report.sequence}").wait_for()
        page.locator("#map").scroll_into_view_if_needed()
        before = visited.pictures()
        for _ in range(3):
            report = settled.show()
            # The page knows of the frame, and does not ask for its pictures.
            page.locator(f'.card[data-sequence="{report.sequence}"]').wait_for()
        assert visited.pictures() == before
        card.scroll_into_view_if_needed()
        card.get_by_role("img", name=f"sees, frame {report.sequence}").wait_for()
        assert len(visited.pictures()) > len(before)


def test_a_pose_on_the_map_is_the_pose_that_is_asked_whatever_axis_is_up(chromium, daemon, settled):
    with visit(chromium, daemon.http, **DESKTOP) as visited:
        worst = visited.page.evaluate(
            """async () => {
                const { Plane, rotate } = await import("/assets/geometry.js");
                let worst = 0;
                for (const axis of [0, 1, 2]) for (const sign of [1, -1]) {
                    const plane = new Plane(axis, sign);
                    for (let heading = -3; heading <= 3; heading += 0.5) for (const pitch of [-1.2, -0.3, 0, 0.9]) {
                        const asked = { right: 1.5, top: -0.5, height: 1.25, heading, pitch };
                        const pose = plane.pose(asked);
                        const got = plane.stance(pose);
                        for (const name of Object.keys(asked)) worst = Math.max(worst, Math.abs(got[name] - asked[name]));
                        // Upright: its right is level, and its upper edge points up.
                        const level = plane.flat(rotate(pose.orientation, [1, 0, 0])).height;
                        const up = plane.flat(rotate(pose.orientation, [0, -1, 0])).height;
                        worst = Math.max(worst, Math.abs(level), Math.abs(up - Math.cos(pitch)));
                        if (!Plane.of([pose.orientation]).is(plane) && Math.cos(pitch) > 0.8) worst = Infinity;
                    }
                }
                return worst;
            }"""
        )
        assert worst < 1e-9


def test_a_picture_that_never_comes_does_not_stop_the_others(chromium, daemon, settled, session):
    """A camera that was calibrated but never sent a frame has no pictures; the others have theirs."""
    other = Robot(session, settled.place, robot="robot2")
    bad = other.next_frame()
    bad.ClearField("depth")
    other.put(bad)
    other.expect_rejection()
    with visit(chromium, f"{daemon.http}/#/{settled.place}", **DESKTOP) as visited:
        card_of(visited.page, other).get_by_text("waiting for a frame").first.wait_for()
        report = settled.show()
        card_of(visited.page, settled).get_by_role("img", name=f"sees, frame {report.sequence}").wait_for()


@pytest.fixture
def guarded(tmp_path):
    """A service with a token, and the token."""
    file = tmp_path / "token"
    file.write_text("correct-horse-battery-staple\n")
    daemon = Daemon("--http-token-file", str(file))
    yield daemon, file.read_text().strip()
    daemon.end()


def test_who_has_the_token_signs_in_and_watches(chromium, guarded):
    daemon, token = guarded
    with visit(chromium, daemon.http, **DESKTOP) as visited, open_session(daemon.endpoint) as session:
        page = visited.page
        page.get_by_role("heading", name="This service asks who you are").wait_for()
        robot = Robot(session, "vault")
        robot.show()
        form = page.locator("#token-form")
        form.get_by_label("Token").fill("battery-staple-horse-correct")
        page.keyboard.press("Enter")
        page.get_by_text("That token is not the right one.").wait_for()
        assert not card_of(page, robot).count(), "nothing is shown to strangers"
        form.get_by_label("Token").fill(token)
        page.keyboard.press("Enter")
        form.wait_for(state="hidden")
        card_of(page, robot).get_by_role("img", name=re.compile(r"sees, frame \d+")).wait_for()
        assert all(token not in url for url in visited.requests)
