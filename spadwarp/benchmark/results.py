"""Results of the benchmark, and the file in which they are kept and compared."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from spadwarp.device import core_count, nvidia_driver, pick_device, processor_name
from spadwarp.errors import FileError
from spadwarp.transport import provenance

__all__ = ["BenchResult", "load_report", "report"]

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
