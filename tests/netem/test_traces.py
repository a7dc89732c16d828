"""`scenario.air`: recorded networks from files of many formats, and invalid files."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import Impairments, impairments
from skytether.netem.impairments.draws import SLOT_NS
from skytether.probe.outages import compare
from skytether.probe.recorded import round_trips
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.formats import recorded
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import File

PING = """PING example (192.0.2.1) 56(84) bytes of data.
64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=20.0 ms
64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=30.0 ms
64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=31.0 ms (DUP!)
64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=50.0 ms

--- example ping statistics ---
4 packets transmitted, 3 received, 25% packet loss, time 3000ms
"""
TIMED = """PING example (192.0.2.1) 56(84) bytes of data.
[1700000000.020000] 64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=20.0 ms
[1700000000.230000] 64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=30.0 ms
[1700000000.650000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=50.0 ms
"""


def trip(sent_ns: int, rtt_ns: int | None, send_ns: int = 0) -> dict[str, object]:
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
    way: recorded.Way,
    time_s: list[float],
    delay_s: list[float] | None,
    lost: list[int],
) -> None:
    found = recorded.recorded_in(File("it", text.encode()), way)
    delay_s = delay_s or [0.1, 0.1 + 0.1 / 3, 0.2]
    np.testing.assert_allclose(found.time_s, time_s, atol=1e-6)
    np.testing.assert_allclose(found.delay_s, delay_s, atol=1e-9)
    assert found.lost.astype(int).tolist() == lost


# -- logs of ping ----------------------------------------------------------------------------------

IPUTILS = """$ ping -O -i 0.2 192.0.2.1
PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data.
no answer yet for icmp_seq=1
64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=20.0 ms
64 bytes from 192.0.2.1: icmp_seq=2 ttl=57 time=31.0 ms (DUP!)
From 192.0.2.9 icmp_seq=3 Destination Host Unreachable
no answer yet for icmp_seq=4

--- 192.0.2.1 ping statistics ---
6 packets transmitted, 1 received, +1 duplicates, +1 errors, 83.3333% packet loss, time 1000ms
rtt min/avg/max/mdev = 20.000/20.000/20.000/0.000 ms
"""
GERMAN = """PING 192.0.2.1 (192.0.2.1) 56(84) Bytes an Daten.
64 Bytes von 192.0.2.1: icmp_seq=1 ttl=57 Zeit=20,0 ms
noch keine Antwort für icmp_seq=2
64 Bytes von 192.0.2.1: icmp_seq=3 ttl=57 Zeit=30,5 ms

--- 192.0.2.1 ping-Statistiken ---
4 Pakete übertragen, 2 empfangen, 50% Paketverlust, Zeit 600ms
rtt min/avg/max/mdev = 20,000/25,250/30,500/5,250 ms
"""
MAC = """PING 192.0.2.1 (192.0.2.1): 56 data bytes
Request timeout for icmp_seq 0
64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=20.000 ms
Request timeout for icmp_seq 2
^C
--- 192.0.2.1 ping statistics ---
4 packets transmitted, 1 packets received, 75.0% packet loss
round-trip min/avg/max/stddev = 20.000/20.000/20.000/0.000 ms
"""
BUSYBOX = """PING 192.0.2.1 (192.0.2.1): 56 data bytes
64 bytes from 192.0.2.1: seq=0 ttl=64 time=20.000 ms
64 bytes from 192.0.2.1: seq=3 ttl=64 time=30.500 ms

--- 192.0.2.1 ping statistics ---
5 packets transmitted, 2 packets received, 60% packet loss
round-trip min/avg/max = 20.000/25.250/30.500 ms
"""
WINDOWS = """
Pinging 192.0.2.1 with 32 bytes of data:
Reply from 192.0.2.1: bytes=32 time=20ms TTL=117
Request timed out.
Reply from 192.0.2.9: Destination host unreachable.
Reply from 192.0.2.1: bytes=32 time<1ms TTL=117

Ping statistics for 192.0.2.1:
    Packets: Sent = 4, Received = 3, Lost = 1 (25% loss),
Approximate round trip times in milli-seconds:
    Minimum = 0ms, Maximum = 20ms, Average = 10ms
"""
WINDOWS_GERMAN = """
Ping wird ausgeführt für 192.0.2.1 mit 32 Bytes Daten:
Antwort von 192.0.2.1: Bytes=32 Zeit=20ms TTL=117
Zeitüberschreitung der Anforderung.
Antwort von 192.0.2.9: Zielhost nicht erreichbar.
Antwort von 192.0.2.1: Bytes=32 Zeit<1ms TTL=117

Ping-Statistik für 192.0.2.1:
    Pakete: Gesendet = 4, Empfangen = 3, Verloren = 1
    (25% Verlust),
Ca. Zeitangaben in Millisek.:
    Minimum = 0ms, Maximum = 20ms, Mittelwert = 10ms
"""
WINDOWS_FRENCH = """
Envoi d’une requête 'Ping'  192.0.2.1 avec 32 octets de données :
Réponse de 192.0.2.1 : octets=32 temps=20 ms TTL=117
Délai d’attente de la demande dépassé.
Réponse de 192.0.2.9 : Impossible de joindre l’hôte de destination.
Réponse de 192.0.2.1 : octets=32 temps<1ms TTL=117

Statistiques Ping pour 192.0.2.1:
    Paquets : envoyés = 4, reçus = 3, perdus = 1 (perte 25%),
Durée approximative des boucles en millisecondes :
    Minimum = 0ms, Maximum = 20ms, Moyenne = 10ms
"""
FPING = """[1700000000.02000] 192.0.2.1 : [0], 64 bytes, 20.0 ms (20.0 avg, 0% loss)
[1700000000.43050] 192.0.2.1 : [2], 64 bytes, 30.5 ms (25.3 avg, 0% loss)
[1700000000.43100] 192.0.2.1 : duplicate for [2], 64 bytes, 31.0 ms
[1700000000.70000] 192.0.2.1 : [1], timed out (25.3 avg, 33% loss)

192.0.2.1 : xmt/rcv/%loss = 4/2/50%, min/avg/max = 20.0/25.3/30.5
"""
FPING_BARE = "$ fping -c 4 -p 200 192.0.2.1\n" + "".join(
    line.partition("] ")[2] or line for line in FPING.splitlines(keepends=True)
)


@pytest.mark.parametrize(
    ("text", "every_s", "trips_ms", "copies"),
    [
        (IPUTILS, 0.2, [None, 20, None, None, None, None], 1),
        (GERMAN, 0.2, [20, None, 30.5, None], 0),
        (MAC, 1.0, [None, 20, None, None], 0),
        (BUSYBOX, 1.0, [20, None, None, 30.5, None], 0),
        (WINDOWS, 1.0, [20, None, None, 0.5], 0),
        (WINDOWS_GERMAN, 1.0, [20, None, None, 0.5], 0),
        (WINDOWS_FRENCH, 1.0, [20, None, None, 0.5], 0),
        (FPING, 0.2, [20, None, 30.5, None], 1),
        (FPING_BARE, 0.2, [20, None, 30.5, None], 1),
    ],
)
def test_logs_of_ping_are_read_in_every_language(
    text: str, every_s: float, trips_ms: list[float | None], copies: int
) -> None:
    found = recorded.recorded_in(File("it", text.encode()))
    np.testing.assert_allclose(found.time_s, every_s * np.arange(len(trips_ms)), atol=1e-6)
    known = [each is not None for each in trips_ms]
    assert found.lost.tolist() == [not each for each in known]
    came_ms = [each / 2.0 for each in trips_ms if each is not None]
    np.testing.assert_allclose(1e3 * found.delay_s[known], came_ms)
    assert (found.copies, found.halved) == (copies, True)


@pytest.mark.parametrize("codec", ["utf-8-sig", "utf-16", "cp850"])
def test_logs_are_read_in_the_codings_of_windows(codec: str) -> None:
    text = WINDOWS_GERMAN.replace("\n", "\r\n")
    found = recorded.recorded_in(File("it", text.encode(codec)))
    assert found.lost.tolist() == [False, True, True, False]


def answers(*numbers: int) -> str:
    """Lines of ping without its first line and its summary."""
    line = "64 bytes from 192.0.2.1: icmp_seq={} ttl=57 time=20.0 ms\n"
    return "".join(map(line.format, numbers))


@pytest.mark.parametrize(
    ("text", "lost"),
    [
        (IPUTILS + GERMAN + BUSYBOX, [1, 0, 1, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 0, 1]),
        (answers(1, 2, 4, 1, 3), [0, 0, 1, 0, 0, 1, 0]),  # a number comes twice: a new run
        (answers(*range(3000, 3003), 1, 2), [0, 0, 0, 0, 0]),  # far below: a new run
        (answers(65534, 65535, 1), [0, 0, 1, 0]),  # 0 was lost when icmp_seq wrapped
        (answers(1, 3, 2, 4), [0, 0, 0, 0]),  # 2 was overtaken
        (IPUTILS.partition("no")[0] + "0 packets x, 0 y, 0% z, time 0ms\n" + answers(1, 2), [0, 0]),
    ],
)
def test_runs_and_wraps_are_told_apart(text: str, lost: list[int]) -> None:
    found = recorded.recorded_in(File("it", text.encode()))
    assert found.lost.astype(int).tolist() == lost
    assert np.diff(found.time_s).min() > 0.0
    assert np.diff(found.time_s).max() <= 1.0


def test_more_than_two_wraps_are_counted() -> None:
    text = answers(*(number % 65536 for number in range(1, 150_000, 100)))
    found = recorded.recorded_in(File("it", text.encode()))
    assert len(found.time_s) == 149_901
    assert (~found.lost).sum() == 1500


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (IPUTILS.replace("6 packets", "3 packets"), "line 10: got a summary of 3 sent and 1"),
        (IPUTILS.replace("1 received", "0 received"), "line 10: got a summary of 6 sent and 0"),
        (IPUTILS.replace("1 received", "3 received"), "but 1 answers above it, expected a line"),
        (WINDOWS.replace("\n", "\n08:00:00 "), "line 9: got a summary of 4 sent and 3 received"),
        ("PING h (h) 56(84) bytes\n\n3 packets x, 3 y, 0% z, time 9ms\n", "log without -q"),
        (FPING.replace("192.0.2.1 : [2]", "192.0.2.7 : [2]"), "line 2: got answers of 192.0.2.1"),
        (TIMED.replace("1700000000.65", "1699990000.65"), "line 4: got a time 9999.58 s before"),
    ],
)
def test_a_log_that_contradicts_itself_is_refused(text: str, said: str) -> None:
    assert text not in (IPUTILS, FPING, TIMED)
    with pytest.raises(ValueError, match="it: line ") as raised:
        recorded.recorded_in(File("it", text.encode()))
    assert said in str(raised.value)


# -- tables and files of irtt ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "timestamp,rtt\n1700000000.0,20\n1700000000.2,-1\n1700000000.4,40\n",
        "timestamp,rtt\n1700000000000,0.02\n1700000000200,\n1700000000400,0.04\n",
        "\ufefft , x , rtt_ms \r\n0 , 7 , 20\r\n 0.2 , word , -1\r\n0.4,7,40\r\n",
        "t;RTT (ms)\n0,0;20,0\n0,2;\n0,4;40,0\n",
        '"time_ms"\t"rtt"\n"0"\t"20"\n"200"\t""\n"400"\t"40"\n',
        "timestamp,rtt\n0,20\n200,nan\n400,40\n",
        "time_s,rtt_ms\n0,20\n0.4,40\n0.2,-1\n",  # in the order of arrival
    ],
)
def test_tables_are_read_in_their_own_units(text: str) -> None:
    found = recorded.recorded_in(File("it", text.encode()))
    np.testing.assert_allclose(found.time_s, [0.0, 0.2, 0.4], atol=1e-6)
    np.testing.assert_allclose(found.delay_s, [0.01, 0.015, 0.02], atol=1e-9)
    assert found.lost.tolist() == [False, True, False]
    assert found.halved


def test_packets_of_one_time_are_kept() -> None:
    text = "time_s,delay_s\n0,0.1\n1,0.1\n1,0.2\n2,0.1\n"
    assert recorded.recorded_in(File("it", text.encode())).delay_s.tolist() == [0.1, 0.1, 0.2, 0.1]


def test_irtt_is_read_from_gzip_with_times_of_day() -> None:
    text = IRTT.replace("monotonic", "wall")
    found = recorded.recorded_in(File("it", gzip.compress(text.encode())))
    assert found.lost.tolist() == [False, True, False]
    assert found.time_s.tolist() == [0.0, 1.0, 2.0]


def test_one_way_delays_beyond_their_round_trip_are_refused() -> None:
    text = json.dumps(
        {"round_trips": [trip(0, 20_000_000, 15_000_000), trip(9, 1000, 900_000_000)]}
    )
    assert recorded.recorded_in(File("it", text.encode())).halved
    for way in ("send", "receive"):
        with pytest.raises(ValueError, match=f"row 2: .* way={way} within the round trip"):
            recorded.recorded_in(File("it", text.encode()), way)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (gzip.compress(b"x" * 100, mtime=0)[:-9], "got a truncated file"),
        (2 * gzip.compress(b"x" * 100, mtime=0), "got a truncated file, several"),
        (b"\x1f\x8bxxxxxxxxx", "cannot be read"),
        (b"time_s,delay_s\n0,0\0\n", "cannot be read"),
        (b"\xd4\xc3\xb2\xa1" + bytes(40), "got a capture of packets"),
    ],
)
def test_bytes_that_are_no_text_are_refused(content: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=f"it: {said}"):
        recorded.recorded_in(File("it", content))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "got an empty file"),
        ("time_s,delay_s\n", "got no rows"),
        ("a,b\n1,2\n", "got the first line 'a,b', expected the columns of a time, such as time_s"),
        ("time_s,delay_s,lost\n0,0.1,0\n1,,0\n", "row 2: got nan, expected a delay, or 1 in"),
        ("time_s,delay_s\n0,0.1\n1,-2\n", "row 2: got -2, expected a delay of at least 0"),
        ("time_s,delay_s\n0,0.1\n1,5000\n", "row 2: got 5000, expected a delay of at most 3600 s"),
        ("time_s,delay_s\n0,0.1\n60,0.1\n1,0.1\n", "row 3: got 1, expected a time at most 10 s"),
        ("time_s,delay_s\n7,0.1\n7,0.1\n7,0.1\n8,0.1\n", "got equal times in most rows"),
        ("time_s,delay_s\nnan,0.1\n", "row 1: got nan, expected a time"),
        ("time_s,delay_s\n0,1\n\n1,x\n", "line 4: got 'x', expected numbers"),
        ("time_s,delay_s\n0\n", "line 2: got 1 columns, expected at least 2"),
        (
            "timestamp,rtt\n2025-08-05T12:00:00Z,20\n",
            "line 2: got '2025-08-05T12:00:00Z', expected",
        ),
        ("timestamp,rtt\n0,0.3\n1,0.4\n", "got 'rtt', which may be seconds or milliseconds"),
        ("t,rtt_ms\n0,9\n10,9\n20,9\n", "got 't', which may be seconds or milliseconds"),
        ("time_s,delay_s,lost\n0,1,1\n1,1,1\n", "got lost packets only"),
        ("time_s,delay_s\n0,0.1\n2e9,0.1\n", "got 2e+09 s, expected at most 1e9 s"),
        ('{"round_trips": [{}]}', "expected JSON as irtt writes it"),
        ("{" * 100_000, "expected JSON as irtt writes it"),
        ("PING x\nno answer yet for icmp_seq=1\n", "got no answer to a ping"),
        ("icmp_seq=1 time=1.0 ms\nicmp_seq=90000000 time=1.0 ms\n", "got 90000000 packets"),
    ],
)
def test_a_bad_file_is_told_in_a_line(tmp_path: Path, text: str, said: str) -> None:
    name = file(tmp_path, text)
    with pytest.raises(ConfigError) as raised:
        reading.check({"network": {"uplink": f'trace("{name}")'}})
    assert name in str(raised.value)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["", "5\n3\n", "-1\n", "nan\n", "0\n0\n"])
def test_a_bad_file_of_mahimahi_is_told_in_a_line(tmp_path: Path, text: str) -> None:
    name = file(tmp_path, text)
    with pytest.raises(ConfigError, match="a file of mahimahi") as raised:
        reading.check({"network": {"downlink": f'deliveries("{name}")'}})
    assert "\n" not in str(raised.value)


def test_too_many_rows_are_refused_before_they_are_read(tmp_path: Path) -> None:
    name = file(tmp_path, "time_s,delay_s\n" + "0,1\n" * 1_000_001)
    with pytest.raises(ValueError, match="got 1000001 rows, expected at most 1000000"):
        recorded.recorded_in(File(name, Path(name).read_bytes()))


def test_a_file_is_read_again_where_it_has_changed(tmp_path: Path) -> None:
    name = file(tmp_path, "time_s,delay_s\n0,0.1\n")
    assert path_of(f"trace({name})").mean_s == 0.1
    file(tmp_path, "time_s,delay_s\n0,0.25\n")
    assert path_of(f"trace({name})").mean_s == 0.25


def path_of(text: str) -> Impairments:
    """Direction of the network, with the files that its text names."""
    return impairments(text, reading.files_of("network.uplink", text))


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


@pytest.mark.parametrize(("name", "together"), [("apart", 0), ("together", 1)])
def test_the_recorded_pairs_are_scenarios_of_two_paths(name: str, together: int) -> None:
    """Outages of both networks, and the number of those in common."""
    scenario, trips = reading.load(f"two-networks-{name}"), []
    assert len(scenario.paths) == 2
    for number, operator in enumerate(("att", "verizon")):
        file = reading.SCENARIOS / "traces" / f"two-networks-{name}-{operator}.csv"
        found = recorded.recorded_in(File(file.name, file.read_bytes()))
        flown = scenario.on_path(number)
        assert flown.network.uplink == flown.network.downlink
        assert flown.uplink.is_ordered
        assert flown.uplink.mean_s == pytest.approx(found.delay_s.mean())
        assert flown.uplink.loss == pytest.approx(found.lost.mean())
        assert found.time_s[-1] >= scenario.duration
        trips.append(round_trips(found))
    outages = compare(trips)
    assert min(each.count for each in outages.paths) >= 1
    assert outages.common.count == together
    assert (outages.common.share > outages.product) == bool(together)
