"""Named benchmark cases: how fast this machine is, in numbers that can be kept and compared.

A case is a scene in a table, or a stage that is fed with made-up light; nothing outside the package is read. Kernels
are loaded, and one run is thrown away, before the clock starts; a launch ends when the device has finished it, and what
is copied to the host afterwards is not counted.
"""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.device import core_count, pick_device
from spadwarp.errors import ConfigError, FileError
from spadwarp.scene import Scene
from spadwarp.units import path_from_time, time_from_path

if TYPE_CHECKING:
    import warp as wp

    from spadwarp_kernels import Data, Model

__all__ = ["CASES", "GROUPS", "BenchResult", "Case", "load_report", "ratios", "report", "run"]

FORMAT, FORMAT_VERSION = "spadwarp bench", 1

# Photons of one timed run.
CUDA_PHOTONS = 1 << 26
CPU_PHOTONS_PER_CORE = 1 << 18

_PASS = 1 << 26  # the most that one launch takes
_CHECK_PHOTONS = 1 << 20  # whose terminal states are kept for the check of a mean
_SIGMAS = 4.0  # beyond which a check fails: one run in 16 000 if all is well


@dataclass(frozen=True)
class Case:
    """One thing to measure.

    Attributes:
        name: Its key.
        about: What it is, in a line.
        kind: "transport", "analytic" or "detect".
        scene: Tables of a scene, as `Scene.from_dict` takes them.
        estimator: The kernel's, in place of the scene's: "none" walks without a camera.
        photons: Of one run; None: what suits the device.
        absorbed: Absorbed fraction of the light that is known from elsewhere, and half its last digit.
        error: Whether to spend a run on the relative error.
        enough: Seconds of timed runs after which none is repeated.
    """

    name: str
    about: str
    kind: str = "transport"
    scene: Mapping[str, Any] = field(default_factory=dict)
    estimator: str | None = None
    photons: int | None = None
    absorbed: tuple[float, float] | None = None
    error: bool = True
    enough: float = math.inf


@dataclass(frozen=True, kw_only=True)
class BenchResult:
    """What a case gave.

    Attributes:
        case: Its name.
        device: "cpu", "cuda:0", ...
        threads: CPU threads; None on a GPU.
        faces: Triangles of the target.
        size: What one run did, by unit: photons; or frames, bins, pulses.
        setup: Seconds for meshes, BVH and arrays.
        compile: Seconds to compile the kernel or, if it was compiled before, to load it.
        seconds: Of each timed run.
        rates: Per second, from the fastest run: photons, collisions, queries (of surfaces, with shadow rays); or
            frames, bins.
        memory: Most memory of the device that the case held at a time [bytes]; None where Warp cannot tell (the CPU).
        tally_bytes: Of it the histograms, known everywhere; None without a camera.
        error_per_root_second: Relative standard error of the bins that decide the depth (`Result.relative_error`) after
            one second of transport, falling with the root of the time; None where it was not asked for or there is no
            camera, infinite where nothing returned.
        check: Where a mean is known from elsewhere: `name`, `value`, `standard_error`, `reference`, `passed`.
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


# ---- Cases

_WATER = {"extinction": 0.3, "albedo": 0.8, "anisotropy": 0.924, "group_index": "seawater"}


def _staircase(subdivisions: int = 0) -> list[dict[str, Any]]:
    """A plate of 4 x 4 m, its face at 5 m, and nine bars 0.1 to 0.6 m proud of it: ten boxes, 120 faces."""
    boxes = [((-2.0, -2.0), (2.0, 2.0), -0.1)]  # two corners, and how far it stands out
    for i in range(3):
        boxes += [
            ((-2.0 + 0.67 * i, -2.0), (-1.37 + 0.67 * i, 2.0), 0.6 - 0.1 * i),
            ((0.0, -2.0 + 0.7 * i), (2.0, -1.4 + 0.7 * i), 0.3 - 0.1 * i),
            ((0.67 * i, 0.0), (0.63 + 0.67 * i, 2.0), 0.3 - 0.1 * i),
        ]
    return [
        {
            "builtin": "box",
            "size": [right - left, bottom - top, abs(proud)],
            "subdivisions": subdivisions,
            "translation": [0.5 * (left + right), 0.5 * (top + bottom), 5.0 - 0.5 * proud],
            "reflectance": 0.5,
        }
        for (left, top), (right, bottom), proud in boxes
    ]


def _at_5m(targets: Sequence[Mapping[str, Any]] = (), estimator: str = "next_event", **camera: Any) -> dict[str, Any]:
    """A cone of 15° beside a camera of 30° in turbid water; bins of 2 cm of path."""
    bins = camera.pop("bins", 1024)
    return {
        "medium": _WATER,
        "laser": {"half_angle_deg": 15.0, "position": [-0.05, 0.0, 0.0]},
        "camera": {"width": 64, "height": 64, "horizontal_fov_deg": 30.0, "aperture_diameter": 0.02, **camera},
        "gate": {"bin_width_ps": 90.983, "bins": bins},
        "targets": list(targets),
        "transport": {"estimator": estimator, "max_collisions": 64, "weight_cutoff": 2e-4},
    }


def _confocal() -> dict[str, Any]:
    """A coaxial beam of 0.1° that visits the 64 x 64 pixels of the staircase in turn."""
    scene = _at_5m(_staircase(), "guided")
    transport = {**scene["transport"], "axis_threshold": 1.0}
    return {**scene, "laser": {"half_angle_deg": 0.1}, "scan": {"mode": "confocal"}, "transport": transport}


def _plane() -> dict[str, Any]:
    """A grey wall at 5 m in index 1, 16 bins of 0.8 m of path from 2 m on."""
    start, width = time_from_path(2.0, 1.0), time_from_path(0.8, 1.0)
    return {
        "medium": {**_WATER, "group_index": 1.0, "phase_index": 1.0},
        "laser": {"half_angle_deg": 2.5, "position": [-0.1, 0.0, 0.0]},
        "camera": {
            "width": 32,
            "height": 32,
            "horizontal_fov_deg": 10.0,
            "aperture_diameter": 2.0 * math.sqrt(1e-4 / math.pi),
        },
        "gate": {"start_ns": start * 1e9, "bin_width_ps": width * 1e12, "bins": 16},
        "targets": [{"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}],
        "transport": {"estimator": "guided", "max_collisions": 20, "weight_cutoff": 2e-4, "axis_threshold": 1.0},
    }


def _spheres() -> list[dict[str, Any]]:
    """Four by three balls of 81 920 faces each."""
    return [
        {
            "builtin": "sphere",
            "size": 0.75,
            "subdivisions": 3,
            "translation": [0.9 * (i - 1.5), 0.9 * (j - 1.0), 5.0],
            "reflectance": 0.5,
        }
        for j in range(3)
        for i in range(4)
    ]


def _cube60() -> dict[str, Any]:
    """MCX's benchmark of that name: a cube of 60 mm of scattering matter without reflections, a pencil beam, 5 ns."""
    return {
        "medium": {"absorption": 5.0, "scattering": 1000.0, "anisotropy": 0.01, "group_index": 1.37},
        "laser": {"profile": "collimated", "beam_radius": 0.0, "position": [0.029, 0.029, 0.0]},
        "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01},  # not used
        "gate": {"bin_width_ps": 5000.0, "bins": 1},
        "domain": {"shape": "box", "lower": 0.0, "upper": 0.06},
        "transport": {
            "max_path": path_from_time(5e-9, 1.37),
            "weight_cutoff": 0.0,
            "max_collisions": 2**31 - 1,
            "axis_threshold": 1.0,
        },
    }


def _cases() -> dict[str, Case]:
    listed = [
        Case("water", "41 m of water alone, next_event, 64 x 64 x 2048 bins", scene=_at_5m(bins=2048)),
        Case("water_20m", "20 m of it, 64 x 64 x 1024 bins", scene=_at_5m()),
        Case("plane_5m", "a wall at 5 m, guided, 32 x 32 x 16 bins", scene=_plane()),
        Case("staircase_5m", "the staircase at 5 m, next_event, 64 x 64 x 1024 bins", scene=_at_5m(_staircase())),
        Case("staircase_5m_guided", "the same, guided", scene=_at_5m(_staircase(), "guided")),
        Case("confocal", "the staircase, guided, 64 x 64 positions scanned by beam and pixel", scene=_confocal()),
        Case("staircase_5m_dense", "the same, next_event, more than 100 000 faces", scene=_at_5m(_staircase(5))),
        Case("spheres", "twelve spheres, a million faces in all, next_event", scene=_at_5m(_spheres())),
        Case(
            "cube60",
            "MCX's cube60: 60 mm, 78 collisions a photon, no camera",
            scene=_cube60(),
            estimator="none",
            # As MCX prints it for its benchmark cube60: 17.69 %.
            absorbed=(0.1769, 0.5e-4),
        ),
        Case(
            "analytic",
            "depth frames of 400 x 400 pixels from the analytic simulator",
            kind="analytic",
            scene=_at_5m(_staircase(), width=400, height=400),
        ),
        Case("detect", "first-photon counts of 1e6 pulses; a frame of 256 x 192 x 1024 bins on a GPU", kind="detect"),
    ]
    return {case.name: case for case in listed}


CASES: dict[str, Case] = _cases()
"""The cases by name."""


def _scaling(cuda: bool) -> list[Case]:
    """How cost and memory grow with photons, faces and bins; on a GPU further than on a CPU."""
    base = _at_5m(_staircase())
    box = {"builtin": "box", "size": [3.0, 3.0, 0.5], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}
    images = [(32, 32, 256), (64, 64, 1024), (128, 128, 1024), (256, 192, 1024), (256, 192, 4096)]
    cases = [
        *(
            Case(f"photons_1e{power}", f"staircase_5m, 1e{power} photons", scene=base, photons=10**power)
            for power in range(5, 11 if cuda else 8)
        ),
        *(
            Case(f"faces_{12 * 4**n}", f"a box of {12 * 4**n} faces", scene=_at_5m([{**box, "subdivisions": n}]))
            for n in (0, 2, 4, 6, 8)
        ),
        *(
            Case(
                f"bins_{width}x{height}x{bins}",
                f"staircase_5m into {width} x {height} x {bins} bins",
                scene=_at_5m(_staircase(), width=width, height=height, bins=bins),
            )
            for width, height, bins in (images if cuda else images[:3])
        ),
    ]
    return [replace(case, error=False, enough=2.0) for case in cases]


GROUPS: dict[str, Callable[[bool], list[Case]]] = {"scaling": _scaling}
"""Names that stand for several cases, which depend on whether the device is a GPU."""


# ---- Running them


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
        cases: Names out of `CASES`, or "scaling" for a table of how cost grows; by default all of `CASES`.
        device: As for `spadwarp.simulate`.
        photons: Of one timed run of a transport case, > 0; by default 2^26 on a GPU and 2^18 a core on a CPU.
            "analytic", "detect" and the cases of "scaling" named after their photons have sizes of their own.
        repeats: Timed runs of each case, > 0; rates are those of the fastest. Cases of "scaling" are not repeated
            once two seconds have been timed.
        progress: Called with each case before it is run.
        found: Called with each result as it comes.

    Raises:
        ConfigError: An unknown case, or a number out of range.
        DeviceError: A device that is not there, or too small for a case.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        if name not in CASES and name not in GROUPS:
            raise ConfigError(f"cases: {name!r} is not one of {', '.join([*CASES, *GROUPS])}")
    for option, value, high in (("photons", photons, 10**12), ("repeats", repeats, 1000)):
        if value is not None and not 1 <= value <= high:
            raise ConfigError(f"{option} = {value} is outside [1, {high}]")
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
        tally_bytes: Of the histograms; None without a camera.
    """

    def __init__(self, case: Case, device: wp.Device) -> None:
        import spadwarp_kernels as sk
        from spadwarp.mesh import build_mesh
        from spadwarp.transport.model import build_model, transport_spec

        scene = Scene.from_dict(case.scene)
        began = time.perf_counter()
        mesh = build_mesh(scene)
        blind = case.estimator == "none"
        self._model: Model = build_model(scene, device, mesh, camera=not blind)
        self._data: Data = sk.make_data(self._model)
        self._spec = transport_spec(scene, mesh, **({} if case.estimator is None else {"estimator": case.estimator}))
        _wait(device)
        ready = time.perf_counter()
        sk.load_transport_kernel(self._spec, device)
        self.setup, self.compile = ready - began, time.perf_counter() - ready
        self.faces = 0 if mesh is None else mesh.face_count
        self.tally_bytes = None if blind else 8 * self._model.tally_size

    def run(self, photons: int, *, first: int = 0) -> tuple[dict[str, int], dict[str, int], float]:
        """Ledger and counters of the photons with ids from `first` on, on a CPU with a thread for each core, and the
        seconds until the device had finished."""
        import spadwarp_kernels as sk

        def launch(start: int, stop: int) -> None:
            for at in range(start, stop, _PASS):
                sk.launch_transport(
                    self._spec, self._model, self._data, seed=0, first_id=at, photon_count=min(_PASS, stop - at)
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


def _transport(case: Case, device: wp.Device, photons: int | None, repeats: int) -> BenchResult:
    usual = CUDA_PHOTONS if device.is_cuda else CPU_PHOTONS_PER_CORE * core_count()
    photons = case.photons or photons or usual
    memory = _Memory(device)
    walk = TransportRun(case, device)
    walk.run(min(photons, 1 << 20))
    seconds: list[float] = []
    counts: list[dict[str, int]] = []
    while len(seconds) < repeats and sum(seconds) < case.enough:
        _, counters, took = walk.run(photons, first=len(seconds) * photons)
        seconds.append(took)
        counts.append(counters)
    fastest = min(range(len(seconds)), key=seconds.__getitem__)
    did = counts[fastest]
    rates = {
        "photons": photons / seconds[fastest],
        "collisions": (did["water_collisions"] + did["surface_events"]) / seconds[fastest],
        "queries": (did["surface_queries"] + did["shadow_queries"]) / seconds[fastest],
    }
    held = memory.peak()
    setup, compiled, faces, tally_bytes = walk.setup, walk.compile, walk.faces, walk.tally_bytes
    del walk  # and its histograms, before the next run makes its own
    scene = Scene.from_dict(case.scene)
    error = case.error and case.estimator != "none"
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
        memory=held,
        tally_bytes=tally_bytes,
        error_per_root_second=_error(scene, device, min(photons, usual), rates["photons"]) if error else None,
        check=None if case.absorbed is None else _absorbed(scene, device, photons, *case.absorbed),
    )


def _wait(device: wp.Device) -> None:
    import warp as wp

    wp.synchronize_device(device)


def _error(scene: Scene, device: wp.Device, photons: int, photons_per_second: float) -> float:
    """Relative error after a second at that rate; from a run of its own, since batches take time."""
    from spadwarp.transport.simulation import simulate

    result = simulate(scene, photons=max(photons, 2 * scene.scan_positions), device=device.alias, uncertainty=True)
    return result.relative_error * math.sqrt(result.photons / photons_per_second)


def _absorbed(scene: Scene, device: wp.Device, photons: int, reference: float, rounding: float) -> dict[str, Any]:
    from spadwarp.transport.records import trace

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
    """What a case holds on a GPU, over what was held before it."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device if device.is_cuda and device.is_mempool_supported else None
        self._before, self._high = self._read()

    def _read(self) -> tuple[int, int]:
        import warp as wp

        if self._device is None:
            return 0, 0
        return wp.get_mempool_used_mem_current(self._device), wp.get_mempool_used_mem_high(self._device)

    def peak(self) -> int | None:
        """[bytes]. Warp's high-water mark cannot be reset: where an earlier case set it, what is held now."""
        now, high = self._read()
        if self._device is None:
            return None
        return (high if high > self._high else now) - self._before


def _analytic(case: Case, device: wp.Device, _: int | None, repeats: int) -> BenchResult:
    from spadwarp.analytic.simulate import simulate_analytic
    from spadwarp.transport import truth_maps

    frames = 512 if device.is_cuda else 32
    scene = Scene.from_dict(case.scene)
    memory = _Memory(device)
    began = time.perf_counter()
    truth = truth_maps(scene, device=device.alias)
    ready = time.perf_counter()
    simulate_analytic(scene, truth=truth, frames=1, device=device.alias)
    compiled = time.perf_counter()
    seconds = []
    for seed in range(repeats):
        started = time.perf_counter()
        simulate_analytic(scene, truth=truth, frames=frames, seed=seed, device=device.alias)
        seconds.append(time.perf_counter() - started)
    return _stage(
        case, device, {"frames": frames}, ready - began, compiled - ready, seconds, memory, {"frames": frames}
    )


def _detect(case: Case, device: wp.Device, _: int | None, repeats: int) -> BenchResult:
    import warp as wp

    from spadwarp.frames.spad import detect
    from spadwarp.scene import Detector, Laser

    # A flat background with a return whose place and strength vary over the image.
    height, width, bins = (192, 256, 1024) if device.is_cuda else (24, 32, 1024)
    pulses, bin_width = 1_000_000, 100e-12
    memory = _Memory(device)
    began = time.perf_counter()
    row, column, k = np.ogrid[:height, :width, :bins]
    place = 300.0 + 400.0 * row / height
    light = 1e-5 + 0.01 * (1 + column) / width * np.exp(-0.5 * ((k - place) / 2.0) ** 2)
    source: Any = wp.array(light.astype(np.float32), dtype=wp.float32, device=device)
    options: dict[str, Any] = {
        "pulses": pulses,
        "detector": Detector(wrap=False),
        "laser": Laser(),
        "gate_start": 0.0,
        "bin_width": bin_width,
        "device": device,
    }
    ready = time.perf_counter()
    detect(source, seed=0, **options)
    _wait(device)
    compiled = time.perf_counter()
    seconds = []
    for seed in range(1, repeats + 1):
        started = time.perf_counter()
        detect(source, seed=seed, **options)
        _wait(device)
        seconds.append(time.perf_counter() - started)
    work = {"bins": height * width * bins, "frames": 1}
    return _stage(case, device, {**work, "pulses": pulses}, ready - began, compiled - ready, seconds, memory, work)


def _stage(
    case: Case,
    device: wp.Device,
    size: dict[str, int],
    setup: float,
    compiled: float,
    seconds: Sequence[float],
    memory: _Memory,
    work: Mapping[str, int],
) -> BenchResult:
    return BenchResult(
        case=case.name,
        device=device.alias,
        threads=None if device.is_cuda else 1,
        size=size,
        setup=setup,
        compile=compiled,
        seconds=tuple(seconds),
        rates={unit: number / min(seconds) for unit, number in work.items()},
        memory=memory.peak(),
    )


_KINDS = {"transport": _transport, "analytic": _analytic, "detect": _detect}


# ---- Keeping them


def report(results: Sequence[BenchResult]) -> dict[str, Any]:
    """Results in plain values, with what they were measured on: device, driver, versions, commit, date."""
    from spadwarp.transport.simulation import provenance

    device = pick_device(results[0].device if results else None)
    made = {**provenance(device), "driver": _driver() if device.is_cuda else None, "commit": _commit()}
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "provenance": {**made, "threads": None if device.is_cuda else core_count()},
        "results": [asdict(result) for result in results],
    }


def load_report(path: str | Path) -> dict[str, Any]:
    """Reads what `spadwarp bench --json` wrote. Raises `FileError`."""
    try:
        kept = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise FileError(f"{path}: not JSON: {error}") from error
    if not isinstance(kept, dict) or kept.get("format") != FORMAT or not isinstance(kept.get("results"), list):
        raise FileError(f"{path}: not a file that `spadwarp bench --json` wrote")
    if kept.get("format_version") != FORMAT_VERSION:
        raise FileError(f"{path}: format_version = {kept.get('format_version')} is not {FORMAT_VERSION}")
    needed = {one.name for one in fields(BenchResult)}
    for row in kept["results"]:
        if not isinstance(row, dict) or not needed <= row.keys():
            raise FileError(f"{path}: a result lacks one of {', '.join(sorted(needed))}")
    return kept


def ratios(results: Sequence[BenchResult], before: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Rates now over rates before, by case and unit, for the cases that both have; above 1 is faster now."""
    earlier = {row["case"]: row["rates"] for row in before["results"]}
    return {
        result.case: {
            unit: rate / earlier[result.case][unit]
            for unit, rate in result.rates.items()
            if earlier[result.case].get(unit)
        }
        for result in results
        if result.case in earlier
    }


def _driver() -> str | None:
    """Version of NVIDIA's driver, as the kernel module tells it."""
    try:
        words = Path("/proc/driver/nvidia/version").read_text().split()
    except OSError:
        return None
    return next((word for word in words if word[0].isdigit() and word.count(".") >= 1), None)


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
