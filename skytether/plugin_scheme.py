"""Names that a plug-in with a scheme imports, beside those of `skytether.plugin`.

They have a module of their own, because they import the server's packages, which other plug-ins do
not need. docs/schemes.md shows such a plug-in.
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
