"""The `skytether` command: runs the function that implements each subcommand."""

import sys
from collections.abc import Sequence

from skytether.cli.commands import COMMANDS, ELSEWHERE, usage
from skytether.shell.commandline import start


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command, and return its exit code."""
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
            instead = f"it is {ELSEWHERE[name]}" if name in ELSEWHERE else hint(name, COMMANDS)
            raise CommandError(f"no command {name!r}; {instead}", CONFIGURATION)


if __name__ == "__main__":
    sys.exit(main())
