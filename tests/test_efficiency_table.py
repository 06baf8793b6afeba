"""The table of the cost of uncertainty: the paper's lines, and text where nothing was measured."""

from __future__ import annotations

import pytest

from ufmstar_torch.eval.bench.energy import CPU, GPU
from ufmstar_torch.eval.bench.measure import overhead_percent
from ufmstar_torch.eval.report.efficiency import NOT_MEASURABLE, efficiency_tables, megabytes


def part(ms, millijoules=None, low=None):
    spread = {"median_ms": ms, "q1_ms": ms if low is None else low, "q3_ms": ms}
    if millijoules is None:
        return spread, {"not_measurable": "no counter"}
    return spread, {"gross": {**dict.fromkeys(("q1", "millijoules", "q3"), millijoules), "seconds": 1e-3 * ms}}


def line(depth=(27.0, 206.3), dnn=(252.0, 1857.0), mvd=None, memory=None, overhead=90.0):
    """A measurement with one row with these medians [ms, mJ]."""
    parts = {"depth": part(*depth), "network_uncertainty": part(*dnn)} | ({"multiview": part(*mvd)} if mvd else {})
    sizes = {"depth_bytes": 138.3e6, "network_uncertainty_bytes": 1245e6, "buffers_bytes": 1e6, "mvd": 0}
    sizes |= memory or {}
    state = sizes.pop("mvd")
    sizes["overhead_percent"] = overhead_percent(sizes["network_uncertainty_bytes"] + state, sizes["depth_bytes"])
    name = "UfM*-Ensemble" if mvd else "Ensemble"
    state_memory = {"bytes_end": state, "bytes_mean": state / 2, "smoothing_bytes": 200704}
    row = {
        "row": name, "base": "ensemble", "network": "ResNet50-Monodepth2",
        "latency": {key: value[0] for key, value in parts.items()},
        "energy": {key: value[1] for key, value in parts.items()},
        "energy_overhead_percent": None if overhead is None else {"gross": overhead},
        "memory": {**sizes, "multiview": state_memory if state or mvd else None},
    }  # fmt: skip
    depth_memory = {"depth": sizes["depth_bytes"], "uncertainty": 0}
    return {
        "devices": {"units": {"depth": GPU, "network_uncertainty": GPU, "multiview": CPU}},
        "machine": {"hardware": {"cpu": "Cortex-A78AE"}, "gpu": "Orin"},
        "plan": {"frames": 100, "whole": True, "threads": 4},
        "sequence": {"name": "scene0000_00"},
        "power": {"missing": {}},
        "networks": {"ensemble": {"memory": depth_memory, "whole": None, "latency": {"depth": parts["depth"][0]}}},
        "rows": [row],
        "left_out": {},
    }


def cells(measured):
    table, *_ = efficiency_tables(measured)
    return list(table.cells.iloc[0])


def test_the_papers_lines_are_printed_as_in_the_paper():
    assert [table.name for table in efficiency_tables(line())][-1] == "paper-efficiency-ResNet50-Monodepth2"
    assert cells(line()) == ["252", "7.4", "1857", "", "", "", "90.0", "1245", "", "90.0", "", "1.0"]
    star = line(dnn=(2.0, 10.4), mvd=(25.2, 53.0), memory={"mvd": 30_000}, overhead=32.0)
    assert cells(star) == ["2.0", "5.2", "10", "25", "2.1", "53", "32.0", "1245", "0.03", "90.0", "0.01", "1.0"]
    table, *_ = efficiency_tables(star)
    assert "Depth alone: 27 ms on the GPU, 138.3 MB." in table.text()
    assert "smoothing besides: 0.20 MB" in table.text()
    assert "Medians of all 100 selected frames of scene0000_00" in table.text()
    assert r"UfM$^*$-Ensemble & 2.0 & 5.2" in table.latex()


def test_a_difference_that_the_noise_hides_is_an_upper_bound():
    hidden = line()
    hidden["rows"][0]["latency"]["network_uncertainty"] = {"q1_ms": -0.3, "median_ms": 0.1, "q3_ms": 0.8}
    hidden["rows"][0]["energy"]["network_uncertainty"]["gross"] |= {"q1": -2.0, "q3": 4.0}
    assert cells(hidden)[:3] == ["<0.8", "", "<4.0"]


def test_an_unmeasured_unit_has_words_in_its_cells_only():
    half = line(dnn=(2.0, 10.4), mvd=(25.2, None), overhead=None)
    half["power"]["missing"] = {CPU: "no counter"}
    assert cells(half)[:7] == ["2.0", "5.2", "10", "25", NOT_MEASURABLE, NOT_MEASURABLE, NOT_MEASURABLE]
    assert "Power and energy of the CPU are not measurable here: no counter." in efficiency_tables(half)[0].text()


@pytest.mark.parametrize(
    ("count", "printed"),
    [(0, "0"), (580, "<0.01"), (30_000, "0.03"), (4e6, "4.0"), (74.6e6, "74.6"), (138.3e6, "138.3"), (1245e6, "1245")],
)
def test_megabytes_are_printed_as_in_the_paper(count, printed):
    assert megabytes(count) == printed
