"""Temporary folders: removed at the end, or after a kill by the next process that makes one."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from skytether.shell.host.temporary import MARK, folder
from warm import Command, skytether

HOLDING = """
import sys, time
from skytether.shell.host.temporary import folder
with folder() as made:
    (made / "below").mkdir()
    (made / "below" / "file").write_text("content")
    print(made, flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def holding() -> "subprocess.Popen[str]":
    """Process that holds a folder until its standard input ends."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-P", "-c", HOLDING], **pipes, text=True)  # type: ignore[call-overload]


def test_a_folder_is_gone_at_the_end(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    with suppress(KeyError), folder() as made:
        (made / "below").mkdir()
        (made / "below" / "file").write_text("content")
        (made / "link").symlink_to(outside)
        raise KeyError
    assert list(tmp_path.iterdir()) == [outside]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_next_start_clears_what_a_dead_process_has_left(
    tmp_path: Path, number: signal.Signals
) -> None:
    with holding() as owner:
        assert owner.stdout is not None
        left = Path(owner.stdout.readline().strip())
        with folder():
            assert (left / "below" / "file").exists()
        owner.send_signal(number)
    assert left.exists()
    with folder() as made:
        assert list(tmp_path.iterdir()) == [made]


def test_what_is_not_ours_stays(tmp_path: Path) -> None:
    """A user's folder of such a name, a file, a link to a folder, and another user's folder."""
    (tmp_path / "skytether-results").mkdir()
    (tmp_path / "skytether-file").touch()
    with holding() as owner:
        assert owner.stdout is not None
        left = Path(owner.stdout.readline().strip())
        owner.kill()
    foreign = left.rename(tmp_path / "foreign")
    (tmp_path / "skytether-link").symlink_to(foreign)
    stays = set(tmp_path.iterdir())
    with folder():
        pass
    assert set(tmp_path.iterdir()) == stays
    foreign.rename(left)
    if os.getuid() == 0:
        os.chown(left, 65534, 65534)
        with folder():
            pass
        assert left.exists()


def test_what_is_written_while_it_is_removed_is_cleared_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, folder() as made:
        (made / "below").mkdir()

        def full(_: object) -> None:
            raise OSError

        patch.setattr("shutil.rmtree", full)
    assert sorted(each.name for each in made.iterdir()) == [MARK, "below"]
    with folder() as other:
        assert list(tmp_path.iterdir()) == [other]


@pytest.mark.long
@pytest.mark.realtime
def test_a_flight_clears_what_a_killed_one_has_left(tmp_path: Path) -> None:
    short = ("fly", "demo", "--no-page", "--duration", "0.1")
    with Command("fly", "demo", "--no-page", "--duration", "30") as killed:
        while not list(tmp_path.glob("skytether-*/client.feed")) and not list(
            tmp_path.glob("skytether-*/server")
        ):
            time.sleep(0.05)
        killed.kill()
    assert list(tmp_path.glob("skytether-*"))
    skytether(*short)
    assert not list(tmp_path.glob("skytether-*"))
