"""The dataset's card: README.md with the YAML front matter that hubs of datasets read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from spadwarp.dataset.histograms import MEANING
from spadwarp.dataset.recipe import SPLITS
from spadwarp.dataset.sampling import Plan
from spadwarp.dataset.schema import FRAME_COLUMNS, scene_columns

__all__ = ["card"]


def card(plan: Plan, manifest: dict[str, Any]) -> str:
    """The text of README.md."""
    recipe = plan.recipe
    used = [split for split in SPLITS if manifest["splits"][split]["shards"]]
    size = sum(one["bytes"] for one in manifest["files"].values())
    room = f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
    front = [
        "---",
        f"pretty_name: {json.dumps(recipe.name)}",
        "task_categories:",
        "- depth-estimation",
        "- image-to-image",
        "tags:",
        *(f"- {tag}" for tag in ("spad", "single-photon", "underwater", "lidar", "depth", "denoising", "simulation")),
        "size_categories:",
        f"- {_size_category(plan.sample_count)}",
        "configs:",
        "- config_name: frames",
        "  data_files:",
    ]
    for split in used:
        front += [f"  - split: {split}", "    path:"]
        front += [f"    - {name}" for name in manifest["splits"][split]["shards"]]
    front.append("---")
    splits = [
        f"| {split} | {', '.join(manifest['splits'][split]['targets'])} | {manifest['splits'][split]['frames']} "
        f"| {manifest['splits'][split]['seed']} |"
        for split in used
    ]
    tables = _table("`frames-*.h5`", "A row a frame.", FRAME_COLUMNS)
    columns = {name: (unit, text) for name, (_, _, unit, text) in scene_columns(plan).items()}
    tables += _table(
        "`scenes.h5`", "A row a scene. Refers to the files in `scenes/`, which have to be beside it.", columns
    )
    if any(name.startswith("histograms-") for name in manifest["files"]):
        tables += _table("`histograms-*.h5`", "Of the scenes that were traced photon by photon.", MEANING)
    return "\n".join(
        [
            *front,
            "",
            f"# {recipe.name}",
            "",
            *([recipe.description, ""] if recipe.description else []),
            f"{plan.sample_count} simulated single-photon depth frames of {plan.shape[1]} × {plan.shape[0]} pixels, of "
            f"{plan.scene_count} underwater scenes with {len(plan.targets)} targets; {room}. Made by "
            f"spadwarp {manifest['version']} from `recipe.toml`, seed {recipe.seed}. Splits share neither targets nor "
            "seeds.",
            "",
            "| split | targets | frames | seed |",
            "|---|---|---|---|",
            *splits,
            "",
            "## Reading",
            "",
            "```python",
            "import spadwarp",
            "",
            f'for item in spadwarp.iterate_dataset("<this folder>", split="{used[0]}"):',
            '    item["noisy"], item["clean"], item["label"]     # float32 [1, H, W]; NaN: no return, nothing hit',
            "```",
            "",
            "Without spadwarp: depth [m] = offset + step · code, both attributes of `depth`"
            f" (here {plan.depth_offset:.6g} m and {plan.depth_step:.6g} m); code 0 is no return; "
            "`np.unpackbits(label, axis=-1)[..., :width]` are the labels.",
            "",
            *tables,
        ]
    )


def _table(title: str, text: str, columns: Mapping[str, tuple[str, str]]) -> list[str]:
    rows = [f"| `{name}` | {unit} | {meaning} |" for name, (unit, meaning) in columns.items()]
    return [f"## {title}", "", text, "", "| dataset | unit | meaning |", "|---|---|---|", *rows, ""]


def _size_category(count: int) -> str:
    edges = [("n<1K", 1e3), ("1K<n<10K", 1e4), ("10K<n<100K", 1e5), ("100K<n<1M", 1e6), ("1M<n<10M", 1e7)]
    return next((name for name, most in edges if count < most), "10M<n<100M")
