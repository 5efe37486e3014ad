"""Making a dataset: shards that are missing or broken, the manifest, the splits, the card.

A shard is two files and a small record of their checksums, in this order, each renamed into place when it is whole.
What is killed loses the shard in hand; a later call makes what has no record, or does not match it.
"""

from __future__ import annotations

import json
import os
import shutil
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from spadwarp.dataset.card import card
from spadwarp.dataset.recipe import SPLITS, Recipe, load_recipe
from spadwarp.dataset.sampling import Plan, Shard
from spadwarp.dataset.schema import FORMAT_VERSION
from spadwarp.dataset.shards import checksum, write_scene_index, write_shard
from spadwarp.device import core_count, pick_devices
from spadwarp.errors import ConfigError, FileError
from spadwarp.io.atomic import atomic_path
from spadwarp.parallel import Ray, Worker, interruptible, run_jobs

__all__ = ["DatasetReport", "make_dataset", "read_manifest", "verify_dataset"]

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class DatasetReport:
    """What a call of `make_dataset` did.

    Attributes:
        folder: The dataset.
        made: Names of the shards that were made.
        kept: Those that were there and whole.
        missing: Those that were not asked for and are not there.
        broken: What was wrong with those that were made again.
        frames: Frames made.
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
    shard: tuple[int, int] = (1, 1),
    progress: Progress | None = None,
) -> DatasetReport:
    """Makes what is missing or broken of a dataset.

    Args:
        recipe: From `load_recipe`, or its path.
        out: The dataset's folder; new, or that of the same recipe.
        device: "cpu", "cuda:0", "cuda:all", ...; by default the first GPU, else the CPU.
        processes: Of each GPU at most; meshes, files and numbers in between are work for cores. With more than one, and
            with several devices, Python starts anew: a script needs its `if __name__ == "__main__":`.
        engine: `spadwarp.parallel.Ray` for its workers, which have to see the folder; None for this host.
        shard: (k, n): only every n-th shard, from the k-th on, 1 ≤ k ≤ n; for several machines with one file system.
        progress: Called with ("frames", done, all that will be made); any other first word is a remark for whoever
            watches.

    Raises:
        ConfigError: A recipe that cannot be used, or another one's dataset in the folder.
        FileError: The folder cannot be written or is full; whole shards stay.
        KeyboardInterrupt: Ctrl-C, once the shards in hand are finished.
    """
    plan = Plan(recipe if isinstance(recipe, Recipe) else load_recipe(recipe))
    part, parts = shard
    if processes < 1:
        raise ConfigError(f"processes = {processes} is outside [1, inf)")
    if not 1 <= part <= parts:
        raise ConfigError(f"shard = {part}/{parts}: {part} is outside [1, {parts}]")
    folder = Path(out).absolute()
    _claim(plan, folder)
    mine = [one for one in plan.shards if one.index % parts == part - 1]
    state = _check(plan, folder, mine)
    todo = [one for one in mine if state[one.index] != ""]
    total = sum(one.scenes for one in todo) * plan.frames_per_scene
    _check_room(plan, folder, total)
    done = 0
    if progress is not None and total:
        progress("compile", 0, 0)

    def note(text: str) -> None:
        if progress is not None:
            progress(text, 0, 0)

    if engine is None:
        device = _shared_out(device, processes, len(todo))
    jobs = [_Job(plan.recipe, folder, one.index) for one in todo]
    with interruptible() as stopped:
        for _, frames in run_jobs(_make_shard, jobs, engine=engine, device=device, stopped=stopped, note=note):
            done += frames
            if progress is not None:
                progress("frames", done, total)
    missing = _finish(plan, folder)
    if done < total:
        raise KeyboardInterrupt
    return DatasetReport(
        folder=Path(out),
        made=tuple(one.frames_file for one in todo),
        kept=tuple(one.frames_file for one in mine if state[one.index] == ""),
        missing=missing,
        broken=tuple(text for text in state.values() if text not in ("", "missing")),
        frames=total,
    )


def verify_dataset(folder: str | os.PathLike[str]) -> list[str]:
    """What is wrong with a dataset, one line for each shard or file: missing, or not what its checksum says.

    Raises `FileError` if there is no dataset.
    """
    place = Path(folder)
    recipe = place / "recipe.toml"
    if not recipe.is_file():
        raise FileError(f"{place}: no dataset there (no recipe.toml)")
    if (place / "manifest.json").is_file():
        files = read_manifest(place)["files"]
        with ThreadPoolExecutor(core_count()) as pool:
            return [text for text in pool.map(lambda name: _compare(place, name, files[name]), files) if text]
    plan = Plan(load_recipe(recipe))
    states = zip(plan.shards, _check(plan, place, plan.shards).values(), strict=True)
    wrong = [f"{one.frames_file}: missing" if text == "missing" else text for one, text in states if text]
    return [*wrong, "manifest.json: missing"]


def read_manifest(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The manifest of a dataset. Raises `FileError`."""
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if (path.parent / "recipe.toml").is_file():
            raise FileError(
                f"{folder}: not finished; `spadwarp dataset make` makes the shards that are missing"
            ) from None
        raise FileError(f"{folder}: no dataset there (no manifest.json)") from None
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot be read: {error}") from error
    if manifest.get("format") != "spadwarp dataset":
        raise FileError(f"{path}: not the manifest of a spadwarp dataset")
    if manifest["format_version"] > FORMAT_VERSION:
        raise FileError(f"{path}: format version {manifest['format_version']} is newer than {FORMAT_VERSION}")
    return manifest


# Parts


class _Job(NamedTuple):
    recipe: Recipe
    folder: Path
    shard: int


def _make_shard(job: _Job, worker: Worker) -> int:
    """Makes a shard and its record; returns its frames."""
    known = worker.state.get("plan")
    plan = known if known is not None and known.recipe == job.recipe else Plan(job.recipe)
    worker.state["plan"] = plan
    shard = plan.shards[job.shard]
    record = _record_path(job.folder, shard)
    try:
        record.unlink(missing_ok=True)
    except OSError as error:
        raise FileError(f"{record}: cannot be replaced: {error.strerror}") from error
    written = write_shard(plan, shard, job.folder, device=worker.device, threads=worker.threads)
    _write_json(record, written)
    return shard.scenes * plan.frames_per_scene


def _shared_out(device: str | None, processes: int, shards: int) -> str:
    """The devices, each GPU as often as it shall have processes."""
    names = [one.alias for one in pick_devices(device)]
    if "cpu" in names or len(set(names)) < len(names):
        return ",".join(names)
    each = min(processes, core_count() // len(names), shards // (2 * len(names)))
    return ",".join(names * max(each, 1))


def _record_path(folder: Path, shard: Shard) -> Path:
    return folder / "shards" / f"{shard.name}.json"


def _claim(plan: Plan, folder: Path) -> None:
    """Writes the recipe into a new folder; refuses one that holds something else."""
    path, text = folder / "recipe.toml", plan.recipe.to_toml()
    try:
        if path.is_file():
            with suppress(tomllib.TOMLDecodeError):
                if tomllib.loads(path.read_text(encoding="utf-8")) == tomllib.loads(text):
                    return
            raise ConfigError(f"{folder} holds the dataset of another recipe ({path}); give another folder")
        if folder.exists() and not folder.is_dir():
            raise FileError(f"{folder}: is a file; a folder is needed")
        if folder.is_dir() and any(not one.name.startswith(".") for one in folder.iterdir()):
            raise FileError(f"{folder}: is not empty and holds no dataset; give another folder")
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise FileError(f"{folder}: cannot be written: {error.strerror}") from error


def _check(plan: Plan, folder: Path, shards: Sequence[Shard]) -> dict[int, str]:
    """For each shard "" (whole), "missing", or what is wrong with it."""

    def state(shard: Shard) -> str:
        path = _record_path(folder, shard)
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            files = {name: (int(one["bytes"]), str(one["sha256"])) for name, one in record.items()}
        except FileNotFoundError:
            return "missing"
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            return f"{path}: cannot be read: {error}"
        if set(files) != set(plan.files_of(shard)):
            return f"{path}: not the record of this shard"
        return next((text for name in files if (text := _compare(folder, name, record[name]))), "")

    with ThreadPoolExecutor(core_count()) as pool:
        return dict(zip((one.index for one in shards), pool.map(state, shards), strict=True))


def _compare(folder: Path, name: str, record: dict[str, Any]) -> str:
    path = folder / name
    try:
        if path.stat().st_size != record["bytes"]:
            return f"{name}: damaged: it has {path.stat().st_size} bytes, not {record['bytes']}"
        return "" if checksum(path) == record else f"{name}: damaged: its checksum is not that of manifest.json"
    except FileNotFoundError:
        return f"{name}: missing"
    except OSError as error:
        return f"{name}: cannot be read: {error.strerror}"


def _check_room(plan: Plan, folder: Path, frames: int) -> None:
    """Frames take up to 3.2 bytes a pixel, scenes up to 20, histograms at least half of their 2 bytes a bin."""
    pixels, recipe = plan.shape[0] * plan.shape[1], plan.recipe
    scene = 20.0 + recipe.monte_carlo.share * recipe.gate.bins
    needed = int(frames * pixels * (3.2 + scene / plan.frames_per_scene))
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise FileError(f"{folder}: up to {needed / 1e9:.3g} GB will be written; {free / 1e9:.3g} GB are free there")


def _finish(plan: Plan, folder: Path) -> tuple[str, ...]:
    """Splits, the index of scenes, and, once every shard is there, manifest and card; returns what is not there."""
    files: dict[str, Any] = {}
    missing = []
    for shard in plan.shards:
        try:
            files |= json.loads(_record_path(folder, shard).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            missing.append(shard.frames_file)
    for split in SPLITS:
        names = [one.frames_file for one in plan.shards if one.split == split]
        _write_text(folder / f"{split}.txt", "".join(f"{name}\n" for name in names))
    write_scene_index(plan, folder)
    if missing:
        return tuple(missing)
    files["scenes.h5"] = checksum(folder / "scenes.h5")
    manifest = _manifest(plan, files)
    _write_text(folder / "README.md", card(plan, manifest))
    _write_json(folder / "manifest.json", manifest)
    return ()


def _manifest(plan: Plan, files: dict[str, Any]) -> dict[str, Any]:
    from spadwarp import __version__

    return {
        "format": "spadwarp dataset",
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "name": plan.recipe.name,
        "description": plan.recipe.description,
        "seed": str(plan.recipe.seed),
        "frames": plan.sample_count,
        "scenes": plan.scene_count,
        "frames_per_scene": plan.frames_per_scene,
        "height": plan.shape[0],
        "width": plan.shape[1],
        "depth_step": plan.depth_step,
        "depth_offset": plan.depth_offset,
        "targets": [one.name for one in plan.targets],
        "splits": {
            split: {
                "seed": str(plan.split_seeds[split]),
                "targets": [one.name for one in plan.targets if one.split == split],
                "shards": [one.frames_file for one in plan.shards if one.split == split],
                "frames": sum(one.scenes for one in plan.shards if one.split == split) * plan.frames_per_scene,
            }
            for split in SPLITS
        },
        "files": dict(sorted(files.items())),
    }


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _write_json(path: Path, value: Any) -> None:
    _write_text(path, json.dumps(value, indent=1) + "\n")
