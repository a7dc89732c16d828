"""Table of equations: the page has what the code says, and a wrong source is refused."""

from pathlib import Path

import pytest

from skytether.lab import equations

PAGE = Path(__file__).parents[2] / "docs" / "paper.md"


def test_the_committed_table_is_the_codes() -> None:
    """`make equations` would change nothing."""
    page = PAGE.read_text()
    message = "docs/paper.md is out of date: run `make equations`"
    assert page == equations.refreshed(page), message


def test_every_equation_of_the_paper_is_there() -> None:
    """(1) to (17), and both algorithms, in the order of the paper."""
    numbers = [f"({number})" for number in range(1, 18)]
    assert list(equations.EQUATIONS) == [*numbers, "Algorithm 1", "Algorithm 2"]


def test_a_source_has_its_place_and_its_equations() -> None:
    """A function, a method and a class are found under their names."""
    found = {(each.file, each.name): each.equations for each in equations.sources()}
    assert found["shared/law/model.py", "advance"] == ("(4)",)
    assert found["client/compensator.py", "Compensator.choose"] == ("(11)",)
    assert found["shared/scenario/triggers.py", "StateGap"] == ("(16)",)


@pytest.mark.parametrize(
    ("docstring", "named"),
    [
        ("Promise.", ()),
        ("Promise.\n\nSource: eq. (4).", ("(4)",)),
        ("Promise.\n\nSource: eqs. (14), (15).", ("(14)", "(15)")),
        ("Promise.\n\nSource: algorithms 1, 2.", ("Algorithm 1", "Algorithm 2")),
    ],
)
def test_the_source_is_the_last_line(docstring: str, named: tuple[str, ...]) -> None:
    """One number, several, or an algorithm."""
    assert equations.named(docstring) == named


@pytest.mark.parametrize(
    "docstring",
    [
        "Promise.\n\nSource: eq. (4)",
        "Promise.\n\nSource: eq. 4.",
        "Promise.\n\nSource: eq. (4), (5).",
        "Promise.\n\nSource: eq. (4).\n\nMore.",
        "Promise. Source: eq. (4).",
    ],
)
def test_a_source_in_another_form_is_refused(docstring: str) -> None:
    """Only then can the table be complete."""
    with pytest.raises(ValueError, match="expected the form"):
        equations.named(docstring)


def test_an_equation_without_a_function_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The table has no empty row."""
    monkeypatch.setattr(equations, "EQUATIONS", {**equations.EQUATIONS, "(18)": "none"})
    with pytest.raises(ValueError, match=r"no function names \(18\)"):
        equations.table()


def test_an_equation_that_is_not_in_the_paper_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slip of the pen would else be left out in silence."""
    fewer = {key: text for key, text in equations.EQUATIONS.items() if key != "(12)"}
    monkeypatch.setattr(equations, "EQUATIONS", fewer)
    with pytest.raises(ValueError, match=r"the paper has no \(12\)"):
        list(equations.sources())


def test_a_page_without_marks_is_refused() -> None:
    """Nothing is overwritten that was not generated."""
    with pytest.raises(ValueError, match="expected the lines"):
        equations.refreshed("# A page\n")
