"""`python -m skytether.server`: the server as a process."""

import sys

from skytether.shell.commandline.start import run

if __name__ == "__main__":  # before the slow imports below
    sys.exit(run("skytether.server.__main__:serve", "server"))

import secrets
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from socket import socket
from typing import TYPE_CHECKING, Annotated

from skytether.server import assignment, routes
from skytether.server.endpoint import VEHICLES_MAX, Server
from skytether.server.gate import Gate, PlainGate
from skytether.server.schemes import loading
from skytether.shared.base import kernel, machine_code
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Address, Form
from skytether.shared.endpoints.steady import Steady
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import address_text
from skytether.shared.scenario.registry import load
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import RECORDING, plan_columns, server_columns
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.driving.planning import SHARE, Planners
from skytether.shell.host import system
from skytether.shell.host.udp import AddressError
from skytether.shell.processes import process, workers
from skytether.shell.processes.process import ProcessOptions

if TYPE_CHECKING:
    from skytether.shared.wire.keys import Keyring


@dataclass(frozen=True)
class ServerOptions(ProcessOptions):
    """Options of `skytether server`."""

    bind: Annotated[
        tuple[str, ...],
        Argument(
            metavar="HOST:PORT",
            append=True,
            help="HOST:PORT to listen on, by default 127.0.0.1:47001; may be repeated, for one to "
            "four addresses. With port 0 the system chooses a free port. An IPv6 host is written "
            "in brackets, as in [::1]:47001; its socket receives only IPv6, even for [::]. A host "
            "name stands for its IPv4 address if it has one.",
        ),
    ] = ()
    vehicles: Annotated[int, Argument(metavar="N")] = VEHICLES_MAX
    """Largest number of vehicles at once, per worker."""
    workers: Annotated[int, Argument(metavar="N")] = 1
    """Number of worker processes, which share the address and the vehicles; one per core is best.
    With several workers each writes its own numbered files, as in RECORD.1 or RECORD.1.mcap, and
    worker N serves metrics at PORT + N - 1."""
    keys: Path | None = None
    """File with the keys of all vehicles, made by `skytether keygen`. Without keys the link is
    plaintext, which is refused if other machines can reach the address."""
    insecure: bool = False
    """Accept plaintext even if other machines can reach the address: anybody there can fly
    vehicles."""


def serve(argv: Sequence[str]) -> None:
    """Plan for every vehicle that requests a session, until SIGINT or SIGTERM.

    SIGUSR1 prints the counters so far.
    """
    options = command.parse(ServerOptions(), argv, "skytether server", serve.__doc__)
    command.check_count("--vehicles", options.vehicles, 65_536)
    command.check_count("--workers", options.workers, 64 if system.FORKS else 1)
    command.check_sockets("--workers", options.workers)
    bind = [command.address("--bind", text) for text in options.bind or ("127.0.0.1:47001",)]
    command.check_count("--bind", len(bind), PATHS_MAX)
    if options.workers > 1:
        command.check_count("--bind with --workers", len(bind), 1)
    command.optional_address("--metrics", options.metrics)
    keyring: Keyring | None = (
        load("skytether.shared.wire.keys", "--keys").load(options.keys) if options.keys else None
    )
    for each in bind:
        command.check_sealed(each, secure=bool(keyring) or options.insecure)
    if options.workers == 1:
        _work(options, keyring, [*bind])
        return

    def work(number: int, sock: socket) -> None:
        def run(_: Sequence[str]) -> None:
            _work(_numbered(options, number), keyring, [sock], number)

        sys.exit(command.main(run, (), f"server.{number}"))

    _ready(options.config)
    try:
        worst = workers.run(options.workers, bind[0], work)
    except AddressError as error:
        raise CommandError(str(error)) from None
    if worst:
        raise CommandError("a worker has failed", worst)


def _ready(scenario: Scenario) -> None:
    """Load the compiled planner and all modules that a vehicle's packet may need. This is done
    before workers are forked, so that they share the memory, and before the first tick, so that the
    tick is on time.
    """
    for room in (assignment.ROOM, routes.ROOM):
        with suppress(ConfigError):  # messages of a module that is missing are refused
            load(room, "a message")
    others = loading.others(scenario)
    terminal.prepare(machine_code.missing(without=others))
    kernel.load(without=others)


def _numbered(options: ServerOptions, number: int) -> ServerOptions:
    def own(path: Path | None) -> Path | None:
        if path and path.suffix == RECORDING:
            return path.with_name(f"{path.stem}.{number}{RECORDING}")
        return path and path.with_name(f"{path.name}.{number}")

    metrics = options.metrics
    if metrics:
        host, port = command.address("--metrics", metrics)
        metrics = address_text(host, port and port + number - 1)
    return replace(
        options,
        record=own(options.record),
        json=own(options.json),
        control=own(options.control),
        feed=own(options.feed),
        metrics=metrics,
    )


def _work(
    options: ServerOptions,
    keyring: "Keyring | None",
    bind: list[Address | socket],
    number: int = 0,
) -> None:
    gate: Gate = PlainGate()
    forms: tuple[Form, ...] = ()
    if keyring:
        from skytether.server.secure import FORMS, SecureGate  # loads ciphers: 30 ms, 9 MB

        gate, forms = SecureGate(keyring, entropy=secrets.token_bytes), FORMS
    axes, control = options.config.model.axes, options.config.control
    stopwatch = Stopwatch(time.perf_counter_ns)
    with process.begin(
        "server",
        options,
        server_columns(axes, control.scheme),
        number=number,
        secure=bool(keyring),
        warnings=command.flight_warnings(options.config),
    ) as running:
        endpoint = Server(
            running.scenario,
            boot_id=secrets.randbits(64),
            entropy=secrets.token_bytes,
            gate=gate,
            capacity=options.vehicles,
            recorder=running.recorder,
            plan_recorder=running.fed("plan", plan_columns(axes, control.horizon)),
            stopwatch=stopwatch,
            planning=Planners(SHARE * control.dt),
        )
        running.drive(
            Steady(endpoint),
            bind=bind,
            forms=forms,
            waiting_for="vehicles",
            insecure=options.insecure,
            stopwatch=stopwatch,
            ready=lambda: _ready(options.config),
        )
