"""`netem.fate`: delays of eq. (17) as corrected, and fates that depend on names and time only."""

from bisect import bisect_right

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from skytether.netem.fate import Fates
from skytether.netem.impairments import delays
from skytether.netem.impairments.direction import impairments
from skytether.netem.impairments.draws import SLOT_NS, Draws, Fate, Stream
from skytether.shared.base.units import MILLISECOND_NS, SECOND_NS

SAMPLES = 20_000
TAIL = 8
"""Slots from here on form one class: Poisson(2) has 22 of 20 000 samples there."""

PAPER = "paper(0.4, 0.02, 2.0)"
LOSSY = f"{PAPER} & loss(0.1)"
COUNT = 800


def first_fates(
    direction: str = LOSSY,
    seed: int = 1,
    name: str = "uplink",
    flow: int = 0,
    count: int = COUNT,
) -> list[Fate]:
    fates = Fates(impairments(direction), seed, name, flow)
    return [fates.at(slot) for slot in range(count)]


def delays_ns(direction: str, count: int) -> NDArray[np.int64]:
    fates = first_fates(direction, 17, count=count)
    return np.array([fate.delay_ns for fate in fates], dtype=np.int64)


def test_paper_delays_follow_the_corrected_equation_17() -> None:
    """P(m) = 2^m e^-2 / m!, by a chi-square test; on the lattice 0.4 s + 0.02 s m."""
    delays = delays_ns(LOSSY, SAMPLES)
    slots, rest_ns = np.divmod(delays - 400 * MILLISECOND_NS, 20 * MILLISECOND_NS)
    assert not rest_ns.any()
    shares = [*stats.poisson.pmf(range(TAIL), 2), stats.poisson.sf(TAIL - 1, 2)]
    counts = np.bincount(np.minimum(slots, TAIL), minlength=TAIL + 1)
    assert stats.chisquare(counts, np.multiply(shares, SAMPLES)).pvalue > 0.001
    assert impairments(PAPER).mean_s == pytest.approx(0.44)


def test_losses_are_independent_of_delays() -> None:
    drawn = first_fates(seed=17, count=SAMPLES)
    slow = [fate.delay_ns > 440 * MILLISECOND_NS for fate in drawn]
    table = stats.contingency.crosstab(slow, [fate.lost for fate in drawn]).count
    assert stats.chi2_contingency(table).pvalue > 0.001


def test_a_fate_does_not_depend_on_what_was_asked_before() -> None:
    fates, bursty = (
        Fates(impairments(text), 1, "uplink", 0)
        for text in (
            LOSSY,
            "gamma(0, 0.1, 0.05, correlation_s=0.3) & gilbert_elliott(0.1, 0.5) & duplicate(0.2)",
        )
    )
    year = 365 * 86_400 * SECOND_NS // SLOT_NS
    for each in (fates, bursty):
        slots = [0, 7, 7_000, year, year + 1, -5]
        forwards = [each.at(slot) for slot in slots]
        assert [each.at(slot) for slot in reversed(slots)] == forwards[::-1]


def test_packets_of_one_slot_have_fates_of_their_own() -> None:
    """CLOSE is sent three times at once, because one may be lost: a binomial test."""
    fates = Fates(impairments(LOSSY), 17, "uplink", 0)
    triples = [[fates.at(slot, rank) for rank in range(3)] for slot in range(SAMPLES)]
    all_lost = sum(all(fate.lost for fate in triple) for triple in triples)
    assert stats.binomtest(all_lost, SAMPLES, 0.1**3).pvalue > 0.001
    assert len({triple[0].delay_ns == triple[1].delay_ns for triple in triples}) == 2


@pytest.mark.parametrize("mean", [0.0, 0.3, 40.0, 1e6])
def test_any_number_of_slots_has_its_mean_and_variance(mean: float) -> None:
    config = f"paper(0.0, 0.001, {mean}) & loss(0.1)"
    slots = delays_ns(config, SAMPLES) / MILLISECOND_NS
    assert slots.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / SAMPLES) + 1e-6)
    kurtosis = np.sqrt((2 * mean**2 + mean) / SAMPLES)
    assert slots.var() == pytest.approx(mean, abs=4 * kurtosis + 1e-6)


# -- bursts ----------------------------------------------------------------------------------------


def test_a_channel_is_as_it_was_drawn_at_the_newest_moment_before() -> None:
    """Transitions of every cell, one after the other up to its end, computed here all at once."""
    names, mean_s = (5, "uplink", 0, "moments"), 0.1
    draws, moments_of = Draws(Stream("packets"), 0, names), Stream(*names)
    drawn: list[tuple[float, float]] = []
    for cell in range(-40, 200):
        moment, number = float(cell), 0
        while True:
            gap, state = moments_of.pair(cell, number)
            moment, number = moment - np.log1p(-gap), number + 1
            if moment > cell + 1.0:
                break
            drawn.append((moment, state))
    moments = [moment for moment, _ in drawn]
    for slot in range(0, 19_900, 10):
        time = slot * SLOT_NS / (mean_s * SECOND_NS)
        assert draws.lasting(Fate(slot), mean_s) == drawn[bisect_right(moments, time) - 1][1]


@pytest.mark.parametrize("mean", [0.0, 0.3, 2.0, 50.0, 1000.0])
def test_no_draw_lies_beyond_the_last_number_of_slots(mean: float) -> None:
    """The probabilities rise to 1 exactly, because a draw may come arbitrarily close to 1."""
    _, cumulative = delays._poisson(mean)
    assert cumulative[-1] == 1.0
    assert list(cumulative) == sorted(cumulative)


def test_in_a_burst_everything_is_lost() -> None:
    fates = Fates(impairments(f"{PAPER} & gilbert_elliott(0.3, 0.1)"), 1, "uplink", 0)
    slots = [{fates.at(slot, rank).lost for rank in range(4)} for slot in range(2000)]
    assert all(len(fates_of) == 1 for fates_of in slots)
    assert {True} in slots
    assert {False} in slots


@pytest.mark.parametrize("burst_s", [0.0, 1e-3, 3600.0])
@pytest.mark.parametrize(("loss", "share"), [(0.0, 0.0), (1.0, 1.0)])
def test_certain_losses_are_certain(loss: float, share: float, burst_s: float) -> None:
    drawn = first_fates(f"{PAPER} & gilbert_elliott({loss}, {burst_s})")
    assert np.mean([fate.lost for fate in drawn]) == share


def test_bursts_shorter_than_a_slot_are_none() -> None:
    drawn = first_fates(f"{PAPER} & gilbert_elliott(0.5, 1e-4)")
    assert drawn == first_fates(f"{PAPER} & loss(0.5)")


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("other", [{"seed": 2}, {"name": "downlink"}, {"flow": 1}])
def test_another_seed_direction_or_flow_meets_another_network(other: dict[str, object]) -> None:
    ours, theirs = first_fates(), first_fates(**other)  # type: ignore[arg-type]
    assert [fate.delay_ns for fate in ours] != [fate.delay_ns for fate in theirs]
    assert [fate.lost for fate in ours] != [fate.lost for fate in theirs]


@pytest.mark.parametrize(("loss", "burst_s"), [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.5, 1.0)])
def test_losses_change_no_delay(loss: float, burst_s: float) -> None:
    """A lost packet draws its delay too, so later draws stay the same."""
    losses = f"gilbert_elliott({loss}, {burst_s})" if burst_s else f"loss({loss})"
    drawn = first_fates(f"{PAPER} & {losses}")
    assert [fate.delay_ns for fate in drawn] == [fate.delay_ns for fate in first_fates()]


def test_a_higher_loss_rate_loses_the_same_packets_and_more() -> None:
    few, many = (first_fates(f"{PAPER} & loss({loss})") for loss in (0.1, 0.3))
    assert all(more.lost for less, more in zip(few, many, strict=True) if less.lost)
    assert sum(fate.lost for fate in few) < sum(fate.lost for fate in many)
