"""Metrics: every figure has a name or is left out on purpose, and requests delay nothing."""

import json
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import msgspec
import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from airborne import Air
from helpers import packaged
from skytether.client.endpoint import Client
from skytether.client.fleet import ClientFleet
from skytether.client.simulated.vehicle import simulated
from skytether.shared.endpoints.endpoint import VEHICLES_SHOWN_MAX
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.processes import Measured
from skytether.shared.scenario import reading
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.protocol import Mode
from skytether.shell.commandline import command
from skytether.shell.processes import exporter, metrics
from skytether.shell.processes.exporter import CONNECTIONS_MAX, Collected, Metrics, MetricsError
from skytether.shell.processes.log import LogLine
from skytether.shell.processes.metrics import (
    HEALTHY,
    LEFT_OUT,
    PREFIX,
    TABLES,
    families,
    flat,
    matched,
    names,
    trouble,
)
from skytether.sim import flight

ROOT = Path(__file__).parents[2]
DEMO = reading.load("demo")
PROCESS: dict[str, Any] = {
    "cpu_s": 1.5,
    "kernel_drops": 2,
    "send_errors": 0,
    "feed": {"readers": 3, "dropped": 1, "refused": 0},
}
"""Figures that a process adds to those of its endpoint."""


@pytest.fixture(scope="module")
def figures() -> dict[str, dict[str, Any]]:
    """Figures of each kind of process, after a flight of two vehicles."""
    eight_s, stopwatch = msgspec.structs.replace(DEMO, duration=8.0), Stopwatch(perf_counter_ns)
    flown = flight.fly(eight_s, vehicles=2, stopwatch=stopwatch)
    clients = [
        Client(
            DEMO,
            simulated(DEMO, 1),
            server=("server", 1),
            vehicle=vehicle,
            boot_id=1,
        )
        for vehicle in range(20)
    ]
    clients[0].horizons += 1
    clients[0].dropped[Drop.NOT_A_MESSAGE] += 1
    air = Air()
    air.run(5.0)
    each = {
        **flown.figures,
        "client": ClientFleet(clients).figures(),
        "alone": clients[0].figures(),
    }
    for client in ("client", "alone"):
        each[client]["by_vehicle"]["0"]["autopilot"] = air.figures()
    two_links = flight.fly(packaged("demo-two-links", duration=12.0, settle=0.0))
    for end in ("server", "client"):
        paths = two_links.figures[end]["by_vehicle"]["1"]["paths"]
        each[end]["by_vehicle"]["1"]["paths"] = paths
    led = flight.fly(packaged("demo", duration=1.0, settle=0.0), standby=True)
    leadership = led.figures["client"]["by_vehicle"]["1"]["leadership"]
    each["client"]["by_vehicle"]["1"]["leadership"] = leadership
    each["server"] |= {"dropped": {"forged": 3}, "refused": {"full": 1}}
    return {process: told | PROCESS for process, told in each.items()}


def numbers(process: str, told: dict[str, Any]) -> dict[tuple[str, tuple[str, ...]], float]:
    """Metrics made of figures, read by Prometheus's own parser."""
    collected, registry = Collected(process, "demo", 0.05), CollectorRegistry(auto_describe=False)
    collected.take(told)
    registry.register(collected)
    text = generate_latest(registry).decode()
    return {
        (sample.name, tuple(f"{name}={value}" for name, value in sorted(sample.labels.items()))): (
            sample.value
        )
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.mark.parametrize("process", ["server", "netem", "client", "alone"])
def test_every_figure_is_told_or_left_out(process: str, figures: dict[str, dict[str, Any]]) -> None:
    kind = "client" if process == "alone" else process
    exported, unknown = families(kind, figures[process])
    assert unknown == []
    known = {(PREFIX + each.name).removesuffix("_total") for each in TABLES[kind]}
    assert {family.name for family in exported} <= known
    assert {name for name, _ in numbers(kind, figures[process])} <= names()


def test_a_figure_that_is_not_known_is_found(figures: dict[str, dict[str, Any]]) -> None:
    changed = figures["server"] | {"brand": {"new": 1}}
    assert families("server", changed)[1] == ["brand/new"]
    assert numbers("server", changed)["skytether_unmapped_figures", ()] == 1.0
    assert numbers("server", figures["server"])["skytether_unmapped_figures", ()] == 0.0


def test_no_line_of_the_tables_is_about_nothing(figures: dict[str, dict[str, Any]]) -> None:
    """Each metric occurs in a flight, and so does each omitted figure."""
    rare = {
        "counts/horizons_lost",
        "counts/scheme_errors",  # of a plug-in
        "counts/planner_errors",
        "counts/trigger_errors",
        "counts/left_tube",  # on missions
        "counts/left_motion",
        "margins/{assumed}",
        "counts/planner_late",
        "counts/planner_not_called",
        "by_vehicle/{vehicle}/age_ms",
        "by_vehicle/{vehicle}/plan_age_ms",
        "by_vehicle/{vehicle}/clock_m",  # on missions
        "others_dropped/{reason}",  # with more than 16 vehicles
    }
    for process, table in TABLES.items():
        paths = [path for path, _ in flat(figures[process])]
        for figure in [*(each.figure for each in table), *LEFT_OUT[process]]:
            matching = [path for path in paths if matched(figure, path) is not None]
            assert matching or figure in rare, (process, figure)


def test_names_follow_prometheus() -> None:
    """Base units last, `_total` for counters; letters only, as in the check of dashboards."""
    for table in (*TABLES.values(), metrics.OWN):
        for metric in table:
            assert re.fullmatch("[a-z_]+", metric.name)
            assert metric.name.endswith("_total") == (metric.kind == "counter")
            assert (metric.scale != 1.0) <= ("_seconds" in metric.name)
    of_name = {metric.name: metric for table in TABLES.values() for metric in table}
    for table in TABLES.values():
        for metric in table:
            other = of_name[metric.name]
            assert (metric.kind, metric.help) == (other.kind, other.help)


def test_numbers_are_the_figures_in_base_units(figures: dict[str, dict[str, Any]]) -> None:
    server, netem = figures["server"], figures["netem"]
    values = numbers("server.2", server)
    assert values["skytether_info", ("process=server.2", "scenario=demo")] == 1.0
    assert values["skytether_step_seconds", ()] == 0.05
    assert values["skytether_server_steps_total", ()] == server["counts"]["steps"] > 100
    assert values["skytether_server_dropped_datagrams_total", ("reason=forged",)] == 3.0
    bound_s = values["skytether_server_vehicle_clock_bound_seconds", ("vehicle=1",)]
    assert bound_s == pytest.approx(server["by_vehicle"]["1"]["clock_bound_ms"] / 1e3)
    ticks = values["skytether_server_tick_seconds_bucket", ("le=+Inf",)]
    assert ticks == values["skytether_server_tick_seconds_count", ()] > 100
    assert values["skytether_feed_dropped_readers_total", ()] == 1.0
    values = numbers("netem", netem)
    up = ("direction=uplink",)
    assert values["skytether_netem_bytes_total", up] == netem["uplink"]["bytes"]
    late = values["skytether_netem_lateness_seconds", (*up, "quantile=0.99")]
    assert late == netem["uplink"]["error_ms_p99"] / 1e3
    buckets = [
        value
        for (name, _), value in values.items()
        if name == "skytether_netem_delay_seconds_bucket"
    ]
    half = len(buckets) // 2
    assert buckets[:half] == sorted(buckets[:half])
    assert buckets[half - 1] == netem["uplink"]["forwarded"]


def test_the_server_that_leads_is_a_label(figures: dict[str, dict[str, Any]]) -> None:
    values = numbers("client", figures["client"])
    assert values["skytether_client_leadership", ("vehicle=1",)] == 0.0
    assert values["skytether_client_leader", ("server=netem 1:0", "vehicle=1")] == 1.0


@pytest.mark.parametrize("end", ["server", "client"])
def test_paths_have_numbers_of_their_own(end: str, figures: dict[str, dict[str, Any]]) -> None:
    values, paths = numbers(end, figures[end]), figures[end]["by_vehicle"]["1"]["paths"]
    for path, each in enumerate(paths, start=1):
        of_path = f"path={path}", "vehicle=1"
        assert values[f"skytether_{end}_path_packets_total", of_path] == each["packets"] > 10
        assert values[f"skytether_{end}_path_bytes_total", of_path] == each["bytes"]
        assert values[f"skytether_{end}_path_loss_ratio", of_path] == each["loss"]
        assert values[f"skytether_{end}_path_failure_ratio", of_path] == each["failure"]
        assert values[f"skytether_{end}_path_later_copies_total", of_path] == each["copies"]
        acknowledged_s = values[f"skytether_{end}_path_acknowledgement_seconds", of_path]
        assert acknowledged_s == pytest.approx(each["delay_ms"] / 1e3)
    with_paths = {labels for name, labels in values if "_path_" in name}
    assert with_paths == {("path=1", "vehicle=1"), ("path=2", "vehicle=1")}


def test_a_path_without_an_acknowledgement_has_no_time_of_one() -> None:
    values = numbers("server", {"by_vehicle": {"1": {"paths": [{"packets": 3, "delay_ms": None}]}}})
    of_path = "path=1", "vehicle=1"
    assert values["skytether_server_path_packets_total", of_path] == 3.0
    assert ("skytether_server_path_acknowledgement_seconds", of_path) not in values


def test_a_vehicle_is_in_one_mode(figures: dict[str, dict[str, Any]]) -> None:
    for process in ("client", "alone"):
        values = numbers("client", figures[process])
        modes = {
            labels[0].removeprefix("mode="): value
            for (name, labels), value in values.items()
            if name == "skytether_client_mode" and labels[1] == "vehicle=0"
        }
        assert modes == {str(mode): float(mode is Mode.INIT) for mode in Mode}
        assert values["skytether_client_horizons_total", ("vehicle=0",)] == 1.0
        assert values["skytether_client_missed_steps_total", ()] == 0.0


def test_vehicles_told_of_are_bounded(figures: dict[str, dict[str, Any]]) -> None:
    """Twenty fly, and sixteen are reported, because Prometheus stores each for weeks."""
    shown = {
        labels for name, labels in numbers("client", figures["client"]) if "client_step" in name
    }
    assert len({label for labels in shown for label in labels}) == VEHICLES_SHOWN_MAX


def test_figures_of_a_client_in_flight_have_ages() -> None:
    seen: list[dict[str, Any]] = []
    fly = Client._fly

    def spied(self: Client, now_ns: int) -> None:
        fly(self, now_ns)
        seen.append(self.vehicle_figures())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Client, "_fly", spied)
        flown = flight.fly(msgspec.structs.replace(DEMO, duration=8.0))
    assert "age_ms" not in seen[0]
    ages = [-1 if "age_ms" not in each else round(each["age_ms"] * 1e6) for each in seen]
    assert ages == flown.client["age_ns"].tolist()
    plans = [round(each["plan_age_ms"]) for each in seen if "plan_age_ms" in each]
    held = flown.client[flown.client["in_force"] >= 0]
    assert plans == ((held["step"] - held["in_force"]) * 50).tolist()


# -- health ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(Mode))
def test_a_client_is_well_while_it_is_flown_or_could_be(mode: Mode) -> None:
    one = {"mode": str(mode), "missed": 0}
    alone = {"vehicles": 1, "missed": 0, "by_vehicle": {"1": one}}
    several = {"vehicles": 2, "missed": 0, "by_vehicle": {"3": {"mode": "track"}, "1": one}}
    why = "" if mode in (Mode.READY, Mode.TRACK, Mode.COAST) else f"vehicle 1 is in mode {mode}"
    assert (str(mode) in HEALTHY) == (not why)
    assert trouble("client", alone) == trouble("client", several) == why


def test_a_server_is_well_while_it_is_in_time() -> None:
    assert trouble("server", {"degraded": False}) == trouble("netem", {}) == ""
    assert trouble("server", {"degraded": True}) == "it misses more ticks than allowed"


def test_a_process_that_is_stuck_is_not_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its figures become old; before the first figures its state is unknown."""
    collected = Collected("server.1", "demo", 0.05)
    assert collected.health()[0] == "503 Service Unavailable"
    collected.take({"degraded": False})
    well = b'{"process":"server.1","healthy":true,"trouble":""}\n'
    assert collected.health() == ("200 OK", well)
    monkeypatch.setattr(exporter, "FRESH_S", -1.0)
    status, body = collected.health()
    assert status.startswith("503 ")
    assert json.loads(body)["trouble"] == "it has been stuck for 0 s"


# -- HTTP ------------------------------------------------------------------------------------------


@pytest.fixture
def served() -> Iterator[Metrics]:
    with closing(Metrics(("127.0.0.1", 0), Collected("netem", "demo", 0.05))) as one:
        one.take({"flows": 1, **PROCESS})
        yield one


@pytest.fixture
def by_hand(monkeypatch: pytest.MonkeyPatch) -> Iterator[Metrics]:
    """Server without its thread: requests are handled where the test asks."""
    monkeypatch.setattr(Metrics, "serve_forever", lambda *_: None)
    one = Metrics(("127.0.0.1", 0), Collected("netem", "demo", 0.05))
    one.take({"flows": 1, **PROCESS})
    yield one
    one.server_close()


def answered(one: Metrics, request: bytes) -> bytes:
    """What a handler answers; empty if it gives up."""
    here, there = socket.socketpair()
    with here, there:
        there.sendall(request)
        there.shutdown(socket.SHUT_WR)
        with suppress(OSError):
            exporter._Handler(here, ("127.0.0.1", 1), one)
        here.shutdown(socket.SHUT_WR)
        return said(there)


def calling(served: Metrics) -> socket.socket:
    return socket.create_connection(served.address, timeout=180.0)


def said(sock: socket.socket) -> bytes:
    text = b""
    while piece := sock.recv(65536):
        text += piece
    return text


def asked(one: Metrics, request: bytes) -> tuple[bytes, bytes]:
    head, _, body = answered(one, request).partition(b"\r\n\r\n")
    assert b"Content-Length: %d\r\n" % len(body) in head + b"\r\n"
    return head.split(b"\r\n")[0], body


def test_metrics_and_health_are_served(by_hand: Metrics) -> None:
    request = b"GET %s HTTP/1.1\r\nHost: netem:9464\r\nAccept: */*\r\n\r\n"
    status, text = asked(by_hand, request % b"/metrics")
    assert status == b"HTTP/1.0 200 OK"
    assert b"\nskytether_netem_flows 1.0\n" in text
    status, body = asked(by_hand, request % b"/healthz")
    assert (status, json.loads(body)["healthy"]) == (b"HTTP/1.0 200 OK", True)
    by_hand.take({"flows": 2, **PROCESS})
    assert b"\nskytether_netem_flows 2.0\n" in asked(by_hand, request % b"/metrics?name=x")[1]


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"404 Not Found"),
        (b"POST /metrics HTTP/1.1\r\n\r\n", b"405 Method Not Allowed"),
        (b"HEAD /healthz HTTP/1.1\r\n\r\n", b"405 Method Not Allowed"),
        (b"GET / metrics HTTP/1.1\r\n\r\n", b"400 Bad request"),
        (b"\xff\x00 / HTTP/1.1\r\n\r\n", b"405 Method Not Allowed"),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 101, b"431 Too many headers"),
    ],
)
def test_anything_else_is_refused(by_hand: Metrics, request_: bytes, status: bytes) -> None:
    assert asked(by_hand, request_)[0].startswith(b"HTTP/1.0 " + status)


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:9464", b"200 OK"),
        ("[::1]:9464", b"200 OK"),
        ("192.0.2.1", b"200 OK"),
        ("localhost:9464", b"200 OK"),
        ("netem:9464", b"200 OK"),
        ("evil.example:9464", b"403 Forbidden"),
        ("evil.example", b"403 Forbidden"),
        ("127.0.0.1.evil.example", b"403 Forbidden"),
        ("localhost.", b"403 Forbidden"),
        ("", b"403 Forbidden"),
        ("netem:9464\r\nHOST: evil.example", b"403 Forbidden"),
        ("\xff[", b"403 Forbidden"),
    ],
)
def test_who_comes_by_the_name_of_a_website_is_refused(
    by_hand: Metrics, host: str, status: bytes
) -> None:
    """A stranger's name may resolve to this machine; an address or a container's name is safe."""
    request = f"GET /metrics HTTP/1.1\r\nHost: {host}\r\n\r\n".encode("latin-1")
    said_, text = asked(by_hand, request)
    assert said_ == b"HTTP/1.0 " + status
    assert (b"skytether_netem_flows" in text) == (status == b"200 OK")


def test_the_name_that_the_user_has_given_may_be_used(by_hand: Metrics) -> None:
    by_hand._name = "vehicle.fleet.example"
    request = b"GET /metrics HTTP/1.1\r\nHost: %s\r\n\r\n"
    assert asked(by_hand, request % b"Vehicle.fleet.example:9464")[0] == b"HTTP/1.0 200 OK"
    assert asked(by_hand, request % b"other.fleet.example:9464")[0] == b"HTTP/1.0 403 Forbidden"


@pytest.mark.parametrize("path", ["/metrics", "/healthz", "/", "/ HTTP/2"])
def test_no_answer_may_be_shown_in_a_frame(by_hand: Metrics, path: str) -> None:
    answer = answered(by_hand, f"GET {path} HTTP/1.1\r\n\r\n".encode())
    head = answer.partition(b"\r\n\r\n")[0].split(b"\r\n")
    assert b"Content-Security-Policy: frame-ancestors 'none'" in head
    assert b"X-Frame-Options: DENY" in head


@pytest.mark.parametrize(
    "request_", [b"GET /" + b"x" * 8200, b"GET / HTTP/1.1\r\n" + b"a: %100d\r\n" % 1 * 90]
)
def test_a_request_that_is_too_long_is_not_answered(by_hand: Metrics, request_: bytes) -> None:
    assert answered(by_hand, request_) == b""


def test_processes_without_a_table_serve_what_every_process_has() -> None:
    values = numbers("autopilot", {"ticks": 7, **PROCESS})
    assert values["skytether_cpu_seconds_total", ()] == 1.5
    assert values["skytether_unmapped_figures", ()] == 0.0


def test_the_oldest_of_too_many_connections_is_closed(
    by_hand: Metrics, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporter.ThreadingMixIn, "process_request", lambda *_: None)
    pairs = [socket.socketpair() for _ in range(CONNECTIONS_MAX + 2)]
    for _, there in pairs:
        there.setblocking(False)
    for here, _ in pairs:
        by_hand.process_request(here, ("127.0.0.1", 1))
        assert len(by_hand._connections) <= CONNECTIONS_MAX
    assert [is_closed(there) for _, there in pairs] == [True] * 2 + [False] * CONNECTIONS_MAX
    for pair in pairs:
        for each in pair:
            each.close()


def is_closed(there: socket.socket) -> bool:
    try:
        return there.recv(1) == b""
    except BlockingIOError:
        return False


def test_a_connection_is_closed_after_its_time_whether_it_was_answered_or_not(
    by_hand: Metrics, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 1000.0
    monkeypatch.setattr(exporter.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(exporter.ThreadingMixIn, "process_request", lambda *_: None)
    here, there = socket.socketpair()
    there.setblocking(False)
    with here, there:
        by_hand.process_request(here, ("127.0.0.1", 1))
        for after_s, ends in ((exporter.PATIENCE_S - 0.1, False), (exporter.PATIENCE_S, True)):
            now_s = 1000.0 + after_s
            by_hand.service_actions()
            assert is_closed(there) == ends


def test_connections_are_accepted_with_a_rest_before_each(
    by_hand: Metrics, monkeypatch: pytest.MonkeyPatch
) -> None:
    rests: list[float] = []
    monkeypatch.setattr(exporter.time, "sleep", rests.append)
    with calling(by_hand):
        connection, _ = by_hand.get_request()
        connection.close()
    assert rests == [exporter.REST_S]


@pytest.mark.realtime
def test_who_says_nothing_hangs_up_or_sends_byte_by_byte_keeps_nobody_out(served: Metrics) -> None:
    """Over HTTP, in threads."""
    request = b"GET /healthz HTTP/1.1\r\n\r\n"
    silent = [calling(served) for _ in range(CONNECTIONS_MAX + 2)]
    with calling(served) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        sock.sendall(request)
    with calling(served) as sock:
        for byte in request:
            sock.send(bytes([byte]))
        assert said(sock).startswith(b"HTTP/1.0 200 OK\r\n")
    assert said(silent[0]) == b""
    for sock in silent:
        sock.close()


def test_an_address_that_is_taken_is_said_in_a_line(
    served: Metrics, capsys: pytest.CaptureFixture[str]
) -> None:
    from skytether.netem.__main__ import emulate

    host, port = served.address
    argv = ["--bind", "127.0.0.1:0", "--metrics", f"{host}:{port}"]
    assert command.main(emulate, argv, "netem") == command.CONFIGURATION
    said_ = f"netem: --metrics: cannot listen at {host}:{port}: Address already in use\n"
    assert capsys.readouterr().err == said_
    with pytest.raises(MetricsError):
        Metrics(("no.such.invalid", 0), Collected("netem", "demo", 0.05))


def test_the_documented_metrics_exist() -> None:
    text = (ROOT / "docs" / "operating.md").read_text()
    named = set(re.findall(r"`(skytether_\w+)`", text))
    known = {PREFIX + each.name for table in (*TABLES.values(), metrics.OWN) for each in table}
    assert named
    assert named <= known


@pytest.mark.long
@pytest.mark.realtime
def test_each_worker_of_a_server_has_a_feed_and_metrics_of_its_own(tmp_path: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = free.getsockname()[1]
    argv = ["server", "demo", "--bind", "127.0.0.1:0", "--workers", "2", "--log", "json"]
    argv += ["--feed", str(tmp_path / "feed"), "--metrics", f"127.0.0.1:{port}"]
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "skytether", *argv], stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        told = {}
        try:
            while len(told) < 2:
                line = msgspec.json.decode(server.stdout.readline(), type=LogLine)
                if isinstance(line.event, Measured):
                    told[line.process] = line.event.port
            assert told == {"server.1": port, "server.2": port + 1}
            assert sorted(path.name for path in tmp_path.iterdir()) == ["feed.1", "feed.2"]
        finally:
            server.terminate()
            server.communicate()
    assert not list(tmp_path.iterdir())
