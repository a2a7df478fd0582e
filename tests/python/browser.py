"""A real browser without a window, and what every visit to the page must keep to."""

import contextlib
import os
import shutil
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from daemon import DEADLINE_S, ROOT

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: the page is not tested")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SHOTS = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "page"

DESKTOP = {"viewport": {"width": 1440, "height": 900}}
PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "is_mobile": True, "has_touch": True}


@contextlib.contextmanager
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium: the page is not tested")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(
            executable_path=CHROMIUM,
            # Containers have neither user namespaces nor much shared memory.
            args=["--no-sandbox", "--disable-dev-shm-usage"],
        )
        yield chromium
        chromium.close()


class Visit:
    """The page, opened. At its end: nothing was asked of another host, no script failed, nothing was refused by the
    page's own rules."""

    def __init__(self, chromium, http: str, **how):
        self.http = http
        self.context = chromium.new_context(**how)
        self.context.set_default_timeout(1000 * DEADLINE_S)
        self.page = self.context.new_page()
        self.requests: list[str] = []
        self.faults: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", self._console)
        self.page.goto(http)

    def _console(self, message) -> None:
        if message.type == "error" and "Content Security Policy" in message.text:
            self.faults.append(message.text)

    def pictures(self) -> list[str]:
        """What was asked for of cameras' pictures so far."""
        return [url for url in self.requests if url.endswith(".png")]

    def shot(self, name: str) -> None:
        SHOTS.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=SHOTS / f"{name}.png", full_page=True)

    def end(self) -> None:
        self.context.close()
        assert self.faults == []
        own = urlsplit(self.http).netloc
        assert {urlsplit(url).netloc for url in self.requests if not url.startswith(("data:", "blob:"))} == {own}


@contextlib.contextmanager
def visit(chromium, http: str, **how):
    visited = Visit(chromium, http, **how)
    try:
        yield visited
    except BaseException:
        visited.shot("failed")
        visited.context.close()
        raise
    visited.end()
