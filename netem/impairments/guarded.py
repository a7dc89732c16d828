"""Guard against errors of plug-ins: an impairment that fails has no effect."""

import traceback
from collections.abc import Iterable
from dataclasses import replace

from skytether.netem.impairments.draws import Draws, Fate
from skytether.netem.impairments.impairment import Impairment
from skytether.shared.base.units import SECOND_NS

DELAY_MAX_NS = 86_400 * SECOND_NS
"""Largest delay that a plug-in may set [ns]."""
COPIES_MAX = 100
"""Largest number of copies that a plug-in may set."""


def fate_of(fate: Fate, impairments: Iterable[tuple[Impairment, Draws]]) -> tuple[Fate, str]:
    """Fate of a packet after all impairments, and the traceback of the first error, or empty."""
    fault = ""
    for impairment, draws in impairments:
        # Each impairment changes a copy, so that one which fails half-way has no effect.
        tried = replace(fate)
        try:
            impairment(tried, draws)
            fate = _possible(tried)
        except Exception:
            fault = fault or traceback.format_exc()
    return fate, fault


def _possible(fate: Fate) -> Fate:
    """Fate after a plug-in, with its numbers converted to integers.

    Raises:
        ValueError, TypeError: the fate contains an impossible value.
    """
    if not 0 <= fate.delay_ns <= DELAY_MAX_NS:
        raise ValueError(f"got delay_ns = {fate.delay_ns}, expected 0 to {DELAY_MAX_NS}")
    if not 0 <= fate.copies <= COPIES_MAX:
        raise ValueError(f"got copies = {fate.copies}, expected 0 to {COPIES_MAX}")
    if fate.flipped is not None and not 0.0 <= fate.flipped < 1.0:
        raise ValueError(f"got flipped = {fate.flipped}, expected a share below 1")
    # A plug-in may set floats, but the link adds and compares integer nanoseconds.
    return replace(fate, delay_ns=int(fate.delay_ns), copies=int(fate.copies))
