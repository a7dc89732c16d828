"""Suggestion of the name that a user may have meant."""

from collections.abc import Iterable


def hint(given: str, known: Iterable[str]) -> str:
    """Asks after the known name that is most like it; where none is, lists them."""
    import difflib  # for mistakes alone

    close = difflib.get_close_matches(given, known, n=1)
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
