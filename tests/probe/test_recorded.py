"""`probe.recorded`: figures from logs and pairs of captures, as from a measurement."""

import json
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from helpers import refused
from skytether.__main__ import main
from skytether.netem.impairments.direction import impairments
from skytether.probe import recorded
from skytether.probe.outcome import outcome
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS
from skytether.shared.formats.recorded import recorded_in
from skytether.shared.scenario import reading
from skytether.shared.scenario.registry import File
from skytether.shared.telemetry.record import parse

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
    told = json.loads((tmp_path / "ping.json").read_text())
    assert told["log"] == "round trips"
    assert told["uplink"] == told["downlink"]
    way = told["uplink"]
    kept = np.delete(DELAYS_MS, np.array(lost) - 1) / 2e3
    assert (way["sent"], way["came"], way["bursts"]) == (400, 379, 2)
    assert way["mean_s"] == pytest.approx(kept.mean(), abs=1e-6)
    assert way["quantiles_s"]["1"] == pytest.approx(kept.max(), abs=1e-6)
    assert told["round_trip_mean_s"] == pytest.approx(2.0 * kept.mean(), abs=1e-6)
    assert told["every_s"] == pytest.approx(0.2, abs=1e-6)
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
    told = outcome(measured, "it", secure=False, log="one way").told
    assert told.uplink.mean_s == pytest.approx(0.02 + 49.5e-4)
    assert told.round_trip_least_s == pytest.approx(0.04)


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
    told = json.loads((tmp_path / "it.json").read_text())
    assert [each["listener"] for each in told["paths"]] == ["first.log", "second.log"]
    found = told["outages"]
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


# -- captures -------------------------------------------------------------------------------------

VEHICLE, NAT, SERVER = (b"\x0a\0\0\2", 5000), (b"\xc0\0\2\7", 6000), (b"\xc0\0\2\1", 47001)
Address = tuple[bytes, int]
Packet = tuple[int, Address, Address, bytes]
"""Time [ns], sender, receiver and payload."""


def ethernet(source: Address, target: Address, payload: bytes) -> bytes:
    """Frame with a VLAN tag, and the padding of a short frame after the packet."""
    return b"\0" * 12 + b"\x81\0\0\5\x08\0" + raw(source, target, payload) + b"\0" * 6


def raw(source: Address, target: Address, payload: bytes) -> bytes:
    udp = struct.pack(">HHHH", source[1], target[1], 8 + len(payload), 0) + payload
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0x4000, 64, 17, 0)
    return head + source[0] + target[0] + udp


def raw6(source: Address, target: Address, payload: bytes) -> bytes:
    udp = struct.pack(">HHHH", source[1], target[1], 8 + len(payload), 0) + payload
    addresses = source[0].rjust(16, b"\xfd") + target[0].rjust(16, b"\xfd")
    return struct.pack(">IHBB", 6 << 28, len(udp), 17, 64) + addresses + udp


def pcap(packets: Sequence[Packet], order: str = "<", *, nano: bool = True) -> bytes:
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    parts = [struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)]
    for time_ns, *packet in packets:
        frame = ethernet(*packet)
        seconds, rest = divmod(time_ns, SECOND_NS)
        rest //= 1 if nano else 1000
        parts.append(struct.pack(order + "IIII", seconds, rest, len(frame), len(frame)) + frame)
    return b"".join(parts)


def pcapng(packets: Sequence[Packet], make: Callable[..., bytes] = raw) -> bytes:
    """Sections as Wireshark writes them, with times in nanoseconds."""

    def block(kind: int, body: bytes) -> bytes:
        body += b"\0" * (-len(body) % 4)
        size = struct.pack("<I", 12 + len(body))
        return struct.pack("<I", kind) + size + body + size

    parts = [
        block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)),
        block(1, struct.pack("<HHI", 101, 0, 0) + struct.pack("<HHB3xHH", 9, 1, 9, 0, 0)),
        block(4, b"names"),
    ]
    for time_ns, *packet in packets:
        frame = make(*packet)
        times = struct.pack("<IIIII", 0, time_ns >> 32, time_ns % 2**32, len(frame), len(frame))
        parts.append(block(6, times + frame))
    return b"".join(parts)


def flight(count: int = 200) -> tuple[list[Packet], list[Packet]]:
    """Packets at both ends: 50 ms down, 90 ms up, each tenth lost, with clocks an hour apart.

    Both ends send at the same rate. Both captures contain a stranger's packets, and a NAT is
    between.
    """
    near: list[Packet] = []
    far: list[Packet] = []
    hour_ns, begin_ns = 3600 * SECOND_NS, 1_700_000_000 * SECOND_NS
    for number in range(count):
        at_ns = begin_ns + 100 * MILLISECOND_NS * number
        down, up = (b"%s %06d" % (way, number) for way in (b"down", b"up"))
        near.append((at_ns, VEHICLE, SERVER, down))
        far.append((at_ns + hour_ns, SERVER, NAT, up))
        near.append((at_ns, VEHICLE, NAT, b"of another %d" % number))
        if number % 10 != 3:
            far.append((at_ns + hour_ns + 50 * MILLISECOND_NS, NAT, SERVER, down))
        if number % 10 != 6:
            near.append((at_ns + 90 * MILLISECOND_NS, SERVER, VEHICLE, up))
        if number == 20:
            far.append((at_ns + hour_ns + 55 * MILLISECOND_NS, NAT, SERVER, down))
    return near, far


@pytest.mark.parametrize(
    "written",
    [
        pcap,
        lambda p: pcap(p, ">"),
        lambda p: pcap(p, nano=False),
        lambda p: pcapng(p, raw6),
    ],
)
def test_a_pair_of_captures_is_measured_each_way(
    written: Callable[[Sequence[Packet]], bytes],
) -> None:
    """Loss of each direction; of the delays only the sum, for any clocks."""
    near, far = flight()
    measured = recorded.of_captures(written(near), written(far) + b"cut")
    told = outcome(measured, "it", secure=False).told
    assert [(way.sent, way.came, way.copies) for way in (told.downlink, told.uplink)] == [
        (200, 180, 1),
        (200, 180, 0),
    ]
    assert told.round_trip_mean_s == pytest.approx(0.14, abs=1e-5)
    assert told.offset_s == pytest.approx(3600.0 - 0.02, abs=1e-5)
    assert (told.bytes, told.every_s, told.unreported) == (11, pytest.approx(0.1), 0)
    if written is not pcap:
        return
    swapped = recorded.of_captures(written(far), written(near))
    assert swapped.downlink.came.tolist() == measured.uplink.came.tolist()


def test_payloads_that_were_sent_twice_are_left_out() -> None:
    near, far = flight()
    far += [(time_ns + SECOND_NS, *rest) for time_ns, *rest in far if rest[2].endswith(b"42")]
    measured = recorded.of_captures(pcap(near), pcap(far))
    assert measured.unreported == 4
    assert len(measured.uplink.sent_ns) == 198
    assert measured.downlink.copies == 3


def test_packets_that_a_kernel_sent_as_one_are_cut() -> None:
    """The sender's capture has them in one piece, so each would count as lost."""
    near, far = flight()
    sent = [packet for packet in near if packet[3].startswith(b"down")]
    joined = [
        (time_ns, source, target, one + two[3])
        for (time_ns, source, target, one), two in zip(sent[::2], sent[1::2], strict=True)
    ]
    near = [packet for packet in near if not packet[3].startswith(b"down")] + joined
    measured = recorded.of_captures(pcap(near), pcap(far))
    assert (len(measured.downlink.sent_ns), measured.downlink.came.sum()) == (200, 180)


def one_way(packets: Sequence[Packet]) -> bytes:
    return pcap([packet for packet in packets if not packet[3].startswith(b"up")])


@pytest.mark.parametrize(
    ("near", "far", "said"),
    [
        (pcap([]), pcap(flight()[1]), "no UDP packet is in both"),
        (pcap(flight()[0]), pcap(flight()[1])[:20], "no UDP packet is in both"),
        (one_way(flight()[0]), pcap(flight()[1]), "of one direction only"),
        (pcap(2 * flight()[0]), pcap(flight()[1]), "0 have a unique payload"),
    ],
)
def test_captures_that_share_too_little_are_refused(near: bytes, far: bytes, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        recorded.of_captures(near, far)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--from nothing", "--from: nothing: cannot be read"),
        ("--from near.pcap", "got 1 files, of which 1 are captures, expected one log, or two"),
        ("--from it.log --from near.pcap", "got 2 files, of which 1 are captures"),
        ("--from it.log --from it.log", "got it.log and it.log, expected each file once"),
        ("--from it.log --from tomorrow.log", "got paths without a time in common"),
        ("--from bad.log", "--from: bad.log: got no answer to a ping"),
        ("--from near.pcap --from near.pcap", "the same times in both captures"),
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
    (tmp_path / "near.pcap").write_bytes(pcap(flight()[0]))
    assert said in refused(["probe", *line.split()], capsys)
