"""The page in Chromium, and pictures of it. Chromium is found by `CHROMIUM` or PATH."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from helpers import PATIENCE_S
from skytether.view.page.words import FLOWN_S

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or ""
FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
SCHEMES: tuple[Literal["dark", "light"], ...] = ("dark", "light")
SIZES = {"wide": (1400, 900), "narrow": (420, 860)}
"""Width and height of windows [pixels]."""
SHOWN_S = 25.0
"""Time of flight at which pictures are taken [s]."""


@contextmanager
def chromium() -> "Iterator[Browser]":
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS])
        yield browser
        browser.close()


@contextmanager
def served(*arguments: str) -> Iterator[str]:
    """Run a command that serves a page; yields the page's address.

    Raises RuntimeError if the command serves none.
    """
    command = [sys.executable, "-P", "-m", "skytether", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    said = []
    try:
        for line in process.stdout:
            said.append(line)
            address = next((word for word in line.split() if word.startswith("http://")), None)
            if address:
                yield address
                return
        raise RuntimeError(f"no page: {''.join(said)}")
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)


@contextmanager
def opened(
    browser: "Browser",
    address: str,
    size: str = "wide",
    prefers: Literal["dark", "light"] = "dark",
) -> "Iterator[Page]":
    width, height = SIZES[size]
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=prefers)
    page.set_default_timeout(1000.0 * PATIENCE_S)
    page.goto(address)
    yield page
    page.close()


def until(true: Callable[[], object], what: str) -> None:
    ends_s = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > ends_s:
            raise TimeoutError(f"not in {PATIENCE_S:g} s: {what}")
        time.sleep(0.05)


def status(page: "Page", place: int = 0) -> str:
    """Status of a flight, and its other figures."""
    parts = [page.locator(f".skytether-{part}") for part in ("status", "figures")]
    return "\n".join(each.nth(place).inner_text() for each in parts if each.count() > place)


def flown_s(page: "Page", place: int = 0) -> float:
    """Time of flight on the page [s]; 0 before the flight."""
    words = page.locator(".skytether-status")
    return float(words.nth(place).get_attribute(FLOWN_S) or 0) if words.count() > place else 0.0


def plotted_s(page: "Page") -> float:
    """Newest time in the first plot [s]; 0 before the flight."""
    newest = """() => {
        const plots = Object.values((window.__viserTestpoints || {}).uplots || {});
        return plots.length ? plots[0].chart.data[0].at(-1) : 0;
    }"""
    return float(page.evaluate(newest))


def number(page: "Page", label: str) -> "Locator":
    """Field of a number beside a slider, or of a text."""
    return page.locator(f"xpath=//*[text()='{label}']/ancestor::*[.//input][1]//input").last


def put(page: "Page", label: str, value: float | str) -> None:
    """Type a number beside a slider, or a text into a field."""
    field = number(page, label)
    field.fill(value if isinstance(value, str) else f"{value:g}")
    # Not on the field: the page removes it as soon as its token is right.
    page.keyboard.press("Enter")


def cut(page: "Page") -> None:
    page.get_by_role("button", name="Cut the link").click()
    page.get_by_role("button", name="Yes, cut it").click()


def picture(page: "Page", file: Path) -> None:
    """Save a picture, without the browser's notice about software rendering."""
    remark = page.locator(".mantine-Notification-closeButton")
    for _ in range(remark.count()):
        remark.first.click()
    page.wait_for_timeout(500)
    page.screenshot(path=file)


def pictures(browser: "Browser", address: str, folder: Path) -> None:
    for size, prefers in product(SIZES, SCHEMES):
        with opened(browser, address, size, prefers) as page:
            until(lambda page=page: "TRACK" in status(page), "it flies a plan")
            until(lambda page=page: flown_s(page) > SHOWN_S, "it has flown for a while")
            picture(page, folder / f"flight-{prefers}-{size}.png")
            page.get_by_role("tab", name="More").click()
            page.wait_for_timeout(2000)
            picture(page, folder / f"network-{prefers}-{size}.png")
