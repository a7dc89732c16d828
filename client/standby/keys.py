"""Key of a vehicle with a standby server."""

from typing import Annotated, Literal

from skytether.shared.scenario import schema
from skytether.shared.scenario.owners import Key, Owner


class LinkConfig(schema.LinkConfig, frozen=True):
    """Time limits of a session, and its leader."""

    leader: Annotated[
        Literal["server", "standby"], Key(Owner.VEHICLE, "leader", is_decision=True)
    ] = "server"
    """Server that an operator chooses in flight to lead; it leads until it falls silent, see
    docs/operating.md."""


SECTION = LinkConfig
