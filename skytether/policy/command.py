"""Commands `skytether policy serve` (policy end) and `skytether policy join` (robot end)."""

import re
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec

from skytether.policy import inside, metrics, web
from skytether.policy.images import QUALITY, Compressor
from skytether.policy.pace import RATE_MAX, RATE_MIN
from skytether.policy.players import PLAYERS
from skytether.policy.robot import AnsweredCall, RobotEnd, RobotOptions
from skytether.shared.base import extras
from skytether.shared.base.units import MILLISECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import Event, address_text
from skytether.shared.events.processes import Counted, Listening, PageServed
from skytether.shared.scenario.registry import Parameter
from skytether.shared.telemetry.record import RECORDING
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read
from skytether.shell.driving.driver import Shell, run
from skytether.shell.host.paths import NetworkPath
from skytether.shell.host.udp import is_loopback
from skytether.shell.processes.log import Log, LogFormat
from skytether.shell.processes.metrics import Metric
from skytether.shell.processes.process import serving

if TYPE_CHECKING:
    from skytether.policy.page import CallPage
    from skytether.policy.recording import CallRecording

ABOUT = """usage: skytether policy serve|join ...

Connect a robot program to a policy server on another machine. `serve` runs
near the policy server, `join` on the robot. openpi's client and server need no
change.

    skytether policy serve --upstream ws://127.0.0.1:8000 --bind 0.0.0.0:47010
        --keys FILE
    skytether policy join gpu:47010 --listen 127.0.0.1:8000 --actions absolute
        --rows 10 --keys FILE

`skytether policy serve --help` and `skytether policy join --help` list their
options."""


@dataclass(frozen=True)
class EndOptions:
    """Options of both commands."""

    keys: Path | None = None
    """File with the keys, made by `skytether keygen`. Without keys the link is plaintext, and
    allowed only on this machine."""
    insecure: bool = False
    """Allow a plaintext link to another machine: anybody on the network can then control the
    robot."""
    rate: str | None = None
    """Largest send rate, as in 4mbit; by default limited only by the measured queueing delay."""
    log: LogFormat = "text"
    """Format of the log: text, one sentence per event; json, one JSON object per event."""
    metrics: str | None = None
    """HTTP address for Prometheus metrics and /healthz, HOST:PORT."""
    json: Path | None = None
    """JSON file for the counters, written at the end."""


@dataclass(frozen=True)
class ServeOptions(EndOptions):
    """Options of `skytether policy serve`."""

    upstream: Annotated[str, Argument(metavar="URL")] = "ws://127.0.0.1:8000"
    """Address of the policy server, which uses openpi's protocol."""
    api_key: str = ""
    """API key of the policy server."""
    bind: Annotated[tuple[str, ...], Argument(metavar="HOST:PORT", append=True)] = ()
    """HOST:PORT to listen on for robots, by default 127.0.0.1:47010. May be repeated."""
    patience: str = "30s"
    """Longest time for a reply of the policy server; after it, the connection is reopened."""
    give_rows: bool = False
    """Add the keys delay_steps, coming and committed to each observation: the rows that the robot
    will execute, for a policy that continues them."""


@dataclass(frozen=True)
class JoinOptions(EndOptions):
    """Options of `skytether policy join`."""

    server: Annotated[str, Argument(positional=True, metavar="HOST:PORT")] = ""
    """HOST:PORT of `skytether policy serve`."""
    actions: Literal["absolute", "delta", ""] = ""
    """Type of the actions; required. The hold action, executed when no row remains, is the last row
    for absolute, and zeros for delta."""
    listen: str = "127.0.0.1:8000"
    """HOST:PORT to listen on for the robot program, which connects with openpi's client."""
    deadline: str = "150ms"
    """Longest time from a call to its answer, except for the first call and the first after a
    pause."""
    hold: str = "1s"
    """Longest time for which calls are answered with the hold action; later calls get an error."""
    begin: str = "60s"
    """Longest time from the first call to its answer; some policies compile in the first call."""
    step: str | None = None
    """Length of a control step, in which the program executes a row, as in 20ms; by default the
    measured time from an answer to the next call, divided by --rows."""
    rows: Annotated[int, Argument(metavar="N")] = 1
    """Number of rows that the program executes of each answer: `action_horizon` of openpi's
    ActionChunkBroker. With a wrong number, rows are repeated or skipped when a chunk is late."""
    plays_on: bool = False
    """Count rows as executed during calls, too, for a program that makes calls in a separate
    thread. Requires --step."""
    when: str = "always"
    """Which observations are sent. always: each; needed(N): only if fewer than N rows will remain
    when the action chunk of the observation arrives, or if fewer than --rows remain."""
    merge: Literal["clock", "average", "drtc"] = "clock"
    """Rule for a step with rows in several chunks: clock, the row of the newest chunk; average, the
    mean of two rows, the newer one with weight 0.7, as in LeRobot; drtc, DRTC's rule. clock counts
    steps by the clock, the others by executed rows."""
    actions_key: str = "actions"
    """Key of the actions in the policy's replies."""
    resize: Annotated[int | None, Argument(metavar="PIXELS")] = None
    """Width and height to which images are resized, padded with black as by openpi; 224 for
    openpi's policies."""
    quality: int = QUALITY
    """JPEG quality, 1 to 100."""
    raw: Annotated[tuple[str, ...], Argument(metavar="KEY", append=True)] = ()
    """Key of an image that is sent without JPEG compression, as in observation/image. May be
    repeated."""
    path: Annotated[tuple[str, ...], Argument(metavar="LOCAL=HOST:PORT", append=True)] = ()
    """Path to the server, in place of HOST:PORT; with several paths, each datagram is sent over
    every path. LOCAL is an interface or an address of this machine, or empty."""
    robot: Annotated[int, Argument(name="id")] = 1
    """Number of this robot and its key, 0 to 65535, unique at the server."""
    record: Path | None = None
    """MCAP file for a recording of observations with images, answers and events, which Foxglove and
    `skytether explain` read."""
    page: str | None = None
    """HTTP address of a live page, as in 127.0.0.1:8080: answers, reasons for holds, network, and
    images. Everybody who can reach the address can see the page."""


def policy(argv: Sequence[str]) -> None:
    """Connect a robot program to a policy server on another machine."""
    name = argv[0] if argv else ""
    if name == "serve":
        serve(argv[1:])
    elif name == "join":
        join(argv[1:])
    elif name in ("", "-h", "--help"):
        print(ABOUT)
        if name:
            raise SystemExit(0)
        raise CommandError("policy: got nothing, expected serve or join", CONFIGURATION)
    else:
        raise CommandError(f"policy: got {name!r}, expected serve or join", CONFIGURATION)


def serve(argv: Sequence[str]) -> None:
    """Connect robots to a policy server, until SIGINT or SIGTERM.

    Each robot gets its own websocket connection to the policy server. While the policy computes,
    only the newest further observation of the robot is kept.
    """
    options = read(ServeOptions(), argv, "skytether policy serve", serve.__doc__)
    if why := web.check_url(options.upstream):
        raise _wrong("--upstream", options.upstream, f"ws://HOST:PORT or wss://HOST:PORT ({why})")
    binds = [command.address("--bind", each) for each in options.bind or ("127.0.0.1:47010",)]
    command.claim_output("--json", options.json)
    gate = inside.gate_of(options.keys)
    for bind in binds:
        command.check_sealed(bind, secure=bool(options.keys) or options.insecure)
    end = inside.policy_end(
        gate,
        patience_ns=_time_ns("--patience", options.patience),
        gives_rows=options.give_rows,
        rate_max=_rate(options.rate),
    )
    line = partial(web.PolicyLine, options.upstream, options.api_key)
    shell = Shell(end, [*binds], line=line)
    _drive("policy serve", end.figures, shell, options, "robots", metrics.SERVE)


def join(argv: Sequence[str]) -> None:
    """Answer a robot program by the deadline, with a policy on another machine.

    The program connects to --listen with openpi's client. If the action chunk of a call has not
    arrived by the deadline, the answer has the remaining rows of earlier chunks. If no row remains,
    the answer is the hold action for at most --hold, and then an error, on which the program must
    stop the robot.
    """
    options = read(JoinOptions(), argv, "skytether policy join", join.__doc__)
    if options.actions == "":
        why = "the hold action is the last row for absolute, zeros for delta"
        raise _wrong("--actions", "nothing", f"absolute or delta: {why}")
    if bool(options.server) == bool(options.path):
        got = "both" if options.path else "neither"
        raise CommandError(f"got {got}, expected either HOST:PORT or --path", CONFIGURATION)
    paths = command.paths("--path", options.path) if options.path else []
    paths = paths or [NetworkPath("", command.address("HOST:PORT", options.server))]
    for name in ("robot", "rows", "quality", "resize"):
        value, (least, most) = getattr(options, name), inside.BOUNDS[name]
        if value is not None and not least <= value <= most:
            flag = "--id" if name == "robot" else f"--{name}"
            raise _wrong(flag, value, f"{least:g} to {most:g}")
    listen_at = command.address("--listen", options.listen)
    page_at = command.address("--page", options.page) if options.page else None
    for flag, local in (("--listen", listen_at), ("--page", page_at)):
        if local and not (is_loopback(local) or options.insecure):
            expected = "an address of this machine alone, such as 127.0.0.1:8000, or --insecure"
            raise _wrong(flag, address_text(*local), expected)
    for option in ("json", "record"):
        command.claim_output(f"--{option}", getattr(options, option))
    if options.record and options.record.suffix != RECORDING:
        raise _wrong("--record", options.record, f"a file that ends in {RECORDING}")
    link = inside.link_of(options.keys, options.robot)
    for path in paths:
        command.check_sealed(path.peer, secure=link.secure or options.insecure)
    # Socket 1 is the local connection, so the second path has number 2.
    numbered = {number + (number > 0): path for number, path in enumerate(paths)}
    with ExitStack() as stack:
        of_end = _robot_options(options)
        recording: CallRecording | None = None
        page: CallPage | None = None
        if options.record:
            recording = stack.enter_context(_recorded(options.record, of_end))
        if page_at:
            page = stack.enter_context(_shown(page_at, options, of_end))
        watching = [each for each in (recording, page) if each]

        def note(call: AnsweredCall) -> None:
            for each in watching:
                each.note(call)

        def hear(event: Event) -> None:
            for each in watching:
                each.hear(event)

        compress = Compressor(options.resize, options.quality, options.raw)
        end = RobotEnd(
            options.robot,
            {number: path.peer for number, path in numbered.items()},
            link,
            of_end,
            boot_id=secrets.randbits(63),
            compress=compress,
            on_answer=note,
            on_step=recording.step if recording else lambda *_: None,
        )
        line = partial(web.ProgramServer, listen_at)
        shell = Shell(end, None, paths=numbered, is_patient=True, line=line)

        def figures() -> dict[str, Any]:
            return end.figures() | {"image_bytes": compress.bytes}

        about = "the robot program", metrics.JOIN
        _drive("policy join", figures, shell, options, *about, hear, page)


@contextmanager
def _shown(address: Address, options: JoinOptions, of_end: RobotOptions) -> Iterator["CallPage"]:
    """Serve the live page in the block."""
    from skytether.policy.page import CallPage
    from skytether.shell.processes.exporter import MetricsError

    about = {
        "robot": options.robot,
        "server": options.server or ", ".join(options.path),
        "actions": options.actions,
        "deadline_ms": of_end.deadline_ns / MILLISECOND_NS,
        "hold_ms": of_end.hold_ns / MILLISECOND_NS,
    }
    try:
        page = CallPage(address, about)
    except MetricsError as error:
        at = address_text(*address)
        raise CommandError(f"--page: cannot listen at {at}: {error}", CONFIGURATION) from None
    with closing(page):
        yield page


@contextmanager
def _recorded(path: Path, options: RobotOptions) -> Iterator["CallRecording"]:
    """Record calls to a file. If the disk fails, calls are still answered, and the command fails at
    the end.
    """
    with extras.named("record"):
        from skytether.policy.recording import CallRecording
    try:
        recording = CallRecording(path, options)
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}", CONFIGURATION) from None
    fault = ""
    try:
        yield recording
    finally:
        fault = recording.close()
    if fault:
        raise CommandError(fault)


def _robot_options(options: JoinOptions) -> RobotOptions:
    assert options.actions
    spare = None
    if options.when != "always":
        found = re.fullmatch(r"needed\((\d{1,4})\)", options.when)
        if not found:
            raise _wrong("--when", options.when, "always or needed(N), as in needed(2)")
        spare = int(found[1])
    if options.plays_on and options.step is None:
        raise _wrong(
            "--plays-on", "no --step", "--step: the step cannot be measured with --plays-on"
        )
    return RobotOptions(
        options.actions,
        _time_ns("--deadline", options.deadline),
        hold_ns=_time_ns("--hold", options.hold, 0),
        begin_ns=_time_ns("--begin", options.begin),
        key=options.actions_key,
        step_ns=None if options.step is None else _time_ns("--step", options.step),
        rows=options.rows,
        plays_on=options.plays_on,
        spare_rows=spare,
        rate_max=_rate(options.rate),
        player=PLAYERS[options.merge],
    )


def _drive(
    name: str,
    figures: Callable[[], dict[str, Any]],
    shell: Shell,
    options: EndOptions,
    waiting_for: str,
    table: Sequence[Metric],
    beside: Callable[[Event], None] = lambda _: None,
    page: "CallPage | None" = None,
) -> None:
    with (
        closing(Log(name, options.log, beside)) as out,
        serving(options.metrics, name, "", 0.0, table) as served,
    ):

        def start() -> None:
            host, port = shell.address
            out.say(Listening(host=host, port=port, waiting_for=waiting_for))
            if page:
                out.say(PageServed(address=f"http://{address_text(*page.address)}"))

        def counted() -> Counted:
            of_process = {"kernel_drops": shell.kernel_drops(), "send_errors": shell.send_errors}
            return Counted(figures=figures() | of_process | {"cpu_s": time.process_time()})

        def each_second() -> None:
            out.each_second()
            for shown in (served, page):
                if shown:
                    shown.take(counted().figures)

        run(
            [shell],
            on_start=start,
            on_event=out.hear,
            on_usr1=lambda: out.say(counted()),
            on_second=each_second,
        )
        last = counted()
        out.say(last)
        if options.json:
            command.write(options.json, msgspec.json.encode(last.figures))


def _time_ns(flag: str, text: str, least_s: float = 1e-9) -> int:
    """Parse the time given to a flag, with its unit [ns]: 150 instead of 150ms is refused."""
    expected = "a time such as 150ms or 1.5s, at most an hour"
    return seconds_to_ns(_quantity(flag, text, "time_s", (least_s, 3600.0), expected))


def _rate(text: str | None) -> float:
    """Parse the rate given to --rate [B/s]."""
    if text is None:
        return RATE_MAX
    expected = "a rate such as 4mbit, 50kbit to 1gbit"
    return _quantity("--rate", text, "bytes_per_s", (RATE_MIN, RATE_MAX), expected)


def _quantity(flag: str, text: str, name: str, limits: tuple[float, float], expected: str) -> float:
    """Parse a number with a unit; `name` ends with the unit of the result, see `registry.UNITS`."""
    value = 0.0 if text == "0" else Parameter(name).without_unit(text)
    if not isinstance(value, float) or not limits[0] <= value <= limits[1]:
        raise _wrong(flag, text, expected)
    return value


def _wrong(flag: str, got: object, expected: str) -> CommandError:
    return CommandError(f"{flag}: got {got}, expected {expected}", CONFIGURATION)
