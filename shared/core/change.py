"""Changes in flight: some keys of a scenario get other values while it is flown.

    values by key → may these change? → checked as a scenario is → `Endpoint.change` → `Changed`

All values of a request take effect together, between two steps of the endpoint, or none does. A
request is an object of JSON, values by key; one without keys asks which may change. The answer is
an `Answer`. `shell.control` has the socket that both pass through, and `sim.flight` makes the same
changes in virtual time.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import msgspec

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.core.endpoint import Endpoint
from skytether.shared.core.events import Changed, ChangeRefused, Event
from skytether.shared.scenario import reading
from skytether.shared.scenario.catalogue import keys_of
from skytether.shared.scenario.dotted import lay, value, whole
from skytether.shared.scenario.owners import InFlight
from skytether.shared.scenario.schema import Scenario

REQUEST_BYTES_MAX = 4096
"""Largest size of a request [B]."""
ONCE = keys_of(InFlight.LEAP)
"""Keys with which something is decided once: no later run of the process takes them up."""
KEY_SHOWN_MAX = 60
"""Largest number of characters that a message repeats of a key that there is not."""


class Answer(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to a request."""

    refused: str = ""
    """Why nothing was changed, in a line; empty where the request was heeded."""
    changed: tuple[Changed, ...] = ()
    """Keys that have another value now."""
    values: dict[str, Any] = {}
    """Keys that may change and their present values, where the request has none."""


class Running:
    """A scenario that an endpoint is flying, and may be changed in.

    Args:
        endpoint: what flies it.
        scenario: the scenario that the endpoint was made with.
        settings: values that were set in an earlier run, which it has.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        scenario: Scenario,
        settings: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self._endpoint = endpoint
        self._scenario = scenario
        self.settings = settings
        """All values that were set in flight, by key; another object after each change."""

    @property
    def scenario(self) -> Scenario:
        """The scenario with all that was changed so far."""
        return self._scenario

    @property
    def changeable(self) -> frozenset[str]:
        """Keys that may change."""
        return self._endpoint.changeable

    def change(self, values: Mapping[str, Any], *, now_ns: int) -> tuple[Changed, ...]:
        """Give keys other values, and say so in events of the endpoint.

        Args:
            values: plain values by key, as a scenario's file has them.
            now_ns: time on the endpoint's clock [ns].

        Returns:
            What has got another value.

        Raises:
            ConfigError: nothing was changed, as an event tells, too.
        """
        before = reading.to_table(self._scenario)
        try:
            values = self._whole(values)
            scenario = with_values(self._scenario, values)
            if said := self._endpoint.objection(scenario, frozenset(values)):
                raise ConfigError(said)
        except ConfigError as error:
            self.refuse(str(error))
            raise
        # Only now, when the whole scenario was checked: a change is made as a whole, or not at all.
        self._endpoint.change(scenario, frozenset(values), now_ns=now_ns)
        self._scenario, after = scenario, reading.to_table(scenario)
        lasting = {key: value for key, value in values.items() if key not in ONCE}
        if lasting:
            self.settings = {**self.settings, **lasting}
        changed = tuple(
            Changed(key=key, before=was, after=becomes)
            for key in values
            if (was := _text(value(before, key))) != (becomes := _text(value(after, key)))
        )
        for event in changed:
            self._endpoint.tell(event)
        return changed

    def tell(self, event: Event) -> None:
        """Report an event through the endpoint."""
        self._endpoint.tell(event)

    def refuse(self, reason: str) -> None:
        """Report through the endpoint that a change is refused."""
        self._endpoint.tell(ChangeRefused(reason=reason))

    def answer(self, request: bytes, *, now_ns: int) -> bytes:
        """Heed a request, whatever it is, and make the answer to it.

        Args:
            request: what has come, or as much of it as shows that it is too long.
            now_ns: time on the endpoint's clock [ns].
        """
        if len(request) > REQUEST_BYTES_MAX:
            return self._refusal(f"got more than {REQUEST_BYTES_MAX} B, expected a shorter request")
        try:
            values = _DECODER.decode(request)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return self._refusal("got no JSON object, expected values by key")
        if not values:
            table = reading.to_table(self._scenario)
            values = {key: value(table, key) for key in sorted(self.changeable)}
            return msgspec.json.encode(Answer(values=values))
        try:
            return msgspec.json.encode(Answer(changed=self.change(values, now_ns=now_ns)))
        except ConfigError as error:
            return msgspec.json.encode(Answer(refused=str(error)))

    def _refusal(self, reason: str) -> bytes:
        self.refuse(reason)
        return msgspec.json.encode(Answer(refused=reason))

    def _whole(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values of whole keys: arguments of a text become the text with them.

        Raises:
            ConfigError: a key may not change, or a text has no such argument.
        """
        may, table = sorted(self.changeable), reading.to_table(self._scenario)
        found: dict[str, Any] = {}
        for key, given in values.items():
            text = whole(key)
            if text in may:
                lay({key: given}, table)
                found[text] = value(table, text)
                continue
            try:
                value(table, text)
            except (KeyError, TypeError):
                shown = key[:KEY_SHOWN_MAX]
                # A request may come from anybody who can open the socket: no control characters
                # into the log.
                shown = shown if shown.isprintable() else repr(shown)
                raise ConfigError(f"{shown}: no such key; {hint(key, may)}") from None
            what = f"expected one of {', '.join(may)}"
            raise ConfigError(f"{key}: cannot be changed in flight; {what}")
        return found


def with_values(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """A scenario with other values laid over it.

    Args:
        scenario: with which nothing is wrong.
        values: plain values by key.

    Raises:
        ConfigError: there is no such key, or the scenario cannot be flown so.
    """
    laid = reading.to_table(scenario)
    lay(values, laid)
    try:
        return reading.check(laid, known=scenario)
    except RecursionError:
        raise ConfigError("got values that are nested too deeply") from None


_DECODER = msgspec.json.Decoder(dict[str, Any])


def _text(value: Any) -> str:
    """A value as a scenario's file has it."""
    return msgspec.json.encode(value).decode()
