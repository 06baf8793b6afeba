"""Energy: arithmetic on counters with known joules, what zeus finds, and the reasons where it finds nothing."""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ufmstar_torch.eval.bench import sensors
from ufmstar_torch.eval.bench.energy import (
    CPU,
    DRAM,
    GPU,
    OTHER,
    PartEnergy,
    PowerMeter,
    Rail,
    SensorError,
    Source,
    consumed,
    repeated,
    run_windows,
)

zeus = pytest.importorskip("zeus", reason="needs the extra energy")


class Machine:
    """A clock and one counter per rail: ``watts`` while time passes, joules of work on top."""

    def __init__(self, watts=5.0, wraps_at=None, name="cpu package 0", part=CPU, period=0.01, start=0.0):
        self.now, self.joules, self.watts = 100.0, start, watts
        self.rail = Rail(name, part, wraps_at)
        self.source = Source((self.rail,), self.read, period)
        self.broken = None

    def read(self):
        if self.broken:
            raise SensorError(self.broken)
        value = self.joules if self.rail.wraps_at is None else self.joules % self.rail.wraps_at
        return {self.rail.name: value}

    def clock(self):
        return self.now

    def run(self, seconds, extra=0.0):
        self.now += seconds
        self.joules += self.watts * seconds + extra

    def meter(self, **missing):
        return PowerMeter([self.source], missing, clock=self.clock)


# ---- windows ----


def test_a_window_is_the_difference_of_two_readings():
    machine = Machine(watts=7.0, start=123.0)
    window = machine.meter().measure(lambda: machine.run(2.5, extra=1.5))
    assert window.seconds == pytest.approx(2.5)
    assert window.joules == {"cpu package 0": pytest.approx(7.0 * 2.5 + 1.5)}
    assert window.unusable == {}


@given(wraps_at=st.floats(1e3, 1e6), start=st.floats(0, 0.999), share=st.floats(1e-6, 0.999), watts=st.floats(1, 900))
def test_a_counter_that_wraps_once_loses_nothing(wraps_at, start, share, watts):
    used = share * wraps_at * watts / 1000  # what fits into the longest window that is allowed
    before = start * wraps_at
    result = consumed(Rail("cpu", CPU, wraps_at), before, (before + used) % wraps_at, used / watts)
    assert result == pytest.approx(used, rel=1e-6, abs=1e-9 * wraps_at)


@pytest.mark.parametrize(
    ("rail", "start", "end", "seconds", "words"),
    [
        (Rail("cpu", CPU, 65536.0), 0.0, 5.0, 66.0, "too long"),
        (Rail("gpu", GPU), 10.0, 9.0, 1.0, "went back"),
        (Rail("gpu", GPU), 10.0, 10.0, 0.01, "did not move"),
        (Rail("cpu", CPU, 65536.0), 7.0, 7.0, 1.0, "did not move"),
    ],
)
def test_what_two_readings_cannot_tell_is_no_number(rail, start, end, seconds, words):
    with pytest.raises(SensorError, match=words):
        consumed(rail, start, end, seconds)


def test_a_sensor_that_fails_later_leaves_the_others():
    cpu, gpu = Machine(watts=3.0), Machine(watts=9.0, name="gpu 0", part=GPU)
    meter = PowerMeter([cpu.source, gpu.source], clock=cpu.clock)

    def work():
        cpu.run(1.0)
        gpu.run(1.0)
        gpu.broken = "the driver is gone"

    window = meter.measure(work)
    assert window.joules == {"cpu package 0": pytest.approx(3.0)}
    assert window.unusable == {"gpu 0": "the driver is gone"}


def test_idle_power_is_measured_for_at_least_the_shortest_window():
    machine, slept = Machine(watts=4.5, period=0.1), []

    def sleep(seconds):
        slept.append(seconds)
        machine.run(seconds)

    meter = machine.meter()
    assert meter.shortest == pytest.approx(2.0)
    assert meter.idle(0.5, sleep) == {"cpu package 0": pytest.approx(4.5)}
    assert meter.idle(3.0, sleep) == {"cpu package 0": pytest.approx(4.5)}
    assert slept == [pytest.approx(2.0), 3.0]


def test_a_meter_without_sensors_measures_nothing_and_does_not_wait():
    meter = PowerMeter([], {GPU: "no GPU", CPU: "no permission"})
    assert meter.idle(1.0, lambda _: pytest.fail("slept")) == {}
    assert meter.measure(lambda: None).joules == {}
    assert meter.missing == {GPU: "no GPU", CPU: "no permission", DRAM: "no sensor"}


def test_rails_have_names_of_their_own():
    with pytest.raises(ValueError, match="names of their own"):
        PowerMeter([Machine().source, Machine().source])


# ---- energy per frame ----


def frames_of(machine, count, seconds, extra, log=None, name=""):
    """Work that takes ``seconds`` and ``extra`` joules a frame on a pretended machine."""

    def repeat(_):
        if log is not None:
            log.append(name)
        for _ in range(count):
            machine.run(seconds, extra)
        return count

    return repeat


def test_gross_and_net_energy_per_frame():
    machine, log = Machine(watts=5.0), []
    work = {
        ("net", "depth"): (CPU, frames_of(machine, 10, 0.02, 0.3, log, "depth")),
        ("net", "once"): (CPU, frames_of(machine, 8, 0.03, 0.5, log, "once")),
    }
    energy = run_windows(machine.meter(), work, {"cpu package 0": 5.0}, seconds=0.1, windows=3)
    depth, once = energy["net", "depth"], energy["net", "once"]
    np.testing.assert_allclose(depth.windows, [[0.4, 0.3, 0.02]] * 3)
    added = once.minus(depth)
    np.testing.assert_allclose(added.windows, [[0.25, 0.2, 0.01]] * 3)
    message = added.to_dict()
    assert message["gross"]["millijoules"] == pytest.approx(250.0)
    assert message["gross"]["watts"] == pytest.approx(25.0)
    assert message["net"]["watts"] == pytest.approx(20.0)
    # Windows take turns, in alternating order.
    assert log == ["depth", "once", "once", "depth", "depth", "once"]


def test_rails_of_one_unit_are_added_and_those_of_others_left_out():
    a, b, dram = Machine(3.0), Machine(4.0, name="cpu package 1"), Machine(99.0, name="dram of package 0", part=DRAM)
    meter = PowerMeter([a.source, b.source, dram.source], clock=a.clock)

    def repeat(_):
        for machine in (a, b, dram):
            machine.run(2.0)
        return 4

    idle = {"cpu package 0": 1.0, "cpu package 1": 1.0, "dram of package 0": 50.0}
    energy = run_windows(meter, {("x", "once"): (CPU, repeat)}, idle, seconds=1.0, windows=1)["x", "once"]
    np.testing.assert_allclose(energy.windows, [[7.0 * 2 / 4, 5.0 * 2 / 4, 2 / 4]])


def test_a_part_whose_unit_has_no_rail_is_not_run_for_energy():
    machine = Machine()
    work = {("x", "once"): (GPU, lambda _: pytest.fail("ran"))}
    energy = run_windows(machine.meter(gpu="no NVML"), work, {}, seconds=1.0, windows=2)["x", "once"]
    assert energy.to_dict() == {"not_measurable": "no NVML"}
    measured = PartEnergy(np.array([[1.0, 0.5, 2.0]]))
    assert measured.minus(energy).to_dict() == energy.minus(measured).to_dict() == {"not_measurable": "no NVML"}


@pytest.mark.parametrize("cause", ["counter", "idle"])
def test_one_unusable_window_makes_the_part_not_measurable(cause):
    machine = Machine(watts=0.0 if cause == "counter" else 5.0)
    idle = {"cpu package 0": 1.0} if cause == "counter" else {}
    work = {("x", "once"): (CPU, frames_of(machine, 3, 0.1, 0.0))}
    message = run_windows(machine.meter(), work, idle, seconds=0.1, windows=2)["x", "once"].to_dict()
    assert list(message) == ["not_measurable"]
    assert ("did not move" if cause == "counter" else "idle power") in message["not_measurable"]


def test_a_difference_of_less_time_than_nothing_has_no_power():
    slow, fast = PartEnergy(np.array([[1.0, 1.0, 0.2]])), PartEnergy(np.array([[2.0, 2.0, 0.1]]))
    assert fast.minus(slow).to_dict()["gross"]["watts"] is None


def test_work_is_repeated_in_order_until_the_time_is_up():
    machine, log = Machine(), []
    calls = [lambda n=n: (log.append(n), machine.run(0.4)) for n in range(3)]
    assert repeated(calls, lambda: log.append("wait"), machine.clock)(1.5) == 4
    assert log == [0, "wait", 1, "wait", 2, "wait", 0, "wait"]
    with pytest.raises(ValueError, match="at least one"):
        repeated([], lambda: None)


# ---- sensors ----


@pytest.fixture
def bare(monkeypatch):
    """A machine on which zeus finds nothing."""
    from zeus.device.cpu.common import ZeusCPUInitError
    from zeus.device.gpu.common import ZeusGPUInitError
    from zeus.device.soc.common import ZeusSoCInitError

    monkeypatch.setattr("zeus.device.get_gpus", Mock(side_effect=ZeusGPUInitError("NVML unavailable.")))
    monkeypatch.setattr("zeus.device.get_cpus", Mock(side_effect=ZeusCPUInitError("RAPL unavailable.")))
    monkeypatch.setattr("zeus.device.get_soc", Mock(side_effect=ZeusSoCInitError("no SoC.")))
    return monkeypatch


def test_no_sensor_has_a_reason_for_everything(bare):
    from zeus.device.cpu.common import ZeusCPUNoPermissionError

    meter = PowerMeter.open(gpu=0)
    assert meter.rails == ()
    assert set(meter.missing) == {GPU, CPU, DRAM}
    assert "NVML unavailable" in meter.missing[GPU]
    assert "RAPL unavailable" in meter.missing[CPU]
    assert PowerMeter.open().missing[GPU] == "nothing runs on a GPU"
    json.dumps(meter.missing)
    refused = ZeusCPUNoPermissionError("Can't read file due to permission error; RAPL requires root privileges.")
    bare.setattr("zeus.device.get_cpus", Mock(side_effect=refused))
    assert "requires root" in PowerMeter.open().missing[CPU]


def test_without_zeus_the_reason_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(sensors, "find_spec", lambda _: None)
    meter = PowerMeter.open(gpu=0)
    assert meter.rails == ()
    assert all("pip install" in reason for reason in meter.missing.values())
    assert PowerMeter.open().missing[GPU] == "nothing runs on a GPU"


@pytest.fixture
def powercap(bare, tmp_path):
    """A folder as Linux's powercap has it, one package with and one without a counter of its memory."""
    import zeus.device.cpu
    from zeus.device.cpu import rapl

    def zone(path, name, energy, limit):
        path.mkdir(parents=True)
        for file, value in (("name", name), ("energy_uj", energy), ("max_energy_range_uj", limit)):
            (path / file).write_text(f"{value}\n")

    root = tmp_path / "intel-rapl"
    zone(root / "intel-rapl:0", "package-0", 262143000000, 262143328850)
    zone(root / "intel-rapl:0" / "intel-rapl:0:0", "core", 1, 262143328850)
    zone(root / "intel-rapl:0" / "intel-rapl:0:1", "dram", 1000, 65712999613)
    zone(root / "intel-rapl:1", "package-1", 5_000_000, 262143328850)
    bare.setattr(rapl, "RAPL_DIR", str(root))
    bare.setattr(zeus.device.cpu, "_cpus", None)
    bare.setattr("zeus.device.get_cpus", zeus.device.cpu.get_cpus)
    rapl.rapl_is_available.cache_clear()
    yield root
    rapl.rapl_is_available.cache_clear()


def test_packages_and_their_memory_are_read_from_the_counters(powercap):
    meter = PowerMeter.open()
    names = {rail.name: rail for rail in meter.rails}
    assert sorted(names) == ["cpu package 0", "cpu package 1", "dram of package 0"]
    assert [names[n].part for n in sorted(names)] == [CPU, CPU, DRAM]
    assert names["cpu package 0"].wraps_at == pytest.approx(262143.32885)
    assert set(meter.missing) == {GPU}

    def work():  # package 0 wraps: 0.32885 J up to the end of its range, and 12 J from there
        (powercap / "intel-rapl:0" / "energy_uj").write_text("12000000\n")
        (powercap / "intel-rapl:0" / "intel-rapl:0:1" / "energy_uj").write_text("2501000\n")
        (powercap / "intel-rapl:1" / "energy_uj").write_text("8000000\n")

    window = meter.measure(work)
    expected = {"cpu package 0": 12.32885, "dram of package 0": 2.5, "cpu package 1": 3.0}
    assert window.joules == pytest.approx(expected)
    assert multiprocessing.active_children() == [], "none looks out for wrapping"


def test_a_counter_that_may_no_longer_be_read_is_named(powercap):
    meter = PowerMeter.open()
    window = meter.measure(lambda: (powercap / "intel-rapl:0" / "energy_uj").unlink())
    assert set(window.joules) == set()
    assert all("energy_uj" in reason for reason in window.unusable.values())


class Gpus:
    """Two GPUs of zeus's interface [mJ]."""

    def __init__(self, supported=True):
        self.energy, self.supported = [10_000, 50_000], supported

    def __len__(self):
        return 2

    def supports_get_total_energy_consumption(self, index):
        return self.supported

    def get_total_energy_consumption(self, index):
        return self.energy[index]


def test_a_gpu_is_read_by_its_index(bare):
    gpus = Gpus()
    bare.setattr("zeus.device.get_gpus", lambda: gpus)
    meter = PowerMeter.open(gpu=1)
    assert [(rail.name, rail.part, rail.wraps_at) for rail in meter.rails] == [("gpu 1", GPU, None)]

    def work():
        gpus.energy = [99_000, 52_500]

    assert meter.measure(work).joules == {"gpu 1": pytest.approx(2.5)}


@pytest.mark.parametrize(("gpus", "index", "words"), [(Gpus(), 2, "not one of index 2"), (Gpus(False), 0, "Volta")])
def test_a_gpu_without_a_counter_has_a_reason(bare, gpus, index, words):
    bare.setattr("zeus.device.get_gpus", lambda: gpus)
    meter = PowerMeter.open(gpu=index)
    assert meter.rails == ()
    assert words in meter.missing[GPU]


def test_a_jetsons_rails_serve_both_units(bare):
    from zeus.device.soc.jetson import JetsonMeasurement

    class Jetson:
        now = JetsonMeasurement(cpu_energy_mj=1000.0, gpu_energy_mj=4000.0, total_energy_mj=9000.0)

        def get_total_energy_consumption(self):
            return self.now

    chip = Jetson()
    bare.setattr("zeus.device.get_soc", lambda: chip)
    meter = PowerMeter.open(gpu=0)
    assert {rail.name: rail.part for rail in meter.rails} == {"soc cpu": CPU, "soc gpu": GPU, "soc total": OTHER}
    assert set(meter.missing) == {DRAM}
    assert meter.shortest >= 2  # zeus asks the chip's monitor ten times a second

    def work():
        chip.now = JetsonMeasurement(cpu_energy_mj=1500.0, gpu_energy_mj=6000.0, total_energy_mj=12000.0)

    assert meter.measure(work).joules == pytest.approx({"soc cpu": 0.5, "soc gpu": 2.0, "soc total": 3.0})
    idle_gpu = PowerMeter.open()
    assert idle_gpu.names(GPU) == ()
    assert idle_gpu.missing[GPU] == "nothing runs on a GPU"


@pytest.mark.slow
def test_importing_reads_no_sensor():
    code = (
        "import sys, threading, ufmstar_torch.eval.bench.energy, ufmstar_torch.eval.bench.sensors;"
        "print('zeus' in sys.modules, 'torch' in sys.modules, threading.active_count())"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False", "1"]
