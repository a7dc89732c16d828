"""Robots and remote agents, connected by one network in virtual time.

At each step a robot reports what it observes (downlink), and the agent may answer with a chunk of
actions (uplink). The rules are those of `skytether.policy`: datagrams of a message with parity for
the measured loss, the delay bound, and the rows that are committed. But a robot here moves on while
it has no rows, and there is neither a send rate nor a report on datagrams: their receiver's counts
reach the sender without delay. Netem decides loss and delay of each datagram. All robots share the
two directions and their finite rates.

Only the size of a datagram matters to the network, so its bytes are zeros, and an attribute holds
the message. A datagram with a flipped bit is dropped, as by a checksum.
"""

from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy.committed import DELAYS, UnderWay
from skytether.policy.form import PART_HEAD_BYTES, Form, form_of
from skytether.policy.pace import LOSS_FIRST, Tally, filtered
from skytether.policy.players import Chunk, Held, Player, Row
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import HEADER_BYTES, SECOND_NS
from skytether.shared.endpoints.endpoint import make_datagram
from skytether.shared.telemetry.record import DOWNLINK, UPLINK

ROWS_MAX = 1024
"""Largest number of rows of a chunk."""
ANSWER_BYTES, REPORT_BYTES = 60, 74
"""Size of an answer without its rows, and of a report without its observation [B]: as
`skytether.policy` sends an array."""


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
    player: Player
    """Robot's player at that step, which the agent could compute from its chunks."""
    acknowledged: int
    """Newest generation of chunks that the robot held; 0 for none."""
    delay: int
    """Delay bound d [steps]; 0 before the first chunk."""
    observation: Any


@dataclass(slots=True)
class Message:
    session: int
    number: int
    form: Form
    content: tuple[int, Held] | ObservationReport
    """Chunk, with the step of its observation; or report."""
    places: list[set[int]]
    """Indices of the parts of each block that have arrived."""

    @property
    def parts(self) -> int:
        return self.form.blocks * (self.form.data + self.form.parity)


class Part(bytes):
    """Datagram of a message. A copy with a flipped bit is plain bytes, not a `Part`."""

    message: Message
    block: int
    place: int


@dataclass(slots=True)
class Way:
    """One direction of one robot."""

    link: Link
    lane: Lane
    loss: float = LOSS_FIRST
    """Measured packet loss ratio."""
    sent: int = 0
    """Number of messages so far."""
    whole: int = -1
    """Number of the newest complete message; earlier ones are not accepted any more."""
    tally: Tally = field(default_factory=Tally)

    def accept(self, part: Part) -> bool:
        """Accept a part; returns whether it completes its message."""
        message = part.message
        sent, came = self.tally.add(message.number, message.parts, (part.block, part.place))
        if sent:
            self.loss = filtered(self.loss, sent, came)
        message.places[part.block].add(part.place)
        if message.number <= self.whole:
            return False
        if any(len(each) < message.form.data for each in message.places):
            return False
        self.whole = message.number
        return True


@dataclass(slots=True)
class Robot:
    player: Player
    report: ObservationReport
    """Newest report that the agent has received."""
    uplink: Way
    downlink: Way
    session: int = 0
    under_way: UnderWay = field(default_factory=UnderWay)
    delays: deque[int] = field(default_factory=lambda: deque(maxlen=DELAYS))
    """Newest delays from an observation to its chunk [steps]."""
    generation: int = 0
    acknowledged: int = 0
    held: int = 0
    """Number of rows that the robot had at `report`."""
    exhausted: int = 0
    """Number of steps at which the robot had no row of actions left."""


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
    ) -> None:
        self._network, self._make_player, self._step_ns = network, make_player, step_ns
        self._none, self._shown, self._fill = none, shown, fill
        self.uplink = Link(UPLINK, QUEUE_BYTES_MAX, None, network.uplink)
        self.downlink = Link(DOWNLINK, QUEUE_BYTES_MAX, None, network.downlink)
        self._leaving: list[tuple[int, int, Message]] = []
        """Answers whose thinking time has not ended: time of sending [ns], robot, message. At most
        one per robot in a call of `step`, which normally lasts until they are sent."""
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
                ObservationReport(self.step, copy(player), 0, 0, observation),
                self._way(self.uplink, "uplink", flow),
                self._way(self.downlink, "downlink", flow),
                session=flow,
            )
            self._robots[index : index + 1] = [robot]

    def _way(self, link: Link, name: str, flow: int) -> Way:
        fates = Fates(link.impairments, self._network.seed, name, flow)
        return Way(link, Lane(flow, fates, self.now_ns))

    def answer(self, index: int, chunk: Chunk, at_ns: int) -> int:
        """Send rows to a robot at the time `at_ns` [ns]; returns the number of datagrams."""
        robot, rows = self._robots[index], chunk.rows
        robot.generation += 1
        made, first = robot.report.step, chunk.first
        first = robot.report.player.number(made) if first is None else first
        held = Held(robot.generation, first, rows)
        robot.under_way.add(made, held)
        is_urgent = robot.held <= self._delay(robot)
        size = ANSWER_BYTES + rows.nbytes
        message = self._message(robot, robot.uplink, (made, held), size, is_urgent=is_urgent)
        self._leaving.append((at_ns, index, message))
        return message.parts

    def _delay(self, robot: Robot) -> int:
        """Delay bound d [steps]. Before the first chunk, both directions count as equally slow."""
        return robot.report.delay or 2 * (self.step - robot.report.step)

    def _message(
        self, robot: Robot, way: Way, content: Any, size: int, *, is_urgent: bool = False
    ) -> Message:
        part_bytes = self._network.mtu - PART_HEAD_BYTES
        form = form_of(size, way.loss, is_urgent=is_urgent, part_bytes=part_bytes)
        way.sent += 1
        return Message(robot.session, way.sent, form, content, [set() for _ in range(form.blocks)])

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
            player, delay = copy(robot.player), max(robot.delays, default=0)
            report = ObservationReport(self.step, player, robot.acknowledged, delay, observation)
            message = self._message(robot, robot.downlink, report, REPORT_BYTES + size)
            self._send(robot.downlink, index, message, self.now_ns)
        self._hear_robots()

    def _send(self, way: Way, index: int, message: Message, at_ns: int) -> None:
        """Send the parts of a message, those of its blocks in turn."""
        form = message.form
        for place in range(form.data + form.parity):
            for block in range(form.blocks):
                part = Part(form.length + PART_HEAD_BYTES)
                part.message, part.block, part.place = message, block, place
                way.link.accept(make_datagram((part, ("", index), 0)), way.lane, now_ns=at_ns)
        if way.lane.fates.fault:
            raise ConfigError(way.lane.fates.fault.splitlines()[-1])

    def _arrived(self, link: Link) -> list[tuple[Robot, Any]]:
        """Robot and content of each message that is complete by now."""
        found = []
        for part, (_, index), _ in link.release(now_ns=self.now_ns):
            robot = self._robots[index]
            # A copy with a flipped bit is no `Part`.
            if isinstance(part, Part) and part.message.session == robot.session:
                way = robot.uplink if link is self.uplink else robot.downlink
                if way.accept(part):
                    found.append((robot, part.message.content))
        return found

    def _hear_agents(self) -> None:
        now_ns = self.now_ns
        for at_ns, index, message in [each for each in self._leaving if each[0] <= now_ns]:
            self._send(self._robots[index].uplink, index, message, at_ns)
        self._leaving = [each for each in self._leaving if each[0] > now_ns]
        for robot, (made, chunk) in self._arrived(self.uplink):
            robot.player.accept(chunk, self.step)
            robot.acknowledged = chunk.generation
            robot.delays.append(self.step + len(robot.player.settled) - made)

    def _hear_robots(self) -> None:
        for robot, report in self._arrived(self.downlink):
            robot.report = report
            robot.under_way.acknowledge(report.acknowledged)
            player, robot.held = copy(report.player), 0
            while robot.held < self._shown and player.row(report.step + robot.held) is not None:
                robot.held += 1

    def report(self, index: int) -> ObservationReport:
        return self._robots[index].report

    def info(self, index: int) -> dict[str, Any]:
        """Entries of `info` for the agent of a robot, as docs/gym.md lists them."""
        robot, report = self._robots[index], self._robots[index].report
        age_steps, delay_steps = self.step - report.step, self._delay(robot)
        every, settled, until = self._coming(robot, delay_steps)
        up, down = self.uplink.counts, self.downlink.counts
        return {
            "step": report.step,
            "age_s": age_steps * self._step_ns / SECOND_NS,
            "generation": robot.generation,
            "acknowledged": report.acknowledged,
            "delay_steps": delay_steps,
            "held": robot.held,
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

    def _coming(self, robot: Robot, delay_steps: int) -> tuple[NDArray[Any], int, int]:
        """Rows that a robot executes from the observation's step on, as its agent predicts them.

        Returns: the rows, number of them within `delay_steps`, and number before rows run out.
        """
        step = robot.report.step
        player, fill = copy(robot.report.player), self._fill
        rows, until = robot.under_way.predict(player, step, delay_steps, self._shown, fill)
        every = np.array(rows, self._none.dtype).reshape(len(rows), *self._none.shape[1:])
        return every, min(delay_steps, len(every)), until
