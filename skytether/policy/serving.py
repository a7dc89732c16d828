"""Policy end: receives observations of robots and sends them the policy's action chunks.

The policy is connected through the local connection (socket 1): a websocket connection for each
robot, with openpi's protocol, or a function. While the policy computes a chunk, only the newest
further observation of the robot is kept. An error of the policy, or a lost websocket connection, is
sent to the robot end as an error, and the robot continues with its remaining rows.
"""

from collections import Counter, OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from skytether.policy import events, values
from skytether.policy.committed import RobotRows, UnderWay
from skytether.policy.exchange import Exchange
from skytether.policy.images import Unpacker
from skytether.policy.messages import (
    CHUNK,
    METADATA,
    OBSERVATION,
    Hello,
    ObservationContent,
    Part,
    Welcome,
    content,
    decode,
    encode,
)
from skytether.policy.pace import RATE_MAX
from skytether.policy.players import Clocked, Held
from skytether.policy.robot import LINE, ROWS_SENT, FrameType
from skytether.policy.schedule import rows_of
from skytether.policy.values import ValueRefused
from skytether.server.gate import Gate, GateCall, ReplyPath
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, by_name
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Refusal

ROBOTS_MAX = 64
"""Largest number of robots with a session."""
SILENCE_NS = 10 * SECOND_NS
"""Time without a datagram after which a robot's session ends [ns]."""
PATH_NS = 3 * SECOND_NS
"""Time without a datagram from an address after which no datagram is sent to the address [ns]."""
PATHS_MAX = 4
"""Largest number of addresses of a robot; the least recently used are discarded."""
REPLACED_MAX = 16
"""Largest number of earlier runs that are remembered of a robot."""
AGAIN_NS = SECOND_NS
"""Time after which a lost connection to the policy is reopened [ns]."""
METADATA_BYTES_MAX = values.BYTES_MAX - 16
"""Largest metadata of the policy [B]."""
POLICY = "policy"
"""Name in the policy's peer address on the local socket: `(POLICY, connection number)`. The numbers
are not reused, so a reply that arrives after its connection has ended is ignored."""


class _Job(NamedTuple):
    """Observation for the policy."""

    call: int
    is_urgent: bool
    """Whether the robot's rows are expected to run out before the chunk arrives."""
    observation: Any
    delay: int
    """Delay bound d [steps]."""
    held: RobotRows | None
    """Rows that the robot has; None if it does not send them."""


@dataclass(slots=True)
class _Robot:
    """Session of a robot, and its connection to the policy."""

    number: int
    boot_id: int
    reply: ReplyPath
    exchange: Exchange
    heard_ns: int
    paths: "OrderedDict[tuple[int, Address], int]" = field(default_factory=OrderedDict)
    """Time of the newest datagram [ns] of each socket and address, newest last."""
    waiting: _Job | None = None
    """Newest observation that waits for the policy."""
    thinking: _Job | None = None
    """Observation for which the policy computes a chunk."""
    answered: tuple[int, bytes] = (-1, b"")
    """Number of the newest call with a chunk, and the message with that chunk."""
    under_way: UnderWay = field(default_factory=UnderWay)
    connection: int = 0
    """Number of the connection to the policy; 0 while it is closed."""
    is_open: bool = False
    """Whether the policy has sent its metadata over this connection."""
    due_ns: int | None = None
    """Time at which a closed connection is reopened, or at which a connection is given up because
    metadata or a reply are missing [ns]; None: neither."""
    was_lost: bool = False
    """Whether a connection to the policy was lost before."""
    has_metadata: bool = False
    replaced: tuple[int, ...] = ()
    """`boot_id` of the newest earlier runs whose session this one ended."""

    @property
    def session(self) -> int:
        return self.exchange.session

    def hear(self, line: ReplyPath, datagram: Datagram, now_ns: int) -> None:
        """Record the source of a datagram."""
        at = datagram.socket, datagram.peer
        self.reply, self.heard_ns, self.paths[at] = line, now_ns, now_ns
        self.paths.move_to_end(at)
        while len(self.paths) > PATHS_MAX:
            self.paths.popitem(last=False)


class PolicyEnd(Endpoint):
    """Policy end of the sessions of several robots.

    Args:
        gate: decryption and admission of robots, see `server.gate`.
        boot_id: random number of this run.
        draw: returns an unpredictable 32-bit number, used as session number.
        patience_ns: longest time for a reply of the policy; then the connection is reopened [ns].
        gives_rows: whether observations get the keys `delay_steps` (the delay bound d), `coming`
            (the rows that the robot will execute from the observation's step on) and `committed`
            (the first d of them), see module `committed`.
        rate_max: largest send rate to each robot [B/s].
    """

    def __init__(
        self,
        gate: Gate,
        *,
        boot_id: int,
        draw: Callable[[], int],
        patience_ns: int = 30 * SECOND_NS,
        gives_rows: bool = False,
        rate_max: float = RATE_MAX,
    ) -> None:
        super().__init__()
        self._gate, self._boot_id, self._draw = gate, boot_id, draw
        self._patience_ns, self._gives_rows, self._rate_max = patience_ns, gives_rows, rate_max
        self._robots: dict[int, _Robot] = {}
        self._welcomed: dict[int, _Robot] = {}
        """Robots by number that have sent only a HELLO; the HELLO may be a replay."""
        self._connections = 0
        self._metadata: bytes | None = None
        self._drops = Counter[str]()
        self._counts = Counter[str]()

    # -- datagrams -----------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        if datagram.socket == LINE and datagram.peer[0] == POLICY:
            self._hear_policy(datagram.payload, datagram.peer[1], now_ns)
        else:
            try:
                self._hear_robot(datagram, now_ns)
            except ProtocolError as error:
                self._drops[error.reason] += 1
            self._out += self._gate.outbox()
        self._send(now_ns)

    def _hear_robot(self, datagram: Datagram, now_ns: int) -> None:
        call = self._gate.open(datagram, now_ns=now_ns)
        if call is None:
            return
        message = decode(call.payload)
        if isinstance(message, Hello):
            self._welcome(message, call, datagram, now_ns)
            return
        if isinstance(message, Welcome):
            raise ProtocolError(Drop.NOT_FOR_A_SERVER)
        robot = self._robot(message.session, call, now_ns)
        if call.vehicle is None and (datagram.socket, datagram.peer) not in robot.paths:
            raise ProtocolError(Drop.ELSEWHERE)
        robot.hear(call.line, datagram, now_ns)
        if isinstance(message, Part):
            if message.stream != OBSERVATION:
                raise ProtocolError(Drop.FIELD)
            if arrived := robot.exchange.accept(message, now_ns=now_ns):
                self._observe(robot, arrived, now_ns)
            return
        if message.came:
            robot.exchange.learn(message, now_ns=now_ns)
        else:  # keep-alive, which includes whether the robot end has the metadata; it is echoed
            robot.has_metadata = message.number > 0
            self.send(call.line.seal(call.payload), datagram.peer, datagram.socket)
            self._give_metadata(robot)

    def _robot(self, session: int, call: GateCall, now_ns: int) -> _Robot:
        """Robot that has this session.

        Raises:
            ProtocolError: the session does not exist or belongs to another robot.
        """
        for robots in (self._welcomed, self._robots):
            for robot in robots.values():
                if robot.session == session and call.vehicle in (None, robot.number):
                    if robots is self._welcomed:
                        self._begin(robot, now_ns)
                    return robot
        raise ProtocolError(Drop.UNKNOWN_SESSION)

    def _welcome(self, hello: Hello, call: GateCall, datagram: Datagram, now_ns: int) -> None:
        number, is_plain = hello.robot, call.vehicle is None
        if call.vehicle not in (None, number):
            raise ProtocolError(Drop.OF_ANOTHER_VEHICLE)
        present, robot, refusal = self._robots.get(number), None, Refusal.ACCEPTED
        if present is None and len(self._robots) >= ROBOTS_MAX:
            refusal = Refusal.FULL
        elif present and hello.boot_id != present.boot_id and now_ns - present.heard_ns < PATH_NS:
            # Without keys anybody may send this number; the robot with a session keeps it. With
            # keys the newest run gets it, and the one before must not take it back.
            is_here = (datagram.socket, datagram.peer) in present.paths
            is_taken = not is_here if is_plain else hello.boot_id in present.replaced
            refusal = Refusal.TAKEN if is_taken else Refusal.ACCEPTED
        if refusal is Refusal.ACCEPTED:
            of_run = (present, self._welcomed.get(number))
            robot = next((each for each in of_run if each and each.boot_id == hello.boot_id), None)
            if robot is None:
                exchange = Exchange(self._new_session(), self._rate_max)
                robot = _Robot(number, hello.boot_id, call.line, exchange, now_ns)
                self._welcomed[number] = robot
            if is_plain:
                if robot is not present:
                    self._begin(robot, now_ns)
                robot.hear(call.line, datagram, now_ns)
        session = robot.session if robot else 0
        welcome = Welcome(number, session, hello.boot_id, self._boot_id, refusal)
        self.send(call.line.seal(encode(welcome)), datagram.peer, datagram.socket)
        if robot:
            self._gate.admit(call, now_ns=now_ns)

    def _new_session(self) -> int:
        robots = (*self._robots.values(), *self._welcomed.values())
        taken = {0, *(each.session for each in robots)}
        while (session := self._draw()) in taken:
            pass
        return session

    def _begin(self, robot: _Robot, now_ns: int) -> None:
        """Begin the session of a robot that got a WELCOME, with a new connection to the policy,
        since a new episode begins.
        """
        if before := self._robots.get(robot.number):
            self._close(before)
            robot.replaced = (*before.replaced, before.boot_id)[-REPLACED_MAX:]
        self._robots[robot.number] = self._welcomed.pop(robot.number)
        robot.heard_ns = now_ns
        self._open(robot, now_ns)
        self._events.append(events.RobotJoined(robot=robot.number))

    # -- the policy ----------------------------------------------------------------------------

    def _open(self, robot: _Robot, now_ns: int) -> None:
        self._connections += 1
        robot.connection, robot.due_ns = self._connections, now_ns + self._patience_ns
        self.send(FrameType.OPENED.value, (POLICY, robot.connection), LINE)

    def _close(self, robot: _Robot) -> None:
        self.send(FrameType.CLOSED.value, (POLICY, robot.connection), LINE)
        robot.connection, robot.is_open = 0, False

    def _hear_policy(self, said: bytes, connection: int, now_ns: int) -> None:
        robots = self._robots.values()
        robot = next((each for each in robots if each.connection == connection), None)
        if robot is None:
            return
        match said[:1]:
            case FrameType.OPENED if len(said) - 1 > METADATA_BYTES_MAX:
                reason = f"metadata of {len(said) - 1} B, expected at most {METADATA_BYTES_MAX}"
                self._lose(robot, reason, now_ns)
                return
            case FrameType.OPENED:
                robot.is_open, robot.due_ns = True, None
                self._metadata = said[1:]
                self._events.append(events.UpstreamFound(robot=robot.number))
                self._give_metadata(robot)
            case FrameType.CLOSED:
                self._lose(robot, said[1:].decode(errors="replace"), now_ns)
                return
            case _ if robot.thinking is None:
                # Otherwise each later observation would get the reply to the observation before.
                self._lose(robot, "reply without an observation", now_ns)
                return
            case FrameType.MESSAGE:
                self._counts["answers"] += 1
                self._finish(robot, said[1:], "")
            case FrameType.ERROR:
                reason = said[1:].decode(errors="replace").strip() or "unknown"
                self._counts["errors"] += 1
                last = reason.splitlines()[-1][:200]
                self._events.append(events.PolicyFailed(robot=robot.number, reason=last))
                self._finish(robot, b"", last)
        self._ask(robot, now_ns)

    def _lose(self, robot: _Robot, reason: str, now_ns: int) -> None:
        if robot.is_open or not robot.was_lost:
            lost = events.UpstreamLost(robot=robot.number, reason=reason[:200] or "closed")
            self._events.append(lost)
        self._close(robot)
        self._finish(robot, b"", f"connection to the policy lost: {reason[:100]}")
        robot.due_ns, robot.was_lost = now_ns + AGAIN_NS, True

    def _finish(self, robot: _Robot, reply: bytes, error: str) -> None:
        """Send the policy's reply, or an error, to the robot."""
        job, robot.thinking, robot.due_ns = robot.thinking, None, None
        if job is None:
            return
        message = values.pack([job.call, reply, error])
        if len(message) > values.BYTES_MAX:
            error = f"the policy's reply has {len(message)} B, expected at most {values.BYTES_MAX}"
            message = values.pack([job.call, b"", error])
        if not error:  # after an error the robot may send the observation again
            robot.answered = job.call, message
            if job.held and self._gives_rows:
                with suppress(ValueRefused):  # the robot end refuses it too, and logs the reason
                    rows = rows_of(values.unpack(reply), job.held.key).astype(np.float64)
                    robot.under_way.add(job.held.step, Held(job.call, job.held.step, rows))
        robot.exchange.send(CHUNK, message, is_urgent=job.is_urgent)

    def _give_metadata(self, robot: _Robot) -> None:
        is_due = not (robot.has_metadata or robot.exchange.is_sending(METADATA))
        if self._metadata is not None and is_due:
            message = values.pack([self._gives_rows, self._metadata])
            robot.exchange.send(METADATA, message)

    def _observe(self, robot: _Robot, message: bytes, now_ns: int) -> None:
        call, left, delay, held, seen = content(ObservationContent, message)
        rows = held and held.rows
        if rows is not None and not (rows.ndim and len(rows)):
            raise ProtocolError(Drop.FIELD)
        if any(job and job.call == call for job in (robot.thinking, robot.waiting)):
            return  # a repeated observation
        if call == robot.answered[0]:
            robot.exchange.send(CHUNK, robot.answered[1], is_urgent=True)
            return
        try:
            observation = values.unpack(seen, Unpacker())
        except ValueRefused:
            raise ProtocolError(Drop.FIELD) from None
        self._counts["observations"] += 1
        self._counts["replaced"] += robot.waiting is not None
        robot.waiting = _Job(call, left <= delay, observation, delay, held)
        if robot.was_lost and not robot.is_open:
            robot.exchange.send(CHUNK, values.pack([call, b"", "no connection to the policy"]))
        self._ask(robot, now_ns)

    def _ask(self, robot: _Robot, now_ns: int) -> None:
        """Send the newest observation to the policy, if the policy is idle."""
        if not (robot.waiting and robot.is_open and robot.thinking is None):
            return
        job, robot.waiting = robot.waiting, None
        try:
            frame = FrameType.MESSAGE.value + values.pack(self._with_rows(job, robot.under_way))
        except ValueError:  # rows of another shape than those of the policy
            self._drops[Drop.FIELD] += 1
            return
        robot.thinking, robot.due_ns = job, now_ns + self._patience_ns
        self.send(frame, (POLICY, robot.connection), LINE)

    def _with_rows(self, job: _Job, under_way: UnderWay) -> Any:
        """Observation with the rows that the robot will execute, if `gives_rows`."""
        held, delay = job.held, job.delay
        if not (self._gives_rows and held and isinstance(job.observation, dict)):
            return job.observation
        under_way.acknowledge(held.acknowledged)
        player = Clocked()
        if held.rows is not None:
            player.accept(Held(held.acknowledged, held.step, held.rows), held.step)
        rows, _ = under_way.predict(player, held.step, delay, ROWS_SENT)
        keys: dict[str, Any] = {"delay_steps": delay}
        if rows:
            coming = np.stack(rows)
            keys |= {"coming": coming, "committed": coming[:delay]}
        return job.observation | keys

    # -- time ----------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        due: list[int | None] = []
        for robot in self._robots.values():
            due += [robot.heard_ns + SILENCE_NS, robot.due_ns, robot.exchange.due_ns()]
        return min((each for each in due if each is not None), default=None)

    def wake(self, *, now_ns: int) -> None:
        for robot in list(self._robots.values()):
            silence_ns = now_ns - robot.heard_ns
            if silence_ns >= SILENCE_NS:
                silence_s = silence_ns / SECOND_NS
                self._events.append(events.RobotSilent(robot=robot.number, silence_s=silence_s))
                self._close(robot)
                del self._robots[robot.number]
            elif robot.due_ns is None or now_ns < robot.due_ns:
                continue
            elif robot.connection:
                waited_s = self._patience_ns / SECOND_NS
                self._lose(robot, f"no reply within {waited_s:g} s", now_ns)
            else:
                self._open(robot, now_ns)
        self._send(now_ns)

    def _send(self, now_ns: int) -> None:
        for robot in self._robots.values():
            for payload in robot.exchange.outbox(now_ns=now_ns):
                sealed = robot.reply.seal(payload)
                for (socket, peer), heard_ns in robot.paths.items():
                    if heard_ns >= now_ns - PATH_NS:
                        self.send(sealed, peer, socket)

    def figures(self) -> dict[str, Any]:
        return {
            "robots": len(self._robots),
            "observations": self._counts["observations"],
            "observations_replaced": self._counts["replaced"],
            "answers": self._counts["answers"],
            "errors": self._counts["errors"],
            "dropped": by_name(self._drops),
            "by_robot": {
                str(number): robot.exchange.figures() for number, robot in self._robots.items()
            },
        }


def reply_of(infer: Callable[[Any], Any], observation: bytes) -> bytes:
    """Frame with the reply of a function, used as policy, to a serialized observation.

    Args:
        infer: returns the array of actions, or a dict with it as `actions`; an exception is an
            error of the policy.
    """
    try:
        reply = infer(values.unpack(observation, most=values.MADE_BYTES_MAX))
        reply = {"actions": reply} if isinstance(reply, np.ndarray) else reply
        return FrameType.MESSAGE.value + values.pack(reply)
    except (Exception, SystemExit) as error:  # a policy must not end the process
        return FrameType.ERROR.value + f"{type(error).__name__}: {error}".encode()
