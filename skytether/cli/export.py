"""`skytether export`: convert a recording to CSV or Parquet tables for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skytether.cli import recordings
from skytether.shared.base import files
from skytether.shared.base.units import HEADER_BYTES
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read
from skytether.view.recordings import export as view
from skytether.view.recordings import traffic
from skytether.view.recordings.recorded import Recorded


@dataclass(frozen=True)
class ExportOptions:
    file: Annotated[Path, Argument(positional=True, metavar="FILE")]
    """The recording (.mcap)."""
    csv: Path | None = None
    """Folder for the tables as CSV."""
    parquet: Path | None = None
    """Folder for the tables as Parquet; needs pyarrow."""
    traces: Path | None = None
    """Folder for traces of netem's effect on packets, one file per direction, flow and path. The
    impairment `trace(FILE)` replays a trace; see docs/network.md.
    """
    pcap: Path | None = None
    """File for a packet capture (pcap) of netem's output, with true lengths, but made-up headers
    and no payload.
    """
    plugin: command.Plugins = ()


def export(argv: Sequence[str]) -> None:
    """Write a recording as tables, one per part: client, server, plan, netem, and the events.

    Each column has its unit in its name, as in position_x_m. The folder is created if necessary.
    """
    options = read(ExportOptions(tyro.MISSING), argv, "skytether export", export.__doc__)
    if not (options.csv or options.parquet or options.traces or options.pcap):
        message = "expected at least one of --csv, --parquet, --traces and --pcap"
        raise CommandError(message, CONFIGURATION)
    to_parquet = view.parquet() if options.parquet else None
    recorded = recordings.opened(options.file)
    if options.traces or options.pcap:
        _traffic(options, recorded)
    if not (options.csv or options.parquet):
        return
    tables = view.tables(recorded)
    command.claim_folder("--csv", options.csv, *(f"{name}.csv" for name in tables))
    command.claim_folder("--parquet", options.parquet, *(f"{name}.parquet" for name in tables))
    for name, columns in tables.items():
        if options.csv:
            path = options.csv / f"{name}.csv"
            _write(path, view.csv(columns).encode())
        if options.parquet and to_parquet:
            path = options.parquet / f"{name}.parquet"
            _write(path, to_parquet(columns))


def _traffic(options: ExportOptions, recorded: Recorded) -> None:
    """Write delay traces and a packet capture of netem's packets."""
    packets = recorded.parts.get("netem")
    if packets is None or not len(packets):
        message = f"{options.file}: expected packets of netem, the recording has none"
        raise CommandError(message, CONFIGURATION)
    command.claim_output("--pcap", options.pcap)
    if options.traces:
        traces = traffic.traces(packets, recorded.ways)
        command.claim_folder("--traces", options.traces, *(f"{name}.csv" for name in traces))
        for name, trace in traces.items():
            _write(options.traces / f"{name}.csv", trace.encode())
    if options.pcap:
        counted = recorded.figures.get("netem", {})
        header_bytes = counted.get("header_bytes", HEADER_BYTES)  # only with `netem run`
        _write(options.pcap, traffic.pcap(packets, header_bytes=header_bytes))


def _write(path: Path, content: bytes) -> None:
    try:
        files.write(path, content)
    except OSError as error:
        message = f"{path}: cannot be written: {error.strerror}"
        raise CommandError(message, CONFIGURATION) from None
    print(path)
