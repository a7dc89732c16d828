"""Robots and remote agents, connected by one network in virtual time.

At each step a robot reports what it observes (downlink), and the agent may answer with a chunk of
actions (uplink). The rules are those of `skytether.policy`: datagrams of a message with parity for
the measured loss, the delay bound, the rows that are committed and, in a direction with a finite
rate, the send rate. But a robot here moves on while it has no rows, and no datagram reports on
those received: their receiver's counts reach the sender without delay. Netem decides loss and delay
of each datagram. All robots share the two directions and their finite rates.

Only the size of a datagram matters to the network, so its bytes are zeros, and an attribute holds
the message. A datagram with a flipped bit is dropped, as by a checksum.
"""

from collections import deque
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments
from skytether.netem.link import QUEUE_BYTES_MAX, Lane, Link
from skytether.policy.committed import DELAYS, UnderWay
from skytether.policy.form import PART_HEAD_BYTES, Form, form_of
from skytether.policy.pace import Pace, Tally, filtered, fit
from skytether.policy.players import Chunk, Held, Player, Row
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import HEADER_BYTES, MICROSECOND_NS, SECOND_NS
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
    form: Form
    content: tuple[int, Held] | ObservationReport
    """Chunk, with the step of its observation; or report."""
    places: list[set[int]]
    """Indices of the parts of each block that have arrived."""
    number: int = 0
    """Number of the message in its direction, from the time at which its first part is sent."""
    times_us: list[tuple[int, int]] = field(default_factory=list)
    """Send and receive time of each part that has arrived [µs]."""
    was_limited: bool = False
    """Whether the send rate has delayed a part."""

    @property
    def parts(self) -> int:
        return self.form.blocks * (self.form.data + self.form.parity)


class Part(bytes):
    """Datagram of a message. A copy with a flipped bit is plain bytes, not a `Part`."""

    message: Message
    block: int
    place: int
    sent_us: int
    """Send time [µs]."""


@dataclass(slots=True)
class Way:
    """One direction of one robot."""

    link: Link
    lane: Lane
    is_paced: bool
    """Whether the direction has a finite rate, to which the send rate adapts."""
    pace: Pace = field(default_factory=Pace)
    """Measured packet loss ratio, and send rate."""
    sent: int = 0
    """Number of messages so far, without those replaced before they were sent."""
    queue: deque[Part] = field(default_factory=deque)
    """Parts of the present message that are not sent yet."""
    next: Message | None = None
    """Newest message that waits for these parts."""
    whole: int = -1
    """Number of the newest complete message; earlier ones are not accepted any more."""
    coming: Message | None = None
    """Message of which parts have arrived, before the sender learns of them."""
    tally: Tally = field(default_factory=Tally)

    def begin(self, message: Message) -> None:
        """Queue the parts of a message, those of its blocks in turn."""
        self.sent += 1
        message.number, form = self.sent, message.form
        for place in range(form.data + form.parity):
            for block in range(form.blocks):
                part = Part(form.length + PART_HEAD_BYTES)
                part.message, part.block, part.place = message, block, place
                self.queue.append(part)

    def accept(self, part: Part, now_ns: int) -> bool:
        """Accept a part; returns whether it completes its message."""
        message = part.message
        sent, came = self.tally.add(message.number, message.parts, (part.block, part.place))
        if sent:
            self.pace.loss = filtered(self.pace.loss, sent, came)
        if self.is_paced:
            self._measure(part, now_ns)
        message.places[part.block].add(part.place)
        if message.number <= self.whole:
            return False
        if any(len(each) < message.form.data for each in message.places):
            return False
        self.whole = message.number
        return True

    def _measure(self, part: Part, now_ns: int) -> None:
        """Update the send rate, as `policy.exchange` does by a report."""
        message = part.message
        if part.place in message.places[part.block]:
            return  # a duplicate
        if self.coming and message.number > self.coming.number:
            self._learn(self.coming, now_ns)
        if self.coming is None and message.number > self.whole:
            self.coming = message
        if message is self.coming:
            message.times_us.append((part.sent_us, now_ns // MICROSECOND_NS))
            if len(message.times_us) == message.parts:
                self._learn(message, now_ns)

    def _learn(self, message: Message, now_ns: int) -> None:
        self.coming = None
        train, came = fit(message.times_us), len(message.times_us)
        self.pace.heard(
            message.parts,
            came,
            came * (message.form.length + PART_HEAD_BYTES + HEADER_BYTES),
            train.first_us * MICROSECOND_NS,
            train.last_us * MICROSECOND_NS,
            2 * train.last_us * MICROSECOND_NS,
            train.spread_us * MICROSECOND_NS,
            was_limited=message.was_limited,
            now_ns=now_ns,
        )


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
        self._sending: list[tuple[int, int, int, Way]] = []
        """Heap of the directions with parts to be sent: time of the next part [ns], order, robot.
        """
        self._order = 0
        self._robots: list[Robot] = []
        self.step = 0
        self._flows = 0

    @property
    def now_ns(self) -> int:
        return self.step * self._step_ns

    def begin(self, observations: Sequence[Any], robots: Sequence[int]) -> None:
        """Begin an episode of some robots; each agent gets the first observation without delay.

        What is not sent yet of an earlier episode is not sent any more.
        """
        self._leaving = [each for each in self._leaving if each[1] not in robots]
        self._sending = sorted(each for each in self._sending if each[2] not in robots)
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
        is_paced = link.impairments.queue is not None
        return Way(link, Lane(flow, fates, self.now_ns), is_paced)

    def answer(self, index: int, chunk: Chunk, at_ns: int) -> int:
        """Send rows to a robot at the time `at_ns` [ns], but not before an earlier answer of its
        agent; returns the number of datagrams.
        """
        robot, rows = self._robots[index], chunk.rows
        robot.generation += 1
        made, first = robot.report.step, chunk.first
        first = robot.report.player.number(made) if first is None else first
        held = Held(robot.generation, first, rows)
        robot.under_way.add(made, held)
        is_urgent = robot.held <= self._delay(robot)
        size = ANSWER_BYTES + rows.nbytes
        message = self._message(robot, robot.uplink, (made, held), size, is_urgent=is_urgent)
        at_ns = max([at_ns, *(each[0] for each in self._leaving if each[1] == index)])
        self._leaving.append((at_ns, index, message))
        return message.parts

    def _delay(self, robot: Robot) -> int:
        """Delay bound d [steps]. Before the first chunk, both directions count as equally slow."""
        return robot.report.delay or 2 * (self.step - robot.report.step)

    def _message(
        self, robot: Robot, way: Way, content: Any, size: int, *, is_urgent: bool = False
    ) -> Message:
        part_bytes = self._network.mtu - PART_HEAD_BYTES
        form = form_of(size, way.pace.loss, is_urgent=is_urgent, part_bytes=part_bytes)
        return Message(robot.session, form, content, [set() for _ in range(form.blocks)])

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
        """Advance to the next step; each robot reports its observation, of the given size [B].

        A robot that still executes rows of its last answer reports nothing.
        """
        self.step += 1
        self._hear_agents()
        for index, (robot, observation, size) in enumerate(
            zip(self._robots, observations, sizes, strict=True)
        ):
            if robot.player.settled:
                continue
            player, delay = copy(robot.player), max(robot.delays, default=0)
            report = ObservationReport(self.step, player, robot.acknowledged, delay, observation)
            message = self._message(robot, robot.downlink, report, REPORT_BYTES + size)
            self._send(robot.downlink, index, message, self.now_ns)
        self._hear_robots()

    def _send(self, way: Way, index: int, message: Message, at_ns: int) -> None:
        """Send a message from the time `at_ns` on; it replaces an earlier one that still waits."""
        self._send_until(at_ns)
        if way.queue:
            way.next = message
            return
        way.begin(message)
        self._continue(way, index, at_ns)

    def _continue(self, way: Way, index: int, at_ns: int) -> None:
        """Send further parts from the time `at_ns` on."""
        self._order += 1
        heappush(self._sending, (at_ns, self._order, index, way))

    def _send_until(self, now_ns: int) -> None:
        """Send all parts that are due."""
        while self._sending and self._sending[0][0] <= now_ns:
            at_ns, _, index, way = heappop(self._sending)
            while way.queue:
                part, due_ns = way.queue[0], way.pace.due_ns() if way.is_paced else at_ns
                if due_ns > at_ns:
                    part.message.was_limited = True
                    self._continue(way, index, due_ns)
                    break
                way.queue.popleft()
                part.sent_us = at_ns // MICROSECOND_NS
                way.link.accept(make_datagram((part, ("", index), 0)), way.lane, now_ns=at_ns)
                if way.is_paced:
                    way.pace.sent(len(part) + HEADER_BYTES, at_ns)
                if not way.queue and way.next:
                    way.begin(way.next)
                    way.next = None
            if way.lane.fates.fault:
                raise ConfigError(way.lane.fates.fault.splitlines()[-1])

    def _arrived(self, link: Link) -> list[tuple[Robot, Any]]:
        """Robot and content of each message that is complete by now."""
        found = []
        while (due_ns := link.next_due_ns()) is not None and due_ns <= self.now_ns:
            # With a finite rate each part has its own receive time, which the send rate follows.
            at_ns = self.now_ns if link.impairments.queue is None else due_ns
            for part, (_, index), _ in link.release(now_ns=at_ns):
                robot = self._robots[index]
                # A copy with a flipped bit is no `Part`.
                if isinstance(part, Part) and part.message.session == robot.session:
                    way = robot.uplink if link is self.uplink else robot.downlink
                    if way.accept(part, at_ns):
                        found.append((robot, part.message.content))
        return found

    def _hear_agents(self) -> None:
        now_ns = self.now_ns
        leaving = [each for each in self._leaving if each[0] <= now_ns]
        for at_ns, index, message in sorted(leaving, key=lambda each: each[0]):
            self._send(self._robots[index].uplink, index, message, at_ns)
        self._leaving = [each for each in self._leaving if each[0] > now_ns]
        self._send_until(now_ns)
        for robot, (made, chunk) in self._arrived(self.uplink):
            robot.player.accept(chunk, self.step)
            robot.acknowledged = chunk.generation
            robot.delays.append(self.step + len(robot.player.settled) - made)

    def _hear_robots(self) -> None:
        self._send_until(self.now_ns)
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
