"""Netem for any program: the examples of docs/network.md, and of docs/netem.md those without a
namespace, with real programs on loopback.
"""

import json
import re
import shlex
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any
from urllib.request import urlopen

import msgspec
import numpy as np
import pytest

import skytether
import skytether.cli.set
from helpers import PATIENCE_S, packaged, until
from skytether.__main__ import main
from skytether.netem.__main__ import NetemOptions, _with_directions
from skytether.netem.proxy import Proxy
from skytether.netem.relay import Relay
from skytether.shared.base.units import HEADER_BYTES, MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.change import Answer, Running
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.other_directions import NAMES, RELAY, RUN
from skytether.shared.formats.recorded import recorded_in
from skytether.shared.scenario.reading import load
from skytether.shared.scenario.registry import File
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, PACKET_COLUMNS, UPLINK
from skytether.shell.commandline.command import parse
from skytether.shell.driving.control import answer_of
from skytether.shell.host.udp import leads_back
from skytether.shell.processes.metrics import families
from skytether.shell.processes.process import Process
from skytether.view.recordings import traffic
from skytether.view.rows import readable

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "network.md").read_text()
BLOCKS = [
    block.splitlines()
    for text in (TEXT, (ROOT / "docs" / "netem.md").read_text())
    for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
]


def block(word: str) -> list[str]:
    (found,) = [lines for lines in BLOCKS if any(word in line for line in lines)]
    ports: dict[str, str] = {}
    for port in re.findall(r"(?<=127\.0\.0\.1:)\d+|(?<=-port )\d+", "\n".join(found)):
        if port not in ports:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind(("127.0.0.1", 0))
                ports[port] = str(free.getsockname()[1])
    return [_with_ports(line, ports) for line in found]


def _with_ports(text: str, ports: dict[str, str]) -> str:
    return re.sub(r"\b\d{4,5}\b", lambda found: ports.get(found[0], found[0]), text)


def argv(line: str) -> list[str]:
    name, *rest = shlex.split(line)
    if name == "skytether":
        return [sys.executable, "-P", "-m", "skytether", *rest]
    return [sys.executable if name == "python" else name, *rest]


@contextmanager
def running(line: str, folder: Path, until: str = "") -> Iterator["subprocess.Popen[str]"]:
    """Running command, once it has printed the expected text; ended by Ctrl-C."""
    with subprocess.Popen(
        argv(line),
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            if until:
                assert process.stdout is not None
                assert any(until in said for said in process.stdout), line
            yield process
        finally:
            process.terminate()


def counted(said: str, name: str) -> tuple[int, int]:
    """Counters of netem to the client and to the server, printed at its end."""
    found = re.search(rf"  {name} +(\d+) +(\d+)$", said, re.MULTILINE)
    assert found, said
    return int(found[1]), int(found[2])


def ended(process: "subprocess.Popen[str]") -> str:
    process.terminate()
    return process.communicate(timeout=PATIENCE_S)[0]


@pytest.mark.realtime
@pytest.mark.long
def test_two_programs_of_ones_own(tmp_path: Path) -> None:
    echo, netem, ask = block("ask.py")
    ports = dict(zip(("5001", "5000"), re.findall(r"127\.0\.0\.1:(\d+)", netem), strict=True))
    for code in re.findall(r"```python\n# (\w+\.py)\n(.*?)```", TEXT, re.DOTALL):
        (tmp_path / code[0]).write_text(_with_ports(code[1], ports))
    with running(echo, tmp_path), running(netem, tmp_path, "listening") as relay:
        done = subprocess.run(
            argv(ask), cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=True
        )
        said = ended(relay)
    found = re.fullmatch(r"(\d+) lost, round trip (\d+) ms\n", done.stdout)
    assert found, done.stdout
    assert 1 <= int(found[1]) < 100
    assert int(found[2]) >= 50  # netem's delay: never earlier
    assert min(counted(said, "packets")) > 0
    assert counted(said, "lost")[1] > 0


@pytest.mark.realtime
@pytest.mark.long
def test_connections_of_tcp_are_relayed(tmp_path: Path) -> None:
    server, netem, curl = block("--tcp")
    (tmp_path / "here").touch()
    url = shlex.split(curl)[-1]
    with running(server, tmp_path), running(netem, tmp_path, "listening") as relay:

        def came() -> bool:
            with suppress(OSError), urlopen(url, timeout=PATIENCE_S) as page:
                return b"here" in page.read()
            return False

        until(came)
        said = ended(relay)
    up, down = counted(said, "forwarded")
    assert up > 1  # pieces, and an end of each direction
    assert down > 1
    assert counted(said, "lost") == (0, 0)


@pytest.mark.realtime
@pytest.mark.long
@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs OpenSSL's program")
def test_dtls_gets_through(tmp_path: Path) -> None:
    server, netem, client = block("openssl")
    with (
        running(server, tmp_path) as far,
        running(netem, tmp_path, "listening"),
        running(client, tmp_path) as near,
    ):
        assert near.stdin is not None
        assert far.stdout is not None
        told: Queue[str] = Queue()
        # A line may be lost, so reading must not block the next one.
        Thread(
            target=lambda lines: list(map(told.put, lines)), args=[far.stdout], daemon=True
        ).start()
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            near.stdin.write("hello through netem\n")
            near.stdin.flush()
            with suppress(Empty):
                if "hello through netem" in told.get(timeout=0.5):
                    return
    pytest.fail("no line came through")


@pytest.mark.realtime
@pytest.mark.long
def test_changes_and_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    netem, *changes = block("netem.sock")
    with running(netem, tmp_path, "listening"):
        for line in changes:
            assert main(shlex.split(line)[1:]) == 0
    said = capsys.readouterr().out
    assert 'to_server is "loss(0.6)" from now on, it was "loss(0.1)"' in said
    assert 'to_client is "constant(0.1) & rate(12500, queue=20000)" from now on' in said
    netem, export = block("passed.mcap")
    with running(netem, tmp_path, "listening") as relay:
        port = int(re.findall(r"127\.0\.0\.1:(\d+)", netem)[0])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            for _ in range(60):
                client.sendto(bytes(40), ("127.0.0.1", port))
                time.sleep(0.005)
        time.sleep(0.5)
        ended(relay)
    assert main(shlex.split(export)[1:]) == 0
    found = recorded_in(File("it", (tmp_path / "traces" / "to_server-0.csv").read_bytes()))
    assert 0 < found.lost.sum() < len(found.time_s) <= 60
    assert found.delay_s.min() >= 0.01
    passed = captured((tmp_path / "passed.pcap").read_bytes())
    assert len(passed) == len(found.time_s) - found.lost.sum()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--to-client", "los(1)"], "--to-client: got 'los(1)'"),
        (["--to-server", "loss(2)"], "expected loss(share) with 0 <= share <= 1"),
        (
            ["--to-server", "trace(none.csv)"],
            "none.csv', expected a file that can be read (No such file",
        ),
    ],
)
def test_a_wrong_direction_is_told_in_a_line(
    flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["netem", "--bind", "127.0.0.1:0", *flags]) == 2
    output = capsys.readouterr().err
    assert said in output
    assert output.count("\n") == 1


def directed(**given: Any) -> Scenario:
    return _with_directions(parse(NetemOptions(**given), [], "netem", None, is_final=False)).config


@pytest.mark.parametrize("text", ["corrupt(50%) & duplicate(50%)", "rate(1mbit, drop=codel)"])
def test_what_acts_on_packets_alone_is_refused_for_streams(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["netem", "--tcp", "--bind", "127.0.0.1:0", "--to-client", text]) == 2
    said = capsys.readouterr().err
    assert said.startswith("netem: --to-client: got ")
    assert "skytether netem run" in said
    to = ("127.0.0.1", 5000)
    with pytest.raises(skytether.ConfigError, match="to_server"):
        skytether.bad_network(to_server=text, to=to, tcp=True)
    scenario = directed(tcp=True, to_client="ordered & loss(0.1) & rate(1mbit)")
    with pytest.raises(skytether.ConfigError, match="to_client"):
        Running(Relay(scenario, server=to), scenario).change({"to_client": text}, now_ns=0)
    assert directed(to_client=text).network.uplink == text


def test_without_a_scenario_netem_changes_nothing() -> None:
    scenario = directed()
    assert scenario.network.mtu == 65_507
    for path in (scenario.uplink, scenario.downlink):
        assert [name for name, _ in path.parts] == ["none"]
        assert path.queue is None


def test_each_flag_changes_its_own_direction_of_the_scenario() -> None:
    network, demo = directed(scenario="demo", to_client="loss(10%)").network, load("demo").network
    assert (network.uplink, network.downlink) == ("loss(10%)", demo.downlink)
    assert directed(to_server="loss(0.2)").downlink.loss == 0.2


def test_netem_emulates_the_path_that_it_is_told() -> None:
    flown = load("demo-two-links")
    assert directed(scenario="demo-two-links") == flown.on_path(0)
    second = directed(scenario="demo-two-links", path=2, to_server="loss(0.5)")
    assert (second.seed, second.uplink.mean_s) == (flown.on_path(1).seed, pytest.approx(0.1))
    assert (second.downlink.loss, second.downlink.mean_s) == (0.5, 0.0)
    to_standby = directed(scenario="demo-two-links", path=3)
    assert (to_standby.seed, to_standby.uplink.mean_s) == (
        flown.on_path(2).seed,
        flown.on_path(0).uplink.mean_s,
    )


@pytest.mark.parametrize(("scenario", "path"), [("demo", 3), ("demo-two-links", 4), ("demo", 0)])
def test_a_path_that_the_scenario_lacks_is_refused(
    scenario: str, path: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["netem", scenario, "--bind", "127.0.0.1:0", "--path", str(path)]) == 2
    assert f"--path: got {path}," in capsys.readouterr().err


def test_the_impairments_of_one_path_change_while_netem_runs() -> None:
    scenario = load("demo-two-links").on_path(1)
    proxy = Proxy(scenario, server=("server", 1), path=1)
    (changed,) = Running(proxy, scenario).change({"network.uplink": "loss(1)"}, now_ns=0)
    assert (changed.key, changed.after) == ("network.uplink", '"loss(1)"')


@pytest.mark.parametrize("text", ["constant(100)", "loss(1)"])
def test_a_network_that_nobody_could_fly_over_is_for_other_programs(text: str) -> None:
    scenario = directed(to_client=text)
    proxy = Proxy(scenario, server=("server", 1))
    Running(proxy, scenario).change({"network.downlink": text}, now_ns=0)


def test_a_change_shows_at_once_and_a_wrong_one_changes_nothing() -> None:
    scenario = packaged("demo", network={"uplink": "none", "downlink": "loss(0.1)"})
    proxy = Proxy(scenario, server=("server", 1))
    running_ = Running(proxy, scenario)

    def lost_in(seconds: range) -> float:
        before = proxy.downlink.counts.lost
        times_ns = [second * SECOND_NS + part * MILLISECOND_NS
                    for second in seconds for part in range(0, 1000, 5)]  # fmt: skip
        for now_ns in times_ns:
            proxy.receive(Datagram(b"x", ("client", 1)), now_ns=now_ns)
        return (proxy.downlink.counts.lost - before) / len(times_ns)

    def ask(text: str) -> dict[str, object]:
        answer: dict[str, object] = msgspec.json.decode(
            running_.answer(msgspec.json.encode({"network.downlink": text}), now_ns=10 * SECOND_NS)
        )
        return answer

    assert lost_in(range(10)) == pytest.approx(0.1, abs=0.03)
    assert "refused" not in ask("loss(0.6)")
    assert lost_in(range(10, 12)) == pytest.approx(0.6, abs=0.08)
    assert "did you mean loss?" in str(ask("los(0.1)")["refused"])
    assert "no such key" in running_.answer(b'{"network.sidelink": "none"}', now_ns=0).decode()
    assert lost_in(range(12, 14)) == pytest.approx(0.6, abs=0.08)


def captured(content: bytes) -> list[tuple[int, bytes, bytes, int]]:
    """Packets of a capture: time [ns], addresses of source and target, UDP payload [B]."""
    magic, major, minor, _, _, kept, kind = struct.unpack_from("<IHHiIII", content)
    assert (magic, major, minor, kept, kind) == (0xA1B23C4D, 2, 4, HEADER_BYTES, 101)
    found, at = [], 24
    while at < len(content):
        seconds, rest_ns, held, size = struct.unpack_from("<IIII", content, at)
        header = content[at + 16 : at + 16 + held]
        assert sum(struct.unpack(">10H", header[:20])) % 0xFFFF == 0  # checksum
        assert struct.unpack_from(">H", header, 2)[0] == size
        assert struct.unpack_from(">H", header, 24)[0] == size - 20
        found.append(
            (seconds * SECOND_NS + rest_ns, header[12:16], header[16:20], size - HEADER_BYTES)
        )
        at += 16 + held
    return found


def test_a_capture_has_what_came_out() -> None:
    rows = np.zeros(4, PACKET_COLUMNS)
    rows["direction"] = [UPLINK, DOWNLINK, DOWNLINK, DOWNLINK]
    rows["flow"], rows["bytes"] = [0, 0, 300, 0], [100, 7, 1400, 5]
    rows["arrived_ns"], rows["delay_ns"] = [5, 1, 2, 3], [10, 20, 1, 1]
    rows["lost"] = [False, False, False, True]
    packets = captured(traffic.pcap(rows, began_ns=SECOND_NS))
    assert [time_ns - SECOND_NS for time_ns, *_ in packets] == [3, 15, 21]
    assert [size for *_, size in packets] == [1400, 100, 7]
    assert packets[0][1] == bytes((10, 0, 1, 45))
    assert packets[1][1:3] == (traffic.SERVER, bytes((10, 0, 0, 1)))


def test_packets_of_ip_keep_their_sizes_in_a_capture() -> None:
    rows = np.zeros(2, PACKET_COLUMNS)
    rows["bytes"] = [20, 1500]  # the first is shorter than the headers of IP and UDP
    content = traffic.pcap(rows, header_bytes=0)
    assert struct.unpack_from("<II", content, 32) == (20, 20)
    assert struct.unpack_from("<II", content, 60 + 8) == (28, 1500)
    assert len(content) == 24 + 16 + 20 + 16 + 28


def test_packets_of_another_path_are_apart_in_captures_and_traces() -> None:
    rows = np.zeros(2, PACKET_COLUMNS)
    rows["direction"], rows["path"] = DOWNLINK, [0, 1]
    assert set(traffic.traces(rows)) == {"downlink-0", "downlink-0-path-2"}
    clients = [client for _, client, *_ in captured(traffic.pcap(rows))]
    assert clients == [bytes((10, 0, 0, 1)), bytes((10, 1, 0, 1))]


def test_a_recording_becomes_the_trace_of_each_flow(tmp_path: Path) -> None:
    rows = np.zeros(5, PACKET_COLUMNS)
    rows["direction"], rows["flow"] = DOWNLINK, [0, 0, 0, 1, 0]
    rows["arrived_ns"] = np.array([2, 1, 3, 9, 3]) * SECOND_NS
    rows["delay_ns"] = np.array([0.2, 0.1, 0.3, 0.9, 0.4]) * SECOND_NS
    rows["lost"] = [True, False, False, False, False]
    made = traffic.traces(rows)
    assert set(made) == {"downlink-0", "downlink-1"}
    (tmp_path / "a.csv").write_text(made["downlink-0"])
    found = recorded_in(File("it", (tmp_path / "a.csv").read_bytes()))
    assert found.time_s.tolist() == [0.0, 1.0, 2.0]
    assert found.lost.tolist() == [False, True, False]
    assert found.delay_s.tolist() == [0.1, 0.2, 0.3]


@pytest.mark.parametrize(
    ("bind", "server"),
    [
        ("127.0.0.1:47600", "127.0.0.1:47600"),
        ("127.0.0.1:47600", "localhost:47600"),
        ("localhost:47600", "0.0.0.0:47600"),
        ("0.0.0.0:47600", "127.0.0.1:47600"),
        ("0.0.0.0:47600", "127.0.0.7:47600"),
        pytest.param("[::]:47600", "[::1]:47600", marks=pytest.mark.ipv6),
    ],
)
def test_netem_is_not_its_own_server(
    bind: str, server: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["netem", "--bind", bind, "--server", server]) == 2
    said = f"--server: got {server}, which is netem itself; expected the address of a server"
    assert said in capfd.readouterr().err


@pytest.mark.parametrize(
    ("server", "bind"),
    [
        (("127.0.0.1", 47601), ("127.0.0.1", 47600)),
        (("127.0.0.2", 47600), ("127.0.0.1", 47600)),
        (("192.0.2.1", 47600), ("0.0.0.0", 47600)),
        (("127.0.0.1", 47600), ("::1", 47600)),
    ],
)
def test_other_servers_do_not_lead_back(server: Address, bind: Address) -> None:
    assert not leads_back(server, bind)


WAYS = [("transparent", RELAY), ("demo", FLIGHT)]


@pytest.mark.parametrize(("scenario", "ways"), WAYS)
def test_a_relay_names_its_directions_by_their_ends_and_a_flight_as_modems_do(
    scenario: str, ways: Directions, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven: list[Any] = []
    monkeypatch.setattr(Process, "drive", lambda _, endpoint, **__: driven.append(endpoint))
    assert main(["netem", scenario, "--bind", "127.0.0.1:0"]) == 0
    (proxy,) = driven
    assert {*ways} <= proxy.figures().keys()


def test_changes_of_a_relay_are_asked_for_and_told_by_its_own_names() -> None:
    scenario = directed(to_server="loss(0.1)")
    relay = Proxy(scenario, server=("server", 1), directions=RELAY)
    running_ = Running(relay, scenario)
    assert json.loads(running_.answer(b"{}", now_ns=0))["names"] == NAMES[RELAY]
    (changed,) = running_.change({"to_server.loss": 0.3}, now_ns=0)
    assert (changed.key, changed.name) == ("network.downlink", "to_server")
    assert str(changed).startswith("to_server is")
    for wrong in ({"to_client": "los(1)"}, {"to_client.los": 1.0}, {"to_cliet": "none"}):
        with pytest.raises(skytether.ConfigError, match="to_client") as refused:
            running_.change(wrong, now_ns=0)
        assert "link" not in str(refused.value)
    assert relay.downlink.impairments.loss == 0.3


def test_set_lists_the_names_of_a_relay(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = directed()
    running_ = Running(Proxy(scenario, server=("server", 1), directions=RELAY), scenario)

    class Caller:
        def __init__(self, _: Path) -> None:
            """Reach the process at once."""

        def ask(self, values: dict[str, Any]) -> Answer:
            return answer_of(running_.answer(msgspec.json.encode(values), now_ns=0))

        def close(self) -> None:
            """Leave nothing behind."""

    monkeypatch.setattr(skytether.cli.set, "Caller", Caller)
    assert main(["set", "netem.sock", "to_server=loss(0.2)"]) == 0
    assert main(["set", "netem.sock"]) == 0
    _, *listed = capsys.readouterr().out.splitlines()
    assert listed == ['to_server = "loss(0.2)"', 'to_client = "none"']


def test_metrics_and_tables_have_the_names_of_a_relay() -> None:
    relay = Proxy(directed(), server=("server", 1), directions=RELAY)
    exposed, unknown = families("netem", relay.figures())
    labels = {each.labels.get("direction") for family in exposed for each in family.samples}
    assert labels >= {*RELAY}
    assert not labels & {*FLIGHT}
    assert not unknown
    rows = np.zeros(2, PACKET_COLUMNS)
    rows["direction"] = [UPLINK, DOWNLINK]
    assert readable(rows, RELAY)["direction"].tolist() == [*RELAY]
    assert {name.partition("-")[0] for name in traffic.traces(rows, RELAY)} == {*RELAY}


@pytest.mark.parametrize(("command", "ways"), [([], RELAY), (["run"], RUN)])
def test_options_are_named_by_the_ends(
    command: list[str], ways: Directions, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["netem", *command, "--help"])
    said = capsys.readouterr().out
    assert all(f"--{way.replace('_', '-')}" in said for way in ways)
    assert not any(f"--{way} " in said for way in FLIGHT)
