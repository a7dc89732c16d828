"""Log of the autopilot's status texts, without repeats and at a limited rate."""

from skytether.mavlink.codec import Message
from skytether.mavlink.text import Texts
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.aboard import AutopilotText, TextsOmitted

SAME_TEXT_NS = 30 * SECOND_NS
"""Time for which a text is not logged again."""
TEXTS_KEPT = 16
"""Number of texts remembered, and largest number logged at once."""
TEXT_NS = 2 * SECOND_NS
"""Interval after which one more text may be logged."""


class LoggedTexts:
    def __init__(self, vehicle: int, events: Events) -> None:
        self._vehicle, self._events = vehicle, events
        self._texts = Texts()
        self._logged_ns: dict[str, int] = {}
        self._left, self._left_ns = TEXTS_KEPT, 0
        """Number of texts that may be logged now, and the time of its newest increase [ns]."""
        self._omitted = 0
        """Number of texts not logged since the last report of this number."""

    def hear(self, message: Message, *, now_ns: int) -> str:
        """Log the text that a STATUSTEXT completes; return the text, empty if none is complete."""
        text = _printable(self._texts.take(message) or "")
        if not text or self._is_known(text, now_ns):
            return text
        if self._left:
            self._left -= 1
            severity = message.severity
            logged = AutopilotText(vehicle=self._vehicle, text=text, severity=severity)
            self._events.append(logged)
        else:
            self._omitted += 1
        return text

    def _is_known(self, text: str, now_ns: int) -> bool:
        """Whether the text was logged or omitted within SAME_TEXT_NS; stores a new text."""
        logged_ns = self._logged_ns.pop(text, None)
        if logged_ns is not None and now_ns - logged_ns < SAME_TEXT_NS:
            self._logged_ns[text] = logged_ns
            return True
        self._logged_ns[text] = now_ns
        if len(self._logged_ns) > TEXTS_KEPT:
            del self._logged_ns[next(iter(self._logged_ns))]
        return False

    def tick(self, *, now_ns: int) -> None:
        """Allow one more text each TEXT_NS, and report how many texts were left out."""
        if now_ns - self._left_ns < TEXT_NS:
            return
        self._left_ns, self._left = now_ns, min(self._left + 1, TEXTS_KEPT)
        if self._omitted:
            self._events.append(TextsOmitted(vehicle=self._vehicle, count=self._omitted))
            self._omitted = 0


def _printable(text: str) -> str:
    """Text with ? for control characters, without white space at its end (PX4 sends tabs)."""
    return "".join(letter if letter.isprintable() else "?" for letter in text.rstrip())
