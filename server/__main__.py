"""`python -m skytether.server`: the server as a process."""

import sys

from skytether.shell.start import run

if __name__ == "__main__":  # before the imports below, which take a while
    sys.exit(run("skytether.server.__main__:serve", "server"))

import secrets
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from socket import socket
from typing import Annotated

from skytether.server.controller import other_schemes
from skytether.server.endpoint import VEHICLES_MAX, Server
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base import kernel
from skytether.shared.core.endpoint import Address, Form
from skytether.shared.core.steady import Steady
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.record import RECORDING, plan_columns, server_columns
from skytether.shared.wire import keys
from skytether.shared.wire.keys import Keyring
from skytether.shell import command, process, terminal, workers
from skytether.shell.command import CommandError, ScenarioFlags, ScenarioName
from skytether.shell.journal import take_up
from skytether.shell.log import LogFormat
from skytether.shell.options import Argument
from skytether.shell.udp import AddressError


@dataclass(frozen=True)
class ServerOptions:
    """Options of `skytether server`."""

    scenario: ScenarioName = "demo"
    """A scenario's name (see `skytether scenarios`) or a .toml file."""
    bind: str = "127.0.0.1:47001"
    """HOST:PORT to listen on; port 0 takes a free one. An IPv6 host stands in brackets, as in
    [::1]:47001; its socket hears IPv6 alone, even that of [::]. A name means its IPv4 address, if
    it has one."""
    log: LogFormat = "text"
    """Format in which each event is printed: a sentence, or a line of JSON for a program."""
    record: Path | None = None
    """File for the server's part of the record; one that ends in .mcap becomes a recording with
    all that the server says and its plans, see `skytether join`."""
    vehicles: Annotated[int, Argument(metavar="N")] = VEHICLES_MAX
    """Most vehicles at once, in each worker."""
    workers: Annotated[int, Argument(metavar="N")] = 1
    """Number of processes that share the address and the vehicles, one a core; with several, each
    has files of its own, numbered, as in RECORD.1 or RECORD.1.mcap."""
    json: Path | None = None
    """File for what was counted, and the CPU time it took."""
    keys: Path | None = None
    """File of the keys of all vehicles that may fly, made by `skytether keygen`. Without it the
    link is plaintext, which is refused where other machines can reach it."""
    insecure: bool = False
    """Do without keys even where other machines can reach it: anybody there can fly vehicles."""
    control: Path | None = None
    """Unix socket to make, through which keys change in flight, see `skytether set`."""
    new_flight: bool = False
    """Begin a new flight: what was set in flight in an earlier run, and lies beside the socket of
    --control, does not count. A person says so; the command of a service must not."""
    feed: Path | None = None
    """Unix socket to make, at which whoever looks on reads what is recorded and said."""
    metrics: str | None = None
    """HTTP address to serve metrics at, HOST:PORT, for Prometheus, and /healthz. Worker N
    listens at PORT + N - 1."""
    plugin: command.Plugins = ()
    config: ScenarioFlags = Scenario()


def serve(argv: Sequence[str]) -> None:
    """Plan for every vehicle that asks for it, until SIGINT or SIGTERM.

    SIGUSR1 prints what was counted so far.
    """
    options = command.parse(ServerOptions(), argv, "skytether server", serve.__doc__)
    command.check_count("--vehicles", options.vehicles, 65_536)
    command.check_count("--workers", options.workers, 64)
    command.check_sockets("--workers", options.workers)
    bind = command.address("--bind", options.bind)
    metrics = command.optional_address("--metrics", options.metrics)
    keyring = keys.load(options.keys) if options.keys else None
    command.check_sealed(bind, secure=bool(keyring) or options.insecure)
    if options.workers == 1:
        _work(options, keyring, bind, "", metrics)
        return

    def work(number: int, sock: socket) -> None:
        suffix = f".{number}"
        own = metrics and (metrics[0], metrics[1] and metrics[1] + number - 1)
        sys.exit(
            command.main(
                lambda _: _work(options, keyring, sock, suffix, own), (), f"server{suffix}"
            )
        )

    _ready(options.config)
    try:
        worst = workers.run(options.workers, bind, work)
    except AddressError as error:
        raise CommandError(str(error)) from None
    if worst:
        raise CommandError("a worker has failed", worst)


def _ready(scenario: Scenario) -> None:
    """Load the planner before a vehicle waits for it, so that workers share its memory."""
    others = other_schemes(scenario)
    terminal.prepare(kernel.missing(without=others))
    kernel.load(without=others)


def _work(
    options: ServerOptions,
    keyring: Keyring | None,
    bind: Address | socket,
    suffix: str,
    metrics: Address | None,
) -> None:
    """Run one worker, whose files have names that end in `suffix`."""

    def own(path: Path | None) -> Path | None:
        if path and path.suffix == RECORDING:
            return path.with_name(path.stem + suffix + RECORDING)
        return path and path.with_name(path.name + suffix)

    # Each worker knows sessions of its own.
    gate: Gate = PlainGate()
    forms: tuple[Form, ...] = ()
    if keyring:
        from skytether.server.secure import FORMS, SecureGate  # its ciphers take 30 ms, and 9 MB

        gate, forms = SecureGate(keyring, entropy=secrets.token_bytes), FORMS
    taken_up = take_up(own(options.control), options.config, new_flight=options.new_flight)
    scenario = taken_up.scenario
    axes, planned = scenario.model.axes, scenario.control.horizon
    record, columns = own(options.record), server_columns(axes, scenario.control.scheme)
    part = process.part_of(record)
    stopwatch = Stopwatch(time.perf_counter_ns)
    with (
        process.recorded(part, columns) if part else nullcontext() as recording,
        process.fed(own(options.feed), record, "server", options, secure=gate.secure) as feed,
    ):
        endpoint = Server(
            scenario,
            boot_id=secrets.randbits(64),
            entropy=secrets.token_bytes,
            gate=gate,
            room=options.vehicles,
            recorder=process.recorder("server", columns, recording, feed),
            plans=process.recorder("plan", plan_columns(axes, planned), None, feed),
            stopwatch=stopwatch,
        )
        process.drive(
            f"server{suffix}",
            Steady(endpoint),
            options,
            bind=bind,
            forms=forms,
            waiting_for="vehicles",
            secure=gate.secure,
            insecure=options.insecure,
            log=options.log,
            json=own(options.json),
            stopwatch=stopwatch,
            recording=recording,
            control=own(options.control),
            journal=taken_up.journal,
            feed=feed,
            metrics=metrics,
            warnings=command.flight_warnings(options.config) + taken_up.news,
            ready=lambda: _ready(options.config),
        )
