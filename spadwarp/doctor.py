"""The packages and devices that are found, what a GPU would need, and a test against known values: `diagnose`."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import math
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spadwarp.device import cuda_driver, devices, nvidia_driver, pick_device
from spadwarp.scene import Scene
from spadwarp.transport import simulate
from spadwarp.validate import references
from spadwarp.validate.cases import PENCIL, CaseResult, Estimate, Quantity, Run, judged, scene, slab_faces
from spadwarp.values import EXTRAS, __version__, guarded

__all__ = ["Diagnosis", "diagnose"]

NEEDED = ["warp-lang", "numpy", "scipy", "trimesh", "manifold3d", "OpenEXR", "pydantic", "typer", "h5py", "matplotlib"]
NEEDED += ["tomli-w", "PyYAML", "jinja2"]

_OLDEST_CUDA = 13000  # of the driver, R580: the CUDA that Warp is built with


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What `diagnose` found."""

    facts: dict[str, dict[str, str]]  # section → name → value, as text
    gpu: list[str]  # why no GPU is used and what to do about it; empty with a GPU
    problems: list[str]  # what keeps spadwarp from working
    tests: list[CaseResult]  # empty if they were not run
    seconds: dict[str, float]  # of the self-test: `compile` (or load) the kernels, `run`

    @property
    def healthy(self) -> bool:
        """Whether there is no problem and every test passed; a machine without a GPU can be healthy."""
        return not self.problems and all(test.passed for test in self.tests)


def diagnose(
    *, device: str | None = None, self_test: bool = True, progress: Callable[[str], None] | None = None
) -> Diagnosis:
    """Checks the installation and the devices, and traces two small scenes whose answer is known.

    Args:
        device: For the self-test; by default the first GPU, else the CPU.
        self_test: Whether to run it: a few seconds, and as many again the first time to compile the kernels.
        progress: Called with the name of each step.

    Raises `DeviceError`: no such device.
    """
    chosen = pick_device(device)
    problems: list[str] = []
    packages, cache = _packages(problems), _cache(problems)
    tests, seconds = _run_self_test(chosen.alias, progress or (lambda _: None)) if self_test else ([], {})
    found = {entry["name"]: _device_text(entry) for entry in devices()}
    facts = {"System": _system(), "Packages": packages, "Devices": found, "Kernel cache": cache}
    return Diagnosis(facts=facts, gpu=_gpu_reasons(), problems=problems, tests=tests, seconds=seconds)


def _system() -> dict[str, str]:
    import warp as wp

    toolkit, driver = wp.get_cuda_toolkit_version(), _driver_cuda()
    return {
        "spadwarp": f"{__version__}, in {Path(__file__).parent}",
        "Python": f"{platform.python_version()} on {platform.platform()}",
        "CUDA of Warp": ".".join(map(str, toolkit)) if toolkit else "none",
        "NVIDIA driver": nvidia_driver() or ("found" if driver else "none"),
        "CUDA of the driver": _dotted(driver) if driver else "none",
    }


def _packages(problems: list[str]) -> dict[str, str]:
    found = {}
    for name in (*NEEDED, *EXTRAS):
        try:
            found[name] = importlib.metadata.version(name if name != "pxr" else "usd-core")
        except importlib.metadata.PackageNotFoundError:
            extra = EXTRAS.get(name)
            found[name] = f"not installed (optional: pip install 'spadwarp[{extra}]')" if extra else "MISSING"
            problems += [] if extra else [f"{name} is not installed: pip install spadwarp"]
    return found


def _device_text(device: dict[str, Any]) -> str:
    memory, capability = device["memory"], device["compute_capability"]
    size = f", {memory / 2**30:.1f} GiB" if memory else ""
    newest = f", compute capability {capability}" if capability else ""
    return f"{device['description']}{size}{newest}{' (default)' if device['default'] else ''}"


def _cache(problems: list[str]) -> dict[str, str]:
    import warp as wp

    folder, writable = Path(str(wp.config.kernel_cache_dir)), "yes"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        writable = "NO"
        problems.append(f"the kernel cache {folder} cannot be written ({error.strerror}): set WARP_CACHE_PATH")
    size = 0
    for place, _, names in os.walk(folder):  # in which other processes rename folders meanwhile
        with contextlib.suppress(FileNotFoundError):
            size += sum(Path(place, name).stat().st_size for name in names)
    modules = sum(path.is_dir() for path in folder.glob("*"))
    return {"folder": str(folder), "holds": f"{modules} kernel modules, {size / 2**20:.1f} MiB", "writable": writable}


def _dotted(version: int) -> str:
    return f"{version // 1000}.{version % 1000 // 10}"


def _driver_cuda() -> int | None:
    """1000 · major + 10 · minor of the newest CUDA that the driver runs; None without a driver."""
    driver, version = cuda_driver(), ctypes.c_int()
    failed = driver is None or driver.cuDriverGetVersion(ctypes.byref(version))
    return None if failed else version.value


def _gpu_reasons() -> list[str]:
    """Why no GPU is used and what to do about it: the first thing that is missing."""
    import warp as wp

    if wp.is_cuda_available():
        return []
    version, hidden = _driver_cuda(), os.environ.get("CUDA_VISIBLE_DEVICES")
    if not wp.get_cuda_toolkit_version():
        reason = "this build of Warp has no CUDA; the wheels for Linux and Windows on x86-64 and Linux on ARM have it"
    elif version is None and (Path("/proc/driver/nvidia").exists() or Path("/dev/nvidiactl").exists()):
        reason = "the system has an NVIDIA driver, but its library libcuda is not found: start a container with "
        reason += "--gpus all (NVIDIA Container Toolkit)"
    elif version is None:
        reason = "no NVIDIA driver: an NVIDIA GPU needs driver R580 or newer; without one everything runs on the CPU"
    elif version < _OLDEST_CUDA:
        reason = f"the driver runs CUDA {_dotted(version)}; Warp needs 13.0: driver R580 or newer"
    elif hidden is not None and not hidden.strip("-1 "):
        reason = f"CUDA_VISIBLE_DEVICES = {hidden!r} hides the GPUs"
    else:
        reason = "the driver finds no GPU: see the output of `nvidia-smi`"
    return [reason]


# Self-test: two small scenes whose answer is known

_LEVEL = 1e-5  # probability that a correct simulator fails
_PHOTONS = 400_000


def _run_self_test(device: str, progress: Callable[[str], None]) -> tuple[list[CaseResult], dict[str, float]]:
    """The tests, and the seconds that it took to `compile` or load the kernels and to `run`."""
    progress("loading kernels; the first time they are compiled")
    began = time.perf_counter()
    _quantities(device, 1)
    ready = time.perf_counter()
    progress("tracing")
    found = _quantities(device, _PHOTONS)
    seconds = {"compile": ready - began, "run": time.perf_counter() - ready}
    return judged([(one.name, one) for one in found], _LEVEL), seconds


def _quantities(device: str, photons: int) -> list[Quantity]:
    """Ballistic light from a plate at 2 m in turbid water, seen by one pixel; a slab; and the energy balance."""
    camera = {"width": 1, "height": 1, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01}
    target = {"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 2.0], "reflectance": 0.5}
    water = {"extinction": 0.5, "albedo": 0.8, "anisotropy": 0.924}
    plate = Scene.from_dict(scene(water, PENCIL, camera=camera, path_edges=(3.8, 4.6, 8), targets=[target]))
    result = simulate(plate, photons=photons, seed=1, device=device)
    # The photons that arrive without a collision are binomial; each gives Γ A / (π z²) exp(−c z) to the lens.
    arrive = math.exp(-0.5 * 2.0)
    returned = 0.5 / math.pi * plate.camera.aperture_area / 2.0**2 * arrive
    error = math.sqrt(arrive * (1 - arrive) / photons)
    ballistic = Estimate(float(result.component("ballistic").sum()) / returned, error)
    row = references.SLABS[0]
    reflected, transmitted = slab_faces(Run(photons, 1, device), row)
    return [
        Quantity("ballistic light from the plate", ballistic, arrive),
        Quantity("reflected by the slab", reflected, row.reflected),
        Quantity("transmitted by the slab", transmitted, row.transmitted),
        Quantity("energy that is not accounted for", Estimate(float(result.energy_report()["difference"]), 0.0), 0.0),
    ]


guarded(__name__)
