"""Suggestion of the name that a user may have meant."""

from collections.abc import Iterable


def hint(given: str, names: Iterable[str]) -> str:
    """Suggestion of the most similar valid name; if none is similar, a list of all names."""
    import difflib  # imported only after a user's mistake

    close = difflib.get_close_matches(given, names, n=1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(names)}"


GIVEN_MAX = 200
"""Largest number of characters of a value that a message repeats."""


def short(given: str) -> str:
    return given if len(given) <= GIVEN_MAX else f"{given[:GIVEN_MAX]}…"
