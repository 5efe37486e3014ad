"""`spadwarp.doctor`: what is installed and seen, what a GPU would need, and a test against known values."""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import math
import os
import platform
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spadwarp.device import devices, pick_device
from spadwarp.scene import Scene

__all__ = ["Diagnosis", "SelfTest", "doctor"]

NEEDED = (
    "warp-lang", "numpy", "scipy", "trimesh", "manifold3d", "OpenEXR", "pydantic", "typer", "rich", "h5py",
    "matplotlib", "tomli-w", "PyYAML", "jinja2",
)  # fmt: skip

# Package → extra that brings it.
OPTIONAL = {
    "torch": "torch", "ray": "ray", "bmnd": "bm3d", "ptufile": "formats", "plotly": "view", "imageio-ffmpeg": "video",
}  # fmt: skip

_OLDEST_CUDA = 13000  # of the driver: what Warp's build asks for, R580
_LARGEST_Z = 4.5  # a right simulator fails once in 150 000 times

# A pencil beam straight on a plate, seen by one pixel through turbid water.
_PLATE = """
[medium]
extinction = 0.5
albedo = 0.8
anisotropy = 0.924
[laser]
profile = "collimated"
beam_radius = 0.0
position = [0.0, 0.0, 0.0]
[camera]
width = 1
height = 1
horizontal_fov_deg = 10.0
aperture_diameter = 0.01
[gate]
start_ns = 17.0
bin_width_ps = 500.0
bins = 8
[[targets]]
builtin = "plane"
size = [4.0, 4.0]
translation = [0.0, 0.0, 2.0]
reflectance = 0.5
[transport]
axis_threshold = 1.0
"""

# Index-matched slab, normal incidence, g 0.75, albedo 0.9, optical depth 2 (van de Hulst, Multiple Light Scattering,
# 1980).
_SLAB = """
[medium]
extinction = 1.0
albedo = 0.9
anisotropy = 0.75
[laser]
profile = "collimated"
beam_radius = 0.0
[domain]
shape = "slab"
lower = [0.0, 0.0, 0.0]
upper = [0.0, 0.0, 2.0]
[camera]
width = 1
height = 1
horizontal_fov_deg = 1.0
aperture_diameter = 0.01
[gate]
start_ns = 0.0
bin_width_ps = 1e6
bins = 1
[transport]
axis_threshold = 1.0
termination = "roulette"
weight_cutoff = 0.05
"""
_REFLECTED, _TRANSMITTED = 0.09739, 0.66096
_ROUNDING = 5e-6  # of the published values


@dataclass(frozen=True)
class SelfTest:
    """A measured value beside what it should be.

    Attributes:
        name: What was measured.
        value: By the simulator.
        reference: Known without it.
        standard_error: Of the value.
        passed: Whether they differ by less than 4.5 standard errors.
    """

    name: str
    value: float
    reference: float
    standard_error: float
    passed: bool


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What `doctor` found.

    Attributes:
        facts: Section → name → value, in words.
        gpu: Why no GPU is used and what to do about it; empty with one.
        problems: What keeps spadwarp from working.
        tests: The self-test, empty if it was not run.
        seconds: Which it took: `compile` or load the kernels, `run`.
    """

    facts: dict[str, dict[str, str]]
    gpu: list[str]
    problems: list[str]
    tests: list[SelfTest]
    seconds: dict[str, float]

    @property
    def healthy(self) -> bool:
        """Nothing is in the way and every test passed; a machine without a GPU can be healthy."""
        return not self.problems and all(test.passed for test in self.tests)


def doctor(
    *, device: str | None = None, self_test: bool = True, progress: Callable[[str], None] | None = None
) -> Diagnosis:
    """Looks at the installation and the devices, and traces two small scenes whose answer is known.

    Args:
        device: For the self-test; by default the first GPU, else the CPU.
        self_test: A few seconds, and as many again the first time to compile the kernels.
        progress: Called with what is being done.

    Raises:
        DeviceError: No such device.
    """
    chosen = pick_device(device)
    problems: list[str] = []
    packages = _packages(problems)
    cache = _cache(problems)
    tests: list[SelfTest] = []
    seconds: dict[str, float] = {}
    if self_test:
        tests, seconds = _self_test(chosen.alias, progress or (lambda _: None))
    return Diagnosis(
        facts={
            "System": _system(),
            "Packages": packages,
            "Devices": {one["name"]: _described(one) for one in devices()},
            "Kernel cache": cache,
        },
        gpu=_missing_for_a_gpu(),
        problems=problems,
        tests=tests,
        seconds=seconds,
    )


# What there is


def _system() -> dict[str, str]:
    import warp as wp

    import spadwarp

    toolkit, driver = wp.get_cuda_toolkit_version(), _cuda_of_driver()
    return {
        "spadwarp": f"{spadwarp.__version__}, in {Path(spadwarp.__file__).parent}",
        "Python": f"{platform.python_version()} on {platform.platform()}",
        "CUDA of Warp": ".".join(map(str, toolkit)) if toolkit else "none",
        "NVIDIA driver": _driver_release() or ("seen" if driver else "none"),
        "CUDA of the driver": f"{driver // 1000}.{driver % 1000 // 10}" if driver else "none",
    }


def _packages(problems: list[str]) -> dict[str, str]:
    found = {}
    for name in NEEDED:
        found[name] = _version(name) or "MISSING"
        if found[name] == "MISSING":
            problems.append(f"{name} is not installed: pip install spadwarp")
    for name, extra in OPTIONAL.items():
        found[name] = _version(name) or f"not installed (optional: pip install 'spadwarp[{extra}]')"
    return found


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _described(device: dict[str, Any]) -> str:
    parts = [device["description"]]
    if device["memory"]:
        parts.append(f"{device['memory'] / 2**30:.1f} GiB")
    if device["compute_capability"]:
        parts.append(f"compute capability {device['compute_capability']}")
    return ", ".join(parts) + (" (default)" if device["default"] else "")


def _cache(problems: list[str]) -> dict[str, str]:
    import warp as wp

    folder = Path(str(wp.config.kernel_cache_dir))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        writable = "yes"
    except OSError as error:
        writable = "NO"
        problems.append(f"the kernel cache {folder} cannot be written ({error.strerror}): set WARP_CACHE_PATH")
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
    modules = sum(1 for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else 0
    return {
        "folder": str(folder),
        "holds": f"{modules} kernel modules, {sum(sizes) / 2**20:.1f} MiB",
        "writable": writable,
    }


def _cuda_of_driver() -> int | None:
    """1000 · major + 10 · minor of the newest CUDA that the driver runs; None without a driver."""
    for library in ("nvcuda.dll",) if os.name == "nt" else ("libcuda.so.1", "libcuda.so"):
        try:
            driver = ctypes.CDLL(library)
        except OSError:
            continue
        version = ctypes.c_int()
        return version.value if driver.cuDriverGetVersion(ctypes.byref(version)) == 0 else None
    return None


def _driver_release() -> str | None:
    """Such as 580.65.06, where Linux tells."""
    try:
        words = Path("/proc/driver/nvidia/version").read_text().split()
    except OSError:
        return None
    return next((word for word in words if word[0].isdigit() and word.count(".") >= 1), None)


def _missing_for_a_gpu() -> list[str]:
    import warp as wp

    if wp.is_cuda_available():
        return []
    if not wp.get_cuda_toolkit_version():
        return ["this build of Warp has no CUDA; the wheels for Linux and Windows on x86-64 and Linux on ARM have it"]
    version = _cuda_of_driver()
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
    if version is None:
        if Path("/proc/driver/nvidia").exists() or Path("/dev/nvidiactl").exists():
            return [
                "the system has an NVIDIA driver, but its library libcuda is not in reach: in a container start with "
                "--gpus all (NVIDIA Container Toolkit)"
            ]
        return ["no NVIDIA driver: a GPU of NVIDIA needs driver R580 or newer; without one everything runs on the CPU"]
    if version < _OLDEST_CUDA:
        return [f"the driver runs CUDA {version // 1000}.{version % 1000 // 10}; Warp needs 13.0: driver R580 or newer"]
    if hidden is not None and not hidden.strip("-1 "):
        return [f"CUDA_VISIBLE_DEVICES = {hidden!r} hides the GPUs"]
    return ["the driver is there and sees no GPU: look at what `nvidia-smi` says"]


# The self-test


def _self_test(device: str, progress: Callable[[str], None]) -> tuple[list[SelfTest], dict[str, float]]:
    import spadwarp

    plate, slab = (Scene.from_dict(tomllib.loads(text)) for text in (_PLATE, _SLAB))
    progress("loading kernels; the first time they are compiled")
    began = time.perf_counter()
    spadwarp.simulate(plate, photons=1, seed=1, device=device)
    spadwarp.transport.trace(slab, photons=1, seed=1, device=device)
    ready = time.perf_counter()
    progress("tracing")
    photons = 400_000
    result = spadwarp.simulate(plate, photons=photons, seed=1, device=device)
    records = spadwarp.transport.trace(slab, photons=photons, seed=1, device=device)
    seconds = {"compile": ready - began, "run": time.perf_counter() - ready}

    # Photons that arrive without a collision are a binomial part of all; each gives Γ A / (π z²) exp(−c z) to the lens.
    there = math.exp(-plate.medium.extinction * 2.0)
    returned = 0.5 / math.pi * plate.camera.aperture_area / 2.0**2 * there
    ballistic = float(result.component("ballistic").sum()) / returned
    tests = [_compared("light straight from the plate", ballistic, there, math.sqrt(there * (1 - there) / photons))]
    for name, face, reference in (
        ("reflected by the slab", "exit_z_low", _REFLECTED),
        ("let through by the slab", "exit_z_high", _TRANSMITTED),
    ):
        weight = records.weight * records.ended(face)
        error = float(weight.std()) / math.sqrt(photons)
        tests.append(_compared(name, float(weight.mean(dtype=float)), reference, math.hypot(error, _ROUNDING)))
    difference = float(result.ledger_report()["difference"])
    tests.append(SelfTest("energy that is unaccounted for", difference, 0.0, 0.0, difference == 0))
    return tests, seconds


def _compared(name: str, value: float, reference: float, standard_error: float) -> SelfTest:
    return SelfTest(name, value, reference, standard_error, abs(value - reference) < _LARGEST_Z * standard_error)
