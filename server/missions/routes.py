"""Routes around zones: the shortest polyline from a position to a goal, at a distance from zones.

The nodes of a visibility graph lie near the corners of zones; two nodes are joined if the straight
line between them is clear. Shortest paths between all nodes are computed once (Floyd and Warshall).
Paths are horizontal: zones entirely above or below both position and goal are ignored.
"""

from functools import lru_cache

import numpy as np

from skytether.server.missions.zone_clearance import are_clear
from skytether.shared.law.model import Array, Flags
from skytether.shared.missions.zones import Zones

NODES_MAX = 200
"""Largest number of nodes; further nodes, at corners of the last zones, are ignored."""
OFF_M = 0.1
"""Distance of nodes from corners in addition to the clearance [m]."""
GRAPHS_MAX = 64
"""Largest number of cached graphs, one for each set of zones that matter at a height."""
TINY_M = 1e-6
"""Rounding tolerance [m]."""


class RoutesAroundZones:
    """Routes around zones, at a distance of `clearance_m`."""

    def __init__(self, zones: Zones, clearance_m: float) -> None:
        self._zones, self._clearance_m = zones, clearance_m
        self._graph = lru_cache(GRAPHS_MAX)(self._make)

    def way(self, place: Array, goal: Array) -> Array:
        """Corners of the shortest route, and then the goal [m]; only the goal if there is no route;
        shape (n, axes).
        """
        if not self._zones:
            return goal[None]
        corners = self._graph(self._heights(place, goal)).corners(place[:2], goal[:2])
        points = np.repeat(goal[None], len(corners) + 1, axis=0)
        points[:-1, :2] = corners
        return points

    def reaches(self, place: Array, goal: Array) -> bool:
        graph = self._graph(self._heights(place, goal))
        return bool(graph.sees(place[None, :2], self.way(place, goal)[:1, :2])[0])

    def _heights(self, place: Array, goal: Array) -> tuple[bool, ...]:
        if len(place) < 3:
            return (True,) * len(self._zones.zones)
        low, high = sorted((float(place[2]), float(goal[2])))
        clearance_m = self._clearance_m
        return tuple(
            zone.is_fence or (zone.low_m - clearance_m < high and low < zone.high_m + clearance_m)
            for zone in self._zones.zones
        )

    def _make(self, heights: tuple[bool, ...]) -> "Graph":
        flagged = zip(self._zones.zones, heights, strict=True)
        level = [
            zone._replace(low_m=-np.inf, high_m=np.inf)
            for zone, is_between in flagged
            if is_between
        ]
        return Graph(Zones(level), self._clearance_m)


class Graph:
    """Visibility graph in the plane, with a clearance from zones that are infinitely high."""

    def __init__(self, zones: Zones, clearance_m: float) -> None:
        self._zones, self._clearance_m = zones, clearance_m
        self._nodes = _nodes(zones, clearance_m + OFF_M)
        if len(self._nodes):
            clear = zones.clearance(self._nodes).min(axis=1) >= clearance_m
            self._nodes = self._nodes[clear][:NODES_MAX]
        n = len(self._nodes)
        first, second = np.triu_indices(n, 1)
        far = np.full((n, n), np.inf)
        np.fill_diagonal(far, 0.0)
        if n > 1:
            sees = self.sees(self._nodes[first], self._nodes[second])
            first, second = first[sees], second[sees]
            far[first, second] = np.linalg.norm(self._nodes[first] - self._nodes[second], axis=1)
            far[second, first] = far[first, second]
        after = np.where(np.isfinite(far), np.arange(n), -1)
        for via in range(n):
            longer = far > far[:, [via]] + far[[via]]
            far = np.where(longer, far[:, [via]] + far[[via]], far)
            after = np.where(longer, after[:, [via]], after)
        self._far, self._after = far, after
        """Length of the shortest path from each node to each other node [m], infinite if there is
        none, and the next node on this path."""

    def corners(self, place: Array, goal: Array) -> Array:
        """Corners of the shortest path between two positions; empty without a path or corners."""
        start, end, nodes = place[None], goal[None], self._nodes
        if not len(nodes) or self.sees(start, end)[0]:
            return nodes[:0]
        long = self._lengths(start)[:, None] + self._far + self._lengths(end)
        via, at = np.unravel_index(int(long.argmin()), long.shape)
        if not np.isfinite(long[via, at]):
            return nodes[:0]
        path = [int(via)]
        while path[-1] != at:
            path.append(int(self._after[path[-1], at]))
        return nodes[path]

    def sees(self, starts: Array, ends: Array) -> Flags:
        """Whether straight lines keep the clearance; shape (n,); starts and ends: shape (n, 2)."""
        return are_clear(self._zones, starts, ends, self._clearance_m - TINY_M)

    def _lengths(self, start: Array) -> Array:
        """Distances of nodes from a position [m], infinite without a clear line; shape (n,)."""
        nodes = self._nodes
        sees = self.sees(np.repeat(start, len(nodes), axis=0), nodes)
        return np.where(sees, np.linalg.norm(nodes - start, axis=1), np.inf)


def _nodes(zones: Zones, off_m: float) -> Array:
    """Positions near the corners of zones, at `off_m` on both sides [m]; shape (n, 2)."""
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
        # On both sides, because vehicles may be inside or outside of a zone.
        points += [corners - sign * off_m * halves / size for sign in (1.0, -1.0)]
    return np.concatenate(points)
