"""Optional extras of pyproject.toml: which extra provides a missing module."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import util

from skytether.shared.base.errors import ConfigError

MODULES = {"eclipse-zenoh": "zenoh", "pillow": "PIL"}
"""Import names of packages, if they differ from the packages' names."""


class ExtraMissing(ModuleNotFoundError):
    """An extra is needed; the message names it, and the command that installs it."""

    def __init__(self, module: str, extra: str) -> None:
        command = f"pip install 'skytether[{extra}]', or in a checkout make setup"
        super().__init__(f"{module} is not installed, install it: {command}", name=module)


@contextmanager
def named(expected: str = "") -> Iterator[None]:
    """Within this block, the error for a missing module names the smallest extra with the module.

    Args:
        expected: extra to name instead, where several provide a module.

    Raises:
        ExtraMissing: instead of a ModuleNotFoundError, if an extra provides the module.
        ConfigError: instead of a ModuleNotFoundError, if Skytether is installed without the module.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = str(error.name).partition(".")[0]
        if module == "skytether":
            raise ConfigError(f"{error.name} is not installed") from None
        extras = _extras()
        having = [extra for extra in extras if module in extras[extra]]
        if isinstance(error, ExtraMissing) or not having:
            raise
        smallest = min(having, key=lambda extra: len(extras[extra]))
        raise ExtraMissing(module, expected or smallest) from None


def need(extra: str) -> None:
    """Check that an extra is installed completely; raises ExtraMissing otherwise."""
    for module in _extras()[extra]:
        if util.find_spec(module) is None:
            raise ExtraMissing(module, extra)


def _extras() -> dict[str, list[str]]:
    """Modules of each extra. A module has the name of its package, except for those in MODULES."""
    from importlib import metadata  # this import takes a tenth of the client's start-up time

    extras: dict[str, list[str]] = {}
    for requirement in metadata.requires("skytether") or ():
        package, _, extra = requirement.partition("; extra == ")
        if extra:
            name = re.split("[^a-z0-9_-]", package)[0]
            extras.setdefault(extra.strip("'\""), []).append(MODULES.get(name, name))
    return extras
