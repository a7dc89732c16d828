"""Film of a fleet's flight as an animated GIF: positions and the smallest distance between
vehicles.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skytether.figures.page import blank
from skytether.shared.base import files
from skytether.shared.law.model import Array
from skytether.shared.missions.derived import zones
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Rows

if TYPE_CHECKING:
    from PIL.Image import Image

SUFFIX = ".gif"
RATE_HZ = 12
"""Frames per second of the film [Hz]."""
SPEED = 4.0
"""Seconds of the flight per second of the film."""
FRAMES_MAX = 600
"""Largest number of frames; a longer flight is shown faster."""
TRAIL_S = 2.0
"""Duration of the flown path that is drawn behind each vehicle [s]."""
COLOURS = 64


def length(scenario: Scenario, client: Rows) -> int:
    flown_s = float(np.ptp(client["step"])) * scenario.control.dt
    return min(FRAMES_MAX, max(1, round(flown_s / SPEED * RATE_HZ)))


def write(
    path: Path,
    title: str,
    scenario: Scenario,
    client: Rows,
    separations: tuple[Array, Array] | None,
    on_frame: Callable[[int], None],
) -> None:
    """Write a film of a fleet's flight.

    Args:
        path: file to write, with the suffix `.gif`.
        client: rows of all vehicles.
        separations: times and distances of a mission, see `summary.separations`.
        on_frame: called with the number of frames drawn so far.

    Raises:
        OSError: the file cannot be written.
    """
    frames = []
    for frame in _frames(title, scenario, client, separations):
        frames.append(frame)
        on_frame(len(frames))
    with files.replacing(path) as file:
        frames[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=frames[1:],
            duration=1000 // RATE_HZ,
            loop=0,
        )


def _frames(
    title: str, scenario: Scenario, client: Rows, separations: tuple[Array, Array] | None
) -> Iterator["Image"]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    dt_s, steps = scenario.control.dt, client["step"]
    frame_steps = np.linspace(steps.min(), steps.max(), length(scenario, client) + 1)[1:]
    tracks = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]

    figure = blank(6.4, 3.2)
    canvas: Any = FigureCanvasAgg(figure)
    plane, nearest = figure.subplots(1, 2) if separations else (figure.subplots(), None)
    everywhere = client["state"][:, :2, 0]
    for zone in zones(scenario).zones:
        plane.fill(*zone.corners.T, facecolor="none", edgecolor="tab:red")
    plane.set_xlim(everywhere[:, 0].min() - 0.5, everywhere[:, 0].max() + 0.5)
    plane.set_ylim(everywhere[:, 1].min() - 0.5, everywhere[:, 1].max() + 0.5)
    plane.set_aspect("equal")
    plane.set_xlabel("x [m]")
    plane.set_ylabel("y [m]")
    drawn = []
    for rows in tracks:
        (trail,) = plane.plot([], [], "-", linewidth=0.8)
        (place,) = plane.plot([], [], "o", markersize=5, color=trail.get_color())
        drawn.append((rows, trail, place))
    if nearest is not None:
        times_s, nearest_m = separations or (np.zeros(0), np.zeros(0))
        asked_m = scenario.mission.separation_m
        nearest.axhline(asked_m, color="tab:red", linestyle="--", label=f"required: {asked_m:g} m")
        (line,) = nearest.plot([], [], "k-", linewidth=0.8, label="nearest two vehicles")
        nearest.set_xlim(0.0, float(np.ptp(times_s)))
        # Large distances at the start and the end would compress the scale.
        nearest.set_ylim(0.0, 1.5 * float(np.nanquantile(nearest_m, 0.9)))
        nearest.set_xlabel("time [s]")
        nearest.set_ylabel("distance [m]")
        nearest.legend(loc="upper right", fontsize=7)
    for step in frame_steps:
        figure.suptitle(f"{title}: {step * dt_s:.0f} s", fontsize=8)
        for rows, trail, place in drawn:
            past = rows["step"] <= step
            recent = past & (rows["step"] >= step - TRAIL_S / dt_s)
            trail.set_data(*rows["state"][recent, :2, 0].T)
            place.set_data(*rows["state"][past, :2, 0][-1:].T)
        if nearest is not None:
            until = times_s - times_s[0] <= (step - steps.min()) * dt_s
            line.set_data(times_s[until] - times_s[0], nearest_m[until])
        canvas.draw()
        frame = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        yield frame.quantize(COLOURS, dither=Image.Dither.NONE)
