"""Python function `compare`, which does the same as the command `skytether compare`."""

from collections.abc import Iterable
from itertools import product
from os import PathLike
from pathlib import Path

from skytether.lab.commands.compare import CompareOptions, run, size
from skytether.lab.commands.pool import Flags, writing
from skytether.lab.commands.report_folder import CommandCall
from skytether.lab.engine.budgets import BUDGETS
from skytether.lab.engine.contenders import ABOARD
from skytether.library.sweeping import Swept
from skytether.shared.base import extras, files
from skytether.shared.base.errors import ConfigError, FlightError
from skytether.shared.scenario import reading
from skytether.shared.scenario.dotted import set_keys
from skytether.shell.commandline import plugins
from skytether.shell.commandline.command import CommandError


@extras.named()
def compare(
    *contenders: str | PathLike[str],
    cases: Iterable[str] = (),
    runs: int = 100,
    quick: bool = False,
    weights: str | PathLike[str] = reading.COMPARED,
    out: str | PathLike[str] = "compare",
    workers: int = 1,
) -> list[Swept]:
    """Fly your contenders and the built-in ones, and write the report of `skytether compare`.

        skytether.compare("mine.toml", cases=["target"], quick=True)

    Args:
        contenders: TOML files, each with a scheme and a trigger to compare, see docs/compare.md.
        cases: names of the cases; by default all.
        runs: number of flights of each contender per case and budget.
        quick: whether to fly only a short preliminary comparison.
        weights: file of the weights of the built-in contenders.
        out: folder for the report; flights that are stored in it are not flown again.
        workers: see `skytether.sweep`.

    Returns:
        For each case, contender and packet budget, the flights with the contender's best threshold.
        The baseline without packets is left out. Their `keys` are `case`, `contender`, `budget`
        [packets/s], `threshold` and `report`.

    Raises:
        ConfigError: a contender or an argument is invalid, or `out` contains another comparison.
        FlightError: the flights were interrupted, or a file could not be written.
        TypeError: an argument has a wrong type.
    """
    for argument, value in (("runs", runs), ("workers", workers)):
        if not isinstance(value, int) or value < 1:
            raise ConfigError(f"{argument}: got {value!r}, expected a whole number from 1 on")
    if isinstance(cases, str):
        raise TypeError(f"cases: got {cases!r}, expected a list of names")
    options = CompareOptions(
        runs=runs,
        out=Path(out),
        quick=quick,
        cases=tuple(cases),
        weights=str(weights),
        contender=tuple(map(Path, contenders)),
        pool=Flags(workers=0 if workers == 1 else workers),
    )
    plugins.load()  # loads the plug-ins of installed packages, once per process
    call = CommandCall.now("compare", [f"--contender={path}" for path in options.contender])
    try:
        with files.apart(), writing(options.out):
            scale = size(options)
            results, _, _ = run(options, scale, call)
    except CommandError as error:
        raise FlightError(str(error)) from None
    swept = []
    for each in results:
        for contender, budget in product(each.contenders, BUDGETS):
            chosen = each.bought.get((contender.name, budget))
            if chosen is not None and contender is not ABOARD:
                table = reading.to_table(scale.scenario(each.case))
                set_keys(chosen.what.keys, table)
                keys = {"case": each.case.name, "contender": contender.name, "budget": budget}
                keys |= {"threshold": chosen.what.threshold, "report": chosen.what.report}
                swept.append(Swept(keys, reading.check(table), tuple(chosen.runs)))
    return swept
