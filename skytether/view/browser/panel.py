"""Panel of one browser beside the scene: texts, plots and, if allowed, controls.

Each browser has its own panel; a browser that may only watch gets no controls.
"""

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from skytether.shared.missions.mission import format_goals, parse_goals
from skytether.shell.driving.control import NETEMS
from skytether.view.browser.flight import PageFlight
from skytether.view.page import words
from skytether.view.page.changes import together
from skytether.view.page.controls import (
    THRESHOLDS,
    WAYS,
    Knob,
    Values,
    applied,
    is_cut,
    knobs,
    texts,
    triggers,
)
from skytether.view.page.plots import POINTS, Look, Plots, more, of_flight, of_link
from skytether.view.page.scene import GROUND_RGB, WIDE, Scene, in_space
from skytether.view.page.state import GUIDED, LIVE_POINT, ZONED, VehicleTrack

HELD_S = 1.5
"""Time for which a slider keeps the position that the user has set [s]."""
IMPAIRMENTS = 'Impairments joined by &, as in "constant(0.05) & loss(0.1)", see docs/network.md'
ZONES = "Zones joined by &, as in 'box(-1, 1, 2, 3) & cylinder(0, -2, 0.5)', see docs/together.md"
GUIDES, DRAWS = "sends the vehicle", "draws a zone"
CLICKS = ("looks", GUIDES, DRAWS)
CLICKED = "Effect of a click on the map: sets the chosen vehicle's goal, or a corner of a box."
MAY_END = (
    "The vehicle then brakes and hovers. Without a link it lands after a while and stays down."
)
ALL_IS_LOST = "Every packet is lost then, both ways."
GOAL_S = 60.0
"""Largest age of a desired position that is shown [s]."""
LEAD_S = 5.0
"""Largest age of a draggable target's position that is shown [s]."""
AFTER_LEAP = (
    "After its position has leapt: fly on in the old frame (the leap is subtracted), in the new "
    "one (figure and fence move with it), or stay, see docs/failsafe.md"
)
FIXED = (
    "Both ends agree on the scheme and the step length before a flight and predict with them: "
    "they cannot be changed in flight. Start a new flight with --control.scheme or --control.dt."
)
WIDE_PLOTS = 760
"""Width of plots on a page without a scene [pixels]."""
NARROW = 800
"""Largest window width at which panels cover the scene instead of standing beside it [pixels]."""
MOVED_M = 0.05
"""Distance between target and handle [m] above which the handle is moved to the target."""
LIGHT = "Light page"
AS_PREFERRED = f"""<img hidden src="data:," onerror="
const label = [...document.querySelectorAll('label')].find(each => each.textContent === '{LIGHT}');
const prefers = matchMedia('(prefers-color-scheme: light)').matches;
if (prefers && !label.control.checked) label.control.click();
">"""
"""HTML that makes the page light if the browser prefers light pages."""

More = Callable[[viser.GuiApi], Callable[[], None]]


class Panel:
    """Panel of one browser.

    Args:
        flights: flights on the page whose scenarios have arrived.
        unlock: checks a token and returns whether it is right; None if the page has no token.
        more: adds further controls for a browser that may change the flight; the function that it
            returns is called at each redraw.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        flights: Sequence[PageFlight],
        scene: Scene,
        *,
        may_play: bool,
        unlock: Callable[[str], bool] | None,
        more: More | None,
    ) -> None:
        self._client, self._flights, self._unlock = client, flights, unlock
        self._controls: list[Controls] = []
        gui = client.gui
        self._dress(light=False)
        gui.set_panel_label("Skytether")
        # In a narrow window, a second panel would be hidden below this one.
        tabs = gui.add_tab_group() if client.camera.image_width <= NARROW else None
        if tabs is None:
            gui.main_panel.dock_right()
        gui.main_panel.set_width(360)
        self._scene = scene
        self._aimed = scene.camera(WIDE)[0]
        """Position of the camera as last set by the panel."""
        with tabs.add_tab("Now") if tabs else nullcontext():
            self._add_words(more if may_play else None, may_play=may_play)
        self._plots: list[Plots] = []
        self._add_plots(tabs or gui.add_panel())

    def _add_words(self, more: More | None, *, may_play: bool) -> None:
        gui, flights = self._client.gui, self._flights
        self._status = [gui.add_html("") for _ in flights]
        self._more = more(gui) if more else None
        numbers = sorted({number for each in flights for number in each.state.vehicles} or {1})
        self._vehicle = gui.add_dropdown(
            "Vehicle", tuple(map(str, numbers)), visible=len(numbers) > 1
        )
        self._play = gui.add_folder("Play", visible=any(each.operator for each in flights))
        if not may_play:
            self._let_look()
        elif any(each.operator for each in flights):
            self._let_play()
        flying = [each for each in flights if each.state.flies]
        with gui.add_folder("Figures", visible=bool(flying)):
            self._figures = [gui.add_html("") for _ in flights]
            zoned = any(each.state.has_zones for each in flying)
            mission = any(each.state.scenario.is_mission for each in flying)
            titles = [each.title for each in flying]
            gui.add_html(words.legend(titles, has_zones=zoned, mission=mission))
        light = gui.add_checkbox(LIGHT, initial_value=False)
        gui.add_html(AS_PREFERRED)

        # Without a GPU, viser's own grid takes 1 s to draw; lines are fast.
        ground = self._client.scene.add_line_segments(
            "/ground",
            self._scene.ground,
            GROUND_RGB[False],
            thickness=1.0,
            thickness_units="screen",
        )

        @light.on_update
        def _(_: Any) -> None:
            self._dress(light=light.value)
            ground.colors = np.array(GROUND_RGB[light.value], np.uint8)

    def _add_plots(self, panel: viser.GuiTabGroupHandle | viser.PanelHandle) -> None:
        gui, flights = self._client.gui, self._flights
        titles = [each.title for each in flights]
        scenarios = [each.state.scenario for each in flights]
        axes = max(each.model.axes for each in scenarios)
        solves = any(not each.control.properties.splines for each in scenarios)
        flies = any(each.state.flies for each in flights)
        self._nobody = None if flies else VehicleTrack(0, scenarios[0])
        shown = {"Network": of_link([*flights[0].state.directions.values()])}
        if flies:
            mission = scenarios[0].is_mission
            shown = {"Flight": of_flight(mission=mission), "More": more(axes, solves=solves)}
        for name, plots in shown.items():
            with panel.add_tab(name):
                self._plots.append(Plots(gui, titles, plots))
        with panel.add_tab("Events"):
            self._said = gui.add_html("")
        if isinstance(panel, viser.PanelHandle):
            panel.dock_left()
            panel.set_width(400 if flies else WIDE_PLOTS)

    def _dress(self, *, light: bool) -> None:
        self._client.gui.configure_theme(
            dark_mode=not light, show_logo=False, show_share_button=False
        )

    def _let_look(self) -> None:
        """Explain why this browser cannot change anything, and how to unlock it."""
        with self._play:
            text = "This page is read-only here: changes can be made on the machine itself"
            self._client.gui.add_html(
                words.note(text + (", or with its token." if self._unlock else "."))
            )
            if self._unlock is None:
                return
            unlock, field = self._unlock, self._client.gui.add_text("Token", "")

            @field.on_update
            def _(_: Any) -> None:
                if unlock(field.value.strip()) and not self._controls:
                    field.remove()
                    self._let_play()

    def _let_play(self) -> None:
        with self._play:
            self._controls = [
                Controls(self._client, self._flights, lambda: int(self._vehicle.value))
            ]

    def _aim(self) -> None:
        """Point the camera at all flights after a resize, unless the user has moved it."""
        camera = self._client.camera
        aim, target = self._scene.camera(camera.aspect)
        is_ours = np.abs(camera.position - self._aimed).max() < 0.05 * self._scene.reach_m
        if is_ours and np.abs(aim - self._aimed).max() > 0.05 * self._scene.reach_m:
            self._aimed = aim
            camera.position, camera.look_at = aim, target

    def show(self, now_ns: int) -> None:
        self._aim()
        numbers = sorted({number for each in self._flights for number in each.state.vehicles})
        if numbers and tuple(map(str, numbers)) != tuple(self._vehicle.options):
            self._vehicle.options = tuple(map(str, numbers))
            self._vehicle.visible = len(numbers) > 1
        vehicle = int(self._vehicle.value)
        shown = zip(self._status, self._figures, self._flights, strict=True)
        for status, figures, flight in shown:
            status.content = words.status(flight.state, vehicle, now_ns, flight.title)
            figures.content = words.figures(flight.state, vehicle, now_ns, flight.title)
        self._said.content = words.said([(each.title, each.state) for each in self._flights])
        tracks = [each.state.vehicles.get(vehicle, self._nobody) for each in self._flights]
        placed = [track for track in tracks if track]
        if len(placed) == len(tracks):
            end_s = max(track.time_s for track in placed)
            looks = [
                Look(flight.state, track.curves(POINTS, end_s), now_ns, vehicle)
                for flight, track in zip(self._flights, placed, strict=True)
            ]
            for plots in self._plots:
                plots.draw(looks)
        for controls in self._controls:
            controls.show()
        if self._more:
            self._more()


def assign(handle: Any, value: Any) -> None:
    """Set a handle's value; a function, because mypy treats viser's property as read-only."""
    handle.value = value


class _Note:
    """Text of a refusal, under the field of the refused value."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html("", visible=False)
        self._keys: frozenset[str] = frozenset()
        self._own = ""

    def asks(self, keys: Iterable[str]) -> None:
        """From now on show the flights' refusals of a request to change exactly these keys."""
        self._keys, self._own = frozenset(keys), ""

    def refuse(self, why: str) -> None:
        """Show a refusal by the page itself, until the field's next request."""
        self._keys, self._own = frozenset(), why

    def show(self, flights: Sequence[PageFlight]) -> bool:
        """Redraw; returns whether this note shows the newest answer."""
        refused = [each.answer for each in flights if each.refused and each.asked == self._keys]
        why = "; ".join(dict.fromkeys(refused)) or self._own
        self._html.content = words.refused(why)
        self._html.visible = bool(why)
        return bool(refused)


class _Slider:
    """Slider for a number that the browser can change.

    Callbacks in this module are coroutines: viser runs coroutines in order, and plain functions in
    any order.

    Args:
        ask: requests a number from the flights, and returns the requested keys.
    """

    def __init__(
        self, gui: viser.GuiApi, knob: Knob, ask: Callable[[Knob, float], Collection[str]]
    ) -> None:
        self.knob = knob
        self._slider = gui.add_slider(
            knob.label, knob.low, knob.high, knob.step, knob.low, hint=knob.hint, visible=False
        )
        self.note = _Note(gui)
        self._shown = knob.low
        self._moved_s = -np.inf

        @self._slider.on_update
        async def _(event: Any) -> None:
            if event.client is None:  # the program itself made the change
                return
            number, low, high = float(self._slider.value), self._slider.min, self._slider.max
            if low <= number <= high:
                self._moved_s = time.monotonic()
                self.note.asks(ask(knob, number))
            else:
                self.note.refuse(knob.with_unit(f"{low:g} to {high:g}"))
                assign(self._slider, self._shown)

    def show(self, values: Values) -> None:
        number = self.knob.read(values)
        self._slider.visible = number is not None
        if number is None or time.monotonic() - self._moved_s < HELD_S:
            return
        self._shown = number
        self._slider.max = max(self._slider.max, number)
        self._slider.min = min(self._slider.min, number)
        if abs(self._slider.value - number) > self.knob.step / 2:
            assign(self._slider, number)


class _Question:
    """Question that asks to confirm a change which may end the flight; one at a time.

    Args:
        warning: consequence of the change.
    """

    def __init__(self, gui: viser.GuiApi, warning: str) -> None:
        self._gui, self._warning = gui, warning
        self._shown: Any = None

    def ask(
        self,
        title: str,
        yes: str,
        change: Callable[[], None],
        leave: Callable[[], None] = lambda: None,
    ) -> None:
        """Ask for confirmation, unless a question is shown already.

        Args:
            yes: text of the button that confirms.
            change: called if the user confirms.
            leave: called if the user does not confirm.
        """
        if self._shown is not None:
            leave()
            return
        self._shown = self._gui.add_modal(title)
        with self._shown:
            self._gui.add_html(words.note(self._warning))
            meant = self._gui.add_button(yes, color="red")
            not_meant = self._gui.add_button("Leave it")
        meant.on_click(partial(self._answer, change))
        not_meant.on_click(partial(self._answer, leave))

    async def _answer(self, act: Callable[[], None], _: Any) -> None:
        if self._shown is not None:
            self._shown.close()
            self._shown = None
            act()


class _Network:
    """Controls of one path's impairments; one of several paths can be cut alone.

    Args:
        number: number of the path, from 1.
        ask, cut, heal: functions that change, cut and heal this path.
        labels: names of both directions.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        number: int,
        ask: Callable[[dict[str, Any]], None],
        cut: Callable[[], None],
        heal: Callable[[], None],
        labels: Sequence[str],
        *,
        flies: bool,
    ) -> None:
        self._number = number
        self._shown: dict[str, str] = {}
        self._folder = gui.add_folder("Network", expand_by_default=not flies, visible=False)
        with self._folder:
            self._texts = {
                way: gui.add_text(label, "", hint=IMPAIRMENTS)
                for way, label in zip(WAYS, labels, strict=True)
            }
            self.note = _Note(gui)
            apply = gui.add_button("Change the network")
            self._alone = gui.add_button_group("This path", ("cut", "heal"), visible=False)

        @self._alone.on_click
        async def _(_: Any) -> None:
            (cut if self._alone.value == "cut" else heal)()

        @apply.on_click
        async def _(_: Any) -> None:
            given = {way: text.value for way, text in self._texts.items()}
            changed = {way: text for way, text in given.items() if text != self._shown.get(way)}
            self.note.asks(changed)
            if changed:
                ask(changed)

    def show(self, values: Values, *, is_alone: bool) -> None:
        shown = texts(values)
        self._folder.visible = bool(shown)
        self._folder.label = "Network" if is_alone else f"Network of path {self._number}"
        self._alone.visible = not is_alone
        if shown != self._shown:
            self._shown = shown
            for way, text in shown.items():
                assign(self._texts[way], text)


class Controls:
    """Controls of one browser; a change applies to all flights on the page.

    Args:
        vehicle: returns the number of the chosen vehicle.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        flights: Sequence[PageFlight],
        vehicle: Callable[[], int],
    ) -> None:
        self._client, self._vehicle = client, vehicle
        self._flights = [each for each in flights if each.operator]
        gui = client.gui
        scenario = self._flights[0].state.scenario
        flies = any(each.state.flies for each in self._flights)
        self._question = _Question(gui, MAY_END if flies else ALL_IS_LOST)
        self._cut = gui.add_button("Cut the link", color="red", icon=viser.Icon.PLUG_CONNECTED_X)
        self._heal = gui.add_button("Heal it", color="green", icon=viser.Icon.PLUG_CONNECTED)
        self._answer = gui.add_html("")
        self._sliders: list[_Slider] = []
        offered = knobs(scenario.model.axes)
        self._add_sliders(knob for knob in offered if knob.process == "netem")
        if flies:
            self._add_trigger()
        self._undo = gui.add_button("Undo", disabled=True, icon=viser.Icon.ARROW_BACK_UP)
        self._add_sliders(knob for knob in offered if knob.process != "netem")
        ways = self._flights[0].state.directions.values()
        labels = ("To the vehicle", "To the server") if flies else [*map(str.capitalize, ways)]
        self._networks = {
            netem: _Network(
                gui,
                number,
                partial(self._path, netem),
                partial(self._cut_alone, netem),
                partial(self._heal_all, (netem,)),
                labels,
                flies=flies,
            )
            for number, netem in enumerate(NETEMS, start=1)
        }
        self._lead: _Lead | None = None
        self._mission: _Mission | None = None
        if flies:
            self._let_fly()

        @self._cut.on_click
        async def _(_: Any) -> None:
            self._question.ask("Cut the link?", "Yes, cut it", self._cut_all)

        @self._heal.on_click
        def _(_: Any) -> None:
            self._heal_all()

        @self._undo.on_click
        async def _(_: Any) -> None:
            if any(flight.undo_cuts for flight in self._flights):
                self._question.ask("Cut the link?", "Yes, cut it", self._undo_all)
            else:
                self._undo_all()

    def _add_sliders(self, offered: Iterable[Knob]) -> None:
        self._sliders += [_Slider(self._client.gui, knob, self._ask) for knob in offered]

    def _add_trigger(self) -> None:
        gui, control = self._client.gui, self._flights[0].state.scenario.control
        self._trigger = gui.add_dropdown(
            "Trigger",
            triggers(control.scheme, control.trigger),
            initial_value=control.trigger,
            hint="Rule for sending a plan",
        )
        self._trigger_note = _Note(gui)
        self._add_sliders(THRESHOLDS)

        @self._trigger.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self._trigger_note.asks(("control.trigger",))
                self._all("server", {"control.trigger": self._trigger.value})

    def _let_fly(self) -> None:
        gui, scenario = self._client.gui, self._flights[0].state.scenario
        self._armed = gui.add_checkbox("Armed", True, hint="Disarmed: the vehicle ignores plans")
        self._after_leap = gui.add_button_group(
            "After a leap", ("old", "new", "stay"), visible=False, hint=AFTER_LEAP
        )
        gui.add_text("Scheme", scenario.control.scheme, disabled=True, hint=FIXED)
        if scenario.reference.shape == "live":
            self._lead = _Lead(self._client, self._flights)
        if scenario.is_mission:
            ask = partial(self._all, "server")
            self._mission = _Mission(self._client, self._flights, ask, self._vehicle)

        @self._after_leap.on_click
        async def _(_: Any) -> None:
            self._chosen({"vehicle.after_leap": self._after_leap.value})

        @self._armed.on_update
        async def _(event: Any) -> None:
            if event.client is None:
                return
            arm = partial(self._chosen, {"armed": self._armed.value})
            if self._armed.value:
                arm()
            else:
                rearm = partial(assign, self._armed, True)
                self._question.ask("Disarm the vehicle?", "Yes, disarm", arm, rearm)

    def _cut_all(self, netems: Sequence[str] = NETEMS) -> None:
        for flight in self._flights:
            flight.cut(netems)

    def _cut_alone(self, netem: str) -> None:
        """Cut the path of a netem; ask for confirmation first if no other path carries packets."""
        cut = partial(self._cut_all, (netem,))
        if any({*each.netems} <= {netem, *each.cuts} for each in self._flights):
            self._question.ask("Cut the last path?", "Yes, cut it", cut)
        else:
            cut()

    def _heal_all(self, netems: Sequence[str] = NETEMS) -> None:
        for flight in self._flights:
            flight.heal(netems)

    def _undo_all(self) -> None:
        for flight in self._flights:
            flight.undo()

    def _all(self, role: str, values: dict[str, Any]) -> None:
        for flight in self._flights:
            for process in flight.processes(role):
                flight.ask(process, values)

    def _path(self, netem: str, values: dict[str, Any]) -> None:
        for flight in self._flights:
            flight.ask(netem, values)

    def _chosen(self, values: dict[str, Any]) -> None:
        """Request that the client of the chosen vehicle changes keys to these values."""
        for flight in self._flights:
            flight.ask(flight.client(self._vehicle()), values)

    def _ask(self, knob: Knob, number: float) -> Collection[str]:
        """Request a number for a slider; returns the keys that are to change."""
        keys: set[str] = set()
        for flight in self._flights:
            for process in flight.processes(knob.process):
                values = flight.values.get(process, {})
                if knob.read(values) is None:
                    continue
                changed = knob.write(values, number)
                if process in NETEMS and is_cut(applied(values, changed)):
                    self._question.ask("Cut the link?", "Yes, cut it", self._cut_all)
                    return ()
                keys |= changed.keys()
                flight.ask(process, changed)
        return keys

    def show(self) -> None:
        flight = self._flights[0]
        for netem, network in self._networks.items():
            network.show(flight.values.get(netem, {}), is_alone=len(flight.netems) < 2)
        for slider in self._sliders:
            slider.show(flight.of_role(slider.knob.process))
        if flight.state.flies:
            self._show_flight(flight)
        is_cut_off = bool(flight.netems) and flight.cuts == flight.netems
        self._cut.visible, self._heal.visible = not is_cut_off, bool(flight.cuts)
        self._cut.disabled = not flight.netems
        undoable = flight.undoable
        self._undo.disabled = not undoable
        self._undo.label = f"Undo: {together(undoable, 1)}" if undoable else "Undo"
        at_fields = [each.show(self._flights) for each in self._notes()]
        said = [] if any(at_fields) else [(each.answer, each.refused) for each in self._flights]
        self._answer.content = words.answers(said)

    def _notes(self) -> Iterator[_Note]:
        yield from (slider.note for slider in self._sliders)
        yield from (network.note for network in self._networks.values())
        if self._flights[0].state.flies:
            yield self._trigger_note
        if self._mission:
            yield self._mission.note

    def _show_flight(self, flight: PageFlight) -> None:
        server = flight.of_role("server")
        trigger = server.get("control.trigger", self._trigger.value)
        if trigger != self._trigger.value:
            scheme = flight.state.scenario.control.scheme
            self._trigger.options = triggers(scheme, trigger)
            assign(self._trigger, trigger)
        values = flight.values.get(flight.client(self._vehicle()), {})
        armed = values.get("armed", self._armed.value)
        if armed != self._armed.value:
            assign(self._armed, armed)
        flies_real = flight.state.scenario.vehicle.kind in ("mavlink", "ros2")
        self._after_leap.visible = flies_real and "vehicle.after_leap" in values
        if self._lead:
            self._lead.show()
        if self._mission:
            self._mission.show()


class _Mission:
    """Controls of a mission: zones, typed or drawn, and the chosen vehicle's goal."""

    def __init__(
        self,
        client: viser.ClientHandle,
        flights: Sequence[PageFlight],
        ask: Callable[[dict[str, Any]], None],
        vehicle: Callable[[], int],
    ) -> None:
        self._flight, self._state, self._ask = flights[0], flights[0].state, ask
        self._shown, self._vehicle = self._state.zones, vehicle
        self._corners: list[NDArray[Any]] = []
        gui = client.gui
        with gui.add_folder("Mission"):
            self._text = gui.add_text("Zones", self._shown, hint=ZONES)
            self.note = _Note(gui)
            apply = gui.add_button("Change the zones")
            self._clicks = gui.add_dropdown("A click", CLICKS, hint=CLICKED)
            gui.add_html(words.note("Drag the handle: it is the chosen vehicle's goal."))
        self._axes = self._state.scenario.model.axes
        self._handle = _Handle(client, "/goal", self._axes, self._drag)

        @apply.on_click
        async def _(_: Any) -> None:
            self.note.asks((ZONED,))
            ask({ZONED: self._text.value})

        @self._clicks.on_update
        async def _(_: Any) -> None:
            self._corners.clear()

        @client.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            if direction[2] * origin[2] < 0:  # else the click is above the horizon
                at = (origin - direction * origin[2] / direction[2])[:2]
                if self._clicks.value == GUIDES:
                    here = self._goal()
                    self._guide(np.append(at, here[2:] if here is not None else [0.0]))
                elif self._clicks.value == DRAWS:
                    self._draw(at)

    def _goal(self) -> NDArray[Any] | None:
        track = self._state.vehicles.get(self._vehicle())
        return track.goal(GOAL_S) if track else None

    def _drag(self, place: NDArray[Any], held: bool) -> None:
        if not held:
            self._guide(place)

    def _guide(self, place: NDArray[Any]) -> None:
        """Set the chosen vehicle's goal [m]; shape (axes,), further elements are ignored."""
        values = self._flight.of_role("server")
        goals = parse_goals(values.get(GUIDED, ""), self._axes)
        goals[self._vehicle()] = np.round(place[: self._axes], 2)
        self._ask({GUIDED: format_goals(goals)})

    def _draw(self, at: NDArray[Any]) -> None:
        self._corners.append(at)
        if len(self._corners) == 2:
            (x0, y0), (x1, y1) = np.sort(np.round(self._corners, 2), axis=0)
            self._corners.clear()
            box = f"box({x0}, {x1}, {y0}, {y1})"
            self._ask({ZONED: " & ".join(filter(None, (self._state.zones, box)))})

    def show(self) -> None:
        self._handle.show(self._goal())
        if self._state.zones != self._shown:
            self._shown = self._state.zones
            assign(self._text, self._shown)


class _Handle:
    """Handle in the scene that the user can drag.

    Args:
        axes: axes along which it can be dragged.
        moved: called with the position to which it was dragged [m; shape (3,)], and whether it is
            still held.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        name: str,
        axes: int,
        moved: Callable[[NDArray[Any], bool], None],
    ) -> None:
        self._held, self._free_s = False, -np.inf
        self._handle = client.scene.add_transform_controls(
            name,
            scale=0.6,
            active_axes=(True, True, axes > 2),
            disable_rotations=True,
            depth_test=False,
            visible=False,  # hidden until a position is known
        )

        @self._handle.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self._held = event.phase != "end"
                self.stay()
                moved(self.place, self._held)

    @property
    def place(self) -> NDArray[Any]:
        return np.asarray(self._handle.position)

    def stay(self) -> None:
        """Ignore positions for HELD_S, until the answer to a change has arrived."""
        self._free_s = time.monotonic() + HELD_S

    def put(self, place: NDArray[Any]) -> None:
        self._handle.position = place

    def show(self, goal: NDArray[Any] | None) -> None:
        if goal is None or self._held or time.monotonic() < self._free_s:
            return
        self._handle.visible = True
        place = in_space(goal[None])[0]
        if np.abs(place - self.place).max() > MOVED_M:
            self.put(place)


class _Lead:
    """Control of a `live` reference: a target that the user can drag, or place by a click."""

    def __init__(self, client: viser.ClientHandle, flights: Sequence[PageFlight]) -> None:
        self._flights = flights
        self._axes = flights[0].state.scenario.model.axes
        self._handle = _Handle(client, "/lead", self._axes, lambda place, _: self._move(place))
        client.gui.add_html(words.note("Drag the target, or click where it should be."))

        @client.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            height = self._handle.place[2] - origin[2]
            if direction[2] * height > 0:  # else the click is above the horizon
                place = origin + direction * height / direction[2]
                self._handle.put(place)
                self._handle.stay()
                self._move(place)

    def _move(self, place: NDArray[Any]) -> None:
        for flight in self._flights:
            flight.ask(
                flight.processes("server")[0],
                {LIVE_POINT: [np.round(place[: self._axes], 3).tolist()]},
            )

    def show(self) -> None:
        for track in list(self._flights[0].state.vehicles.values())[:1]:
            self._handle.show(track.goal(LEAD_S))
