"""Time of day of a host, and its error as known to the kernel."""

from unittest.mock import call, create_autospec

import pytest

from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.processes import TimeUnknown
from skytether.shell.host import time_of_day
from skytether.shell.host.time_of_day import HostTime, TimeTeller, stated


def test_a_host_s_clock_counts_where_its_kernel_tells_how_wrong_it_is() -> None:
    """chrony sets both errors; an undisciplined clock, or one with error 0, counts as unknown."""
    assert stated(0, 0x2001, 1500, 40) == 1_500_000
    for answer, status, most_us, estimate_us in (
        (5, 0x40, 16_000_000, 16_000_000),
        (0, 0x40, 1500, 40),
        (0, 0x2001, 500, 0),
        (-1, 0, 1500, 40),
    ):
        assert stated(answer, status, most_us, estimate_us) is None


def test_a_host_without_a_time_of_day_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    known, endpoint = HostTime(7, 1, 3), create_autospec(Endpoint)
    answers = iter([None, None, known, known, None])
    monkeypatch.setattr(time_of_day, "host_time", lambda: next(answers))
    teller = TimeTeller(endpoint)
    news = [teller.news() for _ in range(5)]
    assert endpoint.learn_time.mock_calls == 2 * [call(7, 1, now_ns=3)]
    assert news == [TimeUnknown(), None, None, None, TimeUnknown()]
