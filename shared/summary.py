"""The figures of a flight, from the parts of its record; their names are used everywhere."""

import math

import msgspec
import numpy as np

from shared.config import Scenario
from shared.model import Array
from shared.protocol import Mode
from shared.record import DOWNLINK, UPLINK, Reason, Rows


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One vehicle's flight; None is what was not measured or whose part of the record is absent."""

    scenario: str
    seed: int
    duration_s: float
    steps: int
    """Number of steps that the client flew."""
    rmse_x: float | None
    """Root mean square of the position error along x, from `settle` on [m]."""
    rmse_y: float | None
    rmse_z: float | None
    """Root mean square of the altitude's error [m]; None in the plane."""
    rmse_xy: float | None
    error_max: float | None
    """Largest distance from the desired trajectory, from `settle` on [m]."""
    covered: float | None
    """Share of the steps for which the vehicle had an input planned; in the others it hovered,
    braked, or held the last."""
    modes: dict[str, float]
    """Time in each mode that occurred [s], see `shared.protocol.Mode`."""
    mode: str | None
    """Mode that the vehicle was in last."""
    reason: str | None
    """Why it was in it."""
    event_ratio: float | None
    """Share of the server's steps that sent a horizon."""
    uplink_packets: int | None
    """Number of packets that entered the network from the server, lost ones included."""
    uplink_bytes: int | None
    """UDP payload of all uplink packets [B]."""
    downlink_packets: int | None
    downlink_bytes: int | None
    lost: int | None
    """Number of packets that the network lost, both ways."""
    reordered: int | None
    """Number of packets overtaken by a later one, both ways."""
    stale: int
    """Number of messages discarded at either end because something newer had come before."""
    age_ms_p50: float | None
    """Age of the observation behind the input being flown [ms], over all steps."""
    age_ms_p99: float | None
    solve_ms_p50: float | None
    """Wall-clock time of both MPCs of a step [ms]; None for a virtual flight."""
    solve_ms_p99: float | None
    deadline_misses: int
    """Number of steps that the server or the client slept through."""
    estimate_error_m: float | None = None
    """Root mean square of how far the position that the vehicle flew by was from the true one, from
    `settle` on [m]; None where it knew that."""
    secure: bool = False
    """Whether the link was authenticated and encrypted."""


def summarise(
    scenario: Scenario,
    name: str,
    client: Rows,
    server: Rows | None = None,
    netem: Rows | None = None,
    *,
    secure: bool = False,
) -> Summary:
    """The summary of one vehicle's flight.

    Args:
        name: of the scenario.
        client: its rows, of one vehicle.
        server: rows of the server, of any vehicles.
        netem: rows of netem; all flows count.
        secure: whether the link was sealed.
    """
    begun = client["step"] * scenario.control.dt >= scenario.settle
    settled = position_error(scenario, client)[begun]
    off = (client["estimate"] - client["state"])[begun, :, 0]
    squares = (settled**2).mean(axis=0) if len(settled) else np.array([np.nan])
    rmse = [float(value) for value in np.sqrt(squares)] if np.isfinite(squares).all() else []
    distances = np.linalg.norm(settled, axis=1)
    age_ms = client["age_ns"][client["age_ns"] >= 0] / 1e6
    stale, missed = _last(client, "stale"), _last(client, "missed")
    event_ratio, solve_ms = None, np.empty(0)
    if server is not None:
        rows = server[np.isin(server["vehicle"], client["vehicle"])]
        event_ratio = float(rows["event"].mean()) if len(rows) else None
        solve_ms = rows["solve_ns"][rows["solve_ns"] >= 0] / 1e6
        stale, missed = stale + _last(rows, "stale"), missed + _last(rows, "missed")
    return Summary(
        scenario=name,
        seed=scenario.seed,
        duration_s=(_last(client, "step") + 1) * scenario.control.dt if len(client) else 0.0,
        steps=len(client),
        rmse_x=rmse[0] if rmse else None,
        rmse_y=rmse[1] if rmse else None,
        rmse_z=rmse[2] if len(rmse) == 3 else None,
        rmse_xy=math.hypot(*rmse[:2]) if rmse else None,
        error_max=float(distances.max()) if len(distances) else None,
        covered=float(client["covered"].mean()) if len(client) else None,
        modes={
            str(mode): int((client["mode"] == mode).sum()) * scenario.control.dt
            for mode in Mode
            if (client["mode"] == mode).any()
        },
        mode=str(Mode(client["mode"][-1])) if len(client) else None,
        reason=str(Reason(client["reason"][-1])) if len(client) else None,
        event_ratio=event_ratio,
        uplink_packets=_count(netem, UPLINK),
        uplink_bytes=_bytes(netem, UPLINK),
        downlink_packets=_count(netem, DOWNLINK),
        downlink_bytes=_bytes(netem, DOWNLINK),
        lost=None if netem is None else int(netem["lost"].sum()),
        reordered=None if netem is None else int(netem["overtaken"].sum()),
        stale=stale,
        age_ms_p50=_quantile(age_ms, 0.5),
        age_ms_p99=_quantile(age_ms, 0.99),
        solve_ms_p50=_quantile(solve_ms, 0.5),
        solve_ms_p99=_quantile(solve_ms, 0.99),
        deadline_misses=missed,
        estimate_error_m=_rms(off) if off.any() and np.isfinite(off).all() else None,
        secure=secure,
    )


def position_error(scenario: Scenario, client: Rows) -> Array:
    """Position minus reference at every step [m]; shape (steps, axes)."""
    desired = scenario.make_reference()(client["step"] * scenario.control.dt)
    error: Array = client["state"][..., 0] - desired[..., 0]
    return error


def _rms(vectors: Array) -> float:
    """Root mean square of the lengths of vectors; shape (n, axes)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _last(rows: Rows, name: str) -> int:
    return int(rows[name][-1]) if len(rows) else 0


def _count(netem: Rows | None, direction: int) -> int | None:
    return None if netem is None else int((netem["direction"] == direction).sum())


def _bytes(netem: Rows | None, direction: int) -> int | None:
    return None if netem is None else int(netem["bytes"][netem["direction"] == direction].sum())


def _quantile(values: Array, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None
