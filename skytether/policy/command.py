"""`skytether policy serve` beside the policy, and `skytether policy join` on the robot."""

import re
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from skytether.policy import inside, metrics, web
from skytether.policy.images import QUALITY, Compressor
from skytether.policy.pace import RATE_MAX, RATE_MIN
from skytether.policy.players import Clocked, Freshest, Player, Queue
from skytether.policy.robot import CALL_COLUMNS, RobotEnd, RobotOptions
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.processes import Counted, Listening
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read
from skytether.shell.driving.driver import Shell, run
from skytether.shell.host.paths import NetworkPath
from skytether.shell.host.udp import AddressError
from skytether.shell.processes.log import Log, LogFormat
from skytether.shell.processes.metrics import Metric
from skytether.shell.processes.process import recorded, serving

PLAYERS: dict[str, Callable[[], Player]] = {
    "clock": Clocked,
    "average": partial(Queue, "average"),
    "drtc": Freshest,
}
UNITS_NS = {"": 1e9, "us": 1e3, "ms": 1e6, "s": 1e9}
RATES = {"kbit": 125.0, "mbit": 125e3, "gbit": 125e6}

ABOUT = """usage: skytether policy serve|join ...

A policy on another machine than its robot, over any network. `serve` runs
beside the policy's server, `join` on the robot; openpi's client and server are
as ever.

    skytether policy serve --upstream ws://127.0.0.1:8000 --bind 0.0.0.0:47010
        --keys FILE
    skytether policy join gpu:47010 --listen 127.0.0.1:8000 --actions absolute
        --keys FILE

`skytether policy serve --help` and `skytether policy join --help` have their
options."""


@dataclass(frozen=True)
class EndOptions:
    """Options of both ends."""

    keys: Path | None = None
    """File with the keys, made by `skytether keygen`. Without it the link is plaintext, which is
    refused beyond this machine."""
    insecure: bool = False
    """Accept a plaintext link to another machine: anybody on the network between can move the
    robot."""
    rate: str | None = None
    """Largest rate at which this end sends, as in 4mbit; by default what the path has, which is
    measured."""
    log: LogFormat = "text"
    """Format in which each event is printed: a sentence, or a line of JSON for a program."""
    metrics: str | None = None
    """HTTP address for Prometheus metrics and /healthz, HOST:PORT."""
    json: Path | None = None
    """File for the counters at the end, as JSON."""


@dataclass(frozen=True)
class ServeOptions(EndOptions):
    """Options of `skytether policy serve`."""

    upstream: Annotated[str, Argument(metavar="URL")] = "ws://127.0.0.1:8000"
    """Address of the policy's server, which speaks openpi's protocol."""
    api_key: str = ""
    """Key that the policy's server asks for."""
    bind: Annotated[tuple[str, ...], Argument(metavar="HOST:PORT", append=True)] = ()
    """HOST:PORT to listen on for robots, by default 127.0.0.1:47010; may be repeated."""
    patience: str = "30s"
    """Longest time that the policy may think; then its connection is opened anew."""
    give_rows: bool = False
    """Give the policy the rows that the robot will play, as further keys of each observation:
    delay_steps, coming and committed."""


@dataclass(frozen=True)
class JoinOptions(EndOptions):
    """Options of `skytether policy join`."""

    server: Annotated[str, Argument(positional=True, metavar="HOST:PORT")] = ""
    """HOST:PORT of `skytether policy serve`."""
    actions: Literal["absolute", "delta", ""] = ""
    """What holds the robot when no action is left: the last one again if actions are absolute,
    zeros if they are changes. Must be given."""
    listen: str = "127.0.0.1:8000"
    """HOST:PORT to listen on for the robot's program, which connects with openpi's client."""
    deadline: str = "150ms"
    """Longest time for an answer."""
    hold: str = "1s"
    """Longest time to hold when no action is left; then the program gets an error."""
    begin: str = "60s"
    """Longest time for the first answer: a policy may compile itself at first."""
    step: str | None = None
    """Time for which the program plays a row of actions, as in 20ms; by default it is measured, as
    the time from an answer to the next call, divided by --rows."""
    rows: Annotated[int, Argument(metavar="N")] = 1
    """Number of rows that the program plays of each answer: `action_horizon` of openpi's
    ActionChunkBroker, or 1 without one."""
    plays_on: bool = False
    """Whether the robot goes on to play rows while its program waits for an answer. Needs --step.
    """
    when: str = "always"
    """Which observations are sent: always, or needed(N): those for which fewer than N rows will be
    left when the answer comes."""
    merge: Literal["clock", "average", "drtc"] = "clock"
    """Row that is played where several chunks have one: that of the newest by the clock; or as
    LeRobot's average, or DRTC's rule, whose steps are counted by rows played."""
    actions_key: str = "actions"
    """Key of the actions in the policy's replies."""
    resize: Annotated[int | None, Argument(metavar="PIXELS")] = None
    """Side to which images are resized, with black bars, as openpi does; 224 for its policies."""
    quality: int = QUALITY
    """Quality of JPEG, 1 to 100."""
    raw: Annotated[tuple[str, ...], Argument(metavar="KEY", append=True)] = ()
    """Key of an image that is sent as it is, as in observation/image; may be repeated."""
    path: Annotated[tuple[str, ...], Argument(metavar="LOCAL=HOST:PORT", append=True)] = ()
    """Path to the server, in place of HOST:PORT; with several, each datagram takes all of them.
    LOCAL is an interface or an address of this machine, or empty."""
    robot: Annotated[int, Argument(name="id")] = 1
    """Number of this robot (0 to 65535), unique among the robots of a server, and of its key."""
    record: Path | None = None
    """File for a row for each answer: when, what kind, how old, how many rows were left."""


def policy(argv: Sequence[str]) -> None:
    """Connect a robot's program with a policy on another machine."""
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
    """Serve robots from beside a policy, until SIGINT or SIGTERM.

    Each robot gets a connection of its own to the policy's server. While the policy thinks, a newer
    observation of the robot takes the place of one that waits.
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
    bound: list[Any] = list(binds)
    line = partial(web.PolicyLine, options.upstream, options.api_key)
    shell = _shell(end, bound, line=lambda hear, _: line(hear))
    _drive("policy serve", end.figures, shell, options, "robots", metrics.SERVE)


def join(argv: Sequence[str]) -> None:
    """Answer a robot's program by the deadline, with a policy on another machine.

    The program connects with openpi's client to --listen. An answer that does not come by the
    deadline is what is left of the one before, from the present row on; then the robot is held, for
    --hold at most; then the program gets an error, so that its own stop acts.
    """
    options = read(JoinOptions(), argv, "skytether policy join", join.__doc__)
    if options.actions == "":
        why = "what holds the robot is the last row again for one, and zeros for the other"
        raise _wrong("--actions", "nothing", f"absolute or delta: {why}")
    if bool(options.server) == bool(options.path):
        got = "both" if options.path else "neither"
        raise CommandError(f"got {got}, expected either HOST:PORT or --path", CONFIGURATION)
    paths = command.paths("--path", options.path) if options.path else []
    paths = paths or [NetworkPath("", command.address("HOST:PORT", options.server))]
    for flag, value, least, most in (
        ("--id", options.robot, 0, 65_535),
        ("--rows", options.rows, 1, 1024),
        ("--quality", options.quality, 1, 100),
        ("--resize", options.resize or 32, 32, 4096),
    ):
        if not least <= value <= most:
            raise _wrong(flag, value, f"{least} to {most}")
    for option in ("json", "record"):
        command.claim_output(f"--{option}", getattr(options, option))
    link = inside.link_of(options.keys, options.robot)
    for path in paths:
        command.check_sealed(path.peer, secure=link.secure or options.insecure)
    # Socket 1 is the line, so the second path has number 2.
    numbered = {number + (number > 0): path for number, path in enumerate(paths)}
    with ExitStack() as stack:
        recorder = None
        if options.record:
            recorder = stack.enter_context(recorded(options.record, CALL_COLUMNS)).recorder
        compress = Compressor(options.resize, options.quality, options.raw)
        end = RobotEnd(
            options.robot,
            {number: path.peer for number, path in numbered.items()},
            link,
            _robot_options(options),
            boot_id=secrets.randbits(63),
            compress=compress,
            recorder=recorder,
        )
        listen = partial(web.ProgramLine, command.address("--listen", options.listen))
        shell = _shell(
            end, None, paths=numbered, is_patient=True, line=lambda hear, _: listen(hear)
        )

        def figures() -> dict[str, Any]:
            return end.figures() | {"image_bytes": compress.bytes}

        _drive("policy join", figures, shell, options, "the robot's program", metrics.JOIN)


def _robot_options(options: JoinOptions) -> RobotOptions:
    assert options.actions
    spare = None
    if options.when != "always":
        found = re.fullmatch(r"needed\((\d{1,4})\)", options.when)
        if not found:
            raise _wrong("--when", options.when, "always or needed(N), as in needed(2)")
        spare = int(found[1])
    if options.plays_on and options.step is None:
        raise _wrong("--plays-on", "no --step", "one: it cannot be measured then")
    return RobotOptions(
        options.actions,
        _time_ns("--deadline", options.deadline),
        hold_ns=_time_ns("--hold", options.hold),
        begin_ns=_time_ns("--begin", options.begin),
        key=options.actions_key,
        step_ns=None if options.step is None else _time_ns("--step", options.step),
        rows=options.rows,
        plays_on=options.plays_on,
        spare_rows=spare,
        rate_max=_rate(options.rate),
        player=PLAYERS[options.merge],
    )


def _shell(end: Endpoint, bind: list[Any] | None, **options: Any) -> Shell:
    try:
        return Shell(end, bind, **options)
    except AddressError as error:
        raise CommandError(str(error)) from None


def _drive(
    name: str,
    figures: Callable[[], dict[str, Any]],
    shell: Shell,
    options: EndOptions,
    waiting_for: str,
    table: Sequence[Metric],
) -> None:
    with (
        closing(Log(name, options.log, lambda _: None)) as out,
        serving(options.metrics, name, "", 0.0, table) as served,
    ):

        def start() -> None:
            host, port = shell.address
            out.say(Listening(host=host, port=port, waiting_for=waiting_for))

        def counted() -> Counted:
            of_process = {"kernel_drops": shell.kernel_drops(), "send_errors": shell.send_errors}
            return Counted(figures=figures() | of_process | {"cpu_s": time.process_time()})

        def each_second() -> None:
            out.each_second()
            if served:
                served.take(counted().figures)

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


def _time_ns(flag: str, text: str) -> int:
    """Time given to a flag [ns]; without a unit in seconds."""
    expected = "a time such as 150ms or 1.5s, at most an hour"
    return round(_quantity(flag, text, UNITS_NS, (1, 3600 * SECOND_NS), expected))


def _rate(text: str | None) -> float:
    """Rate given to --rate [B/s]."""
    if text is None:
        return RATE_MAX
    expected = "a rate such as 4mbit, 100kbit to 1gbit"
    return _quantity("--rate", text, RATES, (RATE_MIN, RATE_MAX), expected)


def _quantity(
    flag: str, text: str, units: Mapping[str, float], limits: tuple[float, float], expected: str
) -> float:
    found = re.fullmatch(r"(\d{1,6}(?:\.\d{1,9})?)([a-z]*)", text)
    value = float(found[1]) * units.get(found[2], 0.0) if found else 0.0
    if not limits[0] <= value <= limits[1]:
        raise _wrong(flag, text, expected)
    return value


def _wrong(flag: str, got: object, expected: str) -> CommandError:
    return CommandError(f"{flag}: got {got}, expected {expected}", CONFIGURATION)
