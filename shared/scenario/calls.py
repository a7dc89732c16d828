"""Texts of a scenario such as `constant(0.05) & loss(0.1)`: names with what is in parentheses."""

import re
from collections.abc import Iterator

from skytether.shared.scenario.policies import PolicyError

QUOTED = r'"[^"]*"'
"""Pattern of an argument in quotes."""
_CALL = re.compile(
    rf"\s*([a-z_]\w*(?:-\w+)*)\s*(?:\(((?:{QUOTED}|[^()\"])*)\))?\s*", re.IGNORECASE | re.ASCII
)


def calls(text: str, form: str) -> Iterator[tuple[str, str | None]]:
    """Names between `&`, each with what stands in its parentheses, None without; none of "".

    Args:
        text: what is written.
        form: what is expected, in messages.

    Raises:
        PolicyError: it is none of that.
    """
    at = 0 if text.strip() else len(text) + 1
    while at <= len(text):
        found = _CALL.match(text, at)
        if not found or (found.end() < len(text) and text[found.end()] != "&"):
            raise PolicyError(text, form)
        yield found[1], found[2]
        at = found.end() + 1
