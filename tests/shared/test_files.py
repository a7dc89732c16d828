"""Outputs of commands: only a plain file or a new name is written, for every option."""

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skytether.cli import keygen
from skytether.cli.export import export
from skytether.cli.fleet import fleet
from skytether.cli.fly import fly
from skytether.cli.join import join
from skytether.cli.report import report
from skytether.client.__main__ import fly as client
from skytether.lab.commands.margins import margins
from skytether.netem.__main__ import emulate
from skytether.server.__main__ import serve
from skytether.shared.base import files
from skytether.shell.commandline import command

SHORT = ("--virtual", "--duration", "6", "--settle", "0")
CALLS: list[tuple[Any, tuple[str, ...], str]] = [
    (fly, ("demo", *SHORT, "--json"), ""),
    (fly, ("demo", *SHORT, "--record"), ".mcap"),
    (fly, ("demo", *SHORT, "--figure"), ".png"),
    (fleet, ("fleet", "--virtual", "--json"), ""),
    (margins, ("demo", "--json"), ""),
    (client, ("demo", "--record"), ""),
    (client, ("demo", "--json"), ""),
    (serve, ("demo", "--record"), ""),
    (emulate, ("demo", "--record"), ""),
    (report, ("FLIGHT", "--html"), ""),
    (join, ("FLIGHT", "--record"), ".mcap"),
]


def link(path: Path) -> None:
    path.symlink_to("precious")


def dangling(path: Path) -> None:
    path.symlink_to("nothing")


def device(path: Path) -> None:
    """Device, with a node of its own if this user may make one."""
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root can make a device")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    assert command.main(fly, ["demo", *SHORT, "--record", str(path)], "fly") == 0
    return path


@pytest.mark.parametrize(
    ("of", "flags", "suffix", "made"),
    [
        *((*call, link) for call in CALLS),
        *((*CALLS[0], made) for made in (dangling, device, os.mkfifo)),
    ],
)
def test_no_command_writes_through_a_link_or_to_a_device(
    of: Any,
    flags: tuple[str, ...],
    suffix: str,
    made: Callable[[Path], None],
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    precious, at = tmp_path / "precious", tmp_path / f"it{suffix}"
    precious.write_text("precious")
    made(at)
    before = at.lstat()
    argv = [str(flight) if flag == "FLIGHT" else flag for flag in flags]
    assert command.main(of, [*argv, str(at)], "it") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "cannot be written: it is " in line
    assert "expected a plain file or a new name" in line
    after = at.lstat()
    assert (before.st_ino, before.st_mode) == (after.st_ino, after.st_mode)
    assert precious.read_text() == "precious"
    assert {each.name for each in tmp_path.iterdir()} == {"precious", at.name}


def test_tables_are_not_written_through_a_link(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "client.csv").symlink_to(tmp_path / "elsewhere")
    assert command.main(export, [str(flight), "--csv", str(tmp_path)], "export") == 2
    assert "client.csv: cannot be written: it is a link" in capsys.readouterr().err
    assert not (tmp_path / "elsewhere").exists()


def test_journals_and_keys_are_not_written_through_a_link(tmp_path: Path) -> None:
    at, elsewhere = tmp_path / "it", tmp_path / "elsewhere"
    at.symlink_to(elsewhere)
    for write in (files.appending, files.Growing):
        with pytest.raises(OSError, match="it is a link"):
            write(at)
    with pytest.raises(command.CommandError):
        keygen.make(at, [1])
    assert not elsewhere.exists()


def test_a_file_that_is_there_is_written_anew(tmp_path: Path) -> None:
    at = tmp_path / "it"
    files.write(at, b"long content")
    at.chmod(0o600)
    files.write(at, b"short")
    assert at.read_bytes() == b"short"
    assert stat.S_IMODE(at.stat().st_mode) == 0o600


def test_a_file_that_is_exchanged_meanwhile_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between check and opening, another process puts a link there."""
    at, precious = tmp_path / "it", tmp_path / "precious"
    precious.write_text("precious")

    def check(path: Path, **_: bool) -> None:
        path.unlink(missing_ok=True)
        path.symlink_to(precious)

    monkeypatch.setattr(files, "check", check)
    for write in (files.appending, files.Growing):
        with pytest.raises(OSError, match="symbolic links"):
            write(at)
    files.write(at, b"content")
    assert at.read_bytes() == b"content"
    assert not at.is_symlink()
    assert precious.read_text() == "precious"
