"""Many flights on all cores; with a folder each is kept, and the same command goes on there."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, TypeVar

from skytether.lab.commands.pool import Flags, crew, writing
from skytether.lab.journal import Journal
from skytether.shell import temporary

F = TypeVar("F")
C = TypeVar("C")


def flights(
    fly: Callable[[C], F],
    cells: Sequence[C],
    kind: type[F],
    settings: Mapping[str, Any],
    out: Path | None,
    workers: int,
) -> list[F]:
    """Results of the flights of some cells, in order.

    Args:
        fly: flies one; called in a worker.
        cells: what is to be flown.
        kind: type of a result.
        settings: all that the results follow from, but for the number of a cell.
        out: folder in which they are kept; None: in none.
        workers: number of processes.

    Raises:
        CommandError: interrupted, or the folder cannot be written.
        ConfigError: the folder has the flights of other settings.
    """
    with temporary.folder() as folder:
        place = out or folder / "flights"
        with writing(place), closing(Journal(place, settings, tuple[int, kind])) as journal:  # type: ignore[valid-type]
            done = {number for number, _ in journal.entries}
            todo = [number for number in range(len(cells)) if number not in done]
            with crew(Flags(workers), "flying", len(cells), "flights") as flyers:
                flyers.advance(len(cells) - len(todo))

                def keep(index: int, flown: F) -> None:
                    journal.append((todo[index], flown))
                    flyers.advance(1)

                flyers.share(fly, [cells[number] for number in todo], keep)
            found = dict(journal.entries)
            return [found[number] for number in range(len(cells))]
