"""`python -m skytether.netem`: the network as a process."""

import sys

from skytether.shell.start import run

if __name__ == "__main__":  # before the imports below, which take a while
    sys.exit(run("skytether.netem.__main__:emulate", "netem"))

import gc
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated

from skytether.netem.proxy import FLOWS_MAX, Proxy
from skytether.shared.core.endpoint import Address
from skytether.shared.core.events import address_text
from skytether.shared.scenario import reading
from skytether.shared.telemetry.record import PACKET_COLUMNS
from skytether.shell import command, process
from skytether.shell.options import Argument
from skytether.shell.process import ProcessOptions
from skytether.shell.udp import files_max, leads_back, sockets_max

COLLECT_AFTER = 100_000
"""Number of new objects after which garbage is collected: packets under way are no garbage, and the
default of 700 objects looks through all of them many times a second."""


@dataclass(frozen=True)
class NetemOptions(ProcessOptions):
    """Options of `skytether netem`."""

    bind: str = "127.0.0.1:47000"
    """HOST:PORT to listen on for clients; port 0 takes a free one. An IPv6 host stands in brackets,
    as in [::1]:47000; its socket hears IPv6 alone, even that of [::]. A name means its IPv4
    address, if it has one."""
    server: str = "127.0.0.1:47001"
    """HOST:PORT of the server, of the same family as the clients' addresses or not."""
    uplink: str | None = None
    """Impairments of packets from the server to clients: impairments joined by &, as in
    "constant(0.05) & loss(0.1)", see `skytether impairments`. In place of the scenario's; where
    only one of uplink and downlink is given, the other passes everything at once."""
    downlink: str | None = None
    """Impairments of packets from clients to the server, written as for uplink."""
    flows: Annotated[int | None, Argument(metavar="N")] = None
    """Most clients at once, each of which takes a socket: 512 unless given, or as many as the
    system allows."""


def emulate(argv: Sequence[str]) -> None:
    """Delay, reorder and lose datagrams between clients and a server, until SIGINT or SIGTERM.

    It carries any UDP. Clients send to --bind in place of the server, and need to know no more:

        skytether netem --bind 127.0.0.1:5000 --server 192.0.2.1:5000 --uplink "constant(0.05)"
            --downlink "gamma(0.02, 0.08, 0.03) & loss(0.05) & rate(125000, queue=30000)"

    SIGUSR1 prints the counters so far; they are also printed at the end. With --control,
    `skytether set` changes directions meanwhile. Without --uplink and
    --downlink the network is the scenario's.
    """
    gc.set_threshold(COLLECT_AFTER)
    options = _with_directions(
        command.parse(NetemOptions(), argv, "skytether netem", emulate.__doc__, is_final=False)
    )
    flows = _flows(options.flows)
    server = command.address("--server", options.server)
    bind = command.address("--bind", options.bind)
    _check_server(server, bind)
    with process.begin("netem", options, PACKET_COLUMNS, secure=None) as running:
        endpoint = Proxy(running.scenario, server=server, flows=flows, recorder=running.recorder)
        waiting_for = f"clients of {options.server}"
        running.drive(endpoint, bind=bind, peers=[server], waiting_for=waiting_for)


def _with_directions(options: NetemOptions) -> NetemOptions:
    """Options with the network that --uplink and --downlink describe.

    Raises:
        ConfigError: the scenario cannot be flown with it.
    """
    table = reading.to_table(options.config)
    if not (options.uplink is None and options.downlink is None):
        table["network"] |= {"uplink": options.uplink or "", "downlink": options.downlink or ""}
    source = f"{options.scenario} and the command line"
    return replace(options, config=reading.check(table, source))


def _check_server(server: Address, bind: Address) -> None:
    """Refuse a server that is netem itself.

    Raises:
        CommandError: packets would circulate.
    """
    with suppress(OSError):  # an address that cannot be found is reported when it is used
        if leads_back(server, bind):
            at = address_text(*server)
            said = f"--server: got {at}, which is netem itself; expected the address of a server"
            raise command.CommandError(said, command.CONFIGURATION)


def _flows(given: int | None) -> int:
    """Largest number of clients at once; smaller than FLOWS_MAX, and printed, where the system
    allows no more.

    Raises:
        CommandError: so many cannot be.
    """
    flows = max(1, min(FLOWS_MAX, sockets_max())) if given is None else given
    command.check_count("--flows", flows, 65_536)
    command.check_sockets("--flows", flows)
    if given is None and flows < FLOWS_MAX:
        print(
            f"netem: room for {flows} clients instead of {FLOWS_MAX}: {files_max()} files may be "
            "open here (ulimit -n)",
            file=sys.stderr,
        )
    return flows
