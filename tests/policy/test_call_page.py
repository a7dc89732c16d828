"""Live page of `policy join`: its state, browsers that do not read, and the page in Chromium.

The test in Chromium leaves pictures in `page-test/`; `make tour-pictures` copies one to docs/tour.
"""

import base64
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from openpi_client.websocket_client_policy import WebsocketClientPolicy

from chromium import CHROMIUM, chromium, opened, until
from policy_lab import Lab, PolicyServer, calls, command, joined, served, state
from skytether.policy import events
from skytether.policy.images import Compressor, leaves
from skytether.policy.page import CALLS_MAX, EVENTS_MAX, IMAGE_BYTES_MAX, PAGE, CallPage
from skytether.policy.robot import AnsweredCall
from skytether.policy.schedule import Kind
from skytether.shell.processes.exporter import CONNECTIONS_MAX

GREY = np.full((48, 64, 3), 90, np.uint8)
PICTURES = Path("page-test")
AT_ONCE: dict[str, Any] = {"deadline_ms": 150.0, "hold_ms": 1000.0, "server": "gpu", "robot": 1}


@pytest.fixture
def page() -> Iterator[CallPage]:
    with closing(CallPage(("127.0.0.1", 0), AT_ONCE)) as one:
        yield one


def asked(page: CallPage, path: str = "/state", host: str | None = None) -> tuple[int, bytes]:
    """Status and content of an answer."""
    connection = http.client.HTTPConnection(*page.address, timeout=180.0)
    with closing(connection):
        connection.request("GET", path, headers={"Host": host} if host else {})
        answer = connection.getresponse()
        return answer.status, answer.read()


def shown(page: CallPage) -> Any:
    status, content = asked(page)
    assert status == 200
    return json.loads(content)


def answered(number: int, sent: object = None) -> AnsweredCall:
    return AnsweredCall(number * 1_500_000, number, Kind.HOLD, 2_000_000, -1, 0, sent, None)


def test_the_page_shows_each_call_and_why_no_row_remained(page: CallPage) -> None:
    lab = Lab()
    lab.robot._on_answer = page.note
    lab.connect()
    lab.infer(state(3.0))
    lab.is_cut = True
    for _ in range(3):
        lab.sleep(0.2)
        lab.infer(state(3.0))
    for each in lab.robot.events():
        page.hear(each)
    page.take(lab.robot.figures())
    seen = shown(page)
    assert seen["about"] == AT_ONCE
    assert [call[4:] for call in seen["calls"]] == [
        ["fresh", 1],
        ["hold", 2],
        ["hold", 3],
        ["hold", 4],
    ]
    assert [call[3] for call in seen["calls"]] == [10, 0, 0, 0]  # rows left
    assert [call[1] for call in seen["calls"]] == [0.0, 150.0, 150.0, 150.0]  # time to the answer
    assert [call[2] for call in seen["calls"]] == [0.0, 350.0, 700.0, 1050.0]  # age of the chunk
    (hold,) = [each for each in seen["events"] if each[1] == "Holding"]
    assert hold[2] == str(events.Holding(robot=1, reason=hold[3]))
    assert seen["figures"]["answers"]["hold"] == 3
    assert [link for _, link in seen["seconds"]] == [seen["figures"]["link"]]


def test_the_newest_images_are_shown_as_they_were_sent(page: CallPage) -> None:
    compress = Compressor(raw=["raw"])
    old = compress({"images": {"top": GREY // 2}})
    new = compress({"images": {"top": GREY}, "list": [GREY], "raw": GREY, "state": np.zeros(3)})
    for number, sent in enumerate((old, new, None)):
        page.note(answered(number, sent))
    images = {key: base64.b64decode(data) for key, data in shown(page)["images"].items()}
    jpeg = new["images"]["top"][b"__jpeg__"]
    assert images == {"images/top": jpeg, "list/0": jpeg}
    page.note(answered(3, {"large": {b"__jpeg__": bytes(IMAGE_BYTES_MAX + 1)}}))
    assert shown(page)["images"] == {}


def test_of_images_as_lists_no_number_is_looked_at() -> None:
    """It would take as long as many answers."""
    lists = GREY.tolist()
    sent = Compressor()({"lists": lists, "state": [1.0, 2.0], "long": [0] * 10_000})
    assert [key for key, _ in leaves(sent)] == ["lists", "state/0", "state/1", "long"]


def test_the_histories_are_bounded(page: CallPage) -> None:
    count = 2 * CALLS_MAX
    for number in range(count):
        page.note(answered(number))
        page.hear(events.RobotJoined(robot=number))
        page.take({"link": None})
    seen = shown(page)
    assert [call[5] for call in seen["calls"]] == [*range(count - CALLS_MAX, count)]
    assert len(seen["events"]) == EVENTS_MAX
    assert len(seen["seconds"]) == 61


def test_a_website_gets_nothing(page: CallPage) -> None:
    """By a name that it has pointed at this machine, or in a frame, or by a foreign script."""
    assert asked(page, host="robot.example")[0] == 403
    assert asked(page, "/", host="robot.example")[0] == 403
    assert asked(page, "/")[1] == PAGE.read_bytes()
    assert asked(page, "/metrics")[0] == 404


def unread(address: tuple[str, int]) -> socket.socket:
    """Connection of a browser that requests the state and reads nothing."""
    reader = socket.create_connection(address)
    reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    reader.sendall(b"GET /state HTTP/1.1\r\nHost: localhost\r\n\r\n")
    return reader


def test_browsers_that_do_not_read_do_not_keep_others_from_the_page(page: CallPage) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (400, 400, 3), np.uint8)
    page.note(answered(1, Compressor()({str(i): noise for i in range(40)})))
    with ExitStack() as stack:
        for _ in range(3 * CONNECTIONS_MAX):
            stack.enter_context(unread(page.address))
        assert len(shown(page)["images"]) == 40
        assert len(page._server._connections) <= CONNECTIONS_MAX


@pytest.fixture
def policy() -> Iterator[PolicyServer]:
    server = PolicyServer()
    yield server
    server.close()


def free_address() -> tuple[str, int]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address: tuple[str, int] = free.getsockname()
        return address


@pytest.mark.realtime
def test_calls_are_answered_while_browsers_do_not_read(policy: PolicyServer) -> None:
    host, port = free_address()
    with (
        served(policy) as server,
        joined(server, "--deadline", "2s", "--hold", "0s", "--page", f"{host}:{port}") as robot,
        ExitStack() as stack,
    ):
        client = WebsocketClientPolicy(f"ws://{robot}")
        for _ in range(2 * CONNECTIONS_MAX):
            stack.enter_context(unread((host, port)))
        assert np.diff(calls(client, 10)).tolist() == [1.0] * 49
        client._ws.close()


def camera(number: int, turn: float) -> Any:
    """Image with a disc that moves in a circle."""
    y, x = np.mgrid[:224, :224]
    image = np.stack([x, y, np.full_like(x, 128 * number)], axis=-1).astype(np.uint8)
    centre = 112 + 70 * np.cos(turn + number), 112 + 70 * np.sin(turn + number)
    image[(x - centre[0]) ** 2 + (y - centre[1]) ** 2 < 400] = 255
    return image


@pytest.mark.browser
@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium: neither CHROMIUM nor PATH names one")
def test_a_hold_of_a_policy_in_the_browser(policy: PolicyServer) -> None:
    """The page in dark and light, wide and narrow, with large text, and by the keyboard."""
    PICTURES.mkdir(exist_ok=True)
    address = "{}:{}".format(*free_address())
    policy.thinking_s = 0.05
    bad = ("--to-server", "constant(20ms) & loss(5%)", "--to-client", "constant(20ms) & loss(5%)")
    ends = threading.Event()

    def program(at: str) -> None:
        client, position = WebsocketClientPolicy(f"ws://{at}"), 0.0
        while not ends.wait(0.1):
            images = {name: camera(i, time.monotonic()) for i, name in enumerate(("top", "wrist"))}
            reply = client.infer({"state": np.array([position]), "images": images})
            position = float(reply["actions"][4, 0]) + 1.0
        client._ws.close()

    with (
        served(policy) as server,
        command("netem", "--bind", "127.0.0.1:0", "--server", server, *bad) as netem,
        joined(netem, "--deadline", "300ms", "--hold", "600s", "--page", address) as robot,
        chromium() as browser,
        opened(browser, f"http://{address}") as page,
        opened(browser, f"http://{address}", "narrow", "light") as narrow,
    ):
        faults: list[str] = []
        for each in (page, narrow):
            each.on("pageerror", lambda error: faults.append(str(error)))
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        running = threading.Thread(target=program, args=(robot,))
        running.start()
        try:
            status = page.get_by_role("status")
            until(lambda: "fresh" in status.inner_text(), "the calls are shown")
            until(lambda: page.get_by_alt_text("Image images/wrist").count(), "images are shown")
            page.wait_for_timeout(20_000)  # for a picture of more than a moment
            policy.thinking_s = 15.0  # longer than the pictures take
            reason = "hold: hold action. `policy serve` has reported"
            until(lambda: reason in status.inner_text(), "the reason")
            until(lambda: page.locator("#events .bad").count(), "the event is shown")
            page.wait_for_timeout(2000)
            page.screenshot(path=PICTURES / "policy-dark-wide.png")
            narrow.screenshot(path=PICTURES / "policy-light-narrow.png", full_page=True)
            page.keyboard.press("Tab")
            page.keyboard.press("Enter")
            assert page.get_by_role("button", name="Go on").get_attribute("aria-pressed") == "true"
            page.keyboard.press("Tab")
            for _ in range(30):
                page.keyboard.press("ArrowLeft")
            assert page.locator("#at").inner_text() == "3.0 s ago"
            beyond = "() => document.documentElement.scrollWidth - innerWidth"
            narrow.set_viewport_size({"width": 320, "height": 600})
            assert narrow.evaluate(beyond) <= 0
            page.add_style_tag(content=":root { font-size: 200% }")
            assert page.evaluate(beyond) <= 0
        finally:
            ends.set()
            policy.thinking_s = 0.0
            running.join()
        assert not faults
        assert all(address in url for url in asked if not url.startswith("data:"))
