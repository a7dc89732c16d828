"""Recording of a single process: a recorder process reads its feed and writes an MCAP file.

The recorded process does not wait for the disk, and imports no MCAP library. When the recorded
process ends or is killed, the recorder's standard input ends, and the recorder completes its file.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from skytether.shared.scenario.reading import to_toml
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import plugins
from skytether.shell.host import temporary

PATIENCE_S = 30.0
"""Longest time for a recorder to complete its file [s]."""


class RecorderOrder(msgspec.Struct, frozen=True, kw_only=True):
    """Instruction to a recorder, sent as one line of JSON to its standard input."""

    path: str
    feed: str
    process: str
    name: str
    scenario: str
    secure: bool
    plugins: list[str]


class RecorderError(Exception):
    """The recording is incomplete; the message is one line with the reason."""


@contextmanager
def socket_of(feed: Path | None) -> Iterator[Path]:
    """Socket of a feed: the given path, or a socket in a private temporary folder."""
    if feed:
        yield feed
        return
    with temporary.folder() as folder:
        yield folder / "feed"


@contextmanager
def recorder(
    path: Path, feed: Path, process: str, name: str, scenario: Scenario, *, secure: bool
) -> Iterator[None]:
    """Record a feed in another process during the block; the feed must end with the block.

    Raises:
        RecorderError: the recording is incomplete.
    """
    order = RecorderOrder(
        path=str(path),
        feed=str(feed),
        process=process,
        name=name,
        scenario=to_toml(scenario).decode(),
        secure=secure,
        plugins=plugins.flags()[1::2],
    )
    child = subprocess.Popen(
        [sys.executable, "-P", "-m", "skytether.cli.recorder"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # Ctrl-C is for the recorded process, which then ends the recorder.
        start_new_session=True,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        child.stdin.write(msgspec.json.encode(order) + b"\n")
        child.stdin.flush()
        child.stdout.readline()  # the recorder reads the feed from this line on, or has ended
        yield
    except BrokenPipeError:
        pass
    finally:
        try:
            _, errors = child.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            _, errors = child.communicate()
            errors = errors or b"its recorder did not end"
    if child.returncode:
        lines = errors.decode(errors="replace").splitlines()
        raise RecorderError(lines[-1] if lines else f"{path}: its recorder was killed")
