"""Scene of a page: vehicles, their trails, their plans, and their desired positions.

Units are metres, the third axis points up. A planar flight is seen from above.
"""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from skytether.figures.colours import GREY, PALETTE, RED, Rgb
from skytether.shared.base.errors import ConfigError
from skytether.shared.law.model import Array
from skytether.shared.missions.mission import Mission
from skytether.shared.missions.zones import Zones
from skytether.shared.scenario.whole import Scenario
from skytether.view.page.state import State, VehicleTrack

FLIGHT_RGB: tuple[Rgb, ...] = ((56, 132, 255), (255, 140, 40), (160, 90, 220), (20, 170, 150))
"""Colours of flights, by their place on the page."""
GOAL_RGB = PALETTE[GREY]

FENCE_RGB = PALETTE[RED]
GROUND_RGB: dict[bool, Rgb] = {False: (52, 55, 60), True: (222, 226, 230)}
"""Colour of the lines on the ground, by whether the page is light."""
GRID_REACH = 3.0
"""Size of the ground's grid, relative to the extent of the flight."""
BELOW = 1e-3
"""Depth of the grid below everything else, relative to the extent of the flight."""
TRAIL_S = 20.0
GOAL_S = 1.0
"""Age up to which a desired position is shown [s]; an older one is out of date."""
TRAIL_POINTS = 240
"""Largest number of points of a vehicle's trail."""
TRAIL_POINTS_ALL = 2000
ROUND_S = 600.0
"""Longest part of the desired trajectory that is drawn [s]."""
SHADE = 0.45
"""Brightness of vehicles, as a share of the flight's colour: the scene's lights brighten them."""
SIZE = 0.05
"""Size of a vehicle, relative to the extent of the flight."""
WIDE, NARROW = 1.5, 0.6
"""Aspect ratios (width over height) of a wide window, and of the widest narrow window."""
FOV_RAD = 0.7


def in_space(points: Array) -> NDArray[np.float32]:
    """Points with a third coordinate added; shape (n, 3)."""
    placed = np.zeros((len(points), 3), np.float32)
    placed[:, : points.shape[1]] = points
    return placed


def segments(points: Array, *, dashed: bool = False) -> NDArray[np.float32]:
    """Line through points, as segments; segments with NaN are left out; shape (n, 2, 3)."""
    placed = in_space(points)
    pieces = np.stack([placed[:-1], placed[1:]], axis=1)
    pieces = pieces[~np.isnan(pieces).any(axis=(1, 2))]
    return pieces[::2] if dashed else pieces


def grid(middle: Array, reach_m: float) -> NDArray[np.float32]:
    """Grid lines on the ground around a centre, with a round spacing; shape (n, 2, 3)."""
    cell_m = 10.0 ** np.floor(np.log10(reach_m))
    most_m = cell_m * np.ceil(GRID_REACH * reach_m / cell_m)
    at_m = np.arange(-most_m, most_m + cell_m / 2, cell_m)
    lines = np.zeros((2 * len(at_m), 2, 3), np.float32)
    along, across = lines[: len(at_m)], lines[len(at_m) :]
    along[:, :, 0] = across[:, :, 1] = at_m[:, None]
    along[:, :, 1] = across[:, :, 0] = -most_m, most_m
    lines[:, :, :2] += np.round(middle[:2] / cell_m) * cell_m
    lines[:, :, 2] = -BELOW * reach_m
    return lines


def extent(scenarios: Sequence[Scenario]) -> tuple[Array, float]:
    """Centre [m; shape (3,)] and size [m] of the volume in which flights take place."""
    points = np.concatenate([in_space(_desired(each)) for each in scenarios]).astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, max(1.0, 1.25 * float((high - low).max()) / 2)


def _desired(scenario: Scenario) -> Array:
    """Points of the desired trajectory, or corners of its bounds [m]; shape (n, axes)."""
    shape, axes = scenario.reference.shape, scenario.model.axes
    if shape == "target":
        corner = np.zeros(axes)
        corner[:2] = scenario.reference.radius_m
        return np.array([-corner, corner])
    if shape == "live":
        corner = np.zeros(axes)
        corner[:2] = 3.0
        middle = np.zeros(axes)
        if points := scenario.reference.points_m:
            middle = np.array(points[0])
        return np.array([middle - corner, middle + corner])
    try:
        reference = scenario.unallocated_reference()
    except (ConfigError, ValueError):  # the file of the trajectory is on another machine
        return np.zeros((2, axes))
    if isinstance(reference, Mission):
        return reference.places
    last_s = min(scenario.duration, ROUND_S)
    if shape in ("circle", "figure-eight", "square"):
        last_s = min(last_s, scenario.reference.period_s)
    return reference(np.linspace(0.0, last_s, 200))[..., 0]


def home(scenario: Scenario) -> Array:
    """Starting point of a flight, if its scenario has one [m]; shape (1, axes)."""
    if scenario.vehicle.start_m:
        return np.array([scenario.vehicle.start_m])
    if scenario.vehicle.kind == "simulated":
        return _desired(scenario)[:1]
    return np.zeros((1, scenario.model.axes))


def fence(scenario: Scenario, reach_m: float) -> NDArray[np.float32]:
    """Lines of a scenario's fence, along the bounds that it has; shape (n, 2, 3).

    Args:
        reach_m: length to which an unbounded side is drawn [m].
    """
    fenced, begin = scenario.fence, in_space(home(scenario))[0]
    pieces = [np.zeros((0, 2, 3), np.float32)]
    if fenced.low_m or fenced.high_m:
        far = GRID_REACH * reach_m
        low, high = begin - far, begin + far
        low[2], high[2] = 0.0, far if scenario.model.axes > 2 else 0.0
        low[: len(fenced.low_m)], high[: len(fenced.high_m)] = fenced.low_m, fenced.high_m
        corners = np.array([low, high])
        for x, y, z in np.ndindex(2, 2, 1 if scenario.model.axes == 2 else 2):
            corner = np.array([corners[x, 0], corners[y, 1], corners[z, 2]])
            for axis, at in enumerate((x, y, z)):
                if at == 0 and corners[0, axis] != corners[1, axis]:
                    opposite = corner.copy()
                    opposite[axis] = corners[1, axis]
                    pieces.append(np.array([[corner, opposite]], np.float32))
    if fenced.radius_m:
        angle = np.linspace(0.0, 2 * np.pi, 97)
        around = begin[:2] + fenced.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        pieces.append(segments(around))
    return np.concatenate(pieces)


def zones(kept: Zones, reach_m: float) -> NDArray[np.float32]:
    """Outlines of a mission's zones; shape (n, 2, 3).

    Args:
        kept: zones to avoid.
        reach_m: height to which a zone without upper bound is drawn [m].
    """
    pieces = [np.zeros((0, 2, 3), np.float32)]
    for zone in kept.zones:
        around = np.concatenate([zone.corners, zone.corners[:1]])
        flat = np.isinf(zone.low_m) and np.isinf(zone.high_m)
        heights = [0.0] if flat else [max(zone.low_m, 0.0), min(zone.high_m, reach_m)]
        rings = [
            np.concatenate([around, np.full((len(around), 1), height)], axis=1)
            for height in heights
        ]
        pieces += [segments(ring) for ring in rings]
        if len(rings) == 2:
            pieces.append(np.stack(rings, axis=1).astype(np.float32))
    return np.concatenate(pieces)


def quadrotor(size: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices [m; shape (n, 3)] and triangles of four rotors on two arms."""
    corners = 12
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []

    def disc(x: float, y: float, radius: float) -> None:
        middle = len(vertices)
        vertices.append((x, y, 0.02 * size))
        for corner in range(corners):
            angle = 2 * np.pi * corner / corners
            vertices.append((x + radius * np.cos(angle), y + radius * np.sin(angle), 0.02 * size))
            faces.append((middle, middle + 1 + corner, middle + 1 + (corner + 1) % corners))

    def bar(x: float, y: float, width: float) -> None:
        first = len(vertices)
        across = np.array([-y, x]) / np.hypot(x, y) * width / 2
        for sign_x, sign in ((-1, -1), (-1, 1), (1, 1), (1, -1)):
            vertices.append((sign_x * x + sign * across[0], sign_x * y + sign * across[1], 0.0))
        faces.extend([(first, first + 1, first + 2), (first, first + 2, first + 3)])

    arm = 0.7 * size
    for x, y in ((arm, arm), (arm, -arm)):
        bar(x, y, 0.2 * size)
    for x in (-arm, arm):
        for y in (-arm, arm):
            disc(x, y, 0.5 * size)
    return np.array(vertices, np.float32), np.array(faces, np.uint32)


class _Marker:
    def __init__(self, scene: viser.SceneApi, name: str, size: float, rgb: Rgb) -> None:
        vertices, faces = quadrotor(size)
        red, green, blue = (round(SHADE * part) for part in rgb)
        self._frame = scene.add_frame(name, show_axes=False)
        scene.add_mesh_simple(
            f"{name}/body",
            vertices,
            faces,
            color=(red, green, blue),
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._dome = scene.add_icosphere(
            f"{name}/mode", 0.35 * size, subdivisions=2, cast_shadow=False, receive_shadow=False
        )
        self._label = scene.add_label(
            f"{name}/label", "", position=(1.3 * size, 1.3 * size, 0.0), anchor="bottom-left"
        )
        self._shown = ""

    def show(self, track: VehicleTrack, title: str) -> None:
        assert track.row is not None
        self._frame.position = in_space(track.row["state"][None, :, 0])[0]
        does = track.does
        text = f"{title} {does.word}".strip()
        if text != self._shown:
            self._shown = text
            self._label.text = text
            self._dome.color = PALETTE[does.colour]


class _Flight:
    def __init__(
        self, scene: viser.SceneApi, place: int, scenario: Scenario, reach_m: float, title: str
    ) -> None:
        self._scene = scene
        self._name = f"/flight{place}"
        self._title = title
        self._size = SIZE * reach_m
        self._rgb = FLIGHT_RGB[place % len(FLIGHT_RGB)]
        self._vehicles: dict[int, _Marker] = {}
        nothing = np.zeros((1, 2, 3), np.float32)
        faint: Rgb = (self._rgb[0] // 2 + 64, self._rgb[1] // 2 + 64, self._rgb[2] // 2 + 64)

        def line(what: str, rgb: Rgb, width: float) -> viser.LineSegmentsHandle:
            return scene.add_line_segments(
                f"{self._name}/{what}", nothing, rgb, thickness=width, thickness_units="screen"
            )

        arm = 0.5 * self._size
        self._cross = np.array(
            [[[-arm, 0, 0], [arm, 0, 0]], [[0, -arm, 0], [0, arm, 0]]], np.float32
        )
        self._is_mission = scenario.is_mission
        if not self._is_mission:
            line("home", GOAL_RGB, 2.0).points = in_space(home(scenario)) + self._cross
        if scenario.fence.is_there:
            line("fence", FENCE_RGB, 1.5).points = fence(scenario, reach_m)
        self._zones, self._zoned = line("zones", FENCE_RGB, 2.5), ""
        self._reach_m = reach_m
        self._trail, self._plan = line("trail", faint, 2.0), line("plan", self._rgb, 4.0)
        self._shows_goals = scenario.reference.shape in ("target", "live")
        if not self._shows_goals and not self._is_mission:
            line("desired", GOAL_RGB, 1.0).points = segments(_desired(scenario))
        self._goal_trail = line("goal-trail", GOAL_RGB, 1.0)
        self._goal = scene.add_icosphere(
            f"{self._name}/goal",
            0.3 * self._size,
            GOAL_RGB,
            subdivisions=2,
            cast_shadow=False,
            visible=False,
        )

    def move(self, state: State) -> None:
        for number, track in list(state.vehicles.items()):
            if track.row is None:
                continue
            vehicle = self._vehicles.get(number)
            if vehicle is None:
                name = f"{self._name}/vehicle{number}"
                vehicle = _Marker(self._scene, name, self._size, self._rgb)
                self._vehicles[number] = vehicle
            named = len(state.vehicles) > 1
            title = " ".join(filter(None, (self._title, str(number) if named else "")))
            vehicle.show(track, title)

    def draw(self, state: State) -> None:
        if state.zones != self._zoned:
            self._zoned = state.zones
            self._set(self._zones, [zones(state.kept, self._reach_m)])
        tracks = list(state.vehicles.values())
        most = max(2, min(TRAIL_POINTS, TRAIL_POINTS_ALL // max(1, len(tracks))))
        trails = [each.trail(TRAIL_S) for each in tracks]
        self._set(
            self._trail, [segments(trail[:: -(-len(trail) // most) or 1]) for trail in trails]
        )
        ahead = [segments(path, dashed=True) for each in tracks for path in each.motions()]
        self._set(self._plan, ahead)
        if self._is_mission:
            goals = [goal for track in tracks if (goal := track.goal(GOAL_S)) is not None]
            self._set(self._goal_trail, [in_space(goal[None]) + self._cross for goal in goals])
            return
        goal = tracks[0].goal(GOAL_S) if tracks else None
        if self._goal.visible != (goal is not None):
            self._goal.visible = goal is not None
        if goal is not None:
            self._goal.position = in_space(goal[None])[0]
        if tracks and self._shows_goals:
            self._set(self._goal_trail, [segments(tracks[0].goals(TRAIL_S))])

    @staticmethod
    def _set(line: viser.LineSegmentsHandle, pieces: Sequence[NDArray[np.float32]]) -> None:
        together = np.concatenate([np.zeros((1, 2, 3), np.float32), *pieces])
        line.points = together


class Scene:
    """Scene with the flights of a page.

    Args:
        states: states of flights whose scenarios have arrived.
        titles: titles of the flights; empty for a single flight.
    """

    def __init__(
        self, server: viser.ViserServer, states: Sequence[State], titles: Sequence[str]
    ) -> None:
        self.middle, self.reach_m = extent([state.scenario for state in states])
        self.flat = all(state.scenario.model.axes == 2 for state in states)
        scene = server.scene
        scene.set_up_direction("+z")
        self.ground = grid(self.middle, self.reach_m)
        camera = server.initial_camera
        camera.fov = FOV_RAD
        camera.position, camera.look_at = self.camera(WIDE)
        self._flights = [
            _Flight(scene, place, state.scenario, self.reach_m, title)
            for place, (state, title) in enumerate(zip(states, titles, strict=True))
            if state.flies
        ]

    def camera(self, aspect: float) -> tuple[Array, Array]:
        """Position and target of a camera that sees everything, in a window of this aspect ratio.

        In a narrow window the flight is in the upper half, because texts cover the lower half.
        """
        away_m = self.reach_m / np.tan(FOV_RAD / 2) / min(1.0, aspect)
        down_m = 0.5 * self.reach_m / aspect if aspect < NARROW else 0.0
        target = self.middle - np.array([0.0, down_m, 0.0])
        if self.flat:
            return target + np.array([0.0, -0.01, 1.0]) * away_m, target
        return target + np.array([-0.4, -0.55, 0.45]) * away_m, target

    def move(self, states: Sequence[State]) -> None:
        for flight, state in zip(self._flights, filter(_flies, states), strict=True):
            flight.move(state)

    def draw(self, states: Sequence[State]) -> None:
        for flight, state in zip(self._flights, filter(_flies, states), strict=True):
            flight.draw(state)


def _flies(state: State) -> bool:
    return state.flies
