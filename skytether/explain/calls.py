"""Calls of a robot program, from a recording of `skytether policy join`, and their replay.

A replay drives the robot end (`policy.robot.RobotEnd`) in virtual time, without a network. A call
begins as long after the previous answer as in the recording, and its chunk arrives as long after
the call. A changed replay shows the answers as if a chunk had arrived or had more rows, or as if
the program had not paused. All rows are zeros, because the kind of an answer does not depend on
them.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from skytether.client.link import PlainLink
from skytether.policy import values
from skytether.policy.messages import CHUNK, Welcome, encode
from skytether.policy.parts import split
from skytether.policy.players import PLAYERS
from skytether.policy.robot import (
    LINE,
    AnsweredCall,
    FrameType,
    LinkStep,
    RobotEnd,
    RobotOptions,
)
from skytether.policy.schedule import ROWS_MAX, Kind
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.view.recordings.container import Container

SERVER: Address = ("server", 1)
PROGRAM: Address = ("program", 1)
WAIT_NS_MAX = 600 * SECOND_NS
"""Longest pause and longest delay of a chunk in a replay [ns]."""
INVALID = b"\xc1"
"""Observation that the robot end refuses."""
NO_ROW = (Kind.HOLD, Kind.ERROR)


class Arrival(NamedTuple):
    """Chunk, or an error of the policy, received by the robot end."""

    time_ns: int
    session: int
    """Number of the session in the recording."""
    message: int
    """Number of the message in its session."""
    step: LinkStep


@dataclass(slots=True)
class Call:
    """Recorded call; times are of the recording [ns]."""

    number: int
    began_ns: int
    answered_ns: int
    kind: Kind
    is_asked: bool
    """Whether its observation was to be sent; otherwise it was not needed, or it was refused."""
    sent_ns: int | None = None
    """Time at which the first part of its observation was sent; None: it was not sent."""
    parts: int = 0
    needed: int = 0
    reported_ns: int | None = None
    """Time of the policy end's report on the observation; None: no report has arrived."""
    came: int = 0
    """Number of parts received, as this report says."""
    arrivals: list[Arrival] = field(default_factory=list)

    @property
    def chunk(self) -> Arrival | None:
        """Chunk of this call; if none was accepted, the refused chunk or the error."""
        return min(self.arrivals, key=lambda each: each.step.kind != "chunk", default=None)

    @property
    def rows(self) -> int:
        """Number of rows of its chunk; 0 without a chunk."""
        return self.chunk.step.rows if self.chunk else 0

    @property
    def is_refused(self) -> bool:
        """Whether the robot end has refused its observation."""
        return self.kind is Kind.ERROR and not self.is_asked


@dataclass(slots=True)
class Program:
    """Calls of one connection of a robot program."""

    options: RobotOptions
    begin_ns: int
    """Time of the first message of the recording [ns]."""
    sessions: list[tuple[int, bool]]
    """Begin of each session of the recording [ns], and whether the policy end was restarted."""
    calls: list[Call] = field(default_factory=list)


class _Answer(msgspec.Struct):
    call: int
    kind: Kind
    waited_s: float


class _Observation(msgspec.Struct):
    call: int


def read(path: Path) -> list[Program]:
    """Programs of a recording, in order of connection; those without calls are left out.

    Raises:
        OSError: the file cannot be read.
        BROKEN: the file is damaged, see `container`.
    """
    with closing(Container(path)) as file:
        asked, messages, begin_ns = set[int](), list[tuple[int, str, bytes]](), 0
        for topic, time_ns, data in file.timed("json"):
            begin_ns = begin_ns or time_ns
            if topic == "/observation":
                asked.add(msgspec.json.decode(data, type=_Observation).call)
            elif topic in ("/options", "/link", "/answers"):
                messages.append((time_ns, topic, data))
        options, programs = None, list[Program]()
        steps, sessions = list[tuple[int, LinkStep]](), list[tuple[int, bool]]()
        for time_ns, topic, data in sorted(messages, key=lambda each: each[0]):
            if topic == "/options":
                options = _options(data)
            elif topic == "/link":
                step = msgspec.json.decode(data, type=LinkStep)
                if not 0 <= step.rows <= ROWS_MAX:
                    raise ValueError(f"a chunk has {step.rows} rows")
                steps.append((time_ns, step))
                if step.kind == "program" and options:
                    programs.append(Program(options, begin_ns, sessions))
            elif programs:
                answer = msgspec.json.decode(data, type=_Answer)
                began_ns = time_ns - round(answer.waited_s * SECOND_NS)
                call = Call(answer.call, began_ns, time_ns, answer.kind, answer.call in asked)
                programs[-1].calls.append(call)
        _follow(steps, programs, sessions)
        return [each for each in programs if each.calls]


def _options(data: bytes) -> RobotOptions:
    given = msgspec.json.decode(data, type=dict[str, Any])
    options = RobotOptions(**given | {"player": PLAYERS[given["player"]]})
    times = options.deadline_ns, options.hold_ns, options.begin_ns, options.step_ns or SECOND_NS
    if (
        not all(0 <= each <= 3600 * SECOND_NS for each in times)
        or not 1 <= options.rows <= ROWS_MAX
    ):
        raise ValueError("its options are out of range")
    return options


def _follow(
    steps: Sequence[tuple[int, LinkStep]],
    programs: Sequence[Program],
    sessions: list[tuple[int, bool]],
) -> None:
    """Assign the events of the link to calls and sessions."""
    calls = {call.number: call for program in programs for call in program.calls}
    of_message = dict[int, int]()
    for time_ns, step in steps:
        if step.kind in ("session", "restart"):
            sessions.append((time_ns, step.kind == "restart"))
            of_message.clear()
        number = of_message.get(step.message, -1) if step.kind == "report" else step.call
        if number not in calls:
            continue
        call = calls[number]
        match step.kind:
            case "sent":
                of_message[step.message] = number
                if call.sent_ns is None:
                    call.sent_ns, call.parts, call.needed = time_ns, step.parts, step.needed
            case "report" if step.parts > call.came:
                call.reported_ns, call.came = time_ns, step.parts
            case "chunk" | "error" | "refused":
                call.arrivals.append(Arrival(time_ns, len(sessions), step.message, step))


# -- replay ----------------------------------------------------------------------------------------


class Reply(NamedTuple):
    """Reply of the policy to a replayed call."""

    delay_ns: int
    """Time from the call to the chunk [ns]."""
    rows: int
    """Number of rows; 0: an error of the policy, or a refused chunk."""


@dataclass(frozen=True, slots=True)
class Replay:
    """Calls to be replayed; the first waits for its chunk, as the first call of a program does."""

    options: RobotOptions
    calls: Sequence[Call]
    pauses_ns: Sequence[int]
    """Time from the previous answer to each call, or from the previous call if it was made before
    that answer [ns]."""
    replies: Sequence[Reply | None]
    """Reply to each call; None: no reply arrives."""
    refused: frozenset[int]
    """Indices of the calls whose observations are refused."""

    def answers(self) -> list[Kind]:
        """Kind of the answer to each call."""
        answered: list[AnsweredCall] = []
        end = RobotEnd(
            *(1, {0: SERVER}, PlainLink(), self.options), boot_id=1, on_answer=answered.append
        )
        end.receive(Datagram(encode(Welcome(1, 1, 1, 1)), SERVER, 0), now_ns=0)
        end.receive(Datagram(FrameType.OPENED.value, PROGRAM, LINE), now_ns=0)
        coming, made, began_ns = list[tuple[int, int]](), 0, 0
        arrived = 0
        while len(answered) < len(self.calls):
            calls_ns = None
            if made < len(self.calls):
                waits = made and self.calls[made].began_ns > self.calls[made - 1].answered_ns
                if not waits:
                    calls_ns = began_ns + self.pauses_ns[made]
                elif len(answered) == made:
                    calls_ns = answered[-1].time_ns + self.pauses_ns[made]
            due = [calls_ns, coming[0][0] if coming else None, end.next_wake_ns()]
            now_ns = min(each for each in due if each is not None)
            if coming and coming[0][0] == now_ns:
                call = heappop(coming)[1]
                for datagram in _chunk(call + 1, arrived, self.replies[call]):
                    end.receive(datagram, now_ns=now_ns)
                arrived += 1
            elif calls_ns == now_ns:
                observation = INVALID if made in self.refused else values.pack(None)
                said = FrameType.MESSAGE.value + observation
                end.receive(Datagram(said, PROGRAM, LINE), now_ns=now_ns)
                if reply := self.replies[made]:
                    heappush(coming, (now_ns + reply.delay_ns, made))
                made, began_ns = made + 1, now_ns
            else:
                end.wake(now_ns=now_ns)
            end.outbox()
        return [each.kind for each in answered]


def _chunk(call: int, message: int, reply: Reply | None) -> list[Datagram]:
    assert reply
    content = values.pack({"actions": np.zeros((reply.rows, 1), np.uint8)})
    data = values.pack([call, content, "" if reply.rows else "error"])
    return [Datagram(encode(part), SERVER, 0) for part in split(data, 1, CHUNK, message, 0)]


def recorded(program: Program, calls: Sequence[Call]) -> Replay:
    """Replay of successive calls of a program as recorded."""
    options = replace(program.options, key="actions")
    pauses_ns = [0]
    for before, call in pairwise(calls):
        is_after = call.began_ns > before.answered_ns
        pause_ns = call.began_ns - (before.answered_ns if is_after else before.began_ns)
        pauses_ns.append(min(max(pause_ns, 0), WAIT_NS_MAX))
    replies: list[Reply | None] = []
    for call in calls:
        delay_ns = call.chunk.time_ns - call.began_ns if call.chunk else -1
        is_in_time = 0 <= delay_ns <= WAIT_NS_MAX
        replies.append(Reply(delay_ns, call.rows) if is_in_time else None)
    refused = frozenset(i for i, each in enumerate(calls) if each.is_refused)
    return Replay(options, calls, pauses_ns, replies, refused)
