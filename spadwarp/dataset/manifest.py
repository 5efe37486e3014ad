"""What a dataset consists of: its manifest, its splits and the checksums of its files, written and verified."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, TypeAdapter, ValidationError

from spadwarp.dataset.card import card
from spadwarp.dataset.croissant import croissant
from spadwarp.dataset.recipe import SPLITS, load_recipe
from spadwarp.dataset.sampling import Plan, Shard
from spadwarp.dataset.schema import FORMAT_VERSION
from spadwarp.dataset.shards import checksum, write_scene_index
from spadwarp.device import core_count
from spadwarp.errors import FileError
from spadwarp.io.parsing import parse_json, read_text
from spadwarp.io.paths import file_problem
from spadwarp.io.text import write_json, write_text
from spadwarp.limits import shown

__all__ = ["check_shards", "finish", "read_manifest", "record_path", "verify_dataset"]


_LARGEST_MANIFEST = 1 << 28  # bytes; a shard takes 400

# Names of files in a dataset's folder: nothing else is opened, whatever a manifest says.
_FileName = Annotated[str, StringConstraints(pattern=r"^(scenes\.h5|(frames|histograms|scenes/scenes)-\d+\.h5)$")]
_ShardName = Annotated[str, StringConstraints(pattern=r"^frames-\d+\.h5$")]
_Count = Annotated[int, Field(ge=0, lt=2**31)]
_Real = Annotated[float, Field(allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True)


class _File(_Strict):
    bytes: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


class _Split(_Strict):
    seed: str
    targets: list[str]
    shards: list[_ShardName]
    frames: _Count


class _Splits(_Strict):
    train: _Split
    validation: _Split
    test: _Split


class _Manifest(_Strict):
    name: str
    version: str
    license: str = ""
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
        raise FileError(f"{folder}: no dataset there (no manifest.json)")
    try:
        manifest = parse_json(read_text(path, largest=_LARGEST_MANIFEST))
    except ValueError as error:
        raise FileError(f"{path}: cannot be read: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != "spadwarp dataset":
        raise FileError(f"{path}: not the manifest of a spadwarp dataset")
    version = manifest.get("format_version")
    if not isinstance(version, int):
        raise FileError(f"{path}: not a whole manifest: format_version = {shown(version)} is no integer")
    if version > FORMAT_VERSION:
        raise FileError(f"{path}: format version {version} is newer than {FORMAT_VERSION}")
    try:
        _Manifest.model_validate(manifest)
    except ValidationError as error:
        raise FileError(f"{path}: not a whole manifest: {_first_problem(error)}") from error
    placed = {name for split in manifest["splits"].values() for name in split["targets"]}
    if lost := sorted(set(manifest["targets"]) - placed):
        raise FileError(f"{path}: not a whole manifest: the target {shown(lost[0])} is in no split")
    return manifest


def _first_problem(error: ValidationError) -> str:
    """Where and what: `splits.train.shards: Field required`."""
    problem = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}"


def verify_dataset(folder: str | os.PathLike[str]) -> list[str]:
    """What is wrong with a dataset, one line for each file that is missing or differs from its checksum.

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
    states = zip(plan.shards, check_shards(plan, place, plan.shards).values(), strict=True)
    wrong = [f"{shard.frames_file}: missing" if text == "missing" else text for shard, text in states if text]
    return [*wrong, "manifest.json: missing"]


def record_path(folder: Path, shard: Shard) -> Path:
    """Where the checksums of a shard's files stand."""
    return folder / "shards" / f"{shard.name}.json"


def _read_record(path: Path) -> dict[str, Any]:
    """Sizes and checksums of a shard's files by name. Raises `FileError`."""
    try:
        record = parse_json(read_text(path))
        _RECORD.validate_python(record)
    except ValidationError as error:
        raise FileError(f"{path}: cannot be read: {_first_problem(error)}") from error
    except ValueError as error:
        raise FileError(f"{path}: cannot be read: {error}") from error
    return record


def check_shards(plan: Plan, folder: Path, shards: Sequence[Shard]) -> dict[int, str]:
    """By the shards' indices "" (whole), "missing", or what is wrong."""

    def state(shard: Shard) -> str:
        path = record_path(folder, shard)
        if file_problem(path) == "no such file":
            return "missing"
        try:
            files = _read_record(path)
        except FileError as error:
            return str(error)
        if set(files) != set(plan.files_of(shard)):
            return f"{path}: not the record of this shard"
        return next((text for name, file in files.items() if (text := _compare(folder, name, file))), "")

    with ThreadPoolExecutor(core_count()) as pool:
        return dict(zip((shard.index for shard in shards), pool.map(state, shards), strict=True))


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


def finish(plan: Plan, folder: Path) -> tuple[str, ...]:
    """Writes the splits, the index of scenes and, once every shard is made, manifest and card.

    Returns the shards that are missing.
    """
    files: dict[str, Any] = {}
    missing = []
    for shard in plan.shards:
        try:
            files |= _read_record(record_path(folder, shard))
        except FileError:
            missing.append(shard.frames_file)
    for split in SPLITS:
        write_text("".join(f"{name}\n" for name in _shards_of(plan, split)), folder / f"{split}.txt")
    write_scene_index(plan, folder)
    if not missing:
        files["scenes.h5"] = checksum(folder / "scenes.h5")
        manifest = _manifest(plan, files)
        write_text(card(plan, manifest), folder / "README.md")
        described = {name: record for name, record in files.items() if name.startswith(("frames-", "histograms-"))}
        write_json(croissant(manifest, "hdf5", described), folder / "croissant.json", indent=1)
        write_json(manifest, folder / "manifest.json", indent=1)
    return tuple(missing)


def _shards_of(plan: Plan, split: str) -> list[str]:
    return [shard.frames_file for shard in plan.shards if shard.split == split]


def _manifest(plan: Plan, files: dict[str, Any]) -> dict[str, Any]:
    from spadwarp import __version__

    return {
        "format": "spadwarp dataset",
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "name": plan.recipe.name,
        "description": plan.recipe.description,
        "license": plan.recipe.license,
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
                "shards": _shards_of(plan, split),
                "frames": sum(shard.scenes for shard in plan.shards if shard.split == split) * plan.frames_per_scene,
            }
            for split in SPLITS
        },
        "files": dict(sorted(files.items())),
    }
