"""What uncertainty costs: times and energies of networks whose cost is known, rows that do not disturb each other."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
import torch
from efficiency_cases import SIZE, network, room_sequence, rows_of
from tiny_networks import Linear

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.bench.energy import CPU, GPU, NOT_MEASURABLE, PowerMeter, Rail, Source
from ufmstar_torch.eval.bench.measure import Plan, measure
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork
from ufmstar_torch.eval.bench.race import MULTIVIEW, PROCESSOR, run_race
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.report.efficiency import efficiency_tables
from ufmstar_torch.eval.report.table import latex, markdown
from ufmstar_torch.models.any_network import wrap_network
from ufmstar_torch.models.preprocess import Preprocess

NO_SENSOR = PowerMeter([], {CPU: "no permission to read RAPL", GPU: "no NVML"})
QUICK = Plan(frames=4, warm_up=2, threads=1, seconds=0.02, windows=2, idle=0.02)


@pytest.fixture(scope="module")
def sequence():
    return room_sequence()


# ---- the race ----


def four(base="ensemble"):
    return TimedNetwork(base, [network(offset=0.2 + 0.1 * n) for n in range(4)], "Linear")


RACE_ROWS = ("UfM-Ensemble", "UfM*-Ensemble", "UfM*-FullEnsemble", "UfM*-Aleatoric", "UfM-Aleatoric-100K")


def race_of(names, sequence, **options):
    options = {"warm_up": 2, "device": torch.device("cpu"), "multiview_device": torch.device("cpu"), **options}
    networks = {"ensemble": four(), "aleatoric": TimedNetwork("aleatoric", [network()], "Linear")}
    return run_race(rows_of(*names), networks, list(sequence), **options)


@pytest.fixture(scope="module")
def race(sequence):
    return race_of(RACE_ROWS, sequence)


@pytest.mark.parametrize("name", RACE_ROWS)
def test_no_row_has_the_state_of_another(race, sequence, name):
    alone = race_of([name], sequence)
    mine, theirs = alone.steps[name], race.steps[name]
    assert mine.kept == theirs.kept
    states = [one.module.state_dict() for one in (mine, theirs)]
    assert mine.kept[-1]["count"] > 0
    for key, value in states[0].items():
        assert torch.equal(value, states[1][key]), key


def test_a_row_is_what_the_module_makes_of_the_networks_turns(race, sequence):
    members, ufm = [network(offset=0.2 + 0.1 * n) for n in range(4)], UfMStar()
    with torch.no_grad():
        for n, frame in enumerate(sequence):
            image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
            x, K = members[0].preprocess(image, torch.from_numpy(frame.intrinsics)[None])
            p = members[n % 4](x)
            ufm(p.depth, torch.from_numpy(frame.T_world_cam)[None], K, p.aleatoric_variance)
    assert torch.equal(race.steps["UfM*-Ensemble"].module.mean, ufm.mean)
    used = int(ufm.mixture.components) * ufm.mixture.bytes_per_component()
    assert race.steps["UfM*-Ensemble"].kept[-1]["bytes"] == used


def test_the_stages_are_those_of_the_same_step_and_add_up(race):
    staged, whole = race.staged["UfM*-Ensemble"], race.steps["UfM*-Ensemble"].module
    assert torch.equal(staged.module.mixture.mean, whole.mean)
    stages = {name: times[race.warm_up :] for name, times in staged.stages.items()}
    assert {len(times) for times in stages.values()} == {6}
    sums = np.sum(list(stages.values()), axis=0)
    assert staged.summary(warm_up=race.warm_up)["stages_total"]["median_ms"] == pytest.approx(np.median(sums))
    assert all(min(times) >= 0 for times in stages.values())
    assert set(race.staged) == {"UfM*-Ensemble", "UfM*-FullEnsemble", "UfM*-Aleatoric"}


def test_warm_up_is_run_but_not_counted(race):
    for owner, part in (("ensemble", DEPTH), ("ensemble", ONCE), ("ensemble", EVERY), ("UfM-Ensemble", MULTIVIEW)):
        assert len(race.ms(owner, part)) == 6
    assert len(race.steps["UfM-Ensemble"].kept) == 8
    assert race.ms("aleatoric", EVERY) == []  # nobody asked for it


LOG: list[float] = []


class Slow(Linear):
    """Every inference takes 4 ms, and is written down."""

    def features(self, image):
        LOG.append(self.offset)
        time.sleep(0.004)
        return super().features(image)


def test_further_members_cost_what_they_take_and_parts_take_turns(sequence):
    LOG.clear()
    members = [network(offset=0.2 + n, backbone=Slow) for n in range(3)]
    one = {"ensemble": TimedNetwork("ensemble", members, "Slow")}
    rows, cpu = rows_of("Ensemble", "UfM-Ensemble"), torch.device("cpu")
    race = run_race(rows, one, list(sequence)[:4], warm_up=0, device=cpu, multiview_device=cpu)
    assert min(race.ms("ensemble", DEPTH)) >= 4
    assert min(race.ms("ensemble", EVERY)) >= 12
    added = np.subtract(race.ms("ensemble", EVERY), race.ms("ensemble", DEPTH))
    np.testing.assert_allclose(race.added_ms("ensemble", EVERY), added)
    assert min(race.ms("ensemble", EVERY, PROCESSOR)) > 0  # no bound above: idle threads of a pool spin meanwhile
    # Depth, the member whose turn it is, all of them; and the reverse for odd frames.
    every, expected = [0.2, 1.2, 2.2], []
    for n in range(4):
        turn = [0.2, every[n % 3], *every] if n % 2 == 0 else [*every, every[n % 3], 0.2]
        expected.extend(turn)
    assert pytest.approx(expected) == LOG


# ---- the whole measurement ----


USED: list[float] = []  # [J]


class Counted(Linear):
    """Every inference consumes 2 J on the meter of :func:`counting_meter`."""

    def features(self, image):
        USED.append(2.0)
        return super().features(image)


def counting_meter(idle_watts):
    """Of a machine that draws ``idle_watts`` all the time; clock and counter are read at the same moment."""
    moments = []

    def clock():
        moments.append(time.perf_counter())
        return moments[-1]

    def read():
        return {"cpu package 0": idle_watts * (moments[-1] - moments[0]) + sum(USED)}

    return PowerMeter([Source((Rail("cpu package 0", CPU),), read, 0.0001)], clock=clock)


def test_energy_is_that_of_the_inferences(sequence):
    members = [network(offset=0.2 + 0.1 * n, backbone=Counted) for n in range(4)]
    networks = {"ensemble": TimedNetwork("ensemble", members, "Linear")}
    meter = counting_meter(3.0)
    message = measure(rows_of("Ensemble", "UfM*-Ensemble"), networks, sequence, plan=QUICK, meter=meter)
    assert message["power"]["idle_watts"] == {"cpu package 0": pytest.approx(3.0)}
    energy = message["networks"]["ensemble"]["energy"]
    assert energy[DEPTH]["net"]["millijoules"] == pytest.approx(2000)
    assert energy[ONCE]["net"]["millijoules"] == pytest.approx(2000)
    assert energy[EVERY]["net"]["millijoules"] == pytest.approx(8000)
    assert energy[DEPTH]["gross"]["millijoules"] > 2000
    ensemble, star = message["rows"]
    assert ensemble["energy"]["network_uncertainty"]["net"]["millijoules"] == pytest.approx(6000)
    assert ensemble["energy_overhead_percent"]["net"] == pytest.approx(75.0)
    # A head and the multiview step consume nothing on this meter, but the machine idles meanwhile.
    assert star["energy"]["multiview"]["net"]["millijoules"] == pytest.approx(0.0, abs=1e-4)
    assert star["energy"]["multiview"]["gross"]["watts"] == pytest.approx(3.0)
    assert star["energy_overhead_percent"]["net"] == pytest.approx(0.0, abs=1e-4)
    assert star["energy_overhead_percent"]["gross"] > 0
    assert NOT_MEASURABLE not in printed(message)


def printed(measured):
    return "\n".join(map(markdown, efficiency_tables(measured)))


def numbers_of_energy(value, inside=False):
    """Every number below a key that speaks of joules, watts or energy."""
    if isinstance(value, dict):
        words = ("joule", "watt", "energy")
        return [n for k, v in value.items() for n in numbers_of_energy(v, inside or any(w in k for w in words))]
    if isinstance(value, list):
        return [n for v in value for n in numbers_of_energy(v, inside)]
    return [value] if inside and isinstance(value, int | float) else []


@pytest.fixture(scope="module")
def unpowered(sequence):
    networks = {"ensemble": four(), "aleatoric": TimedNetwork("aleatoric", [network()], "Linear")}
    names = ("Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble", "Aleatoric", "UfM*-Aleatoric")
    return measure(rows_of(*names), networks, sequence, plan=QUICK, meter=NO_SENSOR)


def test_without_a_sensor_there_is_a_reason_and_no_number(unpowered):
    text = json.dumps(unpowered, allow_nan=False)
    assert numbers_of_energy(json.loads(text)) == []
    for row in unpowered["rows"]:
        assert row["energy_overhead_percent"] is None
        assert all(part == {"not_measurable": "no permission to read RAPL"} for part in row["energy"].values())
    (table,) = efficiency_tables(unpowered)
    for cell_row in table.lines:
        values = [cell.value for cell in cell_row.cells]
        assert values[:3] == ["", "", ""]  # nothing runs on a GPU
        assert values[4:7] == [NOT_MEASURABLE] * 3
        assert float(values[3].removeprefix("<")) >= 0
    assert "no permission to read RAPL" in printed(unpowered)
    assert "& not measurable here &" in latex(table)


def test_a_row_tells_its_latency_and_memory(unpowered):
    rows = {row["row"]: row for row in unpowered["rows"]}
    star, ensemble = rows["UfM*-Ensemble"], rows["Ensemble"]
    assert set(star["latency"]) == {"depth", "network_uncertainty", "multiview"}
    assert set(ensemble["latency"]) == {"depth", "network_uncertainty"}
    assert ensemble["stages"] is None
    assert star["stages"]["stages_total"]["count"] == QUICK.frames
    for clock in ("wall", "processor"):
        assert ensemble["ratios_to_depth"]["network_uncertainty"][clock]["count"] == QUICK.frames
    memory = star["memory"]
    state = memory["multiview"]
    assert state["smoothing_bytes"] == 4 * SIZE[0] * SIZE[1]
    assert state["bytes_max"] >= state["bytes_mean"] > 0
    assert state["bytes_end"] == 64 * state["count_end"]
    uncertainty = memory["network_uncertainty_bytes"] + state["bytes_end"]
    whole = memory["depth_bytes"] + uncertainty
    assert memory["overhead_percent"] == pytest.approx(100 * uncertainty / whole)
    assert ensemble["memory"]["network_uncertainty_bytes"] == memory["network_uncertainty_bytes"]


def test_what_cannot_be_measured_is_left_out_and_named(sequence):
    one = {"ensemble": TimedNetwork("ensemble", [network()], "Linear")}
    rows = [*rows_of("Ensemble", "UfM*-Ensemble", "Evidential"), Row(Method.parse("UfM*-Ensemble"), Setting(skip=2))]
    message = measure(rows, one, sequence, plan=QUICK, meter=NO_SENSOR)
    assert [row["row"] for row in message["rows"]] == ["UfM*-Ensemble"]
    assert set(message["left_out"]) == {"Ensemble", "Evidential", "UfM*-Ensemble (skip 2)"}
    assert "Evidential is left out: no network for evidential" in printed(message)
    with pytest.raises(ValueError, match="can be measured"):
        measure(rows_of("Evidential"), one, sequence, plan=QUICK, meter=NO_SENSOR)
    with pytest.raises(ValueError, match="8 readable frames, the plan needs 45"):
        measure(rows_of("UfM*-Ensemble"), one, sequence, meter=NO_SENSOR)


def test_a_network_that_predicts_all_in_one_is_not_separable(sequence):
    def both(x):
        return {"depth": 0.2 + 5 * x[:, 0], "variance": 0.01 + x[:, 1]}

    whole = wrap_network(both, "depth", aleatoric="variance", preprocess=Preprocess(size=SIZE))
    networks = {base: TimedNetwork(base, [whole], "Mine") for base in ("aleatoric", "depth_only")}
    names = ("UfM*-Aleatoric", "DepthOnly", "UfM*-DepthOnly")
    message = measure(rows_of(*names), networks, sequence, plan=QUICK, meter=NO_SENSOR)
    aleatoric, alone, depth_only = message["rows"]
    assert "WrappedNetwork" in aleatoric["latency"]["network_uncertainty"]["not_separable"]
    assert alone["latency"]["network_uncertainty"] == {"none": "the method needs only depth of the network"}
    assert depth_only["latency"]["multiview"]["median_ms"] > 0
    lines = {line.label: [cell.value for cell in line.cells] for line in efficiency_tables(message)[0].lines}
    assert lines["UfM*-Aleatoric"][3:6] == ["not separable"] * 3
    assert lines["DepthOnly"][3:6] == ["", "", ""]
    # Its weights are no tensors of torch's.
    assert lines["UfM*-DepthOnly"][7] == lines["UfM*-DepthOnly"][9] == NOT_MEASURABLE
    assert lines["UfM*-DepthOnly"][8] != ""


@pytest.mark.parametrize("wrong", [{"frames": 0}, {"warm_up": -1}, {"windows": True}, {"threads": 0}, {"seconds": 0.0}])
def test_a_plan_is_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Plan(**wrong)
