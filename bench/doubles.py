"""Doubles of flights over real UDP: how near each is to its recording, and whether the cause that
`skytether explain` names is what was done to the flight.

    python -m bench.doubles [--out FOLDER] [--only NAME]

Server, netem and client are processes on loopback, one flight after the other; each records its
part, and the parts are joined. In ten flights the vehicle is simulated, in three it is a simulated
autopilot that speaks MAVLink, with a quadrotor of its own in place of the model. FOLDER keeps the
recordings, and `doubles.json` with what was found.
"""

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import tyro

from bench.children import HOST, ChildProcess
from bench.harness import TextTable, progress
from skytether.explain import causes, doubles
from skytether.explain.cases import Bad, FlightCase, Stall
from skytether.explain.causes import CausePart
from skytether.explain.explanation import Explanation, explain
from skytether.explain.flying import CaseOutcome, fly
from skytether.shared.base import files
from skytether.shared.base.errors import ConfigError
from skytether.shared.events.flight import Flying, address_text
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shell.commandline import command
from skytether.view.recordings.joining import join
from skytether.view.recordings.recorded import read

PLAIN, FAIR, PAPER = "constant(0.05)", "uniform(0.05, 0.15) & loss(0.1)", "paper(0.4, 0.02, 2.0)"


@dataclass(frozen=True)
class Problem:
    """A flight, and what is done to it."""

    name: str
    expected: str
    """What the cause should be: uplink, downlink, server or client (stopped), the name of a
    property of the vehicle; or `refused`."""
    keys: Mapping[str, Any] = field(default_factory=dict)
    stopped: tuple[str, float, float] | None = None
    """Process that is stopped, when after the first step, and for how long [s]."""
    restarted_s: float | None = None
    """Time after the first step at which the server is killed and another one started [s]."""
    flavour: str | None = None
    """Autopilot; None for a simulated vehicle."""


def _path(uplink: str, downlink: str = "") -> dict[str, str]:
    return {"uplink": uplink, "downlink": downlink or uplink.partition(" & ")[0]}


def _network(uplink: str, downlink: str = "") -> dict[str, str]:
    return {f"network.{way}": text for way, text in _path(uplink, downlink).items()}


FIELD: Mapping[str, Any] = {
    "duration": 20.0,
    "settle": 3.0,
    "control.scheme": "trajectory",
    "vehicle.kind": "mavlink",
}
"""Keys of flights of an autopilot that differ from the scenario `autopilot`."""
PROBLEMS = (
    Problem("uplink out for 2 s", "uplink", _network(f"{PLAIN} & outage(8, 2)")),
    Problem(
        "uplink out for 2.5 s, paper's network", "uplink", _network(f"{PAPER} & outage(9, 2.5)")
    ),
    Problem(
        "uplink out for 3 s among losses",
        "uplink",
        _network(f"{PLAIN} & loss(0.3) & outage(7, 3)"),
    ),
    Problem("downlink out for 5 s", "downlink", _network(PLAIN, f"{PLAIN} & outage(7, 5)")),
    Problem(
        "both uplinks of two paths out for 3 s",
        "uplink",
        {"network.paths": [_path(f"{FAIR} & outage(8, 3)", FAIR)] * 2},
    ),
    Problem("server stopped for 2.5 s", "server", _network(PLAIN), ("server", 7.0, 2.5)),
    Problem("client stopped for 1 s", "client", _network(PLAIN), ("client", 7.0, 1.0)),
    Problem(
        "gusts of 3 m/s²",
        "gusts",
        {**_network(PLAIN), "vehicle.gust_mps2": 3.0, "vehicle.gust_every_s": 5.0},
    ),
    Problem(
        "a gain of 0.5",
        "a vehicle that differs from its model",
        {**_network(PLAIN), "vehicle.gain": [0.5]},
    ),
    Problem("server killed and restarted", "refused", _network(PLAIN), restarted_s=7.0),
    Problem(
        "ArduPilot, uplink out for 2.5 s",
        "uplink",
        {**FIELD, **_network(f"{PLAIN} & outage(18, 2.5)")},
        flavour="ardupilot",
    ),
    Problem(
        "ArduPilot in wind of 4 m/s, server stopped",
        "server",
        {**FIELD, **_network(PLAIN), "vehicle.steady_wind_mps": [4.0, 0.0, 0.0]},
        ("server", 8.0, 2.5),
        flavour="ardupilot",
    ),
    Problem(
        "PX4, uplink out for 2.5 s",
        "uplink",
        {**FIELD, **_network(f"{PLAIN} & outage(18, 2.5)")},
        flavour="px4",
    ),
)


class Found(msgspec.Struct, frozen=True):
    """What comes of a flight's double."""

    name: str
    expected: str
    until_m: float = 0.0
    """Largest distance of the double from the recording, up to the moment [m]."""
    whole_m: float = 0.0
    """The same in the whole flight [m]."""
    moment: str = ""
    cause: tuple[str, ...] = ()
    agrees: bool = False
    """Whether the cause is what was done."""
    flights: int = 0
    cpu_s: float = 0.0
    refused: str = ""
    """Why there is no explanation; empty if there is one."""


def record(problem: Problem, folder: Path) -> Path:
    """Fly a problem over UDP; returns its recording."""
    base = "autopilot" if problem.flavour else "demo"
    table = reading.to_table(reading.load(base))
    set_keys({"duration": 14.0, "settle": 3.0, "seed": 7, **problem.keys}, table)
    with ExitStack() as stack:
        scenario = folder / "scenario.toml"
        if problem.flavour:
            files.write(scenario, reading.to_toml(reading.check(table, "bench")))
            flags = "--flavour", problem.flavour, "--ready", "2", "--bind", f"{HOST}:0"
            autopilot = ChildProcess(stack, "autopilot", str(scenario), *flags)
            address = f"udpout:{address_text(*autopilot.address)}"
            set_keys({"vehicle.address": address}, table)
        files.write(scenario, reading.to_toml(reading.check(table, "bench")))

        def start(name: str, number: str, *flags: str) -> ChildProcess:
            part = folder / f"{name}{number}.mcap"
            parts.append(part)
            return ChildProcess(stack, name, str(scenario), "--record", str(part), *flags)

        parts: list[Path] = []
        server = start("server", "", "--bind", f"{HOST}:0")
        at = address_text(*server.address)
        netems = [
            start("netem", f" {n}", "--bind", f"{HOST}:0", "--server", at, "--path", str(n))
            for n in range(1, len(reading.check(table, "bench").paths) + 1)
        ]
        paths = [f"--path={HOST}={address_text(*each.address)}" for each in netems]
        unsafe = ["--set-parameters"] if problem.flavour else []
        client = start("client", "", *paths, "--new-flight", *unsafe)
        client.wait_for(Flying)
        if problem.stopped:
            name, at_s, for_s = problem.stopped
            time.sleep(at_s)
            (server if name == "server" else client).freeze(for_s)
        if problem.restarted_s:
            time.sleep(problem.restarted_s)
            server.kill()
            server = start("server", " again", "--bind", at)
        client.process.wait(120.0)
        for each in (server, *netems):
            each.stop()
        whole = folder / "flight.mcap"
        with files.replacing(whole) as file:
            join([read(part) for part in parts], file)
    return whole


def found(problem: Problem, path: Path) -> Found:
    """What `explain` says of a recording, without rescues and remedies."""
    flights, began_s = 0, time.process_time()

    def fly_all(cases: Sequence[FlightCase]) -> list[CaseOutcome]:
        nonlocal flights
        flights += len(cases)
        return [fly(each) for each in cases]

    known: Explanation | None = None
    try:
        case, recorded = doubles.double(read(path))
        for _, known in explain(case, problem.name, fly_all, recorded=recorded):
            if known.cause and all(part.error_m == part.error_m for part in known.cause.parts):
                break
    except ConfigError as error:
        agrees = problem.expected == "refused"
        return Found(problem.name, problem.expected, agrees=agrees, refused=str(error))
    cpu_s = time.process_time() - began_s
    assert known is not None
    assert known.nearness is not None
    moment, cause = known.moment, known.cause
    parts = cause.parts if cause else ()
    return Found(
        problem.name,
        problem.expected,
        known.nearness.until_m,
        known.nearness.whole_m,
        f"{moment.start_s:.1f} s: {moment.says}" if moment else "none",
        tuple(map(_named, parts)),
        bool(parts) and all(_is_expected(problem.expected, part) for part in parts),
        flights,
        cpu_s,
    )


def _named(part: CausePart) -> str:
    unit = part.unit
    if isinstance(unit, Bad):
        way = ("uplink", "downlink")[unit.lane[1]]
        return f"{way} {part.start_s:.1f} to {part.end_s:.1f} s"
    if isinstance(unit, Stall):
        return f"{unit.process} stopped {part.start_s:.1f} to {part.end_s:.1f} s"
    return causes.named(unit)


def _is_expected(expected: str, part: CausePart) -> bool:
    unit = part.unit
    if isinstance(unit, Bad):
        return expected == ("uplink", "downlink")[unit.lane[1]]
    return expected == (unit.process if isinstance(unit, Stall) else causes.named(unit))


def table(all_found: Sequence[Found]) -> TextTable:
    headings = ["flight", "distance until the moment, whole [m]", "moment", "cause", "as it was?"]
    headings += ["flights", "CPU [s]"]
    rows = [
        [
            each.name,
            "-" if each.refused else f"{each.until_m:.1g}, {each.whole_m:.1g}",
            each.moment or "-",
            "; ".join(each.cause) or ("refused" if each.refused else "the scenario itself"),
            "yes" if each.agrees else "no",
            str(each.flights),
            f"{each.cpu_s:.0f}",
        ]
        for each in all_found
    ]
    return TextTable(headings, rows)


@dataclass(frozen=True)
class DoublesOptions:
    out: Path | None = None
    """Folder for the recordings and `doubles.json`; recordings that are there are not flown again.
    """
    only: str = ""
    """CausePart of the names of the flights to fly."""


def main(argv: Sequence[str]) -> None:
    options = tyro.cli(DoublesOptions, args=argv, description=__doc__)
    with ExitStack() as stack:
        out = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        all_found = []
        problems = [each for each in PROBLEMS if options.only in each.name]
        for problem in progress(problems, "flying"):
            folder = out / "".join(c if c.isalnum() else "-" for c in problem.name)
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / "flight.mcap"
            all_found.append(found(problem, path if path.exists() else record(problem, folder)))
        files.write(out / "doubles.json", msgspec.json.format(msgspec.json.encode(all_found)))
    table(all_found).show("doubles of flights over UDP")


if __name__ == "__main__":
    sys.exit(command.main(main, sys.argv[1:], "doubles"))
