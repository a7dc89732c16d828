"""Missions of QGroundControl plans, see `plans.route`."""

from skytether.shared.scenario import plans
from skytether.shared.scenario.formats import Tracks
from skytether.shared.scenario.geographic import Origin


def tracks(content: bytes, axes: int, origin: Origin | None, _: float) -> Tracks:
    return {1: plans.route(content, axes, origin or ())}


def axes_of(_: bytes) -> int:
    return 3
