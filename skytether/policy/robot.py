"""Robot end: answers each call of the robot program by the deadline, whatever the network does.

The program is connected through the local connection (socket 1): a websocket with openpi's
protocol, or `Robot.infer`. A call is an observation. It is answered

- with its own action chunk, as soon as the chunk arrives;
- at the deadline, with the remaining rows of earlier chunks from the present step on, or at once if
  the newest chunks took longer than the deadline;
- if no row remains, with the hold action for at most `hold_ns`, then with an error, after which the
  program must stop the robot.

The first call of a program waits for its chunk for up to `begin_ns`, since the robot has not moved.
So does a call after the program has executed all rows and then paused for more than `hold_ns` and
PAUSE_NS, as between two episodes.

A frame of the local connection begins with a byte of `FrameType`.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from skytether.client.link import ClientLink
from skytether.policy import events, values
from skytether.policy.committed import DELAYS, RobotRows
from skytether.policy.exchange import Exchange
from skytether.policy.messages import (
    CHUNK,
    METADATA,
    OBSERVATION,
    Hello,
    Report,
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
from skytether.shared.wire.drop import Drop, ProtocolError
from skytether.shared.wire.protocol import Refusal

LINE = 1
"""Socket number of the local connection to the robot program or the policy."""
SILENCE_NS = 3 * SECOND_NS
"""Time without a datagram after which the robot end sends HELLO again [ns]."""
ALIVE_NS = SECOND_NS
"""Time after the last sent datagram at which a keep-alive is sent [ns]."""
SILENT_NS = ALIVE_NS + SECOND_NS // 2
"""Time without a datagram that counts as the reason for a hold [ns]."""
AGAIN_NS = SECOND_NS
"""Time between repetitions of the first observation [ns]."""
STEP_NS_FIRST = 200 * MILLISECOND_NS
"""Assumed length of a control step before it is measured [ns]. What a step takes longer counts as a
pause until three intervals have been measured."""
STEP_NS_LEAST, STEP_NS_MOST = MILLISECOND_NS, SECOND_NS
"""Bounds of the measured step length [ns]: a pause of the program is not a long step."""
MEASURED, ASKED_MAX = 9, 1024
"""Number of newest intervals between calls that give the step length, and of newest observations
whose chunks are accepted."""
ROWS_SENT = 64
"""Largest number of next rows that are sent with an observation."""
PAUSE_NS = SECOND_NS
"""Shortest pause of the program after which a new episode is assumed [ns]."""
HELLOS = 4
"""Number of unanswered HELLOs after which the log says so."""
REFUSALS = {
    Refusal.TAKEN: "another robot end has this number; each robot needs its own --id",
    Refusal.FULL: "it has as many robots as it can serve",
}
KINDS = (Kind.FRESH, Kind.REST, Kind.HOLD, Kind.ERROR)


class FrameType(bytes, Enum):
    """First byte of a frame of a local connection, received or sent."""

    OPENED = b"+"
    CLOSED = b"-"
    """The reason follows, or nothing."""
    MESSAGE = b"m"
    ERROR = b"e"
    """The error message follows."""


class AnsweredCall(NamedTuple):
    """Call of the robot program and its answer."""

    time_ns: int
    """Time of the answer [ns]."""
    number: int
    kind: Kind
    waited_ns: int
    """Time from the call to the answer [ns]."""
    chunk_age_ns: int
    """Age of the newest chunk's observation [ns]; -1: no chunk yet."""
    left: int
    """Number of the answer's rows that the policy has computed; the others are the hold action."""
    sent: Any
    """Observation with compressed images; None if it was not sent."""
    reply: Any
    """Reply to the program; None for an error."""


@dataclass(frozen=True)
class RobotOptions:
    """Options of a robot end."""

    actions: Actions
    deadline_ns: int
    """Longest time from a call to its answer, except for the first call [ns]."""
    hold_ns: int = SECOND_NS
    """Longest time for which calls are answered with the hold action [ns]."""
    begin_ns: int = 60 * SECOND_NS
    """Longest time to the answer of the first call, and of the first call after a pause [ns]."""
    key: str = "actions"
    """Key of the actions in the policy's reply."""
    step_ns: int | None = None
    """Length of a control step [ns]; None: measured as the time from an answer to the next call,
    divided by `rows`. Required with `plays_on`, because that time then does not measure steps."""
    rows: int = 1
    """Number of rows that the program executes of each answer, which later chunks do not change."""
    plays_on: bool = False
    """Whether the robot continues to execute rows during a call."""
    spare_rows: int | None = None
    """An observation is sent only if fewer rows than this will remain when its chunk arrives, or
    fewer than `rows` remain; None: every observation is sent."""
    rate_max: float = RATE_MAX
    """Largest send rate [B/s]."""
    player: Callable[[], Player] = Clocked
    """Function that makes a player, the rule that chooses the row of each step."""


@dataclass(slots=True)
class _Call:
    number: int
    began_ns: int
    is_first: bool
    """Whether it is the first call of the program, or of an episode."""
    message: bytes
    """Serialized observation; empty if it is not sent."""
    again_ns: int
    """Time at which the observation is sent again if no chunk has arrived yet [ns]."""
    sent: Any = None
    """Observation with compressed images; None if it is not sent."""


class _Asked(NamedTuple):
    """Observation that was sent."""

    began_ns: int
    first: int
    """Step of the first row of its chunk."""
    step: int
    """Control step of the observation."""
    stood_ns: float
    """`Schedule.stood_ns` at the observation [ns]."""


@dataclass(slots=True)
class _Program:
    """Connected robot program."""

    peer: Address
    schedule: Schedule
    intervals_ns: deque[int]
    """Newest times from an answer to the next call [ns]; the first is an assumed value."""
    newest: int = -1
    """Number of the newest call whose chunk has arrived; -1: none."""
    made_ns: int = -1
    """Time of the call `newest` [ns]."""
    answered_ns: int | None = None
    """Time of the last answer [ns]."""
    has_metadata: bool = False
    answers_first: bool = False
    """Whether the newest chunk is the program's first."""


@dataclass(slots=True)
class _SinceChunk:
    """Events since the newest chunk or, without a chunk, since the program connected, from which
    the reason for a hold follows.
    """

    sent: int = 0
    """Number of observations sent."""
    first: int = 0
    """Number of the first message with one of these observations."""
    reported: set[int] = field(default_factory=set)
    """Numbers of these messages of which the policy end has reported parts."""
    fault: str = ""
    """Newest error of the policy, or reason for refusing a chunk."""


class RobotEnd(Endpoint):
    """Robot end of a session with a policy end.

    Args:
        robot: number of the robot, unique at the policy end.
        servers: address of the policy end on each path, by socket number, without LINE.
        link: encryption of the datagrams, see `client.link`.
        boot_id: random number of this run.
        compress: function that compresses an observation before sending, see `images.Compressor`.
        on_answer: called after each answer; None: answers are not kept.
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
        on_answer: Callable[[AnsweredCall], None] | None = None,
    ) -> None:
        super().__init__()
        self._robot, self._servers, self._link = robot, dict(servers), link
        self._options, self._boot_id, self._compress = options, boot_id, compress
        self._on_answer = on_answer
        self._exchange: Exchange | None = None
        self._session = (0, 0)
        """Session number and the policy end's boot id, from the newest accepted WELCOME; (0, 0)
        before the first."""
        self._hello_ns: int | None = 0
        """Time of the next HELLO [ns]; None during a session."""
        self._hellos = 0
        """Number of HELLOs without an answer."""
        self._heard_ns = self._sent_ns = self._alive_ns = 0
        self._metadata: bytes | None = None
        self._has_metadata = False
        """Whether the metadata of this run of the policy end have arrived."""
        self._wants_rows = False
        """Whether observations include the next rows, for `PolicyEnd.gives_rows`."""
        self._program: _Program | None = None
        self._call: _Call | None = None
        self._asked: dict[int, _Asked] = {}
        """Sent observations of the connected program, by call number."""
        self._calls = 0
        self._waits = True
        """Whether the newest chunk arrived within the deadline; otherwise calls are answered at
        once while rows remain."""
        self._delays: deque[tuple[int, int]] = deque(maxlen=DELAYS)
        """Of the newest chunks: time from its observation [ns], and number of rows executed
        meanwhile, which the chunk could not change."""
        self._counts = Counter[Kind]()
        self._drops = Counter[str]()
        self._refused = 0
        self._late_ns = 0
        """Longest time by which an answer exceeded its deadline [ns]."""
        self._is_holding = False
        self._since = _SinceChunk()
        self._age_ns = -1
        """Age of the newest chunk's observation at the last answer [ns]; -1: no chunk."""
        self._left = 0
        """Number of rows of the last answer that the policy computed."""

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
        if isinstance(message, Report):
            if message.came:
                exchange.learn(message, now_ns=now_ns)
                if message.stream == OBSERVATION and message.number >= self._since.first:
                    self._since.reported.add(message.number)
        elif arrived := exchange.accept(message, now_ns=now_ns):
            if message.stream == METADATA:
                self._learn_metadata(arrived)
            elif message.stream == CHUNK:
                self._accept(arrived, now_ns)

    def _welcome(self, welcome: Welcome, peer: Address, now_ns: int) -> None:
        if welcome.robot != self._robot or welcome.boot_id != self._boot_id:
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        if welcome.refusal:
            reason = REFUSALS.get(Refusal(welcome.refusal), "unknown")
            self._events.append(events.JoinRefused(robot=self._robot, reason=reason))
            return
        self._link.adopt(now_ns=now_ns)
        self._heard_ns, self._hello_ns, self._hellos = now_ns, None, 0
        session = welcome.session, welcome.server_boot_id
        if self._session == session:
            return
        self._session = session
        self._exchange, self._has_metadata = (
            Exchange(welcome.session, self._options.rate_max),
            False,
        )
        self._since.first = 0  # the messages of a session are counted from 0
        self._events.append(events.PolicyJoined(robot=self._robot, peer=address_text(*peer)))
        self._say_alive(now_ns)

    def _say_alive(self, now_ns: int) -> None:
        """Send a keep-alive, which includes whether the policy's metadata has arrived."""
        assert self._exchange
        self._sent_ns = self._alive_ns = now_ns
        has = int(self._has_metadata)
        self._post(encode(Report(self._exchange.session, METADATA, has, 0, 0, 0, 0, 0, 0, 0, 0)))

    def _learn_metadata(self, message: bytes) -> None:
        try:
            wants_rows, metadata = values.unpack(message)
        except (ValueRefused, TypeError, ValueError):
            raise ProtocolError(Drop.FIELD) from None
        if not isinstance(metadata, bytes):
            raise ProtocolError(Drop.FIELD)
        self._wants_rows, self._metadata = wants_rows is True, metadata
        self._has_metadata = True
        self._greet()

    def _post(self, payload: bytes) -> None:
        self._send_on_all(self._link.seal(payload))

    def _send_on_all(self, datagram: bytes) -> None:
        for socket, server in self._servers.items():
            self.send(datagram, server, socket)

    def _send(self, now_ns: int) -> None:
        """Send all datagrams that are due."""
        if self._hello_ns is not None and now_ns >= self._hello_ns:
            self._hello_ns = now_ns + self._link.hello_ns
            hello = encode(Hello(self._robot, self._boot_id))
            self._send_on_all(self._link.hello(hello, now_ns=now_ns))
            self._hellos += 1
            if self._hellos == HELLOS:
                peers = ", ".join(address_text(*each) for each in self._servers.values())
                self._events.append(events.NoWelcome(robot=self._robot, peers=peers))
        for answer in self._link.outbox():
            self._send_on_all(answer)
        if self._exchange is None:
            return
        posted = self._exchange.outbox(now_ns=now_ns)
        for payload in posted:
            self._post(payload)
        if posted:
            self._sent_ns = now_ns
        since_ns = self._sent_ns if self._has_metadata else self._alive_ns
        if now_ns - since_ns >= ALIVE_NS:
            self._say_alive(now_ns)

    # -- robot program -------------------------------------------------------------------------

    def _hear_program(self, said: bytes, peer: Address, now_ns: int) -> None:
        match said[:1]:
            case FrameType.OPENED:
                options = self._options
                step_ns = options.step_ns or STEP_NS_FIRST
                player = options.player()
                late_ns = options.hold_ns + options.deadline_ns
                rows = None if options.step_ns else options.rows
                schedule = Schedule(
                    player, options.actions, options.key, step_ns, rows, late_ns, now_ns
                )
                intervals_ns = deque([STEP_NS_FIRST * options.rows], MEASURED)
                self._program = _Program(peer, schedule, intervals_ns)
                self._call = None
                self._asked.clear()  # their chunks are for the previous program
                self._is_holding = False
                self._forget_events()
                counts = f"{rows} row(s) of each answer, see --rows"
                if rows is None:
                    counts = f"a row each {step_ns / MILLISECOND_NS:g} ms"
                self._events.append(events.ProgramConnected(robot=self._robot, counts=counts))
                self._greet()
            case FrameType.CLOSED if self._program and self._program.peer == peer:
                self._program = self._call = None
                self._events.append(events.ProgramGone(robot=self._robot))
            case FrameType.MESSAGE if self._program and self._program.peer == peer:
                self._hear_call(self._program, said[1:], now_ns)

    def _greet(self) -> None:
        """Send the policy's metadata to the program; the metadata complete its connection."""
        program = self._program
        if program and self._metadata is not None and not program.has_metadata:
            program.has_metadata = True
            self.send(FrameType.MESSAGE.value + self._metadata, program.peer, LINE)

    def _hear_call(self, program: _Program, data: bytes, now_ns: int) -> None:
        options, schedule = self._options, program.schedule
        if self._call:  # the program did not wait for the answer; every call gets an answer
            self._answer(Kind.REST, now_ns)
        if program.answered_ns is not None and options.step_ns is None:
            program.intervals_ns.append(now_ns - program.answered_ns)
            # Lower quartile: long pauses are more frequent than calls without executed rows.
            measured_ns = sorted(program.intervals_ns)[len(program.intervals_ns) // 4]
            step_ns = measured_ns // options.rows
            schedule.step_ns = min(max(step_ns, STEP_NS_LEAST), STEP_NS_MOST)
        self._calls += 1
        if not options.plays_on:
            schedule.stand(now_ns=now_ns)
        number = schedule.number(now_ns=now_ns)
        is_first = program.newest < 0 or self._has_paused(program, now_ns)
        self._call = call = _Call(self._calls, now_ns, is_first, b"", now_ns + AGAIN_NS)
        if not self._is_needed(schedule, now_ns):
            self._answer(Kind.REST, now_ns)
            return
        try:
            observation = values.unpack(data, most=values.MADE_BYTES_MAX)
            compressed = self._compress(observation)
            seen = values.pack(compressed)
            held = None
            if self._wants_rows:
                # Chunks of calls that are no longer in `_asked` are not accepted.
                acknowledged = max(program.newest, next(iter(self._asked), call.number) - 1)
                rows = schedule.coming(ROWS_SENT, now_ns=now_ns)
                held = RobotRows(options.key, number, acknowledged, rows)
            left, delay = schedule.left(now_ns=now_ns), self._delay_steps()
            content = [call.number, left, delay, held, seen]
            message = values.pack(content)
            if len(message) > values.BYTES_MAX:
                raise ValueRefused(f"got {len(message)} B, expected at most {values.BYTES_MAX}")
        except (ValueError, RecursionError) as error:  # ValueError: an image that cannot be resized
            self._refused += 1
            refused = events.ObservationRefused(robot=self._robot, reason=str(error))
            self._events.append(refused)
            self._answer(Kind.ERROR, now_ns, f"the observation is refused: {error}")
            return
        self._asked[call.number] = _Asked(
            now_ns, number, schedule.advance(now_ns=now_ns), schedule.stood_ns
        )
        while len(self._asked) > ASKED_MAX:
            del self._asked[next(iter(self._asked))]
        call.message, call.sent = message, compressed
        self._since.sent += 1
        if self._exchange:
            self._exchange.send(OBSERVATION, message)
        before = self._asked.get(call.number - 1)
        if before and program.newest < call.number - 1:  # that call's chunk has not arrived
            self._waits &= now_ns - before.began_ns <= options.deadline_ns
        if not (self._waits or call.is_first) and schedule.left(now_ns=now_ns):
            self._answer(Kind.REST, now_ns)

    def _forget_events(self) -> None:
        """Begin to collect the events since a chunk, or since a program has connected."""
        first = self._exchange.number(OBSERVATION) + 1 if self._exchange else 0
        self._since = _SinceChunk(first=first)

    def _has_paused(self, program: _Program, now_ns: int) -> bool:
        """Whether the program has made no call since its last row, so that an episode begins."""
        ended_ns, answered_ns = program.schedule.since_ns, program.answered_ns
        if ended_ns is None or answered_ns is None or answered_ns > ended_ns:
            return False
        return now_ns - ended_ns > max(self._options.hold_ns, PAUSE_NS)

    def _delay_steps(self) -> int:
        """Largest number of rows executed before a chunk could change them."""
        return max((steps for _, steps in self._delays), default=0)

    def _is_needed(self, schedule: Schedule, now_ns: int) -> bool:
        spare, rows = self._options.spare_rows, self._options.rows
        left, delay = schedule.left(now_ns=now_ns), self._delay_steps()
        if spare is None or left <= delay or left < rows or self._program is None:
            return True
        newest, asked = next(reversed(self._asked.items()), (-1, None))
        step = schedule.advance(now_ns=now_ns)
        if asked and newest > self._program.newest and step <= asked.step + delay:
            return False  # the chunk of the newest observation may be under way
        return left < spare + delay

    def _accept(self, message: bytes, now_ns: int) -> None:
        """Accept a chunk or an error of the policy."""
        try:
            call_number, reply, error = values.unpack(message)
            if type(call_number) is not int or type(error) is not str:
                raise ProtocolError(Drop.FIELD)
            content = None if error else values.unpack(reply)
        except (ValueRefused, TypeError, ValueError):
            raise ProtocolError(Drop.FIELD) from None
        asked, program = self._asked.get(call_number), self._program
        if asked is None or program is None:
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        call = self._call
        if error:
            fault = f"error of the policy: {error[:200]}"
            if fault != self._since.fault:
                self._events.append(events.PolicyFailed(robot=self._robot, reason=error[:200]))
            self._since.fault = fault
            return
        if program.newest < 0 and (call is None or call_number < call.number):
            why = "its call was answered with an error, and the robot may have been moved since"
            self._events.append(events.ChunkRefused(robot=self._robot, reason=why))
            return
        schedule, delay_ns = program.schedule, now_ns - asked.began_ns
        self._waits = delay_ns <= self._options.deadline_ns
        try:
            stood_ns = asked.stood_ns
            schedule.accept(call_number, asked.first, stood_ns, content, now_ns=now_ns)
        except ValueError as refused:
            self._events.append(events.ChunkRefused(robot=self._robot, reason=str(refused)))
            self._since.fault = f"its chunk is refused: {refused}"
            return
        if program.answers_first:
            self._delays.clear()  # the policy may have compiled before its first chunk
        program.answers_first = program.newest < 0
        # The chunk is used in the answer to the next call: the program executes rows until then.
        rows = 0 if call else self._options.rows
        steps = schedule.open_step(rows, now_ns=now_ns) - asked.step
        if self._options.plays_on:
            steps = max(steps, -(-delay_ns // schedule.step_ns))
        self._delays.append((delay_ns, steps))
        if call_number > program.newest:
            program.newest, program.made_ns = call_number, asked.began_ns
            self._forget_events()
        if call and call.number == call_number:
            self._answer(Kind.FRESH, now_ns)

    def _answer(self, kind: Kind, now_ns: int, error: str = "") -> None:
        """Answer the present call."""
        program, call = self._program, self._call
        assert program
        assert call
        self._call = None
        schedule = program.schedule
        schedule.go(now_ns=now_ns)
        since_ns = now_ns if schedule.since_ns is None else schedule.since_ns
        held_s = (now_ns - since_ns) / SECOND_NS
        message, left, reply = b"", 0, None
        if not error:
            try:
                kind, reply, left = schedule.answer(kind, now_ns=now_ns)
                message = values.pack(reply)
            except Exception as refused:  # such as a reply nested too deeply; the call is answered
                error = f"the policy's reply cannot be sent: {refused}"
        if kind is Kind.HOLD and not error:
            why = self._why_no_row(program, call, since_ns, now_ns)
            if reply is None or now_ns - since_ns > self._options.hold_ns:
                error = f"no action from the policy for {held_s:.2f} s: {why}"
            if not self._is_holding:
                self._is_holding = True
                self._events.append(events.Holding(robot=self._robot, reason=why))
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
        if self._on_answer:
            given = None if error else reply
            numbers = now_ns, call.number, kind, waited_ns, age_ns, left
            self._on_answer(AnsweredCall(*numbers, call.sent, given))
        if error:
            self.send(FrameType.ERROR.value + error.encode(), program.peer, LINE)
        else:
            self.send(FrameType.MESSAGE.value + message, program.peer, LINE)

    def _why_no_row(self, program: _Program, call: _Call, since_ns: int, now_ns: int) -> str:
        """Reason why no row remains since `since_ns`, as far as this end can tell."""
        since, silence_ns = self._since, now_ns - self._heard_ns
        if self._exchange is None:
            return "no session with `policy serve`"
        if since.fault:
            return since.fault
        pause_ns = call.began_ns - since_ns
        if program.newest >= 0 and since.sent <= 1 and pause_ns > program.schedule.step_ns:
            pause_s = pause_ns / SECOND_NS
            return f"the program made no call for {pause_s:.2f} s after its last row"
        if silence_ns >= SILENT_NS:
            return f"no datagram from `policy serve` for {silence_ns / SECOND_NS:.1f} s"
        if not since.sent:
            return "the newest chunk has arrived after the time of its last row"
        reached = min(len(since.reported), since.sent)  # a first observation is sent repeatedly
        counts = f"{reached} of the last {since.sent} observations"
        return f"by its reports {counts} have reached `policy serve`, but no chunk has arrived here"

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
            # The program waits for its first answer, and sends no other observation.
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
            "delay_s": max(self._delays, default=(0, 0))[0] / SECOND_NS,
            "step_s": program.schedule.step_ns / SECOND_NS if program else None,
            "chunk_age_s": None if self._age_ns < 0 else self._age_ns / SECOND_NS,
            "rows_left": self._left,
            "dropped": by_name(self._drops),
        } | ({"link": exchange.figures()} if exchange else {})
