"""Reports: tables, figures, what they say, in a page that opens offline; and the reproduction's."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from lab import plates
from lab.calibration import within
from lab.plates import Picture, Samples
from lab.studies import (
    EVENT,
    EVERY,
    PERIODIC,
    TRAFFIC,
    Cell,
    Cells,
    Entry,
    Flown,
    Study,
    periodic_wins,
    table_1,
)
from lab.sweep import to_csv
from shared.config import Scenario
from shared.model import Array
from shared.summary import summarise
from sim.flight import Flight

TITLE = "Efficient networked UAV control using event-triggered predictive control, reproduced"
ABOUT = (
    "Jang, Son, Yoo, Kim, Johansson (2019), flown with Skytether: the same endpoints in virtual "
    "time and over UDP."
)


@dataclass(frozen=True, slots=True)
class Real:
    """A flight over UDP."""

    scenario: Scenario
    flight: Flight
    netem: Mapping[str, Any]
    """What netem counted, and how late it was."""


@dataclass(frozen=True, slots=True)
class Measured:
    """All that was flown."""

    table: tuple[Study, Cells]
    curves: Sequence[tuple[Study, Cells]]
    maps: Flown
    periods: Flown
    delay_ms: Array
    real: Mapping[str, Real]
    """By method."""
    samples: Samples


@dataclass(frozen=True, slots=True)
class Table:
    """One of the report: its numbers as CSV, and as they are shown."""

    name: str
    title: str
    says: str
    csv: str
    heading: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Drawn:
    """What the report shows."""

    title: str
    about: str
    tables: Sequence[Table]
    pictures: Sequence[Picture]
    verdict: str


def draw(measured: Measured) -> Drawn:
    """All tables and figures."""
    study, cells = measured.table
    columns = {method: cell for (value, method), cell in cells.items() if value == study.here}
    entries = table_1(columns)
    samples = measured.samples
    servers = {method: real.flight.server for method, real in measured.real.items()}
    scenario = study.scenario
    pictures = [
        plates.delay(scenario.network.downlink, measured.delay_ms),
        plates.paths(samples),
        plates.events(samples),
        plates.maps(measured.maps, scenario.control),
        plates.pareto(measured.maps, measured.periods),
        *(plates.curve(*curve) for curve in measured.curves),
        plates.estimates(samples),
        plates.intervals(samples),
        plates.solve_times(servers, scenario.control.dt),
    ]
    tables = [paper_table(entries, columns), traffic_table(columns), real_table(measured)]
    return Drawn(TITLE, ABOUT, tables, pictures, verdict(entries, columns))


def paper_table(entries: Sequence[Entry], columns: Mapping[str, Cell]) -> Table:
    """Table 1, the paper's beside ours."""
    runs, steps = len(columns[EVENT].runs), columns[PERIODIC].period
    rows = [
        (
            *(entry.column, entry.entry, as_text(entry.paper, ".4f"), as_text(entry.here, ".4f")),
            *(as_text(entry.ci95, ".4f"), as_text(entry.deviation, "+.1%")),
        )
        for entry in entries
    ]
    ours, theirs = (_rmse(columns[method]) for method in (EVENT, PERIODIC))
    meet = not periodic_wins(columns[EVENT], columns[PERIODIC])
    loss = f"{abs(ours / theirs - 1.0):.0%} {'more' if ours > theirs else 'less'}"
    says = (
        f"Means of {runs} flights a column with 95 % intervals, in metres; the paper's event ratio "
        f"is its “10 times smaller”. The last column is no scheme of the paper's but a packet "
        f"every {steps} steps, the rate nearest to the trigger's: against it the event trigger has "
        f"{loss} RMSE xy{', though the intervals meet' if meet else ''}."
    )
    header = Entry.__struct_fields__
    text = to_csv(header, [[getattr(entry, name) for name in header] for entry in entries])
    heading = ("column", "entry", "paper", "here", "± 95 %", "deviation")
    return Table("table1", "Table 1: RMSE to the desired trajectory", says, text, heading, rows)


def traffic_table(columns: Mapping[str, Cell]) -> Table:
    """What the network carries."""
    found = {method: [cell.estimate(name) for name in TRAFFIC] for method, cell in columns.items()}
    header = ["column", *(name for figure in TRAFFIC for name in (figure, f"{figure}_ci95"))]
    text = to_csv(
        header,
        [[method, *(part for pair in pairs for part in pair)] for method, pairs in found.items()],
    )
    rows = [
        (method, *(f"{as_text(mean, ',.0f')} ± {as_text(half, ',.0f')}" for mean, half in pairs))
        for method, pairs in found.items()
    ]
    share = [
        (columns[EVENT].estimate(name)[0] or 0.0) / (columns[EVERY].estimate(name)[0] or 1.0)
        for name in TRAFFIC
    ]
    says = (
        f"Of a flight, all that entered the network. The paper's “10 times” counts packets on the "
        f"uplink alone: there the trigger sends {share[0]:.1%} of what every step takes; of all "
        f"packets, both ways, {share[4]:.1%}, and {share[5]:.1%} of all bytes."
    )
    heading = ("column", *(name.replace("_", " ") for name in TRAFFIC))
    return Table("traffic", "Packets and bytes (UDP payload)", says, text, heading, rows)


def real_table(measured: Measured) -> Table:
    """Over real UDP beside virtual time."""
    study, cells = measured.table
    length_s = study.axis.values[1]
    header = (
        *("column", "rmse_xy_udp", "rmse_xy_same_seed", "rmse_xy_virtual", "rmse_xy_virtual_ci95"),
        *("rmse_xy_least", "rmse_xy_most", "event_ratio_udp", "event_ratio_virtual"),
        *("solve_ms_p50", "solve_ms_p99", "deadline_misses", "netem_late_ms_p99"),
    )
    rows, within_range = [], 0
    for method, real in measured.real.items():
        flight, runs = real.flight, cells[length_s, method].runs
        udp = summarise(real.scenario, method, flight.client, flight.server, flight.netem)
        errors = [run.rmse_xy for run in runs if run.rmse_xy is not None]
        cell = cells[length_s, method]
        late_ms = max(real.netem[way]["error_ms_p99"] for way in ("uplink", "downlink"))
        least, most = min(errors, default=None), max(errors, default=None)
        if None not in (least, most, udp.rmse_xy):
            within_range += (least or 0.0) <= (udp.rmse_xy or 0.0) <= (most or 0.0)
        rows.append(
            (
                *(method, udp.rmse_xy, runs[0].rmse_xy, *cell.estimate("rmse_xy"), least, most),
                *(udp.event_ratio, cell.estimate("event_ratio")[0]),
                *(udp.solve_ms_p50, udp.solve_ms_p99, udp.deadline_misses, late_ms),
            )
        )
    specs = ("", *[".4f"] * 6, ".3f", ".3f", ".2f", ".2f", "d", ".2f")
    shown = [[as_text(value, spec) for value, spec in zip(row, specs, strict=True)] for row in rows]
    says = (
        f"{length_s:g} s over real UDP on loopback, three processes and netem, beside virtual "
        f"time: the run of the same seed, and mean, least and most of {len(runs)} seeds. "
        f"{within_range} of {len(rows)} flights over UDP lie within what virtual time says. Where "
        f"a server's tick falls within a vehicle's step is chance in both, so equal seeds do not "
        f"give equal flights."
    )
    heading = (
        *("column", "UDP", "same seed", "virtual", "± 95 %", "least", "most"),
        *("events, UDP", "virtual", "solve p50 [ms]", "p99 [ms]", "misses", "netem late p99 [ms]"),
    )
    title = "RMSE xy [m] over real UDP and in virtual time"
    return Table("real", title, says, to_csv(header, rows), heading, shown)


def verdict(entries: Sequence[Entry], columns: Mapping[str, Cell]) -> str:
    """The reproduction in two sentences."""
    off = {(e.column, e.entry): e.deviation for e in entries if e.deviation is not None}
    near = sum(within(entry, deviation) for (_, entry), deviation in off.items())
    (column, entry), worst = max(off.items(), key=lambda item: abs(item[1]))
    ours, theirs = (_rmse(columns[method]) for method in (EVENT, PERIODIC))
    wins = periodic_wins(columns[EVENT], columns[PERIODIC])
    what = {1: "loses to", -1: "beats", 0: "cannot be told from"}[wins]
    return (
        f"{near} of {len(off)} entries of Table 1 are within tolerance; the farthest is {entry} of "
        f"“{column}”, {worst:+.1%}. At its own rate the event trigger {what} a packet every "
        f"{columns[PERIODIC].period} steps: {ours:.3f} m against {theirs:.3f} m."
    )


def _rmse(cell: Cell) -> float:
    mean = cell.estimate("rmse_xy")[0]
    return float("nan") if mean is None else mean


def as_text(value: Any, spec: str) -> str:
    """A number as a table shows it, and a dash for none."""
    return "–" if value is None else format(value, spec)


def html(drawn: Drawn, scenario: Scenario, calls: Sequence[Mapping[str, Any]]) -> str:
    """The page.

    Args:
        calls: of the command that made it, the last one last.
    """
    from jinja2 import Environment, StrictUndefined  # takes a tenth of a second to import

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["base64"] = lambda content: base64.b64encode(content).decode()
    source = resources.files("lab").joinpath("report.html.jinja").read_text(encoding="utf-8")
    return environment.from_string(source).render(drawn=drawn, scenario=scenario, calls=calls)
