"""`skytether probe`: measure a real network path, and fit models of it that a scenario can fly."""

import io
import secrets
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np

from skytether.client.link import ClientLink, PlainLink
from skytether.probe import recorded
from skytether.probe.analysis import Delays
from skytether.probe.listener import Listener
from skytether.probe.outages import CommonOutages, RoundTrips, common_time, compare
from skytether.probe.outcome import (
    DirectionFigures,
    PathFigures,
    PathsFigures,
    ProbeOutcome,
    outcome,
    rows,
    trace,
)
from skytether.probe.prober import BYTES_MIN, PROBES_MAX, MeasuredPath, Prober
from skytether.probe.wire import NONCE_BYTES
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base import files, input_files
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.events.flight import Event
from skytether.shared.events.processes import Counted, Listening
from skytether.shared.formats.recorded import recorded_in
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import File
from skytether.shared.telemetry.record import PACKET_COLUMNS, RECORDING, Recorder, Rows
from skytether.shared.wire import keys
from skytether.shared.wire.framing import PATHS_MAX
from skytether.shared.wire.protocol import PAYLOAD_BYTES_MAX
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, INTERRUPTED, CommandError
from skytether.shell.commandline.options import read
from skytether.shell.driving import driver
from skytether.shell.host.paths import NetworkPath
from skytether.shell.host.udp import AddressError
from skytether.shell.processes.log import Log

if TYPE_CHECKING:
    from rich.table import Table

SECONDS_MAX, RATE_MAX = 86_400.0, 1000.0
SECRET_BYTES = 32
SCENARIO = "paths.toml"
MODELS_SHOWN = 3
"""Largest number of models printed for the delays, and for the losses, of each direction."""


@dataclass(frozen=True)
class ProbeOptions:
    target: Annotated[str, Argument(metavar="HOST:PORT", positional=True)] = ""
    """Address of the other end, where `skytether probe --listen` runs; an IPv6 host in brackets."""
    path: Annotated[
        tuple[str, ...],
        Argument(
            metavar="LOCAL=HOST:PORT",
            append=True,
            help="Path to the other end, in place of HOST:PORT, as in `skytether client`; repeat "
            "it to measure up to four paths at once, and how often all paths fail together.",
        ),
    ] = ()
    listen: Annotated[str | None, Argument(metavar="HOST:PORT")] = None
    """Run as the listening end: answer probes at this address until Ctrl-C."""
    files: Annotated[tuple[Path, ...], Argument(name="from", metavar="FILE", append=True)] = ()
    """Log of ping, fping or irtt, or a table, to read instead of measuring; repeat it for up to
    four paths that were measured at the same time.
    """
    duration: float = 60.0
    """Length of the measurement [s]."""
    rate: float = 20.0
    """Number of packets per second in each direction."""
    bytes: int = 400
    """UDP payload of each packet [B]."""
    keys: Path | None = None
    """Key file made by `skytether keygen`: the vehicle's key, or with --listen the keys of all
    vehicles. Without it, packets are not encrypted, and the command refuses addresses outside this
    machine unless --insecure is given.
    """
    number: Annotated[int, Argument(name="id")] = 1
    """Number of the vehicle whose key is used; each further --path uses the next vehicle's key."""
    insecure: bool = False
    """Allow unencrypted packets to other machines: anybody on the path can alter the results."""
    out: Path = Path("probed")
    """Folder for the traces uplink.csv and downlink.csv; for several paths also for
    uplink-path-2.csv and so on, and for paths.toml, a scenario over all measured paths.
    """
    json: Path | None = None
    """JSON file for the results."""
    figure: Path | None = None
    """File for a picture of the delays (.png, .svg or .pdf)."""
    record: Path | None = None
    """File for one row per packet, in netem's format."""


def probe(argv: Sequence[str]) -> None:
    """Measure delays, loss, bursts, reordering and rate of a path over UDP, and fit models.

    One end listens and answers; the other end sends numbered packets and prints the results. If the
    listener runs at the server's place and the sender on the vehicle, the packets measure the
    downlink and the answers measure the uplink. Ctrl-C ends the measurement and prints the results
    so far. With --from, probe analyses logs of other programs. For several paths probe also prints
    how often each path failed, and how often all failed at once.
    """
    options = read(ProbeOptions(), argv, "skytether probe", probe.__doc__)
    listens = options.listen is not None
    sources = bool(options.target) + bool(options.path) + listens + bool(options.files)
    if sources != 1:
        message = (
            f"got {'both' if sources else 'neither'}, expected either HOST:PORT to measure the "
            "path to, or --path LOCAL=HOST:PORT, or --listen HOST:PORT, or --from FILE"
        )
        raise CommandError(message, CONFIGURATION)
    if options.files:
        _read(options)
    elif options.listen is not None:
        _listen(options, command.address("--listen", options.listen))
    elif options.path:
        _probe(options, options.path, command.paths("--path", options.path))
    else:
        listener = command.address("HOST:PORT", options.target)
        _probe(options, (options.target,), [NetworkPath("", listener)])


Measured = tuple[MeasuredPath, ProbeOutcome]
"""Measurement of one path, and its results."""


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn an OSError within the block into a CommandError that names the file or folder."""
    try:
        yield
    except OSError as error:
        message = f"{error.filename or path}: cannot be written: {error.strerror or error}"
        raise CommandError(message, CONFIGURATION) from None


# -- the far end ----------------------------------------------------------------------------------


def _listen(options: ProbeOptions, bind: Address) -> None:
    gate: Gate = PlainGate()
    if options.keys:
        from skytether.server.secure import SecureGate

        gate = SecureGate(keys.load(options.keys), entropy=secrets.token_bytes)
    command.check_sealed(bind, secure=bool(options.keys) or options.insecure)
    listener = Listener(gate, secrets.token_bytes(SECRET_BYTES))
    try:
        shell = driver.Shell(listener, bind)
    except AddressError as error:
        raise CommandError(str(error)) from None
    with closing(Log("probe", "text", lambda _: None)) as out:

        def start() -> None:
            host, port = shell.address
            out.say(Listening(host=host, port=port, waiting_for="probes"))

        def counters() -> Counted:
            return Counted(figures=listener.figures() | {"kernel_drops": shell.kernel_drops()})

        driver.run(
            [shell],
            on_start=start,
            on_event=out.hear,
            on_usr1=lambda: out.say(counters()),
            on_second=out.each_second,
        )
        out.say(counters())


# -- the near end ---------------------------------------------------------------------------------


def _probe(options: ProbeOptions, names: Sequence[str], paths: Sequence[NetworkPath]) -> None:
    links = _links(options, len(paths))
    _check(options, len(paths))
    probers = []
    for link, path in zip(links, paths, strict=True):
        command.check_sealed(path.peer, secure=link.secure or options.insecure)
        prober = Prober(
            link,
            path.peer,
            secrets.token_bytes(NONCE_BYTES),
            probes=max(1, round(options.duration * options.rate)),
            period_ns=round(SECOND_NS / options.rate),
            size=options.bytes,
        )
        probers.append(prober)
    try:
        pairs = zip(probers, paths, strict=True)
        shells = [driver.Shell(prober, None, paths={0: path}) for prober, path in pairs]
    except AddressError as error:
        raise CommandError(str(error)) from None
    with terminal.progress(f"probing {' and '.join(names)}", options.duration) as bar:

        def each_second() -> None:
            bar(min(prober.probed_s for prober in probers))
            if any(prober.refused or prober.failed for prober in probers):
                for prober in probers:
                    prober.stop()

        driver.run(shells, on_event=_say, on_second=each_second)
    for name, prober in zip(names, probers, strict=True):
        if prober.refused:
            raise CommandError(f"{name} serves too many measurements already")
        if prober.failed:
            message = f"no answer from {name}: is `skytether probe --listen` running there?"
            raise CommandError(message)
    results: list[Measured] = []
    for name, link, prober in zip(names, links, probers, strict=True):
        measured = prober.measured()
        try:
            results.append((measured, outcome(measured, name, secure=link.secure)))
        except ValueError as error:
            where = f"{name}: " if len(names) > 1 else ""
            raise CommandError(f"{where}too little was measured: {error}") from None
    _conclude(options, results, [prober.round_trips() for prober in probers])
    if not all(prober.finished for prober in probers):
        seconds = min(outcome.figures.seconds for _, outcome in results)
        raise CommandError(
            f"ended early: all figures are from the first {seconds:.3g} s", INTERRUPTED
        )


def _links(options: ProbeOptions, count: int) -> Sequence[ClientLink]:
    """Links of the paths. Each path uses another vehicle's key, because the listening end keeps one
    channel per vehicle.
    """
    if not options.keys:
        return [PlainLink() for _ in range(count)]
    from skytether.client.secure import SecureLink

    keyring = keys.load(options.keys)
    numbers = range(options.number, options.number + count)
    return [SecureLink(keyring.of(number), entropy=secrets.token_bytes) for number in numbers]


def _conclude(
    options: ProbeOptions, results: Sequence[Measured], trips: Sequence[RoundTrips]
) -> None:
    """Write and print results.

    Args:
        trips: round trips of each path; ignored for a single path.
    """
    outcomes = [outcome for _, outcome in results]
    try:
        common = compare(trips) if len(results) > 1 else None
    except ValueError as error:
        raise CommandError(str(error), CONFIGURATION) from None
    _write(options, outcomes, trips, common)
    if options.record:
        packets = [
            rows(measured, outcome.clocks, path) for path, (measured, outcome) in enumerate(results)
        ]
        _record(options.record, np.concatenate(packets))
    _tell(options, outcomes, common)


# -- files ----------------------------------------------------------------------------------------


def _read(options: ProbeOptions) -> None:
    _check(options, len(options.files))
    read = [File(str(path), _content(path)) for path in options.files]
    if len(read) > PATHS_MAX:
        message = f"got {len(read)} files, expected logs of up to {PATHS_MAX} paths"
        raise CommandError(f"--from: {message}", CONFIGURATION)
    if len({*options.files}) < len(read):
        names = " and ".join(file.name for file in read)
        raise CommandError(f"--from: got {names}, expected each file once", CONFIGURATION)
    try:
        results = [_of_file(file) for file in read]
        trips = [recorded.round_trips(recorded_in(file)) for file in read]
    except ValueError as error:
        raise CommandError(f"--from: {error}", CONFIGURATION) from None
    _conclude(options, results, trips)


def _of_file(file: File) -> Measured:
    path = recorded_in(file)
    log: Literal["round trips", "one way"] = "round trips" if path.halved else "one way"
    measured = recorded.of_log(path)
    return measured, outcome(measured, file.name, secure=False, log=log)


def _content(path: Path) -> bytes:
    try:
        return input_files.read(path, reading.FILES["network.uplink"][1])
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise CommandError(f"--from: {path}: cannot be read: {reason}", CONFIGURATION) from None


# -- checks and output ---------------------------------------------------------------------------


def _say(event: Event) -> None:
    print(event, file=sys.stderr)


def _check(options: ProbeOptions, paths: int) -> None:
    """Refuse invalid options for this number of paths, and files that cannot be written."""
    for flag, value, least, most in (
        ("--duration", options.duration, 1.0, SECONDS_MAX),
        ("--rate", options.rate, 0.1, RATE_MAX),
        ("--bytes", options.bytes, BYTES_MIN, PAYLOAD_BYTES_MAX),
        ("--id", options.number, 0, 65_536 - paths),
    ):
        if not least <= value <= most:
            raise CommandError(f"{flag}: got {value:g}, expected {least:g} to {most:g}", 2)
    probes = options.duration * options.rate
    if probes > PROBES_MAX:
        message = f"got {probes:.0f} packets, expected at most {PROBES_MAX}"
        raise CommandError(f"--duration and --rate: {message}", CONFIGURATION)
    if options.record and options.record.suffix == RECORDING:
        message = (
            f"got {options.record}, expected another suffix: the file is no recording of a flight"
        )
        raise CommandError(f"--record: {message}", CONFIGURATION)
    for flag in command.OUTPUTS:
        command.claim_output(f"--{flag}", getattr(options, flag))
    if options.figure:
        from skytether.figures import flights

        flights.check(options.figure)
    names = [_trace_name(way, path) for path in range(paths) for way in ("uplink", "downlink")]
    command.claim_folder("--out", options.out, *names, *[SCENARIO] * (paths > 1))


def _trace_name(way: str, path: int) -> str:
    """File name of a trace, as in `skytether export`. `way`: the direction; paths count from 0."""
    return f"{way}-path-{path + 1}.csv" if path else f"{way}.csv"


def _write(
    options: ProbeOptions,
    outcomes: Sequence[ProbeOutcome],
    trips: Sequence[RoundTrips],
    common: CommonOutages | None,
) -> None:
    within_s = common_time(trips) if common else [None]
    lines = ['title = "paths that were measured at the same time"', 'extends = "demo"']
    for path, (found, within) in enumerate(zip(outcomes, within_s, strict=True)):
        lines += ["", "[[network.paths]]"]
        for way, delays in found.delays.items():
            with _writing(file := options.out / _trace_name(way, path)):
                files.write(file, trace(delays, within).encode())
            lines.append(f'{way} = "trace({file.name})"')
    if common:
        with _writing(file := options.out / SCENARIO):
            files.write(file, "\n".join([*lines, ""]).encode())
    if options.json:
        each_path = [each.figures for each in outcomes]
        figures = PathsFigures(each_path, common) if common else each_path[0]
        command.write(options.json, msgspec.json.encode(figures))
    if options.figure:
        from skytether.figures import flights, probing

        with _writing(options.figure):
            flights.save(probing.drawn(*outcomes), options.figure, dpi=130)


def _record(path: Path, packets: Rows) -> None:
    content = io.BytesIO()
    recorder = Recorder(PACKET_COLUMNS, content)
    recorder.append(len(packets), **{name: packets[name] for name in PACKET_COLUMNS.names or ()})
    with _writing(path):
        files.write(path, content.getvalue())


def _tell(
    options: ProbeOptions, outcomes: Sequence[ProbeOutcome], common: CommonOutages | None
) -> None:
    """Print tables of both directions, their accuracy, and network texts for a scenario."""
    shown: dict[str, DirectionFigures] = {}
    for path in (each.figures for each in outcomes):
        ways = {"downlink": path.downlink, "uplink": path.uplink}
        named = {"each way": path.downlink} if path.log else ways
        of_path = f"{path.listener}\n" if common else ""
        shown |= {f"{of_path}{name}": way for name, way in named.items()}
    terminal.show(_table(shown))
    terminal.show(_models(shown))
    for each in outcomes:
        _tell_accuracy(each, f"{each.figures.listener}: " if common else "")
    if common:
        terminal.show(_outages([each.figures.listener for each in outcomes], common))
    print("To fly over the models, or over what was measured:")
    for line in _flights(options, outcomes):
        print(f"skytether fly {line}")


def _tell_accuracy(outcome: ProbeOutcome, of_path: str) -> None:
    path = outcome.figures
    print(of_path + (_of_log(path) if path.log else _of_clocks(path)))
    if path.log and not path.uplink.bursts and (missing := _missing(outcome.delays["uplink"])):
        print(
            f"Packets were sent every {path.every_s:.3g} s; the file has no row for {missing} "
            "packets. If they were lost, give each a row with its time and no delay."
        )
    if path.unreported:
        print(f"{path.unreported} packets are left out: the other end lost their arrival times.")


def _flights(options: ProbeOptions, outcomes: Sequence[ProbeOutcome]) -> Sequence[str]:
    """Commands with which a user can fly over the fitted models, and over the traces."""
    paths = [
        {"downlink": each.figures.downlink, "uplink": each.figures.uplink} for each in outcomes
    ]
    texts = [{name: way.text for name, way in ways.items() if way.text} for ways in paths]
    if len(paths) > 1:
        tables = (", ".join(f'{name} = "{text}"' for name, text in each.items()) for each in texts)
        models = ", ".join(f"{{{table}}}" for table in tables)
        of_models = f"demo --virtual --network.paths '[{models}]'"
        return of_models, f"{options.out / SCENARIO} --virtual"
    traces = {name: f"trace({options.out / name}.csv)" for name in paths[0]}
    flags = (
        " ".join(f'--network.{name} "{text}"' for name, text in each.items())
        for each in (texts[0], traces)
    )
    return [f"demo --virtual {each}" for each in flags if each]


def _missing(delays: Delays) -> int:
    """Number of packets missing from a series that was sent at a constant rate."""
    if len(delays.time_s) < 3:
        return 0
    apart_s = np.diff(delays.time_s)
    return int(np.maximum(np.rint(apart_s / max(np.median(apart_s), 1e-9)) - 1.0, 0.0).sum())


def _of_log(path: PathFigures) -> str:
    """Sentences about data that a log lacks, and about the assumptions made instead."""
    if path.log == "one way":
        return "Clocks: unknown. The file has the delays of one direction, which are used for both."
    return (
        f"The round trip takes at least {1e3 * path.round_trip_least_s:.2f} ms and "
        f"{1e3 * path.round_trip_mean_s:.2f} ms on average. Half of it is assumed each way, and "
        "all losses both ways: the file does not say which way a packet was slow or lost. So one "
        "way may be up to twice as slow, and the losses of a round trip are counted twice."
    )


def _of_clocks(path: PathFigures) -> str:
    """Sentence about the two clocks, and the possible error of one-way delays."""
    doubt = f"{path.drift_doubt_ppm:.1f} ppm"
    drift = f"no significant drift (standard error {doubt})"
    if path.drift_ppm:
        drift = f"the other end's clock gains {path.drift_ppm:+.1f} ± {doubt}"
    return (
        f"Clocks: {drift}. The round trip takes at least {1e3 * path.round_trip_least_s:.2f} ms "
        f"and {1e3 * path.round_trip_mean_s:.2f} ms on average, whatever the clocks; half of the "
        f"least is taken for each way, so one-way delays may be wrong by up to "
        f"{1e3 * path.offset_doubt_s:.2f} ms, one way too long and the other too short."
    )


def _figures(way: DirectionFigures) -> dict[str, str]:
    texts = {
        "packets sent, arrived": f"{way.sent}, {way.came}",
        "lost [%], 95 % interval": f"{100 * way.loss:.3g} ({100 * way.loss_low:.3g} to "
        f"{100 * way.loss_high:.3g})",
        "bursts of lost packets, mean length": f"{way.bursts}, {way.burst_packets:.3g}",
        "arrived again": f"{way.copies}",
        "reordered [%]": f"{100 * way.reordered:.3g}",
        "delay, mean [ms]": f"{1e3 * way.mean_s:.2f}",
        "standard deviation [ms]": f"{1e3 * way.sd_s:.2f}",
    }
    for share, delay_s in way.quantiles_s.items():
        name = {"0": "least", "1": "largest"}.get(share, f"{100 * float(share):g} %")
        texts[f"delay, {name} [ms]"] = f"{1e3 * delay_s:.2f}"
    texts["correlation of delays lasts [s]"] = f"{way.correlation_s:.3g}"
    rate = "none seen"
    if way.rate_bytes_per_s:
        rate = f"{way.rate_bytes_per_s:.4g} ({way.rate_low:.4g} to {way.rate_high:.4g})"
    texts["rate [B/s], 95 % interval"] = rate
    texts["last packet of a train waits [ms]"] = f"{1e3 * way.train_wait_s:.2f}"
    return texts


def _models(ways: dict[str, DirectionFigures]) -> "Table":
    """Best models of both directions, each with its BIC minus the BIC of the best model."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title="models, the best first", title_justify="left")
    for heading in ("", "model", "BIC, above the best"):
        table.add_column(Text(heading))
    for name, way in ways.items():
        for what, models in (("delay", way.delay_models), ("loss", way.loss_models)):
            for model in models[:MODELS_SHOWN]:
                behind = f"{model.bic - models[0].bic:.0f}"
                table.add_row(Text(f"{name}, {what}"), Text(model.text), Text(behind))
    return table


def _outages(names: Sequence[str], found: CommonOutages) -> "Table":
    from rich.table import Table
    from rich.text import Text

    title = f"outages: no answer within {found.threshold_s:.3g} s, for as long or longer"
    table = Table(title=title, title_justify="left")
    for heading in ("", *names, "all at once", "if independent"):
        table.add_column(Text(heading))
    each = [*found.paths, found.common]
    shares = [*(one.share for one in each), found.product]
    for name, values in (
        ("share of the time [%]", [f"{100 * share:.3g}" for share in shares]),
        ("number", [str(one.count) for one in each]),
        ("longest [s]", [f"{one.longest_s:.3g}" for one in each]),
    ):
        table.add_row(Text(name), *values)
    return table


def _table(ways: dict[str, DirectionFigures]) -> "Table":
    from rich.table import Table
    from rich.text import Text

    table = Table(title="measured", title_justify="left")
    for heading in ("", *ways):
        table.add_column(Text(heading))
    shown = [_figures(way) for way in ways.values()]
    for name in shown[0]:
        table.add_row(Text(name), *(Text(texts[name]) for texts in shown))
    return table
