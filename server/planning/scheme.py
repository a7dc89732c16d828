"""Interface of a scheme of delay compensation, and the arrays that schemes fill in.

`shared.scenario.schemes` lists the schemes, `server.schemes.table` loads a scenario's scheme.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from types import ModuleType
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skytether.server.planning.clock import UNSEEN, ClockMap
from skytether.server.planning.desired import Desired
from skytether.shared.base.kernel import F2, F3, F4, I1, S3, record, records
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.events.flight import Event
from skytether.shared.law.model import Array, Flags, Indices
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reference import Reference
from skytether.shared.scenario.schema import Scenario
from skytether.shared.scenario.schemes import SchemeProperties
from skytether.shared.wire.protocol import FEEDBACK, KNOTS_MAX, Observation, RoomMessage, ahead_max


class Splines(NamedTuple):
    """Trajectories sent by the scheme "trajectory"; with other schemes `block` is 0."""

    knots: S3
    """Position [m] and velocity [m/s] of each knot in turn; shape (block, axes, 2 KNOTS_MAX)."""
    number: I1
    """Number of knots; shape (block,)."""
    spacing: I1
    """Steps from one knot to the next; shape (block,)."""
    age: I1
    """Age of the trajectory [steps]: 0 unless an old trajectory is sent again; shape (block,)."""


class Foresight(NamedTuple):
    """Predictions for a block of vehicles, each at its step k, and the horizons planned from them.

    The arrays are reused for every block. A block with fewer vehicles fills the first rows only.
    """

    estimate: F3
    """Estimate x̂(k) [m, m/s]; shape (block, axes, 2)."""
    ahead: I1
    """Delay bound d: planning starts at k + d; shape (block,)."""
    start: F3
    """Estimate x̂(k+d), where planning starts [m, m/s]; shape (block, axes, 2)."""
    committed: F3
    """Committed inputs of steps k … k+d-1, in the first d columns [m/s]; shape (block, axes,
    largest d)."""
    held: F3
    """Inputs that the vehicle flies from k+d on if no further packet is sent [m/s]; shape (block,
    axes, H)."""
    loss_probability: F2
    """Probability that exactly the newest 1, 2, … of the horizons in flight are lost; shape (block,
    loss_cases). `loss_cases` is 0 unless a trigger uses them."""
    start_if_lost: F4
    """State at k+d in each loss case [m, m/s]; shape (block, loss_cases, axes, 2)."""
    inputs_if_lost: F4
    """Inputs from k+d on in each loss case, if no further packet is sent [m/s]; shape (block,
    loss_cases, axes, H)."""
    usable: I1
    """Number of inputs from k+d on that are younger than `link.age_max_s` when they are flown;
    shape (block,)."""
    disturbance: F2
    """Estimated disturbance ŵ, as an equivalent input [m/s]; shape (block, axes)."""
    horizons: S3
    """Horizons to send, from step k on: d committed inputs, then H planned inputs [m/s]; shape
    (block, axes, largest d + H)."""
    feedback: S3
    """Feedback columns of a horizon, see `wire.protocol.Horizon`; shape (block, axes, FEEDBACK)."""
    splines: Splines
    """Trajectories to send, with the scheme "trajectory"."""


class PlanFigures:
    """Numpy record: figures of one plan, which triggers compare; costs are those of eq. (9)."""

    row: int
    step: int
    start: int
    """Step k + d, where planning starts."""
    gap: int
    """Steps from the start of the previous plan to the start of the new plan."""
    state_gap: float
    """V(k) of eq. (16): (x̂ - x_p)' P (x̂ - x_p)."""
    cost_gap: float
    """Cost of the flight with the inputs already sent, minus the cost of the new plan."""
    expected_gap: float
    """Expected value of `cost_gap` over the losses of packets in flight."""
    deviation_m: float
    """Largest distance between the flight with the inputs already sent and the previous plan [m]; 0
    if `fresh`."""
    fresh: bool
    """Whether no usable previous plan exists: first step, or a gap longer than H."""
    solved: bool
    """Whether the solver has found a plan; without a plan nothing is sent."""


FIGURES = record(PlanFigures)
Figures = Annotated[NDArray[np.void], records(FIGURES, 1)]
"""A `PlanFigures` for each plan; shape (n,)."""


LOSS_CASES = 4
"""Number of loss cases computed: the newest 1, 2, 3, or 4 horizons in flight are lost."""


def empty_foresight(
    block: int, axes: int, H: int, ahead_max: int, loss_cases: int = 0, *, splines: bool = False
) -> Foresight:
    states, trajectories = (block, axes, 2), block if splines else 0
    return Foresight(
        estimate=np.zeros(states),
        ahead=np.zeros(block, dtype=np.int64),
        start=np.zeros(states),
        committed=np.zeros((block, axes, ahead_max)),
        held=np.zeros((block, axes, H)),
        loss_probability=np.zeros((block, loss_cases)),
        start_if_lost=np.zeros((block, loss_cases, axes, 2)),
        inputs_if_lost=np.zeros((block, loss_cases, axes, H)),
        usable=np.full(block, H),
        disturbance=np.zeros((block, axes)),
        horizons=np.zeros((block, axes, ahead_max + H), dtype=np.float32),
        feedback=np.zeros((block, axes, FEEDBACK), dtype=np.float32),
        splines=Splines(
            knots=np.zeros((trajectories, axes, 2 * KNOTS_MAX), dtype=np.float32),
            number=np.ones(trajectories, dtype=np.int64),
            spacing=np.ones(trajectories, dtype=np.int64),
            age=np.zeros(trajectories, dtype=np.int64),
        ),
    )


class Header(NamedTuple):
    """Header of a packet to a vehicle, the same for horizons and trajectories."""

    vehicle: int
    session: int
    sent_us: int
    """Server's clock when the packet is sent [µs]."""
    number: int
    """Number of the packet in the session."""
    silence: int
    """Longest silence that the server requests of the vehicle [half steps]."""


make_header: Callable[[tuple[int, int, int, int, int]], Header] = partial(tuple.__new__, Header)
"""Function that makes a Header from its five values, twice as fast as calling `Header`."""


class Batch(NamedTuple):
    """Vehicles planned for together, and the vehicles among them whose plan is sent."""

    rows: Indices
    """Rows of the vehicles; shape (n,)."""
    step: Indices
    """Step k of each vehicle; shape (n,)."""
    foresight: Foresight
    """Predictions and plans, in the first n rows of the arrays."""
    sent: Indices
    """Indices, from 0 to n - 1, of the vehicles whose plan is sent; shape (m,)."""


class SentPlans(NamedTuple):
    step: Indices
    """Step k that each plan is made for; shape (m,)."""
    begins: Indices
    """First planned step of each plan; shape (m,)."""
    state: Array
    """Predicted state at the step `begins` [m, m/s]; shape (m, axes, 2)."""
    inputs: NDArray[np.floating]
    """Planned inputs [m/s]; shape (m, axes, H)."""


Planning = Callable[[Sequence[tuple[int, Callable[[], Any]]]], list[Any]]
"""Function that runs planners of plug-ins, each given by its number and its call. It returns each
planner's result or exception: TimeoutError if the planner takes too long, `queue.Full` if it was
not run because too many planners hang."""


Tell = Callable[[str, str], None]
"""Function called at each error: name of the error's count, and text to report (may be empty)."""


class Fleet(NamedTuple):
    scenario: Scenario
    terms: Terms
    capacity: int
    block: int
    """Largest number of vehicles planned for together."""
    clock: ClockMap
    desired: Desired
    references: Callable[[int], Reference] | None
    """Reference of each vehicle of a mission, by its number; None without a mission."""
    stopwatch: Stopwatch
    tell: Tell
    """Function called at each error of a plug-in in flight."""
    planning: Planning | None = None
    """Function that calls planners of plug-ins; None to call them one after the other."""


class Scheme(ABC):
    """A scheme of delay compensation: predicts vehicles, plans for them and encodes the plans.

    At each step and for each block of vehicles the server calls `foresee`, `plan`, `remember` and
    `encode`, in this order: with the `rows` of the vehicles and the `step` k of each, both of shape
    (n,).
    """

    properties: ClassVar[SchemeProperties]
    """Properties of a plug-in's scheme; for built-in schemes see `shared.scenario.schemes`."""
    solve_ns = -1
    """Time that planning for the last block took [ns], or -1 if it is not measured."""
    uplink_max_ns = UNSEEN
    """Longest uplink delay at which a plan can still be flown [ns]."""

    def __init__(self, fleet: Fleet) -> None:
        self.terms = fleet.terms
        self.observed_step: Indices = np.full(fleet.capacity, -1, dtype=np.int64)
        """Step of the newest observation of each vehicle, or -1; shape (capacity,)."""
        self.counts: Counter[str] = Counter()
        self.events: list[Event] = []
        """Events for the operator; the caller empties the list."""
        self.figures: Figures = np.zeros(fleet.block, dtype=FIGURES)
        """Figures of the newest plans, in the first rows."""
        self.planned: Array = np.zeros((fleet.block, fleet.terms.axes, 2))
        """States at which the newest plans start, as predicted by the previous plans [m, m/s];
        shape (block, axes, 2)."""

    def make_foresight(self, *, doubts: bool) -> Foresight:
        """Arrays for a block of vehicles.

        Args:
            doubts: whether the trigger needs the cases in which horizons are lost.
        """
        terms, cases = self.terms, LOSS_CASES if doubts else 0
        return empty_foresight(
            len(self.figures),
            terms.axes,
            terms.planned,
            ahead_max(terms),
            cases,
            splines=terms.splines,
        )

    @abstractmethod
    def forget(self, row: int) -> None:
        """Delete the data of the vehicle in a row."""

    @abstractmethod
    def observe(self, row: int, observation: Observation) -> bool:
        """Store an observation unless a newer one is stored (E11); True if stored."""

    @abstractmethod
    def foresee(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Fill in the foresight except the plans; called only for vehicles with an observation that
        is recent enough.
        """

    @abstractmethod
    def plan(self, rows: Indices, step: Indices, foresight: Foresight) -> None:
        """Fill in the plans: `figures`, `planned` and the `horizons` of the foresight."""

    def remember(  # noqa: B027 - many schemes ignore what is sent
        self, rows: Indices, step: Indices, foresight: Foresight, event: Flags
    ) -> None:
        """Store the new plans; the plans that the trigger chose are encoded and sent afterwards.

        Args:
            event: True for vehicles whose plan is sent; shape (n,).
        """

    @abstractmethod
    def encode(self, batch: Batch, header: Callable[[int], Header]) -> Iterator[tuple[int, bytes]]:
        """Row and encoded message of each vehicle whose plan is sent.

        Args:
            batch: vehicles and plans.
            header: function that makes the header of a packet to the vehicle in a row. It is called
                once per packet, because each call uses up a packet number.
        """

    @abstractmethod
    def sent_plans(self, batch: Batch) -> SentPlans:
        """Plans of the batch that are sent, for the flight's record."""

    # -- optional parts, for missions and plug-ins -------------------------------------------------

    changeable: frozenset[str] = frozenset()
    """Keys that may be changed in flight, in addition to the server's own."""
    keeps_rows = False
    """Whether a vehicle keeps its row when its packets no longer arrive."""
    limits: Any = None
    """Limits (`shared.law.limits`) of motions, which a leader and its standby must have in common
    if all vehicles must follow the same server; None if vehicles may follow different servers."""

    def change(self, scenario: Scenario, keys: frozenset[str]) -> None:  # noqa: B027
        """Use changed keys; called only if `objection` has returned no reason."""

    def objection(self, scenario: Scenario, keys: frozenset[str]) -> str:  # noqa: ARG002
        """Reason why the keys cannot be changed now; empty if they can."""
        return ""

    def fleet_figures(self) -> dict[str, Any]:
        """Figures of all vehicles together, in addition to the server's own."""
        return {}

    def vehicle_figures(self, row: int) -> dict[str, Any]:  # noqa: ARG002
        """Figures of a vehicle, in addition to the server's own."""
        return {}

    def follow(self, row: int, lead: RoomMessage | None) -> None:  # noqa: B027
        """Store which server leads a vehicle, and the vehicle's motion in force, as its message
        `lead` reports them. `lead` is None if the vehicle has only this server.
        """

    def leave(self) -> int:
        """Plan nothing further, because the server ends. Return the longest time until all vehicles
        rest [steps].
        """
        return 0

    def rests(self, row: int) -> bool:  # noqa: ARG002
        """Whether a vehicle needs no further plan to be safe, or another server leads it."""
        return True

    def restart(self, row: int) -> bool:  # noqa: ARG002
        """Note that a vehicle's client has restarted; False if this was noted before."""
        return False


Given = Callable[[int], Reference] | None
"""Desired trajectory of each vehicle by its number; None: all have the scenario's trajectory."""


def given_references(scenario: Scenario, given: Given, most: int) -> Given:
    """Desired trajectories of vehicles that are not on a mission: `given`; or, if `given` is None
    and the shape is a target, each vehicle's target as measured, cached for `most` vehicles.
    """
    if given is None and scenario.reference.shape == "target":
        return lru_cache(most)(scenario.measured_reference)
    return given


class SchemeCode(NamedTuple):
    """Contents of the constant CODE in the module of a scheme."""

    make: Callable[[Fleet], Scheme]
    kernels: Callable[[str], Sequence[ModuleType]]
    """Function from the text of `control.scheme` to the modules and packages whose kernels only
    this scheme calls."""
    references: Callable[[Scenario, Given, int], Given] = given_references
    """Function that makes the scheme's desired trajectories from given trajectories; the last
    argument is the largest number of vehicles."""
