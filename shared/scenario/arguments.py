"""Reading and changing arguments of a text's entries by name."""

from typing import Any

from skytether.shared.scenario import grammar
from skytether.shared.scenario.grammar import Call, GrammarError, Value
from skytether.shared.scenario.registry import PluginTable


def with_argument(table: PluginTable, text: str, at: str, value: object) -> str:
    """Text with one argument of an entry changed.

    Args:
        table: table of the entries.
        text: entries combined with & and |.
        at: `entry.parameter`, or `entry` for its first parameter.
        value: new value.

    Raises:
        KeyError: there is no such entry, or it has no such parameter.
        GrammarError: the text does not name the entry, or is invalid.
    """
    calls, index = _argument(table, text, at)
    for call in reversed(calls):
        values: list[Any] = list(call.values)
        values[index] = value
        text = table.with_values(text, call, values)
    return text


def argument(table: PluginTable, text: str, at: str) -> Value:
    """Value of the argument `at` in its entry's first call in a text; see `with_argument`."""
    calls, index = _argument(table, text, at)
    return calls[0].values[index]


def _argument(table: PluginTable, text: str, at: str) -> tuple[list[Call], int]:
    """Calls in `text` of the entry that `at` names, and the index of the parameter in it."""
    name, _, key = at.partition(".")
    names = [parameter.name for parameter in table[name].parameters]
    if not names or (key and key not in names):
        raise KeyError(at)
    calls = [each for each in grammar.leaves(table.parse(text)) if each.name == name]
    if not calls:
        raise GrammarError(text, f"a text with {name}")
    return calls, names.index(key) if key else 0
