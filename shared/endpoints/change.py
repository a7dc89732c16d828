"""Changes in flight: new values for keys of a scenario while it is flown.

    values by key → may these change? → checked like a scenario → `Endpoint.change` → `Changed`

All values of a request take effect together, between two steps of the endpoint, or none does. A
request is a JSON object of values by key; an empty object requests the list of keys that may
change. The answer is an `Answer`. `shell.driving.control` has the socket for requests and answers,
and `sim.flight` makes the same changes in virtual time.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import msgspec

from skytether.shared.base.errors import ConfigError
from skytether.shared.base.hint import hint
from skytether.shared.endpoints import other_directions
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.flight import Changed, ChangeRefused, Event
from skytether.shared.scenario import reading
from skytether.shared.scenario.catalogue import DECISIONS
from skytether.shared.scenario.dotted import set_keys, text_key, value
from skytether.shared.scenario.whole import Scenario

REQUEST_BYTES_MAX = 4096
KEY_SHOWN_MAX = 60
"""Largest number of characters of an unknown key repeated in a message."""


class Answer(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    refused: str = ""
    """Reason why nothing was changed, in one line; empty if the request was carried out."""
    changed: tuple[Changed, ...] = ()
    values: dict[str, Any] = {}
    """Keys that may change and their present values, if the request was empty."""
    names: dict[str, str] = {}
    """Operator's names of keys in `values`, by key; see `endpoints.directions`."""


class Running:
    """Scenario that an endpoint flies, and changes of the scenario.

    Args:
        scenario: scenario that the endpoint was created with.
        settings: values of the scenario that were set in an earlier run.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        scenario: Scenario,
        settings: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.endpoint = endpoint
        self._names = other_directions.NAMES.get(endpoint.directions, {})
        self._scenario = scenario
        self.settings = settings
        """All values that were set in flight, by key; replaced by a new object at each change."""

    @property
    def scenario(self) -> Scenario:
        return self._scenario

    @property
    def changeable(self) -> frozenset[str]:
        return self.endpoint.changeable

    def change(self, values: Mapping[str, Any], *, now_ns: int) -> tuple[Changed, ...]:
        """Change the values of keys, and report the change by events of the endpoint.

        Args:
            values: plain values by key, as in a scenario's file; the endpoint's own names of its
                directions (`endpoints.directions`) are keys, too.
            now_ns: time on the endpoint's clock [ns].

        Returns:
            Keys whose value has changed.

        Raises:
            ConfigError: nothing was changed; an event reports the refusal, too.
        """
        before = reading.to_table(self._scenario)
        try:
            values = self._whole(values)
            scenario = with_values(self._scenario, values)
            if objection := self.endpoint.objection(scenario, frozenset(values)):
                raise ConfigError(objection)
        except ConfigError as error:
            reason = other_directions.named(str(error), self._names)
            self.refuse(reason)
            raise ConfigError(reason) from None
        # The endpoint changes after the check of the whole scenario: completely, or not at all.
        self.endpoint.change(scenario, frozenset(values), now_ns=now_ns)
        self._scenario, after = scenario, reading.to_table(scenario)
        lasting = {key: value for key, value in values.items() if key not in DECISIONS}
        if lasting:
            self.settings = {**self.settings, **lasting}
        changed = tuple(
            Changed(key=key, before=before_text, after=after_text, name=self._names.get(key, ""))
            for key in values
            if (before_text := _text(value(before, key)))
            != (after_text := _text(value(after, key)))
        )
        for event in changed:
            self.endpoint.tell(event)
        return changed

    def tell(self, event: Event) -> None:
        self.endpoint.tell(event)

    def refuse(self, reason: str) -> None:
        self.endpoint.tell(ChangeRefused(reason=reason))

    def answer(self, request: bytes, *, now_ns: int) -> bytes:
        """Carry out a request, valid or not, and return the encoded answer.

        Args:
            request: the request; if too long, at least its first REQUEST_BYTES_MAX + 1 bytes.
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
            return msgspec.json.encode(Answer(values=values, names=self._names))
        try:
            return msgspec.json.encode(Answer(changed=self.change(values, now_ns=now_ns)))
        except ConfigError as error:
            return msgspec.json.encode(Answer(refused=str(error)))

    def _refusal(self, reason: str) -> bytes:
        self.refuse(reason)
        return msgspec.json.encode(Answer(refused=reason))

    def _whole(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values by the scenario's keys. The value of a text's argument, such as
        `network.uplink.loss`, is inserted into the present text of its key.

        Raises:
            ConfigError: a key may not change, or a key's text has no such argument.
        """
        may, table = sorted(self.changeable), reading.to_table(self._scenario)
        keys = {name: key for key, name in self._names.items()}
        merged: dict[str, Any] = {}
        for name, given in values.items():
            head, dot, argument = name.partition(".")
            key = f"{keys[head]}{dot}{argument}" if head in keys else name
            text = text_key(key)
            if text in may:
                set_keys({key: given}, table)
                merged[text] = value(table, text)
                continue
            try:
                value(table, text)
            except (KeyError, TypeError):
                shown_key = key[:KEY_SHOWN_MAX]
                # Any process that can open the socket may send requests, so control characters
                # are escaped before they reach the log.
                shown_key = shown_key if shown_key.isprintable() else repr(shown_key)
                names = [self._names.get(each, each) for each in may]
                raise ConfigError(f"{shown_key}: no such key; {hint(key, names)}") from None
            what = f"expected one of {', '.join(may)}"
            raise ConfigError(f"{key}: cannot be changed in flight; {what}")
        return merged


def with_values(scenario: Scenario, values: Mapping[str, Any]) -> Scenario:
    """Scenario with some values replaced; `values` are plain values by key.

    Raises:
        ConfigError: a key is unknown, or the new scenario is invalid. A network too bad to fly is
            allowed.
    """
    table = reading.to_table(scenario)
    set_keys(values, table)
    try:
        return reading.check(table, checked=scenario, any_network=True)
    except RecursionError:
        raise ConfigError("got values that are nested too deeply") from None


_DECODER = msgspec.json.Decoder(dict[str, Any])


def _text(value: Any) -> str:
    return msgspec.json.encode(value).decode()
