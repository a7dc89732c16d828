"""`skytether recover`: give a recording an end that a killed flight has left without one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from shell import command
from shell.command import CommandError
from skytether.recordings import refused
from view.recovery import recover as recovered


@dataclass(frozen=True)
class Options:
    """Options of `skytether recover`."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    out: Path | None = None
    """File for what is recovered; left out: the recording itself, once all is done."""


def recover(argv: Sequence[str]) -> None:
    """Mend a recording that has no end, because its flight was killed or its disk was full.

    All that is whole is kept, the last second may be missing, and summary and index are made anew.
    It does no harm to a recording that is whole.
    """
    options = command.read(Options(tyro.MISSING), argv, "skytether recover", recover.__doc__)
    command.check_output("--out", options.out)
    out = options.out or options.file
    try:
        with refused(options.file):
            kept = recovered(options.file, out)
    except OSError as error:
        raise CommandError(f"{out}: cannot be written: {error.strerror}") from None
    lost = kept.of_bytes - kept.bytes
    print(f"{out}: kept {kept.messages} messages of {kept.seconds:.1f} s, left out {lost} bytes")
