"""`skytether export`: a recording as tables for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from shell import command
from shell.command import CONFIGURATION, CommandError
from skytether import recordings
from view import export as view


@dataclass(frozen=True)
class Options:
    """Options of `skytether export`."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    csv: Path | None = None
    """Folder for the tables as CSV."""
    parquet: Path | None = None
    """Folder for the tables as Parquet; takes pyarrow."""


def export(argv: Sequence[str]) -> None:
    """Write a recording as tables, one a part: client, server, plan, netem, and the events.

    A column has its unit in its name, as in position_x_m; the folder is made where there is none.
    """
    options = command.read(Options(tyro.MISSING), argv, "skytether export", export.__doc__)
    if not (options.csv or options.parquet):
        said = "got neither --csv nor --parquet, expected a folder for the tables"
        raise CommandError(said, CONFIGURATION)
    try:
        to_parquet = view.parquet() if options.parquet else None
    except ImportError:
        said = "--parquet: pyarrow is not installed, expected it (pip install pyarrow), or --csv"
        raise CommandError(said, CONFIGURATION) from None
    with recordings.opened(options.file) as recorded:
        tables = view.tables(recorded)
    for folder in filter(None, (options.csv, options.parquet)):
        folder.mkdir(parents=True, exist_ok=True)
    for name, columns in tables.items():
        if options.csv:
            path = options.csv / f"{name}.csv"
            path.write_text(view.csv(columns))
            print(path)
        if options.parquet and to_parquet:
            path = options.parquet / f"{name}.parquet"
            to_parquet(columns, str(path))
            print(path)
