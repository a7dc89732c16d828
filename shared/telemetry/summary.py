"""Summary of a flight, computed from its record."""

import math
from collections import Counter
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
from skytether.shared.telemetry.sent import sent_by
from skytether.shared.wire.protocol import NO_HORIZON, Mode

AT_BOUND = 1.0 - 1e-6
"""Share of the bound above which an input counts as bounded. It is below 1, because inputs are
rounded when they are sent."""
WORSE = (Mode.BRAKE, Mode.LAND, Mode.RETURN, Mode.FAULT)
"""Modes in which a vehicle no longer follows its plan because something went wrong."""
STOPPED = (*WORSE, Mode.HOVER, Mode.INIT, Mode.SYNC, Mode.READY)
"""Modes that count as part of a stop that began in a mode of WORSE."""


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of one vehicle's flight; a field is None if it was not measured, or its record is
    missing.
    """

    scenario: str
    seed: int
    duration_s: float
    steps: int
    """Number of steps that the client flew."""
    rmse_x: float | None
    """Root mean square of the position error along x, from `settle` on [m]."""
    rmse_y: float | None
    rmse_z: float | None
    """Root mean square of the altitude error [m]; None in the plane."""
    rmse_xy: float | None
    error_max: float | None
    """Largest distance from the desired trajectory, from `settle` on [m]."""
    covered: float | None
    """Share of the steps with a planned input; in the other steps the vehicle hovered, braked, or
    held the last input."""
    modes: dict[str, float]
    """Time in each mode that occurred [s], see `shared.wire.protocol.Mode`."""
    mode: str | None
    """Last mode of the vehicle."""
    reason: str | None
    """Reason for the last mode."""
    event_ratio: float | None
    """Share of the server's steps at which a horizon was sent."""
    uplink_horizons: int | None = None
    """Number of packets with a horizon that the server sent; the other uplink packets are
    heartbeats and packets of the handshake."""
    uplink_above: int | None = None
    """Number of horizons sent because of the trigger's figure, see `telemetry.sent.SentBy`."""
    uplink_due: int | None = None
    """Number of horizons sent as a heartbeat, by a schedule, or as the first plan."""
    uplink_packets: int | None
    """Number of packets that entered the network from the server, including lost packets."""
    uplink_bytes: int | None
    """UDP payload of all uplink packets [B]."""
    downlink_packets: int | None
    downlink_bytes: int | None
    paths: list[tuple[int, int]] | None = None
    """Number of uplink and downlink packets on each path; None with a single path."""
    uplink_packets_per_s: float | None = None
    """Rate of packets from the server, including heartbeats and lost packets [1/s]."""
    uplink_bytes_per_s: float | None = None
    """Data rate of the packets from the server, with HEADER_BYTES per packet [B/s]."""
    downlink_packets_per_s: float | None = None
    """Rate of packets from the vehicle [1/s]."""
    downlink_bytes_per_s: float | None = None
    """Data rate of the packets from the vehicle, with HEADER_BYTES per packet [B/s]."""
    packets_per_s: float | None = None
    """Rate of packets both ways [1/s]."""
    bytes_per_s: float | None = None
    """Data rate both ways, with HEADER_BYTES per packet [B/s]."""
    lost: int | None
    """Number of packets lost by the network, both ways."""
    reordered: int | None
    """Number of packets overtaken by a later one, both ways."""
    stale: int
    """Number of messages discarded at either end because a newer one had arrived."""
    drops: dict[str, dict[str, int]] | None = None
    """Number of packets that server, netem and client dropped, by reason (docs/operating.md);
    server and netem count the packets of all vehicles. None without the figures of the
    processes."""
    plugin_errors: dict[str, int] | None = None
    """Number of failures of a plug-in's code at the server, by kind of plug-in, for all vehicles
    together. None without the figures of the processes."""
    age_ms_p50: float | None
    """Median over all steps of the age of the observation behind the flown input [ms]."""
    age_ms_p99: float | None
    aoi_s_mean: float | None
    """Mean age of information: the age of the observation from which the input was computed [s],
    over the steps from `settle` on."""
    aoi_s_peak: float | None
    """Mean of the peaks of the age of information [s]. A peak is the age at a step after which the
    age decreases."""
    plan_age_s_mean: float | None
    """Mean time since the horizon in force was made [s], over the steps from `settle` on. This is
    the age of information that only the server has, such as the position of a target."""
    effort_mps: float | None
    """Root mean square of the change of the input from step to step, over all axes together, from
    `settle` on [m/s]."""
    saturated: float | None
    """Share of the steps from `settle` on at which the input is at its bound on some axis."""
    too_fast: float | None = None
    """Share of the steps at which the desired trajectory is faster than u_max times the gain on
    some axis, so that no vehicle can follow it; None if only the server knows the trajectory."""
    solve_ms_p50: float | None
    """Median wall-clock time of both MPCs of a step [ms]; None for a virtual flight."""
    solve_ms_p99: float | None
    deadline_misses: int
    """Number of steps missed by server or client."""
    estimate_error_m: float | None = None
    """Root mean square of the error of the position used by feedback, from `settle` on [m]; None if
    that position is exact."""
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
    """Summary of one vehicle's flight.

    Args:
        name: name of the scenario.
        client: rows of the vehicle in the client's part.
        server: rows of the server, of any vehicles.
        netem: rows of netem, of all flows.
        figures: figures of each process by its name, as in `Record.figures`.
        secure: whether the link was authenticated and encrypted.
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
    sent, event_ratio, solve_ms = None, None, np.empty(0)
    if server is not None:
        rows = server[np.isin(server["vehicle"], client["vehicle"])]
        sent = sent_by(rows)
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
        uplink_horizons=sum(sent) if sent else None,
        uplink_above=sent.above if sent else None,
        uplink_due=sent.due if sent else None,
        uplink_packets=_count(netem, UPLINK),
        uplink_bytes=_bytes(netem, UPLINK),
        downlink_packets=_count(netem, DOWNLINK),
        downlink_bytes=_bytes(netem, DOWNLINK),
        paths=_paths(scenario, netem),
        **_rates(netem, duration_s),
        lost=None if netem is None else int(netem["lost"].sum()),
        reordered=None if netem is None else int(netem["overtaken"].sum()),
        stale=stale,
        drops=drops(figures, int(client["vehicle"][0])) if figures and len(client) else None,
        plugin_errors=plugin_errors(figures) if figures else None,
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


PLUGINS = ("trigger", "planner", "scheme")
"""Kinds of plug-ins whose failures a server counts."""


def plugin_errors(figures: Mapping[str, Any]) -> dict[str, int]:
    """Number of failures of a plug-in's code, by kind of plug-in; empty if no code failed."""
    found = Counter[str]()
    for process, reported in figures.items():
        if process.startswith("server"):
            for kind in PLUGINS:
                found[kind] += reported.get("counts", {}).get(f"{kind}_errors", 0)
    return dict(+found)


def desired(scenario: Scenario, client: Rows, server: Rows | None = None) -> Array:
    """Desired position at every step of one vehicle [m]; shape (steps, axes).

    Only the server's record has the position of a live point and the goal of a vehicle on a
    mission. A step without a row of the server gets the value of the previous row, or of the
    first row if there is none before. NaN: unknown.

    Args:
        client: rows of the vehicle.
        server: rows of the server, of any vehicles.
    """
    if scenario.reference.shape != "live" and not scenario.keeps_apart:
        times_s, vehicles = client["step"] * scenario.control.dt, client["vehicle"][:1].tolist()
        return scenario.make_reference(*vehicles)(times_s)[..., 0]
    server_rows = (
        client[:0] if server is None else server[np.isin(server["vehicle"], client["vehicle"])]
    )
    if not len(server_rows):
        return np.full((len(client), scenario.model.axes), np.nan)
    server_rows = server_rows[np.argsort(server_rows["step"], kind="stable")]
    at = np.searchsorted(server_rows["step"], client["step"], side="right") - 1
    positions: Array = server_rows["reference"][np.maximum(at, 0), :, 0]
    return positions


def _too_fast(scenario: Scenario, client: Rows) -> float | None:
    if not (is_known(scenario) and len(client)):
        return None
    velocity = scenario.make_reference()(client["step"] * scenario.control.dt)[..., 1]
    return float(is_too_fast(scenario, velocity).mean())


def position_error(scenario: Scenario, client: Rows, server: Rows | None = None) -> Array:
    """Position minus desired position at every step [m]; shape (steps, axes); see `desired`."""
    error: Array = client["state"][..., 0] - desired(scenario, client, server)
    return error


def _estimate_error(scenario: Scenario, client: Rows) -> Array:
    """Error of the position used by feedback [m]; shape (steps, axes).

    With a dead time, feedback uses the position predicted for one dead time later, so the true
    position is taken at that time. NaN: that time is after the flight's end.
    """
    flown_by: Array = client["estimate"][..., 0]
    true = client["state"][..., 0]
    late, step = np.array(scenario.terms().dead_time_s) / scenario.control.dt, client["step"]
    if not len(step) or not late.any():
        return flown_by - true
    met = [
        np.interp(step + steps, step, true[:, axis], right=np.nan)
        for axis, steps in enumerate(late)
    ]
    error: Array = flown_by - np.stack(met, axis=1)
    return error


def _rms(vectors: Array) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _last(rows: Rows, name: str) -> int:
    return int(rows[name][-1]) if len(rows) else 0


def _count(netem: Rows | None, direction: int) -> int | None:
    return None if netem is None else int((netem["direction"] == direction).sum())


def _bytes(netem: Rows | None, direction: int) -> int | None:
    return None if netem is None else int(netem["bytes"][netem["direction"] == direction].sum())


def _paths(scenario: Scenario, netem: Rows | None) -> list[tuple[int, int]] | None:
    count = len(scenario.paths)
    if netem is None or count == 1:
        return None
    ways = (netem["path"][netem["direction"] == each] for each in (UPLINK, DOWNLINK))
    up, down = (np.bincount(way, minlength=count).tolist() for way in ways)
    return list(zip(up, down, strict=True))


def _rates(netem: Rows | None, duration_s: float) -> dict[str, float]:
    """Packet and data rates of uplink, downlink and both together; empty if not measured."""
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
    """Smallest distance between two vehicles while both are on a mission [m]; see `separations`.

    None if no two vehicles were on a mission at the same time.
    """
    _, least_m = separations(each, began_s, dt_s, height_scale)
    return float(np.nanmin(least_m)) if np.isfinite(least_m).any() else None


def separations(
    each: Sequence[Rows], began_s: Sequence[float], dt_s: float, height_scale: float = 1.0
) -> tuple[Array, Array]:
    """Smallest distance between any two vehicles on a mission, over time.

    A vehicle is on the mission from the first step at which it follows a plan.

    Args:
        each: for each vehicle, its rows of the client's part, in order of steps.
        began_s: for each vehicle, the time at which its step 0 began, on a common clock [s].
        dt_s: length of a step [s].
        height_scale: factor of distances along the third axis, see `MissionConfig`.

    Returns:
        times on the common clock [s; shape (n,)], empty for fewer than two vehicles, and distances
            [m], NaN while fewer than two fly.
    """
    tracks = [
        track(rows, began, dt_s, height_scale)
        for rows, began in zip(each, began_s, strict=True)
        if (rows["mode"] == Mode.TRACK).any()
    ]
    return nearest(tracks, dt_s)


Track = tuple[Array, Array]
"""Times [s; shape (n,)] and positions of a vehicle, heights scaled [m; shape (n, axes)]."""


def track(
    rows: Rows, began_s: float, dt_s: float, height_scale: float = 1.0, *, whole: bool = False
) -> Track:
    """Positions of a vehicle over time; arguments as in `separations`.

    With `whole` the positions begin with the first row, not the first step on the mission.
    """
    flown = rows if whole else rows[np.argmax(rows["mode"] == Mode.TRACK) :]
    at = flown["state"][:, :, 0].copy()
    at[:, 2:] *= height_scale
    return began_s + flown["step"] * dt_s, at


def nearest(tracks: Sequence[Track], dt_s: float) -> tuple[Array, Array]:
    """Smallest distance between any two vehicles, over time; see `separations`.

    `dt_s` is the time from one distance to the next [s].
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
