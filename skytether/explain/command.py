"""`skytether explain`: explain why a flight went wrong."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from skytether.cli import recordings
from skytether.explain import doubles, picture
from skytether.explain.cases import FlightCase, overridden
from skytether.explain.explanation import FIRST, STEPS, Explanation, check_same, explain
from skytether.explain.flying import CaseOutcome, Track, fly
from skytether.figures import flights as figures
from skytether.lab.commands.pool import Flags, Interrupted, PoolFlags, crew
from skytether.shared.base import extras
from skytether.shared.missions.mission import Mission
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import RECORDING, trace_hash
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError, ScenarioFlags, ScenarioName
from skytether.shell.commandline.options import read
from skytether.shell.host import system
from skytether.theorem.judgement import judged
from skytether.view.recordings.container import reading
from skytether.view.recordings.recorded import Recorded


@dataclass(frozen=True)
class ExplainOptions:
    """Options of `skytether explain`."""

    scenario: ScenarioName = "demo"
    """A scenario's name (`skytether list scenarios`), a .toml file, or a recording (.mcap) of a
    flight in virtual time or over UDP, or of `skytether policy join`."""
    at: Annotated[float | None, Argument(metavar="T")] = None
    """Time of flight of the moment to explain [s]; by default the most severe moment. For calls of
    a robot program: time of the gap since the start of the recording; by default all gaps."""
    vehicle: Annotated[int | None, Argument(metavar="N")] = None
    """Number of the vehicle of the moment to explain; by default any vehicle."""
    seeds: Annotated[int, Argument(metavar="N")] = 0
    """Number of further seeds with which each remedy is flown: those after the scenario's seed."""
    vehicles: Annotated[int | None, Argument(metavar="N")] = None
    """Number of vehicles, as in `skytether fleet`; by default one, or all vehicles of a mission. A
    recording contains this number."""
    json: Path | None = None
    """File for the explanation as JSON, rewritten after each step of the explanation."""
    figure: Path | None = None
    """File for a picture of the explanation (.png, .pdf or .svg)."""
    pool: PoolFlags = Flags()
    config: ScenarioFlags = Scenario()


def explain_flight(argv: Sequence[str]) -> None:
    """Fly a scenario in virtual time, and explain why something went wrong.

    The flight is repeated without some of its outages, lost and late packets, wind and noise, to
    find the smallest set of them with which the flight still goes wrong. Further flights show
    whether each is needed, whether one more delivered packet would have averted the problem, how
    long an outage must be, and what other keys would change, with --seeds also for other seeds.

    A recorded flight over UDP is replaced by its double, which flies in virtual time. Ctrl-C prints
    the explanation so far.

    For a recording of `skytether policy join`, the text gives the cause of each gap, in which no
    row of the policy remained, and what would have averted it: the recorded calls are replayed with
    the chunks that were lost, late or refused, with longer chunks and with another deadline.
    """
    if argv and argv[0].endswith(RECORDING):
        options = read(ExplainOptions(), argv, "skytether explain", explain_flight.__doc__)
        for option in command.OUTPUTS:
            command.claim_output(f"--{option}", getattr(options, option, None))
        if options.vehicles != ExplainOptions.vehicles:
            message = f"--vehicles: got {options.vehicles} with a recording, which has its own"
            raise CommandError(message, command.CONFIGURATION)
        if recordings.is_of_calls(Path(options.scenario)):
            _explain_calls(options)
            return
        found = recordings.opened(Path(options.scenario))
        if found.about.began and found.scenario.keeps_apart:
            _judge(options, found)
            return
        name, case, recorded = _recorded(found)
        if isinstance(recorded, Track) and options.seeds:
            message = (
                f"--seeds: got {options.seeds} with a flight over UDP, whose network is recorded"
            )
            raise CommandError(message, command.CONFIGURATION)
    else:
        options = command.parse(ExplainOptions(), argv, "skytether explain", explain_flight.__doc__)
        vehicles = _vehicles(options)
        command.check_count("--vehicles", vehicles, 255)
        case = FlightCase(
            options.config, vehicles, overridden=overridden(options.config, options.scenario)
        )
        name, recorded = options.scenario, ""
    if options.seeds:
        command.check_count("--seeds", options.seeds, 10_000)
    options.pool.check()
    if options.figure is not None:
        figures.check(options.figure)
    _explain(options, name, case, recorded)


def _vehicles(options: ExplainOptions) -> int:
    if options.vehicles is not None:
        return options.vehicles
    reference = options.config.unallocated_reference()
    return len(reference.vehicles) if isinstance(reference, Mission) else 1


def _explain_calls(options: ExplainOptions) -> None:
    """Explain the gaps in the calls of a robot program.

    Raises:
        CommandError: an option is for flights.
    """
    _check_unused(options, ("vehicle", "seeds", "figure"), "a recording of calls")
    with extras.named("policy"):
        from skytether.explain import calls, gaps
    path = Path(options.scenario)
    with reading(path):
        programs = calls.read(path)
        found = list(gaps.gaps(programs, options.at))
    if options.json is not None:
        command.write(options.json, msgspec.json.encode(found))
    print(gaps.text(programs, found))


def _check_unused(options: ExplainOptions, names: Sequence[str], what: str) -> None:
    """Refuse options; raises CommandError if one is given."""
    for name in names:
        if getattr(options, name) != getattr(ExplainOptions, name):
            raise CommandError(f"--{name}: got it with {what}", command.CONFIGURATION)


def _judge(options: ExplainOptions, recorded: Recorded) -> None:
    """Print the checked assumptions of the separation theorem, for a mission flown over UDP.

    Raises:
        CommandError: a part of the record is missing, or an option needs more flights.
    """
    which = "a flight over UDP, which cannot be flown again"
    _check_unused(options, ("at", "vehicle", "seeds", "json", "figure"), which)
    missing = {"client", "server", "plan"} - recorded.parts.keys()
    if missing:
        message = f"{recorded.path}: no rows of {', '.join(sorted(missing))}"
        raise CommandError(message, command.CONFIGURATION)
    print(judged(recorded.record, recorded.scenario))
    print("A flight over UDP cannot be flown again: what caused what is not said.")


def _recorded(recorded: Recorded) -> tuple[str, FlightCase, str | Track]:
    """Scenario name, case, and hash of a recorded flight; over UDP a track instead of the hash.

    Raises:
        CommandError: the flight cannot be flown again.
    """
    path, client = recorded.path, recorded.parts.get("client")
    if client is None:
        raise CommandError(f"{path}: no step was flown", command.CONFIGURATION)
    if recorded.about.began:
        return recorded.about.scenario, *doubles.double(recorded)
    case = FlightCase(
        recorded.scenario,
        vehicles=len(np.unique(client["vehicle"])),
        secure=recorded.about.secure,
        overridden=overridden(recorded.scenario, recorded.about.scenario),
    )
    return recorded.about.scenario, case, trace_hash(client)


def _explain(options: ExplainOptions, name: str, case: FlightCase, recorded: str | Track) -> None:
    """Explain a flight, and show the explanation even if it is incomplete.

    Args:
        recorded: hash or track from `_recorded`; empty if the flight is not recorded.

    Raises:
        CommandError: interrupted, or a file cannot be written.
    """
    began_s, flights, known, interrupted = time.process_time(), 0, None, None
    at_once = options.pool.workers or system.cores()
    with crew(options.pool, f"explaining {name}", STEPS + bool(options.seeds), "steps") as flyers:

        def fly_all(cases: Sequence[FlightCase]) -> list[CaseOutcome]:
            nonlocal flights
            outcomes = flyers.map(fly, cases)
            flights += len(cases)
            flyers.advance(0, f"{flights} flights: {step}")
            return outcomes

        step = FIRST
        steps = explain(
            case,
            name,
            fly_all,
            at_s=options.at,
            vehicle=options.vehicle,
            seeds=options.seeds,
            at_once=at_once,
            recorded=recorded if isinstance(recorded, Track) else None,
        )
        try:
            for step, known in steps:
                if isinstance(recorded, str):
                    check_same(known.flown, recorded or known.flown.trace, options.scenario)
                flyers.advance(1, step)
                if options.json is not None:  # at each step, for programs that show the progress
                    command.write(options.json, known.to_json(step))
        except Interrupted as error:
            interrupted = error
        cpu_s = time.process_time() - began_s + flyers.cpu_s
    if known is not None:
        _show(options, known, step if interrupted else "")
        print(f"{flights} flights, {cpu_s:.0f} s of CPU")
    if interrupted is not None:
        message = f"interrupted at: {step}; what is above was known by then"
        raise CommandError(message, command.INTERRUPTED) from interrupted


def _show(options: ExplainOptions, known: Explanation, following: str) -> None:
    if options.json is not None:
        command.write(options.json, known.to_json(following))
    if options.figure is not None and known.moment is not None:
        figures.save(picture.drawn(known), options.figure, dpi=100)
    print(known)
