"""Recordings of a robot end, read by the library `mcap`."""

import errno
import io
import threading
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from policy_lab import MS, OPTIONS, Lab, messages, state
from skytether.policy import events, recording
from skytether.policy.images import Compressor
from skytether.policy.recording import CallRecording
from skytether.policy.robot import AnsweredCall
from skytether.policy.schedule import Kind
from skytether.shared.base.units import SECOND_NS

GREY = np.full((48, 64, 3), 90, np.uint8)


def answered(number: int, sent: object = None, reply: object = None) -> AnsweredCall:
    now_ns = number * SECOND_NS
    return AnsweredCall(now_ns, number, Kind.REST, SECOND_NS // 10, -1, 1, sent, reply)


def test_images_are_recorded_as_they_were_sent(tmp_path: Path) -> None:
    seen = {
        "wrist": GREY,
        "images": {"top": GREY.transpose(2, 0, 1)},
        "state": np.array([1.5, np.nan]),
        "map": np.zeros((100, 100)),
    }
    written = CallRecording(tmp_path / "a.mcap", OPTIONS)
    sent = Compressor(raw=["images/top"])(seen)
    written.note(answered(1, sent, {"actions": np.array([[1, 2]])}))
    written.note(answered(2))
    written.hear(events.Holding(robot=1, reason="no session"))
    assert written.close() == ""
    found = dict(messages(tmp_path / "a.mcap"))
    jpeg = found["/images/wrist"]
    assert (jpeg["format"], jpeg["frame_id"]) == ("jpeg", "wrist")
    assert np.asarray(Image.open(io.BytesIO(b64decode(jpeg["data"])))).mean() == 90
    raw = found["/images/images/top"]
    assert (raw["width"], raw["height"], raw["step"]) == (64, 48, 192)
    assert b64decode(raw["data"]) == GREY.tobytes()
    assert found["/observation"] == {"call": 1, "state": [1.5, None], "map": "float64 (100, 100)"}
    assert found["/events"]["message"] == str(events.Holding(robot=1, reason="no session"))
    answers = [each for topic, each in messages(tmp_path / "a.mcap") if topic == "/answers"]
    assert [each["actions"] for each in answers] == [[[1, 2]], None]


def test_the_way_of_each_call_is_recorded(tmp_path: Path) -> None:
    """Sent, reported and answered by a chunk; the second call's observation is lost."""
    lab = Lab(to_policy="outage(0.2, 0.2)")
    written = CallRecording(tmp_path / "a.mcap", OPTIONS)
    lab.robot._on_step = written.step
    lab.connect()
    lab.infer(state(1.0))
    lab.sleep(0.2)
    lab.infer(state(1.0))
    assert written.close() == ""
    found = list(messages(tmp_path / "a.mcap"))
    options = [each for topic, each in found if topic == "/options"]
    assert [(each["deadline_ns"], each["player"]) for each in options] == [(150 * MS, "clock")]
    steps = [each for topic, each in found if topic == "/link"]
    kinds = [each["kind"] for each in steps]
    assert kinds == ["program", "session", "sent", "report", "chunk", "sent"]
    sent, report, chunk, again = steps[2:]
    assert (sent["call"], sent["message"], again["call"], again["message"]) == (1, 0, 2, 1)
    assert report["parts"] == sent["parts"] >= sent["needed"] == 1
    assert (chunk["call"], chunk["message"], chunk["rows"]) == (1, 0, 10)


def test_a_full_disk_stops_the_recording_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = CallRecording(tmp_path / "a.mcap", OPTIONS)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(written._channels.writer, "add_message", full)
    for number in range(2 * recording.WAITING_MAX):
        written.note(answered(number))
    assert "No space left on device" in written.close()


def test_a_slow_disk_never_delays_a_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    written = CallRecording(tmp_path / "a.mcap", OPTIONS)
    monkeypatch.setattr(written, "_add_call", lambda _: free.wait())
    for number in range(recording.WAITING_MAX + 10):
        written.note(answered(number))
    free.set()
    assert "slow disk" in written.close()
