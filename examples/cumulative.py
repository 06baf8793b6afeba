"""Cumulative time and energy of a live run, divided into camera and network, UfM* and the rest (the paper's system
figure).

Energy comes from the processor's and GPU's counters (``energy``), or from the log of an external power meter. It is
divided by time: between two readings each part has the share of the energy that it has of the time. Idle power belongs
to the part that runs, or to the rest.
"""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.bench.energy import EnergyMeter
from ufmstar_torch.eval.engine.realtime import RealTime
from ufmstar_torch.eval.report import style

NETWORK, OURS, REST = "camera and network", "UfM*", "rest"
COLUMNS = ("time", "power")
_COLOURS = ("#E69F00", "#0072B2", "#d0d0d0")  # of the three
_PERIOD = 0.5  # [s] between two readings of the counters
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EnergyReadings:
    """Readings of a meter: times [N] [s] on the clock of the run, and the energy since the first one [N] [J]."""

    times: Array
    joules: Array


class CounterLog(AbstractContextManager["CounterLog"]):
    """Reads the counters of a meter every half second in a thread, as long as the context lasts."""

    def __init__(self, meter: EnergyMeter) -> None:
        self._meter, self._ended = meter, threading.Event()
        self._times, self._joules = [time.perf_counter()], [0.0]
        self._thread = threading.Thread(target=self._read, name="energy counters", daemon=True)

    def __enter__(self) -> CounterLog:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def readings(self) -> EnergyReadings:
        """The readings so far."""
        return EnergyReadings(np.array(self._times), np.array(self._joules))

    def _read(self) -> None:
        while not self._ended.is_set():
            _, joules = self._meter.measure(lambda: self._ended.wait(_PERIOD))
            self._times.append(time.perf_counter())
            self._joules.append(self._joules[-1] + sum(joules.values()))


def read_power(path: Path, offset: float) -> EnergyReadings:
    """Read the log of an external meter: CSV with the columns ``time`` (seconds since 1970) and ``power`` [W]. Power is
    linear between two lines.

    Args:
        path: the file.
        offset: seconds since 1970 minus the clock of the run.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a column is missing, a value is no number, times do not rise, or there are fewer than two lines.
    """
    with path.open(encoding="utf-8", newline="") as file:
        lines = csv.DictReader(file)
        if missing := [name for name in COLUMNS if name not in (lines.fieldnames or ())]:
            raise ValueError(f"{path} must have the columns {', '.join(COLUMNS)}, got no {', '.join(missing)}")
        try:
            values = np.array([[float(line[name]) for name in COLUMNS] for line in lines])
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} must hold numbers, {error}") from error
    if len(values) < 2 or not np.isfinite(values).all() or not (np.diff(values[:, 0]) > 0).all():
        raise ValueError(f"{path} must hold at least two lines of finite numbers with rising times, got {len(values)}")
    seconds, watts = values.T
    energy = np.diff(seconds) * (watts[1:] + watts[:-1]) / 2
    return EnergyReadings(seconds - offset, np.concatenate([[0.0], energy.cumsum()]))


def cumulative_times(results: RealTime, at: Array) -> dict[str, Array]:
    """Seconds that each part has spent until the times ``at`` [N], since the first of them."""
    started, predicted, finished = (np.array(x) for x in (results.started, results.predicted, results.finished))
    parts = {}
    for name, begin, end in ((NETWORK, started, predicted), (OURS, predicted, finished)):
        knots, done = np.stack([begin, end], 1).flatten(), np.repeat((end - begin).cumsum(), 2)
        done[::2] -= end - begin
        spent = np.interp(at, knots, done)
        parts[name] = spent - spent[0]
    return {**parts, REST: at - at[0] - sum(parts.values())}


def cumulative_costs(results: RealTime, readings: EnergyReadings | str) -> dict[str, Any]:
    """Plain values: by part, cumulative "seconds" at the "times" [s] of the results, and "joules" at "energy_times".

    Args:
        results: of the run, at least two.
        readings: of a meter, or why there are none, which "not_measurable" then has.
    """
    at = np.array(results.finished)
    seconds = cumulative_times(results, at)
    costs: dict[str, Any] = {"times": (at - at[0]).tolist(), "seconds": _lists(seconds)}
    if not isinstance(readings, str):
        during = (readings.times >= at[0]) & (readings.times <= at[-1])
        if during.sum() >= 2:
            times, energy = readings.times[during], np.diff(readings.joules[during])
            shares = {name: np.diff(spent) / np.diff(times) for name, spent in cumulative_times(results, times).items()}
            joules = {name: np.concatenate([[0.0], (share * energy).cumsum()]) for name, share in shares.items()}
            return costs | {"energy_times": (times - at[0]).tolist(), "joules": _lists(joules)}
        readings = "fewer than two readings of the meter lie within the run: are its times seconds since 1970?"
    return costs | {"not_measurable": readings}


def _lists(parts: Mapping[str, Array]) -> dict[str, list[float]]:
    return {name: values.tolist() for name, values in parts.items()}


def draw_cumulative(costs: Mapping[str, Any]) -> Any:
    """The paper's system figure (c): time, and energy if it was measured, of the parts of a live run above each other,
    from :func:`cumulative_costs`."""
    panels = [("times", "seconds", "cumulative time [s]")]
    panels += [("energy_times", "joules", "cumulative energy [J]")] if "joules" in costs else []
    figure = style.new_figure(5.2 * len(panels), 3.6, "Cost of a live run")
    for axes, (times, kind, label) in zip(np.atleast_1d(figure.subplots(1, len(panels))), panels, strict=True):
        axes.stackplot(costs[times], *costs[kind].values(), labels=list(costs[kind]), colors=_COLOURS)
        axes.margins(0)
        style.finish(axes, x="time of the run [s]", y=label)
    style.legend_below(figure)
    return figure
