"""The water of a scene cut open; sheets of built-in targets, of a mesh file, of frames of a dataset."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb

from spadwarp.arrays import Floats
from spadwarp.dataset import SPLITS, FrameReader
from spadwarp.mesh import SIZED_BUILTINS, MeshSummary, TriangleMesh, build_mesh, builtin_names, make_builtin
from spadwarp.scene import Scene
from spadwarp.scene.camera import to_camera, to_world
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.scene import camera_port, laser_port
from spadwarp.transport import truth_maps
from spadwarp.values import ArgumentError, check_integer, count
from spadwarp.viz import style
from spadwarp.viz.style import BOUND_MAP, DEPTH_MAP, INTENSITY_MAP, PAGE, PaperFigure, coloured_depth, paper, save

__all__ = ["describe_targets", "draw_dataset", "draw_mesh", "draw_targets", "draw_water"]

_STEPS = 400  # of the longer side
# Without cells the densest water may be everywhere: lines and the targets must show on it.
_PALE = LinearSegmentedColormap.from_list("pale water", matplotlib.colormaps[BOUND_MAP](np.linspace(0.0, 0.16, 64)))


@paper()
def draw_water(scene: Scene, path: str | Path, mesh: TriangleMesh | None = None, *, width: float = PAGE) -> Path:
    """Draws the extinction on two planes through the optical axis, from above and from the side; returns the path.

    `mesh`: of the scene, if the caller has it. `width`: of the picture [inch]. Raises `MeshError` for a target that
    cannot be read, `FileError` where the picture cannot be written or the cells cannot be read.
    """
    figure = style.new_figure(width, 0.34 * width)
    mesh = build_mesh(scene) if mesh is None else mesh
    axes = figure.subplots(1, 2)
    images = [draw_slice(axis, scene, mesh, across) for across, axis in enumerate(axes)]
    extend = "max" if max(image.get_array().max() for image in images) > images[0].norm.vmax else "neither"
    figure.colorbar(images[0], ax=axes, label="extinction [1/m]", shrink=0.7, extend=extend)
    figure.key(axes, 1.1)
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
    camera, laser, side = scene.camera, scene.beam, np.eye(3)[across]
    tangent = 0.5 * camera.pixel_tangent * (camera.width, camera.height)[across]
    view: Any = ("camera", "view", "s", "-", style.BLUE, np.zeros(3), np.eye(3)[2], tangent, camera_port(scene))
    spread, place = math.tan(min(laser.half_angle, 1.4)), np.array(laser.position)
    beam: Any = ("laser", "beam", "^", "--", style.GREEN, place, np.array(laser.axis), spread, laser_port(scene))
    for name, label, marker, line, colour, start, along, slope, port in (view, beam):
        axis.plot(start[2], start[across], marker, color=colour, ms=4.0, clip_on=False, zorder=5, label=name)
        for sign in (-1.0, 1.0):
            point, ray = start, (along + sign * slope * side) / np.linalg.norm(along + sign * slope * side)
            if port is not None:
                point, ray, *_ = port.enter(start, ray)
            reach = (depth - point[2]) / ray[2] if ray[2] > 1e-6 else depth  # to the far end, or backwards
            ends = np.array([start, point, point + reach * ray])
            axis.plot(ends[:, 2], ends[:, across], line, color=colour, lw=0.8, label=label if sign > 0.0 else None)
    if mesh is not None:
        for ends in _section(mesh, 1 - across):
            axis.plot(ends[:, 2], ends[:, across], color="black", lw=1.2)
    axis.set(xlim=(0.0, depth), ylim=(half, -half), xlabel="z [m]", ylabel="xy"[across] + " [m]")
    axis.set_title(("from above", "from the side")[across])
    return image


def _extent(scene: Scene, mesh: TriangleMesh | None) -> tuple[float, float]:
    """Depth and half the height of the picture [m]: to the far end of the targets, or the box."""
    camera, depth, half = scene.camera, 0.5 * scene.path_limit, 0.1
    if scene.medium.grid is not None:
        cells = grid_cells(scene.medium)
        centre = to_camera(camera, cells.centre)
        depth = float(centre[2] + 0.6 * np.linalg.norm(cells.size))
        half = float(np.abs(centre[:2]).max()) + 0.5 * max(cells.size[:2])
    depth = max(1.05 * float(mesh.bounds[1][2]) if mesh is not None else depth, 0.01)
    half = max(half, 0.1, 0.5 * camera.pixel_tangent * max(camera.width, camera.height) * depth)
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


def describe_targets() -> list[dict[str, Any]]:
    """Name, faces and extent x, y, z [m] of the built-in targets."""
    meshes = {name: make_builtin(name) for name in builtin_names()}
    return [{"name": name, "faces": len(it.faces), "extent": it.extents.tolist()} for name, it in meshes.items()]


@paper()
def draw_targets(path: str | Path, *, width: float = PAGE, device: str | None = None) -> Path:
    """Draws the built-in targets as seen from 15 m, shaded and as depth maps, into one picture; returns its path.

    `width`: of the picture [inch]; `device`: Warp device for the rays. Raises `FileError`.
    """
    targets: dict[str, dict[str, Any]] = {}
    for name in builtin_names():
        size = {"size": [_SIDE] * (2 if name == "plane" else 3)} if name in SIZED_BUILTINS else {}
        targets[name] = {"builtin": name, "translation": [0.0, 0.0, DISTANCE], **size}
    figure = _target_sheet(targets, 1.5, width, 192, device)
    _sheet_bar(figure, Normalize(DISTANCE - 1.5, DISTANCE + 1.5), DEPTH_MAP, "depth z [m]")
    return save(figure, path)


@paper()
def draw_mesh(mesh: MeshSummary, path: str | Path, *, width: float = PAGE, device: str | None = None) -> Path:
    """Draws a mesh file as the camera sees it, from its side and from above, shaded, with its depth; returns the path.

    `mesh`: from `spadwarp.mesh.describe_mesh`; `width`: of the picture [inch]; `device`: Warp device for the rays.
    Raises `MeshError` if the file of the mesh is gone, `FileError` where the picture cannot be written.
    """
    shown = _SIDE / max(mesh.extent)  # scale that fills the view
    targets = {}
    for rotation in _VIEWS:
        centre = rotation_matrix(rotation) @ (shown * np.array(mesh.centre))
        translation = (np.array([0.0, 0.0, DISTANCE]) - centre).tolist()
        target = {"mesh": str(mesh.path), "scale": shown, "rotation_deg": list(rotation), "translation": translation}
        targets[f"rotation_deg = {[round(angle) for angle in rotation]}"] = target
    figure = _target_sheet(targets, 0.5 * _SIDE, width, 256, device)
    _sheet_bar(figure, Normalize(-0.5 * mesh.longest, 0.5 * mesh.longest), DEPTH_MAP, "depth from the centre [m]")
    metres = " x ".join(f"{mesh.scale * side:.3g}" for side in mesh.extent)
    figure.caption(f"{mesh.path.name}, {metres} m, with scale = {mesh.scale:g}")
    return save(figure, path)


def _target_sheet(
    targets: dict[str, dict[str, Any]], reach: float, width: float, pixels: int, device: str | None
) -> PaperFigure:
    """Targets by title, at 15 m before a camera of 17°, shaded by one lamp and an even sky, and as depth maps."""
    figure, axes = _sheet(len(targets), width, least=1.7, ratio=0.5, title=0.2)
    scale, lamp = Normalize(DISTANCE - reach, DISTANCE + reach), _LIGHT / np.linalg.norm(_LIGHT)
    camera = {"width": 2 * pixels, "height": 2 * pixels, "horizontal_fov_deg": FIELD_OF_VIEW, "aperture_diameter": 0.01}
    rest = {"medium": {"extinction": 0.1, "albedo": 0.8}, "gate": {"bin_width_ps": 100.0, "bins": 1}}
    for axis, (title, target) in zip(axes, targets.items(), strict=True):
        truth = truth_maps(Scene.from_dict({**rest, "camera": camera, "targets": [target]}), device=device)
        normal = truth.normal.astype(np.float64)
        grey = 0.16 + 0.62 * np.clip(normal @ lamp, 0.0, None) + 0.2 * np.clip(-normal[..., 2], 0.0, 1.0)
        matt = (grey[..., None] * np.array([1.0, 0.97, 0.92])).clip(0.0, 1.0)
        matt = np.where(np.isnan(matt), to_rgb(style.BACKGROUND), matt)
        views = np.concatenate([matt, coloured_depth(truth.depth, scale)], axis=1)
        # Means of 2 × 2 pixels.
        axis.imshow(views.reshape(pixels, 2, 2 * pixels, 2, 3).mean(axis=(1, 3)), interpolation="lanczos")
        axis.set_title(title, pad=2)
    return figure


def _sheet(count: int, width: float, *, least: float, ratio: float, title: float) -> tuple[PaperFigure, list[Axes]]:
    """A figure of `count` images without frames; `least`: width of one, `title`: height of its title [inch]."""
    figure, axes = style.panel_grid(count, width, least=least, height=title, ratio=ratio)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.0)  # type: ignore[call-arg,union-attr]
    for axis in axes:
        axis.axis("off")
    return figure, axes


def _sheet_bar(figure: PaperFigure, scale: Normalize, colours: str, label: str) -> None:
    """A colour bar below all images."""
    axes = [axis for axis in figure.axes if axis.images]
    figure.grow(0.5)
    width, height = figure.get_size_inches()
    look = {"shrink": 0.8, "aspect": 0.8 * width / 0.09, "pad": 0.1 / height}
    bar = figure.colorbar(ScalarMappable(scale, colours), ax=axes, location="bottom", label=label, **look)
    bar.outline.set_visible(False)  # type: ignore[operator]
    bar.ax.xaxis.minorticks_on()


@paper()
def draw_dataset(
    folder: str | Path, path: str | Path, *, split: str = "all", frames: int = 20, width: float = PAGE
) -> Path:
    """Draws frames that lie evenly over a split: true depth, measured depth, recorded photons; returns the path.

    Photons are shown relative to the brightest 0.5 % of each frame, which the frame's title gives.

    `split`: "train", "validation", "test" or "all"; `frames`: at most so many, 1 to 1000; `width`: [inch].

    Raises `FileError` where there is no dataset or the picture cannot be written, `ArgumentError`.
    """
    frames = check_integer("frames", frames, "[1, 1000]")
    reader = FrameReader(folder, split, fields=("clean", "noisy", "intensity"))
    if not len(reader):
        raise ArgumentError(f"split = {split!r} holds no frames")
    number = min(frames, len(reader))
    items = [reader[int((k + 0.5) * len(reader) / number)] for k in range(number)]
    splits = {name: split for split in SPLITS for name in reader.manifest["splits"][split]["targets"]}
    height, across = reader.shape
    figure, axes = _sheet(number, width, least=2.3, ratio=height / across / 3, title=0.3)
    beyond = np.concatenate([(item["clean"] - item["distance"]).ravel() for item in items])
    scale = Normalize(*style.shown_limits(beyond, beyond=0.5, margin=0.1))
    gap = np.ones((height, max(1, across // 48), 3))
    by_fraction = False
    for axis, item in zip(axes, items, strict=True):
        clean, noisy = (coloured_depth(item[name][0] - item["distance"], scale) for name in ("clean", "noisy"))
        top = max(float(np.percentile(item["intensity"], 99.5)), 1.0)
        photons = matplotlib.colormaps[INTENSITY_MAP](np.clip(item["intensity"][0] / top, 0.0, 1.0))[..., :3]
        axis.imshow(np.concatenate([clean, gap, noisy, gap, photons], axis=1), aspect="equal")
        name, fraction = reader.manifest["targets"][item["target"]], float(item["backscatter_fraction"])
        by_fraction |= not math.isnan(fraction)
        level = "" if math.isnan(fraction) else f", BS = {fraction:.3g}"
        level += f", brightest {count(round(top))} photons"
        title = f"{name.replace('_', ' ')} ({splits[name]})\nc r = {item['attenuation_lengths']:.2g}{level}"
        axis.set_title(title, fontsize=6.5, pad=2)
    _sheet_bar(figure, Normalize(0.0, 1.0), INTENSITY_MAP, "recorded photons, relative to the brightest")
    _sheet_bar(figure, scale, DEPTH_MAP, "depth beyond the target's centre [m]")
    figure.note(
        "Each frame: true depth, measured depth (light: none), recorded photons (brightest: their 99.5th percentile). "
        "c r: attenuation lengths one way, c being the water's extinction and r the range of the target."
        + (" BS: backscatter fraction, the part of the pixels that report backscatter." if by_fraction else "")
    )
    return save(figure, path)
