"""Set-points sent directly to an autopilot: the laws, the ground station, and flights."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench import autopilots, straight
from bench.laws import Heard, Law, setpoint
from bench.station import Station, station_columns
from bench.straight import joined, summary_of
from helpers import packaged
from skytether.autopilot.endpoint import TRUTH_COLUMNS, Autopilot
from skytether.autopilot.faults import parse as fault
from skytether.autopilot.flavours import FlavourName
from skytether.mavlink.codec import Codec
from skytether.mavlink.dialect import dialect
from skytether.netem.proxy import Proxy
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.aboard import AutopilotText
from skytether.shared.events.flight import Finished, Flying
from skytether.shared.scenario import reading
from skytether.shared.scenario.curves import figure_eight
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import PACKET_COLUMNS, Record, Recorder
from skytether.shared.telemetry.summary import Summary, summarise
from skytether.sim.world import World

OTHERS = (("velocity", 1.28), ("targets", 0.64))
"""Other laws, and the measured RMSE xy with each [m]."""
EIGHT = figure_eight(5.0, 30.0, 3, 5.0)
NONE = ""
LAWS = {
    "velocity": Law("velocity", gain=0.3),
    "targets": Law("targets"),
    "lead": Law("lead", 1.1, 0.5),
}


def scenario(**table: Any) -> Scenario:
    return packaged("autopilot", {"duration": 4.0, "settle": 0.0}, table)


def flown(law: str = "lead", flavour: FlavourName = "ardupilot", **table: Any) -> Record:
    return straight.fly(scenario(**table), LAWS[law], flavour)


# -- laws ----------------------------------------------------------------------------------------


def test_velocity_flies_to_where_the_vehicle_should_be_now() -> None:
    """Set-point u(t) = r'(t) + k (r(t) - y), regardless of the age of the measurement y."""
    chosen = setpoint(LAWS["velocity"], EIGHT, 4.0, Heard(3.0, np.array([1.0, 2.0, 3.0])))
    r, v = EIGHT(np.array(4.0)).T
    np.testing.assert_allclose(chosen.velocity, v + 0.3 * (r - [1.0, 2.0, 3.0]))
    assert chosen.position is None


def test_led_compares_what_was_measured_with_where_it_should_have_been_then() -> None:
    """Set-point u(t) = r'(t + T) + k (r(t_m) - y(t_m))."""
    law = Law("lead", 1.0, 0.4)
    chosen = setpoint(law, EIGHT, 4.0, Heard(3.0, np.array([1.0, 2.0, 3.0])))
    ahead, then = EIGHT(np.array(5.0))[:, 1], EIGHT(np.array(3.0))[:, 0]
    np.testing.assert_allclose(chosen.velocity, ahead + 0.4 * (then - [1.0, 2.0, 3.0]))
    assert chosen.position is None


def test_targets_leave_it_to_the_autopilot_to_regulate() -> None:
    """Set-points p(t) = r(t + T), u(t) = r'(t + T), regardless of the vehicle's position."""
    chosen = setpoint(Law("targets", 0.5), EIGHT, 4.0, Heard(3.9, np.zeros(3)))
    assert chosen.position is not None
    np.testing.assert_allclose([chosen.position, chosen.velocity], EIGHT(np.array(4.5)).T)


@settings(max_examples=20)
@given(st.floats(-10.0, 100.0), st.floats(0.0, 10.0), st.floats(0.0, 5.0))
def test_a_vehicle_that_was_where_it_should_be_is_told_the_desired_velocity(
    time_s: float, lead_s: float, age_s: float
) -> None:
    heard = Heard(time_s - age_s, EIGHT(np.array(time_s - age_s))[:, 0])
    chosen = setpoint(Law("lead", lead_s, 0.5), EIGHT, time_s, heard)
    np.testing.assert_allclose(chosen.velocity, EIGHT(np.array(time_s + lead_s))[:, 1])


# -- flights -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("law", "measured_m"), [("lead", 0.055), *OTHERS])
def test_it_flies_as_an_arducopter_was_measured_to(law: str, measured_m: float) -> None:
    """RMSE xy of a whole figure eight over the paper's network, within a tenth."""
    whole = flown(law, duration=40.0, settle=10.0)
    summary = summary_of(scenario(duration=40.0, settle=10.0), whole)
    assert summary.rmse_xy == pytest.approx(measured_m, rel=0.1)
    _is_counted_as_flown(summary)
    assert summary.deadline_misses == 0


def _is_counted_as_flown(summary: Summary) -> None:
    """A set-point per step and 20 positions per second, and little else."""
    assert summary.uplink_packets is not None
    assert summary.downlink_packets is not None
    assert summary.steps <= summary.uplink_packets < 1.1 * summary.steps
    assert summary.steps <= summary.downlink_packets < 1.2 * summary.steps
    assert (summary.covered, summary.event_ratio) == (1.0, None)


@pytest.mark.long
def test_px4_is_flown_as_well_and_the_same_seed_flies_the_same() -> None:
    one, other = flown("targets", "px4"), flown("targets", "px4")
    assert one.trace_hash() == other.trace_hash()
    assert [type(each.event) for each in one.events].count(Finished) == 1
    said = [each.event.text for each in one.events if isinstance(each.event, AutopilotText)]
    assert any(text.startswith("Disarmed") for text in said)
    np.testing.assert_allclose(one.client["state"][0, :, 0], [0.0, 0.0, 5.0], atol=0.6)


def test_half_of_all_packets_may_be_lost() -> None:
    half = "constant(0.2) & loss(0.5)"
    record = flown(network={"uplink": half, "downlink": half})
    assert record.failure is None
    assert len(record.client) == 80


def test_an_age_is_known_although_clocks_differ() -> None:
    """TIMESYNC gives a position that was 0.2 s under way an age of 0.2 s to 0.2 s plus a step."""
    late = "constant(0.2)"
    drifts = {"clock_drift_ppm": 500.0, "clock_offset_s": 1000.0}
    record = flown(network={"uplink": late, "downlink": late}, simulation=drifts)
    ages_s = record.client["age_ns"] / 1e9
    assert 0.19 < ages_s.min() <= ages_s.max() < 0.27


@pytest.mark.long
def test_after_a_cut_px4_is_back_by_itself() -> None:
    scene = scenario(duration=8.0)
    began_s = autopilots.began_ns(flown(duration=8.0, flavour="px4")) / 1e9
    both = ("network.uplink.loss", "network.downlink.loss")
    changes = [(began_s + 1.0, dict.fromkeys(both, 1.0)), (began_s + 4.0, dict.fromkeys(both, 0.1))]
    record = straight.fly(scene, LAWS["lead"], "px4", changes)
    summary = summary_of(scene, record)
    assert summary.mode == "track"
    said = [str(event.event) for event in record.events if event.host == "autopilot"]
    assert "Failsafe activated: no offboard signal" in said


@pytest.mark.parametrize("way", ["uplink", "downlink"])
def test_an_autopilot_that_is_not_reached_is_not_flown(way: str) -> None:
    record = flown(network={way: {"loss": 1.0}}, mavlink={"patience_s": 2.0})
    said = {
        "uplink": "vehicle 1: no time told in 2 s: TIMESYNC is not answered",
        "downlink": "vehicle 1: not heard in 2 s: no heartbeat of an autopilot has come",
    }
    assert str(record.failure) == said[way]
    assert not len(record.client)


# -- the station alone ---------------------------------------------------------------------------


class Sky:
    def __init__(self, faults: Sequence[str] = ()) -> None:
        scene = scenario(duration=6.0, network={"uplink": NONE, "downlink": NONE})
        self.events: list[tuple[int, object]] = []
        self.station = Station(scene, LAWS["lead"])
        self.autopilot = Autopilot(
            scene,
            "ardupilot",
            peers=[("netem", 0)],
            ready_s=0.5,
            faults=[fault(each) for each in faults],
        )
        self.world = World(lambda time_ns, _, event: self.events.append((time_ns, event)))
        self.world.add("netem", Proxy(scene, server=("station", 0), flows=1))
        self.world.add("autopilot", self.autopilot)
        self.world.add("station", self.station)

    def run(self) -> None:
        self.world.run(lambda: self.station.finished, limit_ns=60 * 10**9)
        assert self.station.finished


def test_a_pilot_that_takes_over_keeps_the_vehicle() -> None:
    sky = Sky(["pilot@12"])
    sky.run()
    began_ns = next(time_ns for time_ns, event in sky.events if isinstance(event, Flying))
    flown_s = 12.0 - (began_ns - (sky.autopilot.flight.armed_ns or 0)) / 1e9
    assert 20 * flown_s <= sky.station.setpoints <= 20 * (flown_s + 1.1)
    assert sky.autopilot.flight.mode_name == "LOITER"
    assert sky.autopilot.flight.flying


@settings(max_examples=20)
@given(st.lists(st.binary(max_size=60), max_size=5), st.integers(0, 300))
def test_bytes_of_anybody_change_nothing(garbage: list[bytes], system: int) -> None:
    station = Station(scenario(), LAWS["lead"])
    other = Codec(system % 256, 190).encode(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    for now_ns, payload in enumerate([*garbage, other]):
        station.receive(Datagram(payload, ("anybody", 1)), now_ns=now_ns)
        station.wake(now_ns=now_ns)
    assert station.outbox() == []
    assert station.failure is None


def test_what_is_no_quadrotor_is_not_flown() -> None:
    station = Station(scenario(), LAWS["lead"])
    plane = dialect.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)
    station.receive(Datagram(Codec(1, 1).encode(plane), ("plane", 1)), now_ns=0)
    assert "MAV_TYPE 1" in str(station.failure)
    assert station.finished


def test_a_flight_that_begins_on_the_ground_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"takeoff_m: got 'auto' at altitude 0 m"):
        Station(scenario(reference={"altitude_m": 0.0}), LAWS["lead"])


# -- the record ----------------------------------------------------------------------------------


def test_the_true_state_is_taken_at_the_time_of_each_step() -> None:
    """Interpolated between two ticks of the autopilot; undefined where it reported nothing."""
    scene = scenario()
    station = np.zeros(3, station_columns(3))
    station["time_ns"], station["step"] = [0, 50_000_000, 100_000_000], [0, 1, 2]
    truth = np.zeros(2, TRUTH_COLUMNS)
    truth["time_ns"] = [40_000_000, 100_000_000]
    truth["state"][1] = [[6.0, 0.6], [12.0, 1.2], [18.0, 1.8]]
    netem = np.zeros(3, PACKET_COLUMNS)
    netem["arrived_ns"] = [-1, 149_999_999, 150_000_000]
    record = joined(scene, station, truth, netem)
    assert np.isnan(record.client["state"][0]).all()
    np.testing.assert_allclose(record.client["state"][1], truth["state"][1] / 6.0)
    np.testing.assert_allclose(record.client["state"][2], truth["state"][1])
    assert record.netem["arrived_ns"].tolist() == [149_999_999]
    assert msgspec.structs.asdict(summary_of(scene, record))["estimate_error_m"] is None


def test_the_autopilot_records_where_it_truly_is_at_every_tick() -> None:
    """Times in the record are on the driver's clock."""

    class Sink(bytearray):
        def write(self, piece: bytes) -> None:
            self.extend(piece)

    sink = Sink()
    autopilot = Autopilot(
        scenario(), "ardupilot", ready_s=0.5, recorder=Recorder(TRUTH_COLUMNS, sink)
    )
    for now_ns in (7_000_000, 27_000_000):
        autopilot.wake(now_ns=now_ns)
    rows = np.frombuffer(bytes(sink).partition(b"\n")[2], TRUTH_COLUMNS)
    assert rows["time_ns"].tolist() == [12_000_000, 17_000_000, 22_000_000, 27_000_000]
    np.testing.assert_array_equal(rows["state"], 0.0)


# -- the benchmark --------------------------------------------------------------------------------


def flight(contender: str, air: autopilots.Air, seed: int, **whole: float) -> autopilots.FlownCell:
    """Figures of flights of PX4, all zero except for the given ones."""
    nothing = [np.zeros(80, columns) for columns in (station_columns(3), TRUTH_COLUMNS)]
    record = joined(scenario(), *nothing, np.zeros(0, PACKET_COLUMNS))
    summary = summary_of(scenario(), record)
    summary = msgspec.structs.replace(summary, error_max=1.0, duration_s=4.0)
    return autopilots.FlownCell(
        contender=contender,
        flavour="px4",
        air=air,
        seed=seed,
        whole=msgspec.structs.replace(summary, **whole),
        cut=msgspec.structs.replace(summary, mode="manual" if seed else "track"),
        largest_m=float(seed),
    )


def test_the_benchmark_makes_a_table_of_what_was_flown() -> None:
    flights = [
        flight("velocity", "wind", 0, rmse_xy=0.1, uplink_packets=80),
        flight("velocity", "wind", 1, rmse_xy=0.2, uplink_packets=120),
    ]
    ((name, table),) = autopilots.tables(flights).items()
    assert name == "px4"
    assert table.rows == [
        ["velocity", "0.150 (0.100 to 0.200)", "1.00, 1 of 2 fly on", "25.0, 0.0"]
    ]


@pytest.mark.long
def test_the_scenario_px4_flies_its_flavour() -> None:
    table = reading.to_table(reading.load("px4")) | {"duration": 20.0, "settle": 8.0}
    table["vehicle"] |= {"address": "udpout:autopilot:0"}
    scene = reading.check(table, "px4")
    record = autopilots.fly(scene, None, "px4")
    summary = summarise(scene, "px4", record.client, record.server, record.netem)
    assert summary.rmse_xy is not None
    assert summary.rmse_xy < 0.45
