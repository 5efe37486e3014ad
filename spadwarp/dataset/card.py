"""The dataset's card: README.md with the YAML front matter that hubs of datasets read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from spadwarp.dataset.recipe import SPLITS
from spadwarp.dataset.sampling import Plan
from spadwarp.dataset.schema import FRAME_COLUMNS, HISTOGRAM_COLUMNS, scene_columns

__all__ = ["card"]

_TAGS = ("spad", "single-photon", "underwater", "lidar", "depth", "denoising", "simulation")
_SIZES = {"n<1K": 1e3, "1K<n<10K": 1e4, "10K<n<100K": 1e5, "100K<n<1M": 1e6, "1M<n<10M": 1e7}


def card(plan: Plan, manifest: dict[str, Any]) -> str:
    """The text of README.md."""
    recipe = plan.recipe
    used = {split: manifest["splits"][split] for split in SPLITS if manifest["splits"][split]["shards"]}
    size = sum(record["bytes"] for record in manifest["files"].values())
    size_text = f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"
    splits = [
        f"| {name} | {', '.join(split['targets'])} | {split['frames']} | {split['seed']} |"
        for name, split in used.items()
    ]
    columns = {name: (unit, text) for name, (_, _, unit, text) in scene_columns(plan.shape).items()}
    tables = [
        *_table("`frames-*.h5`", "One row for each frame.", FRAME_COLUMNS),
        *_table("`scenes.h5`", "One row for each scene. It refers to the files in `scenes/` beside it.", columns),
    ]
    if any(name.startswith("histograms-") for name in manifest["files"]):
        tables += _table("`histograms-*.h5`", "Of the scenes that were traced photon by photon.", HISTOGRAM_COLUMNS)
    return "\n".join(
        [
            *_front_matter(plan, used),
            "",
            f"# {recipe.name}",
            "",
            *([recipe.description, ""] if recipe.description else []),
            f"{plan.sample_count} simulated single-photon depth frames of {plan.shape[1]} × {plan.shape[0]} pixels, of "
            f"{plan.scene_count} underwater scenes with {len(plan.targets)} targets; {size_text}. Made by "
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
            "import spadwarp.dataset",
            "",
            f'for item in spadwarp.dataset.iterate_dataset("<this folder>", split="{next(iter(used))}"):',
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


def _front_matter(plan: Plan, splits: Mapping[str, Any]) -> list[str]:
    sizes = (name for name, limit in _SIZES.items() if plan.sample_count < limit)
    lines = [
        "---",
        f"pretty_name: {json.dumps(plan.recipe.name)}",
        "task_categories:",
        "- depth-estimation",
        "- image-to-image",
        "tags:",
        *(f"- {tag}" for tag in _TAGS),
        "size_categories:",
        f"- {next(sizes, '10M<n<100M')}",
        "configs:",
        "- config_name: frames",
        "  data_files:",
    ]
    for name, split in splits.items():
        lines += [f"  - split: {name}", "    path:", *(f"    - {shard}" for shard in split["shards"])]
    return [*lines, "---"]


def _table(title: str, text: str, columns: Mapping[str, tuple[str, str]]) -> list[str]:
    rows = [f"| `{name}` | {unit} | {meaning} |" for name, (unit, meaning) in columns.items()]
    return [f"## {title}", "", text, "", "| dataset | unit | meaning |", "|---|---|---|", *rows, ""]
