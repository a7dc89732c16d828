"""The page of netem alone: its directions are named by their ends."""

import re

import pytest

from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.directions import FLIGHT, Directions
from skytether.shared.endpoints.other_directions import RELAY, RUN
from skytether.shared.events.flight import Changed
from skytether.shared.scenario import reading
from skytether.shared.telemetry.feed import Figures, Opened, Said
from skytether.view.page import words
from skytether.view.page.plots import of_link
from skytether.view.page.state import State


@pytest.mark.parametrize("ways", [RELAY, RUN, FLIGHT])
def test_words_plots_and_events_have_the_names_of_the_directions(ways: Directions) -> None:
    state, toml = State(), reading.to_toml(reading.load_base("transparent")).decode()
    opened = Opened(
        process="netem",
        name="transparent",
        scenario=toml,
        parts={},
        directions=ways,
        wall_ns=1,
        time_ns=1,
    )
    state.take("netem", opened)
    counted = {ways[0]: {"lost": 41, "queue": 3}, ways[1]: {"lost": 42, "queue": 4}}
    state.take("netem", Figures(time_ns=SECOND_NS, figures={"flows": 1, **counted}))
    name = "" if ways == FLIGHT else ways[1]
    change = Changed(key="network.downlink", before='"none"', after='"ordered"', name=name)
    state.take("netem", Said(time_ns=SECOND_NS, event=change))
    here, there = state.directions.values()
    assert (here, there) == (
        ("up", "down") if ways == FLIGHT else tuple(way.replace("_", " ") for way in ways)
    )
    shown = re.sub("<[^>]*>", " ", words.status(state, 1, SECOND_NS))
    assert re.search(rf"{here}, so far .*\b41 lost.* {there}, so far .*\b42 lost", shown)
    assert "3 packets" in shown
    assert ("downlink" in shown) == (ways == FLIGHT)
    assert {line.label for plot in of_link([here, there]) for line in plot.lines} == {here, there}
    assert state.network.waiting(0, 3 * SECOND_NS).max() == 3
