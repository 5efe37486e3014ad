"""The water of a scene cut open; sheets of built-in targets, of a mesh file, of frames of a dataset."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from numpy.typing import NDArray

from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.limits import check_integer
from spadwarp.mesh import SIZED_BUILTINS, MeshSummary, TriangleMesh, build_mesh, builtin_names, make_builtin
from spadwarp.scene import Scene
from spadwarp.scene.camera import to_camera, to_world
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.pose import rotation_matrix
from spadwarp.transport import truth_maps
from spadwarp.viz.style import (
    BACKGROUND,
    BLUE,
    BOUND_MAP,
    DEPTH_MAP,
    GREEN,
    INTENSITY_MAP,
    PAGE,
    coloured_depth,
    new_figure,
    paper,
    save,
    spaced,
    strip_bar,
    strips,
    wrapped,
)

__all__ = ["describe_targets", "draw_dataset", "draw_mesh", "draw_targets", "draw_water"]

Floats = NDArray[np.float64]

_STEPS = 400  # of the longer side
# Without cells the densest water may be everywhere: lines and the targets must show on it.
_PALE = LinearSegmentedColormap.from_list("pale water", matplotlib.colormaps[BOUND_MAP](np.linspace(0.0, 0.16, 64)))


@paper()
def draw_water(scene: Scene, path: str | Path, mesh: TriangleMesh | None = None, *, width: float = PAGE) -> Path:
    """Draws the extinction on two planes through the optical axis, from above and from the side, into one picture.

    Args:
        scene: With or without a grid of cells.
        path: The picture.
        mesh: Of the scene, if the caller has it.
        width: Of the picture [inch].

    Raises:
        MeshError: A target that cannot be read.
        FileError: The picture cannot be written, or the cells cannot be read.
    """
    figure = new_figure(width, 0.34 * width)
    mesh = build_mesh(scene) if mesh is None else mesh
    axes = figure.subplots(1, 2)
    images = [draw_slice(axis, scene, mesh, across) for across, axis in enumerate(axes)]
    for axis, title in zip(axes, ("from above", "from the side"), strict=True):
        axis.set_title(title)
    drawn = [image.get_array().max() for image in images]
    extend = "max" if max(drawn) > images[0].norm.vmax else "neither"
    figure.colorbar(images[0], ax=axes, label="extinction [1/m]", shrink=0.7, extend=extend)
    return save(figure, path)


def draw_slice(axis: Axes, scene: Scene, mesh: TriangleMesh | None, across: int) -> Any:
    """One plane through the optical axis: z to the right, x (`across` 0) or y (1) downwards; the image drawn."""
    depth, half = _extent(scene, mesh)
    z = np.linspace(0.0, depth, _STEPS)
    side = np.linspace(-half, half, max(2, round(2.0 * half / depth * _STEPS)))
    points = np.zeros((len(side), len(z), 3))
    points[..., across], points[..., 2] = side[:, None], z
    top = max(water.extinction for water in scene.medium.waters)
    if scene.medium.grid is not None:  # but the densest cells
        top = max(top, float(np.percentile(grid_cells(scene.medium).extinction, 99.5)))
    image = axis.imshow(
        _extinction(scene, points), extent=(0.0, depth, half, -half), vmin=0.0, vmax=top, aspect="equal",
        cmap=_PALE if scene.medium.grid is None else BOUND_MAP,
    )  # fmt: skip
    camera, laser = scene.camera, scene.beam
    tangent = 0.5 * camera.pixel_tangent * (camera.width, camera.height)[across]
    axis.plot([0.0, depth], [0.0, depth * tangent], color=BLUE, lw=0.8)
    axis.plot([0.0, depth], [0.0, -depth * tangent], color=BLUE, lw=0.8, label="view")
    start, along = np.array(laser.position), np.array(laser.axis)
    for sign in (-1.0, 1.0):
        slope = along[across] / max(along[2], 1e-6) + sign * np.tan(min(laser.half_angle, 1.4))
        ends = start[across] + np.array([0.0, slope * (depth - start[2])])
        axis.plot([start[2], depth], ends, color=GREEN, lw=0.8, ls="--", label="beam" if sign > 0 else None)
    if mesh is not None:
        for ends in _section(mesh, 1 - across):
            axis.plot(ends[:, 2], ends[:, across], color="black", lw=1.2)
    axis.set_xlim(0.0, depth)
    axis.set_ylim(half, -half)
    axis.set_xlabel("z [m]")
    axis.set_ylabel("xy"[across] + " [m]")
    axis.legend(loc="upper left", fontsize=6)
    return image


def _extent(scene: Scene, mesh: TriangleMesh | None) -> tuple[float, float]:
    """Depth and half the height of the picture [m]: to the far end of the targets, or the box."""
    camera = scene.camera
    depth, half = 0.5 * scene.path_limit, 0.1
    if mesh is not None:
        depth = 1.05 * float(mesh.bounds[1][2])
    elif scene.medium.grid is not None:
        cells = grid_cells(scene.medium)
        depth = float(to_camera(camera, cells.centre)[2] + 0.6 * np.linalg.norm(cells.size))
    depth = max(depth, 0.01)
    half = max(half, 0.5 * camera.pixel_tangent * max(camera.width, camera.height) * depth)
    if scene.medium.grid is not None:
        cells = grid_cells(scene.medium)
        centre = to_camera(camera, cells.centre)
        half = max(half, float(np.abs(centre[:2]).max()) + 0.5 * max(cells.size[:2]))
    return depth, min(1.15 * half, depth)


def _extinction(scene: Scene, points: Floats) -> Floats:
    """At points of the camera frame."""
    world, medium = to_world(scene.camera, points), scene.medium
    if medium.grid is not None:
        return grid_cells(medium).at(world, medium.extinction)
    values = np.full(points.shape[:-1], medium.extinction)
    along = world @ (np.array(medium.layer_axis) / np.linalg.norm(medium.layer_axis))
    for layer in medium.layers:
        values[along >= layer.start] = layer.extinction
    return values


def _section(mesh: TriangleMesh, axis: int) -> Floats:
    """Where the faces cross the plane of a coordinate 0, `[N, 2, 3]`."""
    from trimesh import Trimesh
    from trimesh.intersections import mesh_plane

    body = Trimesh(mesh.vertices, mesh.faces, process=False)
    normal = np.eye(3)[axis]
    # Beside the middle, where edges of symmetric targets often lie.
    return np.asarray(mesh_plane(body, normal, 1e-4 * normal), np.float64).reshape(-1, 2, 3)


# Sheets


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
