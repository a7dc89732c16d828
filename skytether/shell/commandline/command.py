"""Common parts of all commands, from parsing arguments to reporting an error in one line.

A command's options are a dataclass with a field `scenario` for the scenario's name and a field
`config` for the scenario itself. Every key of the scenario is a flag; flags override the file.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from errno import EMFILE
from pathlib import Path
from typing import Annotated, Protocol, TypeVar

import msgspec

from skytether.shared.base import extras, files
from skytether.shared.base.errors import ConfigError, RecordingError
from skytether.shared.base.extras import ExtraMissing
from skytether.shared.base.printable import printable
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.endpoints.line import HOST_PORT, parse_address
from skytether.shared.events.flight import Event, address_text
from skytether.shared.events.processes import NoFailsafe
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shared.scenario.whole import Scenario
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shell.commandline import plugins
from skytether.shell.commandline.argument import HELP_KEYS, Argument
from skytether.shell.commandline.options import key_values, read
from skytether.shell.host import system
from skytether.shell.host.paths import PATH_FORM, NetworkPath, parse_path
from skytether.shell.host.udp import (
    SPARE_FILES,
    allow_sockets,
    is_loopback,
    look_up,
    sockets_max,
)

CONFIGURATION, RUN, INTERRUPTED = 2, 1, 128 + signal.SIGINT
"""Exit codes: 2 invalid request, 1 failure during the run, 130 ended by Ctrl-C."""
OUTPUTS = ("json", "figure", "record")

ScenarioName = Annotated[str, Argument(metavar="SCENARIO", positional=True)]
ScenarioFlags = Annotated[Scenario, Argument(name="")]
Plugins = Annotated[
    tuple[Path, ...],
    Argument(
        metavar="FILE",
        append=True,
        help="Python file with impairments, triggers, references and others of your own; may be "
        "repeated. See `skytether list impairments`, `triggers`, `references`.",
    ),
]


@dataclass(frozen=True)
class ScenarioOptions:
    scenario: ScenarioName = "demo"
    """A scenario's name (`skytether list scenarios`) or a .toml file."""
    plugin: Plugins = ()
    config: ScenarioFlags = Scenario()


class CommandError(Exception):
    """Error that ends a command: a message of one line, and the exit code."""

    def __init__(self, message: str, code: int = RUN) -> None:
        super().__init__(message)
        self.code = code


class Options(Protocol):
    @property
    def scenario(self) -> str: ...

    @property
    def config(self) -> Scenario: ...


T = TypeVar("T")
O = TypeVar("O", bound=Options)  # noqa: E741 - the options of one command


def parse(
    defaults: O,
    argv: Sequence[str],
    prog: str,
    help_: str | None,
    *,
    leads: bool = True,
    is_final: bool = True,
) -> O:
    """Parse a command line; returns its options, with the named scenario changed by its flags.

    The scenario is checked once, with its final values, because a flag may resolve a contradiction
    in the file.

    Args:
        leads: whether the scenario's name may be the first argument, without a flag.
        is_final: whether to check the scenario; False for a command that changes further keys and
            checks the scenario itself.

    Raises:
        CommandError: an output file cannot be written, is an input, or is locked.
        ConfigError: the scenario cannot be flown, or a plug-in cannot be imported.
        SystemExit: the help or an error in a flag was printed.
    """
    plugins.load(plugins.named(argv))
    argv, values = key_values(argv, type(defaults))
    if HELP_KEYS in argv:  # the help shows the scenario's values of the keys
        named = leads and argv and not argv[0].startswith("-")
        base = reading.load_base(argv[0] if named else defaults.scenario)
        defaults = replace(defaults, config=base)  # type: ignore[type-var]
    options = read(defaults, argv, prog, help_)
    name = options.scenario
    base = reading.load_base(name)
    table = reading.to_table(base)
    set_keys(values, table)
    read_scenario = reading.check if is_final else reading.convert
    source = name if table == reading.to_table(base) else f"{name} and the command line"
    checked = read_scenario(table, source)
    for option in OUTPUTS:
        claim_output(f"--{option}", getattr(options, option, None))
    return replace(options, config=checked)  # type: ignore[type-var]


def address(flag: str, text: str) -> Address:
    """Address given to a flag as HOST:PORT, with an IPv6 host in brackets."""
    parsed = parse_address(text)
    if parsed is None:
        raise CommandError(f"{flag}: got {text!r}, expected {HOST_PORT}", CONFIGURATION)
    return parsed


def paths(flag: str, texts: Sequence[str], *, needs_local: bool = True) -> list[NetworkPath]:
    """Paths given to a flag, each as LOCAL=HOST:PORT.

    Args:
        needs_local: whether HOST:PORT without LOCAL is refused.
    """
    check_count(flag, len(texts), PATHS_MAX)
    parsed: list[NetworkPath] = []
    for text in texts:
        path = parse_path(text if needs_local or "=" in text else f"={text}")
        if path is None:
            form = PATH_FORM if needs_local else f"{HOST_PORT}; or {PATH_FORM}"
            raise CommandError(f"{flag}: got {text!r}, expected {form}", CONFIGURATION)
        if path in parsed:
            raise CommandError(f"{flag}: got {text!r} twice, expected it once", CONFIGURATION)
        parsed.append(path)
    return parsed


def flight_warnings(scenario: Scenario) -> list[Event]:
    return [NoFailsafe()] if scenario.vehicle.exhausted == "hold" else []


def optional_address(flag: str, text: str | None) -> Address | None:
    return None if text is None else address(flag, text)


def check_count(flag: str, given: int, most: int) -> None:
    """Refuse a count outside 1 to `most`."""
    if not 1 <= given <= most:
        raise CommandError(f"{flag}: got {given}, expected 1 to {most}", CONFIGURATION)


def check_sealed(bind: Address, *, secure: bool) -> None:
    """Refuse a run without keys at an address that other machines can reach."""
    with suppress(OSError):  # an unusable address is reported when the socket is bound
        if not (secure or is_loopback(look_up(bind))):
            raise unsealed(bind)


def unsealed(*addresses: Address) -> CommandError:
    at = ", ".join(address_text(*address) for address in addresses)
    expected = "expected --keys FILE (see skytether keygen), or --insecure"
    message = f"{at}: other machines can reach it and there are no keys, {expected}"
    return CommandError(message, CONFIGURATION)


def check_sockets(flag: str, given: int) -> None:
    """Raise this process's limit of open files for a number of sockets, or refuse the number."""
    most = sockets_max()
    if given > most:
        needed = f"got {given}, which takes {given + SPARE_FILES} open files"
        allowed = f"expected at most {max(most, 0)}, for {_may_be_open()}"
        raise CommandError(f"{flag}: {needed}; {allowed}", CONFIGURATION)
    allow_sockets(given)


def claim_output(flag: str, path: Path | None) -> None:
    """Lock an output file until the command ends. Called before any flight, so that an unusable
    file is reported at once.

    Raises:
        CommandError: the file cannot be written, is an input, is named by another option, or is
            locked by another command.
    """
    _claim(files.claim, flag, path)


def claim_folder(flag: str, path: Path | None, *names: str) -> None:
    """Lock an output folder until the command ends; a missing folder is created.

    Args:
        names: files that will be written in it.

    Raises:
        CommandError: the folder cannot be created, is locked by another command, or one of the
            files cannot be written or is an input.
    """
    _claim(files.claim_folder, flag, path)
    for name in names:
        _claim(files.check, flag, path and path / name)


def _claim(claim: Callable[[Path], object], flag: str, path: Path | None) -> None:
    try:
        if path is not None:
            claim(path)
    except OSError as error:
        message = f"{flag}: {path}: cannot be written: {error.strerror}"
        raise CommandError(message, CONFIGURATION) from None


def refuse_errors(plugin_errors: Mapping[str, int] | None) -> None:
    """Raise CommandError if a plug-in's code has failed in flight, see `Summary.plugin_errors`."""
    for kind, count in (plugin_errors or {}).items():
        raise CommandError(f"the plug-in's {kind} failed {count} times; the log has the first")


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Catch Ctrl-C and SIGTERM in the block; yields a function that returns whether one came."""
    interrupted = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: interrupted.set()) for number in numbers]
    try:
        yield interrupted.is_set
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def main(command: Callable[[Sequence[str]], None], argv: Sequence[str] | None, prog: str) -> int:
    """Run a command, and print one line on stderr if it fails; returns the command's exit code."""
    try:
        try:
            with extras.named(), files.apart():
                command(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()
    except CommandError as error:
        return _refuse(prog, str(error), error.code)
    except (ConfigError, RecordingError, ExtraMissing) as error:
        return _refuse(prog, str(error), CONFIGURATION)
    except KeyboardInterrupt:  # Ctrl-C before `interruptible` was entered
        return INTERRUPTED
    # errors of the machine, not of Skytether: a full disk, too few open files, a broken pipe
    except OSError as error:
        # the reader of our output has closed the pipe, as `head` does
        is_closed = isinstance(error, BrokenPipeError)
        with suppress(OSError):
            sys.stdout.flush()
            return RUN if is_closed else _refuse(prog, _reason(error), RUN)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return RUN if is_closed else _refuse(prog, _reason(error), RUN)
    return 0


def _refuse(prog: str, message: str, code: int) -> int:
    """Print an error as one line, whatever characters it contains; returns the exit code."""
    print(printable(f"{prog}: {message}"), file=sys.stderr)
    return code


def _may_be_open() -> str:
    return f"{system.files_max()} may be open here (ulimit -n)"


def _reason(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    allowed = (
        f"; {system.files_max()} may be open here (ulimit -n)" if error.errno == EMFILE else ""
    )
    return f"{where}{error.strerror or error}{allowed}"


def write(path: Path, json: bytes) -> None:
    try:
        files.write(path, msgspec.json.format(json, indent=2) + b"\n")
    except OSError as error:
        raise CommandError(f"{path}: cannot be written: {error.strerror}") from None
