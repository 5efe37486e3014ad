"""What a dataset consists of: its manifest, its splits and the checksums of its files, written and verified."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from spadwarp.dataset.card import card
from spadwarp.dataset.recipe import SPLITS, load_recipe
from spadwarp.dataset.sampling import Plan, Shard
from spadwarp.dataset.schema import FORMAT_VERSION
from spadwarp.dataset.shards import checksum, write_scene_index
from spadwarp.device import core_count
from spadwarp.errors import FileError
from spadwarp.io.atomic import atomic_path
from spadwarp.io.text import write_json

__all__ = ["check_shards", "finish", "read_manifest", "record_path", "verify_dataset"]


def read_manifest(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The manifest of a dataset. Raises `FileError`."""
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if (path.parent / "recipe.toml").is_file():
            raise FileError(f"{folder}: not finished; `spadwarp dataset make` makes the missing shards") from None
        raise FileError(f"{folder}: no dataset there (no manifest.json)") from None
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot be read: {error}") from error
    if manifest.get("format") != "spadwarp dataset":
        raise FileError(f"{path}: not the manifest of a spadwarp dataset")
    if manifest["format_version"] > FORMAT_VERSION:
        raise FileError(f"{path}: format version {manifest['format_version']} is newer than {FORMAT_VERSION}")
    return manifest


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


def check_shards(plan: Plan, folder: Path, shards: Sequence[Shard]) -> dict[int, str]:
    """By the shards' indices "" (whole), "missing", or what is wrong."""

    def state(shard: Shard) -> str:
        path = record_path(folder, shard)
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            files = {name: {"bytes": int(file["bytes"]), "sha256": file["sha256"]} for name, file in record.items()}
        except FileNotFoundError:
            return "missing"
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            return f"{path}: cannot be read: {error}"
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
            files |= json.loads(record_path(folder, shard).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            missing.append(shard.frames_file)
    for split in SPLITS:
        _write_text(folder / f"{split}.txt", "".join(f"{name}\n" for name in _shards_of(plan, split)))
    write_scene_index(plan, folder)
    if not missing:
        files["scenes.h5"] = checksum(folder / "scenes.h5")
        manifest = _manifest(plan, files)
        _write_text(folder / "README.md", card(plan, manifest))
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


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
