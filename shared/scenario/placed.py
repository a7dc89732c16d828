"""Check for contradictions in shapes that are given by points, by a file, or by goals."""

from collections.abc import Iterator
from itertools import pairwise

from skytether.shared.scenario.rooms import FROM_FILE
from skytether.shared.scenario.schema import Contradiction, Scenario


def contradictions(scenario: Scenario) -> Iterator[Contradiction]:
    ref, axes = scenario.reference, scenario.model.axes
    least = {"waypoints": 2, "hover": 1}.get(ref.shape, 0)
    if len(ref.points_m) < least:
        yield "reference.points_m", list(ref.points_m), f"at least {least} with shape {ref.shape!r}"
    for point in ref.points_m:
        if len(point) != axes:
            yield "reference.points_m", list(point), f"{axes} numbers a point"
    if ref.shape.partition("(")[0].strip() == "sphere" and axes != 3:
        yield "model.axes", axes, "3 with the shape sphere"
    route = ref.points_m + ref.points_m[:1] * ref.loop
    if ref.shape == "waypoints" and any(here == there for here, there in pairwise(route)):
        yield "reference.points_m", [list(point) for point in route], "no point twice in a row"
    elif ref.shape in ("waypoints", *FROM_FILE):
        try:
            scenario.unallocated_reference()
        except ValueError as error:
            if ref.shape in FROM_FILE:
                yield "reference.file", repr(ref.file), f"a table of the trajectory ({error})"
            else:
                points = [list(point) for point in route]
                yield "reference.points_m", points, "points that are further apart"
