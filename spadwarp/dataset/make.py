"""Making a dataset: shards that are missing or broken, the manifest, the splits, the card.

A shard is two or three files and a small record of their checksums, written in this order, each renamed into place when
it is whole. When a process is killed only its unfinished shard is lost; a later call makes what has no record or does
not match it. A process that makes a shard holds a lock on it: of two calls for one folder, each makes what the other
has not begun.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from spadwarp.dataset.manifest import check_shards, finish, record_path
from spadwarp.dataset.recipe import Recipe, load_recipe
from spadwarp.dataset.sampling import Plan
from spadwarp.dataset.shards import write_shard
from spadwarp.device import core_count, pick_devices
from spadwarp.errors import ConfigError, FileError
from spadwarp.io.paths import atomic_path, lock, remove_temporaries
from spadwarp.io.text import parse_toml, read_toml, write_json
from spadwarp.limits import check_integer, check_part
from spadwarp.parallel import Ray, Worker, interruptible, run_jobs

__all__ = ["DatasetReport", "make_dataset"]

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class DatasetReport:
    """What a call of `make_dataset` did.

    Attributes:
        folder: The dataset.
        made: Names of the shards that were made.
        kept: Those that were already complete.
        missing: Those that are missing because they were not asked for.
        broken: What was wrong with those that were made again.
        frames: Number of frames that were made.
    """

    folder: Path
    made: tuple[str, ...]
    kept: tuple[str, ...]
    missing: tuple[str, ...]
    broken: tuple[str, ...]
    frames: int


def make_dataset(
    recipe: Recipe | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    device: str | None = None,
    processes: int = 1,
    engine: Ray | None = None,
    part: tuple[int, int] = (1, 1),
    progress: Progress | None = None,
) -> DatasetReport:
    """Makes what is missing or broken of a dataset.

    Args:
        recipe: From `load_recipe`, or its path.
        out: The dataset's folder; new, or that of the same recipe.
        device: "cpu", "cuda:0", "cuda:all", ...; by default the first GPU, else the CPU.
        processes: At most so many for each GPU, ≥ 1, since part of the work is done by CPU cores. With more than one
            process or device Python starts again for each: a script needs `if __name__ == "__main__":`.
        engine: `spadwarp.parallel.Ray` to use its workers, which must see the folder; None for this host.
        part: (k, n): every n-th shard from the k-th on, 1 ≤ k ≤ n; for several machines with one file system.
        progress: Called with ("frames", frames made, frames to make), and with (message, 0, 0).

    Raises:
        ConfigError: A recipe that cannot be used, or the folder holds the dataset of another recipe.
        FileError: The folder cannot be written or is full; complete shards are kept.
        KeyboardInterrupt: Ctrl-C, once the shards that were begun are finished.
    """
    plan = Plan(recipe if isinstance(recipe, Recipe) else load_recipe(recipe))
    plan.check_targets()
    number, parts = check_part("part", part)
    processes = check_integer("processes", processes, "[1, 1000]")
    folder = Path(out).absolute()
    _claim(plan, folder)
    shards = [item for item in plan.shards if item.index % parts == number - 1]
    state = check_shards(plan, folder, shards)
    missing = [item for item in shards if state[item.index]]
    total = sum(item.scenes for item in missing) * plan.frames_per_scene
    _check_space(plan, folder, total)
    report = progress or (lambda *_: None)
    if total:
        report("compile", 0, 0)
    if engine is None:
        device = _processes(device, processes, len(missing))
    done = 0
    jobs = [_Job(plan.recipe, folder, item.index) for item in missing]
    with interruptible() as stopped:
        options: dict[str, Any] = {"engine": engine, "device": device, "stopped": stopped}
        for _, frames in run_jobs(_make_shard, jobs, note=lambda text: report(text, 0, 0), **options):
            done += frames
            report("frames", done, total)
    others = finish(plan, folder)
    if done < total:
        raise KeyboardInterrupt
    return DatasetReport(
        folder=Path(out),
        made=tuple(item.frames_file for item in missing),
        kept=tuple(item.frames_file for item in shards if not state[item.index]),
        missing=others,
        broken=tuple(text for text in state.values() if text not in ("", "missing")),
        frames=total,
    )


class _Job(NamedTuple):
    recipe: Recipe
    folder: Path
    shard: int


def _make_shard(job: _Job, worker: Worker) -> int:
    """Makes a shard and its record, unless another process does; returns its frames."""
    known = worker.state.get("plan")
    plan = known if known is not None and known.recipe == job.recipe else Plan(job.recipe)
    worker.state["plan"] = plan
    shard = plan.shards[job.shard]
    record = record_path(job.folder, shard)
    try:
        record.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise FileError(f"{record.parent}: cannot be made: {error.strerror}") from error
    with lock(record.with_suffix(".lock"), wait=lambda: not worker.stopped.is_set()) as obtained:
        if not obtained:  # interrupted while another process was making it
            return 0
        if check_shards(plan, job.folder, [shard])[shard.index]:
            try:
                record.unlink(missing_ok=True)
            except OSError as error:
                raise FileError(f"{record}: cannot be replaced: {error.strerror}") from error
            remove_temporaries(record)
            written = write_shard(plan, shard, job.folder, device=worker.device, threads=worker.threads)
            write_json(written, record, indent=1)
    return shard.scenes * plan.frames_per_scene


def _processes(device: str | None, processes: int, shards: int) -> str:
    """The devices, each GPU as often as it gets processes."""
    names = [chosen.alias for chosen in pick_devices(device)]
    if "cpu" in names or len(set(names)) < len(names):
        return ",".join(names)
    each = min(processes, core_count() // len(names), shards // (2 * len(names)))
    return ",".join(names * max(each, 1))


def _claim(plan: Plan, folder: Path) -> None:
    """Writes the recipe into a new folder; refuses one that holds something else."""
    try:
        if _holds(plan, folder):
            return
        folder.mkdir(parents=True, exist_ok=True)
        with lock(folder / ".claim.lock", wait=lambda: True):
            if _holds(plan, folder):  # another process was faster
                return
            if any(not path.name.startswith(".") for path in folder.iterdir()):
                raise FileError(f"{folder}: is not empty and holds no dataset; give another folder")
            with atomic_path(folder / "recipe.toml") as temporary:
                temporary.write_text(plan.recipe.to_toml(), encoding="utf-8")
    except FileExistsError:
        raise FileError(f"{folder}: is a file; a folder is needed") from None
    except OSError as error:
        raise FileError(f"{folder}: cannot be written: {error.strerror}") from error


def _holds(plan: Plan, folder: Path) -> bool:
    """Whether the folder holds the dataset of this recipe; `ConfigError` for one of another recipe."""
    path = folder / "recipe.toml"
    if not path.is_file():
        return False
    with suppress(ConfigError, FileError):  # not TOML, or not UTF-8
        if read_toml(path) == parse_toml(plan.recipe.to_toml()):
            return True
    raise ConfigError(f"{folder} holds the dataset of another recipe ({path}); give another folder")


def _check_space(plan: Plan, folder: Path, frames: int) -> None:
    """Frames take up to 3.2 bytes a pixel, scenes up to 20, histograms at least half of their 2 bytes a bin."""
    pixels, recipe = plan.shape[0] * plan.shape[1], plan.recipe
    scene = 20.0 + recipe.monte_carlo.share * recipe.gate.bins
    needed = int(frames * pixels * (3.2 + scene / plan.frames_per_scene))
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise FileError(f"{folder}: up to {needed / 1e9:.3g} GB will be written; {free / 1e9:.3g} GB are free there")
