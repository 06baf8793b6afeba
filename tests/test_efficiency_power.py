"""Energy: windows of a monitor with known joules, and the reasons if zeus has no meter."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest

from ufmstar_torch.eval.bench import energy
from ufmstar_torch.eval.bench.energy import CPU, GPU, NO_GPU, NO_ZEUS, EnergyMeter, difference, measure_energy, summary


class Monitor:
    """Stand-in for zeus's monitor, with known time and energy per work."""

    def __init__(self, **units):
        self.units = units  # by zeus's field name: the value that a window reports, a function of joules
        self.now = self.joules = 0.0

    def run(self, seconds, joules):
        self.now += seconds
        self.joules += joules

    def begin_window(self, name, restart):
        self.began = self.now, self.joules

    def end_window(self, name):
        seconds, joules = self.now - self.began[0], self.joules - self.began[1]
        empty = {"gpu_energy": {}, "cpu_energy": None, "soc_energy": None}
        return SimpleNamespace(time=seconds, **(empty | {key: of(joules) for key, of in self.units.items()}))


@pytest.fixture
def monitor(monkeypatch):
    """Two CPU packages with a quarter and three quarters of the energy, and a GPU with twice the energy."""
    one = Monitor(cpu_energy=lambda j: {0: j / 4, 1: 3 * j / 4}, gpu_energy=lambda j: {0: 2 * j})
    monkeypatch.setattr(time, "perf_counter", lambda: one.now)
    monkeypatch.setattr(time, "sleep", lambda seconds: one.run(seconds, 1.0))
    return one


def test_energy_per_frame(monitor):
    log = []
    calls = {
        "depth": [lambda: (log.append("depth"), monitor.run(0.02, 0.3))],
        "once": [lambda: (log.append("once"), monitor.run(0.03, 0.5))],
    }
    work = {"depth": (CPU, calls["depth"]), "once": (CPU, calls["once"]), "gpu": (GPU, calls["depth"])}
    measured = measure_energy(EnergyMeter(0, monitor), work, seconds=0.03, windows=2)
    np.testing.assert_allclose(measured["depth"], [[0.3, 0.02]] * 2)
    np.testing.assert_allclose(measured["gpu"], [[0.6, 0.02]] * 2)
    added = difference(measured["once"], measured["depth"])
    expected = {"millijoules": 200.0, "q1": 200.0, "q3": 200.0, "seconds": 0.01}
    assert summary(added) == {"gross": pytest.approx(expected), "windows": 2}
    # A window needs two calls, or one of the slower part; the second round runs in reverse order.
    assert log == ["depth"] * 2 + ["once"] + ["depth"] * 4 + ["once"] + ["depth"] * 2


@pytest.mark.parametrize(
    ("chip", "unit"), [({"cpu_energy_mj": 500.0}, CPU), ({"cpu_total_mj": 500.0}, CPU), ({"gpu_mj": 500.0}, GPU)]
)
def test_a_system_on_a_chip(monitor, chip, unit):
    monitor.units = {"soc_energy": lambda j: SimpleNamespace(**chip)}
    meter = EnergyMeter(0, monitor)
    assert meter.measure(lambda: monitor.run(2.0, 1.0)) == (2.0, {unit: 0.5})
    assert unit not in meter.missing


def test_reasons_in_place_of_numbers(monitor, monkeypatch):
    monitor.units = {"cpu_energy": lambda j: {0: 0.0 * j}}
    meter = EnergyMeter(0, monitor)
    assert "no meter of the GPU" in meter.missing[GPU]
    work = {"still": (CPU, [lambda: monitor.run(1.0, 1.0)]), "none": (GPU, [lambda: pytest.fail("ran")])}
    measured = measure_energy(meter, work, seconds=0.5, windows=2)
    assert measured["still"] == "the meter of the cpu did not move in 1 s"
    assert summary(measured["none"]) == {"not_measurable": meter.missing[GPU]}
    assert difference(np.ones((1, 2)), measured["none"]) == difference(measured["none"], np.ones((1, 2)))
    assert EnergyMeter(None, monitor).missing[GPU] == NO_GPU
    monkeypatch.setattr(energy, "find_spec", lambda name: None)
    assert EnergyMeter(0).missing == {GPU: NO_ZEUS, CPU: NO_ZEUS}
    assert "pip install" in NO_ZEUS


def test_zeus_measures_here_or_says_why_not():
    pytest.importorskip("zeus", reason="needs the extra energy")
    meter = EnergyMeter()
    assert meter.missing[GPU] == NO_GPU
    seconds, joules = meter.measure(lambda: time.sleep(0.01))
    assert seconds >= 0.01
    assert set(joules) | set(meter.missing) == {CPU, GPU}
