"""Scenario with all installed optional sections. Its types are in `whole.pyi`."""

import msgspec

from skytether.shared.scenario import rooms, schema
from skytether.shared.scenario.registry import Files

Scenario = msgspec.defstruct(
    "Scenario",
    [(name, section, section()) for name, section in rooms.sections().items()],
    bases=(schema.Scenario,),
    module=__name__,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    namespace={"is_mission": schema.Scenario.keeps_apart},
)


class WithFiles(Scenario, frozen=True):  # type: ignore[misc, valid-type]
    """Scenario with the contents of the files that it names, made by `reading.py`."""

    contents: Files = ()

    @property
    def files(self) -> Files:
        return tuple(each._replace(origin=self.reference.origin) for each in self.contents)
