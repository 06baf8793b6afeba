"""Cumulative time and energy of a live run, against sums by hand."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from cumulative import (
    NETWORK,
    OURS,
    REST,
    CounterLog,
    EnergyReadings,
    cumulative_costs,
    draw_cumulative,
    read_power,
)
from onboard import onboard_table

# Three images, 1 s apart: .2 s of network, then .1, .2 and .3 s of UfM*.
RUN = SimpleNamespace(started=[10.0, 11.0, 12.0], predicted=[10.2, 11.2, 12.2], finished=[10.3, 11.4, 12.5])


def test_times_add_up_to_the_time_of_the_run():
    costs = cumulative_costs(RUN, "no meter")
    assert costs["times"] == pytest.approx([0, 1.1, 2.2])
    assert costs["seconds"][NETWORK] == pytest.approx([0, 0.2, 0.4])
    assert costs["seconds"][OURS] == pytest.approx([0, 0.2, 0.5])
    assert costs["seconds"][REST] == pytest.approx([0, 0.7, 1.3])
    assert costs["not_measurable"] == "no meter"
    assert len(draw_cumulative(costs).axes) == 1


def test_energy_is_divided_by_time_between_two_readings():
    """10 W until 11.2 s, where UfM* begins, and 100 W until the end of its step."""
    readings = EnergyReadings(np.array([9.0, 10.3, 11.2, 11.4, 20.0]), np.array([0.0, 13.0, 22.0, 42.0, 50.0]))
    costs = cumulative_costs(RUN, readings)
    assert costs["energy_times"] == pytest.approx([0, 0.9, 1.1])
    assert costs["joules"][OURS] == pytest.approx([0, 0, 20])
    assert costs["joules"][NETWORK] == pytest.approx([0, 2, 2])
    assert costs["joules"][REST] == pytest.approx([0, 7, 7])
    figure = draw_cumulative(costs)
    assert [axes.get_ylabel() for axes in figure.axes] == ["cumulative time [s]", "cumulative energy [J]"]


def test_a_log_of_a_meter_is_integrated(tmp_path):
    log = tmp_path / "power.csv"
    log.write_text("power,time\n2.0,1000.0\n4.0,1001.0\n4.0,1003.0\n")
    readings = read_power(log, 900.0)
    assert readings.times.tolist() == [100, 101, 103]
    assert readings.joules.tolist() == [0, 3, 11]
    late = cumulative_costs(RUN, readings)
    assert "seconds since 1970" in late["not_measurable"]
    assert "joules" not in late


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("time\n1\n2\n", "no power"),
        ("time,power\n1,2\nx,3\n", "must hold numbers"),
        ("time,power\n2,2\n1,3\n", "rising times"),
        ("time,power\n2,2\n", "at least two lines"),
        ("time,power\n1,2\n2,nan\n", "finite numbers"),
    ],
)
def test_refused_logs(tmp_path, text, reason):
    log = tmp_path / "power.csv"
    log.write_text(text)
    with pytest.raises(ValueError, match=reason):
        read_power(log, 0.0)


def test_counters_are_read_as_long_as_the_run_lasts():
    def measure(work):
        work()
        return 0.0, {"cpu": 2.0, "gpu": 3.0}

    with CounterLog(SimpleNamespace(measure=measure)) as log:
        time.sleep(0.01)
    readings = log.readings
    assert readings.joules.tolist() == [5.0 * n for n in range(len(readings.times))]
    assert len(readings.times) >= 2
    assert (np.diff(readings.times) > 0).all()


def test_the_table_states_the_costs():
    readings = EnergyReadings(np.array([10.3, 12.5]), np.array([0.0, 22.0]))
    times = dict.fromkeys(("latency_ms", "network_ms", "ours_ms", "processor_ms"))
    numbers = {"images": 3, "results": 3, "seconds": 2.2, "dropped": {}, "skipped": {}, "restarts": 0}
    unknown = dict.fromkeys(("lost_share", "per_second", "ours_share", "memory_bytes", "memory_growth_bytes"))
    summary = {"realtime": times | numbers | unknown, "network": {}, "load_average": 0.0, "out": "OUT"}
    text = onboard_table(summary | {"costs": cumulative_costs(RUN, readings)})
    assert "energy: camera and network 4" in text
    assert text.endswith("OUT: summary.json, onboard_costs.png")
    assert "not measurable here: no meter" in onboard_table(summary | {"costs": cumulative_costs(RUN, "no meter")})
