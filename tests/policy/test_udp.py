"""Over real UDP: openpi's unchanged client with both commands, and the Python interface."""

import json
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Barrier, BrokenBarrierError, Thread
from types import SimpleNamespace
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from openpi_client.websocket_client_policy import WebsocketClientPolicy

from helpers import LOOPBACK, Idle, ran, refused
from policy_lab import PolicyServer, calls, command, joined, messages, process, served
from skytether.__main__ import main
from skytether.policy import PolicyError, Robot, values
from skytether.policy.command import JoinOptions, _robot_options
from skytether.policy.inside import _FunctionLine
from skytether.policy.robot import FrameType
from skytether.shared.base.errors import ConfigError
from skytether.shell.driving.driver import Shell


@pytest.fixture
def policy() -> Iterator[PolicyServer]:
    server = PolicyServer()
    yield server
    server.close()


@pytest.mark.realtime
def test_openpis_own_client_flies_through_both_commands(
    policy: PolicyServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With keys, an impaired network, and an error of the policy at the end."""
    keys = ["--keys", str(tmp_path / "keys")]
    assert main(["keygen", keys[1]]) == 0
    capsys.readouterr()
    with socket.create_server(("127.0.0.1", 0)) as free:
        metrics = f"127.0.0.1:{free.getsockname()[1]}"
    bad = ("--to-server", "constant(30ms) & loss(10%)", "--to-client", "constant(30ms) & loss(10%)")
    files = [f"--json={tmp_path / 'join.json'}", f"--record={tmp_path / 'calls.mcap'}"]
    with (
        served(policy, *keys) as server,
        command("netem", "--bind", "127.0.0.1:0", "--server", server, *bad) as netem,
        joined(netem, *keys, "--deadline", "2s", "--metrics", metrics, *files) as robot,
    ):
        client = WebsocketClientPolicy(f"ws://{robot}")
        assert client.get_server_metadata() == {"name": "ramp"}
        assert np.diff(calls(client, 15)).tolist() == [1.0] * 74
        with pytest.raises(RuntimeError, match="the observation is refused"):
            client.infer({"state": np.zeros(1), "image": np.zeros(5_000_000, np.uint8)})
        with urlopen(f"http://{metrics}/metrics", timeout=10) as answer:
            assert b'skytether_policy_answers_total{kind="fresh"}' in answer.read()
        client._ws.close()
    counted = json.loads((tmp_path / "join.json").read_text())
    assert counted["answers"] == {"fresh": 15, "rest": 0, "hold": 0, "error": 1}
    recorded = list(messages(tmp_path / "calls.mcap"))
    answers = [each for topic, each in recorded if topic == "/answers"]
    assert [each["kind"] for each in answers] == ["fresh"] * 15 + ["error"]
    assert answers[0]["actions"] == [[float(row)] for row in range(10)]
    observed = [each for topic, each in recorded if topic == "/observation"]
    assert observed[1] == {"call": 2, "state": [5.0], "prompt": "go on"}
    assert policy.seen[0]["prompt"] == "go on"
    assert main(["explain", str(tmp_path / "calls.mcap")]) == 0
    assert "the robot end refused observations" in capsys.readouterr().out


@pytest.mark.realtime
def test_a_robot_in_python_with_a_policy_in_python(tmp_path: Path) -> None:
    script = tmp_path / "serves.py"
    script.write_text(
        "import sys\n"
        "import numpy as np\n"
        "from skytether import policy\n"
        "def infer(seen):\n"
        "    if seen['state'][0] < 0:\n"
        "        raise RuntimeError('below zero')\n"
        "    return seen['state'][0] + np.arange(10.0)[:, None]\n"
        "def say(event):\n"
        "    print(event, flush=True)\n"
        "policy.serve(infer, bind='127.0.0.1:0', metadata={'rows': 10}, on_event=say)\n"
    )
    with (
        process(sys.executable, "-P", str(script)) as server,
        Robot(server, actions="absolute", deadline=1.0, hold=0.2, step=0.01) as robot,
    ):
        position = 0.0
        for _ in range(20):
            row = float(robot.infer({"state": np.array([position])})["actions"][0, 0])
            assert row == position
            position += 1.0
            time.sleep(0.01)
        assert robot.metadata == {"rows": 10}
        assert robot.figures()["answers"]["fresh"] == 20
        time.sleep(0.5)
        with pytest.raises(PolicyError, match="no action from the policy"):
            robot.infer({"state": np.array([-1.0])})


@pytest.mark.realtime
def test_the_documented_programs_run(tmp_path: Path) -> None:
    """A served function, `Robot`, and openpi's client through `policy join`."""
    text = (Path(__file__).parents[2] / "docs" / "policy.md").read_text()
    programs = dict(re.findall(r"```python\n# (\w+)\.py\n(.*?)```", text, re.DOTALL))
    assert all(program.count("\n") <= 30 for program in programs.values())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        server = f"127.0.0.1:{free.getsockname()[1]}"

    def line(name: str, old: str, new: str) -> list[str]:
        assert old in programs[name]
        (tmp_path / name).write_text(programs[name].replace(old, new))
        return [sys.executable, "-P", str(tmp_path / name)]

    with subprocess.Popen(line("serving", "127.0.0.1:47010", server)) as serving:
        try:
            run = ran(*line("robot", "127.0.0.1:47010", server))
            assert run.stdout.startswith("{'rows': 20} [ 0."), run
            with joined(server, "--rows", "10", "--resize", "224") as robot:
                run = ran(*line("openpi_robot", "8001", robot.rpartition(":")[2]))
            assert run.stdout.startswith("{'rows': 20} [ 0."), run
        finally:
            serving.terminate()


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        ([], "expected serve or join"),
        (["fly"], "expected serve or join"),
        (["join", "127.0.0.1:1"], "--actions: got nothing, expected absolute or delta"),
        (["join", "--actions", "delta"], "expected either HOST:PORT or --path"),
        (["join", "192.0.2.1:1", "--actions", "delta"], "--keys"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--deadline", "150"], "150ms"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--hold", "5"], "--hold"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--rate", "4"], "4mbit"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--rate", "40kbit"], "50kbit"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--when", "never"], "needed(2)"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--rows", "0"], "1 to 1024"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--resize", "0"], "32 to 4096"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--listen", "0.0.0.0:1"], "--insecure"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--page", "0.0.0.0:1"], "--insecure"),
        (["join", "127.0.0.1:1", "--actions", "delta", "--plays-on"], "--step"),
        (["serve", "--upstream", "http://127.0.0.1"], "ws://HOST:PORT"),
        (["serve", "--bind", "0.0.0.0:1"], "--keys"),
    ],
)
def test_what_is_wrong_is_named(
    argv: list[str], says: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert says in refused(["policy", *argv], capfd)


def test_without_a_hold_time_calls_get_an_error_at_once() -> None:
    assert _robot_options(JoinOptions(actions="delta", hold="0")).hold_ns == 0


def test_other_machines_need_keys_in_python_too() -> None:
    with pytest.raises(ConfigError, match="expected keys=FILE"):
        Robot("192.0.2.1:47010", actions="delta")
    with pytest.raises(ConfigError, match="absolute"):
        Robot("127.0.0.1:47010", actions="up")  # type: ignore[arg-type]


def test_bound_sockets_leave_the_number_of_the_line_free() -> None:
    opened = SimpleNamespace(address=None)
    shell = Shell(Idle(), [LOOPBACK, LOOPBACK], line=lambda hear, _: opened)  # noqa: ARG005
    assert sorted(shell.addresses) == [0, 2]
    shell._close_sockets()


def test_an_answer_to_a_call_that_was_interrupted_is_not_that_of_the_next() -> None:
    robot = Robot("127.0.0.1:9", actions="delta")
    said: list[bytes] = []
    robot._say = said.append  # type: ignore[method-assign]
    robot._is_connected, robot._unread, robot._patience_s = True, 1, 0.01
    assert robot._line
    for number in (1, 2):
        robot._line.answers.put(b"m" + values.pack({"actions": np.array([float(number)])}))
    assert robot.infer({})["actions"][0] == 2.0
    with pytest.raises(PolicyError):
        robot.infer({})
    robot._shell._close_sockets()


def function_line(infer: Any) -> tuple[Any, "SimpleQueue[bytes]"]:
    """Local connection to a function, and the queue of what it says."""
    said: SimpleQueue[bytes] = SimpleQueue()
    loop: Any = SimpleNamespace(call_soon_threadsafe=lambda hear, each: hear(each))
    line = _FunctionLine(infer, {}, lambda each: said.put(each.payload))
    Thread(target=line._work, args=(loop,), daemon=True).start()
    return line, said


def test_a_policy_that_exits_is_an_error_and_is_called_again() -> None:
    def infer(_: Any) -> Any:
        raise SystemExit(3)

    line, said = function_line(infer)
    for _ in range(2):
        line.send(FrameType.MESSAGE.value + values.pack({}), ("policy", 1))
        assert b"SystemExit" in said.get(timeout=10)


def test_calls_from_several_threads_are_made_one_after_the_other() -> None:
    robot = Robot("127.0.0.1:9", actions="delta")
    assert robot._line
    answers, calls = robot._line.answers, Barrier(2)

    def say(said: bytes) -> None:
        with pytest.raises(BrokenBarrierError):
            calls.wait(0.1)
        answers.put(said)

    robot._say = say  # type: ignore[method-assign]
    robot._is_connected, robot._unread, robot._patience_s = True, 0, 0.5
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(robot.infer, range(2))) == [0, 1]
    robot._shell._close_sockets()


def test_an_episode_begins_after_the_answer_to_a_call_of_another_thread() -> None:
    robot = Robot("127.0.0.1:9", actions="delta")
    assert robot._line
    answers, done = robot._line.answers, list[str]()

    def say(said: bytes) -> None:
        resetting.append(pool.submit(robot.reset))
        with pytest.raises(TimeoutError):
            resetting[0].result(0.1)
        done.append("infer")
        answers.put(said)

    robot._say = say  # type: ignore[method-assign]
    robot._do = lambda _: done.append("reset")  # type: ignore[method-assign]
    robot._is_connected, robot._unread, robot._patience_s = True, 0, 0.5
    resetting = list[Any]()
    with ThreadPoolExecutor(1) as pool:
        assert robot.infer(7) == 7
    assert done == ["infer", "reset"]
    assert robot._unread == 0
    robot._shell._close_sockets()


def test_a_call_of_another_thread_ends_when_the_robot_is_closed() -> None:
    with ThreadPoolExecutor(1) as pool:
        with Robot("127.0.0.1:9", actions="delta") as robot:
            call = pool.submit(robot.infer, {})
        with pytest.raises(PolicyError, match="closed"):
            call.result(10)


def test_a_robot_that_is_connected_again_gets_no_earlier_answer() -> None:
    robot = Robot("127.0.0.1:9", actions="delta")
    assert robot._line
    for _ in range(2):
        with robot:
            assert robot._line.answers.empty()
            assert not robot._is_connected
            robot._line.answers.put(b"m")
            robot._is_connected = True
            robot._say(FrameType.MESSAGE.value + values.pack({}))
        assert robot._end._program is None


@pytest.mark.parametrize(
    "wrong", [{"rows": 0}, {"robot": 70_000}, {"deadline": 0.0}, {"step": -1.0}, {"hold": -1.0}]
)
def test_a_robot_with_impossible_arguments_is_refused(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(ConfigError, match=name):
        Robot("127.0.0.1:9", actions="delta", **wrong)
