"""Texts of the autopilot that are logged: each once in a while, and no more than a log can take."""

from skytether.mavlink.codec import Message
from skytether.mavlink.text import Texts
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.aboard import AutopilotText, TextsOmitted
from skytether.shared.core.endpoint import Events

SAME_TEXT_NS = 30 * SECOND_NS
"""Time for which a text is not logged again [ns]."""
TEXTS_KEPT = 16
"""Texts that are remembered, and most texts that are logged at once."""
TEXT_NS = 2 * SECOND_NS
"""Time after which one more may be logged [ns]."""


class LoggedTexts:
    """Log of one autopilot's texts.

    Args:
        vehicle: number of the vehicle, for what is told.
        events: takes what is told.
    """

    def __init__(self, vehicle: int, events: Events) -> None:
        self._vehicle, self._events = vehicle, events
        self._texts = Texts()
        self._told_ns: dict[str, int] = {}
        """Texts that were logged, and when."""
        self._left, self._left_ns = TEXTS_KEPT, 0
        """Texts that may be logged now, and time at which that number last changed."""
        self._omitted = 0
        """Texts that were not logged, and not counted in the log either."""

    def hear(self, message: Message, *, now_ns: int) -> str:
        """Log the text that a STATUSTEXT completes; returns it, empty where there is none."""
        text = _printable(self._texts.take(message) or "")
        if not text or self._is_known(text, now_ns):
            return text
        if self._left:
            self._left -= 1
            severity = message.severity
            said = AutopilotText(vehicle=self._vehicle, text=text, severity=severity)
            self._events.append(said)
        else:
            self._omitted += 1
        return text

    def _is_known(self, text: str, now_ns: int) -> bool:
        """Whether a text came before within SAME_TEXT_NS; it is remembered."""
        told_ns = self._told_ns.pop(text, None)
        if told_ns is not None and now_ns - told_ns < SAME_TEXT_NS:
            self._told_ns[text] = told_ns
            return True
        self._told_ns[text] = now_ns
        if len(self._told_ns) > TEXTS_KEPT:
            del self._told_ns[next(iter(self._told_ns))]
        return False

    def tick(self, *, now_ns: int) -> None:
        """Allow one more text each TEXT_NS, and say how many were left out."""
        if now_ns - self._left_ns < TEXT_NS:
            return
        self._left_ns, self._left = now_ns, min(self._left + 1, TEXTS_KEPT)
        if self._omitted:
            self._events.append(TextsOmitted(vehicle=self._vehicle, count=self._omitted))
            self._omitted = 0


def _printable(text: str) -> str:
    """Text without what a terminal would act on; PX4 ends some texts with a tabulator."""
    return "".join(letter if letter.isprintable() else "?" for letter in text.rstrip())
