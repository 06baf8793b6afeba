"""Costs of uncertainty: times and energies of networks with known costs, independent rows."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from efficiency_cases import SIZE, network, room_sequence
from tiny_networks import Linear
from tiny_suite import rows_of

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.bench.energy import CPU, GPU
from ufmstar_torch.eval.bench.measure import Plan, measure
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork
from ufmstar_torch.eval.bench.parts import MULTIVIEW, time_parts
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.frames.image_check import reduced, shows_something
from ufmstar_torch.frames.prediction import NetworksInTurn
from ufmstar_torch.models.any_network import wrap_network
from ufmstar_torch.models.preprocess import Preprocess

NO_METER = SimpleNamespace(missing={CPU: "no permission to read RAPL", GPU: "no NVML"})
QUICK = Plan(frames=4, warm_up=2, threads=1, seconds=0.02, windows=2)
ROWS = ("UfM-Ensemble", "UfM*-Ensemble", "UfM*-FullEnsemble", "UfM*-Aleatoric", "UfM-Aleatoric-100K")


@pytest.fixture(scope="module")
def sequence():
    return room_sequence()


def four(base="ensemble"):
    return TimedNetwork(base, [network(offset=0.2 + 0.1 * n) for n in range(4)], "Linear")


def parts_of(rows, networks, frames, warm_up=2):
    cpu = torch.device("cpu")
    return time_parts(rows, networks, frames, warm_up=warm_up, device=cpu, multiview_device=cpu)


@pytest.fixture(scope="module")
def timed(sequence):
    networks = {"ensemble": four(), "aleatoric": TimedNetwork("aleatoric", [network()], "Linear")}
    return parts_of(rows_of(*ROWS), networks, list(sequence))


def test_no_row_has_the_state_of_another(timed, sequence):
    for name in ROWS:
        alone = parts_of(rows_of(name), {"ensemble": four(), "aleatoric": TimedNetwork("aleatoric", [network()], "L")},
                         list(sequence))  # fmt: skip
        assert alone.memory[name] == timed.memory[name]
        assert alone.memory[name]["count_end"] > 0


def test_a_row_is_what_the_module_makes_of_the_networks_turns(timed, sequence):
    members, ufm = [network(offset=0.2 + 0.1 * n) for n in range(4)], UfMStar()
    with torch.no_grad():
        for n, frame in enumerate(sequence):
            image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
            x, K = members[0].preprocess(image, torch.from_numpy(frame.intrinsics)[None])
            p = members[n % 4](x)
            view = {"member": n % 4, "informative": shows_something(reduced(image))}
            ufm(p.depth, torch.from_numpy(frame.T_world_cam)[None], K, p.aleatoric_variance, **view)
    assert torch.equal(timed.staged["UfM*-Ensemble"].module.mean, ufm.mean)
    used = int(ufm.mixture.components) * ufm.mixture.bytes_per_component()
    assert timed.memory["UfM*-Ensemble"]["bytes_end"] == used


def test_stages_add_up_and_warm_up_is_not_counted(timed):
    assert set(timed.staged) == {"UfM*-Ensemble", "UfM*-FullEnsemble", "UfM*-Aleatoric"}
    staged = timed.staged["UfM*-Ensemble"]
    sums = np.sum([times[timed.warm_up :] for times in staged.stages.values()], axis=0)
    assert staged.summary(warm_up=timed.warm_up)["stages_total"]["median_ms"] == pytest.approx(np.median(sums))
    for owner, part in (("ensemble", DEPTH), ("ensemble", ONCE), ("ensemble", EVERY), ("UfM-Ensemble", MULTIVIEW)):
        assert len(timed.ms(owner, part)) == 6, "without the warm-up"
    assert timed.ms("aleatoric", EVERY) == []  # energy is not requested


LOG: list[float] = []


class Slow(Linear):
    """Every inference takes 4 ms, and is recorded."""

    def features(self, image):
        LOG.append(self.offset)
        time.sleep(0.004)
        return super().features(image)


def test_further_members_cost_what_they_take_and_parts_take_turns(sequence):
    LOG.clear()
    members = [network(offset=0.2 + n, backbone=Slow) for n in range(3)]
    one = {"ensemble": TimedNetwork("ensemble", members, "Slow")}
    timed = parts_of(rows_of("Ensemble", "UfM-Ensemble"), one, list(sequence)[:4], warm_up=0)
    assert min(timed.ms("ensemble", DEPTH)) >= 4
    assert min(timed.ms("ensemble", EVERY)) >= 12
    # Depth, the current member, all members; in reverse order for odd frames.
    every, expected = [0.2, 1.2, 2.2], []
    for n in range(4):
        turn = [0.2, every[n % 3], *every] if n % 2 == 0 else [*every, every[n % 3], 0.2]
        expected.extend(turn)
    assert pytest.approx(expected) == LOG


# ---- the whole measurement ----


@pytest.fixture(scope="module")
def unpowered(sequence):
    networks = {"ensemble": four(), "aleatoric": TimedNetwork("aleatoric", [network()], "Linear")}
    names = ("Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble", "Aleatoric", "UfM*-Aleatoric")
    return measure(rows_of(*names), networks, sequence, plan=QUICK, meter=NO_METER)


def test_without_a_meter_there_is_a_reason_and_no_number(unpowered):
    for row in json.loads(json.dumps(unpowered, allow_nan=False))["rows"]:
        assert row["energy_overhead_percent"] is None
        assert all(part == {"not_measurable": "no permission to read RAPL"} for part in row["energy"].values())
    assert unpowered["power"] == {"missing": NO_METER.missing}


def test_energy_of_the_parts(sequence):
    """Every call takes a joule on this meter."""
    meter, calls = SimpleNamespace(missing={}), [0]

    class Counted(Linear):
        def features(self, image):
            calls[0] += 1
            return super().features(image)

    def measured(work):
        before = calls[0]
        work()
        return 1.0, {CPU: float(calls[0] - before) or 1e-9}

    meter.measure = measured
    members = [network(offset=0.2 + 0.1 * n, backbone=Counted) for n in range(4)]
    networks = {"ensemble": TimedNetwork("ensemble", members, "Linear")}
    message = measure(rows_of("Ensemble", "UfM*-Ensemble"), networks, sequence, plan=QUICK, meter=meter)
    energy = {part: value["gross"]["millijoules"] for part, value in message["networks"]["ensemble"]["energy"].items()}
    assert energy == {DEPTH: pytest.approx(1000), ONCE: pytest.approx(1000), EVERY: pytest.approx(4000)}
    ensemble, star = message["rows"]
    assert ensemble["energy"]["network_uncertainty"]["gross"]["millijoules"] == pytest.approx(3000)
    assert ensemble["energy_overhead_percent"]["gross"] == pytest.approx(75.0)
    assert star["energy_overhead_percent"]["gross"] == pytest.approx(0.0, abs=1e-4)


def test_a_row_states_its_latency_and_memory(unpowered):
    rows = {row["row"]: row for row in unpowered["rows"]}
    star, ensemble = rows["UfM*-Ensemble"], rows["Ensemble"]
    assert set(star["latency"]) == {"depth", "network_uncertainty", "multiview"}
    assert set(ensemble["latency"]) == {"depth", "network_uncertainty"}
    assert ensemble["stages"] is None
    assert star["stages"]["stages_total"]["count"] == QUICK.frames
    assert ensemble["ratios_to_depth"]["network_uncertainty"]["count"] == QUICK.frames
    memory, state = star["memory"], star["memory"]["multiview"]
    assert state["smoothing_bytes"] == 4 * SIZE[0] * SIZE[1]
    assert state["bytes_end"] == 84 * state["count_end"] > 0
    uncertainty = memory["network_uncertainty_bytes"] + state["bytes_end"]
    assert memory["overhead_percent"] == pytest.approx(100 * uncertainty / (memory["depth_bytes"] + uncertainty))


def test_what_cannot_be_measured_is_left_out_and_named(sequence):
    one = {"ensemble": TimedNetwork("ensemble", [network()], "Linear")}
    odd = [*rows_of("UfM*-Ensemble", skip=2), *rows_of("UfM*-Ensemble", anchors="truth")]
    rows = [*rows_of("Ensemble", "UfM*-Ensemble", "Evidential"), *odd]
    message = measure(rows, one, sequence, plan=QUICK, meter=NO_METER)
    assert [row["row"] for row in message["rows"]] == ["UfM*-Ensemble"]
    assert len(message["left_out"]) == 4
    assert message["left_out"]["Evidential"] == "no network for evidential"
    for wrong, words in ((rows_of("Evidential"), "can be measured"), (rows_of("UfM*-Ensemble"), "8 usable frames")):
        with pytest.raises(ValueError, match=words):
            measure(wrong, one, sequence, meter=NO_METER, plan=Plan(frames=40))
    with pytest.raises(ValueError, match="0 usable frames"):
        measure(rows_of("UfM*-Ensemble"), one, sequence, meter=NO_METER, selected=slice(20, 30))


def test_all_selected_frames_are_measured_as_in_the_evaluation(sequence):
    """Latencies of every selected frame, and the memory of the evaluation after the last one and in the mean."""
    selected, rows = slice(1, None), rows_of("UfM-Aleatoric", "UfM*-Aleatoric")
    networks = {"aleatoric": TimedNetwork("aleatoric", [network()], "Linear")}
    with_depth = open_sequence(f"tour:1?frames=150&size={SIZE[0]}x{SIZE[1]}&sensor=0")
    seen = replace(sequence, entries=tuple(
        replace(entry, load_depth=rendered.load_depth)
        for entry, rendered in zip(sequence.entries, with_depth.entries, strict=False)
    ))  # fmt: skip
    message = measure(rows, networks, seen, plan=Plan(threads=1), meter=NO_METER, selected=selected)
    assert message["plan"]["frames"] == 7
    one = network()
    source = NetworkSource(NetworksInTurn(one, preprocess=one.preprocess), torch.device("cpu"), {})
    judged = evaluate_sequence(seen, rows, {"aleatoric": source}, frames=selected)
    for row, figures in zip(message["rows"], judged, strict=True):
        assert row["latency"]["multiview"]["count"] == figures.frames["done"] == 7
        measured = row["memory"]["multiview"]
        assert measured["bytes_end"] == figures.state["bytes_end"] > 0
        assert measured["bytes_mean"] == pytest.approx(figures.state["bytes_mean"])
    ufm = message["rows"][0]["memory"]["multiview"]
    assert ufm["bytes_mean"] < ufm["bytes_end"]


def test_the_meter_repeats_every_frame_of_a_multiview_step(sequence):
    """A window runs all frames, from the reset on, however short it may be."""
    windows = []

    def measured(work):
        work()
        windows.append(1)
        return 1.0, {CPU: 1.0}

    meter = SimpleNamespace(missing={}, measure=measured)
    networks = {"aleatoric": TimedNetwork("aleatoric", [network()], "Linear")}
    plan = Plan(threads=1, seconds=0.0, windows=1)
    message = measure(rows_of("UfM*-Aleatoric"), networks, sequence, plan=plan, meter=meter)
    assert message["rows"][0]["energy"]["multiview"]["gross"]["millijoules"] == pytest.approx(1000 / 8)
    assert len(windows) == 3  # depth, once, multiview


def test_a_network_that_predicts_all_in_one_is_not_separable(sequence):
    def both(x):
        return {"depth": 0.2 + 5 * x[:, 0], "variance": 0.01 + x[:, 1]}

    whole = wrap_network(both, "depth", aleatoric="variance", preprocess=Preprocess(size=SIZE))
    networks = {base: TimedNetwork(base, [whole], "Mine") for base in ("aleatoric", "depth_only")}
    message = measure(rows_of("UfM*-Aleatoric", "DepthOnly", "UfM*-DepthOnly"), networks, sequence, plan=QUICK,
                      meter=NO_METER)  # fmt: skip
    aleatoric, alone, depth_only = message["rows"]
    assert "WrappedNetwork" in aleatoric["latency"]["network_uncertainty"]["not_separable"]
    assert alone["latency"]["network_uncertainty"] == {"none": "the method needs only depth of the network"}
    assert depth_only["latency"]["multiview"]["median_ms"] > 0
    assert "not torch's" in depth_only["memory"]["not_measurable"]
