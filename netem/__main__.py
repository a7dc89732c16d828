"""`python -m skytether.netem`: the network emulator as a process."""

import sys

from skytether.shell.commandline.start import run

if __name__ == "__main__":  # before the slow imports below
    sys.exit(run("skytether.netem.__main__:emulate", "netem"))

import gc
import os
import signal
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from socket import AF_INET
from typing import TYPE_CHECKING, Annotated

from skytether.netem import relay
from skytether.netem.proxy import FLOWS_MAX, Proxy
from skytether.netem.relay import Relay
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.endpoints.line import CONNECTIONS_MAX, Listen, parse_address
from skytether.shared.endpoints.other_directions import KEYS, RELAY, RUN, named
from skytether.shared.events.flight import address_text
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import PACKET_COLUMNS
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.host import system
from skytether.shell.host.udp import leads_back, look_up, sockets_max
from skytether.shell.processes import process
from skytether.shell.processes.process import ProcessOptions

if TYPE_CHECKING:
    from skytether.shell.driving.program import Program

NETWORK = "transparent"
"""Default scenario: a network without impairments, for the packets of any program."""
COLLECT_AFTER = 100_000
"""Number of new objects after which Python collects garbage. With the default of 700 the collector
would scan all queued packets, which are not garbage, many times a second."""
MTU_MIN, MTU_MAX = 1280, 65_520
"""Bounds of an MTU [B]: the smallest that IPv6 allows, and the largest that slirp4netns accepts."""


@dataclass(frozen=True)
class NetemOptions(ProcessOptions):
    """Options of `skytether netem`."""

    scenario: command.ScenarioName = NETWORK
    """A scenario's name (`skytether list scenarios`) or a .toml file, for its network and seed.
    With a scenario, netem emulates the network of a flight: delay and loss of a packet depend on
    the time, not on the packet's number in its flow."""
    bind: str = "127.0.0.1:47000"
    """HOST:PORT to listen on for clients; with port 0 the system chooses a free port. An IPv6 host
    is written in brackets, as in [::1]:47000; its socket receives only IPv6, even for [::]. A host
    name stands for its IPv4 address if it has one."""
    server: str = "127.0.0.1:47001"
    """HOST:PORT of the server; its address family may differ from the clients'."""
    to_client: str | None = None
    """Impairments of packets from the server to clients, joined by &, as in "constant(50ms) &
    loss(10%)", see `skytether list impairments`. Replaces network.uplink of the scenario."""
    to_server: str | None = None
    """Impairments of packets from clients to the server. Replaces network.downlink."""
    path: Annotated[int, Argument(metavar="N")] = 1
    """Number of the scenario's path to emulate, from 1, see network.paths. The number after the
    last path selects the path to a standby server, which has the impairments of path 1."""
    tcp: bool = False
    """Relay TCP connections instead of UDP: with latency, a rate and cuts, but no packet loss."""
    flows: Annotated[int | None, Argument(metavar="N")] = None
    """Largest number of clients at once; each needs a socket. By default 512, or as many as the
    system allows. With --tcp: number of connections, 1 to 128, by default 128."""


@dataclass(frozen=True)
class RunOptions(ProcessOptions):
    """Options of `skytether netem run`."""

    scenario: command.ScenarioName = NETWORK
    """A scenario's name (`skytether list scenarios`) or a .toml file, for its network and seed."""
    to_program: str | None = None
    """Impairments of packets to the program, joined by &, as in "constant(50ms) & loss(10%)", see
    `skytether list impairments`. Replaces network.uplink of the scenario."""
    from_program: str | None = None
    """Impairments of packets from the program. Replaces network.downlink."""
    expose: Annotated[tuple[str, ...], Argument(metavar="PORT", append=True)] = ()
    """Port of this machine that is forwarded to the same port of the program, for TCP and UDP. PORT
    alone listens on 127.0.0.1, HOST:PORT on another IPv4 address. May be repeated."""
    mtu: Annotated[int, Argument(metavar="BYTES")] = 1500
    """Largest packet of the program's network device, 1280 to 65520 bytes."""
    path_mtu: Annotated[int | None, Argument(metavar="BYTES")] = None
    """Largest packet that passes [bytes], if below --mtu; a longer packet causes an ICMP error."""


def emulate(argv: Sequence[str]) -> None:
    """Delay, reorder and lose datagrams between clients and a server, until SIGINT or SIGTERM.

    netem carries the UDP packets of any program. Clients send to --bind instead of the server:

        skytether netem --bind 127.0.0.1:5000 --server 192.0.2.1:5000
            --to-client "constant(50ms)"
            --to-server "gamma(20ms, 80ms, 30ms) & loss(5%) & rate(1mbit)"

    Without impairments, packets pass at once. With the same seed, the nth packet of a flow has the
    same fate in each run. SIGUSR1 prints the counters so far; they are also printed at the end.
    With --control, `skytether set` changes the impairments while netem runs.

    `skytether netem run … -- CMD ARG…` does the same for all packets of one program.
    """
    if argv[:1] == ["run"]:
        emulate_for(argv[1:])
        return
    gc.set_threshold(COLLECT_AFTER)
    options = command.parse(
        NetemOptions(), argv, "skytether netem", emulate.__doc__, is_final=False
    )
    options = _with_directions(options)
    flows = _flows(options.flows, CONNECTIONS_MAX if options.tcp else 65_536)
    server = command.address("--server", options.server)
    bind = command.address("--bind", options.bind)
    _check_server(server, bind)
    name = f"netem {options.path}" if options.path > 1 else "netem"
    with process.begin(name, options, PACKET_COLUMNS, secure=None) as running:
        recorder, path = running.recorder, options.path - 1
        waiting_for = f"clients of {options.server}"
        if options.tcp:
            listen = Listen(bind, server, flows)
            streams = Relay(running.scenario, server=server, recorder=recorder, path=path)
            running.drive(streams, bind=None, line=listen, waiting_for=waiting_for)
            return
        proxy = Proxy(
            running.scenario,
            server=server,
            flows=flows,
            directions=RELAY if options.scenario == NETWORK else FLIGHT,
            recorder=recorder,
            path=path,
        )
        running.drive(proxy, bind=bind, peers=[server], waiting_for=waiting_for)


def emulate_for(argv: Sequence[str]) -> None:
    """Run a program whose only network is netem; exit code and streams are the program's.

        skytether netem run --to-program "constant(50ms)"
            --from-program "constant(50ms) & loss(5%)" --seed 7
            -- curl http://10.0.2.2:8000/

    All IPv4 and IPv6 packets of the program and its children are impaired: TCP, UDP, QUIC, ICMP,
    DNS. The program reaches other machines as before, and this machine at 10.0.2.2 and fd00::2.
    With the same seed, the nth packet of a flow has the same fate in each run. The command needs
    Linux and slirp4netns, and root or user namespaces.

    SIGUSR1 prints the counters so far to stderr; with --control, `skytether set` changes the
    impairments while the program runs. All other signals are passed to the program.
    """
    from skytether.netem.tunnel import Tunnel
    from skytether.shell.driving.program import ProgramError, program

    gc.set_threshold(COLLECT_AFTER)
    end = argv.index("--") if "--" in argv else len(argv)
    options = command.parse(
        RunOptions(), argv[:end], "skytether netem run", emulate_for.__doc__, is_final=False
    )
    if not argv[end + 1 :]:
        message = "got no program, expected -- CMD ARG… at the end"
        raise command.CommandError(message, command.CONFIGURATION)
    options = replace(options, config=_impaired(options, RUN))
    exposed = [_exposed(text) for text in options.expose]
    mtu = options.mtu
    path_mtu = mtu if options.path_mtu is None else options.path_mtu
    for flag, size in (("--mtu", mtu), ("--path-mtu", path_mtu)):
        if not MTU_MIN <= size <= MTU_MAX:
            message = f"{flag}: got {size}, expected {MTU_MIN} to {MTU_MAX}"
            raise command.CommandError(message, command.CONFIGURATION)
    with process.begin("netem", options, PACKET_COLUMNS, secure=None) as running:
        try:
            passing = min(mtu, path_mtu)
            with program(argv[end + 1 :], mtu, path_mtu=passing, exposed=exposed) as run_:
                signal.signal(signal.SIGINT, lambda *_: None)  # ignored from here on
                endpoint = Tunnel(running.scenario, mtu=passing, recorder=running.recorder)
                running.drive(endpoint, bind=None, waiting_for="", line=run_, on_signal=run_.signal)
        except ProgramError as error:
            raise command.CommandError(str(error)) from None
    _end_like(run_)


def _exposed(text: str) -> Address:
    """IPv4 address and port in a value of --expose; packets to it are forwarded to the program."""
    host, colon, _ = text.rpartition(":")
    why = ""
    if host.isdecimal():
        why = "; the port is the same on both sides"
    elif "[" in host:
        why = "; slirp4netns passes IPv4 alone"
    address = None if why else parse_address(text if colon else f"127.0.0.1:{text}")
    if address is None or not address[1]:
        expected = f"expected PORT, or HOST:PORT to listen at another address than 127.0.0.1{why}"
        raise command.CommandError(f"--expose: got {text!r}, {expected}", command.CONFIGURATION)
    try:
        return look_up(address, AF_INET)
    except OSError as error:
        message = f"--expose: {address[0]}: {error.strerror}"
        raise command.CommandError(message, command.CONFIGURATION) from None


def _end_like(program: "Program") -> None:
    """End this process with the exit code or signal with which the program ended."""
    if program.fault or program.status is None:
        raise command.CommandError(program.fault or "the program was killed with its namespaces")
    if os.WIFSIGNALED(program.status):
        number = os.WTERMSIG(program.status)
        system.dump_no_core()  # the program has written a core dump already
        with suppress(OSError):  # the action of SIGKILL cannot be changed
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    raise SystemExit(os.waitstatus_to_exitcode(program.status))


def _with_directions(options: NetemOptions) -> NetemOptions:
    """Options whose scenario has only the path of --path, impaired by --to-client and --to-server.

    Raises:
        CommandError: the scenario has no such path.
        ConfigError: the network is invalid.
    """
    command.check_count("--path", options.path, len(options.config.paths) + 1)
    alone = replace(options, config=options.config.on_path(options.path - 1))
    return replace(options, config=_impaired(alone, RELAY, tcp=options.tcp))


def _impaired(
    options: NetemOptions | RunOptions, names: Directions, *, tcp: bool = False
) -> Scenario:
    """Scenario of the options, with the impairments of each direction whose option is given.

    Args:
        names: names of the options of both directions.
        tcp: whether connections are relayed.

    Raises:
        ConfigError: the network is invalid.
    """
    table, flags = reading.to_table(options.config), dict[str, str]()
    for key, way, name in zip(KEYS, FLIGHT, names, strict=True):
        text = getattr(options, name)
        if text is not None:
            table["network"][way], flags[key] = text, f"--{name.replace('_', '-')}"
    try:
        scenario = reading.check(table, any_network=True)
        if tcp and (why := relay.objection(scenario)):
            raise ConfigError(why)
    except ConfigError as error:
        raise ConfigError(named(str(error), flags)) from None
    return scenario


def _check_server(server: Address, bind: Address) -> None:
    """Refuse netem's own address as the server's, because packets would circulate."""
    with suppress(OSError):  # an unknown host is reported later, at the first packet to it
        if leads_back(server, bind):
            at = address_text(*server)
            message = f"--server: got {at}, which is netem itself; expected the address of a server"
            raise command.CommandError(message, command.CONFIGURATION)


def _flows(requested: int | None, most: int) -> int:
    """Largest number of clients at once; prints a warning if the system allows few.

    Raises:
        CommandError: the system does not allow the requested number.
    """
    usual = min(FLOWS_MAX, most)
    flows = max(1, min(usual, sockets_max())) if requested is None else requested
    command.check_count("--flows", flows, most)
    command.check_sockets("--flows", flows)
    if requested is None and flows < usual:
        print(
            f"netem: at most {flows} clients instead of {usual}: {system.files_max()} files may "
            "be open here (ulimit -n)",
            file=sys.stderr,
        )
    return flows
