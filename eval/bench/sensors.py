"""The sensors that zeus reads: GPUs (NVML, AMD SMI), processors (RAPL), and systems on a chip (Jetson, Apple).

zeus finds them and names what they count. Two things are done here instead, since a short measurement is disturbed
by them: RAPL's counters are read from the files that zeus found (zeus starts a process per counter that looks out
for its wrapping, every second; a difference modulo the counter's range needs none), and there is one reason per sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.bench.energy import CPU, DRAM, GPU, OTHER, READING_ERRORS, Rail, SensorError, Source

# [s] Refresh of the counters: NVML's of a data-centre GPU and RAPL's of a package, both generously, and the interval
# at which zeus reads a Jetson's power monitor.
_NVML_PERIOD, _RAPL_PERIOD, _SOC_PERIOD = 0.1, 0.01, 0.15
_NO_ZEUS = "zeus, which reads the sensors, is not installed: pip install 'ufmstar-torch[energy]'"
_UNUSED = "nothing runs on a GPU"


def find_sources(gpu: int | None) -> tuple[list[Source], dict[str, str]]:
    """Every sensor that answers, and for the GPU, the processor and its memory why they have none.

    Args:
        gpu: index as torch counts (of the visible ones); None = none is used.
    """
    if find_spec("zeus") is None:
        return [], {GPU: _UNUSED if gpu is None else _NO_ZEUS, CPU: _NO_ZEUS, DRAM: _NO_ZEUS}
    missing: dict[str, str] = {}
    sources: list[Source] = []
    chip, why_no_chip = _try(_chip)
    if chip is not None:  # a GPU on which nothing runs counts in no column
        rails = tuple(replace(r, part=OTHER) if r.part == GPU and gpu is None else r for r in chip.rails)
        sources.append(replace(chip, rails=rails))
    others: list[tuple[Callable[[], Source], tuple[str, ...]]] = [(_packages, (CPU, DRAM))]
    if gpu is None:
        missing[GPU] = _UNUSED
    else:
        others.append((partial(_graphics, gpu), (GPU,)))
    known = {rail.part for source in sources for rail in source.rails}
    for open_, parts in others:
        if parts[0] not in known:
            source, reason = _try(open_)
            sources += [] if source is None else [source]
            messages = ", ".join(f'"{text}"' for text in (reason, why_no_chip) if text)
            missing |= dict.fromkeys(parts, f"there is no counter of it that zeus can read ({messages})")
    if any(rail.part == CPU for source in sources for rail in source.rails):
        missing[DRAM] = "the processor has no counter for its memory"
    return [source for source in sources if source.rails], missing


def _try(open_: Callable[[], Source]) -> tuple[Source | None, str | None]:
    """A sensor that answers, or why there is none."""
    try:
        source = open_()
        source.read()
    except SensorError as error:
        return None, str(error)
    return source, None


def _guarded(call: Callable[[], Any]) -> Any:
    """The result of a call into zeus.

    Raises:
        SensorError: the sensor is missing, may not be read, or does not answer.
    """
    from zeus.exception import ZeusBaseError

    try:
        return call()
    except (ZeusBaseError, ImportError, *READING_ERRORS) as error:
        message = " ".join(str(error).split()).rstrip(". ")
        raise SensorError(message or type(error).__name__) from error


# ---- GPUs ----


def _graphics(index: int) -> Source:
    """The GPU's counter of its whole energy; without one raises SensorError."""
    from zeus.device import get_gpus

    gpus = _guarded(get_gpus)
    if index >= len(gpus):
        raise SensorError(f"zeus sees {len(gpus)} GPUs, not one of index {index}")
    if not _guarded(lambda: gpus.supports_get_total_energy_consumption(index)):
        raise SensorError(f"GPU {index} has no counter of energy (NVIDIA's have one from Volta on)")
    name = f"gpu {index}"

    def read() -> Mapping[str, float]:
        return {name: 1e-3 * _guarded(lambda: gpus.get_total_energy_consumption(index))}

    return Source((Rail(name, GPU),), read, _NVML_PERIOD)


# ---- processors ----


def _packages() -> Source:
    """RAPL's counters of every processor package, and of its memory where there is one.

    Raises:
        SensorError: there is none, or it may not be read (on Linux only root may, unless zeus's daemon serves it).
    """
    from zeus.device import get_cpus
    from zeus.device.cpu.rapl import RAPLCPU, ZeusdRAPLCPU

    cpus = _guarded(get_cpus).cpus
    if not cpus:
        raise SensorError("RAPL names no processor package")
    if all(isinstance(cpu, RAPLCPU) and not isinstance(cpu, ZeusdRAPLCPU) for cpu in cpus):
        return _from_files(cpus)
    parts = {CPU: "cpu package", DRAM: "dram of package"}

    def read() -> Mapping[str, float]:
        values: dict[str, float] = {}
        for n, cpu in enumerate(cpus):
            now = _guarded(cpu.get_total_energy_consumption)
            for part, joules in ((CPU, now.cpu_mj), (DRAM, now.dram_mj)):
                if joules is not None:
                    values[f"{parts[part]} {n}"] = 1e-3 * joules
        return values

    rails = [Rail(name, CPU if name.startswith("cpu") else DRAM) for name in read()]
    return Source(tuple(rails), read, _RAPL_PERIOD)


def _from_files(cpus: Any) -> Source:
    """The same by reading the counters' files."""
    files: dict[Rail, Path] = {}
    for n, cpu in enumerate(cpus):
        for part, file in ((CPU, cpu.rapl_file), (DRAM, cpu.dram)):
            if file is not None:
                name = f"cpu package {n}" if part == CPU else f"dram of package {n}"
                files[Rail(name, part, 1e-6 * file.max_energy_range_uj)] = Path(file.energy_uj_path)

    def read() -> Mapping[str, float]:
        return {rail.name: 1e-6 * float(_guarded(path.read_text)) for rail, path in files.items()}

    return Source(tuple(files), read, _RAPL_PERIOD)


# ---- systems on a chip ----


def _chip() -> Source:
    """The rails of a Jetson or of Apple's chips; of another machine raises SensorError."""
    from zeus.device import get_soc

    soc = _guarded(get_soc)
    # The whole processor's, GPU's and memory's rails; clusters of cores and caches are parts of them.
    whole = {"soc cpu": CPU, "soc cpu total": CPU, "soc gpu": GPU, "soc dram": DRAM}

    def read() -> Mapping[str, float]:
        now = asdict(_guarded(soc.get_total_energy_consumption))
        single = {key: value for key, value in now.items() if isinstance(value, int | float)}
        return {  # "cpu_energy_mj" is "soc cpu", "gpu_sram_mj" "soc gpu sram"
            f"soc {key.removesuffix('_mj').removesuffix('_energy').replace('_', ' ')}": 1e-3 * value
            for key, value in single.items()
        }

    return Source(tuple(Rail(name, whole.get(name, OTHER)) for name in read()), read, _SOC_PERIOD)
