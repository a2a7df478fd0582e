"""The page in a real browser against a running demo: what an operator does with it, in the order they would."""

import math
import re
import subprocess
import tempfile
from pathlib import Path

import pytest
from browser import DESKTOP, PHONE, browser, visit
from daemon import BINARY, await_condition, free_port

# The robots get to know the table for 350 frames; the first thing comes within 84 more. Each takes up to half a second
# on a busy machine.
EVENT_WITHIN_S = 300.0

ACCESSIBILITY = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed: accessibility is not tested"
)


# A surprise whose cause is a thing: neither nothing nor the person who brings it.
THING = re.compile(r" at \((\S+), (\S+), (\S+)\) m, .* - (?!nothing|person|where)(.+)$")
# On the table, from a region's middle to its event's, which is that of all who saw it and of the hand that brought it.
NEAR_M = 0.2


class Demo:
    def __init__(self, port: int):
        self.http = f"http://127.0.0.1:{port}"
        self._printed = tempfile.NamedTemporaryFile("w")
        self.process = subprocess.Popen(
            [BINARY, "demo", "--http", f"127.0.0.1:{port}"],
            stdin=subprocess.DEVNULL,
            stdout=self._printed,
            stderr=subprocess.DEVNULL,
        )
        await_condition("the demo has begun", self.lines)

    def lines(self) -> list[str]:
        """What it has printed so far."""
        return Path(self._printed.name).read_text().splitlines()

    def things(self) -> list[tuple[float, ...]]:
        """Where it has said that the script put something."""
        found = (THING.search(line) for line in self.lines())
        return [tuple(float(x) for x in at.groups()[:3]) for at in found if at]

    def end(self):
        self.process.kill()
        self.process.wait()
        self._printed.close()


@pytest.fixture(scope="module")
def chromium():
    with browser() as chromium:
        yield chromium


@pytest.fixture(scope="module")
def demo():
    running = {"demo": Demo(free_port())}
    yield running
    running["demo"].end()


@pytest.fixture(scope="module")
def opened(chromium, demo):
    with visit(chromium, demo["demo"].http, **DESKTOP, color_scheme="light") as visited:
        # Boxes come and go as things become known: which events had one is kept.
        visited.page.evaluate(
            """() => {
                window.boxed = new Set();
                new MutationObserver(() => {
                    for (const box of document.querySelectorAll(".card .box")) window.boxed.add(box.dataset.event);
                }).observe(document.getElementById("cameras"), { childList: true, subtree: true });
            }"""
        )
        yield visited


def violations(page) -> list[str]:
    found = ACCESSIBILITY.Axe().run(page).response["violations"]
    return [f"{rule['id']}: {node['target']} {node['failureSummary']}" for rule in found for node in rule["nodes"]]


def test_the_demo_prints_the_address_of_the_page(demo):
    assert demo["demo"].http in demo["demo"].lines()[0]


def test_both_robots_appear_live_with_what_they_see_and_expect(opened):
    page = opened.page
    for robot in ("robot0", "robot1"):
        card = page.locator(f'.card[data-camera="{robot}/front"]')
        card.locator('.state[data-state="live"]').wait_for()
        card.get_by_role("img", name=re.compile(rf"{robot} front: sees, frame \d+")).wait_for()
        card.get_by_role("img", name=re.compile(rf"{robot} front: expected, frame \d+")).wait_for()
    page.locator('#link[data-state="live"]').wait_for()


def test_the_place_is_drawn_from_above_with_robots_and_viewpoints(opened):
    page = opened.page
    page.locator("#map .robot").nth(1).wait_for()
    await_condition("viewpoints are drawn", lambda: page.locator("#map .viewpoints").get_attribute("d"))
    page.get_by_text("The map as a table").click()
    row = page.locator("#map-table tr", has_text="robot1 front")
    x, y = (float(cell.replace("\u2212", "-")) for cell in row.locator("td").all_inner_texts()[:2])
    assert 0.5 < (x * x + y * y) ** 0.5 < 3.0, "a robot drives around the table"


def test_an_object_that_is_put_down_is_boxed_and_listed_as_an_event(opened, demo):
    page = opened.page
    # Boxes come with pictures, and those only while they are looked at.
    page.locator("#cameras").scroll_into_view_if_needed()

    def listed() -> str | None:
        """The key of an event that was boxed, and stands where the script put something."""
        things = demo["demo"].things()
        for key, where in page.evaluate(
            """() => [...document.querySelectorAll('.event[data-kind="change"]')]
                .filter((event) => window.boxed.has(event.dataset.key))
                .map((event) => [event.dataset.key, event.innerText.match(/Where\\s+(.+) m/)?.[1]])"""
        ):
            at = [float(x.replace("\u2212", "-")) for x in where.split(", ")] if where else None
            if at and any(math.dist(at[:2], thing[:2]) < NEAR_M for thing in things):
                return key
        return None

    # Reading the list lays the whole page out.
    key = await_condition("an object is boxed and listed", listed, EVENT_WITHIN_S, every_s=0.5)
    opened.shot("desktop-light")
    event = page.locator(f'#events .event[data-key="{key}"]')
    words = event.inner_text()
    assert re.search(r"robot[01]", words) and "nats" in words, words
    assert re.search(r"\d\d:\d\d:\d\d", words), words
    event.scroll_into_view_if_needed()
    for picture in event.locator("img").all():
        await_condition("its thumbnail is there", lambda p=picture: p.evaluate("image => image.naturalWidth") > 8)


def test_pointing_at_the_map_asks_what_the_memory_expects_there(opened):
    page = opened.page
    page.locator("#map").scroll_into_view_if_needed()
    box = page.locator("#map .robot circle").first.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.locator('#prior-answer[data-state="answered"]').wait_for()
    words = page.locator("#prior-words").inner_text()
    known = re.search(r"(\d+) % of it is known", words)
    assert known and int(known[1]) > 50, words
    colours = page.locator("#prior-picture").evaluate(
        """canvas => {
            const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
            const colours = new Set();
            for (let at = 0; at < data.length; at += 4) colours.add((data[at] << 16) | (data[at + 1] << 8) | data[at + 2]);
            return colours.size;
        }"""
    )
    assert colours > 1000, "the picture shows something"


def test_the_map_is_used_without_a_mouse(opened):
    page = opened.page
    page.locator("#map").focus()
    x = float(page.locator('#prior [name="right"]').input_value())
    heading = float(page.locator('#prior [name="heading"]').input_value())
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowRight")
    assert float(page.locator('#prior [name="right"]').input_value()) == pytest.approx(x + 0.05, abs=0.011)
    assert float(page.locator('#prior [name="heading"]').input_value()) == pytest.approx(heading - 5, abs=1.1)
    with page.expect_response(lambda response: response.url.endswith("/prior")) as answer:
        page.keyboard.press("Enter")
    assert answer.value.status == 200


def test_a_camera_is_opened_and_frozen_with_the_keyboard(opened):
    page = opened.page
    link = page.locator('.card[data-camera="robot0/front"] a')
    link.focus()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog", name="robot0 front")
    for kind in ("sees", "expected", "surprise", "uncertainty"):
        dialog.get_by_role("img", name=re.compile(rf"robot0 front: {kind}, frame \d+")).wait_for()
    assert violations(page) == []
    opened.shot("camera-light")
    dialog.get_by_role("radio", name="Learn").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    mode = f"{opened.http}/api/v1/places/kitchen/robots/robot0/front/mode"
    await_condition("the camera is frozen", lambda: opened.context.request.get(mode).json()["mode"] == "freeze")
    await_condition("the page says so", dialog.get_by_role("radio", name="Freeze").is_checked)
    page.keyboard.press("Escape")
    dialog.wait_for(state="hidden")
    page.locator('.card[data-camera="robot0/front"] .badge', has_text="frozen").wait_for()
    assert link.evaluate("link => link === document.activeElement"), "the focus is back where it was"


def test_nothing_stands_in_the_way_of_a_screen_reader(opened):
    assert violations(opened.page) == []
    opened.page.emulate_media(color_scheme="dark")
    assert violations(opened.page) == []
    opened.shot("desktop-dark")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone(chromium, demo, scheme):
    with visit(chromium, demo["demo"].http, **PHONE, color_scheme=scheme) as phone:
        phone.page.locator(".card canvas[aria-label]").first.wait_for()
        phone.page.locator("#map .robot").first.wait_for()
        wide = phone.page.evaluate("() => document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert wide <= 0, "nothing has to be scrolled sideways"
        assert violations(phone.page) == []
        phone.shot(f"phone-{scheme}")


def test_it_says_that_the_service_is_gone_and_survives_its_restart(opened, demo):
    page = opened.page
    port = int(opened.http.rsplit(":", 1)[1])
    demo["demo"].end()
    page.get_by_role("heading", name="The service does not answer").wait_for()
    assert re.search(r"last heard of at \d\d:\d\d:\d\d", page.locator("#gone-text").inner_text())
    assert f"surprised serve --http 127.0.0.1:{port}" in page.locator("#gone").inner_text()
    assert violations(page) == []
    opened.shot("gone")
    demo["demo"] = Demo(port)
    page.get_by_role("heading", name="The service does not answer").wait_for(state="hidden")
    page.locator('#link[data-state="live"]').wait_for()
    for robot in ("robot0", "robot1"):
        page.locator(f'.card[data-camera="{robot}/front"] .state[data-state="live"]').wait_for()
    # It counts anew: the page does not show what the old one said.
    card = page.locator('.card[data-camera="robot0/front"]')
    card.get_by_role("img", name=re.compile(r"robot0 front: sees, frame \d+")).wait_for()
    assert int(card.get_attribute("data-sequence")) < 350
    assert page.locator('.card[data-camera="robot0/front"] .badge', has_text="frozen").is_hidden()
