"""Pictures of flights."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from shared.command import CommandError
from shared.config import Scenario
from shared.record import Rows
from shared.summary import position_error
from sim.flight import Flight

FORMATS = (".png", ".pdf", ".svg")


def check(path: Path) -> None:
    """Refuse a file that no picture can be written to, before anything is flown.

    Raises:
        CommandError: with what would do.
    """
    if path.suffix not in FORMATS:
        raise CommandError(f"{path}: expected a file in {', '.join(FORMATS)}", 2)
    if not path.absolute().parent.is_dir():
        raise CommandError(f"{path}: there is no folder {path.parent}", 2)


def flights(path: Path, flown: Mapping[str, tuple[Scenario, Flight]]) -> None:
    """Draw flights side by side: the path over the reference, and beneath it when packets went up.

    Args:
        path: of a file in one of FORMATS.
        flown: scenario and record of each, by title.
    """
    from matplotlib.figure import Figure  # takes half a second to import

    figure = Figure(figsize=(5.2 * len(flown), 5.2), layout="constrained")
    grid = figure.subplots(
        2, len(flown), squeeze=False, sharex="row", sharey="row", height_ratios=(6, 1)
    )
    for (title, (scenario, flight)), (plane, events) in zip(flown.items(), grid.T, strict=True):
        dt = scenario.control.dt
        desired = scenario.make_reference()(flight.client["step"] * dt)[..., 0]
        position = flight.client["state"][..., 0]
        plane.plot(desired[:, 0], desired[:, 1], "r--", label="reference")
        plane.plot(position[:, 0], position[:, 1], "k-", linewidth=1.0, label="UAV")
        plane.plot(position[0, 0], position[0, 1], "ko", markersize=4, label="start")
        plane.set_title(title, fontsize=10)
        plane.set_xlabel("x [m]")
        plane.set_aspect("equal", adjustable="box")
        plane.grid(alpha=0.3)
        sent = flight.server["event"]
        ratio = float(np.mean(sent)) if len(sent) else 0.0
        events.vlines(flight.server["step"][sent] * dt, 0.0, 1.0, color="k", linewidth=0.6)
        events.set_xlabel(f"time [s]; a horizon sent at {ratio:.0%} of the steps")
        events.set_yticks([])
    grid[0, 0].set_ylabel("y [m]")
    grid[0, 0].legend(loc="upper right", fontsize=8)
    grid[1, 0].set_ylabel("sent")
    figure.savefig(path, dpi=130)


def fleet(path: Path, title: str, scenario: Scenario, client: Rows) -> None:
    """Draw a fleet: all paths over the reference, and how the tracking error spreads.

    Args:
        path: of a file in one of FORMATS.
        client: rows of all vehicles.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.4, 4.8), layout="constrained")
    plane, spread = figure.subplots(1, 2)
    flights = [client[client["vehicle"] == number] for number in np.unique(client["vehicle"])]
    for rows in flights:
        plane.plot(
            *rows["state"][:, :2, 0].T, "k-", linewidth=0.6, alpha=max(0.05, 1 / len(flights))
        )
    desired = scenario.make_reference()(np.unique(client["step"]) * scenario.control.dt)
    plane.plot(*desired[:, :2, 0].T, "r--", label="reference")
    plane.set_aspect("equal", adjustable="datalim")
    plane.set_xlabel("x [m]")
    plane.set_ylabel("y [m]")
    plane.legend(loc="upper right", fontsize=8)
    settled = [rows[rows["step"] * scenario.control.dt >= scenario.settle] for rows in flights]
    errors = [
        np.sqrt((position_error(scenario, rows)[:, :2] ** 2).sum(axis=1).mean())
        for rows in settled
        if len(rows)
    ]
    spread.hist(errors, bins=max(5, round(np.sqrt(len(errors)))), color="0.4")
    spread.set_xlabel("RMSE xy of a vehicle [m]")
    spread.set_ylabel("vehicles")
    for axes in (plane, spread):
        axes.grid(alpha=0.3)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=130)
