"""Socket of `--control`, and `skytether set`, which uses it."""

import asyncio
import os
import random
import socket
import stat
import tempfile
import threading
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest

import skytether.shell.driving.control
from helpers import LOOPBACK, HandLoop
from skytether.cli.set import set_keys
from skytether.netem.proxy import Proxy
from skytether.shared.endpoints.change import Running
from skytether.shared.events.flight import Changed, ChangeRefused, Event
from skytether.shared.scenario import reading, schema
from skytether.shell.commandline import command
from skytether.shell.commandline.options import toml_value
from skytether.shell.driving.control import REST_S, RESTS, Caller, Control, ControlError, controlled
from skytether.shell.driving.driver import Shell, run
from skytether.shell.driving.journal import take_up
from skytether.shell.host.local import LocalError
from virtual_loop import virtually

DEMO = reading.load("demo")


class Closing(Proxy):
    finished = False

    def change(self, scenario: schema.Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        super().change(scenario, keys, now_ns=now_ns)
        self.finished = scenario.uplink.loss == 1.0


def running() -> Running:
    return Running(Proxy(DEMO, server=("server", 0)), DEMO)


def heeding(control: Control) -> tuple[HandLoop, list[None]]:
    """Loop that serves requests, and a list that grows with each."""
    loop, heeded = HandLoop(), []  # type: ignore[var-annotated]
    control.begin(loop, lambda: heeded.append(None))  # type: ignore[arg-type]
    return loop, heeded


# -- the socket ------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_a_process_is_changed_through_its_socket_while_it_is_driven(tmp_path: Path) -> None:
    """In a thread beside it an operator asks; values are in the journal once it is answered."""
    path, events, answers = tmp_path / "netem", list[Event](), list[Any]()

    def operate() -> None:
        with closing(Caller(path)) as caller:
            answers.append(caller.ask({}).values["network.uplink"])
            answers.append(caller.ask({"network.uplink.loss": 2}).refused)
            answers.append(caller.ask({"network.uplink.loss": 1}).changed)
        answers.append((tmp_path / "netem.set").exists())

    journal = take_up(path, DEMO, new_flight=False).journal
    endpoint = Closing(DEMO, server=("127.0.0.1", 1))
    with controlled(path, Running(endpoint, DEMO), journal) as control:
        thread = threading.Thread(target=operate)
        shell_ = Shell(endpoint, ("127.0.0.1", 0), control=control)
        run([shell_], on_start=thread.start, on_event=events.append)
        thread.join()
    refused = "network.uplink: got 'loss(2)', expected loss(share) with 0 <= share <= 1"
    before, after = (f"paper(0.4, 0.02, 2.0) & loss({share})" for share in ("0.1", "1"))
    changed = Changed(key="network.uplink", before=f'"{before}"', after=f'"{after}"')
    assert answers == [before, refused, (changed,), True]
    assert events == [ChangeRefused(reason=refused), changed]
    assert not path.exists()


@virtually
async def test_a_driven_process_tells_its_changes_and_may_end_with_one(tmp_path: Path) -> None:
    path, events, loop = tmp_path / "netem", list[Event](), asyncio.get_running_loop()
    endpoint = Closing(DEMO, server=("127.0.0.1", 1))
    with controlled(path, Running(endpoint, DEMO)) as control, closing(Caller(path)) as caller:
        caller._socket.setblocking(False)
        shell_ = Shell(endpoint, LOOPBACK, control=control)
        driven = loop.create_task(shell_.run(events.append))
        for request in (b'{"network.uplink.loss":2}', b'{"network.uplink.loss":1}'):
            caller._socket.send(request)
            assert await loop.sock_recv(caller._socket, 9000)
        await driven
    assert [type(event) for event in events] == [ChangeRefused, Changed]


def test_a_flood_of_requests_is_read_one_at_a_time_with_a_rest_after_each(tmp_path: Path) -> None:
    with closing(Control(tmp_path / "netem", running())) as control:
        loop, heeded = heeding(control)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as flood:
            flood.setblocking(False)
            sent = 0
            with suppress(BlockingIOError):
                while sent < 100_000:
                    flood.sendto(b'{"network.uplink.loss":0.5}', str(tmp_path / "netem"))
                    sent += 1
        assert sent < 100_000
        for count in range(1, 6):
            assert loop.look()
            assert not loop.look()
            assert len(heeded) == count
            ((rest_s, listen),) = loop.later
            assert rest_s >= REST_S
            loop.later.clear()
            listen()


def test_a_request_that_takes_long_is_followed_by_a_rest_that_is_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Requests take a bounded share of the time, whatever they ask for."""
    seconds = iter((10.0, 10.5))
    with closing(Control(tmp_path / "netem", running())) as control:
        loop, _ = heeding(control)
        monkeypatch.setattr(
            skytether.shell.driving.control.time, "monotonic", lambda: next(seconds)
        )
        loop.look()
    assert [rest_s for rest_s, _ in loop.later] == [0.5 * RESTS]


def test_a_socket_that_is_closed_while_it_rests_reads_no_more(tmp_path: Path) -> None:
    with closing(Control(tmp_path / "netem", running())) as control:
        loop, _ = heeding(control)
        loop.look()
        control.end()
        loop.later[0][1]()
        assert not loop.look()


def test_whoever_sends_garbage_and_does_not_read_costs_others_nothing(tmp_path: Path) -> None:
    rng = random.Random(1)
    path = tmp_path / "netem"
    with closing(Control(path, running())) as control:
        loop, heeded = heeding(control)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hostile:
            hostile.bind(str(tmp_path / "hostile"))
            for count in range(1000):
                if count == 500:  # from here on answers cannot be delivered
                    (tmp_path / "hostile").unlink()
                hostile.sendto(rng.randbytes(rng.randrange(9000)), str(path))
                loop.look()
                loop.later.pop()[1]()
        assert len(heeded) == 1000
        caller = Caller(path)
        caller._socket.send(b"{}")
        loop.look()
        assert b"network.uplink" in caller._socket.recv(9000)
        caller.close()


def test_what_is_too_long_for_a_datagram_is_refused_whole(tmp_path: Path) -> None:
    """A truncated change might still be valid."""
    path = tmp_path / "netem"
    flown = running()
    with closing(Control(path, flown)) as control, closing(Caller(path)) as caller:
        loop, _ = heeding(control)
        caller._socket.send(b'{"network.uplink.loss":0.5}' + b" " * 5000)
        loop.look()
        assert b"expected a shorter request" in caller._socket.recv(9000)
    assert flown.change({"network.uplink.loss": 0.1}, now_ns=0) == ()


@pytest.mark.parametrize("said", [b"", b"[]", b"\xff", b'{"values":{"a":' + b"[" * 30_000])
def test_an_answer_of_something_else_is_a_control_error(said: bytes, tmp_path: Path) -> None:
    path = tmp_path / "netem"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(str(path))
        with closing(Caller(path)) as caller:
            other.sendto(said, caller._socket.getsockname())
            with pytest.raises(
                ControlError, match=f"{path}: got an answer that is not from skytether"
            ):
                caller.ask({})


# -- path of the socket ----------------------------------------------------------------------------


def test_a_socket_that_a_killed_process_left_behind_gives_way(tmp_path: Path) -> None:
    path = tmp_path / "netem"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(str(path))
    with controlled(path, running()):
        assert stat.S_IMODE(path.lstat().st_mode) == 0o600
    assert not path.exists()


def occupied(path: Path, kind: str) -> None:
    match kind:
        case "a file":
            path.write_text("precious")
        case "a folder":
            path.mkdir()
        case "a link":
            path.with_name("file").write_text("precious")
            path.symlink_to(path.with_name("file"))
        case "a pipe":
            os.mkfifo(path)


@pytest.mark.parametrize("kind", ["a file", "a folder", "a link", "a pipe"])
def test_nothing_else_gives_way(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "netem"
    occupied(path, kind)
    before = path.lstat()
    with pytest.raises(LocalError) as refused:
        Control(path, running())
    assert str(refused.value) == (
        f"{path}: cannot create the socket: expected a new path, or a socket that is no longer "
        "in use"
    )
    assert path.lstat() == before


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM])
def test_a_socket_at_which_somebody_listens_stays(kind: int, tmp_path: Path) -> None:
    path = tmp_path / "netem"
    with socket.socket(socket.AF_UNIX, kind) as other:
        other.bind(str(path))
        if kind == socket.SOCK_STREAM:
            other.listen()
        with pytest.raises(LocalError, match="another process listens there"):
            Control(path, running())
        assert path.is_socket()


def test_at_the_end_only_its_own_socket_is_removed(tmp_path: Path) -> None:
    """Another process may have made one there since."""
    path = tmp_path / "netem"
    control = Control(path, running())
    path.unlink()
    path.write_text("precious")
    control.close()
    assert path.read_text() == "precious"


def test_a_socket_that_cannot_be_made_is_said_before_anything_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from skytether.netem.__main__ import emulate

    path = tmp_path / ("n" * 200)
    code = command.main(emulate, ["--bind", "127.0.0.1:0", "--control", str(path)], "netem")
    said = f"netem: --control: {path}: cannot create the socket: AF_UNIX path too long\n"
    assert (code, capsys.readouterr().err) == (2, said)


def test_the_folder_of_a_socket_is_made_for_its_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "air" / "netem"
    with closing(Control(path, running())):
        assert path.is_socket()
    assert path.parent.stat().st_mode & 0o777 == 0o700


# -- skytether set ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.3", 0.3),
        ("[[1, 2.5]]", [[1, 2.5]]),
        ("true", True),
        ('"periodic(5)"', "periodic(5)"),
        ("cost_gap & budget(5, 2) | silence(1)", "cost_gap & budget(5, 2) | silence(1)"),
        ("", ""),
        ("nan", "nan"),
        ("[inf]", "[inf]"),
        ("2026-01-01", "2026-01-01"),
        ("1\nother = 2", "1\nother = 2"),
        ("9" * 5000, "9" * 5000),
        ("[" * 5000, "[" * 5000),
    ],
)
def test_a_value_is_toml_or_else_a_text(text: str, expected: object) -> None:
    assert toml_value(text) == expected


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (["network.uplink.loss"], "got 'network.uplink.loss', expected KEY=VALUE"),
        (["=1"], "got '=1', expected KEY=VALUE"),
        (["a=1", "a=2"], "a: got two values, expected one"),
        (
            ["a=" + "x" * 5000],
            "got 5008 B of keys and values, expected at most 4096 B at a time",
        ),
    ],
)
def test_what_is_no_change_is_refused_before_anybody_is_asked(
    changes: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main(set_keys, ["nowhere", *changes], "set") == 2
    assert capsys.readouterr().err == f"set: {line}\n"


def test_where_nobody_listens_is_said_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "netem"
    assert command.main(set_keys, [str(path)], "set") == 1
    assert capsys.readouterr().err.startswith(f"set: {path}: no process listens there (No such")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(str(path))
    assert command.main(set_keys, [str(path)], "set") == 1
    assert capsys.readouterr().err.startswith(f"set: {path}: no process listens there (Conn")


def test_answers_come_to_beside_the_socket_that_was_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In another container no other folder is shared; if its path is too long, another folder."""
    deep = tmp_path / ("d" * 90)
    deep.mkdir()
    monkeypatch.chdir(deep)
    for path, beside in ((tmp_path / "netem", True), (Path("netem"), False)):
        with controlled(path, running()), closing(Caller(path)) as caller:
            address = Path(caller._socket.getsockname())
            assert (address.parent.parent == tmp_path) == beside
            assert address.is_socket()
        assert not address.parent.exists()


def test_where_no_address_for_answers_can_be_made_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither beside the socket nor in the folder for temporary files; nothing is left open."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    path = tmp_path / "gone" / "netem"
    assert command.main(set_keys, [str(path)], "set") == 1
    said = f"set: {path}: no socket for the answer can be created\n"
    assert capsys.readouterr().err == said


def test_one_that_listens_and_does_not_answer_is_not_waited_for_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "netem"
    monkeypatch.setattr(skytether.shell.driving.control, "PATIENCE_S", 0.05)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(str(path))
        assert command.main(set_keys, [str(path)], "set") == 1
    assert capsys.readouterr().err == f"set: {path}: no answer in 0.05 s\n"


class Heard:
    """Socket of an operator, whose requests are answered as soon as they are sent."""

    def __init__(self, sock: socket.socket, loop: HandLoop) -> None:
        self._socket, self._loop = sock, loop

    def send(self, request: bytes) -> None:
        self._socket.send(request)
        assert self._loop.look()
        self._loop.pass_time()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._socket, name)


def test_set_prints_what_may_change_what_has_and_what_was_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "netem"
    calls = [[], ["network.uplink.loss=0.3", "network.downlink=none"], ["control.dt=1"]]
    calls.append(["network.uplink=constant(0.1) & loss(0.6)"])
    with closing(Control(path, running())) as control:
        loop, _ = heeding(control)
        connected = Caller.__init__

        def connect(caller: Caller, at: Path) -> None:
            connected(caller, at)
            caller._socket = Heard(caller._socket, loop)  # type: ignore[assignment]

        monkeypatch.setattr(Caller, "__init__", connect)
        codes = [command.main(set_keys, [str(path), *call], "set") for call in calls]
    out, err = capsys.readouterr()
    assert codes == [0, 0, 2, 0]
    paper = '"paper(0.4, 0.02, 2.0) & loss({})"'.format
    assert out.splitlines() == [
        f"network.downlink = {paper(0.1)}",
        f"network.uplink = {paper(0.1)}",
        f"network.uplink is {paper(0.3)} from now on, it was {paper(0.1)}",
        f'network.downlink is "none" from now on, it was {paper(0.1)}',
        (
            'network.uplink is "constant(0.1) & loss(0.6)" from now on, it was '
            '"paper(0.4, 0.02, 2.0) & loss(0.3)"'
        ),
    ]
    assert err.startswith(f"set: {path}: control.dt: cannot be changed in flight; expected one of")


def test_no_loop_is_needed_to_close_what_was_never_driven(tmp_path: Path) -> None:
    path = tmp_path / "netem"
    with controlled(path, running()) as control:
        control.end()
    assert not path.exists()
