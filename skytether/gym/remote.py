"""Robots and the agents far from them, over one network in virtual time.

At each step a robot reports what it observes (downlink), and the agent may answer with a chunk of
actions (uplink). Both are packets of bytes with a checksum, whose fates are netem's. All robots
share the two directions, so also their finite rates.
"""

import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.gym.players import Chunk, Held, Player, Row
from skytether.netem.fate import Fates
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.server.schemes.delay_bound import DelayBound, add_sample, delay_bound
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.kernel import kernel
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.core.endpoint import make_datagram
from skytether.shared.scenario.air.path import Path
from skytether.shared.telemetry.record import DOWNLINK, UPLINK

ROWS_MAX = 1024
"""Largest number of rows of a chunk."""
SHOWN_ROWS_MAX = 64
"""Largest number of rows in `info["coming"]`, unless more are committed."""
UNDER_WAY_MAX = 4096
"""Number of newest reports and answers that the agent remembers, each way."""
DELAY_STEPS_MAX = 4096
_ANSWER = Struct("<IIqH")
"""Session, generation, step of the first row, number of rows."""
_REPORT = Struct("<IqqIq")
"""Session, step, the player's number of the step, newest generation held or 0, and the step at
which it came."""
_SUM = Struct("<I")


class Network(NamedTuple):
    uplink: Path
    """From agent to robot."""
    downlink: Path
    """From robot to agent."""
    seed: int


class Report(NamedTuple):
    """Observation at the agent's end."""

    step: int
    number: int
    """The player's number of the step, which is the default of `Chunk.first`."""
    acknowledged: int
    """Newest generation that the robot held; 0 for none."""
    since: int
    """Step at which that generation came."""
    observation: NDArray[Any]


@dataclass(slots=True)
class Robot:
    player: Player
    report: Report
    """Newest report at the agent's end."""
    uplink: Lane
    downlink: Lane
    sent: OrderedDict[int, tuple[int, Held]]
    """Answers under way, by generation, with the step of the observation of each."""
    snapshots: OrderedDict[int, Player]
    """What the robot held at the steps of reports under way."""
    session: int = 0
    generation: int = 0
    acknowledged: int = 0
    since: int = 0
    exhausted: int = 0
    """Number of steps at which rows had run out."""


@kernel
def learn(bound: DelayBound, row: int, delay: int) -> None:
    """Add a sample [steps] to the delay bound of a robot."""
    add_sample(bound, row, delay)


class Remote:
    """Robots, their agents, and the network between.

    Args:
        make_player: called for each robot and episode.
        step_ns: length of a step of the environment [ns].
        action, observation: arrays of the shapes and dtypes of both.
        fill: row that a robot plays without one of its own, from the last row (None before the
            first); None if the agent cannot know.
    """

    def __init__(
        self,
        network: Network,
        make_player: Callable[[], Player],
        step_ns: int,
        action: NDArray[Any],
        observation: NDArray[Any],
        fill: Callable[[Row | None], Row | None],
        count: int = 1,
    ) -> None:
        self._network, self._make_player, self._step_ns = network, make_player, step_ns
        self._action, self._observation, self._fill = action, observation, fill
        self._none = np.zeros((0, *action.shape), action.dtype)
        self.uplink = Link(UPLINK, QUEUE_BYTES_MAX, None, network.uplink)
        self.downlink = Link(DOWNLINK, QUEUE_BYTES_MAX, None, network.downlink)
        self._bound = delay_bound(count, step_ns / SECOND_NS, DELAY_STEPS_MAX, None)
        self._leaving: list[tuple[int, int, bytes]] = []
        """Answers that agents still think about: time of sending [ns], robot, packet. A call of
        `step` adds at most one for each robot, and mostly lasts until they have left."""
        self._robots: list[Robot] = []
        self.step = 0
        self._flows = 0

    @property
    def now_ns(self) -> int:
        return self.step * self._step_ns

    def begin(self, observations: Sequence[NDArray[Any]], robots: Sequence[int]) -> None:
        """Begin an episode of some robots; each agent is given the first observation at once."""
        for index, observation in zip(robots, observations, strict=True):
            flow = self._flows
            self._flows += 1
            robot = Robot(
                player := self._make_player(),
                Report(self.step, player.number(self.step), 0, 0, observation),
                self._lane("uplink", flow),
                self._lane("downlink", flow),
                OrderedDict(),
                OrderedDict({self.step: copy(player)}),
                session=flow,
            )
            self._robots[index : index + 1] = [robot]

    def _lane(self, way: str, flow: int) -> Lane:
        network = self._network
        return Lane(flow, Fates(getattr(network, way), network.seed, way, flow), self.now_ns)

    def answer(self, index: int, chunk: Chunk, at_ns: int) -> None:
        """Send rows, of the action's dtype, to a robot at a time from now on [ns]."""
        robot, rows = self._robots[index], chunk.rows
        robot.generation += 1
        first = robot.report.number if chunk.first is None else chunk.first
        sent = Held(robot.generation, first, rows)
        _remember(robot.sent, robot.generation, (robot.report.step, sent))
        head = _ANSWER.pack(robot.session, robot.generation, first, len(rows))
        self._leaving.append((at_ns, index, _sealed(head + rows.tobytes())))

    def rows(self) -> list[Row | None]:
        """Row of each robot for the present step; None where rows have run out."""
        self._hear_agents()
        played = [robot.player.row(self.step) for robot in self._robots]
        for robot, row in zip(self._robots, played, strict=True):
            robot.exhausted += row is None
        return played

    def last(self, index: int) -> Row | None:
        """Row that a robot holds when rows have run out."""
        return self._robots[index].player.last

    def advance(self, observations: Sequence[NDArray[Any]]) -> None:
        """Go to the next step, at which the robots observe this."""
        self.step += 1
        self._hear_agents()
        for index, (robot, observation) in enumerate(zip(self._robots, observations, strict=True)):
            _remember(robot.snapshots, self.step, copy(robot.player))
            number = robot.player.number(self.step)
            at = robot.session, self.step, number, robot.acknowledged, robot.since
            packet = _sealed(_REPORT.pack(*at) + observation.tobytes())
            self._send(self.downlink, robot.downlink, index, packet, self.now_ns)
        self._hear_robots()

    def _send(self, link: Link, lane: Lane, index: int, packet: bytes, at_ns: int) -> None:
        link.accept(make_datagram((packet, ("", index), 0)), lane, now_ns=at_ns)
        if lane.fates.fault:
            raise ConfigError(lane.fates.fault.splitlines()[-1])

    def _hear_agents(self) -> None:
        now_ns = self.now_ns
        for at_ns, index, packet in [each for each in self._leaving if each[0] <= now_ns]:
            self._send(self.uplink, self._robots[index].uplink, index, packet, at_ns)
        self._leaving = [each for each in self._leaving if each[0] > now_ns]
        for packet, (_, index), _ in self.uplink.release(now_ns=now_ns):
            robot, body = self._robots[index], _opened(packet)
            if body is None or _ANSWER.unpack_from(body)[0] != robot.session:
                continue  # corrupted, or of an earlier episode
            _, generation, first, count = _ANSWER.unpack_from(body)
            rows = np.frombuffer(body, self._action.dtype, offset=_ANSWER.size)
            rows = rows.reshape(count, *self._action.shape)
            robot.player.accept(Held(generation, first, rows), self.step)
            if generation > robot.acknowledged:
                robot.acknowledged, robot.since = generation, self.step

    def _hear_robots(self) -> None:
        for packet, (_, index), _ in self.downlink.release(now_ns=self.now_ns):
            robot, body = self._robots[index], _opened(packet)
            if body is None or _REPORT.unpack_from(body)[0] != robot.session:
                continue
            _, step, number, newest, since = _REPORT.unpack_from(body)
            if step <= robot.report.step:
                continue  # overtaken
            observation = np.frombuffer(body, self._observation.dtype, offset=_REPORT.size)
            observation = observation.reshape(self._observation.shape).copy()
            robot.report = report = Report(step, number, newest, since, observation)
            made = robot.sent.get(report.acknowledged)
            _forget_before(robot.sent, report.acknowledged + 1)
            _forget_before(robot.snapshots, step)
            if made is not None:
                learn(self._bound, index, report.since - made[0])

    def report(self, index: int) -> Report:
        return self._robots[index].report

    def info(self, index: int) -> dict[str, Any]:
        """Entries of `info` for the agent of a robot, as docs/gym.md lists them."""
        robot, report = self._robots[index], self._robots[index].report
        age_steps = self.step - report.step
        # Until an answer was acknowledged, the way there is taken to be as long as the way back.
        delay_steps = int(self._bound.steps[index]) or 2 * age_steps
        held, coming, committed = self._coming(robot, delay_steps)
        up, down = self.uplink.counts, self.downlink.counts
        return {
            "step": report.step,
            "age_s": age_steps * self._step_ns / SECOND_NS,
            "generation": robot.generation,
            "acknowledged": report.acknowledged,
            "delay_steps": delay_steps,
            "held": held,
            "coming": coming,
            "committed": committed,
            "exhausted_steps": robot.exhausted,
            "uplink_packets": up.packets,
            "uplink_bytes": up.bytes + HEADER_BYTES * up.packets,
            "downlink_packets": down.packets,
            "downlink_bytes": down.bytes + HEADER_BYTES * down.packets,
            "lost": sum(each.lost + each.dropped + each.overflowed for each in (up, down)),
        }

    def _coming(self, robot: Robot, delay_steps: int) -> tuple[int, NDArray[Any], NDArray[Any]]:
        """Number of rows that a robot held at the observation's step; rows that it plays from then
        on, until they run out; and those of the first `delay_steps`; shapes (n, *action).

        As the agent can tell: it knows what it sent, the report says what has arrived, and each
        answer under way is expected `delay_steps` after its observation.
        """
        step, rows = robot.report.step, list[Row]()
        if step not in robot.snapshots:
            return 0, self._none, self._none
        player, held = copy(robot.snapshots[step]), 0
        alone = copy(player)
        while held < SHOWN_ROWS_MAX and alone.row(step + held) is not None:
            held += 1
        under_way = [each for each in robot.sent.values() if each[0] + delay_steps > step]
        ran_out: int | None = None
        for at in range(step, step + max(SHOWN_ROWS_MAX, delay_steps)):
            for made, chunk in under_way:
                if made + delay_steps == at:
                    player.accept(chunk, at)
            row = player.row(at)
            if row is None:
                ran_out = len(rows) if ran_out is None else ran_out
                row = self._fill(player.last)
                if row is None or len(rows) >= delay_steps:
                    break
            rows.append(row)
        every = np.array(rows, dtype=self._action.dtype).reshape(-1, *self._action.shape)
        return held, every[:ran_out], every[:delay_steps]


def _sealed(body: bytes) -> bytes:
    return body + _SUM.pack(zlib.crc32(body))


def _opened(packet: bytes) -> bytes | None:
    """Packet without its checksum; None if a bit was flipped."""
    body = packet[: -_SUM.size]
    return body if _sealed(body) == packet else None


def _remember(by_number: OrderedDict[int, Any], number: int, value: object) -> None:
    by_number[number] = value
    if len(by_number) > UNDER_WAY_MAX:
        by_number.popitem(last=False)


def _forget_before(by_number: OrderedDict[int, Any], number: int) -> None:
    while by_number and next(iter(by_number)) < number:
        by_number.popitem(last=False)
