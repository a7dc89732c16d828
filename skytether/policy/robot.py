"""Robot end: answers each call of the robot program by the deadline, whatever the network does.

The program is connected through the local connection (socket 1): a websocket with openpi's
protocol, or `Robot.infer`. A call is an observation. It is answered

- with its own action chunk, as soon as the chunk arrives;
- at the deadline, with the remaining rows of earlier chunks from the present step on, or at once if
  the newest chunks took longer than the deadline;
- if no row remains, with the hold action for at most `hold_ns`, then with an error, after which the
  program must stop the robot.

The first call of a program waits for its chunk for up to `begin_ns`, since the robot has not moved.
The first call after a pause, for which no row has remained and the program has made no call, waits
for up to `RobotOptions.pause_ns` if the pause was longer, as between two episodes.

A frame of the local connection begins with a byte of `FrameType`.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import msgspec

from skytether.client.link import ClientLink
from skytether.policy import events, values
from skytether.policy.committed import DELAYS, RobotRows
from skytether.policy.messages import CHUNK, OBSERVATION, ChunkContent, Report, content
from skytether.policy.pace import RATE_MAX
from skytether.policy.players import Clocked, Player
from skytether.policy.schedule import Actions, Kind, Schedule, rows_of
from skytether.policy.session import ALIVE_NS, Session
from skytether.policy.values import ValueRefused
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint, by_name
from skytether.shared.wire.drop import Drop, ProtocolError

LINE = 1
"""Socket number of the local connection to the robot program or the policy."""
SILENT_NS = ALIVE_NS + SECOND_NS // 2
"""Time without a datagram that counts as the reason for a hold [ns]."""
AGAIN_NS = SECOND_NS
"""Time between repetitions of the first observation [ns]."""
ASKED_MAX = 1024
"""Number of newest observations whose chunks are accepted."""
ROWS_SENT = 64
"""Largest number of next rows that are sent with an observation."""
PAUSE_NS = SECOND_NS
"""Smallest value of `RobotOptions.pause_ns` [ns]."""


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


class LinkStep(msgspec.Struct, frozen=True, omit_defaults=True):
    """Event of the link to the policy end, recorded for `skytether explain`."""

    kind: str
    """`program`: a program connects; `session`: a session begins, `restart` if with a new run of
    the policy end; `sent`: the first part of an observation is sent. What arrives: `report`, on an
    observation; `chunk`, `refused` if it is not used; `error`, of the policy."""
    call: int = -1
    message: int = -1
    """Number of the message in its stream and session."""
    parts: int = 0
    """Number of parts sent, or received."""
    needed: int = 0
    """Number of parts that restore the message."""
    rows: int = 0
    fault: str = ""
    """Reason of an error, or for refusing a chunk."""


@dataclass(frozen=True)
class RobotOptions:
    """Options of a robot end."""

    actions: Actions
    deadline_ns: int
    """Longest time from a call to its answer, except for first calls, see the module [ns]."""
    hold_ns: int = SECOND_NS
    """Longest time for which calls are answered with the hold action [ns]."""
    begin_ns: int = 60 * SECOND_NS
    """Longest time from the first call to its answer [ns]."""
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

    @property
    def pause_ns(self) -> int:
        """Time without a row or a call after which a new episode is assumed; its first call waits
        for its chunk for as long [ns].
        """
        return max(self.hold_ns, PAUSE_NS)


@dataclass(slots=True)
class _Call:
    """Call of the program, also after its answer, while a chunk for it is accepted."""

    number: int
    began_ns: int
    answer_by_ns: int
    """Time by which the call is answered [ns]."""
    is_first: bool
    """Whether it is the first call of the program, or of an episode."""
    step: int
    """Control step of the observation."""
    first: int
    """Step of the first row of its chunk, as the player counts steps."""
    stood_ns: float
    """`Schedule.stood_ns` at the observation [ns]."""
    message: bytes = b""
    """Serialized observation, until the answer; empty if it is not sent."""
    again_ns: int = 0
    """Time at which the observation of a first call is sent again [ns]."""
    sent: Any = None
    """Observation with compressed images, until the answer; None if it is not sent."""


@dataclass(slots=True)
class _SinceChunk:
    """Events from which the reason for a hold follows: since the newest chunk or, without a chunk,
    since the program connected.
    """

    first: int = 0
    """Number of the first message with an observation since then, or after the newest report."""
    sent: int = 0
    """Number of observations sent."""
    reported: int = 0
    """Number of their messages of which the policy end has reported parts."""
    fault: str = ""
    """Newest error of the policy, or reason for refusing a chunk."""


@dataclass(slots=True)
class _Program:
    """Connected robot program."""

    peer: Address
    schedule: Schedule
    since: _SinceChunk
    call: _Call | None = None
    """Call that is not answered yet."""
    asked: dict[int, _Call] = field(default_factory=dict)
    """Calls whose observation was sent and whose chunk has not arrived, by number."""
    newest: int = -1
    """Number of the newest call whose chunk has been accepted; -1: none."""
    made_ns: int = -1
    """Time of the call `newest` [ns]."""
    has_metadata: bool = False
    answers_first: bool = False
    """Whether the newest chunk is the program's first."""
    is_holding: bool = False


class RobotEnd(Endpoint):
    """Robot end of a session with a policy end.

    Args:
        robot: number of the robot, unique at the policy end.
        servers: address of the policy end on each path, by socket number, without LINE.
        link: encryption of the datagrams, see `client.link`.
        boot_id: random number of this run.
        compress: function that compresses an observation before sending, see `images.Compressor`.
        on_answer: called after each answer.
        on_step: called with the time [ns] of each `LinkStep`.
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
        on_answer: Callable[[AnsweredCall], None] = lambda _: None,
        on_step: Callable[[int, LinkStep], None] = lambda *_: None,
    ) -> None:
        super().__init__()
        self._robot, self._options, self._compress = robot, options, compress
        self._on_answer, self._on_step = on_answer, on_step
        self._begun = -1
        """Number of this session's newest observation message of which parts were sent."""
        self._session = Session(self, robot, servers, link, boot_id, options.rate_max)
        self._program: _Program | None = None
        self._calls = 0
        self._waits = True
        """Whether the newest chunk arrived within the deadline; otherwise calls are answered at
        once while rows remain."""
        self._delays: deque[tuple[int, int]] = deque(maxlen=DELAYS)
        """Of the newest chunks: time from its observation [ns], and number of rows executed
        meanwhile, which the chunk could not change."""
        self._answered: AnsweredCall | None = None
        """Newest answer."""
        self._counts = Counter[Kind]()
        self._drops = Counter[str]()
        self._refused = 0
        self._late_ns = 0
        """Longest time by which an answer exceeded its deadline [ns]."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        if datagram.socket == LINE:
            self._hear_program(datagram.payload, datagram.peer, now_ns)
        else:
            try:
                self._hear_server(datagram, now_ns)
            except ProtocolError as error:
                self._drops[error.reason] += 1
        self._send(now_ns)

    def _send(self, now_ns: int) -> None:
        self._session.send(now_ns=now_ns)
        program, exchange = self._program, self._session.exchange
        if exchange and (number := exchange.number(OBSERVATION)) > self._begun:
            # Only the newest observation waits, so the one whose sending begins is the newest.
            self._begun, form = number, exchange.forms[OBSERVATION]
            call = next(reversed(program.asked), -1) if program else -1
            needed, parity = form.blocks * form.data, form.blocks * form.parity
            self._on_step(now_ns, LinkStep("sent", call, number, needed + parity, needed))

    def _hear_server(self, datagram: Datagram, now_ns: int) -> None:
        exchange, program = self._session.exchange, self._program
        run = self._session.server_boot_id
        heard = self._session.hear(datagram, now_ns=now_ns)
        if self._session.exchange is not exchange:
            is_new = run not in (0, self._session.server_boot_id)
            self._on_step(now_ns, LinkStep("restart" if is_new else "session"))
            self._begun = -1
            if program:
                program.since.first = 0  # the messages of a session are counted from 0
        if isinstance(heard, Report):
            self._on_step(now_ns, LinkStep("report", message=heard.number, parts=heard.came))
            if program and heard.number >= program.since.first:
                program.since.first = heard.number + 1
                program.since.reported += 1
        elif heard:
            self._accept(heard, now_ns)
        self._greet()

    # -- robot program -------------------------------------------------------------------------

    def _hear_program(self, said: bytes, peer: Address, now_ns: int) -> None:
        program = self._program
        match said[:1]:
            case FrameType.OPENED:
                options = self._options
                schedule = Schedule(
                    options.player(),
                    options.actions,
                    options.key,
                    options.step_ns,
                    options.rows,
                    options.hold_ns + options.deadline_ns,
                    now_ns,
                )
                self._program = _Program(peer, schedule, self._since_now())
                self._on_step(now_ns, LinkStep("program"))
                counts = f"{options.rows} row(s) of each answer, see --rows"
                if options.step_ns:
                    counts = f"a row each {options.step_ns / MILLISECOND_NS:g} ms"
                self._events.append(events.ProgramConnected(robot=self._robot, counts=counts))
                self._greet()
            case FrameType.CLOSED if program and program.peer == peer:
                self._program = None
                self._events.append(events.ProgramGone(robot=self._robot))
            case FrameType.MESSAGE if program and program.peer == peer:
                self._hear_call(program, said[1:], now_ns)

    def _since_now(self) -> _SinceChunk:
        exchange = self._session.exchange
        return _SinceChunk(exchange.number(OBSERVATION) + 1 if exchange else 0)

    def _greet(self) -> None:
        """Send the policy's metadata to the program; the metadata complete its connection."""
        program, metadata = self._program, self._session.metadata
        if program and metadata is not None and not program.has_metadata:
            program.has_metadata = True
            self.send(FrameType.MESSAGE.value + metadata, program.peer, LINE)

    def _hear_call(self, program: _Program, data: bytes, now_ns: int) -> None:
        options, schedule = self._options, program.schedule
        if program.call:  # the program did not wait for the answer; every call gets an answer
            self._answer(program, program.call, Kind.REST, now_ns)
        self._calls += 1
        if not options.plays_on:
            schedule.stand(now_ns=now_ns)
        step = schedule.advance(now_ns=now_ns)
        pause_ns = options.pause_ns
        if self._answered and self._answered.kind is Kind.HOLD:  # whose rows have been executed
            pause_ns += options.rows * schedule.step_ns
        has_paused = schedule.has_paused(pause_ns, now_ns=now_ns)
        is_first, wait_ns = program.newest < 0 or has_paused, options.deadline_ns
        if is_first:
            wait_ns = options.begin_ns if program.newest < 0 else max(wait_ns, options.pause_ns)
        answer_by_ns = now_ns + wait_ns
        number, stood_ns = schedule.number(now_ns=now_ns), schedule.stood_ns
        call = _Call(self._calls, now_ns, answer_by_ns, is_first, step, number, stood_ns)
        program.call = call
        left, delay = schedule.left(now_ns=now_ns), self._delay_steps()
        if not (is_first or self._is_needed(program, step, left, delay)):
            self._answer(program, call, Kind.REST, now_ns)
            return
        try:
            observation = values.unpack(data, most=values.MADE_BYTES_MAX)
            compressed = self._compress(observation)
            seen, held = values.pack(compressed), None
            if self._session.wants_rows:
                # Chunks of calls that are no longer in `asked` are not accepted.
                acknowledged = max(program.newest, next(iter(program.asked), call.number) - 1)
                rows = schedule.coming(ROWS_SENT, now_ns=now_ns)
                held = RobotRows(options.key, number, acknowledged, rows)
            message = values.pack([call.number, left, delay, held, seen])
            if len(message) > values.BYTES_MAX:
                raise ValueRefused(f"got {len(message)} B, expected at most {values.BYTES_MAX}")
        except (ValueError, RecursionError) as error:  # ValueError: an image that cannot be resized
            self._refused += 1
            refused = events.ObservationRefused(robot=self._robot, reason=str(error))
            self._events.append(refused)
            refusal = f"the observation is refused: {error}"
            self._answer(program, call, Kind.ERROR, now_ns, refusal)
            return
        call.message, call.sent = message, compressed
        program.asked[call.number] = call
        while len(program.asked) > ASKED_MAX:
            del program.asked[next(iter(program.asked))]
        program.since.sent += 1
        self._ask(call, now_ns)
        before = program.asked.get(call.number - 1)
        if before:
            self._waits &= now_ns - before.began_ns <= options.deadline_ns
        if left and not (self._waits or is_first):
            self._answer(program, call, Kind.REST, now_ns)

    def _ask(self, call: _Call, now_ns: int) -> None:
        call.again_ns = now_ns + AGAIN_NS
        if self._session.exchange:
            self._session.exchange.send(OBSERVATION, call.message)

    def _delay_steps(self) -> int:
        """Largest number of rows executed before a chunk could change them."""
        return max((steps for _, steps in self._delays), default=0)

    def _is_needed(self, program: _Program, step: int, left: int, delay: int) -> bool:
        """Whether an observation at this step is sent, while `left` rows remain."""
        options = self._options
        if options.spare_rows is None or left <= delay or left < options.rows:
            return True
        newest, asked = next(reversed(program.asked.items()), (-1, None))
        if asked and newest > program.newest and step <= asked.step + delay:
            return False  # the chunk of the newest observation may be under way
        return left < options.spare_rows + delay

    def _accept(self, message: bytes, now_ns: int) -> None:
        """Accept a chunk or an error of the policy."""
        call_number, serialized, error = content(ChunkContent, message)
        try:
            reply = None if error else values.unpack(serialized)
        except ValueRefused:
            raise ProtocolError(Drop.FIELD) from None
        program = self._program
        asked = program.asked.get(call_number) if program else None
        if program is None or asked is None:
            raise ProtocolError(Drop.FOR_ANOTHER_LIFE)
        call = program.call
        if error:
            fault = f"error of the policy: {error[:200]}"
            if fault != program.since.fault:
                self._events.append(events.PolicyFailed(robot=self._robot, reason=error[:200]))
            program.since.fault = fault
            self._note("error", call_number, now_ns, fault=error[:200])
            return
        if program.newest < 0 and (call is None or call_number < call.number):
            why = "its call was answered with an error, and the robot may have been moved since"
            self._events.append(events.ChunkRefused(robot=self._robot, reason=why))
            self._note("refused", call_number, now_ns, fault=why)
            return
        schedule, delay_ns = program.schedule, now_ns - asked.began_ns
        self._waits = delay_ns <= self._options.deadline_ns
        # The robot stands until the first call, also of an episode, is answered.
        is_awaited = asked is call and asked.is_first and now_ns <= asked.answer_by_ns
        stood_ns = None if is_awaited else asked.stood_ns
        try:
            schedule.accept(call_number, asked.first, stood_ns, reply, now_ns=now_ns)
        except ValueError as refused:
            self._events.append(events.ChunkRefused(robot=self._robot, reason=str(refused)))
            program.since.fault = f"its chunk is refused: {refused}"
            self._note("refused", call_number, now_ns, fault=str(refused))
            return
        del program.asked[call_number]  # a first observation, sent repeatedly, may get it again
        self._note("chunk", call_number, now_ns, rows=len(rows_of(reply, self._options.key)))
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
            program.since = self._since_now()
        if call and call.number == call_number:
            self._answer(program, call, Kind.FRESH, now_ns)

    def _note(self, kind: str, call: int, now_ns: int, **content: Any) -> None:
        """Call `on_step` for the chunk or error that has just arrived."""
        exchange = self._session.exchange
        number = exchange.newest(CHUNK) if exchange else -1
        self._on_step(now_ns, LinkStep(kind, call, number, **content))

    def _answer(
        self, program: _Program, call: _Call, kind: Kind, now_ns: int, error: str = ""
    ) -> None:
        """Answer the program's present call."""
        program.call, schedule = None, program.schedule
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
            if not program.is_holding:
                program.is_holding = True
                self._events.append(events.Holding(robot=self._robot, reason=why))
        elif program.is_holding and not error:
            program.is_holding = False
            self._events.append(events.PlaysAgain(robot=self._robot, after_s=held_s))
        kind = Kind.ERROR if error else kind
        self._counts[kind] += 1
        if not call.is_first:
            self._late_ns = max(self._late_ns, now_ns - call.answer_by_ns)
        self._answered = AnsweredCall(
            now_ns,
            call.number,
            kind,
            now_ns - call.began_ns,
            now_ns - program.made_ns if program.newest >= 0 else -1,
            left,
            call.sent,
            None if error else reply,
        )
        call.message, call.sent = b"", None
        self._on_answer(self._answered)
        if error:
            self.send(FrameType.ERROR.value + error.encode(), program.peer, LINE)
        else:
            self.send(FrameType.MESSAGE.value + message, program.peer, LINE)

    def _why_no_row(self, program: _Program, call: _Call, since_ns: int, now_ns: int) -> str:
        """Reason why no row remains since `since_ns`, as far as this end can tell."""
        since, silence_ns = program.since, now_ns - self._session.heard_ns
        if self._session.exchange is None:
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
        reached = min(since.reported, since.sent)  # a first observation is sent repeatedly
        counts = f"{reached} of the last {since.sent} observations"
        return f"`policy serve` has reported {counts}, but no chunk has arrived"

    # -- time ----------------------------------------------------------------------------------

    def next_wake_ns(self) -> int | None:
        due, program = [self._session.due_ns()], self._program
        if program and (call := program.call):
            due.append(call.answer_by_ns)
            if call.is_first and call.message:
                due.append(call.again_ns)
        return min(due)

    def wake(self, *, now_ns: int) -> None:
        if (program := self._program) and (call := program.call):
            if now_ns >= call.answer_by_ns:
                self._answer(program, call, Kind.REST, now_ns)
            elif call.is_first and call.message and now_ns >= call.again_ns:
                # The program waits for its first answer, and sends no other observation.
                self._ask(call, now_ns)
        self._session.wake(now_ns=now_ns)
        self._send(now_ns)

    def figures(self) -> dict[str, Any]:
        exchange, program, last = self._session.exchange, self._program, self._answered
        return {
            "calls": self._calls,
            "answers": by_name({kind: self._counts[kind] for kind in Kind}),
            "late_s_max": max(self._late_ns, 0) / SECOND_NS,
            "observations_refused": self._refused,
            "delay_s": max(self._delays, default=(0, 0))[0] / SECOND_NS,
            "step_s": program.schedule.step_ns / SECOND_NS if program else None,
            "chunk_age_s": last.chunk_age_ns / SECOND_NS
            if last and last.chunk_age_ns >= 0
            else None,
            "rows_left": last.left if last else 0,
            "dropped": by_name(self._drops),
        } | ({"link": exchange.figures()} if exchange else {})
