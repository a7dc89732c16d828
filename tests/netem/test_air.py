"""`scenario.air`: impairments against their distributions, and texts against the grammar."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from skytether.netem.fate import Fates
from skytether.netem.impairments.direction import impairments
from skytether.netem.impairments.draws import SLOT_NS, Fate
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import Call, GrammarError
from skytether.shared.scenario.registry import IMPAIRMENTS, TRIGGERS

SAMPLES = 3000
P_MIN = 0.001


def fates(text: str, seed: int = 1, count: int = SAMPLES, every: int = 7) -> list[Fate]:
    made = Fates(impairments(text), seed, "uplink", 0)
    return [made.at(every * number) for number in range(count)]


def delays_s(text: str, seed: int, every: int = 7, count: int = SAMPLES) -> NDArray[np.float64]:
    return np.array([fate.delay_ns for fate in fates(text, seed, count, every)]) / SECOND_NS


def lognormal(least: float, mean: float, sd: float) -> Any:
    variance = np.log(1 + (sd / (mean - least)) ** 2)
    scale = (mean - least) * np.exp(-variance / 2)
    return stats.lognorm(np.sqrt(variance), loc=least, scale=scale)


def gamma(least: float, mean: float, sd: float) -> Any:
    shape = ((mean - least) / sd) ** 2
    return stats.gamma(shape, loc=least, scale=(mean - least) / shape)


LAWS = {
    "uniform(0.05, 0.2)": stats.uniform(0.05, 0.15),
    "normal(0.3, 0.04)": stats.norm(0.3, 0.04),
    "lognormal(0.02, 0.05, 0.03)": lognormal(0.02, 0.05, 0.03),
    "gamma(0.02, 0.05, 0.01)": gamma(0.02, 0.05, 0.01),
    "gamma(0.02, 0.05, 0.06)": gamma(0.02, 0.05, 0.06),
    "gamma(0, 0.5, 0.005)": gamma(0, 0.5, 0.005),
}


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("constant(50ms)", "constant(0.05)"),
        ("normal(mean_s=20ms, sd_s=500us)", "normal(0.02, 0.0005)"),
        ("gilbert_elliott(7%, 2s)", "gilbert_elliott(0.07, 2)"),
        ("rate(1.5Mbit, queue=9000)", "rate(187500, 9000)"),
    ],
)
def test_a_number_may_have_the_unit_of_its_parameter(text: str, plain: str) -> None:
    assert IMPAIRMENTS.calls(text) == IMPAIRMENTS.calls(plain)


@pytest.mark.parametrize("text", ["loss(50ms)", "constant(10%)", "rate(10%)", "rate(1ms)"])
def test_a_unit_of_something_else_is_refused(text: str) -> None:
    with pytest.raises(GrammarError):
        IMPAIRMENTS.calls(text)
    with pytest.raises(GrammarError):
        TRIGGERS.parse("budget(5ms)")


@pytest.mark.parametrize("text", LAWS)
def test_delays_follow_their_law_and_what_it_says_of_itself_is_so(text: str) -> None:
    made, law = impairments(text), LAWS[text]
    assert stats.kstest(delays_s(text, 1), law.cdf).pvalue > P_MIN
    assert made.mean_s == pytest.approx(law.mean(), rel=1e-6)
    assert made.least_s == pytest.approx(max(0.0, law.ppf(2.0**-54)), abs=0.01)


@pytest.mark.parametrize(
    ("law", "mean_s", "sd_s"), [("gamma(0, 0.5, 0.3", 0.5, 0.3), ("paper(0, 0.1, 3", 0.3, 0.1732)]
)
def test_correlated_delays_keep_their_law_and_their_memory(
    law: str, mean_s: float, sd_s: float
) -> None:
    """The autocorrelation falls to 1/e in the correlation time."""
    every, correlation_s = 50, 0.5
    text = f"{law}, correlation_s={correlation_s})"
    drawn = np.concatenate([delays_s(text, seed, every, 8000) for seed in range(10)])
    alone = np.concatenate([delays_s(f"{law})", seed, every, 8000) for seed in range(3)])
    assert drawn.mean() == pytest.approx(mean_s, rel=0.03)
    assert drawn.std() == pytest.approx(sd_s, rel=0.03)
    lag = round(correlation_s * SECOND_NS / (every * SLOT_NS))
    centred = drawn - drawn.mean()
    correlation = np.mean(centred[lag:] * centred[:-lag]) / np.mean(centred**2)
    assert correlation == pytest.approx(np.exp(-1), abs=0.03)
    centred = alone - alone.mean()
    assert abs(np.mean(centred[1:] * centred[:-1]) / np.mean(centred**2)) < 0.02


@pytest.mark.parametrize(
    ("text", "befell", "share"),
    [
        ("loss(0.1)", lambda fate: fate.lost, 0.1),
        ("duplicate(0.2)", lambda fate: fate.copies == 1, 0.2),
        ("corrupt(0.3)", lambda fate: fate.flipped is not None, 0.3),
        ("loss(0.2) & loss(0.5)", lambda fate: fate.lost, 0.6),
        ("gilbert_elliott(0.3, 0.001, 0.5, 0.1)", lambda fate: fate.lost, 0.22),
    ],
)
def test_shares_are_those_asked_for(
    text: str, befell: Callable[[Fate], bool], share: float
) -> None:
    count = sum(befell(fate) for fate in fates(text))
    assert stats.binomtest(count, SAMPLES, share).pvalue > P_MIN
    if "loss" in text or "gilbert" in text:
        assert impairments(text).loss == pytest.approx(share)


def test_flipped_bits_lie_anywhere() -> None:
    places = [fate.flipped for fate in fates("corrupt(0.5)") if fate.flipped is not None]
    assert stats.kstest(places, stats.uniform.cdf).pvalue > P_MIN


@pytest.mark.parametrize(
    ("text", "share", "burst_s"),
    [("gilbert_elliott(0.2, 0.4)", 0.2, 0.4), ("outages(3, 1)", 0.25, 1.0)],
)
def test_bursts_last_as_long_as_asked_for(text: str, share: float, burst_s: float) -> None:
    every, count = 20, 20_000
    lost = np.concatenate(
        [[fate.lost for fate in fates(text, seed, count, every)] for seed in range(2)]
    )
    edges = np.flatnonzero(np.diff(lost.astype(int), prepend=0, append=0))
    lengths_s = np.diff(edges)[::2] * every * SLOT_NS / SECOND_NS
    error = 4 / np.sqrt(len(lengths_s))
    assert lengths_s.mean() == pytest.approx(burst_s, rel=error + 0.03)
    assert lengths_s.std() == pytest.approx(burst_s, rel=2 * error + 0.03)
    assert lost.mean() == pytest.approx(share, rel=2 * error)


def test_an_outage_keeps_its_schedule() -> None:
    once = [fate.lost for fate in fates("outage(2, 0.5)", every=100, count=100)]
    assert np.flatnonzero(once).tolist() == [20, 21, 22, 23, 24]
    again = [fate.lost for fate in fates("outage(2, 0.5, every_s=3)", every=100, count=100)]
    assert np.flatnonzero(again).tolist() == [
        first + more for first in (20, 50, 80) for more in range(5)
    ]


def test_delays_add_up() -> None:
    assert {fate.delay_ns for fate in fates("constant(0.1) & constant(0.05)")} == {150_000_000}
    assert impairments("constant(0.1) & uniform(0.1, 0.3)").mean_s == pytest.approx(0.3)


def test_another_impairment_changes_no_draw_of_the_others() -> None:
    alone, both = fates("gamma(0, 0.1, 0.05)"), fates("loss(0.3) & gamma(0, 0.1, 0.05)")
    assert [fate.delay_ns for fate in alone] == [fate.delay_ns for fate in both]
    lost = [fate.lost for fate in fates("loss(0.3)")]
    assert lost == [fate.lost for fate in both]
    assert lost == [fate.lost for fate in fates("corrupt(0.3) & loss(0.3) & duplicate(0.3)")]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gama(1)", "got 'gama(1)', expected an impairment; did you mean gamma?"),
        ("loss", "got 'loss', expected loss(share) with 0 <= share <= 1"),
        ("loss(2)", "got 'loss(2)', expected loss(share) with 0 <= share <= 1"),
        ("loss(nan)", "got 'loss(nan)', expected loss(share) with"),
        ("loss(0.1, 0.2)", "expected loss(share) with"),
        ("loss(0.1, share=0.2)", "expected loss(share) with"),
        ("loss(lost=0.1)", "expected loss(share) with"),
        ("loss(0.1) &", "expected impairments such as"),
        ("loss(0.1) | loss(0.2)", "expected impairments such as"),
        ("loss((0.1))", "expected impairments such as"),
        ("uniform(0.3, 0.1)", "expected high_s to be at least low_s = 0.3"),
        ("gamma(0.2, 0.1, 0.1)", "expected mean_s to be at least least_s = 0.2"),
        ("gamma(0, 0.1, 10)", "expected sd_s of 0, or of a hundredth"),
        ("outage(0, 2, 1)", "expected every_s of 0, or of more than for_s = 2"),
        ("rate(1000, queue=1.5)", "1 <= queue <= 67108864 (whole)"),
        ("rate(1000, drop=head)", "drop tail or codel"),
        ("rate(1000) & rate(2000)", "expected one rate or deliveries in a direction"),
        (" & ".join(["loss(0.1)"] * 17), "expected at most 16 impairments"),
    ],
)
def test_a_wrong_text_is_told_in_a_line(text: str, said: str) -> None:
    with pytest.raises(GrammarError) as raised:
        impairments(text)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


@given(st.text("()&,=.\"' -0123456789alosrtequnif_\n", max_size=60))
def test_no_text_does_anything_but_be_refused(text: str) -> None:
    with suppress(GrammarError):
        impairments(text)


def test_arguments_may_have_names_and_defaults() -> None:
    expected = [Call("rate", (12500.0, 20000, "codel", "fair"))]
    assert IMPAIRMENTS.calls("rate(12500, queue=20000, serve=fair, drop=codel)") == expected
    assert IMPAIRMENTS.calls("rate(12500,20000,codel,fair)") == expected
    assert IMPAIRMENTS.calls("gilbert_elliott( share=.1 ,burst_s = 2)")[0].values == (
        0.1,
        2,
        1.0,
        0.0,
    )


def test_files_are_found_beside_the_scenario(tmp_path: Any) -> None:
    assert IMPAIRMENTS.with_files("trace(a.csv) & loss(0.1)", lambda file: f"/x/{file}") == (
        'trace("/x/a.csv", loop, auto) & loss(0.1)'
    )
    assert IMPAIRMENTS.with_files("loss(0.1)", lambda file: f"/x/{file}") == "loss(0.1)"
    (tmp_path / "a, b (c).csv").write_text("time_s,delay_s\n0,0.1\n1,0.2\n")
    (tmp_path / "mine.toml").write_text(
        "extends = 'demo'\nnetwork.uplink = 'trace(\"a, b (c).csv\")'\n"
        "network.downlink = 'loss(0.5)'\n"
    )
    found = reading.load(str(tmp_path / "mine.toml"))
    assert found.uplink.mean_s == pytest.approx(0.15)
    assert found.downlink.loss == 0.5


def test_a_text_replaces_that_below_and_an_argument_changes_it(tmp_path: Any) -> None:
    (tmp_path / "lossy.toml").write_text("extends = 'demo'\nnetwork.uplink.loss = 0.3\n")
    assert reading.load(str(tmp_path / "lossy.toml")).network.uplink == (
        "paper(0.4, 0.02, 2.0) & loss(0.3)"
    )
    above = tmp_path / "above.toml"
    above.write_text("extends = 'lossy.toml'\nnetwork.uplink = 'constant(0.1)'\n")
    assert reading.load(str(above)).network.uplink == "constant(0.1)"
    above.write_text("extends = '5g-urban'\nnetwork.uplink.loss = 0.3\n")
    with pytest.raises(ConfigError, match=r"network\.uplink\.loss: .* expected a text with loss"):
        reading.load(str(above))
    again = reading.check(reading.to_table(reading.load("5g-urban")))
    assert again == reading.load("5g-urban")
