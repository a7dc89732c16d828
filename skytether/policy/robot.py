"""The robot's end: answers each call of its program by the deadline, whatever the network does.

The program speaks through the line (socket 1): openpi's websocket protocol, or `Robot.infer`. A
call is an observation. It is answered as soon as its own chunk has come; at the deadline with the
newest chunk that has rows for now, cut to now; then with what holds the robot, for at most
`hold_ns`; then with an error, so that the robot's own stop acts. While chunks take longer than the
deadline, waiting gains nothing: a call is answered at once if rows are left. The first call of a
program is answered when the first chunk has come, within `begin_ns`: the robot has not moved yet.

What the line hears and sends begins with one of `Said`.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from skytether.client.link import ClientLink
from skytether.policy import events, values
from skytether.policy.exchange import Exchange
from skytether.policy.messages import (
    CHUNK,
    METADATA,
    OBSERVATION,
    Hello,
    Seen,
    Welcome,
    decode,
    encode,
)
from skytether.policy.pace import RATE_MAX
from skytether.policy.players import Clocked, Player
from skytether.policy.schedule import Actions, Kind, Schedule
from skytether.policy.values import ValueRefused
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, by_name
from skytether.shared.events.flight import address_text
from skytether.shared.telemetry.record import Recorder
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Refusal

LINE = 1
"""Socket of the line."""
SILENCE_NS = 3 * SECOND_NS
"""Time without a packet after which the robot says HELLO again."""
ALIVE_NS = SECOND_NS
"""Time after which something is sent, so that the server knows that the robot is there."""
AGAIN_NS = SECOND_NS
"""Time after which the first observation is sent again."""
STEP_NS_FIRST = 50 * MILLISECOND_NS
"""Length of a step before it is measured."""
STEP_NS_LEAST, STEP_NS_MOST = MILLISECOND_NS, SECOND_NS
"""Bounds of what is measured: a program that pauses for a minute plays no row for a minute."""
MEASURED, DELAYS, ASKED_MAX = 9, 64, 1024
"""Number of newest intervals and delays that are measured, and of observations whose chunks are
played."""
ROWS_SENT = 64
"""Largest number of coming rows that are sent with an observation."""
CALL_COLUMNS = np.dtype(
    [
        ("time_ns", "<i8"),  # time of the answer
        ("robot", "<i8"),
        ("call", "<i8"),  # number of the call
        ("kind", "u1"),  # 0 fresh, 1 rest, 2 hold, 3 error
        ("waited_ns", "<i8"),  # time from the call to the answer
        ("chunk_age_ns", "<i8"),  # age of the observation that the answer was made from, -1: none
        ("left", "<i8"),  # rows of the answer that the policy has made
    ]
)
KINDS = (Kind.FRESH, Kind.REST, Kind.HOLD, Kind.ERROR)


class Said(bytes, Enum):
    """First byte of what a line hears and sends."""

    OPENED = b"+"
    CLOSED = b"-"
    """The rest is the reason, or empty."""
    MESSAGE = b"m"
    ERROR = b"e"
    """The rest is a text."""


@dataclass(frozen=True)
class RobotOptions:
    actions: Actions
    deadline_ns: int
    hold_ns: int = SECOND_NS
    """Longest time for which a robot without rows is held."""
    begin_ns: int = 60 * SECOND_NS
    """Longest time for the first answer."""
    key: str = "actions"
    """Key of the actions in the policy's reply."""
    step_ns: int | None = None
    """Length of a step; None: measured, as the time from an answer to the next call, in which a
    robot that `plays_on` does not play just its rows."""
    rows: int = 1
    """Number of rows that the program plays of each answer, from which the step is measured."""
    plays_on: bool = False
    """Whether the robot plays on while its program waits for an answer."""
    spare_rows: int | None = None
    """An observation is sent only if fewer rows than these will be left when its chunk comes; None
    sends each."""
    rate_max: float = RATE_MAX
    """Bound of the rate at which it sends [B/s]."""
    player: Callable[[], Player] = Clocked


@dataclass(slots=True)
class _Call:
    number: int
    began_ns: int
    is_first: bool
    message: bytes
    """Observation as it is sent; empty if it is not."""
    again_ns: int
    """Time at which it is sent again, if no answer has ever come."""


class _Asked(NamedTuple):
    """Observation that was sent."""

    began_ns: int
    first: int
    """Number of the first row of its chunk."""
    stood_ns: float
    """Time for which the robot had stood still until then [ns]."""
    connection: int


@dataclass(slots=True)
class _Program:
    """The robot's program, from its connection on."""

    peer: Address
    number: int
    schedule: Schedule
    intervals_ns: deque[int]
    """Newest times from an answer to the next call; the first is a guess."""
    newest: int = -1
    """Number of the observation that the newest chunk was made from."""
    made_ns: int = -1
    """Time of that observation [ns]."""
    answered_ns: int | None = None
    has_metadata: bool = False


class RobotEnd(Endpoint):
    """Robot's end of a session with a policy server.

    Args:
        robot: number of the robot, unique among those of the server.
        servers: the server's address on each path, by socket; socket 1 is the line.
        link: see `client.link`.
        boot_id: random number of this run.
        compress: changes an observation into what is sent of it, see `images.Compressor`.
        recorder: of CALL_COLUMNS, a row for each answer.
    """

    def __init__(
        self,
        robot: int,
        servers: dict[int, Address],
        link: ClientLink,
        options: RobotOptions,
        *,
        boot_id: int,
        compress: Callable[[Any], Any] = lambda observation: observation,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__()
        self._robot, self._servers, self._link = robot, dict(servers), link
        self._options, self._boot_id, self._compress = options, boot_id, compress
        self._recorder = recorder
        self._exchange: Exchange | None = None
        self._session = (0, 0)
        """Number of the session, and of the server's run."""
        self._hello_ns: int | None = 0
        """Time of the next HELLO; None while there is a session."""
        self._heard_ns = self._sent_ns = 0
        self._metadata: bytes | None = None
        self._wants_rows = False
        """Whether the policy wants to know which rows are coming."""
        self._program: _Program | None = None
        self._call: _Call | None = None
        self._asked: dict[int, _Asked] = {}
        """Observations that were sent, by number."""
        self._calls = self._connections = 0
        self._waits = True
        """Whether the newest chunk came within the deadline, so that it is worth waiting for the
        next."""
        self._delays_ns: deque[int] = deque(maxlen=DELAYS)
        """Newest times from an observation to its chunk."""
        self._counts = Counter[Kind]()
        self._drops = Counter[str]()
        self._refused = 0
        self._late_ns = 0
        """Longest time by which an answer came after its deadline."""
        self._is_holding = False
        self._age_ns, self._left = -1, 0
        """Age of the newest answer's observation [ns], -1: none, and its rows by the policy."""

    # -- datagrams -----------------------------------------------------------------------------

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        if datagram.socket == LINE:
            self._hear_program(datagram.payload, datagram.peer, now_ns)
        else:
            try:
                self._hear_server(datagram, now_ns)
            except ProtocolError as error:
                self._drops[error.reason] += 1
        self._send(now_ns)

    def _hear_server(self, datagram: Datagram, now_ns: int) -> None:
        if datagram.peer not in self._servers.values():
            raise ProtocolError(Drop.ELSEWHERE)
        opened = self._link.open(datagram.payload, now_ns=now_ns)
        if opened is None:
            return
        message = decode(opened)
        if isinstance(message, Welcome):
            self._welcome(message, datagram.peer, now_ns)
            return
        exchange = self._exchange
        if isinstance(message, Hello) or exchange is None or message.session != exchange.session:
            raise ProtocolError(Drop.UNKNOWN_SESSION)
        self._heard_ns = now_ns
        if isinstance(message, Seen):
            if message.came:
                exchange.learn(message, now_ns=now_ns)
        elif arrived := exchange.accept(message, now_ns=now_ns):
            if message.stream == METADATA:
                self._learn_metadata(arrived)
            elif message.stream == CHUNK:
                self._accept(arrived, now_ns)

    def _welcome(self, welcome: Welcome, peer: Address, now_ns: int) -> None:
        if welcome.robot != self._robot or welcome.boot_id != self._boot_id:
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        if welcome.refusal:
            reason = str(Refusal(welcome.refusal))
            self._events.append(events.JoinRefused(robot=self._robot, reason=reason))
            return
        self._link.adopt(now_ns=now_ns)
        self._heard_ns, self._hello_ns = now_ns, None
        session = welcome.session, welcome.server_boot_id
        if self._session == session:
            return
        self._session = session
        self._exchange = Exchange(welcome.session, self._options.rate_max)
        self._events.append(events.PolicyJoined(robot=self._robot, peer=address_text(*peer)))
        self._say_alive()

    def _say_alive(self) -> None:
        """Say that the robot is there, and whether it has the policy's metadata."""
        assert self._exchange
        has = int(self._metadata is not None)
        self._post(encode(Seen(self._exchange.session, METADATA, has, 0, 0, 0, 0, 0, 0)))

    def _learn_metadata(self, message: bytes) -> None:
        try:
            self._wants_rows, metadata = values.unpack(message)
        except (ValueRefused, TypeError, ValueError):
            raise ProtocolError(Drop.FIELD) from None
        if not isinstance(metadata, bytes):
            raise ProtocolError(Drop.FIELD)
        self._metadata = metadata
        self._greet()

    def _post(self, payload: bytes) -> None:
        self._send_on_all(self._link.seal(payload))

    def _send_on_all(self, datagram: bytes) -> None:
        for socket, server in self._servers.items():
            self.send(datagram, server, socket)

    def _send(self, now_ns: int) -> None:
        """Send what is due."""
        if self._hello_ns is not None and now_ns >= self._hello_ns:
            self._hello_ns = now_ns + self._link.hello_ns
            hello = encode(Hello(self._robot, self._boot_id))
            self._send_on_all(self._link.hello(hello, now_ns=now_ns))
        for answer in self._link.outbox():
            self._send_on_all(answer)
        if self._exchange is None:
            return
        posted = self._exchange.outbox(now_ns=now_ns)
        for payload in posted:
            self._post(payload)
        if posted:
            self._sent_ns = now_ns
        elif now_ns - self._sent_ns >= ALIVE_NS:
            self._sent_ns = now_ns
            self._say_alive()

    # -- the program ---------------------------------------------------------------------------

    def _hear_program(self, said: bytes, peer: Address, now_ns: int) -> None:
        match said[:1]:
            case Said.OPENED:
                options = self._options
                step_ns = options.step_ns or STEP_NS_FIRST
                player = options.player()
                late_ns = options.hold_ns + options.deadline_ns
                rows = None if options.step_ns else options.rows
                schedule = Schedule(
                    player, options.actions, options.key, step_ns, rows, late_ns, now_ns
                )
                self._connections += 1
                intervals_ns = deque([STEP_NS_FIRST * options.rows], MEASURED)
                self._program = _Program(peer, self._connections, schedule, intervals_ns)
                self._call = None
                self._events.append(events.ProgramConnected(robot=self._robot))
                self._greet()
            case Said.CLOSED if self._program and self._program.peer == peer:
                self._program = self._call = None
                self._events.append(events.ProgramGone(robot=self._robot))
            case Said.MESSAGE if self._program and self._program.peer == peer:
                self._hear_call(self._program, said[1:], now_ns)

    def _greet(self) -> None:
        """Give the program the policy's metadata, by which its connection is complete."""
        program = self._program
        if program and self._metadata is not None and not program.has_metadata:
            program.has_metadata = True
            self.send(Said.MESSAGE.value + self._metadata, program.peer, LINE)

    def _hear_call(self, program: _Program, data: bytes, now_ns: int) -> None:
        options, schedule = self._options, program.schedule
        if self._call:  # the program does not wait for its answers; each gets its own
            self._answer(Kind.REST, now_ns)
        if program.answered_ns is not None and options.step_ns is None:
            program.intervals_ns.append(now_ns - program.answered_ns)
            # The lower quartile: a program may pause more often than it calls without playing.
            measured_ns = sorted(program.intervals_ns)[len(program.intervals_ns) // 4]
            step_ns = measured_ns // options.rows
            schedule.step_ns = min(max(step_ns, STEP_NS_LEAST), STEP_NS_MOST)
        self._calls += 1
        is_first, again_ns = program.newest < 0, now_ns + AGAIN_NS
        call = _Call(self._calls, now_ns, is_first, b"", again_ns)
        self._call = call
        if not options.plays_on:
            schedule.stand(now_ns=now_ns)
        number = schedule.number(now_ns=now_ns)
        if not self._is_needed(schedule, now_ns):
            self._answer(Kind.REST, now_ns)
            return
        try:
            observation = values.unpack(data, most=values.MADE_BYTES_MAX)
            seen = values.pack(self._compress(observation))
            coming = None
            if self._wants_rows:
                coming = schedule.coming(ROWS_SENT, now_ns=now_ns)
            left, delay = schedule.left(now_ns=now_ns), self._delay_steps(schedule)
            content = [call.number, left, delay, coming, seen]
            message = values.pack(content)
            if len(message) > values.BYTES_MAX:
                raise ValueRefused(f"got {len(message)} B, expected at most {values.BYTES_MAX}")
        except (ValueError, RecursionError) as error:  # ValueError: an image that cannot be resized
            self._refused += 1
            refused = events.ObservationRefused(robot=self._robot, reason=str(error))
            self._events.append(refused)
            self._answer(Kind.ERROR, now_ns, f"the observation is refused: {error}")
            return
        self._asked[call.number] = _Asked(now_ns, number, schedule.stood_ns, program.number)
        while len(self._asked) > ASKED_MAX:
            del self._asked[next(iter(self._asked))]
        call.message = message
        if self._exchange:
            self._exchange.send(OBSERVATION, message)
        before = self._asked.get(call.number - 1)
        if before and program.newest < call.number - 1:  # its chunk has not come yet
            self._waits &= now_ns - before.began_ns <= options.deadline_ns
        if not (self._waits or call.is_first) and schedule.left(now_ns=now_ns):
            self._answer(Kind.REST, now_ns)

    def _delay_steps(self, schedule: Schedule) -> int:
        """Steps within which a chunk comes, after its observation, by the newest delays."""
        longest_ns = max(self._delays_ns, default=0)
        return -(-longest_ns // schedule.step_ns)

    def _is_needed(self, schedule: Schedule, now_ns: int) -> bool:
        spare = self._options.spare_rows
        left = schedule.left(now_ns=now_ns)
        return spare is None or not left or left < spare + self._delay_steps(schedule)

    def _accept(self, message: bytes, now_ns: int) -> None:
        """Accept a chunk."""
        try:
            call_number, reply, error = values.unpack(message)
            if type(call_number) is not int:
                raise ProtocolError(Drop.FIELD)
            content = None if error else values.unpack(reply)
        except (ValueRefused, TypeError, ValueError):
            raise ProtocolError(Drop.FIELD) from None
        asked, program = self._asked.get(call_number), self._program
        if asked is None or program is None or asked.connection != program.number:
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        call = self._call
        if error:
            self._events.append(events.PolicyFailed(robot=self._robot, reason=str(error)[:200]))
            return
        schedule, delay_ns = program.schedule, now_ns - asked.began_ns
        self._waits = delay_ns <= self._options.deadline_ns
        try:
            stood_ns = asked.stood_ns
            schedule.accept(call_number, asked.first, stood_ns, content, now_ns=now_ns)
        except ValueRefused as refused:
            self._events.append(events.ChunkRefused(robot=self._robot, reason=str(refused)))
            return
        self._delays_ns.append(delay_ns)
        if call_number > program.newest:
            program.newest, program.made_ns = call_number, asked.began_ns
        if call and (call.number == call_number or call.is_first):
            self._answer(Kind.FRESH, now_ns)

    def _answer(self, kind: Kind, now_ns: int, error: str = "") -> None:
        """Answer the call."""
        program, call = self._program, self._call
        assert program
        assert call
        self._call = None
        schedule = program.schedule
        schedule.go(now_ns=now_ns)
        since_ns = now_ns if schedule.since_ns is None else schedule.since_ns
        held_s = (now_ns - since_ns) / SECOND_NS
        message, left = b"", 0
        if not error:
            try:
                kind, reply, left = schedule.answer(kind, now_ns=now_ns)
                message = values.pack(reply)
            except (ValueRefused, RecursionError) as refused:  # nested too deep
                error = f"the policy's reply cannot be sent: {refused}"
        if kind is Kind.HOLD and not error:
            if reply is None or now_ns - since_ns > self._options.hold_ns:
                error = f"no action from the policy for {held_s:.2f} s"
            if not self._is_holding:
                self._is_holding = True
                self._events.append(events.Holding(robot=self._robot))
        elif self._is_holding and not error:
            self._is_holding = False
            self._events.append(events.PlaysAgain(robot=self._robot, after_s=held_s))
        kind = Kind.ERROR if error else kind
        program.answered_ns = now_ns
        waited_ns = now_ns - call.began_ns
        self._counts[kind] += 1
        if not call.is_first:
            self._late_ns = max(self._late_ns, waited_ns - self._options.deadline_ns)
        age_ns = now_ns - program.made_ns if program.newest >= 0 else -1
        self._age_ns, self._left = age_ns, left
        if self._recorder:
            row = (now_ns, self._robot, call.number, KINDS.index(kind), waited_ns, age_ns, left)
            self._recorder.append_row(*row)
        if error:
            self.send(Said.ERROR.value + error.encode(), program.peer, LINE)
        else:
            self.send(Said.MESSAGE.value + message, program.peer, LINE)

    # -- time ----------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        due = [self._heard_ns + SILENCE_NS, self._sent_ns + ALIVE_NS]
        if self._hello_ns is not None:
            due = [self._hello_ns]
        if self._exchange and (sends_ns := self._exchange.due_ns()) is not None:
            due.append(sends_ns)
        if self._call:
            due.append(self._answer_by_ns(self._call))
            if self._call.is_first and self._call.message:
                due.append(self._call.again_ns)
        return min(due)

    def _answer_by_ns(self, call: _Call) -> int:
        options = self._options
        return call.began_ns + (options.begin_ns if call.is_first else options.deadline_ns)

    def wake(self, *, now_ns: int) -> None:
        call = self._call
        if call and now_ns >= self._answer_by_ns(call):
            self._answer(Kind.REST, now_ns)
        elif call and call.is_first and call.message and now_ns >= call.again_ns:
            # The robot waits for its first answer, and no other observation follows.
            call.again_ns = now_ns + AGAIN_NS
            if self._exchange:
                self._exchange.send(OBSERVATION, call.message)
        if self._hello_ns is None:
            silence_ns = now_ns - self._heard_ns
            if silence_ns >= SILENCE_NS:
                silent = events.PolicySilent(robot=self._robot, silence_s=silence_ns / SECOND_NS)
                self._events.append(silent)
                self._hello_ns = now_ns
            elif self._link.wants_hello(now_ns):
                self._hello_ns = now_ns
        self._send(now_ns)

    def figures(self) -> dict[str, Any]:
        exchange, program = self._exchange, self._program
        return {
            "calls": self._calls,
            "answers": by_name({kind: self._counts[kind] for kind in KINDS}),
            "late_s_max": max(self._late_ns, 0) / SECOND_NS,
            "observations_refused": self._refused,
            "delay_s": max(self._delays_ns, default=0) / SECOND_NS,
            "step_s": program.schedule.step_ns / SECOND_NS if program else None,
            "chunk_age_s": None if self._age_ns < 0 else self._age_ns / SECOND_NS,
            "rows_left": self._left,
            "dropped": by_name(self._drops),
        } | ({"link": exchange.figures()} if exchange else {})
