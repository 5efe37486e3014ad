"""Making a dataset: shards that are missing or broken, the manifest, the splits, the card.

A shard is two or three files and a small record of their checksums, written in this order, each renamed into place when
it is whole. When a process is killed only its unfinished shard is lost; a later call makes what has no record or does
not match it. A process that makes a shard holds a lock on it: of two calls for one folder, each makes what the other
has not begun.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, StringConstraints, TypeAdapter, ValidationError

from spadwarp.dataset.card import card, croissant
from spadwarp.dataset.plan import Plan, Shard
from spadwarp.dataset.recipe import SPLITS, Recipe, load_recipe
from spadwarp.dataset.shards import FORMAT_VERSION, checksum, write_scene_index, write_shard
from spadwarp.device import core_count, pick_devices
from spadwarp.io.paths import file_problem, lock, remove_temporaries, sha256
from spadwarp.io.text import parse_toml, read_json, read_toml, write_json, write_text
from spadwarp.parallel import Ray, Worker, interruptible, run_jobs
from spadwarp.transport import Progress
from spadwarp.values import ConfigError, FileError, check_integer, check_part, shown

__all__ = ["DatasetReport", "make_dataset", "read_manifest", "verify_dataset"]

_INPUTS = "inputs.json"
_LARGEST_MANIFEST = 1 << 28  # bytes; a shard takes 400

# Names of files in a dataset's folder: nothing else is opened, whatever a manifest says.
_FileName = Annotated[str, StringConstraints(pattern=r"^(scenes\.h5|(frames|histograms|scenes/scenes)-\d+\.h5)$")]
_ShardName = Annotated[str, StringConstraints(pattern=r"^frames-\d+\.h5$")]
_Count = Annotated[int, Field(ge=0, lt=2**31)]
_Real = Annotated[float, Field(allow_inf_nan=False)]


class _File(BaseModel, strict=True):
    bytes: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


class _Split(BaseModel, strict=True):
    seed: str
    targets: list[str]
    shards: list[_ShardName]
    frames: _Count


class _Splits(BaseModel, strict=True):
    train: _Split
    validation: _Split
    test: _Split


class _Manifest(BaseModel, strict=True):
    name: str
    description: str
    license: str
    version: str
    seed: str
    frames: _Count
    scenes: _Count
    frames_per_scene: _Count
    height: Annotated[int, Field(ge=1, lt=2**16)]
    width: Annotated[int, Field(ge=1, lt=2**16)]
    depth_step: Annotated[_Real, Field(gt=0)]
    depth_offset: _Real
    targets: list[str]
    splits: _Splits
    files: dict[_FileName, _File]


_RECORD = TypeAdapter(dict[_FileName, _File])


def read_manifest(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The manifest of a dataset. Raises `FileError`."""
    path = Path(folder) / "manifest.json"
    if file_problem(path) == "no such file":
        if file_problem(path.parent / "recipe.toml") is None:
            raise FileError(f"{folder}: not finished; `spadwarp dataset` makes the missing shards")
        raise FileError(f"{folder}: no dataset there (no manifest.json); `spadwarp dataset` makes one")
    manifest = read_json(path, largest=_LARGEST_MANIFEST)
    if not isinstance(manifest, dict) or manifest.get("format") != "spadwarp dataset":
        raise FileError(f"{path}: not the manifest of a spadwarp dataset")
    if (version := manifest.get("format_version")) != FORMAT_VERSION:
        raise FileError(f"{path}: format_version = {shown(version)} is not {FORMAT_VERSION}")
    try:
        whole = _Manifest.model_validate(manifest)
    except ValidationError as error:
        raise FileError(f"{path}: not a whole manifest: {_first_problem(error)}") from error
    placed = {*whole.splits.train.targets, *whole.splits.validation.targets, *whole.splits.test.targets}
    if lost := sorted(set(manifest["targets"]) - placed):
        raise FileError(f"{path}: not a whole manifest: the target {shown(lost[0])} is in no split")
    return manifest


def _first_problem(error: ValidationError) -> str:
    """Where and what: `splits.train.shards: Field required`."""
    problem = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}"


def verify_dataset(folder: str | os.PathLike[str]) -> list[str]:
    """Problems of a dataset, one line for each file that is missing or differs from its checksum.

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
    states = zip(plan.shards, _states(plan, place, plan.shards), strict=True)
    wrong = [f"{shard.frames_file}: missing" if text == "missing" else text for shard, text in states if text]
    return [*wrong, "manifest.json: missing"]


def _record_path(folder: Path, shard: Shard) -> Path:
    """Where the checksums of a shard's files stand."""
    return folder / "shards" / f"{shard.index:05d}.json"


def _read_record(path: Path) -> dict[str, Any]:
    """Sizes and checksums of a shard's files by name. Raises `FileError`."""
    record = read_json(path)
    try:
        _RECORD.validate_python(record)
    except ValidationError as error:
        raise FileError(f"{path}: not a whole record: {_first_problem(error)}") from error
    return record


def _state(plan: Plan, folder: Path, shard: Shard) -> str:
    """Nothing for a shard that is whole, else "missing" or what is wrong."""
    path = _record_path(folder, shard)
    if file_problem(path) == "no such file":
        return "missing"
    try:
        files = _read_record(path)
    except FileError as error:
        return str(error)
    if set(files) != set(plan.files_of(shard)):
        return f"{path}: not the record of this shard"
    return next((text for name, file in files.items() if (text := _compare(folder, name, file))), "")


def _states(plan: Plan, folder: Path, shards: Sequence[Shard]) -> list[str]:
    with ThreadPoolExecutor(core_count()) as pool:
        return list(pool.map(partial(_state, plan, folder), shards))


def _compare(folder: Path, name: str, record: dict[str, Any]) -> str:
    path = folder / name
    try:
        size = path.stat().st_size
        if size != record["bytes"]:
            return f"{name}: damaged: it has {size} bytes, not {record['bytes']}"
        return "" if checksum(path) == record else f"{name}: damaged: its checksum is not that of manifest.json"
    except FileNotFoundError:
        return f"{name}: missing"
    except OSError as error:
        return f"{name}: cannot be read: {error.strerror}"


def _finish(plan: Plan, folder: Path) -> tuple[str, ...]:
    """Writes the splits, the index of scenes and, once every shard is made, manifest and card.

    Returns the shards that are missing.
    """
    from spadwarp.values import __version__

    files: dict[str, Any] = {}
    missing = []
    for shard in plan.shards:
        try:
            files |= _read_record(_record_path(folder, shard))
        except FileError:
            missing.append(shard.frames_file)
    splits = {split: [item for item in plan.shards if item.split == split] for split in SPLITS}
    for split, shards in splits.items():
        write_text("".join(f"{item.frames_file}\n" for item in shards), folder / f"{split}.txt")
    write_scene_index(plan, folder)
    if missing:
        return tuple(missing)
    files["scenes.h5"] = checksum(folder / "scenes.h5")
    manifest = {
        "format": "spadwarp dataset",
        "format_version": FORMAT_VERSION,
        "version": __version__,
        **{name: getattr(plan.recipe, name) for name in ("name", "description", "license")},
        "seed": str(plan.recipe.seed),
        "frames": plan.sample_count,
        "scenes": plan.scene_count,
        "frames_per_scene": plan.frames_per_scene,
        "height": plan.shape[0],
        "width": plan.shape[1],
        "depth_step": plan.depth_step,
        "depth_offset": plan.depth_offset,
        "targets": [target.name for target in plan.targets],
        "splits": {
            split: {
                "seed": str(plan.split_seeds[split]),
                "targets": [target.name for target in plan.targets if target.split == split],
                "shards": [item.frames_file for item in shards],
                "frames": sum(item.scenes for item in shards) * plan.frames_per_scene,
            }
            for split, shards in splits.items()
        },
        "files": dict(sorted(files.items())),
    }
    write_text(card(manifest, "hdf5", files), folder / "README.md")
    described = {name: record for name, record in files.items() if name.startswith(("frames-", "histograms-"))}
    write_json(croissant(manifest, "hdf5", described), folder / "croissant.json", indent=1)
    write_json(manifest, folder / "manifest.json", indent=1)
    return ()


@dataclass(frozen=True)
class DatasetReport:
    """The work of a call of `make_dataset`."""

    folder: Path  # the dataset
    made: tuple[str, ...]  # names of the shards that were made
    kept: tuple[str, ...]  # those that were already complete
    missing: tuple[str, ...]  # those that are missing because they were not asked for
    broken: tuple[str, ...]  # what was wrong with those that were made again
    frames: int  # number of frames that were made


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
    shards = plan.shards[number - 1 :: parts]
    states = _states(plan, folder, shards)
    missing = [item for item, text in zip(shards, states, strict=True) if text]
    total = sum(item.scenes for item in missing) * plan.frames_per_scene
    _check_space(plan, folder, total)
    report = progress or (lambda *_: None)
    if total:
        report("compile", 0, 0)
    if engine is None:
        device = _processes(device, processes, len(missing))
    done = 0
    jobs = [(plan.recipe, folder, item.index) for item in missing]
    with interruptible() as stopped:
        options: dict[str, Any] = {"engine": engine, "device": device, "stopped": stopped}
        for _, frames in run_jobs(_make_shard, jobs, note=lambda text: report(text, 0, 0), **options):
            done += frames
            report("frames", done, total)
    others = _finish(plan, folder)
    if done < total:
        raise KeyboardInterrupt
    return DatasetReport(
        folder=Path(out),
        made=tuple(item.frames_file for item in missing),
        kept=tuple(item.frames_file for item in shards if item not in missing),
        missing=others,
        broken=tuple(text for text in states if text not in ("", "missing")),
        frames=total,
    )


def _make_shard(job: tuple[Recipe, Path, int], worker: Worker) -> int:
    """Makes a shard, by its index, and its record, unless another process does; returns its frames."""
    recipe, folder, index = job
    plan = worker.state.get("plan")
    if plan is None or plan.recipe != recipe:
        plan = worker.state["plan"] = Plan(recipe)
    shard = plan.shards[index]
    record = _record_path(folder, shard)
    record.parent.mkdir(exist_ok=True)
    with lock(record.with_suffix(".lock"), wait=lambda: not worker.stopped.is_set()) as obtained:
        if not obtained:  # interrupted while another process was making it
            return 0
        if _state(plan, folder, shard):
            record.unlink(missing_ok=True)
            remove_temporaries(record)
            written = write_shard(plan, shard, folder, device=worker.device, threads=worker.threads)
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
            write_json(_inputs(plan), folder / _INPUTS, indent=1)
            write_text(plan.recipe.to_toml(), folder / "recipe.toml")
    except FileExistsError:
        raise FileError(f"{folder}: is a file; a folder is needed") from None
    except OSError as error:
        raise FileError(f"{folder}: cannot be written: {error.strerror}") from error


def _holds(plan: Plan, folder: Path) -> bool:
    """Whether the folder holds the dataset of this recipe; `ConfigError` for one of another recipe."""
    path = folder / "recipe.toml"
    if not path.is_file():
        return False
    same = False
    with suppress(ConfigError, FileError):  # not TOML, or not UTF-8
        same = read_toml(path) == parse_toml(plan.recipe.to_toml())
    if not same:
        raise ConfigError(f"{folder} holds the dataset of another recipe ({path}); give another folder")
    try:
        before = read_json(folder / _INPUTS)
        changed = [name for name, content in _inputs(plan).items() if before[name] != content]
    except (TypeError, KeyError) as error:
        raise FileError(f"{folder / _INPUTS}: not the hashes of the recipe's files; give another folder") from error
    if changed:
        text = f"its content has changed since {folder} was begun; give another folder"
        raise FileError(f"{changed[0]} is another file than it was: {text}")
    return True


def _inputs(plan: Plan) -> dict[str, str]:
    """The files that the dataset is made from, and the SHA-256 of each."""
    targets = (path for target in plan.targets for path in (target.mesh, target.export) if path is not None)
    return {str(path): sha256(path) for path in dict.fromkeys((*plan.recipe.files, *targets)) if path.is_file()}


def _check_space(plan: Plan, folder: Path, frames: int) -> None:
    """Frames take up to 3.2 bytes a pixel, scenes up to 20, histograms at least half of their 2 bytes a bin."""
    pixels, recipe = plan.shape[0] * plan.shape[1], plan.recipe
    scene = 20.0 + recipe.monte_carlo.share * recipe.gate.bins
    needed = int(frames * pixels * (3.2 + scene / plan.frames_per_scene))
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise FileError(f"{folder}: up to {needed / 1e9:.3g} GB will be written; {free / 1e9:.3g} GB are free there")
