"""The figures of a flight, from the parts of its record; their names are used everywhere."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from skytether.shared.base.units import HEADER_BYTES
from skytether.shared.law.model import Array
from skytether.shared.scenario.pace import is_known, is_too_fast
from skytether.shared.scenario.schema import Scenario
from skytether.shared.telemetry.drops import drops
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Reason, Rows
from skytether.shared.wire.protocol import NO_HORIZON, Mode

AT_BOUND = 1.0 - 1e-6
"""Share of the bound from which an input is at it: inputs are rounded on the wire."""


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of one vehicle's flight; None where nothing was measured, or a record is missing."""

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
    """Time in each mode that occurred [s], see `shared.wire.protocol.Mode`."""
    mode: str | None
    """Mode that the vehicle was in last."""
    reason: str | None
    """Why it was in it."""
    event_ratio: float | None
    """Share of the server's steps that sent a horizon."""
    uplink_horizons: int | None = None
    """Number of packets with a horizon that the server sent; the other uplink packets are
    heartbeats and the handshake's."""
    uplink_packets: int | None
    """Number of packets that entered the network from the server, lost ones included."""
    uplink_bytes: int | None
    """UDP payload of all uplink packets [B]."""
    downlink_packets: int | None
    downlink_bytes: int | None
    uplink_packets_per_s: float | None = None
    """Packets from the server a second of flight, heartbeats and lost ones among them [1/s]."""
    uplink_bytes_per_s: float | None = None
    """Bytes on the line that they take a second, with HEADER_BYTES a packet [B/s]."""
    downlink_packets_per_s: float | None = None
    """Packets from the vehicle a second of flight [1/s]."""
    downlink_bytes_per_s: float | None = None
    """Bytes on the line that they take a second, with HEADER_BYTES a packet [B/s]."""
    packets_per_s: float | None = None
    """Packets both ways a second of flight [1/s]."""
    bytes_per_s: float | None = None
    """Bytes on the line both ways a second, with HEADER_BYTES a packet [B/s]."""
    lost: int | None
    """Number of packets that the network lost, both ways."""
    reordered: int | None
    """Number of packets overtaken by a later one, both ways."""
    stale: int
    """Number of messages discarded at either end because something newer had come before."""
    drops: dict[str, dict[str, int]] | None = None
    """Number of packets that server, netem and client dropped, by reason (docs/operating.md); those
    of server and netem are of all vehicles. None where the processes' figures are not known."""
    age_ms_p50: float | None
    """Age of the observation behind the input being flown [ms], over all steps."""
    age_ms_p99: float | None
    aoi_s_mean: float | None
    """Mean age of information, of that observation [s], over the steps from `settle` on."""
    aoi_s_peak: float | None
    """Mean of its peaks [s]: of the age at each step before one at which it is smaller."""
    plan_age_s_mean: float | None
    """Mean time since the horizon in force was made [s], over the steps from `settle` on: the age
    of all that the server alone knows, as where its target is."""
    effort_mps: float | None
    """Root mean square of the change of the input from step to step, over all axes together, from
    `settle` on [m/s]."""
    saturated: float | None
    """Share of the steps from `settle` on at which the input is at its bound on some axis."""
    too_fast: float | None = None
    """Share of the steps at which the desired trajectory is faster than u_max times the gain on
    some axis, so that nothing can follow it; None where only the server knows it."""
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
    figures: Mapping[str, Mapping[str, Any]] | None = None,
    secure: bool = False,
) -> Summary:
    """The summary of one vehicle's flight.

    Args:
        name: of the scenario.
        client: its rows, of one vehicle.
        server: rows of the server, of any vehicles.
        netem: rows of netem; all flows count.
        figures: figures of each process by its name, as in `Record.figures`.
        secure: whether the link was sealed.
    """
    error = position_error(scenario, client, server)
    counted = client["step"] * scenario.control.dt >= scenario.settled_s
    settled, flown = error[counted], client[counted]
    off = _estimate_error(scenario, client)[counted]
    off = off[np.isfinite(off).all(axis=1)] if any(scenario.terms().dead_time_s) else off
    squares = (settled**2).mean(axis=0) if len(settled) else np.array([np.nan])
    rmse = [float(value) for value in np.sqrt(squares)] if np.isfinite(squares).all() else []
    distances = np.linalg.norm(settled, axis=1)
    age_ms = client["age_ns"][client["age_ns"] >= 0] / 1e6
    aoi_s = flown["age_ns"][flown["age_ns"] >= 0] / 1e9
    planned = flown[flown["in_force"] != NO_HORIZON]
    plan_age_s = (planned["step"] - planned["in_force"]) * scenario.control.dt
    changes = np.diff(client["input"], axis=0)[counted[1:]]
    stale, missed = _last(client, "stale"), _last(client, "missed")
    horizons, event_ratio, solve_ms = None, None, np.empty(0)
    if server is not None:
        rows = server[np.isin(server["vehicle"], client["vehicle"])]
        horizons = int(rows["event"].sum())
        event_ratio = float(rows["event"].mean()) if len(rows) else None
        solve_ms = rows["solve_ns"][rows["solve_ns"] >= 0] / 1e6
        stale, missed = stale + _last(rows, "stale"), missed + _last(rows, "missed")
    duration_s = (_last(client, "step") + 1) * scenario.control.dt if len(client) else 0.0
    return Summary(
        scenario=name,
        seed=scenario.seed,
        duration_s=duration_s,
        steps=len(client),
        rmse_x=rmse[0] if rmse else None,
        rmse_y=rmse[1] if rmse else None,
        rmse_z=rmse[2] if len(rmse) == 3 else None,
        rmse_xy=math.hypot(*rmse[:2]) if rmse else None,
        error_max=float(distances.max()) if rmse else None,
        covered=float(client["covered"].mean()) if len(client) else None,
        modes={
            str(mode): int((client["mode"] == mode).sum()) * scenario.control.dt
            for mode in Mode
            if (client["mode"] == mode).any()
        },
        mode=str(Mode(client["mode"][-1])) if len(client) else None,
        reason=str(Reason(client["reason"][-1])) if len(client) else None,
        event_ratio=event_ratio,
        uplink_horizons=horizons,
        uplink_packets=_count(netem, UPLINK),
        uplink_bytes=_bytes(netem, UPLINK),
        downlink_packets=_count(netem, DOWNLINK),
        downlink_bytes=_bytes(netem, DOWNLINK),
        **_rates(netem, duration_s),
        lost=None if netem is None else int(netem["lost"].sum()),
        reordered=None if netem is None else int(netem["overtaken"].sum()),
        stale=stale,
        drops=drops(figures, int(client["vehicle"][0])) if figures and len(client) else None,
        age_ms_p50=_quantile(age_ms, 0.5),
        age_ms_p99=_quantile(age_ms, 0.99),
        aoi_s_mean=_mean(aoi_s),
        aoi_s_peak=_mean(aoi_s[:-1][np.diff(aoi_s) < 0.0]),
        plan_age_s_mean=_mean(plan_age_s),
        effort_mps=math.sqrt((changes**2).sum(axis=1).mean()) if len(changes) else None,
        saturated=_mean((np.abs(flown["input"]) >= AT_BOUND * scenario.u_max).any(axis=1)),
        too_fast=_too_fast(scenario, client),
        solve_ms_p50=_quantile(solve_ms, 0.5),
        solve_ms_p99=_quantile(solve_ms, 0.99),
        deadline_misses=missed,
        estimate_error_m=_rms(off) if off.any() and np.isfinite(off).all() else None,
        secure=secure,
    )


def desired(scenario: Scenario, client: Rows, server: Rows | None = None) -> Array:
    """Desired position at every step of one vehicle [m]; shape (steps, axes).

    Where a live point was, and which goal a vehicle of a mission had, only the server knows: at a
    step that it has no row of, it is what it was before. What nobody knows is NaN.

    Args:
        client: rows of the vehicle.
        server: rows of the server, of any vehicles.
    """
    if scenario.reference.shape != "live" and not scenario.is_mission:
        times_s, vehicles = client["step"] * scenario.control.dt, client["vehicle"][:1].tolist()
        return scenario.make_reference(*vehicles)(times_s)[..., 0]
    known = client[:0] if server is None else server[np.isin(server["vehicle"], client["vehicle"])]
    if not len(known):
        return np.full((len(client), scenario.model.axes), np.nan)
    known = known[np.argsort(known["step"], kind="stable")]
    at = np.searchsorted(known["step"], client["step"], side="right") - 1
    positions: Array = known["reference"][np.maximum(at, 0), :, 0]
    return positions


def _too_fast(scenario: Scenario, client: Rows) -> float | None:
    """Share of the steps at which the desired trajectory is too fast to be followed."""
    if not (is_known(scenario) and len(client)):
        return None
    velocity = scenario.make_reference()(client["step"] * scenario.control.dt)[..., 1]
    return float(is_too_fast(scenario, velocity).mean())


def position_error(scenario: Scenario, client: Rows, server: Rows | None = None) -> Array:
    """Position minus desired position at every step [m]; shape (steps, axes); see `desired`."""
    error: Array = client["state"][..., 0] - desired(scenario, client, server)
    return error


def _estimate_error(scenario: Scenario, client: Rows) -> Array:
    """Difference of the position that was flown by from the true one [m]; shape (steps, axes).

    With a dead time it is that of a dead time later; NaN where the flight has ended by then.
    """
    known: Array = client["estimate"][..., 0]
    true = client["state"][..., 0]
    late, step = np.array(scenario.terms().dead_time_s) / scenario.control.dt, client["step"]
    if not len(step) or not late.any():
        return known - true
    met = [
        np.interp(step + steps, step, true[:, axis], right=np.nan)
        for axis, steps in enumerate(late)
    ]
    error: Array = known - np.stack(met, axis=1)
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


def _rates(netem: Rows | None, duration_s: float) -> dict[str, float]:
    """Packets and bytes on the line a second, up, down and both ways; none where not measured."""
    if netem is None or duration_s == 0.0:
        return {}
    packets, sizes = {}, {}
    for name, direction in (("uplink_", UPLINK), ("downlink_", DOWNLINK)):
        rows = netem[netem["direction"] == direction]
        packets[name] = len(rows) / duration_s
        sizes[name] = (int(rows["bytes"].sum()) + HEADER_BYTES * len(rows)) / duration_s
    packets[""], sizes[""] = sum(packets.values()), sum(sizes.values())
    return {f"{name}packets_per_s": rate for name, rate in packets.items()} | {
        f"{name}bytes_per_s": rate for name, rate in sizes.items()
    }


def _mean(values: Array) -> float | None:
    return float(values.mean()) if len(values) else None


def _quantile(values: Array, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def least_separation(
    each: Sequence[Rows], began_s: Sequence[float], dt_s: float, height_scale: float = 1.0
) -> float | None:
    """Smallest distance between two vehicles while both are on a mission [m]; None without.

    See `separations`.
    """
    _, least_m = separations(each, began_s, dt_s, height_scale)
    return float(np.nanmin(least_m)) if np.isfinite(least_m).any() else None


def separations(
    each: Sequence[Rows], began_s: Sequence[float], dt_s: float, height_scale: float = 1.0
) -> tuple[Array, Array]:
    """Distance between the two vehicles on a mission that are nearest to each other, over time.

    Each vehicle is on it from the first step on at which it follows what the server has sent.

    Args:
        each: rows of the client's part of each vehicle, by their steps.
        began_s: time at which step 0 of each began, of one clock [s].
        dt_s: length of a step [s].
        height_scale: factor of distances along the third axis, see `MissionConfig`.

    Returns:
        times of that clock [s; shape (n,)], none of fewer than two vehicles, and distances [m],
        NaN where fewer fly.
    """
    tracks = [
        track(rows, began, dt_s, height_scale)
        for rows, began in zip(each, began_s, strict=True)
        if (rows["mode"] == Mode.TRACK).any()
    ]
    return nearest(tracks, dt_s)


Track = tuple[Array, Array]
"""Times [s; shape (n,)] and positions of a vehicle then, heights scaled [m; shape (n, axes)]."""


def track(
    rows: Rows, began_s: float, dt_s: float, height_scale: float = 1.0, *, whole: bool = False
) -> Track:
    """Track of a vehicle, see `separations`.

    Args:
        rows: rows of the client's part of it.
        began_s: time at which its step 0 began [s].
        dt_s: length of a step [s].
        height_scale: see `separations`.
        whole: whether it begins with the first row, and not at the first step on a mission.
    """
    flown = rows if whole else rows[np.argmax(rows["mode"] == Mode.TRACK) :]
    at = flown["state"][:, :, 0].copy()
    at[:, 2:] *= height_scale
    return began_s + flown["step"] * dt_s, at


def nearest(tracks: Sequence[Track], dt_s: float) -> tuple[Array, Array]:
    """Distance between the two vehicles that are nearest to each other, over time; see
    `separations`.

    Args:
        tracks: one of each vehicle.
        dt_s: time from one distance to the next [s].
    """
    if len(tracks) < 2:
        return np.zeros(0), np.zeros(0)
    begin, end = min(times[0] for times, _ in tracks), max(times[-1] for times, _ in tracks)
    grid_s = np.arange(begin, end, dt_s)
    places = [
        np.stack([np.interp(grid_s, times, x, np.nan, np.nan) for x in at.T], axis=1)
        for times, at in tracks
    ]
    least_m = np.full(len(grid_s), np.nan)
    for number, one in enumerate(places):
        for other in places[:number]:
            np.fmin(least_m, np.linalg.norm(one - other, axis=1), out=least_m)
    return grid_s, least_m
