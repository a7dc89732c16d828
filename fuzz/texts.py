"""Targets for texts: scenarios, requests for changes in flight, and output of processes."""

import importlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from random import Random

import msgspec
import numpy as np

from fuzz.datagrams import SCENARIOS, EndpointInFlight
from fuzz.mutators import text_changed, words_of
from fuzz.target import Target, flown
from skytether.netem.impairments import traces
from skytether.netem.proxy import Proxy
from skytether.shared import formats
from skytether.shared.base import toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints import change
from skytether.shared.endpoints.change import REQUEST_BYTES_MAX, Answer, Running
from skytether.shared.events.processes import Counted
from skytether.shared.formats import bounded, pings, plans, recorded, tracks, zone_files
from skytether.shared.missions import mission, zone_texts
from skytether.shared.scenario import contradictions, grammar, reading
from skytether.shared.scenario.dotted import value
from skytether.shared.scenario.grammar import GrammarError
from skytether.shared.scenario.registry import REFERENCES, TRIGGERS, File
from skytether.shared.wire import handshake, keys
from skytether.shared.wire.protocol import Hello, Welcome, decode, encode
from skytether.shell.driving.control import ANSWER_BYTES_MAX, ControlError, answer_of
from skytether.shell.processes import log
from skytether.shell.processes.log import LogLine, line_of

SAMPLES_S = np.array([-1.0, 0.0, 0.05, 7.3, 1e3, 1e5])
"""Times at which a scenario's trajectory must be finite [s]."""
LIVE = reading.check(
    {
        "reference": {"shape": "live", "points_m": [[0.0, 0.0]]},
        "control": {"scheme": "committed", "trigger": "state_gap & budget(5, 2) | silence(1)"},
    },
    "fuzz",
)
"""Scenario in which as many keys as possible can be changed in flight."""
POLICIES = [name.encode() for name in (*TRIGGERS, *REFERENCES)] + b"( ) & | ! ,".split()


class Text(Target):
    """Target that takes text: mutations of `known`, with tokens of `known` and `words`."""

    largest = 8192

    def __init__(self, seeds: Sequence[bytes], words: Sequence[bytes] = ()) -> None:
        self._seeds = seeds
        self._words = [*words_of(seeds), *words]

    def seeds(self) -> Sequence[bytes]:
        return self._seeds

    def mutated(self, rng: Random, payload: bytes) -> bytes:
        return text_changed(rng, payload, self._words)


class ScenarioFile(Text):
    """Target for a scenario file: it is refused by `ConfigError`, or can be flown."""

    code = (
        reading,
        contradictions,
        grammar,
        tracks,
        toml,
        importlib.import_module("tomllib._parser"),
    )

    def __init__(self, folder: Path) -> None:
        self._path = folder / "it.toml"
        files = [(reading.SCENARIOS / f"{name}.toml").read_bytes() for name in reading.names()]
        whole = [reading.to_toml(reading.load(name)) for name in reading.names()]
        made = [reading.to_toml(each) for each in (*SCENARIOS, LIVE)]
        words = [f'"{name}"'.encode() for name in (*reading.names(), "compare/none", "it.toml")]
        super().__init__([*files, *whole, *made], [*words, *POLICIES])

    def __call__(self, payload: bytes) -> None:
        self._path.write_bytes(payload)
        try:
            scenario = reading.load(str(self._path))
        except ConfigError:
            return
        again = toml.loads(reading.to_toml(scenario).decode())
        assert reading.check(again) == scenario
        terms, largest = scenario.terms(), 2**64 - 1
        hello = encode(Hello(2**16 - 1, largest, terms))
        welcome = encode(Welcome(2**16 - 1, 2**32 - 1, largest, largest, 2**63 - 1, 0, terms))
        for message in (hello, welcome):
            assert encode(decode(message, terms)) == message
        assert len(hello) <= handshake.HELLO_BYTES_MAX
        assert len(welcome) <= handshake.WELCOME_BYTES_MAX
        assert np.isfinite(scenario.make_reference()(SAMPLES_S)).all()


class NamedFiles(Text):
    """Target for files that a scenario names: tables, zones, traces, and keys.

    The first byte of an input chooses the reader, which raises an error for the user, or gives
    values that can be flown.
    """

    code = (
        *(importlib.import_module(f"{formats.__name__}.{name}") for name, *_ in formats.FORMATS),
        *(bounded, tracks, mission, plans, zone_files, zone_texts),
        *(recorded, pings, traces, keys),
    )
    largest = 20_000

    def __init__(self, folder: Path) -> None:
        self._path = folder / "it"
        row = "64 bytes from 192.0.2.1: icmp_seq={0} ttl=57 time={0}.5 ms"
        stamps = '{"client":{"send":{"monotonic":%d}}}'
        trip = f'{{"lost":"false","delay":{{"rtt":2000000}},"timestamps":{stamps}}}'
        ring = "[[[0,0],[9,0],[9,9],[0,9],[0,0]]]"
        feature = '{{"type":"Feature","properties":{},"geometry":{{"type":"{}","coordinates":{}}}}}'
        box = feature.format('{"kind":"fence"}', "Polygon", ring)
        point = feature.format('{"radius_m":3}', "Point", "[4,4]")
        item = '{"type":"SimpleItem","command":16,"frame":3,"params":[1,0,0,null,47.001,8,9]}'
        route = (
            '{"fileType":"Plan","mission":{"plannedHomePosition":[47,8,400],"hoverSpeed":5,'
            f'"items":[{item}]}},"geoFence":{{"circles":[{{"inclusion":true,"circle":'
            '{"center":[47,8],"radius":50}}],"polygons":[{"inclusion":false,"polygon":'
            "[[47,8.001],[47,8.002],[47.001,8.002]]}]}}"
        )
        texts = (
            "t,x,y\n0,0,0\n5,1.5,-2\n",
            "vehicle,t,x,y\n1,0,0,0\n1,5,4,4\n2,0,9,0\n",
            "t,lat,lon\n0,47,8\n5,47.0001,8\n",
            (
                "duration,x^0,x^1,x^2,x^3,x^4,x^5,x^6,x^7,y^0,y^1,y^2,y^3,y^4,y^5,y^6,y^7\n"
                "2,0,1,0,0,0,0,0,0,1,0,0,0,0,0,0,0\n"
            ),
            route,
            f'{{"type":"FeatureCollection","units":"m","features":[{box},{point}]}}',
            (
                "<kml><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>"
                "8,47 8.001,47 8.001,47.001</coordinates></LinearRing></outerBoundaryIs></Polygon>"
                "</Placemark></kml>"
            ),
            route,
            "QGC WPL 110\n0 1 0 16 0 0 0 0 47 8 400 1\n1 0 3 16 1 0 0 0 47.001 8 9 1\n",
            (
                "<gpx><trk><trkseg><trkpt lat='47' lon='8'><ele>9</ele><time>2026-01-01T00:00:00Z"
                "</time></trkpt></trkseg></trk></gpx>"
            ),
            (
                "<kml><LineString><altitudeMode>absolute</altitudeMode><coordinates>8,47,9 "
                "8,47.001,9</coordinates></LineString></kml>"
            ),
            "time_s,delay_s,lost\n0,0.1,0\n1,,1\n2,0.2,0\n",
            "timestamp,rtt\n1700000000000,20\n1700000000200,-1\n",
            "\n".join(map(row.format, (1, 2, 4))),
            (
                f"PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data.\n[17.2] {row.format(65535)}\n"
                "2 packets transmitted, 1 received, 50% packet loss, time 812ms"
            ),
            (
                "Pinging 192.0.2.1 with 32 bytes of data:\nReply from 192.0.2.1: time<1ms\nlost\n\n"
                "    Packets: Sent = 4, Received = 2, Lost = 2 (50% loss)"
            ),
            (
                "$ fping -p 200 h\nh : [0], 64 bytes, 20.1 ms\nh : [1], timed out\n"
                "h : xmt/rcv/%loss = 3/1/66%"
            ),
            f'{{"round_trips":[{trip % 5},{trip % 9}]}}',
            "0\n3\n3\n17\n",
            keys.write(1, 1, bytes(32)) + keys.write(2, 1, bytes(32)),
        )
        kinds = b"\0\1\1\0\0\2\2\2\0\1\1" + 7 * b"\3" + b"\4\5"
        seeds = [bytes([k]) + text.encode() for k, text in zip(kinds, texts, strict=True)]
        super().__init__(seeds, [b"nan", b"1e308", b"-0", b"inf", b"9" * 5000, b"[" * 500])

    def __call__(self, payload: bytes) -> None:
        self._path.write_bytes(payload[1:])
        with suppress(ConfigError, GrammarError, ValueError):
            match (payload or b"\0")[0] % 6:
                case 0:
                    assert np.isfinite(tracks.path(payload[1:], 2, (47.0, 8.0))(SAMPLES_S)).all()
                case 1:
                    found = tracks.tracks(payload[1:], 2, (47.0, 8.0))
                    for is_show in (False, True):
                        mission.Mission(found, 2, 1, is_show=is_show).nearest(1.0, 1.0)
                case 2:
                    file = File("it", payload[1:], (47.0, 8.0))
                    for kind in ("geojson", "kml", "plan"):
                        with suppress(GrammarError):
                            kept = zone_texts.parse(f"{kind}(it)", 2, (file,))
                            kept.clearance(np.zeros((2, 2)))
                case 3:
                    parsed = recorded.recorded_in.__wrapped__(File("it", payload[1:]), "auto")
                    assert np.isfinite(parsed.delay_s).all()
                    assert (np.diff(parsed.time_s) > 0.0).all()
                case 4:
                    times_s = traces.deliveries_in.__wrapped__(File("it", payload[1:]))
                    assert np.isfinite(times_s).all()
                case _:
                    keys.parse("it", payload[1:])


class ControlTarget(Text, EndpointInFlight):
    """Target for control requests: each is answered, and the changed scenario can be flown."""

    code = (change, reading, contradictions, grammar)
    largest = REQUEST_BYTES_MAX + 1

    def __init__(self) -> None:
        EndpointInFlight.__init__(self, LIVE)
        tables = [reading.to_table(each) for each in (LIVE, *SCENARIOS)]
        values = [
            {key: value(table, key)}
            for table in tables
            for running in self._running
            for key in sorted(running.changeable)
        ]
        seeds = [msgspec.json.encode(each) for each in ({}, *values)]
        Text.__init__(self, seeds, POLICIES)

    def _begin(self) -> None:
        super()._begin()
        ends = (self.server, self.client, Proxy(self._scenario, server=("server", 0)))
        self._running = [Running(end, self._scenario) for end in ends]

    def _attack(self, payload: bytes) -> None:
        for running in self._running:
            before = running.scenario
            answer = running.answer(payload[: REQUEST_BYTES_MAX + 1], now_ns=self._now_ns)
            assert len(answer) <= ANSWER_BYTES_MAX, payload.hex()
            parsed = answer_of(answer)
            assert bool(parsed.changed) == (running.scenario != before), payload.hex()
            assert not (parsed.refused and parsed.changed), payload.hex()
            table = reading.to_table(running.scenario)
            reading.check(table, checked=running.scenario, any_network=True)
        running.endpoint.events()  # empties the list of netem's events


class LogLines(Text):
    """Target for lines of a process, and answers at its control socket."""

    code = (log,)

    def __init__(self) -> None:
        own = {type(each.event): each.event for each in flown().events}
        events = *own.values(), Counted(figures={"missed": 3, "dropped": {"late": 2}})
        lines = [LogLine(process="client", time_ns=5, event=event) for event in events]
        answers = Answer(refused="no such key"), Answer(values={"network.uplink": "loss(0.1)"})
        super().__init__([msgspec.json.encode(each) for each in (*lines, *answers)])

    def __call__(self, payload: bytes) -> None:
        line = line_of(payload)
        assert line is None or str(line.event).splitlines(), payload.hex()
        with suppress(ControlError):
            answer_of(payload)
