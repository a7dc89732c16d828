"""Scenarios and flights from Python: `load`, `check`, `fly` and `fly_batch`."""

import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from os import PathLike, fspath
from typing import Any

import msgspec

from skytether.library.flight import Flight
from skytether.shared.base import extras
from skytether.shared.base.errors import ConfigError, FlightError
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import flat, set_keys
from skytether.shared.scenario.planners import Planner
from skytether.shared.scenario.registry import PLANNERS
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shell.commandline import plugins
from skytether.shell.host import temporary

Given = str | PathLike[str] | Scenario
"""Name of a scenario (`skytether list scenarios`), path of a .toml file, or a scenario."""


def load(scenario: Given, /, **keys: Any) -> Scenario:
    """Load a scenario, and replace keys as flags on the command line do.

        skytether.load("demo", duration=20, **{"control.trigger": "always"})

    Args:
        scenario: name of a scenario, path of a .toml file, or a scenario.
        keys: keys of the scenario and their values. A dot separates table and key, as in TOML. If
            the value is a mapping, it replaces only the keys that it contains.

    Raises:
        ConfigError: the scenario or a key does not exist, or a value cannot be flown.
        TypeError: `scenario` is of another type.
    """
    return named(scenario, keys)[1]


def check(scenario: Scenario | Mapping[str, Any], /, **keys: Any) -> Scenario:
    """Check every value of a scenario made by hand, and return the scenario.

    Args:
        scenario: a `Scenario`, or a mapping with the tables and keys of a TOML file.
        keys: see `load`.

    Raises:
        ConfigError: the scenario is invalid; the message names the first wrong value.
        TypeError: `scenario` is of another type.
    """
    if isinstance(scenario, Mapping):
        return reading.check(_laid({**scenario, **keys}, {}))
    if not isinstance(scenario, Scenario):
        raise TypeError(f"scenario: got {scenario!r}, expected a Scenario or a mapping of its keys")
    return load(scenario, **keys)


@extras.named()
def fly(
    scenario: Given,
    /,
    *,
    udp: bool = False,
    secure: bool = False,
    server: Endpoint | None = None,
    planner: Callable[..., Planner] | None = None,
    **keys: Any,
) -> Flight:
    """Fly a scenario: in virtual time, reproducible to the last bit, or over real UDP.

    Args:
        scenario: name of a scenario, path of a .toml file, or a scenario.
        udp: whether server, netem and client run as three processes on loopback, in real time.
        secure: whether the link is encrypted, with keys made for this flight.
        server: endpoint that replaces Skytether's server, only in virtual time. Each flight needs a
            new endpoint.
        planner: class that plans instead of the MPC, see `skytether.plugin.Planner`; only in
            virtual time. Alternatively, the key `control.planner` names a class decorated by
            `@planner`.
        keys: see `load`.

    Returns:
        The flight. If the vehicle could not fly, `Flight.failure` says why.

    Raises:
        ConfigError: the scenario cannot be flown, or cannot be flown with these arguments.
        FlightError: one of the three processes failed.
        TypeError: an argument is of another type.
    """
    if server is not None:
        _check_server(server, udp=udp, secure=secure)
    if planner is not None:
        keys["control.planner"] = _planner(planner, udp=udp)
    name, flown = named(scenario, keys)
    if server is None:
        prepare(flown)
    if udp:
        return Flight(flown, _over_udp(flown, secure=secure), name=name, secure=secure)
    from skytether.sim import flight  # imports the planner and numba, which takes a while

    record = flight.fly(flown, secure=secure, server=server)
    return Flight(flown, record, name=name, secure=secure)


@extras.named()
def fly_batch(scenario: Given, seeds: Iterable[int], /, **keys: Any) -> list[Flight]:
    """Fly a scenario in virtual time once for each seed, all flights together.

    This is several times faster than `fly`. Each flight equals the flight of `fly` with the same
    seed, to the last bit, but plans are not recorded.

    Args:
        scenario: name of a scenario, path of a .toml file, or a scenario.
        seeds: seeds of the flights, all different, as in `range(100)`.
        keys: see `load`.

    Raises:
        ConfigError: the scenario cannot be flown, or a seed is invalid or occurs twice.
        TypeError: an argument is of another type.
    """
    name, flown = named(scenario, keys)
    if not isinstance(seeds, Iterable) or isinstance(seeds, str):
        raise TypeError(f"seeds: got {seeds!r}, expected several seeds, as in range(100)")
    each = [_checked(name, flown, {"seed": seed}) for seed in seeds]
    numbers = [run.seed for run in each]
    for number in numbers:
        if numbers.count(number) > 1:
            raise ConfigError(f"seeds: got {number} twice, expected seeds that differ")
    prepare(*each)
    from skytether.sim import batch  # imports the planner and numba, which takes a while

    records = batch.fly_batch(flown, numbers)
    return [Flight(run, record, name=name) for run, record in zip(each, records, strict=True)]


def named(scenario: Given, keys: Mapping[str, Any]) -> tuple[str, Scenario]:
    """Name of a scenario, and the scenario with keys replaced. The name of a `Scenario` is its
    title.
    """
    plugins.load()  # plug-ins of installed packages, once per process
    if isinstance(scenario, Scenario):
        name, base = scenario.title, scenario
    elif isinstance(scenario, str | PathLike):
        name = fspath(scenario)
        base = reading.load_base(name)
    else:
        expected = "expected the name of a scenario, a .toml file or a Scenario"
        raise TypeError(f"scenario: got {scenario!r}, {expected}")
    return name, _checked(name, base, keys)


def prepare(*scenarios: Scenario) -> None:
    """Compile the kernels that these scenarios call, unless their machine code is on disk. Without
    scenarios, compile the kernels of all schemes. A note on stderr reports the compilation.
    """
    import skytether.sim.flight  # noqa: F401 - its kernels are those of every flight
    from skytether.server.schemes import loading
    from skytether.shared.base import machine_code
    from skytether.shell.commandline import terminal

    if not scenarios:
        loading.load_all()
    terminal.prepare(machine_code.missing(loading.others(*scenarios) if scenarios else ()))


def _checked(name: str, scenario: Scenario, keys: Mapping[str, Any]) -> Scenario:
    table = _laid(keys, msgspec.to_builtins(scenario, enc_hook=_plain))
    return reading.check(table, f"{name or 'the scenario'}{' with these keys' if keys else ''}")


def _laid(keys: Mapping[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = msgspec.to_builtins(dict(keys), enc_hook=_plain)
    set_keys(dict(flat(plain)), table)
    return table


def _plain(value: Any) -> Any:
    """Python value of a numpy number or array; the text of any other value, such as a path."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _check_server(server: Endpoint, *, udp: bool, secure: bool) -> None:
    """Refuse a user's endpoint that cannot replace Skytether's server.

    Raises:
        ConfigError: a flight over UDP or with encryption needs Skytether's server.
        TypeError: the server is not an endpoint.
    """
    if not isinstance(server, Endpoint):
        raise TypeError(f"server: got {server!r}, expected an Endpoint")
    if udp:
        raise ConfigError("udp: got True with a server of your own, expected virtual time")
    if secure:
        message = "got True with a server of your own, which cannot open encrypted packets"
        raise ConfigError(f"secure: {message}")


def _planner(planner: Callable[..., Planner], *, udp: bool) -> str:
    """Name of a planner class in the table PLANNERS, to which a missing class is added.

    Raises:
        ConfigError: the flight is over UDP, or another planner has this name.
        TypeError: the planner is not a class.
    """
    if not callable(planner):
        expected = "expected a class with the method plan, not an object made from it"
        raise TypeError(f"planner: got {planner!r}, {expected}")
    if udp:
        expected = "skytether fly with the planner in a file: --plugin FILE"
        raise ConfigError(f"udp: got True with a planner of this process, expected {expected}")
    for name, entry in PLANNERS.items():
        if entry.make is planner:
            return name
    PLANNERS.add(planner, planner.__name__)
    return planner.__name__


def _over_udp(scenario: Scenario, *, secure: bool) -> Record:
    """Fly over UDP in a separate thread, because the caller's thread may already run an event loop,
    as in a notebook.
    """
    from skytether.cli import processes
    from skytether.shell.commandline.command import CommandError
    from skytether.shell.processes.log import LogLine

    said: list[LogLine] = []
    stopped = threading.Event()
    with (
        temporary.folder() as parts,
        ThreadPoolExecutor(1) as pool,
        ExitStack() as stack,
    ):
        # After Ctrl-C the processes are asked to end, before the exception is raised again.
        stack.callback(stopped.set)
        flying = pool.submit(
            processes.run,
            scenario,
            parts,
            on_second=lambda _: None,
            interrupted=stopped.is_set,
            on_event=said.append,
            secure=secure,
        )
        try:
            shortfalls = flying.result()
        except CommandError as error:
            raise FlightError(str(error)) from None
        return processes.record_of(parts, scenario, shortfalls, said)
