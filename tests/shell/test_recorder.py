"""Writing a part of the record to a file: all rows, or as many as fit and a line about it."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from helpers import until
from skytether.shared.base import files
from skytether.shared.events.flight import RecordIncomplete
from skytether.shared.telemetry.parts import read
from skytether.shared.telemetry.record import PACKET_COLUMNS
from skytether.shell.commandline.command import CommandError
from skytether.shell.driving import recording
from skytether.shell.driving.recording import RecordFile
from skytether.shell.host import writer
from skytether.shell.processes.process import recorded, recorded_meanwhile
from virtual_loop import AtJoin


@pytest.fixture(autouse=True)
def _threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread writes when it is waited for."""
    if not request.node.get_closest_marker("realtime"):
        monkeypatch.setattr(writer.threading, "Thread", AtJoin)


def append(to: RecordFile, count: int) -> None:
    for number in range(count):
        to.recorder.append(1, number=number)


def test_rows_are_in_the_file_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "netem"
    with recorded(path, PACKET_COLUMNS) as part:
        append(part, 1000)
        part.end()
        assert part.rows()["number"].tolist() == list(range(1000))
        assert (part.news(), part.fault()) == (None, None)
    np.testing.assert_array_equal(read(path)["number"], np.arange(1000))


@pytest.mark.realtime
def test_rows_reach_the_file_while_the_flight_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "netem"
    with recorded(path, PACKET_COLUMNS) as part:
        append(part, 10)
        until(lambda: path.stat().st_size >= part._header_bytes + 10 * PACKET_COLUMNS.itemsize)
        assert read(path)["number"].tolist() == list(range(10))


class OnAFullDisk(files.Growing):
    def __init__(self, path: Path, buffering: int = -1) -> None:
        self._path = self.at = path
        self.file = Path("/dev/full").open("r+b", buffering)  # noqa: SIM115 - closed by `end`


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(files, "Growing", OnAFullDisk)
    return Path("record")


def test_a_full_disk_is_said_once_and_ends_the_command_when_all_is_done(full: Path) -> None:
    flown = []

    def fly() -> None:
        with recorded(full, PACKET_COLUMNS) as part:
            append(part, 3)
            part.end()
            flown.extend([part.news(), part.news(), len(part.rows())])

    with pytest.raises(CommandError) as error:
        fly()
    event = RecordIncomplete(file="record", reason="No space left on device")
    assert flown == [event, None, 0]
    assert error.value.code == 1
    assert "0 of 3 rows" in str(error.value)


def test_without_a_temporary_file_a_flight_is_flown_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nowhere(*_: object, **__: object) -> BinaryIO:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr("tempfile.TemporaryFile", nowhere)
    flown = []

    def fly() -> None:
        with recorded_meanwhile(PACKET_COLUMNS) as part:
            append(part, 3)
            part.end()
            flown.extend(part.rows())

    with pytest.raises(CommandError, match=r"temporary record: No usable .*: 0 of 3 rows"):
        fly()
    assert flown == []


def test_a_disk_that_is_too_slow_loses_whole_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows beyond the memory's capacity, and those not written within the final timeout."""
    monkeypatch.setattr(recording, "ROOM_BYTES", 1000)
    monkeypatch.setattr(recording, "PATIENCE_S", 0.0)
    with (tmp_path / "netem").open("w+b", buffering=0) as file:
        part = RecordFile("netem", PACKET_COLUMNS, file)
        append(part, 1000)
        assert part.news() == RecordIncomplete(file="netem", reason="the disk is too slow")
        part.end()
        assert "0 of 1000 rows" in part.fault()
        monkeypatch.setattr(recording, "PATIENCE_S", 30.0)
        part.end()
        kept = (1000 - part._header_bytes) // PACKET_COLUMNS.itemsize
        assert part.fault() == f"netem: the disk is too slow: {kept} of 1000 rows are recorded"
        assert len(part.rows()) == kept


def test_a_file_of_any_name_can_be_told_of() -> None:
    """Its name may be invalid Unicode, but a line of JSON must not."""
    part = RecordFile("netem\udcff", PACKET_COLUMNS, OSError(28, "No space left on device"))
    part.end()
    assert part.news() == RecordIncomplete(file="netem?", reason="No space left on device")
    part.close()


def test_a_command_that_fails_otherwise_says_only_that(full: Path) -> None:
    def fly() -> None:
        with recorded(full, PACKET_COLUMNS) as part:
            append(part, 3)
            raise CommandError("refused")

    with pytest.raises(CommandError, match="refused"):
        fly()


def test_a_file_that_cannot_be_opened_is_a_mistake_before_the_flight(tmp_path: Path) -> None:
    with (
        pytest.raises(CommandError, match="cannot be written: No such file or directory") as error,
        recorded(tmp_path / "none" / "netem", PACKET_COLUMNS),
    ):
        pytest.fail("flown")
    assert error.value.code == 2
