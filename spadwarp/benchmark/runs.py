"""Running the benchmark cases, the file of their results, and whether cases became faster.

Kernels are loaded, and one run is discarded, before the clock starts; a launch ends when the device has finished it,
and later copies to the host are not counted.
"""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import simulate_analytic
from spadwarp.benchmark.cases import CASES, GROUPS, Case
from spadwarp.device import core_count, nvidia_driver, pick_device, processor_name
from spadwarp.errors import FileError
from spadwarp.frames import detect
from spadwarp.limits import check_choice, check_integer
from spadwarp.mesh import build_mesh
from spadwarp.scene import Detector, Laser, Scene
from spadwarp.transport import provenance, simulate, trace, truth_maps
from spadwarp.transport.model import build_model, transport_spec

if TYPE_CHECKING:
    import warp as wp

    from spadwarp_kernels import Data, Model

__all__ = ["MARGIN", "BenchResult", "Comparison", "TransportRun", "compare", "history", "load_report", "newest_report"]
__all__ += ["report", "run"]

FORMAT, FORMAT_VERSION = "spadwarp bench", 1


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """What was measured in a case.

    Attributes:
        case: Its name.
        device: "cpu", "cuda:0", ...
        threads: CPU threads; None on a GPU.
        faces: Triangles of the target.
        size: Work of one run by unit: photons; or frames, bins, pulses.
        setup: Seconds for meshes, BVH and arrays.
        compile: Seconds to compile the kernel or, if it was compiled before, to load it.
        seconds: Of each timed run.
        rates: Per second, from the fastest run: photons, collisions, queries (of surfaces, with shadow rays); or
            frames, bins.
        memory: Highest memory of the device that the case used [bytes]; None on the CPU, where Warp does not count it.
        tally_bytes: Size of the histograms; None without a camera.
        error_per_root_second: Relative standard error of the bins that decide the depth (`Result.relative_error`) after
            one second of transport; it falls with the root of the time. None without a camera or where it was not asked
            for, infinite where nothing returned.
        check: Where a mean is known: `name`, `value`, `standard_error`, `reference`, `passed`.
    """

    case: str
    device: str
    threads: int | None
    faces: int = 0
    size: dict[str, int]
    setup: float
    compile: float
    seconds: tuple[float, ...]
    rates: dict[str, float]
    memory: int | None = None
    tally_bytes: int | None = None
    error_per_root_second: float | None = None
    check: dict[str, Any] | None = None


def report(results: Sequence[BenchResult]) -> dict[str, Any]:
    """Results as plain values, with device, processor, driver, versions, commit and date."""
    device = pick_device(results[0].device if results else None)
    made = {**provenance(device), "driver": nvidia_driver() if device.is_cuda else None, "commit": _commit()}
    made["processor"] = processor_name(pick_device("cpu"))
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "provenance": {**made, "threads": None if device.is_cuda else core_count()},
        "results": [asdict(result) for result in results],
    }


def load_report(path: str | Path) -> dict[str, Any]:
    """Reads what `spadwarp bench --json` wrote. Raises `FileError`."""
    try:
        stored = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise FileError(f"{path}: not JSON: {error}") from error
    if not isinstance(stored, dict) or stored.get("format") != FORMAT or not isinstance(stored.get("results"), list):
        raise FileError(f"{path}: not a file that `spadwarp bench --json` wrote")
    if stored.get("format_version") != FORMAT_VERSION:
        raise FileError(f"{path}: format_version = {stored.get('format_version')} is not {FORMAT_VERSION}")
    needed = {field.name for field in fields(BenchResult)}
    if any(not isinstance(row, dict) or not needed <= row.keys() for row in stored["results"]):
        raise FileError(f"{path}: a result lacks one of {', '.join(sorted(needed))}")
    return stored


def _commit() -> str | None:
    """The commit of the checkout that this package lies in, "-dirty" where it was changed; None outside one."""
    root = Path(__file__).resolve().parents[2]

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root:
            return None
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


# Runs

# Photons of one timed run.
CUDA_PHOTONS = 1 << 26
CPU_PHOTONS_PER_CORE = 1 << 18

_LAUNCH = 1 << 26  # the most photons of one launch
_CHECK_PHOTONS = 1 << 20  # whose terminal states are kept for the check of a mean
_SIGMAS = 4.0  # beyond which a check fails: one correct run in 16 000


def run(
    cases: Iterable[str] | None = None,
    *,
    device: str | None = None,
    photons: int | None = None,
    repeats: int = 3,
    progress: Callable[[Case], None] | None = None,
    found: Callable[[BenchResult], None] | None = None,
) -> list[BenchResult]:
    """Measures cases one after the other.

    Args:
        cases: Names out of `CASES`, or "scaling" for the growth of cost with size; by default all of `CASES`.
        device: As for `spadwarp.simulate`.
        photons: Of one timed run of a transport case, > 0; by default 2^26 on a GPU and 2^18 a core on a CPU.
            "analytic", "detect" and the cases of "scaling" named after their photons have sizes of their own.
        repeats: Timed runs of each case, > 0; rates are those of the fastest. Cases of "scaling" are not repeated
            once two seconds have been timed.
        progress: Called with each case before it is run.
        found: Called with each result.

    Raises:
        ArgumentError: An unknown case, or a number out of range.
        DeviceError: No such device, or one that is too small for a case.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        check_choice("cases: an item", name, [*CASES, *GROUPS])
    photons = None if photons is None else check_integer("photons", photons, "[1, 1000000000000]")
    repeats = check_integer("repeats", repeats, "[1, 1000]")
    wp_device = pick_device(device)
    chosen = [case for name in names for case in (GROUPS[name](wp_device.is_cuda) if name in GROUPS else [CASES[name]])]
    results = []
    for case in chosen:
        if progress is not None:
            progress(case)
        results.append(_KINDS[case.kind](case, wp_device, photons, repeats))
        if found is not None:
            found(results[-1])
    return results


class TransportRun:
    """A transport case on a device, set up and compiled.

    Attributes:
        setup, compile: Seconds that this took, see `BenchResult`.
        faces: Triangles of the target.
        scores: Whether the estimator fills a histogram; else photons travel without a camera.
        tally_bytes: Of the histograms; None without a camera.
    """

    def __init__(self, case: Case, device: wp.Device) -> None:
        import spadwarp_kernels as sk

        scene = Scene.from_dict(case.scene)
        began = time.perf_counter()
        mesh = build_mesh(scene)
        self._spec = transport_spec(scene, mesh, **({} if case.estimator is None else {"estimator": case.estimator}))
        self.scores: bool = sk.ESTIMATORS[self._spec.estimator](self._spec).scores
        self._model: Model = build_model(scene, device, mesh, camera=self.scores)
        self._data: Data = sk.make_data(self._model)
        _wait(device)
        ready = time.perf_counter()
        sk.load_transport_kernel(self._spec, device, model=self._model)
        self.setup, self.compile = ready - began, time.perf_counter() - ready
        self.faces = 0 if mesh is None else mesh.face_count
        self.tally_bytes = 8 * self._model.tally_size if self.scores else None

    def run(self, photons: int, *, first: int = 0) -> tuple[dict[str, int], dict[str, int], float]:
        """Ledger and counters of the photons with ids from `first` on, on a CPU with a thread for each core, and the
        seconds until the device had finished."""
        import spadwarp_kernels as sk

        def launch(start: int, stop: int) -> None:
            for at in range(start, stop, _LAUNCH):
                sk.launch_transport(
                    self._spec, self._model, self._data, seed=0, first_id=at, photon_count=min(_LAUNCH, stop - at)
                )

        device = self._model.device
        workers = 1 if device.is_cuda else min(core_count(), photons)
        edges = [first + photons * i // workers for i in range(workers + 1)]
        self._data.ledger.zero_()
        _wait(device)
        began = time.perf_counter()
        if workers == 1:
            launch(first, first + photons)
        else:
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(launch, edges[:-1], edges[1:]))
        _wait(device)
        seconds = time.perf_counter() - began
        return (*sk.read_ledger(self._data), seconds)


def measure_transport(case: Case, device: wp.Device, photons: int | None, repeats: int) -> BenchResult:
    usual = CUDA_PHOTONS if device.is_cuda else CPU_PHOTONS_PER_CORE * core_count()
    photons = case.photons or photons or usual
    memory = _Memory(device)
    traced = TransportRun(case, device)
    traced.run(min(photons, _LAUNCH if device.is_cuda else 1 << 20))  # a GPU's kernel may depend on the number
    seconds: list[float] = []
    counts: list[dict[str, int]] = []
    while len(seconds) < repeats and sum(seconds) < case.time_limit:
        _, counters, took = traced.run(photons, first=len(seconds) * photons)
        seconds.append(took)
        counts.append(counters)
    fastest = min(range(len(seconds)), key=seconds.__getitem__)
    counted = counts[fastest]
    work = {
        "photons": photons,
        "collisions": counted["water_collisions"] + counted["surface_events"],
        "queries": counted["surface_queries"] + counted["shadow_queries"],
    }
    rates = {unit: number / seconds[fastest] for unit, number in work.items()}
    used = memory.peak()
    setup, compiled, faces, tally_bytes = traced.setup, traced.compile, traced.faces, traced.tally_bytes
    error = case.error and traced.scores
    del traced  # and its histograms, before the next run makes its own
    scene = Scene.from_dict(case.scene)
    return BenchResult(
        case=case.name,
        device=device.alias,
        threads=None if device.is_cuda else core_count(),
        faces=faces,
        size={"photons": photons},
        setup=setup,
        compile=compiled,
        seconds=tuple(seconds),
        rates=rates,
        memory=used,
        tally_bytes=tally_bytes,
        error_per_root_second=_error(scene, device, min(photons, usual), rates["photons"]) if error else None,
        check=None if case.absorbed is None else _absorbed(scene, device, photons, *case.absorbed),
    )


def _wait(device: wp.Device) -> None:
    import warp as wp

    wp.synchronize_device(device)


def _error(scene: Scene, device: wp.Device, photons: int, photons_per_second: float) -> float:
    """Relative error after one second at that rate; from a separate run, since batches take time."""
    result = simulate(scene, photons=max(photons, 2 * scene.scan_positions), device=device.alias, uncertainty=True)
    return result.relative_error * math.sqrt(result.photons / photons_per_second)


def _absorbed(scene: Scene, device: wp.Device, photons: int, reference: float, rounding: float) -> dict[str, Any]:
    weights = trace(scene, photons=max(2, min(photons, _CHECK_PHOTONS)), device=device.alias).weight
    lost = 1.0 - weights.astype(np.float64)
    value, error = float(lost.mean()), float(lost.std(ddof=1) / math.sqrt(lost.size))
    return {
        "name": "absorbed fraction",
        "value": value,
        "standard_error": error,
        "reference": reference,
        "passed": abs(value - reference) <= rounding + _SIGMAS * error,
    }


class _Memory:
    """Memory that a case uses on a GPU, above what was used before it."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device if device.is_cuda and device.is_mempool_supported else None
        self._before, self._high = self._read()

    def _read(self) -> tuple[int, int]:
        import warp as wp

        if self._device is None:
            return 0, 0
        return wp.get_mempool_used_mem_current(self._device), wp.get_mempool_used_mem_high(self._device)

    def peak(self) -> int | None:
        """[bytes]. Warp cannot reset its maximum: where an earlier case reached it, the memory that is used now."""
        now, high = self._read()
        if self._device is None:
            return None
        return (high if high > self._high else now) - self._before


def _analytic(case: Case, device: wp.Device, _: int | None, repeats: int) -> BenchResult:
    frames = 512 if device.is_cuda else 32
    scene, memory, clock = Scene.from_dict(case.scene), _Memory(device), _Clock(device)
    truth = truth_maps(scene, device=device.alias)
    clock.lap()

    def simulate_frames(count: int, seed: int) -> None:
        simulate_analytic(scene, truth=truth, frames=count, seed=seed, device=device.alias)

    simulate_frames(1, 0)
    clock.lap()
    for seed in range(repeats):
        simulate_frames(frames, seed)
        clock.lap()
    return _stage(case, clock, memory, rates={"frames": frames})


def _detect(case: Case, device: wp.Device, _: int | None, repeats: int) -> BenchResult:
    import warp as wp

    # A flat background, and a return whose time and strength vary over the image.
    height, width, bins = (192, 256, 1024) if device.is_cuda else (24, 32, 1024)
    pulses, memory, clock = 1_000_000, _Memory(device), _Clock(device)
    row, column, k = np.ogrid[:height, :width, :bins]
    centre = 300.0 + 400.0 * row / height
    light = 1e-5 + 0.01 * (1 + column) / width * np.exp(-0.5 * ((k - centre) / 2.0) ** 2)
    source: Any = wp.array(light.astype(np.float32), dtype=wp.float32, device=device)
    detector, laser = Detector(wrap=False), Laser()
    clock.lap()
    for seed in range(repeats + 1):
        detect(
            source,
            seed=seed,
            pulses=pulses,
            detector=detector,
            laser=laser,
            gate_start=0.0,
            bin_width=100e-12,
            device=device,
        )
        clock.lap()
    return _stage(case, clock, memory, rates={"bins": height * width * bins, "frames": 1}, pulses=pulses)


class _Clock:
    """Seconds between laps, each of which waits for the device."""

    def __init__(self, device: wp.Device) -> None:
        self.device, self.seconds, self._last = device, list[float](), time.perf_counter()

    def lap(self) -> None:
        _wait(self.device)
        now = time.perf_counter()
        self.seconds.append(now - self._last)
        self._last = now


def _stage(case: Case, clock: _Clock, memory: _Memory, *, rates: Mapping[str, int], **size: int) -> BenchResult:
    """The result of laps for setup, compilation and each timed run, which does the work of `rates`."""
    setup, compiled, *seconds = clock.seconds
    return BenchResult(
        case=case.name,
        device=clock.device.alias,
        threads=None if clock.device.is_cuda else 1,
        size={**rates, **size},
        setup=setup,
        compile=compiled,
        seconds=tuple(seconds),
        rates={unit: number / min(seconds) for unit, number in rates.items()},
        memory=memory.peak(),
    )


_KINDS = {"transport": measure_transport, "analytic": _analytic, "detect": _detect}


# Comparison

MARGIN = 0.03
"""Change of speed that a comparison ignores: processes differ by this much where the runs of one agree better."""

_CONFIDENCE = 0.99
_RESOLUTION = 0.1  # "same" is not said where the interval reaches beyond this change of speed
_TIMER = 1e-3  # the least relative scatter of a timed run: clocks are not better


@dataclass(frozen=True)
class Comparison:
    """One case now and before.

    Attributes:
        case: Its name.
        unit: What is counted: photons, frames or bins a second.
        before, now: Rate [1/s], geometric mean of the timed runs.
        spread_before, spread_now: Relative standard deviation of a timed run; None from one run.
        ratio: now / before; above 1 is faster.
        interval: Confidence interval of the ratio at 99 %; None where one side has a single run.
        verdict: "faster" or "slower" where the whole interval lies more than `MARGIN` from 1; else "same", or
            "unclear" where it reaches further than 10 % from 1.
    """

    case: str
    unit: str
    before: float
    now: float
    spread_before: float | None
    spread_now: float | None
    ratio: float
    interval: tuple[float, float] | None
    verdict: Literal["faster", "slower", "same", "unclear"]


def compare(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[Comparison]:
    """Compares two reports case by case, those that both have.

    Logarithms of rates are compared, so that a ratio is a difference, by the t-test of Welch (1947), which takes the
    scatter of either side as it is. It knows the noise between runs of one process alone; `MARGIN` stands for the rest.

    Args:
        now, before: From `report` or `load_report`.
    """
    earlier = {row["case"]: row for row in before["results"]}
    return [_compared(row, earlier[row["case"]]) for row in now["results"] if row["case"] in earlier]


def _compared(now: Mapping[str, Any], before: Mapping[str, Any]) -> Comparison:
    unit = next(iter(now["rates"]))
    new, old = _log_rates(now, unit), _log_rates(before, unit)
    interval = _interval(new, old)
    return Comparison(
        case=now["case"],
        unit=unit,
        before=math.exp(old.mean()),
        now=math.exp(new.mean()),
        spread_before=_spread(old),
        spread_now=_spread(new),
        ratio=math.exp(new.mean() - old.mean()),
        interval=interval,
        verdict=_verdict(interval),
    )


def _verdict(interval: tuple[float, float] | None) -> Literal["faster", "slower", "same", "unclear"]:
    if interval is None:
        return "unclear"
    low, high = interval
    if low > 1.0 + MARGIN:
        return "faster"
    if high < 1.0 / (1.0 + MARGIN):
        return "slower"
    return "same" if max(high, 1.0 / low) <= 1.0 + _RESOLUTION else "unclear"


def _log_rates(row: Mapping[str, Any], unit: str) -> NDArray[np.float64]:
    return np.asarray(np.log(row["size"][unit] / np.asarray(row["seconds"], dtype=np.float64)))


def _spread(log_rates: NDArray[np.float64]) -> float | None:
    return float(log_rates.std(ddof=1)) if log_rates.size > 1 else None


def _interval(new: NDArray[np.float64], old: NDArray[np.float64]) -> tuple[float, float] | None:
    """Of the ratio, from logarithms of rates; degrees of freedom by Welch and Satterthwaite."""
    from scipy.special import stdtrit

    if min(new.size, old.size) < 2:
        return None
    parts = [max(float(side.var(ddof=1)), _TIMER**2) / side.size for side in (new, old)]
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / (new.size - 1) + parts[1] ** 2 / (old.size - 1))
    half = float(stdtrit(freedom, 0.5 + 0.5 * _CONFIDENCE)) * math.sqrt(sum(parts))
    difference = float(new.mean() - old.mean())
    return math.exp(difference - half), math.exp(difference + half)


def history(directory: str | Path) -> list[tuple[Path, dict[str, Any]]]:
    """The reports (*.json) of a directory and their paths, oldest first. Raises `FileError`."""
    paths = sorted(Path(directory).glob("*.json"))
    if not paths:
        raise FileError(f"{directory}: holds no report (*.json) that `spadwarp bench --json` wrote")
    return sorted(((path, load_report(path)) for path in paths), key=lambda entry: str(entry[1]["provenance"]["date"]))


def newest_report(directory: str | Path, *, like: Mapping[str, Any], cases: Sequence[str]) -> Path:
    """The newest report of a directory with one of these cases, from the same kind of device.

    Args:
        directory: Of reports.
        like: Provenance of a report: `device_name` and `threads` count.
        cases: Names of cases.

    Raises:
        FileError: There is none.
    """
    for path, stored in reversed(history(directory)):
        made = stored["provenance"]
        same = all(made.get(name) == like[name] for name in ("device_name", "threads"))
        if same and any(row["case"] in cases for row in stored["results"]):
            return path
    threads = "" if like["threads"] is None else f" with {like['threads']} threads"
    raise FileError(f"{directory}: no report of {', '.join(cases)} from {like['device_name']}{threads}")
