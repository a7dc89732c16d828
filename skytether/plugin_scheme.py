"""Names that a plug-in with a scheme imports, in addition to the names of `skytether.plugin`.

This module also imports the server's packages, which other plug-ins do not need; so the names are
not in `skytether.plugin`. docs/schemes.md shows a plug-in with a scheme.
"""

from skytether.server.planning.scheme import Batch, Fleet, Foresight, Header, Scheme, SentPlans
from skytether.server.planning.splines import SplineScheme
from skytether.server.schemes.horizons import InputScheme
from skytether.shared.law.model import Flags, Indices
from skytether.shared.scenario.schemes import SchemeProperties, scheme
from skytether.shared.wire.protocol import Observation

__all__ = [
    "Batch",
    "Flags",
    "Fleet",
    "Foresight",
    "Header",
    "Indices",
    "InputScheme",
    "Observation",
    "Scheme",
    "SchemeProperties",
    "SentPlans",
    "SplineScheme",
    "scheme",
]
