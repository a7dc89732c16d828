"""`skytether netem run`: actual programs whose only network is netem."""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from errno import EADDRINUSE
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest

from helpers import SKYTETHER, echo, until
from namespaces import needs_namespaces
from robot import free_port
from skytether.netem.__main__ import emulate_for
from skytether.shared.base.packets import GATEWAY, GATEWAY6
from skytether.shared.base.units import SECOND_NS
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import DOWNLINK, UPLINK
from skytether.shell.commandline.command import CommandError
from skytether.shell.driving.program import GRACE_S
from skytether.shell.host import system

PATIENCE_S = 180.0
PASSED_ON = set(system.passable()) - {signal.SIGTSTP}
"""All but that which stops netem, too."""


def needs(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(shutil.which(name) is None, reason=f"no {name} here")


needs_ping = needs("ping")


def argv(*options: str, of: list[str]) -> list[str]:
    return [*SKYTETHER, "netem", "run", *options, "--", *of]


def ran(*options: str, of: list[str], **more: Any) -> "subprocess.CompletedProcess[str]":
    command = argv(*options, of=of)
    return subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, **more
    )


def python(code: str, *arguments: object) -> list[str]:
    return [sys.executable, "-uc", code, *map(str, arguments)]


def documented(words: str) -> list[list[str]]:
    """Commands of docs/netem.md that contain these words."""
    text = (Path(__file__).parents[2] / "docs" / "netem.md").read_text()
    blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if words in line]
    names = {"skytether": SKYTETHER, "python": (sys.executable,)}
    return [
        [part for word in shlex.split(line) for part in names.get(word, (word,))] for line in lines
    ]


def line_of(process: int) -> str:
    """Command line of a process; empty if it has ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")
    except OSError:
        return ""


def below(process: int) -> list[int]:
    """Processes that a process has started, and those that these have."""
    text = Path(f"/proc/{process}/task/{process}/children").read_text()
    children = list(map(int, text.split()))
    return children + [each for child in children for each in below(child)]


def gone(processes: Iterable[int]) -> bool:
    """Whether they end, within PATIENCE_S."""
    left, until_s = set(processes), time.monotonic() + PATIENCE_S
    while left and time.monotonic() < until_s:
        time.sleep(0.05)
        left = {each for each in left if Path(f"/proc/{each}").exists() and line_of(each)}
    return not left


def test_without_slirp4netns_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    with pytest.raises(CommandError, match="slirp4netns is missing"):
        emulate_for(["--", "true"])


EXPOSED = ("x", "0", "18080:80", "8080:8080", "::8080", "[::1]:8080", "127.0.0.1:8080:80")


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ([], "--"),
        (["--"], "--"),
        (["--mtu", "1279", "--", "true"], "--mtu"),
        (["--mtu", "65521", "--", "true"], "--mtu"),
        (["--path-mtu", "0", "--", "true"], "--path-mtu"),
        *((["--expose", text, "--", "true"], f"--expose: got '{text}'") for text in EXPOSED),
    ],
)
def test_an_impossible_request_is_refused(line: list[str], wrong: str) -> None:
    with pytest.raises(CommandError, match=re.escape(wrong)) as refused:
        emulate_for(line)
    assert refused.value.code == 2


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
class TestProgram:
    def test_streams_folder_and_exit_code_are_the_programs(self, tmp_path: Path) -> None:
        script = "pwd; cat; echo wrong >&2; exit 7"
        run = ran(of=["sh", "-c", script], input="given", cwd=tmp_path)
        assert (run.stdout, run.stderr) == (f"{tmp_path}\ngiven", "wrong\n")
        assert run.returncode == 7

    def test_it_ends_by_the_signal_that_ended_the_program(self) -> None:
        for number in (signal.SIGTERM, signal.SIGKILL):
            run = ran(of=["sh", "-c", f"kill -{number} $$"])
            assert (run.returncode, run.stderr) == (-number, "")

    def test_a_missing_program_is_reported_as_by_a_shell(self) -> None:
        run = ran(of=["no-such-program"])
        assert run.returncode == 127
        assert run.stderr.count("\n") == 1
        assert "no-such-program" in run.stderr

    def test_a_child_that_outlives_the_program_keeps_its_network(self) -> None:
        code = """if 1:
            import os, socket, sys, time
            if os.fork():
                sys.exit(3)
            time.sleep(1)
            client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            client.settimeout(120)
            client.connect((sys.argv[1], int(sys.argv[2])))
            client.send(b"late")
            print(client.recv(100))"""
        with echo() as port:
            run = ran(of=python(code, GATEWAY, port))
        assert (run.stdout, run.returncode) == ("b'late'\n", 3)

    def test_a_signal_reaches_the_program_once(self) -> None:
        code = """if 1:
            import signal, sys
            for number in map(int, sys.argv[1:]):
                signal.signal(number, lambda number, _: print(int(number)))
            print("up")
            while True:
                signal.pause()"""
        numbers = [*map(int, PASSED_ON)]
        with subprocess.Popen(
            argv(of=python(code, *numbers)),
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as run:
            assert run.stdout is not None
            assert run.stdout.readline() == "up\n"
            for number in numbers:
                run.send_signal(number)  # as by kill
                assert run.stdout.readline() == f"{number}\n"
                os.killpg(run.pid, number)  # as by a terminal
                assert run.stdout.readline() == f"{number}\n"
            run.kill()
            assert run.stdout.read() == ""

    def test_netem_stops_and_goes_on_with_the_program(self) -> None:
        code = """if 1:
            import signal
            for number in (signal.SIGTSTP, signal.SIGCONT):
                signal.signal(number, lambda number, _: print(int(number)))
            print("up")
            while True:
                signal.pause()"""
        with subprocess.Popen(argv(of=python(code)), stdout=subprocess.PIPE, text=True) as run:
            assert run.stdout is not None
            assert run.stdout.readline() == "up\n"
            run.send_signal(signal.SIGTSTP)
            assert run.stdout.readline() == f"{int(signal.SIGTSTP)}\n"
            _, status = os.waitpid(run.pid, os.WUNTRACED)
            assert os.WIFSTOPPED(status)
            run.send_signal(signal.SIGCONT)
            assert run.stdout.readline() == f"{int(signal.SIGCONT)}\n"
            run.kill()

    def test_a_run_within_a_run_has_a_network(self) -> None:
        code = """if 1:
            import socket, sys
            client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            client.settimeout(120)
            client.connect((sys.argv[1], int(sys.argv[2])))
            client.send(b"from inside")
            print(client.recv(100))"""
        serving = """if 1:
            import socket, subprocess, sys
            server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            server.bind(("127.0.0.1", 5000))
            inner = subprocess.Popen(sys.argv[1:])
            server.sendto(*server.recvfrom(100))
            sys.exit(inner.wait())"""
        inner = argv(of=python(code, GATEWAY, 5000))
        run = ran(of=python(serving, *inner))
        assert (run.stdout, run.returncode) == ("b'from inside'\n", 0), run.stderr

    def test_under_nohup_it_outlives_its_parent(self, tmp_path: Path) -> None:
        program = f"echo up; while [ ! -e {tmp_path}/go ]; do sleep 0.05; done; echo on"
        line = shlex.join(argv(of=["sh", "-c", program]))
        script = f"nohup {line} > {tmp_path}/said 2>&1 & echo $!; read -r _"
        said = tmp_path / "said"
        with subprocess.Popen(
            ["sh", "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as parent:
            until(lambda: said.exists() and "up\n" in said.read_text())
        time.sleep(1.5 * GRACE_S)
        (tmp_path / "go").touch()
        until(lambda: said.read_text() == "up\non\n")
        assert parent.returncode is not None

    def test_the_kernel_sends_nothing_by_itself(self, tmp_path: Path) -> None:
        ran("--json", str(tmp_path / "counted"), of=["sleep", "2"])
        counted = json.loads((tmp_path / "counted").read_bytes())
        assert counted["to_program"]["packets"] == counted["from_program"]["packets"] == 0


@pytest.mark.realtime
@needs_namespaces
class TestTunnel:
    @pytest.mark.parametrize("hosts", [("127.0.0.1", GATEWAY), ("::1", GATEWAY6)])
    def test_datagrams_of_all_sizes_come_back(self, hosts: tuple[str, object]) -> None:
        host, seen_as = hosts
        # slirp4netns does not put fragments of IPv6 together
        sizes = (0, 1, 1400) if ":" in host else (0, 1, 1472, 1473, 9000)
        code = """if 1:
            import socket, sys
            host, port, *sizes = sys.argv[1:]
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            client = socket.socket(family, socket.SOCK_DGRAM)
            client.settimeout(120)
            client.connect((host, int(port)))
            for size in map(int, sizes):
                client.send(b"x" * size)
                print(len(client.recv(65536)))"""
        try:
            with echo(host) as port:
                run = ran(of=python(code, seen_as, port, *sizes))
        except OSError:
            pytest.skip("no IPv6 loopback")
        assert run.stdout.split() == [str(size) for size in sizes], run.stderr


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
class TestNetwork:
    def test_a_file_comes_over_http_as_it_is(self, tmp_path: Path) -> None:
        content = os.urandom(300_000)

        class Page(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, *_: object) -> None: ...

        code = """if 1:
            import sys, urllib.request
            with urllib.request.urlopen(sys.argv[1], timeout=120) as page:
                open(sys.argv[2], "wb").write(page.read())"""
        with ThreadingHTTPServer(("127.0.0.1", 0), Page) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            url = f"http://{GATEWAY}:{server.server_port}/"
            air = "constant(0.02) & loss(0.02)"
            options = ("--to-program", air, "--from-program", air, "--path-mtu", "1300")
            run = ran(*options, of=python(code, url, tmp_path / "came"))
            server.shutdown()
        assert run.returncode == 0, run.stderr
        assert (tmp_path / "came").read_bytes() == content

    def test_a_program_that_sends_alike_meets_the_same_fates(self, tmp_path: Path) -> None:
        code = """if 1:
            import socket, sys, time
            client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            for number in range(300):
                client.sendto(b"%d" % number, (sys.argv[1], int(sys.argv[2])))
                time.sleep(0.002)"""
        air = "uniform(0, 0.02) & loss(0.3)"
        met = []
        with echo() as port:
            for run, seed in enumerate((7, 7, 8)):
                record = tmp_path / str(run)
                options = ("--from-program", air, "--seed", str(seed), "--record", str(record))
                ran(*options, of=python(code, GATEWAY, port))
                rows = read(record)
                # Answers to a closed port get an ICMP error of the kernel, which is another flow.
                rows = rows[(rows["direction"] == DOWNLINK) & (rows["flow"] == 0)]
                fates = zip(rows["lost"].tolist(), rows["delay_ns"].tolist(), strict=True)
                met.append(dict(zip(rows["number"].tolist(), fates, strict=True)))
        one, same, other = met
        both = one.keys() & same.keys()
        assert any(is_lost for is_lost, _ in one.values())
        assert {number: one[number] for number in both} == {number: same[number] for number in both}
        assert any(one[number] != other.get(number) for number in one)

    def test_the_network_changes_while_the_program_runs(self, tmp_path: Path) -> None:
        code = """if 1:
            import socket, sys
            client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            client.settimeout(0.2)
            client.connect((sys.argv[1], int(sys.argv[2])))
            print("up")
            for _ in range(600):
                client.send(b"?")
                try:
                    sys.exit(client.recv(100) != b"?")
                except TimeoutError:
                    pass
            sys.exit("no answer")"""
        control = tmp_path / "control"
        with echo() as port:
            line = argv(
                *("--from-program", "loss(1)", "--control", str(control)),
                of=python(code, GATEWAY, port),
            )
            with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as run:
                assert run.stdout is not None
                assert run.stdout.readline() == "up\n"
                change = [*SKYTETHER, "set", str(control), "from_program=none"]
                subprocess.run(change, check=True, timeout=PATIENCE_S, capture_output=True)
                assert run.wait(PATIENCE_S) == 0

    def test_the_outside_reaches_a_server_at_an_exposed_port(self) -> None:
        code = """if 1:
            import socket, sys
            with socket.create_server(("", int(sys.argv[1]))) as server:
                print("up")
                connection, _ = server.accept()
                connection.sendall(connection.recv(100).upper())"""
        port = free_port()
        line = argv("--expose", str(port), of=python(code, port))
        with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as run:
            assert run.stdout is not None
            assert run.stdout.readline() == "up\n"
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as client:
                client.sendall(b"hello")
                assert client.recv(100) == b"HELLO"
            assert run.wait(PATIENCE_S) == 0

    def test_a_port_that_cannot_be_exposed_is_told_with_the_reason(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            run = ran("--expose", f"localhost:{port}", of=["true"])
        assert run.stdout == ""
        assert run.returncode == 1
        assert f"127.0.0.1:{port} (tcp): {os.strerror(EADDRINUSE)}" in run.stderr

    def test_a_packet_too_long_for_the_path_is_an_error_of_the_program(self) -> None:
        code = """if 1:
            import errno, socket, sys
            client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            client.settimeout(120)
            client.connect((sys.argv[1], int(sys.argv[2])))
            client.setsockopt(socket.IPPROTO_IP, 10, 2)  # IP_MTU_DISCOVER: do not fragment
            try:
                client.send(bytes(1400))
                client.recv(2000)
            except OSError as error:
                print(errno.errorcode[error.errno])
            print(client.getsockopt(socket.IPPROTO_IP, 14))  # IP_MTU"""
        with echo() as port:
            run = ran("--path-mtu", "1300", of=python(code, GATEWAY, port))
        assert run.stdout.split() == ["EMSGSIZE", "1300"], run.stderr

    def test_what_a_program_sent_last_still_arrives(self) -> None:
        code = """if 1:
            import socket, sys
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(
                b"bye", (sys.argv[1], int(sys.argv[2])))"""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
            server.bind(("127.0.0.1", 0))
            server.settimeout(PATIENCE_S)
            ran(
                "--from-program", "constant(0.5)", of=python(code, GATEWAY, server.getsockname()[1])
            )
            assert server.recv(100) == b"bye"

    def test_programs_find_each_other_by_multicast(self) -> None:
        code = """if 1:
            import os, socket, struct
            def member():
                heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                heard.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                heard.bind(("", 7400))
                group = struct.pack("4s4x", socket.inet_aton("239.255.0.1"))
                heard.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
                heard.settimeout(120)
                return heard
            one, other = member(), member()
            if not os.fork():
                print(other.recv(100))
                os._exit(0)
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b"here", ("239.255.0.1", 7400))
            print(one.recv(100))
            os.wait()"""
        run = ran(of=python(code))
        assert run.stdout.count("b'here'") == 2, run.stderr


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
class TestPrograms:
    """Programs of others, as they are."""

    @needs("iperf3")
    @pytest.mark.parametrize(
        ("way", "options"),
        [
            ("from-program", ("--udp", "--bitrate", "4M", "--length", "1400")),
            ("to-program", ("--udp", "--bitrate", "4M", "--length", "1400", "--reverse")),
            ("from-program", ()),
        ],
    )
    def test_iperf3_gets_the_rate_of_the_network(
        self, tmp_path: Path, way: str, options: tuple[str, ...]
    ) -> None:
        rate, record = 125_000, tmp_path / "netem"
        port = str(free_port())
        at = ("--bind", "127.0.0.1", "--port", port)
        serve = ["iperf3", "--server", "--one-off", *at, "--forceflush"]
        client = ["iperf3", "--client", str(GATEWAY), "--port", port, "--bytes", "300K", "--json"]
        with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            until(lambda: "listening" in server.stdout.readline())
            run = ran(
                *(f"--{way}", f"rate({rate}, queue=1000000)", "--record", str(record)),
                of=[*client, *options],
            )
            server.terminate()
        assert json.loads(run.stdout)["end"]
        rows = read(record)
        rows = rows[rows["direction"] == (DOWNLINK if way == "from-program" else UPLINK)]
        rows = rows[rows["bytes"] > 1000]
        assert len(rows) > 1
        left_ns = np.sort(rows["arrived_ns"] + rows["delay_ns"])
        # A sender that pauses makes it slower; nothing makes it faster.
        assert np.diff(left_ns).min() >= 0.99 * rows["bytes"].min() / rate * SECOND_NS


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
class TestDocument:
    """Commands of docs/netem.md."""

    @needs_ping
    def test_the_pings_of_the_document(self) -> None:
        for line in documented("-- ping -c 20"):
            run = subprocess.run(
                line, capture_output=True, text=True, timeout=PATIENCE_S, check=False
            )
            assert "20 packets transmitted" in run.stdout, run.stderr

    def test_the_server_of_the_document(self, tmp_path: Path) -> None:
        (line,) = documented("--expose 8080")
        port = free_port()
        line = [re.sub("8080", str(port), word) for word in line]
        with subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.DEVNULL) as run:

            def answer() -> bool:
                with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/", timeout=5) as page:
                    return page.status == 200
                return False

            until(answer)
            run.terminate()

    @needs_ping
    def test_the_changes_of_the_document(self, tmp_path: Path) -> None:
        (line,) = documented("-c 40")
        (tmp_path / "air").mkdir()
        with subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as run:
            until((tmp_path / "air" / "netem").exists)
            (change,) = documented("skytether set")
            subprocess.run(change, cwd=tmp_path, check=True, timeout=PATIENCE_S)
            assert run.stdout is not None
            assert "40 packets transmitted" in run.stdout.read()
        (export,) = documented("skytether export")
        subprocess.run(export, cwd=tmp_path, check=True, timeout=PATIENCE_S)
        assert (tmp_path / "tables" / "netem.csv").exists()
        capture = (tmp_path / "pinged.pcap").read_bytes()
        assert struct.unpack_from("<I", capture, 36) == (84,)  # an echo of ping, as IP has it


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
class TestEnd:
    """Whatever is killed, no process is left, and so no namespace and no device."""

    @contextmanager
    def running(self) -> Iterator[tuple["subprocess.Popen[str]", list[int]]]:
        """Program with a child that nothing but SIGKILL ends, in a session of its own; and all
        processes below netem.
        """
        script = "(trap '' HUP INT TERM; setsid sleep 1000) & echo up; sleep 1000"
        with subprocess.Popen(
            argv(of=["sh", "-c", script]),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as run:
            assert run.stdout is not None
            assert run.stdout.readline() == "up\n"
            try:
                yield run, below(run.pid)
            finally:
                run.kill()

    def test_netem_is_killed(self) -> None:
        with self.running() as (run, processes):
            run.kill()
            assert gone(processes)

    @pytest.mark.parametrize(
        "begins",
        [
            r"\S*python\S* -P -m skytether.shell.driving.inside",
            r"\S*slirp4netns",
            r"sh -c \nulimit",
        ],
    )
    def test_another_process_is_killed(self, begins: str) -> None:
        with self.running() as (run, processes):
            victim = next(each for each in processes if re.match(begins, line_of(each)))
            os.kill(victim, signal.SIGKILL)
            assert gone(processes)
            assert run.wait(PATIENCE_S) == 1
            assert run.stderr is not None
            assert run.stderr.read().count("\n") == 1

    def test_ctrl_c_ends_what_the_program_left(self) -> None:
        with self.running() as (run, processes):
            until_s = time.monotonic() + PATIENCE_S
            while run.poll() is None and time.monotonic() < until_s:
                os.killpg(run.pid, signal.SIGINT)
                time.sleep(0.2)
            assert run.returncode == -signal.SIGINT
            assert gone(processes)

    def test_its_parent_ends(self) -> None:
        line = argv(of=["sh", "-c", "trap '' HUP; echo up; sleep 1000"])
        with subprocess.Popen(
            # Whoever runs the tests under `nohup` ignores SIGHUP.
            python(
                "import signal, subprocess, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
                "subprocess.run(sys.argv[1:])",
                *line,
            ),
            stdout=subprocess.PIPE,
            text=True,
        ) as parent:
            assert parent.stdout is not None
            assert parent.stdout.readline() == "up\n"
            processes = below(parent.pid)
            parent.kill()
            assert gone(processes)
