"""Sheets of small images: built-in targets, a mesh file, frames of a dataset."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgb
from numpy.typing import NDArray

from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.limits import check_integer
from spadwarp.mesh import SIZED_BUILTINS, MeshSummary, builtin_names, make_builtin
from spadwarp.scene import Scene
from spadwarp.scene.pose import rotation_matrix
from spadwarp.transport import truth_maps
from spadwarp.viz.style import (
    BACKGROUND,
    DEPTH_MAP,
    INTENSITY_MAP,
    PAGE,
    coloured_depth,
    paper,
    save,
    spaced,
    strip_bar,
    strips,
    wrapped,
)

__all__ = ["describe_targets", "draw_dataset", "draw_mesh", "draw_targets"]

DISTANCE = 15.0  # [m]
FIELD_OF_VIEW = 17.0  # [°]
_SIDE = 3.5  # [m] of targets that have no size of their own
_VIEWS = ((0.0, 0.0, 0.0), (0.0, 90.0, 0.0), (90.0, 0.0, 0.0))  # rotations [°]
_LIGHT = np.array([-0.35, -0.5, -0.79])  # direction to a lamp on the upper left of the camera


def describe_targets(names: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Name, faces and extent x, y, z [m] of built-in targets; all if `names` is None. Raises `ArgumentError`."""
    described = []
    for name in builtin_names() if names is None else names:
        mesh = make_builtin(name)
        described.append({"name": name, "faces": len(mesh.faces), "extent": [float(side) for side in mesh.extents]})
    return described


@paper()
def draw_targets(
    path: str | Path,
    *,
    names: Sequence[str] | None = None,
    pixels: int = 192,
    width: float = PAGE,
    device: str | None = None,
) -> Path:
    """Draws built-in targets as seen from 15 m, shaded and as depth maps, into one PNG; returns its path.

    Args:
        path: The picture.
        names: Of the targets, in this order; all if None.
        pixels: Width and height of each view, > 0.
        width: Of the picture [inch].
        device: Warp device for the rays.

    Raises:
        ConfigError: An unknown name.
        FileError: The picture cannot be written.
    """
    chosen = list(builtin_names() if names is None else names)
    figure, axes, (bar,) = strips(len(chosen), width=width, least=1.7, ratio=0.5, title=0.2)
    scale = Normalize(DISTANCE - 1.5, DISTANCE + 1.5)
    for axis, name in zip(axes, chosen, strict=False):
        size = {"size": [_SIDE] * (2 if name == "plane" else 3)} if name in SIZED_BUILTINS else {}
        target = {"builtin": name, "translation": [0.0, 0.0, DISTANCE], **size}
        _show_target(axis, target, scale, pixels, device)
        axis.set_title(name, pad=2)
    strip_bar(bar, scale, DEPTH_MAP, "depth z [m]")
    return save(figure, path)


@paper()
def draw_mesh(
    mesh: MeshSummary, path: str | Path, *, pixels: int = 256, width: float = PAGE, device: str | None = None
) -> Path:
    """Draws a mesh file as the camera sees it, from its side and from above, shaded, with its depth; returns the path.

    Args:
        mesh: From `spadwarp.mesh.describe_mesh`.
        path: The picture.
        pixels: Width and height of each view, > 0.
        width: Of the picture [inch].
        device: Warp device for the rays.

    Raises:
        MeshError: The file of the mesh is gone.
        FileError: The picture cannot be written.
    """
    shown = _SIDE / max(mesh.extent)  # scale that fills the view
    metres = " x ".join(f"{mesh.scale * side:.3g}" for side in mesh.extent)
    figure, axes, (bar,) = strips(len(_VIEWS), width=width, least=1.7, ratio=0.5, title=0.2)
    scale = Normalize(DISTANCE - 0.5 * _SIDE, DISTANCE + 0.5 * _SIDE)
    for axis, rotation in zip(axes, _VIEWS, strict=False):
        centre = rotation_matrix(rotation) @ (shown * np.array(mesh.centre))
        target = {"mesh": str(mesh.path), "scale": shown, "rotation_deg": list(rotation)}
        target["translation"] = [float(x) for x in np.array([0.0, 0.0, DISTANCE]) - centre]
        _show_target(axis, target, scale, pixels, device)
        axis.set_title(f"rotation_deg = {[round(angle) for angle in rotation]}", pad=3)
    own = Normalize(-0.5 * mesh.longest, 0.5 * mesh.longest)
    strip_bar(bar, own, DEPTH_MAP, "depth from the centre [m]")
    figure.suptitle(wrapped(f"{mesh.path.name}: {metres} m with scale = {mesh.scale:g}", width - 0.3))
    return save(figure, path)


def _show_target(axis: Axes, target: dict[str, Any], scale: Normalize, pixels: int, device: str | None) -> None:
    """A target at 15 m before a camera of 17°, shaded and as a depth map; means of 2 × 2 pixels."""
    camera = {"width": 2 * pixels, "height": 2 * pixels, "horizontal_fov_deg": FIELD_OF_VIEW, "aperture_diameter": 0.01}
    scene = Scene.from_dict(
        {
            "medium": {"extinction": 0.1, "albedo": 0.8},
            "camera": camera,
            "gate": {"bin_width_ps": 100.0, "bins": 1},
            "targets": [target],
        }
    )
    truth = truth_maps(scene, device=device)
    views = np.concatenate([_shaded(truth.normal), coloured_depth(truth.depth, scale)], axis=1)
    axis.imshow(views.reshape(pixels, 2, 2 * pixels, 2, 3).mean(axis=(1, 3)), interpolation="lanczos")


def _shaded(normal: NDArray[np.float32]) -> NDArray[np.float64]:
    """RGB of a matt surface under one lamp and an even sky, `[H, W, 3]`."""
    n = normal.astype(np.float64)
    lamp = np.clip(n @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, None)
    facing = np.clip(-n[..., 2], 0.0, 1.0)
    grey = 0.16 + 0.62 * lamp + 0.2 * facing
    image = grey[..., None] * np.array([1.0, 0.97, 0.92])
    return np.where(np.isfinite(grey)[..., None], image, to_rgb(BACKGROUND)).clip(0.0, 1.0)


@paper()
def draw_dataset(
    folder: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    split: str = "all",
    frames: int = 20,
    width: float = PAGE,
) -> Path:
    """Draws frames that lie evenly over a split into one PNG: true depth, measured depth, recorded photons.

    Photons are shown relative to the brightest 0.5 % of each frame, which the frame's title gives.

    Args:
        folder: The dataset.
        path: The picture.
        split: "train", "validation", "test" or "all".
        frames: At most so many, 1 to 1000.
        width: Of the picture [inch].

    Raises:
        FileError: No dataset, or the picture cannot be written.
        ArgumentError: An argument out of range.
    """
    frames = check_integer("frames", frames, "[1, 1000]")
    reader = FrameReader(folder, split, fields=("clean", "noisy", "intensity"))
    if not len(reader):
        raise ArgumentError(f"split = {split!r} holds no frames")
    number = min(frames, len(reader))
    items = [reader[int((k + 0.5) * len(reader) / number)] for k in range(number)]
    splits = {name: split for split, value in reader.manifest["splits"].items() for name in value["targets"]}
    height, across = reader.shape
    figure, axes, bars = strips(number, width=width, least=2.3, ratio=height / across / 3, title=0.34, bars=2)
    scale = _depth_scale(items)
    gap = np.ones((height, max(1, across // 48), 3))
    for axis, item in zip(axes, items, strict=False):
        clean, noisy = (coloured_depth(item[name][0] - item["distance"], scale) for name in ("clean", "noisy"))
        intensity = item["intensity"][0]
        top = max(float(np.percentile(intensity, 99.5)), 1.0)
        photons = matplotlib.colormaps[INTENSITY_MAP](np.clip(intensity / top, 0.0, 1.0))[..., :3]
        axis.imshow(np.concatenate([clean, gap, noisy, gap, photons], axis=1), aspect="equal")
        name = reader.manifest["targets"][item["target"]]
        axis.set_title(_title(item, f"{name.replace('_', ' ')} ({splits[name]})", top), fontsize=6.5, pad=2)
    strip_bar(bars[0], scale, DEPTH_MAP, "depth beyond the target's centre [m]", bars=2)
    strip_bar(bars[1], Normalize(0.0, 1.0), INTENSITY_MAP, "recorded photons, relative to the brightest", bars=2)
    note = (
        "Each frame: true depth, measured depth (light: none), recorded photons (brightest: their 99.5th percentile). "
        "c r: attenuation lengths one way, c being the water's extinction and r the range of the target."
    )
    if not all(math.isnan(float(item["backscatter_fraction"])) for item in items):
        note += " BS: backscatter fraction, the part of the pixels that report backscatter."
    return save(figure, path, note=note)


def _title(item: dict[str, Any], name: str, top: float) -> str:
    """Target, attenuation lengths, backscatter fraction where it is known, largest number of photons in colours."""
    fraction = float(item["backscatter_fraction"])
    level = "" if math.isnan(fraction) else f", BS = {fraction:.3g}"
    return f"{name}\nc r = {item['attenuation_lengths']:.2g}{level}, brightest {spaced(round(top))} photons"


def _depth_scale(items: Sequence[dict[str, Any]]) -> Normalize:
    """The span of the true depths, seen from the targets' centres."""
    values = np.concatenate([(item["clean"] - item["distance"]).ravel() for item in items])
    values = values[np.isfinite(values)]
    if not values.size:
        return Normalize(-1.0, 1.0)
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.1 * (high - low) + 0.05
    return Normalize(float(low - margin), float(high + margin))
