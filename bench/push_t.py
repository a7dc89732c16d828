"""Scripted policy for gym-pusht: a block in the shape of a T is pushed to its goal.

From each place on its outline a push of some length would move and turn the block. The policy takes
the push after which the block is closest to its goal, less the way to get there, and returns the
path of the pusher: round the block, to the place, and through it. Where rows are committed, it
predicts where they bring the pusher and the block, and goes on from there.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GOAL, GOAL_ANGLE = np.array([256.0, 256.0]), np.pi / 4
CENTRE = np.array([0.0, 45.0])
"""Centre of gravity in the frame of the block [px]."""
GYRATION = 55.0
"""Radius of gyration of the block as it is simulated [px]."""
ARM = 60.0
"""Length by which an angle counts as a distance [px]."""
BOXES = np.array([[[-60.0, 0.0], [-15.0, 30.0]], [[60.0, 30.0], [15.0, 120.0]]])
"""The bar and the stem of the block: least and largest coordinates in its frame [px]."""
RADIUS, GAP = 15.0, 10.0
"""Radius of the pusher, and distance to the outline before a push [px]."""
PUSHES = np.array([4.0, 12.0, 30.0, 60.0])
TRAVEL = 0.04
"""Price of a way of 1 px, as a distance of the block [px]."""
TRAVEL_SPEED, PUSH_SPEED = 25.0, 8.0
"""Pixels a step."""
ARENA = 20.0, 492.0
CORNERS = np.array(
    [[-85, -25], [85, -25], [85, 55], [40, 55], [40, 145], [-40, 145], [-40, 55], [-85, 55]], float
)
"""Corners of a wider outline, on which the pusher goes round the block [px]."""


def _outline() -> tuple[Array, Array]:
    """Places on the outline of the block and the normals into it, in its frame; shape (n, 2)."""
    sides = [
        ((-60, 0), (60, 0), (0, 1)),
        ((60, 0), (60, 30), (-1, 0)),
        ((60, 30), (15, 30), (0, -1)),
        ((15, 30), (15, 120), (-1, 0)),
        ((15, 120), (-15, 120), (0, -1)),
        ((-15, 120), (-15, 30), (1, 0)),
        ((-15, 30), (-60, 30), (0, -1)),
        ((-60, 30), (-60, 0), (1, 0)),
    ]
    places, normals = [], []
    for begin, end, normal in sides:
        length = float(np.hypot(end[0] - begin[0], end[1] - begin[1]))
        for share in np.linspace(0.15, 0.85, max(1, round(length / 12))):
            places.append(np.array(begin) + share * (np.array(end) - np.array(begin)))
            normals.append(normal)
    return np.array(places), np.array(normals, dtype=float)


PLACES, NORMALS = _outline()


def turned_by(angle: float) -> Array:
    """Rotation matrix; shape (2, 2)."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def predict(observation: Array, targets: Array) -> Array:
    """Observation once the pusher has been at all targets, shape (n, 2).

    Wherever the pusher would be in the block, this gives way along the shortest way out. The pusher
    is taken to follow without delay.
    """
    pusher, block, angle = observation[:2], observation[2:4], float(observation[4])
    for target in targets:
        for at in pusher + np.linspace(0.1, 1.0, 10)[:, None] * (target - pusher):
            turn = turned_by(angle)
            place = (at - block) @ turn
            nearest = np.clip(place, *BOXES)
            away = np.hypot(*(place - nearest).T)
            box = int(away.argmin())
            if 0.0 < away[box] < RADIUS:
                centre, normal = block + turn @ CENTRE, turn @ (nearest[box] - place) / away[box]
                x, y = turn @ (nearest[box] - CENTRE)
                moment = x * normal[1] - y * normal[0]
                give = (RADIUS - away[box]) / (1.0 + (moment / GYRATION) ** 2)
                angle += give * moment / GYRATION**2
                block = centre + give * normal - turned_by(angle) @ CENTRE
        pusher = target
    return np.array([*pusher, *block, angle])


def plan(observation: Array, committed: Array, rows: int) -> Array:
    """Next positions of the pusher, the committed ones first [px]; shape (rows, 2)."""
    if len(committed) < 2:  # the pusher is two rows behind its target: nothing is known of so few
        return _push(observation, rows)
    continued = _push(predict(observation, committed), rows)
    return np.concatenate([committed, continued])[:rows]


def _push(observation: Array, rows: int) -> Array:
    pusher, block, angle = observation[:2], observation[2:4], observation[4]
    turn, goal_turn = turned_by(angle), turned_by(GOAL_ANGLE)
    places, normals = block + PLACES @ turn.T, NORMALS @ turn.T
    centre = block + turn @ CENTRE
    off = GOAL + goal_turn @ CENTRE - centre
    off_angle = (GOAL_ANGLE - angle + np.pi) % (2 * np.pi) - np.pi
    # A push along a normal: the block gives way by moving and by turning, as a free body does.
    arms = places - centre
    moments = arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0]
    gives = 1.0 / (1.0 + (moments / GYRATION) ** 2)
    moved = PUSHES[:, None, None] * (gives[:, None] * normals)
    turned = PUSHES[:, None] * (gives * moments / GYRATION**2)
    left = np.hypot(*np.moveaxis(off - moved, -1, 0)) + ARM * np.abs(off_angle - turned)
    starts = places - (RADIUS + GAP) * normals
    x, y = (pusher - starts).T
    ahead = x * normals[:, 0] + y * normals[:, 1]
    aside = np.abs(x * normals[:, 1] - y * normals[:, 0])
    is_there = (aside < 6.0) & (ahead > -5.0) & (ahead < GAP + 12.0)
    ways = np.where(is_there, 0.0, np.hypot(x, y) + 40.0)
    inside = ((starts > ARENA[0]) & (starts < ARENA[1])).all(axis=1)
    cost = left + TRAVEL * ways + np.where(inside | is_there, 0.0, 1e3)
    push, at = np.unravel_index(np.argmin(cost), cost.shape)
    end = places[at] + (PUSHES[push] - RADIUS) * normals[at]
    path = [(end, PUSH_SPEED)]
    if not is_there[at]:
        path = [(each, TRAVEL_SPEED) for each in _around(pusher, starts[at], turn, block)]
        path += [(starts[at], TRAVEL_SPEED), (end, PUSH_SPEED)]
    return _along(pusher, path, rows)


def _around(pusher: Array, start: Array, turn: Array, block: Array) -> list[Array]:
    """Points round the block, if it is in the way: corners of a wider outline, the shorter way."""
    if _is_clear(pusher, start, turn, block):
        return []
    corners = block + CORNERS @ turn.T
    ends = []
    for each in (pusher, start):
        order = np.argsort(np.hypot(*(corners - each).T))
        clear = (i for i in order if _is_clear(each, corners[i], turn, block))
        ends.append(int(next(clear, order[0])))
    ways = []
    for sign in (1, -1):
        count = (sign * (ends[1] - ends[0])) % len(corners)
        way = corners[[(ends[0] + sign * i) % len(corners) for i in range(count + 1)]]
        targets = [*way[1:], start]
        while len(way) and (
            np.hypot(*(way[0] - pusher)) < 15.0
            or _is_clear(pusher, targets[-len(way)], turn, block)
        ):
            way = way[1:]
        outside = np.abs(way - np.clip(way, *ARENA)).sum()
        length = np.hypot(*np.diff([pusher, *way, start], axis=0).T).sum()
        ways.append((length + 20.0 * outside, way))
    return list(np.clip(min(ways, key=lambda each: each[0])[1], *ARENA))


def _is_clear(begin: Array, end: Array, turn: Array, block: Array) -> bool:
    line = begin + np.linspace(0.0, 1.0, 20)[:, None] * (end - begin)
    x, y = ((line - block) @ turn).T
    margin = RADIUS - 1.0
    bar = (np.abs(x) < 60 + margin) & (y > -margin) & (y < 30 + margin)
    stem = (np.abs(x) < 15 + margin) & (y > 30 - margin) & (y < 120 + margin)
    return not (bar | stem)[1:].any()


def _along(begin: Array, path: list[tuple[Array, float]], rows: int) -> Array:
    """Points along a path, one for each step at the speed of its part; the last is repeated."""
    points, at = [], begin
    for to, speed in path:
        steps = round(np.hypot(*(to - at)) / speed + 0.4)  # a part of less than a tenth is left out
        points += [at + (to - at) * (i / steps) for i in range(1, steps + 1)]
        at = to
        if len(points) >= rows:
            break
    return np.array((points + [at] * rows)[:rows])
