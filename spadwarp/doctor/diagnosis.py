"""What is installed, which devices are found, what a GPU would need, and a test against known values."""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spadwarp.device import devices, nvidia_driver, pick_device
from spadwarp.doctor.self_test import SelfTest, run_self_test

__all__ = ["Diagnosis", "diagnose"]

NEEDED = (
    "warp-lang", "numpy", "scipy", "trimesh", "manifold3d", "OpenEXR", "pydantic", "typer", "rich", "h5py",
    "matplotlib", "tomli-w", "PyYAML", "jinja2",
)  # fmt: skip

# Package → extra that brings it.
OPTIONAL = {
    "torch": "torch", "ray": "ray", "bmnd": "bm3d", "ptufile": "formats", "plotly": "view", "imageio-ffmpeg": "video",
}  # fmt: skip

_OLDEST_CUDA = 13000  # of the driver, R580: the CUDA that Warp is built with


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        facts: Section → name → value, as text.
        gpu: Why no GPU is used and what to do about it; empty with a GPU.
        problems: What keeps spadwarp from working.
        tests: The self-test, empty if it was not run.
        seconds: Duration of the self-test: `compile` (or load) the kernels, `run`.
    """

    facts: dict[str, dict[str, str]]
    gpu: list[str]
    problems: list[str]
    tests: list[SelfTest]
    seconds: dict[str, float]

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
        tests, seconds = run_self_test(chosen.alias, progress or (lambda _: None))
    return Diagnosis(
        facts={
            "System": _system(),
            "Packages": packages,
            "Devices": {entry["name"]: _device_text(entry) for entry in devices()},
            "Kernel cache": cache,
        },
        gpu=_gpu_reasons(),
        problems=problems,
        tests=tests,
        seconds=seconds,
    )


# Facts


def _system() -> dict[str, str]:
    import warp as wp

    from spadwarp import __version__

    toolkit, driver = wp.get_cuda_toolkit_version(), _driver_cuda()
    return {
        "spadwarp": f"{__version__}, in {Path(__file__).parents[1]}",
        "Python": f"{platform.python_version()} on {platform.platform()}",
        "CUDA of Warp": ".".join(map(str, toolkit)) if toolkit else "none",
        "NVIDIA driver": nvidia_driver() or ("found" if driver else "none"),
        "CUDA of the driver": _dotted(driver) if driver else "none",
    }


def _packages(problems: list[str]) -> dict[str, str]:
    needed = {name: _version(name) or "MISSING" for name in NEEDED}
    problems += [f"{name} is not installed: pip install spadwarp" for name in NEEDED if needed[name] == "MISSING"]
    optional = {
        name: _version(name) or f"not installed (optional: pip install 'spadwarp[{extra}]')"
        for name, extra in OPTIONAL.items()
    }
    return needed | optional


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _device_text(device: dict[str, Any]) -> str:
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
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    modules = sum(path.is_dir() for path in folder.glob("*"))
    return {
        "folder": str(folder),
        "holds": f"{modules} kernel modules, {sum(sizes) / 2**20:.1f} MiB",
        "writable": writable,
    }


def _dotted(version: int) -> str:
    return f"{version // 1000}.{version % 1000 // 10}"


def _driver_cuda() -> int | None:
    """1000 · major + 10 · minor of the newest CUDA that the driver runs; None without a driver."""
    for library in ("nvcuda.dll",) if os.name == "nt" else ("libcuda.so.1", "libcuda.so"):
        try:
            driver = ctypes.CDLL(library)
        except OSError:
            continue
        version = ctypes.c_int()
        return version.value if driver.cuDriverGetVersion(ctypes.byref(version)) == 0 else None
    return None


def _gpu_reasons() -> list[str]:
    import warp as wp

    if wp.is_cuda_available():
        return []
    if not wp.get_cuda_toolkit_version():
        return ["this build of Warp has no CUDA; the wheels for Linux and Windows on x86-64 and Linux on ARM have it"]
    version = _driver_cuda()
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
    if version is None:
        if Path("/proc/driver/nvidia").exists() or Path("/dev/nvidiactl").exists():
            return [
                "the system has an NVIDIA driver, but its library libcuda is not found: start a container with "
                "--gpus all (NVIDIA Container Toolkit)"
            ]
        return ["no NVIDIA driver: an NVIDIA GPU needs driver R580 or newer; without one everything runs on the CPU"]
    if version < _OLDEST_CUDA:
        return [f"the driver runs CUDA {_dotted(version)}; Warp needs 13.0: driver R580 or newer"]
    if hidden is not None and not hidden.strip("-1 "):
        return [f"CUDA_VISIBLE_DEVICES = {hidden!r} hides the GPUs"]
    return ["the driver finds no GPU: see the output of `nvidia-smi`"]
