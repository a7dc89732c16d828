"""Missions of QGroundControl plans, see `plans.route`."""

from skytether.shared.formats import Tracks, plans
from skytether.shared.formats.geographic import Origin


def tracks(content: bytes, axes: int, origin: Origin | None, _: float) -> Tracks:
    return {1: plans.route(content, axes, origin or ())}


def axes_of(_: bytes) -> int:
    return 3
