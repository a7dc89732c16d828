"""Texts of triggers: parsed, or refused in one line; never executed."""

import string
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import helpers
from skytether.shared.scenario import reading
from skytether.shared.scenario.grammar import (
    TEXT_MAX,
    Call,
    Combination,
    Expression,
    GrammarError,
    leaves,
)
from skytether.shared.scenario.registry import TRIGGERS

FORM = "policies such as 'state_gap & budget(5, 2) | silence(1)'"
STATE_GAP, ALWAYS = Call("state_gap", (3.6, 1.5)), Call("always")
BUDGET, SILENCE = Call("budget", (5, 2)), Call("silence", (0.5,))

READ = {
    "state_gap": STATE_GAP,
    " state_gap()\n": STATE_GAP,
    "((state_gap))": STATE_GAP,
    "budget(5, 2)": BUDGET,
    "silence( 5e-1 )": SILENCE,
    "state_gap(.5, 2.)": Call("state_gap", (0.5, 2.0)),
    "state_gap(decay_rate=2, epsilon = .5)": Call("state_gap", (0.5, 2.0)),
    "state_gap(4)": Call("state_gap", (4, 1.5)),
    "state_gap & always": Combination("&", STATE_GAP, ALWAYS),
    "state_gap|\n always": Combination("|", STATE_GAP, ALWAYS),
    # & binds tighter than |, and both from the left.
    "state_gap & budget(5, 2) | silence(0.5)": Combination(
        "|", Combination("&", STATE_GAP, BUDGET), SILENCE
    ),
    "silence(0.5) | state_gap & budget(5, 2)": Combination(
        "|", SILENCE, Combination("&", STATE_GAP, BUDGET)
    ),
    "(silence(0.5) | state_gap) & budget(5, 2)": Combination(
        "&", Combination("|", SILENCE, STATE_GAP), BUDGET
    ),
    "state_gap | always | state_gap": Combination(
        "|", Combination("|", STATE_GAP, ALWAYS), STATE_GAP
    ),
}

PERIODIC = "periodic(N=10) with 1 <= N <= 1000000 (whole)"
BOUNDED = "budget(packets_per_s, burst) with 0.001 <= packets_per_s <= 1000000 and "
BOUNDED += "1 <= burst <= 1000000"
GAP = "state_gap(epsilon=3.6, decay_rate=1.5) with 0 <= epsilon and 0 <= decay_rate"
REFUSED = {
    # No expression of policies.
    "": ("", FORM),
    "state_gap &": ("state_gap &", FORM),
    "(state_gap": ("(state_gap", FORM),
    "state_gap always": ("state_gap always", FORM),
    "state_gap and always": ("state_gap and always", FORM),
    "always & (not state_gap)": ("always & (not state_gap)", FORM),
    "always & (lambda: state_gap)": ("always & (lambda: state_gap)", FORM),
    "state_gap - 3": ("state_gap - 3", FORM),
    "state_gap -3": ("state_gap -3", FORM),
    "3": ("3", FORM),
    "None": ("None", f"a policy; there are {', '.join(TRIGGERS)}"),
    "(state_gap, always)": ("(state_gap, always)", FORM),
    "state_gap(1, 2)(3)": ("state_gap(1, 2)(3)", FORM),
    "1or 2": ("1or 2", FORM),
    "state_gap.test": ("state_gap.test", FORM),
    "state_gap[0]": ("state_gap[0]", FORM),
    "state_gap # always": ("state_gap # always", FORM),
    "state_gap(*always)": ("state_gap(*always)", GAP),
    "\N{FULLWIDTH LATIN SMALL LETTER P}aper": ("\N{FULLWIDTH LATIN SMALL LETTER P}aper", FORM),
    # No such policy.
    "perodic(3)": ("perodic(3)", "a policy; did you mean periodic?"),
    "state_gap | cost_gab": ("cost_gab", "a policy; did you mean cost_gap?"),
    "print(1)": (
        "print(1)",
        f"a policy; there are {', '.join(TRIGGERS)}",
    ),
    # Not its arguments.
    "always(1)": ("always(1)", "always"),
    "periodic(3, 4)": ("periodic(3, 4)", PERIODIC),
    "periodic(0)": ("periodic(0)", PERIODIC),
    "periodic(2.5)": ("periodic(2.5)", PERIODIC),
    "periodic(True)": ("periodic(True)", PERIODIC),
    "periodic(1000001)": ("periodic(1000001)", PERIODIC),
    "periodic(state_gap)": ("periodic(state_gap)", PERIODIC),
    "state_gap & budget": ("budget", BOUNDED),
    "budget(5)": ("budget(5)", BOUNDED),
    "budget(0, 2)": ("budget(0, 2)", BOUNDED),
    "budget(5, 0.9)": ("budget(5, 0.9)", BOUNDED),
    "silence()": ("silence()", "silence(seconds) with 0.001 <= seconds <= 3600"),
    "cost_gap(-1)": ("cost_gap(-1)", "cost_gap(c=0.05) with 0 <= c"),
    "deviation(1e999)": ("deviation(1e999)", "deviation(metres=0.05) with 0 <= metres"),
    "state_gap(1, epsilon=2)": ("state_gap(1, epsilon=2)", GAP),
    "state_gap(lambda=2)": ("state_gap(lambda=2)", GAP),
}
"""Invalid texts, each with the part that is named as wrong and the expected form."""


def refusal(text: str) -> str:
    return helpers.refusal(lambda: reading.check({"control": {"trigger": text}}, "mine"))


@pytest.mark.parametrize(("text", "read"), READ.items(), ids=READ)
def test_what_is_written_is_read(text: str, read: Expression) -> None:
    assert TRIGGERS.parse(text) == read
    control = {"scheme": "committed", "trigger": text}
    assert reading.check({"control": control}, "mine").control.trigger == text


@pytest.mark.parametrize(("text", "said"), REFUSED.items(), ids=REFUSED)
def test_what_is_no_trigger_is_refused_in_one_line(text: str, said: tuple[str, str]) -> None:
    assert refusal(text) == f"mine: control.trigger: got {said[0]!r}, expected {said[1]}"


def test_the_longest_trigger_is_read_and_a_longer_one_refused() -> None:
    deep = "(" * 97 + "always" + ")" * 97
    assert len(deep) == TEXT_MAX
    assert TRIGGERS.parse(deep) == ALWAYS
    assert refusal(deep + " ").endswith(", expected a text of length <= 200")
    longest = " | ".join(["state_gap"] * 16)
    assert list(leaves(TRIGGERS.parse(longest))) == [STATE_GAP] * 16


@pytest.mark.parametrize(
    ("name", "needed", "given"),
    [
        ("cost_gap", "'committed' or 'trajectory'", "predictive"),
        ("deviation", "'committed' or 'trajectory'", "none"),
        ("expected_gap", "'committed' or 'trajectory'", "predictive"),
        ("state_gap", "'committed' or 'predictive' or 'none'", "trajectory"),
    ],
)
def test_what_is_compared_needs_a_scheme_that_has_it(name: str, needed: str, given: str) -> None:
    text = f"silence(1) | {name} & budget(5, 2)"
    control: dict[str, Any] = {"trigger": text, "scheme": given, "feedback": given != "none"}
    said = helpers.refusal(lambda: reading.check({"control": control}, "mine"))
    assert said == f"mine: control.scheme: got {given!r}, expected {needed} with the trigger {name}"
    for scheme in needed.replace("'", "").split(" or "):
        feedback = scheme == "trajectory"
        reading.check({"control": control | {"scheme": scheme, "feedback": feedback}}, "mine")


words = st.sampled_from(
    [
        *TRIGGERS,
        *" &|(),.-",
        "1",
        "0.5",
        "7e",
        "1_0",
        "0x1",
        "lambda",
        "if",
        "else",
        "None",
        "f()",
    ]
)


@settings(max_examples=100)
@given(
    st.text(max_size=60)
    | st.text(string.printable, max_size=60)
    | st.lists(words, max_size=40).map("".join)
    | st.lists(words, max_size=40).map(" ".join)
)
@example("(" * 200)
@example("state_gap(" * 33)
@example("-" * 200)
@example("always\0")
@example("\ud800")
@example("[" * 100 + "]" * 100)
def test_whatever_is_written_is_a_trigger_or_refused(text: str) -> None:
    said, found = "", []
    try:
        found = list(leaves(TRIGGERS.parse(text)))
        reading.check({"control": {"trigger": text, "scheme": "committed"}}, "mine")
    except GrammarError:
        said = refusal(text)
        assert said.startswith("mine: control.trigger: got ")
    assert bool(said) or found
    assert len(said.splitlines()) == bool(said)
    assert all(TRIGGERS[one.name].bound(one) == one.values for one in found)


def test_nothing_written_is_ever_run() -> None:
    assert "there are always" in refusal("exit(1)")
    assert refusal("__import__('os')._exit(1)").endswith(FORM)


trees = st.recursive(
    st.sampled_from([STATE_GAP, ALWAYS, BUDGET, SILENCE]),
    lambda tree: st.builds(Combination, st.sampled_from("&|"), tree, tree),
    max_leaves=5,
)


def written(tree: Expression) -> str:
    if isinstance(tree, Call):
        values = ", ".join(map(repr, tree.values))
        return f"{tree.name}({values})"
    return f"({written(tree.left)} {tree.operator} {written(tree.right)})"


@settings(max_examples=40)
@given(trees)
def test_every_combination_can_be_written(tree: Expression) -> None:
    assert TRIGGERS.parse(written(tree)) == tree
