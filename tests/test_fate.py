"""`netem.fate`: the delays of eq. (17) as corrected, and fates that depend on their names alone."""

from itertools import islice

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy import stats

from netem.fate import BLOCK, Fate, delays_ns, fates
from shared.chance import stream
from shared.config import DirectionConfig
from shared.endpoint import MILLISECOND_NS

SAMPLES = 20_000
TAIL = 8
"""Slots from here on are one class: Poisson(2) has 22 of 20 000 samples there."""

PAPER = DirectionConfig()
COUNT = 3 * BLOCK + 1


def first_fates(
    direction: DirectionConfig = PAPER, seed: int = 1, name: str = "uplink", flow: int = 0
) -> list[Fate]:
    """The fates of a flow's first packets."""
    return list(islice(fates(direction, seed, name, flow), COUNT))


@pytest.fixture(scope="module")
def slots() -> NDArray[np.int64]:
    """Number m of slots of eq. (17) in sampled delays."""
    delays = delays_ns(PAPER, stream(17, "test"), SAMPLES)
    slots, rest_ns = np.divmod(delays - 400 * MILLISECOND_NS, 20 * MILLISECOND_NS)
    assert not rest_ns.any(), "a delay off the lattice 0.4 s + 0.02 s · m"
    return slots


def test_paper_delays_follow_the_corrected_equation_17(slots: NDArray[np.int64]) -> None:
    """P(m) = 2^m e^-2 / m!, by a chi-square test."""
    shares = [*stats.poisson.pmf(range(TAIL), 2), stats.poisson.sf(TAIL - 1, 2)]
    counts = np.bincount(np.minimum(slots, TAIL), minlength=TAIL + 1)
    assert stats.chisquare(counts, np.multiply(shares, SAMPLES)).pvalue > 0.001


def test_the_equation_as_printed_is_no_distribution() -> None:
    """2^m e^-2 / m lacks the factorial: m = 1 … 4 alone are more than certain."""
    m = np.arange(1, 5)
    assert (2.0**m * np.exp(-2.0) / m).sum() == pytest.approx(1.444, abs=0.001)


def test_delays_do_not_follow_the_equation_as_printed(slots: NDArray[np.int64]) -> None:
    """Even scaled to one, the printed shape does not fit the slots that are frequent enough."""
    m = np.arange(1, TAIL)
    printed = 2.0**m / m
    counts = np.bincount(slots, minlength=TAIL)[1:TAIL]
    expected = counts.sum() * printed / printed.sum()
    assert stats.chisquare(counts, expected).pvalue < 1e-9


def test_the_mean_paper_delay_is_440_ms(slots: NDArray[np.int64]) -> None:
    """Within four standard errors, and as the scenario says."""
    mean_s = 0.4 + 0.02 * slots.mean()
    assert mean_s == pytest.approx(0.44, abs=4 * 0.02 * np.sqrt(2 / SAMPLES))
    assert PAPER.mean_s == pytest.approx(0.44)


def test_a_constant_delay_is_the_minimum() -> None:
    """Without the slots of the paper's."""
    constant = DirectionConfig(delay="constant", minimum_s=0.25)
    assert delays_ns(constant, stream(1), 3).tolist() == [250 * MILLISECOND_NS] * 3


def test_no_delay_is_none_whatever_the_minimum() -> None:
    """The numbers of other delays do not count."""
    assert delays_ns(DirectionConfig(delay="none"), stream(1), 3).tolist() == [0, 0, 0]


@pytest.mark.parametrize("loss", [0.02, 0.1, 0.5])
def test_the_share_of_lost_packets_is_as_asked(loss: float) -> None:
    """By a binomial test."""
    drawn = islice(fates(replace(PAPER, loss=loss), 17, "uplink", 0), SAMPLES)
    lost = sum(fate.lost for fate in drawn)
    assert stats.binomtest(lost, SAMPLES, loss).pvalue > 0.001


@pytest.mark.parametrize(("loss", "lost"), [(0.0, 0), (1.0, COUNT)])
def test_certain_losses_are_certain(loss: float, lost: int) -> None:
    """No packet is lost at a rate of 0, and every packet at a rate of 1."""
    assert sum(fate.lost for fate in first_fates(replace(PAPER, loss=loss))) == lost


def test_losses_are_independent_of_delays() -> None:
    """The slow packets are not lost more often: a contingency test."""
    drawn = list(islice(fates(PAPER, 17, "uplink", 0), SAMPLES))
    slow = [fate.delay_ns > 440 * MILLISECOND_NS for fate in drawn]
    table = stats.contingency.crosstab(slow, [fate.lost for fate in drawn]).count
    assert stats.chi2_contingency(table).pvalue > 0.001


def test_fates_are_the_same_again() -> None:
    """Same seed, direction and flow: same network."""
    assert first_fates() == first_fates()


def test_fates_do_not_depend_on_how_they_are_interleaved() -> None:
    """Two flows that take turns meet what each would have met alone."""
    pairs = zip(fates(PAPER, 1, "uplink", 0), fates(PAPER, 1, "uplink", 1), strict=True)
    taken = list(islice(pairs, COUNT))
    assert [first for first, _ in taken] == first_fates(flow=0)
    assert [second for _, second in taken] == first_fates(flow=1)


@pytest.mark.parametrize("other", [{"seed": 2}, {"name": "downlink"}, {"flow": 1}])
def test_another_seed_direction_or_flow_meets_another_network(other: dict[str, object]) -> None:
    """In its delays as well as in its losses."""
    ours, theirs = first_fates(), first_fates(**other)  # type: ignore[arg-type]
    assert [fate.delay_ns for fate in ours] != [fate.delay_ns for fate in theirs]
    assert [fate.lost for fate in ours] != [fate.lost for fate in theirs]


@pytest.mark.parametrize("loss", [0.0, 0.5, 1.0])
def test_the_loss_rate_changes_no_delay(loss: float) -> None:
    """A lost packet draws its delay as well, so nothing after it shifts."""
    delays = [fate.delay_ns for fate in first_fates(replace(PAPER, loss=loss))]
    assert delays == [fate.delay_ns for fate in first_fates()]


@pytest.mark.parametrize("delay", ["constant", "none"])
def test_the_delay_model_changes_no_loss(delay: str) -> None:
    """Each is drawn from a stream of its own."""
    lost = [fate.lost for fate in first_fates(replace(PAPER, delay=delay))]
    assert lost == [fate.lost for fate in first_fates()]


def test_a_higher_loss_rate_loses_the_same_packets_and_more() -> None:
    """A sweep over the rate therefore compares like with like."""
    few, many = (first_fates(replace(PAPER, loss=loss)) for loss in (0.1, 0.3))
    assert all(more.lost for less, more in zip(few, many, strict=True) if less.lost)
    assert sum(fate.lost for fate in few) < sum(fate.lost for fate in many)
