"""Report: a page of tables and figures that opens offline, and the contents for `skytether
reproduce`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from msgspec.structs import asdict

from skytether.figures.page import Facts, Row, Table, as_text, rendered, table_of
from skytether.lab.engine.calibration import within
from skytether.lab.engine.intervals import Estimate
from skytether.lab.engine.studies import (
    EVENT,
    EVERY,
    PERIODIC,
    TRAFFIC,
    Cells,
    CellSummaries,
    MethodFlights,
    Study,
    TableEntry,
    periodic_wins,
    table_1,
)
from skytether.lab.engine.sweep import by_name
from skytether.lab.pages import plates
from skytether.lab.pages.plates import Plate, Samples
from skytether.shared.law.model import Array
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Record
from skytether.shared.telemetry.summary import summarise

TITLE = "Efficient networked UAV control using event-triggered predictive control, reproduced"
ABOUT = (
    "Jang, Son, Yoo, Kim, Johansson (2019), flown with Skytether: the same endpoints in virtual "
    "time and over UDP."
)


@dataclass(frozen=True, slots=True)
class Real:
    scenario: Scenario
    flight: Record
    netem: Mapping[str, Any]
    """Counters and lateness of netem in the flight."""


@dataclass(frozen=True, slots=True)
class Reproduction:
    table: tuple[Study, Cells]
    curves: Sequence[tuple[Study, Cells]]
    maps: CellSummaries
    """Summaries of the flights for Fig. 5, by λ and ε."""
    periods: CellSummaries
    """Summaries of flights with periodic sending, by period, for the curves of Fig. 5."""
    delay_ms: Array
    """Delay of each packet over UDP, measured and drawn by netem [ms]; shape (packets, 2)."""
    real: Mapping[str, Real]
    """Flights over UDP, by method."""
    samples: Samples
    """Complete records of some flights in virtual time, by method."""


@dataclass(frozen=True, slots=True)
class Drawn:
    title: str
    about: str
    """Introduction: one or two sentences on the scenario."""
    tables: Sequence[Table]
    pictures: Sequence[Plate]
    verdict: str
    figures_first: bool = False
    """Whether the page shows figures before tables."""


def draw(measured: Reproduction) -> Drawn:
    study, cells = measured.table
    columns = {method: cell for (value, method), cell in cells.items() if value == study.here}
    entries = table_1(columns)
    samples = measured.samples
    scenario = study.scenario
    pictures = [
        plates.delay(scenario.network.downlink, measured.delay_ms),
        plates.paths(samples),
        plates.events(samples),
        plates.maps(measured.maps, scenario.control),
        plates.pareto(measured.maps, measured.periods),
        *(plates.curve(*curve) for curve in measured.curves),
        plates.estimates(samples),
    ]
    tables = [paper_table(entries, columns), traffic_table(columns), real_table(measured)]
    return Drawn(TITLE, ABOUT, tables, pictures, verdict(entries, columns))


def paper_table(entries: Sequence[TableEntry], columns: Mapping[str, MethodFlights]) -> Table:
    runs, steps = len(columns[EVENT].runs), columns[PERIODIC].period
    ours, theirs = (_rmse(columns[method]) for method in (EVENT, PERIODIC))
    overlap = not periodic_wins(columns[EVENT], columns[PERIODIC])
    loss = f"{abs(ours / theirs - 1.0):.0%} {'more' if ours > theirs else 'less'}"
    says = (
        f"Means of {runs} flights a column with 95 % intervals, in metres; the paper's event ratio "
        f"is its “10 times smaller”. The last column is not in the paper: a packet every {steps} "
        f"steps, the rate nearest to the trigger's. Compared with it, the event trigger has {loss} "
        f"RMSE xy{', although the intervals overlap' if overlap else ''}."
    )
    shown = {
        "column": ("column", ""),
        "entry": ("entry", ""),
        "paper": ("paper", ".4f"),
        "here": ("here", ".4f"),
        "± 95 %": ("ci95", ".4f"),
        "deviation": ("deviation", "+.1%"),
    }
    title = "Table 1: RMSE to the desired trajectory"
    return table_of("table1", title, says, list(map(asdict, entries)), shown)


def traffic_table(columns: Mapping[str, MethodFlights]) -> Table:
    names = (*TRAFFIC, *SENT_BY)
    rows = [{"column": method} | by_name(names, cell.estimate) for method, cell in columns.items()]
    share = [
        (columns[EVENT].estimate(name)[0] or 0.0) / (columns[EVERY].estimate(name)[0] or 1.0)
        for name in TRAFFIC
    ]
    says = (
        "All packets that entered the network in a flight. The paper's “10 times” counts those on "
        f"the uplink alone: there the trigger sends {share[0]:.1%} of what every step takes; of "
        f"all packets, both ways, {share[4]:.1%}, and {share[5]:.1%} of all bytes. Of the plans, "
        "those “above” were sent because the trigger's figure exceeded its threshold, the others "
        "because a heartbeat, a first plan or the schedule was due."
    )

    def cell(name: str, row: Row) -> str:
        return as_interval((row[name], row[f"{name}_ci95"]), ",.0f")

    shown = {name.replace("_", " "): partial(cell, name) for name in names}
    title = "Packets and bytes (UDP payload)"
    return table_of("traffic", title, says, rows, {"column": ("column", ""), **shown})


SENT_BY = ("uplink_above", "uplink_due")
"""Names of the figures that count the plans sent by cause, see `shared.telemetry.sent.SentBy`."""
REAL = {
    "column": ("column", ""),
    "UDP": ("rmse_xy_udp", ".4f"),
    "same seed": ("rmse_xy_same_seed", ".4f"),
    "virtual": ("rmse_xy_virtual", ".4f"),
    "± 95 %": ("rmse_xy_virtual_ci95", ".4f"),
    "least": ("rmse_xy_least", ".4f"),
    "most": ("rmse_xy_most", ".4f"),
    "events, UDP": ("event_ratio_udp", ".3f"),
    "events, virtual": ("event_ratio_virtual", ".3f"),
    "solve p50 [ms]": ("solve_ms_p50", ".2f"),
    "p99 [ms]": ("solve_ms_p99", ".2f"),
    "misses": ("deadline_misses", "d"),
    "netem late p99 [ms]": ("netem_late_ms_p99", ".2f"),
}
"""Columns of `real_table`: name and format of the number, by heading."""


def real_table(measured: Reproduction) -> Table:
    study, cells = measured.table
    length_s = study.axis.values[1]
    rows: list[dict[str, Any]] = []
    within_range = 0
    for method, real in measured.real.items():
        flight, runs = real.flight, cells[length_s, method].runs
        udp = summarise(real.scenario, method, flight.client, flight.server, flight.netem)
        errors = [run.rmse_xy for run in runs if run.rmse_xy is not None]
        cell = cells[length_s, method]
        late_ms = max(real.netem[way]["error_ms_p99"] for way in ("uplink", "downlink"))
        least, most = min(errors, default=None), max(errors, default=None)
        if None not in (least, most, udp.rmse_xy):
            within_range += (least or 0.0) <= (udp.rmse_xy or 0.0) <= (most or 0.0)
        mean, half = cell.estimate("rmse_xy")
        rows.append(
            {
                "column": method,
                "rmse_xy_udp": udp.rmse_xy,
                "rmse_xy_same_seed": runs[0].rmse_xy,
                "rmse_xy_virtual": mean,
                "rmse_xy_virtual_ci95": half,
                "rmse_xy_least": least,
                "rmse_xy_most": most,
                "event_ratio_udp": udp.event_ratio,
                "event_ratio_virtual": cell.estimate("event_ratio")[0],
                "solve_ms_p50": udp.solve_ms_p50,
                "solve_ms_p99": udp.solve_ms_p99,
                "deadline_misses": udp.deadline_misses,
                "netem_late_ms_p99": late_ms,
            }
        )
    says = (
        f"{length_s:g} s over real UDP on loopback, three processes and netem, compared "
        f"with virtual time: same seed, and mean, least and most of {len(runs)} seeds. "
        f"{within_range} of {len(rows)} flights over UDP lie within the range of virtual time. The "
        f"phase between the server's ticks and the vehicle's steps is random in both, so equal "
        f"seeds do not give equal flights."
    )
    title = "RMSE xy [m] over real UDP and in virtual time"
    return table_of("real", title, says, rows, REAL)


def verdict(entries: Sequence[TableEntry], columns: Mapping[str, MethodFlights]) -> str:
    off = {(e.column, e.entry): e.deviation for e in entries if e.deviation is not None}
    near = sum(within(entry, deviation) for (_, entry), deviation in off.items())
    (column, entry), worst = max(off.items(), key=lambda item: abs(item[1]))
    ours, theirs = (_rmse(columns[method]) for method in (EVENT, PERIODIC))
    wins = periodic_wins(columns[EVENT], columns[PERIODIC])
    what = {1: "loses to", -1: "beats", 0: "does not differ significantly from"}[wins]
    return (
        f"{near} of {len(off)} entries of Table 1 are within tolerance; the farthest is {entry} of "
        f"“{column}”, {worst:+.1%}. At its own rate the event trigger {what} a packet every "
        f"{columns[PERIODIC].period} steps: {ours:.3f} m against {theirs:.3f} m."
    )


def _rmse(cell: MethodFlights) -> float:
    """Mean RMSE xy [m]; NaN if every flight failed."""
    mean = cell.estimate("rmse_xy")[0]
    return float("nan") if mean is None else mean


def as_interval(estimate: Estimate, spec: str) -> str:
    return " ± ".join(as_text(part, spec) for part in estimate)


def html(drawn: Drawn, scenario: Scenario, calls: Sequence[Mapping[str, Any]]) -> str:
    """HTML page of a report.

    `calls` has facts about each call of the command that made the report, in order.
    """
    call = calls[-1]
    versions = {"Python": call["python"], **call["versions"]}
    each = [f"{call['date']}, {call['runs']} runs, {call['seconds']} s" for call in calls]
    made = {
        "command": call["command"],
        "seeds": f"from {scenario.seed} on",
        "flights": f"{scenario.duration} s each, RMSE from {scenario.settle} s on",
        "date": call["date"],
        "machine": call["machine"],
        "commit": call["commit"] or "none: not run from a checkout",
        "versions": ", ".join(map(" ".join, versions.items())),
        "duration": f"{sum(call['seconds'] for call in calls):.1f} s in {len(calls)} "
        f"call{'s' * (len(calls) > 1)} that were completed: {'; '.join(each)}",
    }
    shown = (drawn.tables, drawn.pictures)[:: -1 if drawn.figures_first else 1]
    parts = [*shown[0], *shown[1], Facts("How it was made", made)]
    return rendered(drawn.title, f"{drawn.about} {drawn.verdict}", parts)
