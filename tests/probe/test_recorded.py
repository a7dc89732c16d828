"""`probe.recorded`: figures from logs, as from a measurement."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from helpers import refused
from skytether.__main__ import main
from skytether.netem.impairments.direction import impairments
from skytether.probe import recorded
from skytether.probe.outcome import outcome
from skytether.shared.formats.recorded import recorded_in
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import File
from skytether.shared.telemetry.parts import parse

ROOT = Path(__file__).parents[2]
RNG = np.random.default_rng(7)
DELAYS_MS = RNG.gamma(4.0, 5.0, 400) + 30.0


def log(lost: Sequence[int] = (), begin_s: float = 1.7e9) -> str:
    """Log of ping, five packets a second; those with the numbers in `lost` are lost."""
    line = "[{:.6f}] 64 bytes from 192.0.2.1: icmp_seq={} ttl=57 time={:.3f} ms\n"
    rows = [
        line.format(begin_s + number / 5 + trip_ms / 1e3, number, trip_ms)
        for number, trip_ms in enumerate(DELAYS_MS.tolist(), 1)
        if number not in lost
    ]
    count = len(DELAYS_MS)
    end = f"{count} packets transmitted, {count - len(lost)} received, 9% packet loss, time 79800ms"
    return "".join(["PING h (192.0.2.1) 56(84) bytes of data.\n", *rows, "\n", end, "\n"])


# -- logs -----------------------------------------------------------------------------------------


def test_the_documented_command_reads_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Table, models and traces are those of half the round trip in each direction."""
    (line,) = re.findall(r"^skytether (probe --from ping\.log.*)$", docs(), re.MULTILINE)
    lost = [*range(100, 110), *range(390, 401)]
    (tmp_path / "ping.log").write_text(log(lost))
    monkeypatch.chdir(tmp_path)
    flags = [word for word in line.split() if word not in {"--figure", "ping.png"}]
    assert main([*flags, "--record", "it.rows"]) == 0
    content = json.loads((tmp_path / "ping.json").read_text())
    assert content["log"] == "round trips"
    assert content["uplink"] == content["downlink"]
    way = content["uplink"]
    kept = np.delete(DELAYS_MS, np.array(lost) - 1) / 2e3
    assert (way["sent"], way["came"], way["bursts"]) == (400, 379, 2)
    assert way["mean_s"] == pytest.approx(kept.mean(), abs=1e-6)
    assert way["quantiles_s"]["1"] == pytest.approx(kept.max(), abs=1e-6)
    assert content["round_trip_mean_s"] == pytest.approx(2.0 * kept.mean(), abs=1e-6)
    assert content["every_s"] == pytest.approx(0.2, abs=1e-6)
    assert "gilbert_elliott" in impairments(way["text"]).parts[1][0]
    for name in ("uplink", "downlink"):
        file = tmp_path / "probed" / f"{name}.csv"
        again = recorded_in(File(name, file.read_bytes()))
        assert again.lost.sum() == len(lost)
        assert again.delay_s[~again.lost] == pytest.approx(kept, abs=2e-6)
    assert (tmp_path / "it.rows").stat().st_size > 400
    assert capsys.readouterr().out.count("skytether fly demo") == 2


def docs() -> str:
    return (ROOT / "docs" / "network.md").read_text()


def test_a_table_of_one_way_is_taken_as_it_is() -> None:
    rows = "".join(f"{n / 10},{0.02 + n / 1e4},0\n" for n in range(100))
    measured = recorded.of_log(recorded_in(File("it", f"time_s,delay_s,lost\n{rows}".encode())))
    figures = outcome(measured, "it", secure=False, log="one way").figures
    assert figures.uplink.mean_s == pytest.approx(0.02 + 49.5e-4)
    assert figures.round_trip_least_s == pytest.approx(0.04)


def test_rows_that_a_table_lacks_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{n / 10},{20 + n % 7}\n" for n in range(100) if not 40 <= n < 47)
    (tmp_path / "it.csv").write_text(f"time_s,rtt_ms\n{rows}")
    assert main(["probe", "--from", "it.csv"]) == 0
    assert "no row for 7 packets" in capsys.readouterr().out


def test_logs_of_two_modems_are_compared_at_the_same_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second log begins 10 s after the first; both links are out for 2 s, 1 s of it at once."""
    (line,) = re.findall(r"^skytether (probe --from .*\.log --from .*)$", docs(), re.MULTILINE)
    (tmp_path / "first.log").write_text(log([*range(151, 161)]))
    (tmp_path / "second.log").write_text(log([*range(106, 116), 300], begin_s=1.7e9 + 10.0))
    monkeypatch.chdir(tmp_path)
    assert main([*line.split(), "--json", "it.json", "--record", "it.rows"]) == 0
    content = json.loads((tmp_path / "it.json").read_text())
    assert [each["listener"] for each in content["paths"]] == ["first.log", "second.log"]
    found = content["outages"]
    assert found["seconds"] == pytest.approx(70.0, abs=0.5)
    assert [each["count"] for each in (*found["paths"], found["common"])] == [1, 1, 1]
    assert [each["longest_s"] for each in found["paths"]] == pytest.approx([2.0, 2.0], abs=0.01)
    assert found["common"]["longest_s"] == pytest.approx(1.0, abs=0.01)
    assert found["common"]["share"] == pytest.approx(1.0 / 70.0, rel=0.02)
    assert found["product"] == pytest.approx((2.0 / 70.0) ** 2, rel=0.02)
    assert "skytether fly probed/paths.toml --virtual" in capsys.readouterr().out
    flown = [reading.load("probed/paths.toml").on_path(number).uplink for number in range(2)]
    assert [each.loss for each in flown] == pytest.approx([10 / 351, 11 / 351], rel=0.01)
    packets = parse((tmp_path / "it.rows").read_bytes())
    assert np.bincount(packets["path"]).tolist() == [800, 800]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--from nothing", "--from: nothing: cannot be read"),
        (5 * "--from it.log ", "got 5 files, expected logs of up to 4 paths"),
        ("--from near.pcap", "--from: near.pcap: got a capture of packets"),
        ("--from it.log --from it.log", "got it.log and it.log, expected each file once"),
        ("--from it.log --from tomorrow.log", "got paths measured at different times"),
        ("--from bad.log", "--from: bad.log: got no answer to a ping"),
        ("--from it.log --listen 127.0.0.1:1", "got both, expected"),
    ],
)
def test_bad_files_are_one_line(
    line: str,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "it.log").write_text(log())
    (tmp_path / "tomorrow.log").write_text(log(begin_s=1.7e9 + 86_400.0))
    (tmp_path / "bad.log").write_text("icmp_seq=1")
    (tmp_path / "near.pcap").write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(40))
    assert said in refused(["probe", *line.split()], capsys)
