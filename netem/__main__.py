"""`python -m skytether.netem`: the network as a process."""

import sys

from skytether.shell.start import run

if __name__ == "__main__":  # called before the slow imports below
    sys.exit(run("skytether.netem.__main__:emulate", "netem"))

import gc
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated

from skytether.netem.proxy import FLOWS_MAX, Proxy
from skytether.netem.relay import Relay
from skytether.shared.core.endpoint import Address
from skytether.shared.core.events import address_text
from skytether.shared.core.line import Listen
from skytether.shared.scenario import reading
from skytether.shared.telemetry.record import PACKET_COLUMNS
from skytether.shell import command, process
from skytether.shell.argument import Argument
from skytether.shell.process import ProcessOptions
from skytether.shell.udp import files_max, leads_back, sockets_max

COLLECT_AFTER = 100_000
"""Number of new objects after which garbage is collected. Queued packets are not garbage, and the
default of 700 would scan all of them many times a second."""


@dataclass(frozen=True)
class NetemOptions(ProcessOptions):
    """Options of `skytether netem`."""

    scenario: command.ScenarioName = "transparent"
    """A scenario's name (see `skytether scenarios`) or a .toml file, for its network and seed."""
    bind: str = "127.0.0.1:47000"
    """HOST:PORT to listen on for clients; port 0 takes a free one. An IPv6 host is written in
    brackets, as in [::1]:47000; its socket receives IPv6 only, even for [::]. A name means its IPv4
    address if it has one."""
    server: str = "127.0.0.1:47001"
    """HOST:PORT of the server; its address family may differ from the clients'."""
    to_client: str | None = None
    """Impairments of packets from the server to clients, joined by &, as in "constant(50ms) &
    loss(10%)", see `skytether impairments`; the key network.uplink of a scenario."""
    to_server: str | None = None
    """Impairments of packets from clients to the server; the key network.downlink."""
    path: Annotated[int, Argument(metavar="N")] = 1
    """Path of the scenario to emulate, from 1, see network.paths; one more than there are is that
    to a standby server, impaired like the first."""
    tcp: bool = False
    """Relay TCP connections in place of UDP: latency, a rate and cuts, and no packet loss."""
    flows: Annotated[int | None, Argument(metavar="N")] = None
    """Largest number of clients at once, each of which takes a socket; by default 512, or as many
    as the system allows. With --tcp there are at most 128 connections, always."""


def emulate(argv: Sequence[str]) -> None:
    """Delay, reorder and lose datagrams between clients and a server, until SIGINT or SIGTERM.

    It carries any UDP. Clients send to --bind instead of the server:

        skytether netem --bind 127.0.0.1:5000 --server 192.0.2.1:5000 --to-client "constant(50ms)"
            --to-server "gamma(20ms, 80ms, 30ms) & loss(5%) & rate(1mbit, queue=30000)"

    Without these, packets pass at once. SIGUSR1 prints the counters so far; they are also printed
    at the end. With --control, `skytether set` changes the impairments meanwhile.
    """
    gc.set_threshold(COLLECT_AFTER)
    options = _with_directions(
        command.parse(NetemOptions(), argv, "skytether netem", emulate.__doc__, is_final=False)
    )
    flows = _flows(options.flows)
    server = command.address("--server", options.server)
    bind = command.address("--bind", options.bind)
    _check_server(server, bind)
    name = f"netem {options.path}" if options.path > 1 else "netem"
    with process.begin(name, options, PACKET_COLUMNS, secure=None) as running:
        recorder, path = running.recorder, options.path - 1
        waiting_for = f"clients of {options.server}"
        if options.tcp:
            relay = Relay(running.scenario, server=server, recorder=recorder, path=path)
            running.drive(relay, bind=None, line=Listen(bind, server), waiting_for=waiting_for)
            return
        proxy = Proxy(running.scenario, server=server, flows=flows, recorder=recorder, path=path)
        running.drive(proxy, bind=bind, peers=[server], waiting_for=waiting_for)


def _with_directions(options: NetemOptions) -> NetemOptions:
    """Options with the scenario of --path alone, and --to-client and --to-server in its network.

    Raises:
        CommandError: the scenario has no such path.
        ConfigError: the network is invalid.
    """
    command.check_count("--path", options.path, len(options.config.paths) + 1)
    table = reading.to_table(options.config.on_path(options.path - 1))
    directions = {"uplink": options.to_client, "downlink": options.to_server}
    table["network"] |= {key: text for key, text in directions.items() if text is not None}
    source = f"{options.scenario} and the command line"
    return replace(options, config=reading.check(table, source, any_network=True))


def _check_server(server: Address, bind: Address) -> None:
    """Refuse an address of netem itself as the server, since packets would circulate."""
    with suppress(OSError):  # an unknown host is reported when it is used
        if leads_back(server, bind):
            at = address_text(*server)
            message = f"--server: got {at}, which is netem itself; expected the address of a server"
            raise command.CommandError(message, command.CONFIGURATION)


def _flows(requested: int | None) -> int:
    """Largest number of clients at once; prints a warning if the system allows few.

    Raises:
        CommandError: the system does not allow the requested number.
    """
    flows = max(1, min(FLOWS_MAX, sockets_max())) if requested is None else requested
    command.check_count("--flows", flows, 65_536)
    command.check_sockets("--flows", flows)
    if requested is None and flows < FLOWS_MAX:
        print(
            f"netem: room for {flows} clients instead of {FLOWS_MAX}: {files_max()} files may be "
            "open here (ulimit -n)",
            file=sys.stderr,
        )
    return flows
