"""Set-up: identification of the autopilot, and check of its parameters.

    heartbeat → version → parameters, read one by one → all safe, or refused, or set and read again

A question is repeated until it is answered, up to TRIES times, because the line may be bad. If no
answer arrives, the autopilot counts as lacking the parameter.
"""

from collections.abc import Mapping

from skytether.client.mavlink import safety
from skytether.client.mavlink.flavours import ARDUPILOT, Flavour
from skytether.client.mavlink.safety import Rule
from skytether.client.mavlink.streams import request
from skytether.mavlink import parameters
from skytether.mavlink.codec import Message
from skytether.mavlink.dialect import dialect
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Events
from skytether.shared.events.aboard import (
    AutopilotFound,
    AutopilotParameter,
    ParametersRead,
    ParametersSet,
    ParametersUnsafe,
)

AGAIN_NS = 400 * MILLISECOND_NS
TRIES = 10
"""Number of times that a question is sent: with 10 % loss each way, one question in ten million
stays unanswered."""
AT_ONCE = 4
"""Largest number of unanswered questions at once, because serial lines are slow."""
VERSION = int(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
BYTEWISE = dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
CONVERTED = dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST


class Setup:
    """Checks the parameters of an autopilot, and sets unsafe ones if allowed.

    Args:
        target: numbers of the autopilot's system and component.
        system: number of the client's own system.
        returns_below_m: altitude below which the vehicle has to return home [m]; None: it lands.
    """

    def __init__(
        self,
        vehicle: int,
        flavour: Flavour,
        target: tuple[int, int],
        system: int,
        *,
        sets: bool,
        returns_below_m: float | None = None,
        events: Events,
    ) -> None:
        self._vehicle, self._flavour, self._target = vehicle, flavour, target
        self._sets, self._events = sets, events
        self._rules = (
            safety.ardupilot(system, returns_below_m)
            if flavour is ARDUPILOT
            else safety.px4(returns_below_m)
        )
        self._bytewise = flavour.bytewise
        self._version: str | None = None
        self._version_tries = 0
        self._tries: dict[str, int] = {name: 0 for rule in self._rules for name in rule.names}
        """Number of attempts to read or set each parameter whose value is still awaited."""
        self._values: dict[str, float] = {}
        self._kinds: dict[str, int] = {}
        self._setting: dict[str, tuple[float, float]] = {}
        """Old and new values of parameters that are being set."""
        self._changed: list[tuple[str, float, float]] = []
        self._asked_ns: int | None = None
        self.is_done = False
        self.failure: ParametersUnsafe | None = None

    @property
    def fence(self) -> dict[str, float]:
        return {name: value for name, value in self._values.items() if name[:3] in ("FEN", "GF_")}

    def value(self, name: str) -> float | None:
        return self._values.get(name)

    @property
    def waits_for(self) -> str:
        if self._version is None:
            return "the version of its autopilot"
        return f"parameters of its autopilot: {', '.join(list(self._tries)[:AT_ONCE])}"

    # Answers

    def hear(self, message: Message) -> None:
        match message.get_type():
            case "AUTOPILOT_VERSION" if self._version is None:
                can, number = message.capabilities, message.flight_sw_version
                if can & (BYTEWISE | CONVERTED):
                    self._bytewise = bool(can & BYTEWISE)
                version = f"{number >> 24}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}"
                self._parameter_answered(f"{self._flavour.name} {version}")
            case "PARAM_VALUE":
                self._hear_parameter(message)

    def _hear_parameter(self, message: Message) -> None:
        name, kind = message.param_id, message.param_type
        value = parameters.from_wire(message.param_value, kind, bytewise=self._bytewise)
        if name not in self._tries or value is None or self._version is None:
            return
        if name in self._setting:
            before, wanted = self._setting[name]
            if abs(value - wanted) > safety.TOLERANCE:
                return  # an old answer, or a refusal: the parameter is set again
            del self._setting[name]
            self._changed.append((name, before, value))
        self._values[name], self._kinds[name] = value, kind
        for rule in self._rules:
            if name in rule.names:  # the autopilot has the parameter under this name only
                for other_name in rule.names:
                    self._tries.pop(other_name, None)

    def _parameter_answered(self, name: str) -> None:
        self._version = name
        self._events.append(
            AutopilotFound(vehicle=self._vehicle, name=name, system=self._target[0])
        )

    # Questions

    def ask(self, *, now_ns: int) -> list[Message]:
        if self.is_done or self.failure:
            return []
        if self._version is not None and not self._tries:
            self._judge()
            if self.is_done or self.failure:
                return []
        elif self._asked_ns is not None and now_ns - self._asked_ns < AGAIN_NS:
            return []
        self._asked_ns = now_ns
        if self._version is None:
            return self._ask_version()
        questions = []
        for name in list(self._tries)[:AT_ONCE]:
            self._tries[name] += 1
            if self._tries[name] > TRIES:
                del self._tries[name]
            else:
                questions.append(self._question(name))
        return questions

    def _ask_version(self) -> list[Message]:
        self._version_tries += 1
        if self._version_tries > TRIES:
            self._parameter_answered(f"{self._flavour.name} of an unknown version")
        return [request(self._target, VERSION)]

    def _question(self, name: str) -> Message:
        """Message that reads or sets a parameter; the answer to both is the parameter's value."""
        if name not in self._setting:
            return dialect.MAVLink_param_request_read_message(*self._target, name.encode(), -1)
        kind, (_, wanted) = self._kinds[name], self._setting[name]
        value = int(wanted) if kind in parameters.INTEGERS else wanted
        sent = parameters.to_wire(value, bytewise=self._bytewise)
        return dialect.MAVLink_param_set_message(*self._target, name.encode(), sent, kind)

    # Verdict

    def _judge(self) -> None:
        """Report all parameters; then finish, set the unsafe ones, or fail."""
        judged = {rule: safety.judged(rule, self._values) for rule in self._rules}
        parameters = tuple(judged.values())
        unsafe = {rule: parameter for rule, parameter in judged.items() if parameter.wanted}
        self._report(parameters)
        if not unsafe:
            self.is_done = True
        elif self._sets and not self._setting and not self._changed:
            self._begin_setting(unsafe)
        if not self.is_done and not self._tries:
            wrong = tuple(unsafe.values())
            self.failure = ParametersUnsafe(
                vehicle=self._vehicle, parameters=wrong, sets=self._sets
            )
            self._events.append(self.failure)

    def _begin_setting(self, unsafe: Mapping[Rule, AutopilotParameter]) -> None:
        for rule, parameter in unsafe.items():
            if parameter.value is not None:
                self._setting[parameter.name] = (parameter.value, rule.value)
                self._tries[parameter.name] = 0

    def _report(self, parameters: tuple[AutopilotParameter, ...]) -> None:
        if self._changed:
            changes = tuple(self._changed)
            self._events.append(ParametersSet(vehicle=self._vehicle, changes=changes))
        elif not self._setting:
            self._events.append(ParametersRead(vehicle=self._vehicle, parameters=parameters))
