"""Robots and remote agents, connected by one network in virtual time.

At each step a robot reports what it observes (downlink), and the agent may answer with a chunk of
actions (uplink). A long message is split into several datagrams, and arrives with the last of them.
Netem decides the loss and delay of each datagram. All robots share the two directions and their
finite rates.

Only the size of a datagram matters to the network, so its bytes are zeros, and an attribute holds
the message. A datagram with a flipped bit is dropped, as by a checksum.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy.players import Chunk, Held, Player, Row
from skytether.server.schemes.delay_bound import DelayBound, add_sample, delay_bound
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.kernel import kernel
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.endpoints.endpoint import make_datagram
from skytether.shared.telemetry.record import DOWNLINK, UPLINK

ROWS_MAX = 1024
"""Largest number of rows of a chunk."""
UNDER_WAY_MAX = 4096
"""Largest number of reports, and of answers, that the agent remembers; the oldest are forgotten."""
DELAY_STEPS_MAX = 4096
ANSWER_BYTES = 22
"""Size of an answer without its rows [B]: session, generation, step of the first row (8 B), number
of rows (2 B), checksum; fields without a number in brackets have 4 B."""
REPORT_BYTES = 36
"""Size of a report without its observation [B]: session, step (8 B), the player's number of the
step (8 B), newest generation held, step of its arrival (8 B), checksum."""
PART_BYTES = 12
"""Size of a datagram's header in a split message [B]: message, number, count; as large as RTP's."""


class Network(NamedTuple):
    uplink: Impairments
    """Impairments from agent to robot."""
    downlink: Impairments
    """Impairments from robot to agent."""
    seed: int
    mtu: int
    """Largest UDP payload of a datagram [B]."""


class ObservationReport(NamedTuple):
    """Report of a robot to its agent: an observation, and the newest chunk that the robot holds."""

    step: int
    number: int
    """Step number by the count of the robot's player, the default of `Chunk.first` of an answer."""
    acknowledged: int
    """Generation (number) of the newest chunk that the robot held; 0 without a chunk."""
    since: int
    """Step at which the generation `acknowledged` arrived."""
    observation: Any


@dataclass(slots=True)
class Message:
    session: int
    content: Held | ObservationReport
    missing: set[int]
    """Numbers of the message's datagrams that have not arrived yet."""


class Part(bytes):
    """Datagram of a message. A copy with a flipped bit is plain bytes, not a `Part`."""

    message: Message
    number: int


@dataclass(slots=True)
class Robot:
    player: Player
    report: ObservationReport
    """Newest report that the agent has received."""
    uplink: Lane
    downlink: Lane
    sent: OrderedDict[int, tuple[int, Held]]
    """Answers under way by generation: step of the observation that was answered, and the rows."""
    snapshots: OrderedDict[int, Player]
    """Snapshots of the robot's player at the steps of reports that are under way, by step."""
    session: int = 0
    generation: int = 0
    acknowledged: int = 0
    since: int = 0
    exhausted: int = 0
    """Number of steps at which the robot had no row of actions left."""


@kernel
def learn(bound: DelayBound, row: int, delay: int) -> None:
    """Add a sample [steps] to the delay bound of a robot."""
    add_sample(bound, row, delay)


class Remote:
    """Robots, their agents, and the network between them.

    Args:
        make_player: called for each robot and episode.
        step_ns: length of a step of the environment [ns].
        none: empty array of rows of actions; shape (0, *row).
        shown: number of rows in `coming` and `committed`.
        fill: returns the row that a robot without rows executes, from the robot's last row (None
            before the first); returns None if the agent cannot know that row.
    """

    def __init__(
        self,
        network: Network,
        make_player: Callable[[], Player],
        step_ns: int,
        none: NDArray[Any],
        shown: int,
        fill: Callable[[Row | None], Row | None],
        count: int = 1,
    ) -> None:
        self._network, self._make_player, self._step_ns = network, make_player, step_ns
        self._none, self._shown, self._fill = none, shown, fill
        self.uplink = Link(UPLINK, QUEUE_BYTES_MAX, None, network.uplink)
        self.downlink = Link(DOWNLINK, QUEUE_BYTES_MAX, None, network.downlink)
        self._bound = delay_bound(count, step_ns / SECOND_NS, DELAY_STEPS_MAX, None)
        self._leaving: list[tuple[int, int, Message, int]] = []
        """Answers whose thinking time has not ended: time of sending [ns], robot, message, size
        [B]. A call of `step` adds at most one per robot, and normally lasts until all are sent."""
        self._robots: list[Robot] = []
        self.step = 0
        self._flows = 0

    @property
    def now_ns(self) -> int:
        return self.step * self._step_ns

    def begin(self, observations: Sequence[Any], robots: Sequence[int]) -> None:
        """Begin an episode of some robots; each agent gets the first observation without delay."""
        for index, observation in zip(robots, observations, strict=True):
            flow = self._flows
            self._flows += 1
            robot = Robot(
                player := self._make_player(),
                ObservationReport(self.step, player.number(self.step), 0, 0, observation),
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

    def answer(self, index: int, chunk: Chunk, at_ns: int) -> int:
        """Send rows to a robot at the time `at_ns` [ns]; returns the number of datagrams."""
        robot, rows = self._robots[index], chunk.rows
        robot.generation += 1
        first = robot.report.number if chunk.first is None else chunk.first
        sent = Held(robot.generation, first, rows)
        _remember(robot.sent, robot.generation, (robot.report.step, sent))
        size = ANSWER_BYTES + rows.nbytes
        count = self._datagrams(size)
        self._leaving.append((at_ns, index, Message(robot.session, sent, set(range(count))), size))
        return count

    def _datagrams(self, size: int) -> int:
        """Number of datagrams into which a message of a given size [B] is split."""
        mtu = self._network.mtu
        return 1 if size <= mtu else -(-size // (mtu - PART_BYTES))

    def rows(self) -> list[Row | None]:
        """Row of actions of each robot for the present step; None for a robot without rows left."""
        self._hear_agents()
        played = [robot.player.row(self.step) for robot in self._robots]
        for robot, row in zip(self._robots, played, strict=True):
            robot.exhausted += row is None
        return played

    def last(self, index: int) -> Row | None:
        """Last row that a robot executed; the robot may repeat that row when no row is left."""
        return self._robots[index].player.last

    def advance(self, observations: Sequence[Any], sizes: Sequence[int]) -> None:
        """Advance to the next step; each robot reports its observation, of the given size [B]."""
        self.step += 1
        self._hear_agents()
        for index, (robot, observation, size) in enumerate(
            zip(self._robots, observations, sizes, strict=True)
        ):
            _remember(robot.snapshots, self.step, copy(robot.player))
            number = robot.player.number(self.step)
            report = ObservationReport(
                self.step, number, robot.acknowledged, robot.since, observation
            )
            whole = REPORT_BYTES + size
            message = Message(robot.session, report, set(range(self._datagrams(whole))))
            self._send(self.downlink, robot.downlink, index, message, whole, self.now_ns)
        self._hear_robots()

    def _send(
        self, link: Link, lane: Lane, index: int, message: Message, size: int, at_ns: int
    ) -> None:
        parts = sorted(message.missing)
        left = size + (PART_BYTES * len(parts) if len(parts) > 1 else 0)
        for number in parts:
            part = Part(min(left, self._network.mtu))
            part.message, part.number = message, number
            left -= len(part)
            link.accept(make_datagram((part, ("", index), 0)), lane, now_ns=at_ns)
        if lane.fates.fault:
            raise ConfigError(lane.fates.fault.splitlines()[-1])

    def _arrived(self, link: Link) -> list[tuple[int, Any]]:
        """Robot and content of each message whose last missing datagram has arrived by now."""
        found = []
        for part, (_, index), _ in link.release(now_ns=self.now_ns):
            if not isinstance(part, Part):
                continue  # a copy with a flipped bit, see `Part`
            message = part.message
            message.missing.discard(part.number)
            if not message.missing and message.session == self._robots[index].session:
                found.append((index, message.content))
        return found

    def _hear_agents(self) -> None:
        now_ns = self.now_ns
        for at_ns, index, message, size in [each for each in self._leaving if each[0] <= now_ns]:
            self._send(self.uplink, self._robots[index].uplink, index, message, size, at_ns)
        self._leaving = [each for each in self._leaving if each[0] > now_ns]
        for index, chunk in self._arrived(self.uplink):
            robot = self._robots[index]
            robot.player.accept(chunk, self.step)
            if chunk.generation > robot.acknowledged:
                robot.acknowledged, robot.since = chunk.generation, self.step

    def _hear_robots(self) -> None:
        for index, report in self._arrived(self.downlink):
            robot = self._robots[index]
            if report.step <= robot.report.step:
                continue  # overtaken by a newer report
            robot.report = report
            made = robot.sent.get(report.acknowledged)
            _forget_before(robot.sent, report.acknowledged + 1)
            _forget_before(robot.snapshots, report.step)
            if made is not None:
                learn(self._bound, index, report.since - made[0])

    def report(self, index: int) -> ObservationReport:
        return self._robots[index].report

    def info(self, index: int) -> dict[str, Any]:
        """Entries of `info` for the agent of a robot, as docs/gym.md lists them."""
        robot, report = self._robots[index], self._robots[index].report
        age_steps = self.step - report.step
        # Before the first acknowledgement, both directions are assumed to be equally slow.
        delay_steps = int(self._bound.steps[index]) or 2 * age_steps
        held, every, settled, until = self._coming(robot, delay_steps)
        up, down = self.uplink.counts, self.downlink.counts
        return {
            "step": report.step,
            "age_s": age_steps * self._step_ns / SECOND_NS,
            "generation": robot.generation,
            "acknowledged": report.acknowledged,
            "delay_steps": delay_steps,
            "held": held,
            "coming": self._padded(every[:until]),
            "coming_rows": until,
            "committed": self._padded(every[:settled]),
            "committed_rows": settled,
            "exhausted_steps": robot.exhausted,
            "uplink_packets": up.packets,
            "uplink_bytes": up.bytes + HEADER_BYTES * up.packets,
            "downlink_packets": down.packets,
            "downlink_bytes": down.bytes + HEADER_BYTES * down.packets,
            "lost": sum(each.lost + each.dropped + each.overflowed for each in (up, down)),
        }

    def _padded(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Rows padded with zeros to `shown` rows, so that vector environments can stack them."""
        padded = np.zeros((self._shown, *rows.shape[1:]), rows.dtype)
        padded[: len(rows)] = rows
        return padded

    def _coming(self, robot: Robot, delay_steps: int) -> tuple[int, NDArray[Any], int, int]:
        """Predict, as the agent can, at most `shown` rows that a robot executes from the newest
        report's step on. An answer under way is expected to arrive `delay_steps` after the
        observation that it answers.

        Returns: number of rows that the robot held at that step, the predicted rows, number of
        predicted rows within `delay_steps`, and number of rows before the robot runs out of rows.
        """
        step, rows = robot.report.step, list[Row]()
        if step not in robot.snapshots:
            return 0, self._none, 0, 0
        player, held = copy(robot.snapshots[step]), 0
        alone = copy(player)
        while held < self._shown and alone.row(step + held) is not None:
            held += 1
        under_way = [each for each in robot.sent.values() if each[0] + delay_steps > step]
        ran_out: int | None = None
        for at in range(step, step + self._shown):
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
        every = np.array(rows, self._none.dtype).reshape(len(rows), *self._none.shape[1:])
        settled = min(delay_steps, len(every))
        return held, every, settled, len(every) if ran_out is None else ran_out


def _remember(by_number: OrderedDict[int, Any], number: int, value: object) -> None:
    by_number[number] = value
    if len(by_number) > UNDER_WAY_MAX:
        by_number.popitem(last=False)


def _forget_before(by_number: OrderedDict[int, Any], number: int) -> None:
    while by_number and next(iter(by_number)) < number:
        by_number.popitem(last=False)
