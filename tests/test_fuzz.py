"""`fuzz`: whatever a peer sends, no endpoint raises; what was found once stays mended."""

from itertools import islice
from random import Random

import numpy as np
import pytest

from fuzz.mutators import corpus, hostile, seeds
from fuzz.targets import SCENARIOS, InFlight, Target, decoder, targets
from shared import protocol
from shared.config import Scenario
from shared.protocol import decode

TARGETS = targets()
BY_AXES = pytest.mark.parametrize("scenario", SCENARIOS, ids=["2-D", "3-D"])


def attack(target: Target, known: list[bytes], count: int) -> None:
    """Give a target so many payloads."""
    for payload in islice(hostile(Random(1), known, {}), count):
        target(payload)


@pytest.mark.parametrize("name", TARGETS)
def test_every_payload_of_the_corpus_is_survived(name: str) -> None:
    """Odd ones, and a message of each type, with terms of either scenario."""
    messages = [seed for scenario in SCENARIOS for seed in seeds(scenario.terms())]
    for payload in (*corpus().values(), *messages):
        TARGETS[name](payload)


@BY_AXES
def test_seeds_are_messages_of_every_type(scenario: Scenario) -> None:
    """Each is decoded with its own terms."""
    terms = scenario.terms()
    found = {type(decode(seed, terms)) for seed in seeds(terms)}
    assert found == {message for message, _ in protocol._TYPES}


@BY_AXES
def test_a_hundred_thousand_payloads_do_not_break_the_decoder(scenario: Scenario) -> None:
    """Together with the other scenario; `make fuzz` and `python -m fuzz` give it more."""
    attack(decoder(scenario), [*corpus().values(), *seeds(scenario.terms())], 50_000)


@BY_AXES
def test_a_flight_goes_on_whatever_is_said_to_both_ends(scenario: Scenario) -> None:
    """Payloads reach past the decoder, into session and plausibility, and bounds hold."""
    flight = InFlight(scenario)
    known = [*corpus().values(), *seeds(scenario.terms())]
    for payload in islice(hostile(Random(1), known, flight.newest), 8_000):
        flight(payload)
    dropped = " ".join((*flight.server.counts, *flight.client.counts))
    for reason in ("implausible", "unknown session", "from the future", "for another life"):
        assert reason in dropped
    assert flight.client.figures()["step"] > 20


def test_a_decoder_that_does_not_look_at_shapes_is_found_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is no array, or one of another shape, then raises something else than it may."""
    monkeypatch.setattr(
        protocol,
        "_array",
        lambda value, dtype, axes, _: np.frombuffer(value, dtype).reshape(axes, -1),
    )
    for scenario in SCENARIOS:
        with pytest.raises((TypeError, ValueError)):
            attack(decoder(scenario), seeds(scenario.terms()), 5_000)
