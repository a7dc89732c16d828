"""`skytether recover`: repair a recording that lacks its end because its flight was killed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skytether.cli.recordings import refused
from skytether.shell import command
from skytether.shell.command import CommandError
from skytether.shell.options import read
from skytether.view.recovery import recover as recovered


@dataclass(frozen=True)
class RecoverOptions:
    """Options of `skytether recover`."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    out: Path | None = None
    """File for the recovered recording; if left out, the recording itself is replaced at the
    end."""
    plugin: command.Plugins = ()


def recover(argv: Sequence[str]) -> None:
    """Repair a recording without an end: its flight was killed, or its disk was full.

    Everything intact is kept, except that the last second may be missing; summary and index are
    made anew. An intact recording is not harmed: the file is replaced only after the new one was
    read and found to hold at least as many rows.
    """
    options = read(RecoverOptions(tyro.MISSING), argv, "skytether recover", recover.__doc__)
    out = options.out or options.file
    if options.out or options.file.is_file():
        flag = "--out" if options.out else "FILE"
        command.claim_output(flag, out, is_input=options.out is None)
    try:
        with refused(options.file):
            kept = recovered(options.file, out)
    except OSError as error:
        raise CommandError(f"{out}: cannot be written: {error.strerror}") from None
    what = f"{kept.messages} messages of {kept.seconds:.1f} s"
    print(f"{out}: kept {what}, left out {kept.lost_bytes} bytes")
    print(f"rows that can be read: {kept.rows_before} before, {kept.rows} now")
