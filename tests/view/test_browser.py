"""The page in Chromium, which `CHROMIUM` or PATH names.

Three tests are of each submission: it opens, a link is cut and healed, a change is measured.
Pictures are left in `page-test/`, light and dark, wide and narrow.
"""

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from matplotlib.image import imread

from chromium import (
    CHROMIUM,
    chromium,
    cut,
    flown_s,
    number,
    opened,
    picture,
    pictures,
    plotted_s,
    put,
    served,
    status,
    until,
)
from skytether.figures.page import Folded, Table, rendered

sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

PICTURES = Path("page-test")
RANGES = """() => Object.values(window.__viserTestpoints.uplots).map(({chart}) => chart)
    .filter((chart) => /^[xy] /.test(chart.root.querySelector('.u-title').textContent))
    .map(({data, scales: {x, y}}) => [data[0].at(-1) - x.max, y.max - y.min])"""
"""For the plots of x and y: newest time beyond the shown ones [s], and height of the range [m]."""
WIDTHS = (("narrow", 2), ("wide", 9))
"""Tables of a report and their numbers of columns."""

TWO_LINKS = """extends = "demo"
[network]
uplink = "constant(0.08)"
downlink = "constant(0.08)"
[[network.paths]]
[[network.paths]]
"""

pytestmark = [
    pytest.mark.browser,
    pytest.mark.realtime,
    pytest.mark.skipif(not CHROMIUM, reason="no Chromium: neither CHROMIUM nor PATH names one"),
    pytest.mark.timeout(900),
]


@pytest.fixture(scope="module")
def browser() -> Iterator["sync_api.Browser"]:
    PICTURES.mkdir(exist_ok=True)
    with chromium() as launched:
        yield launched


@pytest.fixture(scope="module")
def flight(browser: "sync_api.Browser") -> Iterator[str]:
    """Address of the page of a flight that has begun."""
    with served("fly", "demo", "--duration", "3600", "--page", "127.0.0.1:0") as address:
        page = browser.new_page()
        page.goto(address)
        until(lambda: flown_s(page) > 6, "the flight begins")
        page.close()
        yield address


def test_moving_data_is_drawn_and_nobody_outside_is_asked(
    browser: "sync_api.Browser", flight: str
) -> None:
    asked: list[str] = []
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.on("request", lambda request: asked.append(request.url))
    page.on("websocket", lambda socket: asked.append(socket.url))
    page.goto(flight)
    until(lambda: plotted_s(page) > 1, "a plot is drawn")
    first_s = plotted_s(page)
    until(lambda: plotted_s(page) > first_s, "it moves")
    picture(page, PICTURES / "opened-dark-wide.png")
    page.close()
    own = flight.removeprefix("http://")
    assert not [url for url in asked if own not in url and not url.startswith("data:")]
    assert any(url.startswith("ws://") for url in asked)


def test_the_loss_slider_changes_the_measured_loss(
    browser: "sync_api.Browser", flight: str
) -> None:
    def measured() -> list[int]:
        return [int(each) for each in re.findall(r"(\d+) % (?:up|down)", status(page))]

    with opened(browser, flight) as page:
        until(lambda: "TRACK" in status(page), "it flies a plan")
        until(lambda: max(measured(), default=100) < 35, "the loss before is measured")
        slider = page.get_by_text("Loss [%]")
        place = slider.bounding_box()
        put(page, "Loss [%]", 60)
        undo = page.get_by_role("button", name=re.compile("→ 60 %"))
        until(undo.count, "it is answered")
        assert slider.bounding_box() == place, "the answer has moved the controls"
        until(lambda: min(measured(), default=0) > 40, "the measured loss follows")
        put(page, "Loss [%]", 10)
        until(lambda: max(measured(), default=100) < 35, "the measured loss follows back")


@pytest.mark.long
def test_a_typed_number_counts_once_it_is_whole(browser: "sync_api.Browser", flight: str) -> None:
    """On Enter, or when the field is left; Escape restores it, and a number beyond the range is
    refused at the field.
    """
    with opened(browser, flight) as page:
        until(lambda: "TRACK" in status(page), "it flies a plan")
        field, beside = number(page, "Loss [%]"), number(page, "Delay [ms]")

        def typed(text: str, key: str) -> str:
            field.click()
            field.press("Control+a")
            page.keyboard.type(text, delay=100.0)
            shown = field.input_value()
            page.keyboard.press(key)
            page.wait_for_timeout(2500)  # longer than an answer takes
            return shown

        changes = page.get_by_text(re.compile("^Loss .* →"))
        put(page, "Loss [%]", 12)
        until(changes.count, "it is answered")
        for text, key, expected in (("45", "Escape", "12"), ("250", "Enter", "12")):
            assert typed(text, key) == text
            assert field.input_value() == expected
        refused = page.get_by_text("0 to 100 %")
        assert refused.bounding_box()["y"] < beside.bounding_box()["y"]  # type: ignore[index]
        assert changes.first.inner_text().endswith("→ 12 %")
        typed("20", "Enter")
        until(lambda: changes.first.inner_text().endswith("12 → 20 %"), "no prefix was flown")
        assert not refused.count()
        typed("10", "Tab")
        until(lambda: changes.first.inner_text().endswith("20 → 10 %"), "a field that is left acts")
        page.get_by_role("button", name="Undo").click()
        until(lambda: changes.first.inner_text().endswith("10 → 20 %"), "it is taken back")
        put(page, "Loss [%]", 10)


def test_cutting_the_link_leads_to_braking_and_hovering_and_healing_it_back(
    browser: "sync_api.Browser", flight: str
) -> None:
    with opened(browser, flight) as page:
        until(lambda: "TRACK" in status(page), "it flies a plan")
        page.get_by_role("button", name="Cut the link").click()
        page.get_by_role("button", name="Yes, cut it").wait_for()
        picture(page, PICTURES / "asked-dark-wide.png")
        page.get_by_role("button", name="Leave it").click()
        page.wait_for_timeout(2500)
        assert "link cut" not in status(page)
        cut(page)
        until(lambda: "vehicle 1 hovers: the server is silent" in status(page), "it hovers")
        until(lambda: "HOVER" in status(page) and "link cut" in status(page), "it is shown")
        picture(page, PICTURES / "cut-dark-wide.png")
        page.get_by_role("button", name="Heal it").click()
        until(lambda: "TRACK" in status(page), "it flies a plan once the link is healed")
        until(lambda: "link good" in status(page), "the link is good again")


@pytest.mark.long
def test_a_website_cannot_show_the_page_in_a_frame_and_catch_a_click(
    browser: "sync_api.Browser", flight: str
) -> None:
    """A page of another origin, with an invisible frame over all of it."""
    frame = (
        f'<iframe src="{flight}" style="position:fixed;inset:0;width:100%;height:100%;opacity:0">'
    )

    class Website(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(frame.encode())

    with (
        ThreadingHTTPServer(("127.0.0.1", 0), Website) as website,
        opened(browser, flight) as page,
    ):
        Thread(target=website.serve_forever, daemon=True).start()
        until(lambda: "TRACK" in status(page), "it flies a plan")
        button = page.get_by_role("button", name="Cut the link").bounding_box()
        assert button
        attacked = browser.new_page(viewport=page.viewport_size)
        attacked.goto(f"http://localhost:{website.server_port}/")
        attacked.wait_for_timeout(5000)  # longer than drawing the page takes
        x, y = button["x"] + button["width"] / 2, button["y"] + button["height"] / 2
        attacked.mouse.click(x, y)
        picture(attacked, PICTURES / "framed.png")
        (shown,) = attacked.frames[1:]
        assert shown.locator("button").count() == 0
        attacked.close()
        page.wait_for_timeout(2500)
        assert "link cut" not in status(page)
        website.shutdown()


@pytest.mark.long
def test_a_network_is_written_and_measured_on_a_page_of_its_own(
    browser: "sync_api.Browser", tmp_path: Path
) -> None:
    """Netem alone, with two sockets in place of a client and a server."""
    netem = [sys.executable, "-P", "-m", "skytether", "netem", "--to-server", "constant(0.02)"]
    folder, client = tmp_path / "air", socket.socket(type=socket.SOCK_DGRAM)
    folder.mkdir()
    with client, socket.socket(type=socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        host, port = server.getsockname()
        with socket.socket(type=socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            at = free.getsockname()
        addresses = ["--bind", f"{at[0]}:{at[1]}", "--server", f"{host}:{port}"]
        sockets = ["--feed", str(folder / "netem.feed"), "--control", str(folder / "netem")]
        process = subprocess.Popen([*netem, *addresses, *sockets])

        def measured() -> str:
            client.sendto(b"asks", at)
            return status(page)

        try:
            with (
                served("page", str(folder), "--page", "127.0.0.1:0") as address,
                opened(browser, address) as page,
            ):
                until(lambda: "0 % to server" in measured(), "nothing is lost")
                assert "TRACK" not in status(page)
                assert page.get_by_text("Trigger").count() == 0
                put(page, "To server", "loss(2)")
                page.get_by_role("button", name="Change the network").click()
                until(lambda: page.get_by_text("expected loss(share)").count(), "it is refused")
                put(page, "To server", "loss(1)")
                page.get_by_role("button", name="Change the network").click()
                until(lambda: "100 % to server" in measured(), "everything is lost")
                picture(page, PICTURES / "netem-dark-wide.png")
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=30)


@pytest.mark.long
def test_one_of_two_links_is_cut_alone_and_the_vehicle_flies_on(
    browser: "sync_api.Browser", tmp_path: Path
) -> None:
    scenario = tmp_path / "two.toml"
    scenario.write_text(TWO_LINKS)
    with (
        served("fly", str(scenario), "--duration", "3600", "--page", "127.0.0.1:0") as at,
        opened(browser, at) as page,
    ):
        until(lambda: "TRACK" in status(page), "it flies a plan")
        until(lambda: "alive\talive" in status(page), "both paths are known")
        page.get_by_text("Network of path 2").dispatch_event("click")
        page.get_by_role("button", name="cut", exact=True).last.dispatch_event("click")
        until(lambda: "alive\tsilent up and down" in status(page), "the second one is silent")
        until(lambda: "TRACK" in status(page), "it flies on over the first one")
        picture(page, PICTURES / "path-cut-dark-wide.png")
        page.get_by_role("button", name="heal", exact=True).last.dispatch_event("click")
        until(lambda: "alive\talive" in status(page), "the second one is back")


def arrow(page: "sync_api.Page") -> tuple[float, float] | None:
    """Position of the arrow that drags a handle along x [pixels]; None if there is none."""
    left, width = 400, 640  # of the map, between the panels
    clip: sync_api.FloatRect = {"x": left, "y": 0, "width": width, "height": 900}
    seen = imread(BytesIO(page.screenshot(clip=clip))) * 255.0
    red, green, blue = seen[:, :, 0], seen[:, :, 1], seen[:, :, 2]
    pink = np.argwhere((red - blue > 80.0) & (blue - green > 30.0) & (green < 90.0))
    near = (np.abs(pink[:, None] - pink) <= 12).all(axis=2).sum(axis=1)
    if near.max(initial=0) < 20:
        return None
    y, x = pink[near.argmax()].tolist()
    return left + x, y


@pytest.mark.long
def test_zones_and_goals_of_a_mission_are_changed_and_refused_in_words(
    browser: "sync_api.Browser",
) -> None:
    """A zone around a vehicle is refused; another one is accepted and shown. The chosen vehicle is
    sent along x by its handle, and elsewhere by a click.
    """
    argv = ("fleet", "--mission", "warehouse", "--duration", "1200", "--page", "127.0.0.1:0")
    with served(*argv) as address, opened(browser, address) as page:
        until(lambda: "nearest other vehicle" in status(page), "the mission is shown")
        until(lambda: flown_s(page) > 12, "the mission begins")
        put(page, "Zones", "box(-20, 20, -20, 20)")
        page.get_by_role("button", name="Change the zones").click()
        until(lambda: page.get_by_text("nothing was changed").count(), "it is refused")
        put(page, "Zones", "fence(-9, 9, -9, 9)")
        page.get_by_role("button", name="Change the zones").click()
        until(lambda: page.get_by_text("mission.zones").count(), "it is said")
        x, y, tries = 0.0, 0.0, 0
        goals = page.get_by_text("mission.goals ")

        def dragged() -> bool:
            """Whether a drag has sent the vehicle. Its goal, where the handle is, may have changed
            since it was seen: then the drag turns the view instead.
            """
            nonlocal x, y, tries
            seen = arrow(page)
            if seen is None:
                return False
            (x, y), tries = seen, tries + 1
            page.mouse.move(x, y)
            page.mouse.down()
            page.mouse.move(x + 30.0, y, steps=10)
            page.wait_for_timeout(2000)  # longer than the timeout for an answer
            # The handle is still held; an earlier drag may be answered only now.
            assert tries > 1 or goals.count() == 0
            page.mouse.up()
            with suppress(sync_api.TimeoutError):
                goals.first.wait_for(timeout=60_000)
            return goals.count() > 0

        until(dragged, "it is sent there")
        page.mouse.move(x, 800.0)  # its arrow has another colour under the mouse
        page.wait_for_timeout(2000)  # by then the handle is at the confirmed goal
        if tries == 1:
            moved = pytest.approx((x + 30.0, y), abs=12.0)
            until(lambda: arrow(page) == moved, "the handle is there")
        page.get_by_label("A click").click()
        page.get_by_role("option", name="sends the vehicle").click()

        def sent() -> int:
            """Whether a click on the map has sent a vehicle. The first click may be too early, or
            choose another vehicle at that place.
            """
            page.mouse.click(720, 250)
            return page.get_by_text(re.compile(r"mission\.goals goal\(.* → ")).count()

        until(sent, "the vehicle is sent there")
        picture(page, PICTURES / "mission-dark-wide.png")


@pytest.mark.long
def test_it_is_light_and_dark_wide_and_narrow(browser: "sync_api.Browser", flight: str) -> None:
    pictures(browser, flight, PICTURES)
    with opened(browser, flight) as page:
        until(lambda: "TRACK" in status(page), "it flies a plan")
        scheme = page.locator("html")
        assert scheme.get_attribute("data-mantine-color-scheme") == "dark"
        page.get_by_label("Light page").click()
        until(
            lambda: scheme.get_attribute("data-mantine-color-scheme") == "light", "it becomes light"
        )
    with opened(browser, flight, prefers="light") as page:
        scheme = page.locator("html")
        until(
            lambda: scheme.get_attribute("data-mantine-color-scheme") == "light", "it is preferred"
        )


@pytest.mark.long
@pytest.mark.parametrize(
    ("width", "height", "labels"),
    [
        (1280, 800, ("Loss [%]", "Delay [ms]", "Trigger", "Threshold: expected gap")),
        (390, 844, ("Loss [%]", "Delay [ms]")),
    ],
)
def test_what_an_operator_needs_is_seen_without_scrolling(
    browser: "sync_api.Browser", flight: str, width: int, height: int, labels: tuple[str, ...]
) -> None:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(100_000)
    page.goto(flight)
    until(lambda: "TRACK" in status(page), "it flies a plan")
    words, button = page.locator(".skytether-status"), page.get_by_role("button", name="Cut the")
    shown = [words, button, *(page.locator("label").get_by_text(each) for each in labels)]
    boxes: list[sync_api.FloatRect | None] = []

    def laid_out() -> bool:
        """Whether all is there at once: words are replaced as the flight goes on."""
        boxes[:] = [each.bounding_box() for each in shown]
        return None not in boxes

    until(laid_out, "all is shown")
    tops = [box["y"] for box in boxes if box]
    assert tops == sorted(tops)
    assert tops[-1] + 20.0 < height
    assert all(box["height"] < 25.0 for box in boxes[2:] if box), "a label has a line"
    if width < 500:
        assert boxes[0]
        assert boxes[0]["width"] > 0.9 * width
    picture(page, PICTURES / f"opened-{width}.png")
    page.close()


@pytest.mark.long
def test_a_phone_finds_plots_beside_the_words(browser: "sync_api.Browser", flight: str) -> None:
    with opened(browser, flight, "narrow") as page:
        until(lambda: "TRACK" in status(page), "it flies a plan")
        assert plotted_s(page) == 0.0
        page.get_by_role("tab", name="Flight").click()
        until(lambda: plotted_s(page) > 1, "a plot is drawn")
        plot = page.locator(".u-wrap").first.bounding_box()
        assert plot
        assert plot["x"] >= 0.0
        assert plot["x"] + plot["width"] <= 420.0


@pytest.mark.long
def test_a_wide_table_of_a_report_fits_the_window(browser: "sync_api.Browser") -> None:
    heading = [f"a long heading {number}" for number in range(9)]
    tables = [Table(name, name, "", "", heading[:count], [["0"] * count]) for name, count in WIDTHS]
    folded = Folded("folded", [Table("folded", "", "", "", heading[:3], [["0"] * 3])])
    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.set_content(rendered("", "", [*tables, folded]))
    # What is folded has no layout.
    page.locator("details").evaluate_all("all => all.forEach(each => { each.open = true; })")
    boxes = [page.locator(f"#{name}").bounding_box() for name, _ in WIDTHS]
    hidden = "box => box.scrollWidth - box.clientWidth"
    assert [each.evaluate(hidden) for each in page.locator(".wide").all()] == [0, 0, 0]
    assert boxes[1]
    assert boxes[1]["width"] > 56 * 16
    page.close()


@pytest.mark.long
def test_who_has_no_token_can_only_look(browser: "sync_api.Browser") -> None:
    """Under a name that may mean another machine, buttons appear only with the token."""
    with served("fly", "demo", "--duration", "1200", "--page", "0.0.0.0:0") as address:
        port, token = re.search(r":(\d+)/.*token=(\S+)", address).groups()  # type: ignore[union-attr]
        with opened(browser, f"http://0.0.0.0:{port}/") as page:
            cuts = page.get_by_role("button", name="Cut the link")
            until(lambda: flown_s(page) > 0, "it can be looked at")
            assert cuts.count() == 0
            put(page, "Token", "guessed")
            page.wait_for_timeout(500)
            assert cuts.count() == 0
            put(page, "Token", token)
            until(cuts.count, "it can be played")
        with opened(browser, address.replace("127.0.0.1", "0.0.0.0")) as page:
            cuts = page.get_by_role("button", name="Cut the link")
            until(cuts.count, "the link suffices")


@pytest.mark.long
def test_a_recording_can_be_scrubbed(browser: "sync_api.Browser", tmp_path: Path) -> None:
    file = tmp_path / "demo.mcap"
    record = [sys.executable, "-P", "-m", "skytether", "fly", "demo", "--virtual"]
    subprocess.run([*record, "--record", str(file)], check=True, capture_output=True)
    with (
        served("replay", str(file), "--page", "127.0.0.1:0") as address,
        opened(browser, address) as page,
    ):
        until(lambda: flown_s(page) > 0, "it plays")
        page.get_by_role("button", name="Pause").click()
        until(lambda: page.get_by_role("button", name="Go on").count(), "it is paused")
        page.wait_for_timeout(1000)  # until the slider's earlier value has arrived
        for at_s in (30, 12, 20):
            put(page, "Time [s]", at_s)
            until(lambda at_s=at_s: abs(flown_s(page) - at_s) <= 2, f"{at_s} s is shown")
        page.wait_for_timeout(1500)  # until the last seconds are shown too
        paused_s = flown_s(page)
        page.wait_for_timeout(1500)
        assert flown_s(page) == paused_s
        picture(page, PICTURES / "replay-dark-wide.png")


@pytest.mark.long
def test_a_brake_of_a_recording_is_explained_beside_it(
    browser: "sync_api.Browser", tmp_path: Path
) -> None:
    file = tmp_path / "braked.mcap"
    record = [sys.executable, "-P", "-m", "skytether", "fly", "demo-two-links", "--virtual"]
    subprocess.run(
        [*record, "--seed", "9314", "--record", str(file)], check=True, capture_output=True
    )
    with (
        served("replay", str(file), "--page", "127.0.0.1:0") as address,
        opened(browser, address) as page,
    ):
        until(lambda: flown_s(page) > 0, "it plays")
        page.get_by_role("button", name="12.1 s: vehicle 1 brakes: the server is silent").click()
        explained = page.locator(".skytether-explained")
        until(lambda: "What would have helped" in explained.inner_text(), "it is explained")
        assert "Why: 2 outages of the uplink, together." in explained.inner_text()
        picture(page, PICTURES / "explained-dark-wide.png")


@pytest.mark.long
def test_a_duel_shows_all(browser: "sync_api.Browser") -> None:
    names = "demo", "demo-paper", "demo-no-compensation"
    with (
        served("duel", *names, "--virtual", "--page", "127.0.0.1:0") as address,
        opened(browser, address) as page,
    ):
        until(lambda: flown_s(page, 2) > 15, "all fly")
        for place, name in enumerate(names):
            assert status(page, place).startswith(name)
            assert page.locator(".u-legend").first.get_by_text(name, exact=True).count() == 1
        page.get_by_role("tab", name="More").click()
        until(lambda: len(page.evaluate(RANGES)) == 2, "x and y are drawn")
        (late_s, x_m), (_, y_m) = page.evaluate(RANGES)
        assert abs(late_s) < 1.0, "the times are those of the newest data"
        assert y_m == pytest.approx(x_m, rel=0.2)
        picture(page, PICTURES / "duel-dark-wide.png")
