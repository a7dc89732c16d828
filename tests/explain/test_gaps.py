"""Explanations of gaps in a robot program's calls: each names what was broken on purpose."""

import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from policy_lab import MS, OPTIONS, Around, Lab, ramp, secured, state
from skytether.__main__ import main
from skytether.explain import calls, gaps
from skytether.explain.gaps import Cause, Gap
from skytether.policy.players import PLAYERS
from skytether.policy.recording import CallRecording
from skytether.policy.robot import RobotOptions
from skytether.policy.serving import PolicyEnd
from skytether.policy.virtual import NoActionError
from skytether.server.gate import PlainGate

DOCUMENT = Path(__file__).parents[2] / "docs" / "explain.md"
NEAR, FAR = "constant(20ms)", "constant(125ms)"
BEGIN = 40
"""Call from which something is broken."""
Breaks = Callable[[Lab, int], None]


def record(
    path: Path,
    breaks: Breaks = lambda *_: None,
    *,
    options: RobotOptions = OPTIONS,
    observe: Callable[[int], Any] = lambda _: state(1.0),
    made: Callable[..., Lab] = Lab,
    number: int = 80,
    **others: Any,
) -> Path:
    """Recording of a program that executes five rows of 20 ms between its calls."""
    lab = made(options=options, **{"to_policy": NEAR, "to_robot": NEAR, "thinking": 0.03} | others)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CallRecording, "_put", lambda _, action: action())
        written = CallRecording(path, options)
        lab.robot._on_answer, lab.robot._on_step = written.note, written.step
        lab.connect()
        for i in range(number):
            breaks(lab, i)
            with suppress(NoActionError):
                lab.infer(observe(i))
            lab.sleep(0.1)
        patch.undo()
        assert written.close() == ""
    return path


def explained(path: Path) -> list[Gap]:
    return list(gaps.gaps(calls.read(path)))


# -- what is broken --------------------------------------------------------------------------------


def pauses(seconds: float) -> Breaks:
    return lambda lab, i: lab.sleep(seconds) if i == BEGIN else None


def thinks(seconds: float, number: int, usual_s: float = 0.03) -> Breaks:
    """The policy takes longer for some observations."""

    def breaks(lab: Lab, i: int) -> None:
        lab.thinking_ns = int((seconds if BEGIN <= i < BEGIN + number else usual_s) * 1e9)

    return breaks


def cut(number: int) -> Breaks:
    """Both directions of the network are cut."""

    def breaks(lab: Lab, i: int) -> None:
        lab.is_cut = BEGIN <= i < BEGIN + number

    return breaks


def killed(lab: Lab, i: int) -> None:
    if i == BEGIN:
        sessions = count(100)
        lab.server = PolicyEnd(PlainGate(), boot_id=7, draw=lambda: next(sessions))


def loses_parts(lab: Lab, i: int) -> None:
    """Of some observations only five large datagrams leave the robot."""
    if i == 0:
        lab.robot = Around(lab.robot)  # type: ignore[assignment]
    sent = Counter[int]()

    def leaves(datagram: Any) -> bool:
        sent[i] += len(datagram.payload) > 600 and not datagram.socket
        return not BEGIN <= i < BEGIN + 4 or sent[i] <= 5 or datagram.socket == 1

    lab.robot.leaves = leaves  # type: ignore[attr-defined]


def rows(number: int) -> Callable[[Any], Any]:
    return lambda _: {"actions": np.zeros((number, 1), np.float32)}


def replies(
    how: Callable[[], Any], number: int = 6, first: int = BEGIN, usual: Any = ramp
) -> Callable[[Any], Any]:
    """Policy whose replies to some observations are different."""
    asked = count()

    def policy(observation: Any) -> Any:
        return how() if first <= next(asked) < first + number else usual(observation)

    return policy


def raises() -> Any:
    raise ValueError("CUDA out of memory")


def not_finite() -> Any:
    return {"actions": np.full((10, 1), np.nan)}


def larger(size: int, otherwise: int = 10) -> Callable[[int], Any]:
    """Observations of which some are large."""
    sizes = dict.fromkeys(range(30, 36), size)
    return lambda i: {"state": np.zeros(1), "map": np.zeros(sizes.get(i, otherwise))}


def options(**others: Any) -> RobotOptions:
    return RobotOptions("absolute", 150 * MS, **{"step_ns": 20 * MS} | others)


def to_policy(broken: str, **others: Any) -> dict[str, Any]:
    return {"to_policy": f"{NEAR} & {broken}", **others}


def to_robot(broken: str, **others: Any) -> dict[str, Any]:
    return {"to_robot": f"{NEAR} & {broken}", **others}


BROKEN: dict[str, tuple[Cause, dict[str, Any]]] = {
    "outage to the policy, 0.8 s": (Cause.TO_POLICY, to_policy("outage(3, 0.8)")),
    "outage to the policy, 1.2 s": (Cause.TO_POLICY, to_policy("outage(4, 1.2)")),
    "outage to the policy, 2.5 s": (Cause.TO_POLICY, to_policy("outage(5, 2.5)")),
    "outage to the policy, with keys": (
        Cause.TO_POLICY,
        to_policy("outage(4, 1.2)", made=secured),
    ),
    "outage, measured steps": (
        Cause.TO_POLICY,
        to_policy("outage(4, 1.2)", options=options(step_ns=None, rows=5)),
    ),
    "outage, needed(2)": (
        Cause.TO_POLICY,
        to_policy("outage(4, 1.2)", options=options(spare_rows=2)),
    ),
    "outage to the robot, 0.8 s": (Cause.TO_ROBOT, to_robot("outage(3, 0.8)")),
    "outage to the robot, 1.2 s": (Cause.TO_ROBOT, to_robot("outage(4, 1.2)")),
    "outage to the robot, 2.5 s": (Cause.TO_ROBOT, to_robot("outage(5, 2.5)")),
    "outage to the robot, drtc": (
        Cause.TO_ROBOT,
        to_robot("outage(4, 1.2)", options=options(player=PLAYERS["drtc"])),
    ),
    "outage to the robot, 250 ms away": (
        Cause.TO_ROBOT,
        {"policy": rows(30), "to_policy": FAR, "to_robot": f"{FAR} & outage(4, 1.2)"},
    ),
    "loss to the policy": (Cause.TO_POLICY, to_policy("loss(0.75)", number=120)),
    "loss to the robot": (Cause.TO_ROBOT, to_robot("loss(0.75)", number=120)),
    "single datagrams to the policy": (
        Cause.TO_POLICY,
        {"breaks": loses_parts, "observe": larger(1000, 1000)},
    ),
    "both directions": (Cause.TO_POLICY, {"breaks": cut(8)}),
    "both directions, for good": (Cause.EITHER, {"breaks": cut(80), "number": 60}),
    "policy end killed": (Cause.RESTART, {"breaks": killed}),
    "policy slow, 4 times": (Cause.SLOW, {"breaks": thinks(0.7, 4)}),
    "policy slow, twice": (Cause.SLOW, {"breaks": thinks(1.5, 2)}),
    "policy hangs": (Cause.SLOW, {"breaks": thinks(1000.0, 80)}),
    "policy slow, also before": (
        Cause.SLOW,
        {"breaks": thinks(1.5, 2, 0.25), "policy": rows(30)},
    ),
    "outage, slow policy": (
        Cause.TO_POLICY,
        to_policy("outage(6, 1.2)", thinking=0.25, policy=rows(30)),
    ),
    "errors, slow policy": (
        Cause.ERROR,
        {"policy": replies(raises, 4, 20, rows(30)), "thinking": 0.25},
    ),
    "errors": (Cause.ERROR, {"policy": replies(raises)}),
    "errors for 2 s": (Cause.ERROR, {"policy": replies(raises, 20)}),
    "chunks refused": (Cause.CHUNK_REFUSED, {"policy": replies(not_finite)}),
    "observations refused": (Cause.REFUSED, {"observe": larger(600_000)}),
    "send rate": (
        Cause.SEND_RATE,
        {"observe": larger(2500), "options": options(rate_max=20_000.0)},
    ),
    "send rate, late": (
        Cause.SEND_RATE,
        {"observe": larger(1200), "options": options(rate_max=20_000.0)},
    ),
    "rate of the network": (Cause.DELAY, to_policy("rate(12000)", observe=larger(1500))),
    "jitter to the policy": (
        Cause.DELAY,
        {"to_policy": "gamma(0.02, 0.1, 0.15)", "number": 160},
    ),
    "jitter to the robot": (
        Cause.DELAY,
        {"to_robot": "gamma(0.02, 0.2, 0.3)", "number": 160},
    ),
    "pause of the program": (Cause.PAUSE, {"breaks": pauses(2.3), "thinking": 0.25}),
    "chunks too short": (Cause.USUAL, {"thinking": 0.29, "policy": rows(5), "number": 20}),
}
"""Cause that the explanation must name, and what is broken."""
ONE_OF_TWO = {"jitter to the robot", "errors, slow policy", "send rate, late"}
"""Cases of which two causes are named, because either suffices: a chunk overtaken by a newer one
counts as lost, a faster policy would have sent a chunk before the errors, and an observation that
takes long to send seems late in the network."""


@pytest.mark.parametrize("broken", BROKEN)
def test_the_explanation_names_what_was_broken(broken: str, tmp_path: Path) -> None:
    truth, how = BROKEN[broken]
    found = explained(record(tmp_path / "calls.mcap", **how))
    gap = next(each for each in found if min(*each.holds, *each.errors, BEGIN) > 8)
    named = [each.cause for each in gap.parts]
    assert truth in named
    assert len(named) == 1 + (broken in ONE_OF_TWO)
    assert gap.equal == gap.replayed


@pytest.mark.parametrize("broken", ["outage to the policy, 1.2 s", "jitter to the policy"])
def test_what_would_have_averted_a_gap_averts_it(broken: str, tmp_path: Path) -> None:
    """The flight is repeated in virtual time with the least number of rows, and with one less."""
    _, how = BROKEN[broken]
    gap, *_ = explained(record(tmp_path / "calls.mcap", **how))
    least = int(re.findall(r"\d+", gap.averting[0])[0])
    numbers = {*gap.holds, *gap.errors}

    def holds(**others: Any) -> bool:
        again = explained(record(tmp_path / "again.mcap", **how | others))
        return any(numbers & {*each.holds, *each.errors} for each in again)

    assert not holds(policy=rows(least))
    assert holds(policy=rows(least - 1))
    for each in gap.averting[1:]:
        deadline_ms = int(re.findall(r"\d+", each)[0])
        assert not holds(options=RobotOptions("absolute", deadline_ms * MS, step_ns=20 * MS))


def test_without_two_of_the_repaired_chunks_the_gap_remains(tmp_path: Path) -> None:
    """The smallest set of chunks is needed completely."""
    _, how = BROKEN["outage to the robot, 2.5 s"]
    (program,) = calls.read(record(tmp_path / "calls.mcap", **how))
    (gap,) = gaps.gaps([program])
    replay = calls.recorded(program, program.calls)
    usual = replay.replies[10]

    def averted(repaired: tuple[int, ...]) -> bool:
        for number in repaired:
            replay.replies[number - 1] = usual  # type: ignore[index]
        kinds = replay.answers()
        for number in repaired:
            replay.replies[number - 1] = None  # type: ignore[index]
        return not any(kinds[number - 1] in calls.NO_ROW for number in (*gap.holds, *gap.errors))

    (part,) = gap.parts
    assert averted(part.repaired)
    for each in part.repaired:
        assert not averted(tuple(number for number in part.repaired if number != each))


def test_a_recording_without_gaps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "calls.mcap")
    assert main(["explain", str(tmp_path / "calls.mcap")]) == 0
    assert capsys.readouterr().out == "No gap in 80 calls.\n"


def test_the_documented_explanation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    record(Path("calls.mcap"), **BROKEN["outage to the robot, 1.2 s"][1])
    assert main(["explain", "calls.mcap", "--json", "gaps.json"]) == 0
    (shown,) = re.findall(
        r"skytether explain calls.mcap\n```\n\n```\n(.*?)```", DOCUMENT.read_text(), re.DOTALL
    )
    assert capsys.readouterr().out == shown
    assert f"{len(BROKEN)} runs in\nvirtual time" in DOCUMENT.read_text()
    (gap,) = msgspec.json.decode(Path("gaps.json").read_bytes(), type=list[Gap])
    assert gap.parts[0].cause is Cause.TO_ROBOT
    assert main(["explain", "calls.mcap", "--at", "1"]) == 0
    assert "No gap" in capsys.readouterr().out
    assert main(["explain", "calls.mcap", "--seeds", "3"]) != 0


def test_a_damaged_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = record(tmp_path / "calls.mcap", number=3)
    (program,) = calls.read(path)
    assert len(program.calls) == 3
    for options in (b"{}", b'{"player": "clock", "deadline_ns": -1}'):
        with pytest.raises((ValueError, LookupError, TypeError)):
            calls._options(options)
    path.write_bytes(path.read_bytes()[:100])
    assert main(["explain", str(path)]) != 0
    assert capsys.readouterr().err


def test_a_long_gap_is_explained_by_its_first_calls(tmp_path: Path) -> None:
    number = BEGIN + 2 * gaps.LENGTH_MAX
    (gap,) = explained(record(tmp_path / "a.mcap", cut(number), number=number))
    assert len(gap.errors) > gaps.LENGTH_MAX
    assert gap.replayed <= gaps.BEFORE + gaps.LENGTH_MAX
