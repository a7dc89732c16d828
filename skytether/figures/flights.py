"""Pictures of flights, and of a fleet."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skytether.figures.page import blank
from skytether.shared.base import files
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Record, Rows
from skytether.shared.telemetry.summary import desired, position_error, summarise

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")


def check(path: Path, *others: str) -> None:
    """Refuse a file name without the suffix of a picture, before anything is flown.

    Args:
        others: suffixes accepted beside FORMATS.

    Raises:
        ConfigError: the suffix is not accepted; the message names the accepted suffixes.
        ModuleNotFoundError: matplotlib is not installed.
    """
    accepted = (*FORMATS, *others)
    if path.suffix not in accepted:
        raise ConfigError(f"{path}: expected a file in {', '.join(accepted)}")
    import_module("matplotlib.figure")


def flights(path: Path, flown: Mapping[str, tuple[Scenario, Record]]) -> None:
    """Write a picture of flights side by side to a file in one of FORMATS; see `drawn`."""
    save(drawn(flown), path, dpi=130)


def save(figure: "Figure", path: Path, *, dpi: int) -> None:
    """Write a figure to a file in one of FORMATS.

    Raises:
        OSError: the file cannot be written, or is not a regular file.
    """
    with files.replacing(path) as file:
        figure.savefig(file, format=path.suffix[1:], dpi=dpi)


def drawn(flown: Mapping[str, tuple[Scenario, Record]]) -> "Figure":
    """Draw flights side by side: the path over the reference, and below the packets in each second.

    Args:
        flown: scenario and record of each flight, by title.
    """
    figure = blank(4.1 * len(flown) + 1.0, 5.4)
    grid = figure.subplots(
        2, len(flown), squeeze=False, sharex="row", sharey="row", height_ratios=(5, 2)
    )
    for (title, (scenario, flight)), (plane, packets) in zip(flown.items(), grid.T, strict=True):
        summary = summarise(scenario, title, flight.client, flight.server, flight.netem)
        off = "" if summary.rmse_xy is None else f"\n{summary.rmse_xy:.3f} m off (RMSE)"
        draw_path(plane, scenario, flight)
        plane.set_title(f"{title}{off}", fontsize=10)
        arrived_s = flight.netem["arrived_ns"] / SECOND_NS
        arrived_s -= arrived_s.min(initial=np.inf)
        draw_packets(packets, scenario, flight.netem["direction"], arrived_s)
        sent = (
            "" if summary.event_ratio is None else f"; sent at {summary.event_ratio:.0%} of steps"
        )
        packets.set_xlabel(f"time from the first packet [s]{sent}")
        packets.grid(alpha=0.3)
    for plane in grid[0, 1:]:
        plane.set_ylabel("")
    grid[0, 0].legend(loc="upper right", fontsize=8)
    grid[1, 0].set_ylabel("packets per s")
    grid[1, -1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    return figure


def draw_path(plane: "Axes", scenario: Scenario, flight: Record) -> None:
    position = flight.client["state"][..., 0]
    draw_reference(plane, scenario, flight.client, flight.server)
    plane.plot(position[:, 0], position[:, 1], "k-", linewidth=1.0, label="UAV")
    plane.plot(position[0, 0], position[0, 1], "ko", markersize=4, label="start")
    plane.set_xlabel("x [m]")
    plane.set_ylabel("y [m]")
    plane.set_aspect("equal", adjustable="box")
    plane.grid(alpha=0.3)


def draw_packets(
    axes: "Axes", scenario: Scenario, direction: NDArray[np.uint8], arrived_s: Array
) -> None:
    """Draw the number of packets that entered the network in each second, uplink and downlink.

    Args:
        direction: UPLINK or DOWNLINK of each packet; shape (n,).
        arrived_s: time at which each packet entered the network [s], 0 at the left; shape (n,).
    """
    seconds = np.arange(int(arrived_s.max(initial=0.0)) + 2)
    axes.axhline(1.0 / scenario.control.dt, color="r", linestyle="--", zorder=0, label="every step")
    for way, name, color, width in ((UPLINK, "up", "k", 2.0), (DOWNLINK, "down", "#3fa7e0", 1.0)):
        counts, _ = np.histogram(arrived_s[direction == way], seconds)
        axes.stairs(counts, seconds, color=color, label=name, linewidth=width)
    axes.set_ylim(bottom=0.0)


def draw_reference(
    plane: Any, scenario: Scenario, client: Rows, server: Rows | None = None
) -> None:
    """Draw the reference, red and dashed, for the steps that a vehicle has flown.

    A closed curve is drawn for one round only: dashes of a second round would fill the gaps.

    Args:
        client: rows of the vehicle.
        server: rows of the server, which have the positions of a target that moves in flight.
    """
    if scenario.reference.shape in ("circle", "figure-eight", "square"):
        time_s = client["step"] * scenario.control.dt
        client = client[time_s - time_s[:1] <= scenario.reference.period_s]
    x, y = desired(scenario, client, server)[:, :2].T
    plane.plot(x, y, "r--", label="reference")


def fleet(
    path: Path,
    title: str,
    scenario: Scenario,
    client: Rows,
    server: Rows | None = None,
    separations: tuple[Array, Array] | None = None,
) -> None:
    """Draw a fleet: all paths over the reference, and the spread of the tracking error.

    For a mission, draw paths, zones, and the smallest distance between two vehicles over time.

    Args:
        path: file to write, in one of FORMATS.
        client: rows of all vehicles.
        server: rows of the server, which have the positions of a target that moves in flight.
        separations: times and distances of a mission, see `summary.separations`.
    """
    figure = blank(10.4, 4.8)
    plane, spread = figure.subplots(1, 2)
    flights = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]
    for rows in flights:
        x, y = rows["state"][:, :2, 0].T
        faint = 0.5 if separations else max(0.05, 1 / len(flights))
        plane.plot(x, y, "k-", linewidth=0.6, alpha=faint)
    if separations:
        from skytether.shared.missions.derived import zones  # the package of missions may be absent

        for number, zone in enumerate(zones(scenario).zones):
            label = "" if number else "zones"
            plane.fill(*zone.corners.T, facecolor="none", edgecolor="tab:red", label=label)
        for rows in flights:
            plane.plot(*rows["state"][-1, :2, 0], "k.", markersize=4)
    else:
        draw_reference(plane, scenario, max(flights, key=len), server)
    plane.set_aspect("equal", adjustable="datalim")
    plane.set_xlabel("x [m]")
    plane.set_ylabel("y [m]")
    if plane.get_legend_handles_labels()[0]:
        plane.legend(loc="upper right", fontsize=8)
    if separations:
        _draw_separations(spread, scenario, *separations)
    else:
        _draw_errors(spread, scenario, flights, server)
    for axes in (plane, spread):
        axes.grid(alpha=0.3)
    figure.suptitle(title, fontsize=10)
    save(figure, path, dpi=130)


def _draw_separations(axes: "Axes", scenario: Scenario, times_s: Array, nearest_m: Array) -> None:
    axes.plot(times_s - times_s[:1], nearest_m, "k-", linewidth=0.8, label="nearest two vehicles")
    asked_m = scenario.mission.separation_m
    axes.axhline(asked_m, color="tab:red", linestyle="--", label=f"required: {asked_m:g} m")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("distance [m]")
    axes.legend(loc="upper right", fontsize=8)


def _draw_errors(
    spread: "Axes", scenario: Scenario, flights: Sequence[Rows], server: Rows | None
) -> None:
    settled = [rows[rows["step"] * scenario.control.dt >= scenario.settled_s] for rows in flights]
    errors = [
        np.sqrt((position_error(scenario, rows, server)[:, :2] ** 2).sum(axis=1).mean())
        for rows in settled
        if len(rows)
    ]
    finite = np.array(errors)[np.isfinite(errors)]
    spread.hist(finite, bins=max(5, round(np.sqrt(len(finite)))), color="0.4")
    spread.set_xlabel("RMSE xy of a vehicle [m]")
    spread.set_ylabel("vehicles")
