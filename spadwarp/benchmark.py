"""How fast this machine is, in numbers that can be kept and compared: `run` measures named cases.

Kernels are loaded, and one run is discarded, before the clock starts; a launch ends when the device has finished it,
and later copies to the host are not counted.
"""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from spadwarp.analytic import simulate_analytic
from spadwarp.device import core_count, nvidia_driver, pick_device, processor_name
from spadwarp.frames import detect
from spadwarp.io.text import read_json, read_toml
from spadwarp.mesh import build_mesh
from spadwarp.scene import Detector, Laser, Scene
from spadwarp.transport import provenance, simulate, trace, truth_maps
from spadwarp.transport.model import build_model, transport_spec
from spadwarp.values import FileError, check_choice, check_integer, guarded

if TYPE_CHECKING:
    import warp as wp

__all__ = ["CASES", "GROUPS", "MARGIN", "BenchResult", "Case", "Comparison", "TransportRun", "compare", "history"]
__all__ += ["load_report", "newest_report", "report", "run"]


# Cases: scenes of benchmark.toml, or a stage that is given artificial light


@dataclass(frozen=True)
class Case:
    """One thing to measure."""

    name: str  # its key
    summary: str  # in one line
    kind: Literal["transport", "analytic", "detect"] = "transport"
    scene: Mapping[str, Any] = field(default_factory=dict)  # tables, as `Scene.from_dict` takes them
    estimator: str | None = None  # replaces the scene's: "none" traces photons without a camera
    photons: int | None = None  # of one run; None: chosen for the device
    absorbed: tuple[float, float] | None = None  # known absorbed fraction of the light, and half its last digit
    error: bool = True  # whether to use a run for the relative error
    time_limit: float = math.inf  # seconds of timed runs after which none is repeated


_SCENES = read_toml(Path(__file__).with_name("benchmark.toml"))


def _at_5m(targets: str | None = None, **changes: Mapping[str, Any]) -> dict[str, Any]:
    """The scene with a cone beside a camera in turbid water, its targets by name, and other fields of its sections."""
    chosen = _SCENES["targets"][targets] if targets else []
    return Scene.merged({**_SCENES["at_5m"], "targets": chosen}, changes)


_GUIDED: dict[str, Any] = {"estimator": "guided", "points_per_flight": 1}  # as in the history of their speed
_COAXIAL = {"half_angle_deg": 0.1, "position": [0.0, 0.0, 0.0]}
_STAIRCASE = _at_5m("staircase")
_DENSE = Scene.merged(_STAIRCASE, {"targets": {index: {"subdivisions": 5} for index in range(10)}})
_CONFOCAL = _at_5m("staircase", laser=_COAXIAL, scan={"mode": "confocal"}, transport={**_GUIDED, "axis_threshold": 1.0})

CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("water", "41 m of water alone, next_event, 64 x 64 x 2048 bins", scene=_at_5m(gate={"bins": 2048})),
        Case("water_20m", "20 m of water alone, 64 x 64 x 1024 bins", scene=_at_5m()),
        Case("plane_5m", "a wall at 5 m, guided, 32 x 32 x 16 bins", scene=_SCENES["plane_5m"]),
        Case("staircase_5m", "a staircase at 5 m, next_event, 64 x 64 x 1024 bins", scene=_STAIRCASE),
        Case("staircase_5m_guided", "the same, guided", scene=_at_5m("staircase", transport=_GUIDED)),
        Case("confocal", "the staircase, guided, 64 x 64 positions scanned by beam and pixel", scene=_CONFOCAL),
        Case("staircase_5m_dense", "the same, next_event, more than 100 000 faces", scene=_DENSE),
        Case("spheres", "twelve spheres, a million faces in all, next_event", scene=_at_5m("spheres")),
        replace(
            Case(
                "cube60",
                "MCX's cube60: 60 mm, 78 collisions a photon, no camera",
                scene=_SCENES["cube60"],
                estimator="none",
            ),
            absorbed=(0.1769, 0.5e-4),  # as MCX prints it: 17.69 %
        ),
        Case(
            "analytic",
            "depth frames of 400 x 400 pixels from the analytic simulator",
            "analytic",
            _at_5m("staircase", camera={"width": 400, "height": 400}),
        ),
        Case("detect", "first-photon counts of 1e6 pulses; a frame of 256 x 192 x 1024 bins on a GPU", "detect"),
    )
}
"""The cases by name."""


def _scaling(cuda: bool) -> list[Case]:
    """How cost and memory grow with photons, faces and bins; to larger sizes on a GPU than on a CPU."""
    images = [(32, 32, 256), (64, 64, 1024), (128, 128, 1024), (256, 192, 1024), (256, 192, 4096), (4096, 4096, 8)]
    cases = [
        Case(f"photons_1e{power}", f"staircase_5m, 1e{power} photons", scene=_STAIRCASE, photons=10**power)
        for power in range(5, 11 if cuda else 8)
    ]
    for n in (0, 2, 4, 6, 8, 10)[: 6 if cuda else 5]:
        faces, scene = 12 * 4**n, Scene.merged(_at_5m("box"), {"targets": {0: {"subdivisions": n}}})
        cases.append(Case(f"faces_{faces}", f"a box of {faces} faces", scene=scene))
    for width, height, bins in images if cuda else images[:3]:
        scene = _at_5m("staircase", camera={"width": width, "height": height}, gate={"bins": bins})
        text = f"staircase_5m into {width} x {height} x {bins} bins"
        cases.append(Case(f"bins_{width}x{height}x{bins}", text, scene=scene))
    return [replace(case, error=False, time_limit=2.0) for case in cases]


GROUPS: dict[str, Callable[[bool], list[Case]]] = {"scaling": _scaling}
"""Names that stand for several cases, which depend on whether the device is a GPU."""


# Results and their file

FORMAT, FORMAT_VERSION = "spadwarp bench", 1


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """What was measured in a case."""

    case: str  # its name
    device: str  # "cpu", "cuda:0", ...
    threads: int | None  # of the CPU; None on a GPU
    faces: int = 0  # triangles of the target
    size: dict[str, int]  # work of one run by unit: photons; or frames, bins, pulses
    setup: float  # seconds for meshes, BVH and arrays
    compile: float  # seconds to compile the kernel or, if it was compiled before, to load it
    seconds: tuple[float, ...]  # of each timed run
    rates: dict[str, float]  # per second, from the fastest run: photons, collisions, queries; or frames, bins
    memory: int | None = None  # most of the device that the case used [bytes]; None on the CPU: Warp does not count it
    tally_bytes: int | None = None  # of the histograms; None without a camera
    error_per_root_second: float | None = None
    """Relative standard error of the bins that decide the depth (`Result.relative_error`) after one second of
    transport; it falls with the root of the time. None where it was not asked for, infinite where nothing returned."""
    check: dict[str, Any] | None = None
    """Where a mean is known: `name`, `value`, `standard_error`, `reference`, `passed`."""


def report(results: Sequence[BenchResult]) -> dict[str, Any]:
    """Results as plain values, with device, processor, driver, versions, commit and date."""
    device = pick_device(results[0].device if results else None)
    made = {**provenance(device), "driver": nvidia_driver() if device.is_cuda else None, "commit": _commit()}
    made |= {"processor": processor_name(pick_device("cpu")), "threads": None if device.is_cuda else core_count()}
    rows = [asdict(result) for result in results]
    return {"format": FORMAT, "format_version": FORMAT_VERSION, "provenance": made, "results": rows}


def load_report(path: str | Path) -> dict[str, Any]:
    """Reads what `spadwarp bench --json` wrote. Raises `FileError`."""
    stored = read_json(path)
    if not isinstance(stored, dict) or stored.get("format") != FORMAT or not isinstance(stored.get("results"), list):
        raise FileError(f"{path}: not a file that `spadwarp bench --json` wrote")
    if (version := stored.get("format_version")) != FORMAT_VERSION:
        raise FileError(f"{path}: format_version = {version} is not {FORMAT_VERSION}")
    needed = {field.name for field in fields(BenchResult)}
    if any(not isinstance(row, dict) or not needed <= row.keys() for row in stored["results"]):
        raise FileError(f"{path}: a result lacks one of {', '.join(sorted(needed))}")
    return stored


def _commit() -> str | None:
    """The commit of the checkout that this package lies in, "-dirty" where it was changed; None outside one."""
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root:
            return None
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


# Runs

CUDA_PHOTONS, CPU_PHOTONS_PER_CORE = 1 << 26, 1 << 18  # of one timed run
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
        progress, found: Called with each case before it is run, and with each result.

    Raises `ArgumentError`: an unknown case, or a number out of range; `DeviceError`: no such device, or one that is too
    small for a case.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        check_choice("cases", name, [*CASES, *GROUPS])
    photons = None if photons is None else check_integer("photons", photons, "[1, 1000000000000]")
    repeats = check_integer("repeats", repeats, "[1, 1000]")
    wp_device = pick_device(device)
    results = []
    for name in names:
        for case in GROUPS[name](wp_device.is_cuda) if name in GROUPS else [CASES[name]]:
            if progress is not None:
                progress(case)
            results.append(measure(case, wp_device, photons, repeats))
            if found is not None:
                found(results[-1])
    return results


def measure(case: Case, device: wp.Device, photons: int | None, repeats: int) -> BenchResult:
    """One case; see `run`."""
    before = _memory(device)
    facts, run_number = _STAGES[case.kind](case, device, photons)
    runs: list[tuple[dict[str, int], float]] = []
    while len(runs) < repeats and sum(seconds for _, seconds in runs) < case.time_limit:
        runs.append(run_number(len(runs)))
    work, fastest = min(runs, key=lambda timed: timed[1])
    rates, memory = {unit: number / fastest for unit, number in work.items()}, None
    if before is not None and (after := _memory(device)) is not None:
        # Warp cannot reset its maximum: where an earlier case reached it, the memory that is used now.
        memory = (after[1] if after[1] > before[1] else after[0]) - before[0]
    size, tally_bytes = facts["size"], facts.get("tally_bytes")
    del run_number  # and its histograms, before the next run makes its own
    error = check = None
    if case.error and tally_bytes is not None:  # from a separate run, whose photons are counted in batches
        scene = Scene.from_dict(case.scene)
        photons = max(min(size["photons"], _usual_photons(device)), 2 * scene.scan_positions)
        result = simulate(scene, photons=photons, device=device.alias)
        error = result.relative_error * math.sqrt(result.photons / rates["photons"])
    if case.absorbed is not None:
        check = _absorbed(case, device, size["photons"], *case.absorbed)
    return BenchResult(
        case=case.name,
        device=device.alias,
        threads=None if device.is_cuda else facts.pop("threads", core_count()),
        seconds=tuple(seconds for _, seconds in runs),
        rates=rates,
        memory=memory,
        error_per_root_second=error,
        check=check,
        **facts,
    )


def _usual_photons(device: wp.Device) -> int:
    return CUDA_PHOTONS if device.is_cuda else CPU_PHOTONS_PER_CORE * core_count()


def _memory(device: wp.Device) -> tuple[int, int] | None:
    """Memory of a GPU that is used, and the most that was [bytes]; None where Warp does not count it."""
    import warp as wp

    if not (device.is_cuda and device.is_mempool_supported):
        return None
    return wp.get_mempool_used_mem_current(device), wp.get_mempool_used_mem_high(device)


def _timed(device: wp.Device, work: Callable[[], Any]) -> tuple[Any, float]:
    """What some work returns, and the seconds until the device has finished it."""
    import warp as wp

    wp.synchronize_device(device)
    began = time.perf_counter()
    result = work()
    wp.synchronize_device(device)
    return result, time.perf_counter() - began


def _absorbed(case: Case, device: wp.Device, photons: int, reference: float, rounding: float) -> dict[str, Any]:
    scene = Scene.from_dict(case.scene)
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


# Stages: each is set up and compiled; returns what `BenchResult` has of that, and a function that does the timed run of
# a number and returns its work by unit, and seconds.

_Stage = tuple[dict[str, Any], Callable[[int], tuple[dict[str, int], float]]]


class TransportRun:
    """A transport case on a device, set up and compiled; `setup`, `compile`, `faces` and `tally_bytes` as in
    `BenchResult`."""

    def __init__(self, case: Case, device: wp.Device) -> None:
        import warp as wp

        import spadwarp_kernels as sk

        scene = Scene.from_dict(case.scene)
        began = time.perf_counter()
        mesh = build_mesh(scene)
        self._spec = transport_spec(scene, mesh, **({} if case.estimator is None else {"estimator": case.estimator}))
        scores = sk.ESTIMATORS[self._spec.estimator](self._spec).scores  # else photons travel without a camera
        self._model = build_model(scene, device, mesh, camera=scores)
        self._data = sk.make_data(self._model)
        wp.synchronize_device(device)
        ready = time.perf_counter()
        sk.load_transport_kernel(self._spec, device)
        self.setup, self.compile = ready - began, time.perf_counter() - ready
        self.faces = 0 if mesh is None else mesh.face_count
        self.tally_bytes = 8 * self._model.tally_size if scores else None

    def run(self, photons: int, *, first: int = 0) -> tuple[dict[str, int], dict[str, int], float]:
        """Ledger and counters of the photons with ids from `first` on, on a CPU with a thread for each core, and the
        seconds until the device had finished."""
        import spadwarp_kernels as sk

        device = self._model.device
        workers = 1 if device.is_cuda else min(core_count(), photons)
        edges = [first + photons * i // workers for i in range(workers + 1)]

        def launch(start: int, stop: int) -> None:
            for at in range(start, stop, _LAUNCH):
                sk.launch_transport(
                    self._spec, self._model, self._data, seed=0, first_id=at, photon_count=min(_LAUNCH, stop - at)
                )

        def launch_all() -> None:
            if workers == 1:
                return launch(first, first + photons)
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(launch, edges[:-1], edges[1:]))

        self._data.ledger.zero_()
        _, seconds = _timed(device, launch_all)
        return (*sk.read_ledger(self._data), seconds)


def _transport(case: Case, device: wp.Device, photons: int | None) -> _Stage:
    photons = case.photons or photons or _usual_photons(device)
    traced = TransportRun(case, device)
    traced.run(min(photons, _LAUNCH if device.is_cuda else 1 << 20))  # a GPU's kernel may depend on the number

    def timed_run(number: int) -> tuple[dict[str, int], float]:
        _, counted, seconds = traced.run(photons, first=number * photons)
        work = {
            "photons": photons,
            "collisions": counted["water_collisions"] + counted["surface_events"],
            "queries": counted["surface_queries"] + counted["shadow_queries"],
        }
        return work, seconds

    facts = {name: getattr(traced, name) for name in ("setup", "compile", "faces", "tally_bytes")}
    return {**facts, "size": {"photons": photons}}, timed_run


def _alone(device: wp.Device, setup: float, work: Callable[[int], Any], rates: dict[str, int], **size: int) -> _Stage:
    """A stage on one thread, whose run of any number does the work of `rates`."""
    _, compiled = _timed(device, lambda: work(0))
    facts = {"setup": setup, "compile": compiled, "size": {**rates, **size}, "threads": 1}
    return facts, lambda number: (rates, _timed(device, lambda: work(number + 1))[1])


def _analytic(case: Case, device: wp.Device, _: int | None) -> _Stage:
    scene, frames = Scene.from_dict(case.scene), 512 if device.is_cuda else 32
    truth, setup = _timed(device, lambda: truth_maps(scene, device=device.alias))

    def work(number: int) -> None:
        simulate_analytic(scene, truth=truth, frames=frames if number else 1, seed=number, device=device.alias)

    return _alone(device, setup, work, {"frames": frames})


def _detect(case: Case, device: wp.Device, _: int | None) -> _Stage:
    import warp as wp

    # A flat background, and a return whose time and strength vary over the image.
    began, pulses = time.perf_counter(), 1_000_000
    height, width, bins = (192, 256, 1024) if device.is_cuda else (24, 32, 1024)
    row, column, k = np.ogrid[:height, :width, :bins]
    centre = 300.0 + 400.0 * row / height
    light = 1e-5 + 0.01 * (1 + column) / width * np.exp(-0.5 * ((k - centre) / 2.0) ** 2)
    source: Any = wp.array(light.astype(np.float32), dtype=wp.float32, device=device)
    options: dict[str, Any] = {"detector": Detector(wrap=False), "laser": Laser(), "gate_start": 0.0}
    options |= {"bin_width": 100e-12, "pulses": pulses, "device": device}
    wp.synchronize_device(device)

    def work(number: int) -> None:
        detect(source, seed=number, **options)

    rates = {"bins": height * width * bins, "frames": 1}
    return _alone(device, time.perf_counter() - began, work, rates, pulses=pulses)


_STAGES = {"transport": _transport, "analytic": _analytic, "detect": _detect}


# Comparison

MARGIN = 0.03
"""Change of speed that a comparison ignores: processes differ by this much where the runs of one agree better."""

_CONFIDENCE = 0.99
_RESOLUTION = 0.1  # "same" is not said where the interval reaches beyond this change of speed
_TIMER = 1e-3  # the least relative scatter of a timed run: clocks are not better


@dataclass(frozen=True)
class Comparison:
    """One case now and before."""

    case: str  # its name
    unit: str  # what is counted: photons, frames or bins a second
    before: float  # rate [1/s], geometric mean of the timed runs
    now: float
    spread_before: float | None  # relative standard deviation of a timed run; None from one run
    spread_now: float | None
    ratio: float  # now / before; above 1 is faster
    interval: tuple[float, float] | None  # of the ratio at 99 % confidence; None where one side has a single run
    verdict: Literal["faster", "slower", "same", "unclear"]
    """"faster" or "slower" where the whole interval lies more than `MARGIN` from 1; else "same", or "unclear" where it
    reaches further than 10 % from 1."""


def compare(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[Comparison]:
    """Compares two reports, of `report` or `load_report`, case by case, those that both have.

    Logarithms of rates are compared, so that a ratio is a difference, by the t-test of Welch (1947), which takes the
    scatter of either side as it is. It knows the noise between runs of one process alone; `MARGIN` stands for the rest.
    """
    earlier = {row["case"]: row for row in before["results"]}
    return [_compared(row, earlier[row["case"]]) for row in now["results"] if row["case"] in earlier]


def _compared(now: Mapping[str, Any], before: Mapping[str, Any]) -> Comparison:
    from scipy.special import stdtrit

    unit = next(iter(now["rates"]))
    new, old = sides = [np.log(row["size"][unit] / np.asarray(row["seconds"], np.float64)) for row in (now, before)]
    difference, interval = float(new.mean() - old.mean()), None
    verdict: Literal["faster", "slower", "same", "unclear"] = "unclear"
    if min(new.size, old.size) > 1:
        # Degrees of freedom by Welch and Satterthwaite.
        parts = [max(float(side.var(ddof=1)), _TIMER**2) / side.size for side in sides]
        freedom = sum(parts) ** 2 / sum(part**2 / (side.size - 1) for part, side in zip(parts, sides, strict=True))
        half = float(stdtrit(freedom, 0.5 + 0.5 * _CONFIDENCE)) * math.sqrt(sum(parts))
        low, high = interval = math.exp(difference - half), math.exp(difference + half)
        if low > 1.0 + MARGIN:
            verdict = "faster"
        elif high < 1.0 / (1.0 + MARGIN):
            verdict = "slower"
        elif max(high, 1.0 / low) <= 1.0 + _RESOLUTION:
            verdict = "same"
    spread_before, spread_now = (float(side.std(ddof=1)) if side.size > 1 else None for side in (old, new))
    rates = math.exp(old.mean()), math.exp(new.mean())
    return Comparison(now["case"], unit, *rates, spread_before, spread_now, math.exp(difference), interval, verdict)


def history(directory: str | Path) -> list[tuple[Path, dict[str, Any]]]:
    """The reports (*.json) of a directory and their paths, oldest first. Raises `FileError`."""
    paths = sorted(Path(directory).glob("*.json"))
    if not paths:
        raise FileError(f"{directory}: holds no report (*.json) that `spadwarp bench --json` wrote")
    return sorted(((path, load_report(path)) for path in paths), key=lambda entry: str(entry[1]["provenance"]["date"]))


def newest_report(directory: str | Path, *, like: Mapping[str, Any], cases: Sequence[str]) -> Path:
    """The newest report of a directory with one of these cases, from a device as that of a report's provenance `like`
    (`device_name` and `threads`). Raises `FileError` if there is none."""
    for path, stored in reversed(history(directory)):
        made = stored["provenance"]
        same = all(made.get(name) == like[name] for name in ("device_name", "threads"))
        if same and any(row["case"] in cases for row in stored["results"]):
            return path
    threads = "" if like["threads"] is None else f" with {like['threads']} threads"
    raise FileError(f"{directory}: no report of {', '.join(cases)} from {like['device_name']}{threads}")


guarded(__name__)
