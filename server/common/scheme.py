"""Interface of the schemes of delay compensation, and the predictions that they share.

`shared.scenario.schemes` has the table of all; on a mission `server.missions.mission_planner` is
one.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.common.clock import ClockMap
from skytether.server.common.desired import Desired
from skytether.shared.base.kernel import F2, F3, F4, I1, S3, record, records
from skytether.shared.core.stopwatch import Stopwatch
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.scenario.zones import Zones
from skytether.shared.wire.protocol import FEEDBACK, KNOTS_MAX, Observation


class Splines(NamedTuple):
    """Trajectories that are sent in place of horizons; no vehicles with the other schemes."""

    knots: S3
    """Position [m] and velocity [m/s] of one knot after the other; shape
    (block, axes, 2 KNOTS_MAX)."""
    number: I1
    """Number of knots; shape (block,)."""
    spacing: I1
    """Steps from one knot to the next; shape (block,)."""
    back: I1
    """Number of steps since the one it was made for: 0, unless it is sent once more; shape
    (block,)."""


class Foresight(NamedTuple):
    """Predictions for vehicles at their steps k before planning, and the horizons sent after it.

    It is written anew for every block of vehicles; those of a block come first in each array.
    """

    estimate: F3
    """Estimate x̂(k) [m, m/s]; shape (block, axes, 2)."""
    ahead: I1
    """Delay bound d: planning starts at k + d; shape (block,)."""
    start: F3
    """Estimate x̂(k+d), where planning starts [m, m/s]; shape (block, axes, 2)."""
    committed: F3
    """Inputs of k … k+d-1, the first d of the last axis [m/s]; shape (block, axes, most), with
    the largest d there may be."""
    held: F3
    """Inputs from k+d on, if nothing more were sent [m/s]; shape (block, axes, H)."""
    doubt: F2
    """Probability that the newest 1, 2, … of the horizons in flight are lost, and no older one;
    shape (block, doubts), with no doubts where no trigger asks for them."""
    doubted_start: F4
    """State at k+d in each of these cases [m, m/s]; shape (block, doubts, axes, 2)."""
    doubted: F4
    """Inputs from k+d on in each of these cases, if nothing more were sent [m/s]; shape
    (block, doubts, axes, H)."""
    flown: I1
    """Number of the inputs planned from k+d on that a vehicle flies, before they are too old;
    shape (block,)."""
    disturbance: F2
    """Disturbance ŵ, an input that nobody gave [m/s]; shape (block, axes)."""
    horizons: S3
    """Inputs that may be sent, from k on: d committed inputs, then H planned ones [m/s]; shape
    (block, axes, most + H)."""
    feedback: S3
    """Feedback columns of a horizon, see `wire.protocol.Horizon`; shape (block, axes, FEEDBACK)."""
    told: Splines
    """Trajectories that are sent, with the scheme "trajectory"."""


class PlanFigures:
    """Record: what is known of a vehicle once its plan is made; a cost is that of eq. (9)."""

    row: int
    """Row of the vehicle."""
    step: int
    """Step k."""
    start: int
    """Step k + d, where planning starts."""
    gap: int
    """Steps since planning started before."""
    state_gap: float
    """V(k) of eq. (16): square of how far x̂ is from x_p, weighted by P [cost]."""
    cost_gap: float
    """Cost of flying on with what was sent above that of the plan [cost]."""
    expected_gap: float
    """Mean of that cost where packets in flight may be lost [cost]."""
    deviation_m: float
    """Largest distance between what was sent and the generator's plan before [m]; 0 where fresh."""
    fresh: bool
    """Whether it is at its first step, or behind a gap that no plan reached over."""
    solved: bool
    """Whether the plan is new and right, so that it may be sent."""


FIGURES = record(PlanFigures)
Figures = Annotated[NDArray[np.void], records(FIGURES, 1)]
"""Shape (n,)."""


DOUBTS = 4
"""Number of horizons in flight whose loss is reckoned with."""


def foresight(
    block: int, axes: int, H: int, most: int, doubts: int = 0, *, splines: bool = False
) -> Foresight:
    """Room for a block of vehicles, whose delay bounds are at most `most`."""
    states, told = (block, axes, 2), block if splines else 0
    return Foresight(
        estimate=np.zeros(states),
        ahead=np.zeros(block, dtype=np.int64),
        start=np.zeros(states),
        committed=np.zeros((block, axes, most)),
        held=np.zeros((block, axes, H)),
        doubt=np.zeros((block, doubts)),
        doubted_start=np.zeros((block, doubts, axes, 2)),
        doubted=np.zeros((block, doubts, axes, H)),
        flown=np.full(block, H),
        disturbance=np.zeros((block, axes)),
        horizons=np.zeros((block, axes, most + H), dtype=np.float32),
        feedback=np.zeros((block, axes, FEEDBACK), dtype=np.float32),
        told=Splines(
            knots=np.zeros((told, axes, 2 * KNOTS_MAX), dtype=np.float32),
            number=np.ones(told, dtype=np.int64),
            spacing=np.ones(told, dtype=np.int64),
            back=np.zeros(told, dtype=np.int64),
        ),
    )


class Head(NamedTuple):
    """What the head of a packet to a vehicle says, whatever is in it."""

    vehicle: int
    """Number of the vehicle."""
    session: int
    """Number of its session."""
    sent_us: int
    """Time of sending on the server's clock [µs]."""
    number: int
    """Number of the packet in the session."""
    silence: int
    """Longest silence that is asked of the vehicle [half steps]."""


make_head: Callable[[tuple[int, int, int, int, int]], Head] = partial(tuple.__new__, Head)
"""Head from its five values, in half the time of calling `Head`."""


class Batch(NamedTuple):
    """Vehicles that are decided on together, and which of them are sent a plan."""

    rows: Indices
    """The vehicles; shape (n,)."""
    step: Indices
    """Step k of each; shape (n,)."""
    found: Foresight
    """What is foreseen of them, and planned; these n come first."""
    sent: Indices
    """Indices, of these n, of those that are sent their plan."""


class SentPlans(NamedTuple):
    """Plans that are sent, for the record; shapes (m, …)."""

    step: Indices
    """Step that each is made for."""
    begins: Indices
    """Step of its first planned input."""
    state: Array
    """State there [m, m/s]; shape (m, axes, 2)."""
    inputs: NDArray[np.floating]
    """Planned inputs [m/s]; shape (m, axes, H)."""


class Fleet(NamedTuple):
    """Flight and vehicles for which a scheme is made."""

    scenario: Scenario
    terms: Terms
    """Terms of the flight."""
    capacity: int
    """Largest number of vehicles."""
    block: int
    """Largest number of vehicles that are planned for together."""
    clock: ClockMap
    desired: Desired
    """Desired trajectories."""
    references: Callable[[int], Reference] | None
    """Reference of each vehicle of a mission, by its number; None without a mission."""
    stopwatch: Stopwatch
    tell: Callable[[str], None]
    """Called with the traceback of a plug-in's first error in flight."""


class Scheme(ABC):
    """A scheme of delay compensation: what the server believes of its vehicles, plans and sends.

    At each step and for each block of vehicles it is asked, in this order, to `foresee`, `plan`,
    `remember`, and `encode`.
    """

    properties: ClassVar[SchemeProperties]
    """Properties of a plug-in's scheme; those of ours are in `shared.scenario.schemes`."""
    solve_ns = -1
    """Time that planning for the last block took [ns], or -1 where nobody measures it."""

    def __init__(self, fleet: Fleet) -> None:
        self.terms = fleet.terms
        self.observed_step: Indices = np.full(fleet.capacity, -1, dtype=np.int64)
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        self.counts: Counter[str] = Counter()
        """Events that the scheme counted, by name."""
        self.figures: Figures = np.zeros(fleet.block, dtype=FIGURES)
        """Costs of the newest plans; those of a block come first."""
        self.planned: Array = np.zeros((fleet.block, fleet.terms.axes, 2))
        """States that the newest plans begin with by the plans before [m, m/s]; shape (block,
        axes, 2)."""

    @abstractmethod
    def forget(self, row: int) -> None:
        """Begin anew with a vehicle in this row."""

    @abstractmethod
    def observe(self, row: int, observation: Observation) -> bool:
        """Keep an observation, unless a newer one is known (E11); whether it was kept."""

    @abstractmethod
    def foresee(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Fill in all but the plans, for vehicles that were observed recently enough.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is filled in.
        """

    @abstractmethod
    def plan(self, rows: Indices, step: Indices, found: Foresight) -> None:
        """Fill in the plans, `figures` and `planned`.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what is foreseen of them; its horizons are filled in.
        """

    def remember(  # noqa: B027 - many need not know what is sent
        self, rows: Indices, step: Indices, found: Foresight, event: Flags
    ) -> None:
        """Take note of what was computed for the steps from k on, and which of it is sent.

        Args:
            rows: the vehicles; shape (n,).
            step: k of each; shape (n,).
            found: what was foreseen and planned.
            event: which vehicles are sent their plan; shape (n,).
        """

    @abstractmethod
    def encode(self, batch: Batch, head: Callable[[int], Head]) -> Iterator[tuple[int, bytes]]:
        """Row and message of each vehicle that is sent its plan.

        Args:
            batch: the vehicles.
            head: returns the head of the next packet to the vehicle in a row; called once for each.
        """

    @abstractmethod
    def sent_plans(self, batch: Batch) -> SentPlans:
        """Plans of the vehicles that are sent theirs, for the record."""

    # -- what is asked of a mission ----------------------------------------------------------------

    @property
    def left_tube(self) -> list[tuple[int, float]]:
        """Vehicles that have left their tube, and by how much [m]; to be emptied."""
        return []

    @property
    def inside(self) -> list[tuple[int, str]]:
        """Vehicles that were found at rest within a zone, and its name; to be emptied."""
        return []

    def change_zones(self, zones: Zones) -> None:  # noqa: B027 - most know of none
        """Keep vehicles out of other zones from now on."""

    def objection(self, zones: Zones) -> str:  # noqa: ARG002
        """Why there cannot be these zones now, in words; empty: there can."""
        return ""

    def waits(self, row: int) -> str:  # noqa: ARG002
        """Reason in words why a vehicle waits; empty if it does not."""
        return ""

    def clock_m(self, row: int) -> float | None:  # noqa: ARG002
        """Distance by which a vehicle may be elsewhere for want of its clock [m]."""
        return None

    def restart(self, row: int) -> bool:  # noqa: ARG002
        """Take note that the client of a vehicle has begun anew; whether that is news."""
        return False
