"""`scenario.air.traces`: recorded networks, from files of four formats, and files that are none."""

import json
from pathlib import Path

import numpy as np
import pytest

from skytether.netem.fate import Fates
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.scenario import reading
from skytether.shared.scenario.air import traces
from skytether.shared.scenario.air.draws import SLOT_NS
from skytether.shared.scenario.air.path import Path as AirPath
from skytether.shared.scenario.air.path import path
from skytether.shared.scenario.registry import File

PING = """PING example (192.0.2.1) 56(84) bytes of data.
64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=20.0 ms
64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=30.0 ms
64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=31.0 ms (DUP!)
64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=50.0 ms

--- example ping statistics ---
4 packets transmitted, 3 received, 25% packet loss, time 3004ms
"""
TIMED = """PING example (192.0.2.1) 56(84) bytes of data.
[1700000000.020000] 64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=20.0 ms
[1700000000.230000] 64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=30.0 ms
[1700000000.650000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=50.0 ms
"""


def trip(sent_ns: int, rtt_ns: int | None, send_ns: int = 0) -> dict[str, object]:
    """A round trip as irtt writes it."""
    if rtt_ns is None:
        return {"lost": "true", "timestamps": {"client": {"send": {"monotonic": sent_ns}}}}
    delay = {"rtt": rtt_ns, "send": send_ns, "receive": rtt_ns - send_ns}
    return {
        "lost": "false",
        "delay": delay,
        "timestamps": {"client": {"send": {"monotonic": sent_ns}}},
    }


IRTT = json.dumps(
    {
        "round_trips": [
            trip(5 * 10**9, 20_000_000, 15_000_000),
            trip(6 * 10**9, None),
            trip(7 * 10**9, 40_000_000, 10_000_000),
        ]
    }
)


def file(tmp_path: Path, text: str) -> str:
    """Path of a file with this text."""
    (tmp_path / "mine").write_text(text)
    return str(tmp_path / "mine")


@pytest.mark.parametrize(
    ("text", "way", "time_s", "delay_s", "lost"),
    [
        ("time_s,delay_s\n0,0.1\n1,0.2\n", "auto", [0, 1], [0.1, 0.2], [0, 0]),
        ("time_s, delay_ms ,lost\n5,100,0\n6,,1\n8,200,0\n", "auto", [0, 1, 3], None, [0, 1, 0]),
        ("sent_s,rtt_ms\n0,100\n0.5,200\n", "auto", [0, 0.5], [0.05, 0.1], [0, 0]),
        ("other,rtt_s,sent_s\n9,1,0\n9,2,1\n", "auto", [0, 1], [0.5, 1.0], [0, 0]),
        (PING, "auto", [0, 1, 2, 3], [0.01, 0.015, 0.02, 0.025], [0, 0, 1, 0]),
        (TIMED, "auto", [0, 0.2, 0.4, 0.6], [0.01, 0.015, 0.02, 0.025], [0, 0, 1, 0]),
        (IRTT, "auto", [0, 1, 2], [0.01, 0.015, 0.02], [0, 1, 0]),
        (IRTT, "send", [0, 1, 2], [0.015, 0.0125, 0.01], [0, 1, 0]),
        (IRTT, "receive", [0, 1, 2], [0.005, 0.0175, 0.03], [0, 1, 0]),
    ],
)
def test_formats_are_told_apart_by_their_content(
    text: str,
    way: traces.Way,
    time_s: list[float],
    delay_s: list[float] | None,
    lost: list[int],
) -> None:
    found = traces.recorded_in(File("it", text.encode()), way)
    delay_s = delay_s or [0.1, 0.1 + 0.1 / 3, 0.2]
    np.testing.assert_allclose(found.time_s, time_s, atol=1e-6)
    np.testing.assert_allclose(found.delay_s, delay_s, atol=1e-9)
    assert found.lost.astype(int).tolist() == lost


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "got an empty file"),
        (" \n", "got an empty file"),
        ("time_s,delay_s\n", "got no rows"),
        ("a,b\n1,2\n", "got the first line 'a,b', expected the columns time_s or sent_s, and"),
        ("time_s,delay_s\n0,0.1\n1,nan\n", "row 2: got nan, expected a delay"),
        ("time_s,delay_s\n0,0.1\n1,-1\n", "row 2: got -1, expected a delay of at least 0"),
        ("time_s,delay_s\n0,0.1\n1,5000\n", "row 2: got 5000, expected a delay of at most 3600 s"),
        ("time_s,delay_s\n0,0.1\n1,0.1\n0.5,0.1\n", "row 3: got 0.5, expected a time after"),
        ("time_s,delay_s\nnan,0.1\n", "row 1: got nan, expected a time in seconds"),
        ("time_s,delay_s\n0,x\n", "expected numbers"),
        ("time_s,delay_s\n0\n", "expected numbers"),
        ("time_s,delay_s,lost\n0,1,1\n1,1,1\n", "got lost packets alone"),
        ("time_s,delay_s\n0,0.1\n2e9,0.1\n", "got 2e+09 s, expected at most 1e9 s"),
        ('{"round_trips": [{}]}', "expected JSON as irtt writes it"),
        ("{" * 100_000, "expected JSON as irtt writes it"),
        ("PING x\nno answer yet for icmp_seq=1\n", "got no answer to a ping"),
        ("icmp_seq=1 time=1.0 ms\nicmp_seq=90000000 time=1.0 ms\n", "more rows than 1000000"),
    ],
)
def test_a_bad_file_is_told_in_a_line(tmp_path: Path, text: str, said: str) -> None:
    name = file(tmp_path, text)
    with pytest.raises(ConfigError) as raised:
        reading.check({"network": {"uplink": f'trace("{name}")'}})
    assert name in str(raised.value)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["", "x\n", "5\n3\n", "-1\n", "nan\n", "0\n0\n"])
def test_a_bad_file_of_mahimahi_is_told_in_a_line(tmp_path: Path, text: str) -> None:
    name = file(tmp_path, text)
    with pytest.raises(ConfigError, match="a file of mahimahi") as raised:
        reading.check({"network": {"downlink": f'deliveries("{name}")'}})
    assert "\n" not in str(raised.value)


def test_too_many_rows_are_refused_before_they_are_read(tmp_path: Path) -> None:
    name = file(tmp_path, "time_s,delay_s\n" + "0,1\n" * 10_000_000)
    with pytest.raises(ValueError, match="got 10000000 rows, expected at most 1000000"):
        traces.recorded_in(File(name, Path(name).read_bytes()))


def test_a_file_is_read_again_where_it_has_changed(tmp_path: Path) -> None:
    name = file(tmp_path, "time_s,delay_s\n0,0.1\n")
    assert path_of(f"trace({name})").mean_s == 0.1
    file(tmp_path, "time_s,delay_s\n0,0.25\n")
    assert path_of(f"trace({name})").mean_s == 0.25


def path_of(text: str) -> AirPath:
    """A direction, with the files that its text names."""
    return path(text, reading.files_of("network.uplink", text))


@pytest.mark.parametrize("play", ["loop", "once"])
def test_a_trace_is_replayed_by_time(tmp_path: Path, play: str) -> None:
    name = file(tmp_path, "time_s,delay_s,lost\n0,0.1,0\n1,0.3,0\n2,,1\n3,0.3,0\n")
    fates = Fates(path_of(f"trace({name}, {play})"), 1, "uplink", 0)

    def at(time_s: float) -> tuple[float, bool]:
        fate = fates.at(round(time_s * SECOND_NS / SLOT_NS))
        return fate.delay_ns / SECOND_NS, fate.lost

    assert at(0.0) == (0.1, False)
    assert at(0.25) == (0.15, False)
    assert [at(time_s)[1] for time_s in (1.4, 1.6, 2.4, 2.6)] == [False, True, True, False]
    assert at(3.5) == (0.3, False)
    assert at(4.25) == ((0.15, False) if play == "loop" else (0.3, False))


@pytest.mark.parametrize("name", ["urban", "edge-of-cell", "outage", "rural", "rural-queue"])
def test_the_recorded_links_are_scenarios(name: str) -> None:
    scenario = reading.load(f"5g-{name}")
    table = np.loadtxt(reading.SCENARIOS / "traces" / f"5g-{name}.csv", delimiter=",", skiprows=1)
    assert scenario.network.uplink == scenario.network.downlink
    assert scenario.uplink.mean_s == pytest.approx(table[:, 1].mean() / 2e3)
    assert scenario.uplink.is_ordered
