"""The `skytether` command: it passes each subcommand to the module that implements it."""

import sys
from collections.abc import Sequence

from skytether.cli.commands import COMMANDS, usage
from skytether.shell.commandline import start


def list_scenarios(argv: Sequence[str]) -> None:
    from skytether.shared.scenario import reading
    from skytether.shell.commandline.command import CommandError

    match argv:
        case ["-h" | "--help", *_]:
            print("usage: skytether scenarios\n\nPrint the scenarios that come with Skytether.")
            return
        case [word, *_]:
            raise CommandError(f"got {word!r}, expected nothing", 2)
    names = reading.names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:{width}}  {reading.load(name).title}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    name, *rest = argv or ["--help"]
    if name in COMMANDS:
        return start.run(COMMANDS[name], name, rest)
    return start.run("skytether.__main__:introduce", "skytether", argv)


def introduce(argv: Sequence[str]) -> None:
    from importlib import metadata

    from skytether.shared.base.hint import hint
    from skytether.shell.commandline.command import CONFIGURATION, CommandError

    match argv:
        case [] | ["-h" | "--help", *_]:
            print(usage())
        case ["--version", *_]:
            print(f"skytether {metadata.version('skytether')}")
        case [name, *_]:
            raise CommandError(f"no command {name!r}; {hint(name, COMMANDS)}", CONFIGURATION)


if __name__ == "__main__":
    sys.exit(main())
