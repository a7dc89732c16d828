"""`python -m skytether.client`: one simulated UAV as a process."""

import sys

from skytether.shell.commandline.start import run

if __name__ == "__main__":  # before the slow imports below
    sys.exit(run("skytether.client.__main__:fly", "client"))

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec

from skytether.client import vehicles
from skytether.client.alone import Reach
from skytether.client.endpoint import Client
from skytether.client.fleet import ClientFleet
from skytether.client.link import ClientLink, PlainLink
from skytether.client.vehicle import Vehicle, VehicleMemory
from skytether.shared.endpoints.steady import Steady
from skytether.shared.events.aboard import ParametersUnsafe
from skytether.shared.events.flight import Event, NoSession, SessionRefused, address_text
from skytether.shared.events.processes import NotRecalled, Recalled
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import client_columns
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire import protocol
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioName
from skytether.shell.host.paths import NetworkPath
from skytether.shell.processes import process
from skytether.shell.processes.process import ProcessOptions

if TYPE_CHECKING:
    from skytether.client.memory import SavedState
    from skytether.shared.wire.keys import Keyring
    from skytether.shell.driving.memory import MemoryFile

NONE = "none"
"""Value of --standby that means: no standby server."""


@dataclass(frozen=True)
class ClientOptions(ProcessOptions):
    scenario: ScenarioName = "demo"
    """A scenario's name (`skytether list scenarios`) or a .toml file; the same as the server's."""
    server: str = "127.0.0.1:47000"
    """HOST:PORT of netem, or of the server itself; an IPv6 host in brackets, as in [::1]:47000."""
    path: Annotated[
        tuple[str, ...],
        Argument(
            metavar="LOCAL=HOST:PORT",
            append=True,
            help="Path to the server, in place of --server; may be repeated for up to four paths, "
            "each of which may fail for a time. LOCAL is an interface, as in wwan0=ground:47000, "
            "or an address of this machine, as in 192.0.2.7=ground:47000 or "
            "[2001:db8::7]=ground:47000, or empty for any address.",
        ),
    ] = ()
    standby: Annotated[
        tuple[str, ...],
        Argument(
            metavar="HOST:PORT",
            append=True,
            help="Standby server, or netem in front of it: this server leads when the first is "
            "silent, and may be unreachable for a time, also at the start. Repeat --standby with "
            "LOCAL=HOST:PORT, as in --path, for each path to it. none: no standby server.",
        ),
    ] = ()
    number: Annotated[int, Argument(name="id")] = 1
    """Number of this vehicle (0 to 65535), unique among the vehicles of a server."""
    vehicles: Annotated[int, Argument(metavar="N")] = 1
    """Number of vehicles to fly in this process; the first has the number --id."""
    keys: Path | None = None
    """File with the vehicle's key, made by `skytether keygen`. Without this file the link is
    plaintext. A plaintext link is refused unless the server is on this machine."""
    key_id: Annotated[int | None, Argument(metavar="N")] = None
    """Number of the key to use if the file has two keys of the vehicle; by default the highest."""
    set_parameters: bool = False
    """If the autopilot reacts unsafely to set-points that stop, set its parameters to safe values.
    Without --set-parameters, unsafe values are only reported, and the vehicle is not armed."""
    insecure: bool = False
    """Accept a plaintext link to another machine: anybody on the network between the two machines
    can then fly the vehicle."""
    json: Path | None = None
    """File for the client's summary of the flight, or for counters and CPU time if the client flies
    several vehicles."""
    new_flight: bool = False
    """Begin a new flight: ignore what an earlier run saved in `vehicle.memory` and what was set in
    flight. Give --new-flight by hand only, never in the command of a service."""


def fly(argv: Sequence[str]) -> None:
    """Fly one simulated UAV for `--duration` seconds, or until SIGINT or SIGTERM.

    SIGUSR1 prints the counters so far. The exit code is 1 if no server answers, if no plan was ever
    flown or none was in force at the end, or if the record is incomplete; 2 if the server flies
    another scenario, is full, or has another client with this number.
    """
    options = command.parse(ClientOptions(), argv, "skytether client", fly.__doc__)
    paths, standby = _paths(options), _standby(options)
    command.check_count("--vehicles", options.vehicles, 65_536)
    numbers = range(options.number, options.number + options.vehicles)
    if not (numbers[0] >= 0 and numbers[-1] < 2**16):
        numbers_text = f"{numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else numbers[0]
        raise CommandError(f"--id: got {numbers_text}, expected 0 to 65535", 2)
    command.check_sockets("--vehicles", len(numbers))
    keyring: Keyring | None = (
        load("skytether.shared.wire.keys", "--keys").load(options.keys) if options.keys else None
    )
    protocol.preload()
    alone = len(numbers) == 1

    def link(number: int) -> ClientLink:
        if keyring is None:
            return PlainLink()

        from skytether.client.secure import SecureLink  # slow: loads 6 MB of ciphers

        return SecureLink(keyring.of(number, options.key_id), entropy=secrets.token_bytes)

    with (
        process.begin(
            "client",
            replace(options, json=None) if alone else options,
            client_columns(options.config.model.axes),
            secure=keyring is not None,
            warnings=command.flight_warnings(options.config),
            keeps_rows=True,
        ) as running,
        ExitStack() as stack,
    ):
        scenario = running.scenario
        flying = [vehicles.make(scenario, number) for number in numbers]
        memory = stack.enter_context(_memory(options, flying, keyring))
        make = _saving(memory, scenario, numbers[0], running.warnings) if memory else Client
        if kernel := sys.modules.get("skytether.shared.base.kernel"):  # the simulation is compiled
            from skytether.shared.base import machine_code

            terminal.prepare(machine_code.missing())
            kernel.load()
        line = vehicles.connection(flying[0], scenario)
        if line is not None:
            command.check_count(f"--vehicles with {scenario.vehicle.kind}", len(numbers), 1)
        if options.set_parameters and not flying[0].set_parameters():
            kind = f"got vehicle.kind = {scenario.vehicle.kind!r}, expected one with parameters"
            raise CommandError(f"--set-parameters: {kind}", command.CONFIGURATION)
        several, sockets = None, {0: paths[0]}
        if len(paths) > 1 or standby:
            several, sockets = _several(paths, standby, scenario, partial(link, numbers[0]))
        clients = [
            make(
                scenario,
                flies,
                server=several or paths[0].peer,
                vehicle=number,
                boot_id=secrets.randbits(64),
                link=None if several else link(number),
                recorder=running.recorder,
            )
            for number, flies in zip(numbers, flying, strict=True)
        ]
        endpoint = (
            clients[0]
            if alone
            else ClientFleet(clients, vehicles.apart_ns(len(clients), scenario.dt_ns))
        )
        running.drive(
            Steady(endpoint),
            bind=None,
            paths=sockets,
            waiting_for=(
                f"its {scenario.vehicle.kind} vehicle at {scenario.vehicle.address}"
                if line
                else _servers(paths, standby)
            ),
            insecure=options.insecure,
            line=line,
            is_patient=True,
            memory=memory,
        )
        recording = running.recording
        assert recording
        if alone and len(rows := recording.rows()):
            summary = summarise(scenario, options.scenario, rows, secure=keyring is not None)
            title = "client, as far as it is recorded" if recording.fault() else "client"
            if options.log == "text":
                terminal.finish(summary, title, options.json)
            elif options.json:
                command.write(options.json, msgspec.json.encode(summary))
        if failure := endpoint.failure:
            refused = isinstance(failure, SessionRefused | NoSession | ParametersUnsafe)
            message = failure.brief if isinstance(failure, ParametersUnsafe) else str(failure)
            raise CommandError(message, command.CONFIGURATION if refused else command.RUN)


def _paths(options: ClientOptions) -> Sequence[NetworkPath]:
    if not options.path:
        return [NetworkPath("", command.address("--server", options.server))]
    if options.server != ClientOptions.server:
        raise CommandError("--path: got --server as well, expected one of them", 2)
    if options.vehicles > 1:
        raise CommandError(f"--vehicles: got {options.vehicles} with --path, expected 1", 2)
    return command.paths("--path", options.path)


def _several(
    paths: Sequence[NetworkPath],
    standby: Sequence[NetworkPath],
    scenario: Scenario,
    link: Callable[[], ClientLink],
) -> tuple[Reach, dict[int, NetworkPath]]:
    """Routes of a vehicle to its servers, and the network path of each of its sockets."""
    expected = len(scenario.paths)
    if len(paths) > 1 and 1 < expected != len(paths):
        message = f"--path: got {len(paths)}, expected {expected}, as many as network.paths"
        raise CommandError(message, command.CONFIGURATION)
    several = load("skytether.client.several", "several paths or servers")
    reach = several.Several(
        [path.peer for path in paths],
        link(),
        names=[str(path) for path in paths] if len(paths) > 1 else (),
        standby=[each.peer for each in standby],
        standby_link=link() if standby else None,
    )
    return reach, several.by_socket(paths, standby)


def _standby(options: ClientOptions) -> Sequence[NetworkPath]:
    if options.standby in ((), (NONE,)):
        return []
    if options.vehicles > 1:
        raise CommandError(f"--vehicles: got {options.vehicles} with --standby, expected 1", 2)
    standby = command.paths("--standby", options.standby, needs_local=False)
    leading = [path.peer for path in _paths(options)]
    for path in standby:
        if path.peer in leading:
            at = address_text(*path.peer)
            raise CommandError(f"--standby: got {at}, expected another server than the first", 2)
    return standby


def _servers(paths: Sequence[NetworkPath], standby: Sequence[NetworkPath]) -> str:
    """Addresses of the servers that the client waits for, in words."""

    def addresses(paths: Sequence[NetworkPath]) -> str:
        return " and ".join(dict.fromkeys(address_text(*path.peer) for path in paths))

    first = f"the server at {addresses(paths)}"
    return f"{first}, or the standby server at {addresses(standby)}" if standby else first


@contextmanager
def _memory(
    options: ClientOptions, flying: Sequence[Vehicle], keyring: "Keyring | None"
) -> "Iterator[MemoryFile | None]":
    """File that keeps the client's state for its next run; None if `vehicle.memory` keeps no state.

    Raises:
        CommandError: the file cannot be written, or another process uses it.
    """
    setting, number = options.config.vehicle.memory, options.number
    if setting == "none" or (setting == "auto" and flying[0].port is None):
        yield None
        return
    if len(flying) > 1:
        raise CommandError("vehicle.memory: got a folder, expected none with --vehicles", 2)
    from skytether.shell.driving.memory import MemoryFile, folder

    key = keyring.of(number, options.key_id) if keyring else None
    identity = {
        "vehicle": str(number),
        "key": str(key.number) if key else "none",
        "autopilot": options.config.vehicle.address,
        "terms": blake2b(repr(options.config.terms()).encode(), digest_size=8).hexdigest(),
    }
    path = folder(setting) / f"client-{number}"
    try:
        memory = MemoryFile(path, identity, key.mac if key else b"")
        if options.new_flight:
            memory.forget()
    except OSError as error:
        problem = f"vehicle.memory: {error.strerror or error}"
        raise CommandError(f"{problem}; expected a folder of its own, or none", 2) from None
    with closing(memory):
        yield memory


def _saving(
    memory: "MemoryFile", scenario: Scenario, number: int, warnings: list[Event]
) -> Callable[..., Client]:
    """Function that makes a client that saves its state, and continues from an earlier run's state.

    A warning is added to `warnings` if a saved state was used, or could not be used.
    """
    room = load("skytether.client.memory", "vehicle.memory")
    before: SavedState | None = None
    try:
        if saved := memory.read():
            before = room.recall(*saved, time.monotonic_ns(), scenario.terms())
            warnings.append(Recalled(vehicle=number, goes_on=before.boot_id is not None))
    except ValueError as error:
        warnings.append(NotRecalled(vehicle=number, reason=str(error)))
        # The lost state may be that of an armed vehicle: only an operator may arm it again.
        before = room.SavedState(frame=VehicleMemory(armed=True))
    return partial(room.SavingClient, before=before)
