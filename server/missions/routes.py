"""Ways around zones: the shortest line from a place to a goal that keeps its distance from them.

The nodes of a visibility graph stand off the corners of zones; two that see each other are joined
by the straight line between them. Shortest ways between all of them are found once (Floyd and
Warshall). Ways are level: zones wholly above or below a vehicle and its goal are in no way.
"""

from functools import lru_cache

import numpy as np

from skytether.server.missions.zone_clearance import are_clear
from skytether.shared.law.model import Array, Flags
from skytether.shared.scenario.zones import Zones

NODES_MAX = 200
"""Largest number of nodes; the corners of zones with more are left out, the sharpest last."""
OFF_M = 0.1
"""Distance of nodes from corners beyond that which is kept [m]."""
GRAPHS_MAX = 64
"""Largest number of graphs that are kept, each of the zones at some heights."""
TINY_M = 1e-6
"""Rounding tolerance."""


class Routes:
    """Ways around zones.

    Args:
        zones: what is in the way.
        clearance_m: distance that a way keeps from them [m].
    """

    def __init__(self, zones: Zones, clearance_m: float) -> None:
        self._zones, self._clearance_m = zones, clearance_m
        self._graph = lru_cache(GRAPHS_MAX)(self._make)

    def way(self, place: Array, goal: Array) -> Array:
        """The shortest way: its corners, and the goal behind them; that alone where there is none.

        Args:
            place, goal: shape (axes,).

        Returns:
            shape (n, axes); n >= 1.
        """
        if not self._zones:
            return goal[None]
        corners = self._graph(self._heights(place, goal)).corners(place[:2], goal[:2])
        points = np.repeat(goal[None], len(corners) + 1, axis=0)
        points[:-1, :2] = corners
        return points

    def reaches(self, place: Array, goal: Array) -> bool:
        """Whether there is a way; shapes (axes,)."""
        graph = self._graph(self._heights(place, goal))
        return bool(graph.sees(place[None, :2], self.way(place, goal)[:1, :2])[0])

    def _heights(self, place: Array, goal: Array) -> tuple[bool, ...]:
        """Flags of the zones at heights between those of two places."""
        if len(place) < 3:
            return (True,) * len(self._zones.zones)
        low, high = sorted((float(place[2]), float(goal[2])))
        clearance_m = self._clearance_m
        return tuple(
            zone.is_fence or (zone.low_m - clearance_m < high and low < zone.high_m + clearance_m)
            for zone in self._zones.zones
        )

    def _make(self, heights: tuple[bool, ...]) -> "Graph":
        there = zip(self._zones.zones, heights, strict=True)
        level = [
            zone._replace(low_m=-np.inf, high_m=np.inf) for zone, is_there in there if is_there
        ]
        return Graph(Zones(level), self._clearance_m)


class Graph:
    """Visibility graph in the plane.

    Args:
        zones: what is in the way, of any height.
        clearance_m: distance that a way keeps from them [m].
    """

    def __init__(self, zones: Zones, clearance_m: float) -> None:
        self._zones, self._clearance_m = zones, clearance_m
        self._nodes = _nodes(zones, clearance_m + OFF_M)
        if len(self._nodes):
            clear = zones.clearance(self._nodes).min(axis=1) >= clearance_m
            self._nodes = self._nodes[clear][:NODES_MAX]
        n = len(self._nodes)
        here, there = np.triu_indices(n, 1)
        far = np.full((n, n), np.inf)
        np.fill_diagonal(far, 0.0)
        if n > 1:
            sees = self.sees(self._nodes[here], self._nodes[there])
            here, there = here[sees], there[sees]
            far[here, there] = np.linalg.norm(self._nodes[here] - self._nodes[there], axis=1)
            far[there, here] = far[here, there]
        after = np.where(np.isfinite(far), np.arange(n), -1)
        for via in range(n):
            longer = far > far[:, [via]] + far[[via]]
            far = np.where(longer, far[:, [via]] + far[[via]], far)
            after = np.where(longer, after[:, [via]], after)
        self._far, self._after = far, after
        """Length of the shortest way between two nodes, infinite without one [m], and the node that
        comes next on it."""

    def corners(self, place: Array, goal: Array) -> Array:
        """Corners of the shortest way between two places; none where there is no way."""
        here, there, nodes = place[None], goal[None], self._nodes
        if not len(nodes) or self.sees(here, there)[0]:
            return nodes[:0]
        long = self._lengths(here)[:, None] + self._far + self._lengths(there)
        via, at = np.unravel_index(int(long.argmin()), long.shape)
        if not np.isfinite(long[via, at]):
            return nodes[:0]
        path = [int(via)]
        while path[-1] != at:
            path.append(int(self._after[path[-1], at]))
        return nodes[path]

    def sees(self, here: Array, there: Array) -> Flags:
        """Whether straight lines keep their distance; shape (n,), of two of shape (n, 2)."""
        return are_clear(self._zones, here, there, self._clearance_m - TINY_M)

    def _lengths(self, here: Array) -> Array:
        """Distances of nodes from a place, infinite of those that it does not see; shape (n,)."""
        nodes = self._nodes
        sees = self.sees(np.repeat(here, len(nodes), axis=0), nodes)
        return np.where(sees, np.linalg.norm(nodes - here, axis=1), np.inf)


def _nodes(zones: Zones, off_m: float) -> Array:
    """Places off the corners of zones, outward on the line that halves each [m]; shape (n, 2)."""
    points = [np.zeros((0, 2))]
    for zone in zones.zones:
        corners = zone.corners
        after, before = (
            np.roll(corners, -1, axis=0) - corners,
            np.roll(corners, 1, axis=0) - corners,
        )
        after /= np.maximum(np.linalg.norm(after, axis=1, keepdims=True), 1e-9)
        before /= np.maximum(np.linalg.norm(before, axis=1, keepdims=True), 1e-9)
        halves = after + before
        size = np.linalg.norm(halves, axis=1, keepdims=True)
        straight = size[:, 0] < 1e-6
        halves[straight] = np.stack([-after[straight, 1], after[straight, 0]], axis=1)
        size[straight] = 1.0
        # Both ways: one of them is where vehicles may be.
        points += [corners - sign * off_m * halves / size for sign in (1.0, -1.0)]
    return np.concatenate(points)
