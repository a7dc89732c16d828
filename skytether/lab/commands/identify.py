"""`skytether identify`: identify a vehicle's model from small steps of velocity."""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from skytether.client import vehicles
from skytether.figures import flights as figures
from skytether.figures.tables import to_csv
from skytether.lab.commands import tables
from skytether.lab.commands.pool import writing
from skytether.lab.identify import outcome, picture
from skytether.lab.identify.fit import Fit, fit, misfit, verdict
from skytether.lab.identify.flight import Identifying
from skytether.lab.identify.outcome import AXES, AxisOutcome, AxisResults
from skytether.lab.identify.responses import responses
from skytether.lab.identify.steps import (
    STEP_MIN_MPS,
    Experiment,
    ExperimentPlan,
    default_hold_s,
    default_speeds,
    fenced,
)
from skytether.ros2.graph import Node
from skytether.shared.base import files, machine_code
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.line import Line
from skytether.shared.endpoints.steady import Steady
from skytether.shared.events.flight import Event
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags
from skytether.shell.driving import driver
from skytether.shell.host.udp import AddressError
from skytether.sim.world import World

SCENARIO, PICTURE, MEASURED = "scenario.toml", "steps.png", "measured.csv"
OUTCOME = "identified.json"
NUMBER = 1
REPEATS_MAX, HOLD_MAX_S = 100, 60.0
VIRTUAL_MAX_NS = 7200 * SECOND_NS


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of `skytether identify`."""

    kind: Annotated[str, Argument(metavar="KIND", positional=True)] = ""
    """Vehicle to fly (`skytether list vehicles`), in place of `vehicle.kind`. Kinds with real
    hardware, such as mavlink, fly in real time; others fly in virtual time."""
    scenario: str = "demo"
    """Scenario to be flown later: a name (`skytether list scenarios`) or a .toml file. The scenario
    that is written extends this scenario."""
    speed: Annotated[tuple[float, ...], Argument(metavar="MPS")] = ()
    """Size of the velocity steps [m/s], one number for all axes or one for each axis. By default
    the reference's largest speed on the axis, but at least half of its largest speed on any axis.
    """
    also: Annotated[tuple[float, ...], Argument(metavar="MPS")] = ()
    """Further sizes of velocity steps to fly [m/s], to measure the errors of models that are
    identified at other sizes."""
    hold: float | None = None
    """Time for which each velocity step is held [s]; by default four time constants of the
    scenario's model plus its dead time, within 3 to 6 s."""
    repeats: int = 3
    """Number of repetitions on each axis, of four steps each: out, back, to the other side,
    back."""
    set_parameters: bool = False
    """Set parameters of the autopilot so that the vehicle is safe if set-points stop. Without
    --set-parameters, unsafe values are only reported, and the vehicle is not armed."""
    out: Path = Path("identified")
    """Folder for the scenario (scenario.toml), the picture (steps.png), the measurements
    (measured.csv) and the results for programs (identified.json)."""
    plugin: command.Plugins = ()
    config: ScenarioFlags = Scenario()


@dataclass(frozen=True, slots=True)
class SizeFlown:
    flight: Identifying
    axes: list[AxisOutcome]


class IdentificationTold(msgspec.Struct, frozen=True):
    """Results for programs, the content of identified.json."""

    scenario: str
    kind: str
    ended: str
    hold_s: float
    flown_s: float
    axes: list[AxisResults]
    sizes: list[list[AxisResults]]
    costs: list[dict[str, float]]


def identify(argv: Sequence[str]) -> None:
    """Identify the model of a vehicle: gain, time constant and dead time of each axis.

    The vehicle takes off, flies small steps of velocity out and back inside its fence, one axis
    after another, and lands. The fitted model is printed with 95 % intervals, drawn, and written as
    a scenario that can be flown at once. If the scenario has no fence, the vehicle stays near its
    starting point. Ctrl-C makes the vehicle land; its measurements are kept.
    """
    options = command.parse(
        IdentifyOptions(),
        argv,
        "skytether identify",
        identify.__doc__,
        leads=False,
        is_final=False,
    )
    scenario, plans = _asked(options)
    flies = vehicles.make(scenario, NUMBER)
    if len(plans) > 1 and flies.port:
        raise CommandError("--also: got a vehicle with hardware, expected a simulated vehicle", 2)
    if options.set_parameters and not flies.set_parameters():
        kind = f"got vehicle.kind = {scenario.vehicle.kind!r}, expected a kind with parameters"
        raise CommandError(f"--set-parameters: {kind}", command.CONFIGURATION)
    figures.check(options.out / PICTURE)
    command.claim_folder("--out", options.out, SCENARIO, PICTURE, MEASURED, OUTCOME)
    flown = [_fly(scenario, plan, sets=options.set_parameters) for plan in plans]
    if failure := flown[0].flight.failure:
        raise CommandError(str(failure))
    _tell(options, scenario, flown)
    if why := flown[0].flight.why:
        code = command.INTERRUPTED if why == "interrupted" else command.RUN
        raise CommandError(f"the flight ended early: {why}; measurements in {options.out}", code)
    _write_scenario(options, scenario, flown[0])


def _asked(options: IdentifyOptions) -> tuple[Scenario, list[ExperimentPlan]]:
    """Scenario with the requested kind of vehicle, and one experiment for each size of the steps.

    Raises CommandError or ConfigError if the request cannot be flown.
    """
    table = reading.to_table(options.config)
    if options.kind:
        table["vehicle"] |= {"kind": options.kind}
    scenario = reading.check(table, f"{options.scenario} and the command line")
    command.check_count("--repeats", options.repeats, REPEATS_MAX)
    hold_s = default_hold_s(scenario) if options.hold is None else options.hold
    if not 0.5 <= hold_s <= HOLD_MAX_S:
        raise CommandError(f"--hold: got {hold_s:g}, expected 0.5 to {HOLD_MAX_S:g} s", 2)
    speeds = options.speed or default_speeds(scenario)
    sizes = [_size(scenario, "--speed", speeds)]
    sizes += [_size(scenario, "--also", (each,)) for each in options.also]
    return scenario, [ExperimentPlan(size, hold_s, options.repeats) for size in sizes]


def _size(scenario: Scenario, flag: str, given: Sequence[float]) -> tuple[float, ...]:
    """Size of the velocity steps on each axis [m/s]; raises CommandError if it cannot be flown."""
    axes = scenario.model.axes
    if len(given) not in (1, axes):
        raise CommandError(f"{flag}: got {len(given)} numbers, expected 1 or {axes}", 2)
    speeds = tuple(given) * (axes if len(given) == 1 else 1)
    limit = scenario.fence.speed_mps or math.inf
    for speed, bound in zip(speeds, scenario.u_max.tolist(), strict=True):
        most = min(bound, limit)
        if not STEP_MIN_MPS <= speed <= most:
            bounds = f"{STEP_MIN_MPS:g} to {most:g} m/s (model.u_max, fence.speed_mps)"
            raise CommandError(f"{flag}: got {speed:g}, expected {bounds}", 2)
    return speeds


def _fly(scenario: Scenario, plan: ExperimentPlan, *, sets: bool) -> SizeFlown:
    """Fly an experiment, in real time if the vehicle has hardware.

    Args:
        sets: whether parameters of the autopilot may be set.

    Raises:
        CommandError: the connection to the hardware cannot be opened.
    """
    flies = vehicles.make(scenario, NUMBER)
    if sets and not flies.set_parameters():
        kind = f"got vehicle.kind = {scenario.vehicle.kind!r}, expected a kind with parameters"
        raise CommandError(f"--set-parameters: {kind}", 2)
    within = fenced(scenario, plan)
    if within is not scenario:
        _say(f"no fence: the vehicle stays within {within.fence.radius_m:g} m of its start")
    flight = Identifying(within, flies, Experiment(within, plan))
    terminal.prepare(
        machine_code.missing() if "skytether.shared.base.kernel" in sys.modules else []
    )
    title = f"identifying {scenario.vehicle.kind}"
    with terminal.progress(title, plan.duration_s) as bar:

        def show(*_: object) -> None:
            bar(flight.flown_s, _doing(flight))

        if flies.port is None:
            _virtually(flight, show)
        else:
            _really(flight, vehicles.connection(flies, scenario), show)
    steps, cut = flight.experiment.steps, flight.experiment.cut
    axes = []
    for number, speed in enumerate(plan.speeds):
        found = responses(flight.inputs, flight.measured, steps, number)
        axes.append(AxisOutcome(speed, cut[number], found, fit(found)))
    return SizeFlown(flight, axes)


def _doing(flight: Identifying) -> str:
    if not flight.flown_s:
        return "taking off"
    return f"{len(flight.experiment.steps)} steps" if not flight.is_over else "landing"


def _virtually(flight: Identifying, show: Callable[[], None]) -> None:
    world = World()
    world.add("vehicle", flight)
    with command.interruptible() as interrupted:

        def over() -> bool:
            show()
            return flight.finished or interrupted()

        world.run(over, limit_ns=VIRTUAL_MAX_NS)
        if not flight.finished:
            flight.close(now_ns=world.now_ns)


def _really(flight: Identifying, line: Line | Node | None, show: Callable[[], None]) -> None:
    """Fly in real time; raises CommandError if the connection to the hardware cannot be opened."""
    try:
        shell = driver.Shell(Steady(flight), None, line=line)
    except AddressError as error:
        raise CommandError(str(error)) from None
    driver.run([shell], on_event=_say, on_second=show)


def _say(line: Event | str) -> None:
    print(line, file=sys.stderr)


# -- results ---------------------------------------------------------------------------------


def _tell(options: IdentifyOptions, scenario: Scenario, flown: Sequence[SizeFlown]) -> None:
    first, out = flown[0], options.out
    costs = _costs(flown) if len(flown) > 1 else []
    results = IdentificationTold(
        scenario=options.scenario,
        kind=scenario.vehicle.kind,
        ended=first.flight.why,
        hold_s=first.flight.experiment.plan.hold_s,
        flown_s=first.flight.flown_s,
        axes=_all_results(first),
        sizes=[_all_results(each) for each in flown[1:]],
        costs=costs,
    )
    with writing(out):
        files.write(
            out / OUTCOME, msgspec.json.format(msgspec.json.encode(results), indent=2) + b"\n"
        )
        files.write(out / MEASURED, _measured(first.flight, scenario.model.axes).encode())
        figures.save(picture.drawn(first.axes), out / PICTURE, dpi=130)
    _show_models(first)
    for name, axis in zip(AXES, first.axes, strict=False):
        print(f"{name}: {verdict(axis.fit) if axis.fit else outcome.describe(axis)}")
    if costs:
        _show_costs(flown, costs)


def _all_results(flown: SizeFlown) -> list[AxisResults]:
    return [outcome.axis_results(name, axis) for name, axis in zip(AXES, flown.axes, strict=False)]


def _measured(flight: Identifying, axes: int) -> str:
    """All measurements as CSV text, each with the input in force at its time."""
    names = AXES[:axes]
    header = ["time_s", *(f"{what}_{name}" for what in ("p", "v", "u") for name in names)]
    inputs, nothing, rows, at = flight.inputs, [None] * axes, [], 0
    zero_ns = inputs[0][0] if inputs else 0
    for stamp_ns, position, velocity in sorted(flight.measured, key=lambda each: each.stamp_ns):
        while at + 1 < len(inputs) and inputs[at + 1][0] <= stamp_ns:
            at += 1
        flown = inputs[at][1] if inputs and inputs[at][0] <= stamp_ns else [0.0] * axes
        time_s = (stamp_ns - zero_ns) / SECOND_NS
        rows.append([time_s, *(position or nothing), *(velocity or nothing), *flown])
    return to_csv(header, rows)


def _show_models(flown: SizeFlown) -> None:
    rows = []
    heading = ("axis", "step [m/s]", "steps", "gain", "time constant [s]", "dead time [s]")
    for name, axis in zip(AXES, flown.axes, strict=False):
        row = [name, f"{axis.speed:g}", axis.steps]
        if found := axis.fit:
            keys = ("gain", "tau_s", "dead_time_s")
            row += [outcome.with_interval(key, found.numbers, found.within) for key in keys]
            row += [f"{found.misfit.rms:.1%}", f"{found.misfit.largest:.1%}"]
        rows.append(row)
    title = "first order with dead time, 95 % intervals"
    tables.show(title, (*heading, "residual, RMS", "largest"), rows)


def _costs(flown: Sequence[SizeFlown]) -> list[dict[str, float]]:
    """Largest errors in steps of the requested size, of the models identified at each size."""
    measured = [axis.responses for axis in flown[0].axes]

    def off(model: Fit | None, axis: int) -> float:
        if model is None or not measured[axis]:
            return math.nan
        return misfit(measured[axis], model.numbers).largest

    return [
        {
            name: off(axis.fit, n)
            for n, (name, axis) in enumerate(zip(AXES, each.axes, strict=False))
        }
        for each in flown
    ]


def _show_costs(flown: Sequence[SizeFlown], costs: Sequence[dict[str, float]]) -> None:
    rows = []
    for one, cost in zip(flown, costs, strict=True):
        of = ", ".join(f"{axis.speed:g}" for axis in one.axes)
        rows.append((of, *(f"{each:.1%}" for each in cost.values())))
    title = (
        "Error of models identified at other sizes: largest difference from the first row's steps"
    )
    tables.show(title, ("model of [m/s]", *costs[0]), rows)


def _write_scenario(options: IdentifyOptions, scenario: Scenario, flown: SizeFlown) -> None:
    """Write the scenario with the identified model, and check that it can be flown.

    Raises CommandError if there is no model, or the scenario cannot be flown.
    """
    base = reading.load_base(options.scenario)
    text = outcome.scenario_text(scenario, options.scenario, base, flown.axes)
    if text is None:
        missing = [n for n, axis in zip(AXES, flown.axes, strict=False) if axis.fit is None]
        raise CommandError(f"no scenario is written: too few steps of {', '.join(missing)}")
    file = options.out / SCENARIO
    with writing(options.out):
        files.write(file, text)
    try:
        reading.load(str(file))
    except ConfigError as error:
        raise CommandError(f"the identified model cannot be flown: {error}") from None
    print(f"The scenario is {file}, the picture {options.out / PICTURE}.")
