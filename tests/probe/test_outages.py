"""Outages of paths: which there are, and how many several paths have in common."""

from collections.abc import Sequence
from itertools import groupby
from math import prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skytether.client.link import PlainLink
from skytether.netem.proxy import Proxy
from skytether.probe.listener import Listener
from skytether.probe.outages import (
    OUTAGE_S,
    RoundTrips,
    common_time,
    compare,
    length_s,
    outages,
    overlap,
)
from skytether.probe.prober import Prober
from skytether.probe.wire import NONCE_BYTES
from skytether.server.gate import PlainGate
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.scenario import reading
from skytether.sim.world import World

EVERY_S = 0.125


def trips(failed: Sequence[bool], begin_s: float = 0.0, gap_s: float = 0.0) -> RoundTrips:
    """Probes 0.125 s apart, with a gap in front of the second half."""
    count = len(failed)
    late = np.arange(count) >= count // 2
    sent_s: Array = begin_s + EVERY_S * np.arange(count) + gap_s * late
    trip_s: Array = np.where(failed, np.nan, 0.05)
    return RoundTrips(sent_s, trip_s)


def row(text: str) -> list[bool]:
    return [letter == "x" for letter in text]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("....xxxx....", [(0.5, 1.0)]),
        ("....xxx.xxx.", []),  # shorter than 0.5 s each
        ("xxxx....xxxx", [(0.0, 0.5), (1.0, 1.625)]),  # the last probe covers 0.25 s
        ("............", []),
        ("xxxxxxxxxxxx", [(0.0, 1.625)]),
    ],
)
def test_an_outage_is_a_row_of_probes_without_answer(
    text: str, expected: list[tuple[float, float]]
) -> None:
    found, covered = outages(trips(row(text)), OUTAGE_S)
    assert found.tolist() == [list(each) for each in expected]
    assert covered.tolist() == [[0.0, 12 * EVERY_S + EVERY_S]]


def test_an_answer_that_takes_too_long_is_none() -> None:
    sent_s = np.arange(0.0, 1.5, EVERY_S)
    trip_s = np.where((sent_s >= 0.5) & (sent_s < 1.0), OUTAGE_S + 0.01, OUTAGE_S)
    assert outages(RoundTrips(sent_s, trip_s), OUTAGE_S)[0].tolist() == [[0.5, 1.0]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("....xx..........", []),
        (".......xx.......", []),  # two lost by chance, one on each side of the gap
        (".....xxxx.......", [(0.625, 3.125)]),
        ("......xx........", []),
    ],
)
def test_the_gap_of_a_train_makes_no_outage_but_may_be_within_one(
    text: str, expected: list[tuple[float, float]]
) -> None:
    found, covered = outages(trips(row(text), gap_s=2.0), OUTAGE_S)
    assert found.tolist() == [list(each) for each in expected]
    assert covered.tolist() == [[0.0, 1.125], [3.0, 4.125]]


ROWS = st.integers(8, 40).flatmap(
    lambda count: st.lists(
        st.lists(st.booleans(), min_size=count, max_size=count), min_size=2, max_size=4
    )
)


@settings(max_examples=40)
@given(ROWS, st.integers(0, 3))
def test_common_outages_are_those_of_every_probe_counted_by_hand(
    failed: list[list[bool]], late: int
) -> None:
    """Shares are means of flags, and the common share that of their product; the first path began
    some probes earlier.
    """
    # The last probe, which covers twice as much, is answered.
    paths = [trips([*each, False]) for each in failed]
    paths[0] = trips([*[False] * late, *failed[0], False], begin_s=-late * EVERY_S)
    found = compare(paths)
    flags = np.array([_out(each) for each in failed])
    total_s = flags.shape[1] * EVERY_S + 2 * EVERY_S
    shares = flags.sum(axis=1) * EVERY_S / total_s
    assert [each.share for each in found.paths] == pytest.approx(shares.tolist())
    assert found.product == pytest.approx(prod(shares.tolist()))
    assert found.common.share == pytest.approx(flags.all(axis=0).sum() * EVERY_S / total_s)
    assert found.seconds == pytest.approx(total_s)
    runs = [length for value, length in _runs([all(each) for each in flags.T.tolist()]) if value]
    assert found.common.count == len(runs)
    assert found.common.longest_s == pytest.approx(EVERY_S * max(runs, default=0))
    assert compare(paths[::-1]).common == found.common


def _runs(flags: Sequence[bool]) -> list[tuple[bool, int]]:
    return [(value, len([*run])) for value, run in groupby(flags)]


def _out(failed: Sequence[bool]) -> list[bool]:
    """Whether the path is out, at each probe."""
    return [
        value and length * EVERY_S >= OUTAGE_S
        for value, length in _runs(failed)
        for _ in range(length)
    ]


SETS = st.lists(
    st.lists(st.integers(0, 30), unique=True, max_size=10).map(
        lambda ends: np.sort(ends)[: len(ends) // 2 * 2].reshape(-1, 2).astype(float)
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=50)
@given(SETS, st.integers(1, 4))
def test_an_overlap_is_that_of_every_moment(sets: list[Array], least: int) -> None:
    moments = np.arange(0.5, 30.0)
    inside = [((each[:, :1] < moments) & (moments < each[:, 1:])).any(axis=0) for each in sets]
    found = overlap(sets, least)
    assert length_s(found) == (np.sum(inside, axis=0) >= least).sum()
    assert np.all(np.diff(found.ravel()) > 0)


def test_paths_that_were_never_measured_together_are_refused() -> None:
    with pytest.raises(ValueError, match="measured at different times"):
        compare([trips(row("........")), trips(row("........"), begin_s=60.0)])


def test_sparse_probes_need_two_in_a_row_for_an_outage() -> None:
    """One lost ping of one a second is no outage of a second."""
    sent_s = np.arange(20.0)
    trip_s = np.where(np.isin(sent_s, (4, 10, 11)), np.nan, 0.05)
    found = compare([RoundTrips(sent_s, trip_s)] * 2)
    assert (found.threshold_s, found.common.count, found.common.longest_s) == (2.0, 1, 2.0)


def test_the_time_in_common_is_each_paths_own() -> None:
    first, second = trips(row("........")), trips(row("........"), begin_s=0.25)
    assert common_time([first, second]) == [(0.25, 0.875), (0.0, 0.625)]


def test_paths_are_probed_at_the_same_time_in_a_known_network() -> None:
    """One path is out from 1 to 2.5 s to the listener, the other from 2 to 4 s from it."""
    world, probers = World(), []
    listener = world.add("listener", Listener(PlainGate(), b"secret" * 5))
    for number, cut in enumerate(("downlink", "uplink")):
        network = {"uplink": "constant(0.02)", "downlink": "constant(0.02)"}
        network[cut] += ("& outage(1, 1.5)", "& outage(2, 2)")[number]
        scenario = reading.check({"network": network}, "measured")
        netem = world.add(f"netem {number}", Proxy(scenario, server=listener))
        prober = Prober(
            PlainLink(),
            netem,
            bytes([number]) * NONCE_BYTES,
            probes=200,
            period_ns=SECOND_NS // 20,
            size=400,
        )
        world.add(f"prober {number}", prober)
        probers.append(prober)
    world.run(lambda: all(each.finished for each in probers), limit_ns=60 * SECOND_NS)
    found = compare([each.round_trips() for each in probers])
    assert [each.count for each in (*found.paths, found.common)] == [1, 1, 1]
    longest_s = [each.longest_s for each in (*found.paths, found.common)]
    assert longest_s == pytest.approx([1.5, 2.0, 0.5], abs=0.1)
    seconds = 10.0 - 1.6  # what a train takes of the time is covered by no probe
    assert found.seconds == pytest.approx(seconds, abs=0.2)
    assert found.common.share == pytest.approx(0.5 / seconds, abs=0.01)
    assert found.product == pytest.approx(1.5 * 2.0 / seconds**2, abs=0.005)
