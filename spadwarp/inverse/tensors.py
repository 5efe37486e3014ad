"""The renderer as a function of torch: expected histograms whose gradients are the scored derivatives."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.arrays import Floats
from spadwarp.inverse.unknowns import read_unknowns, with_values
from spadwarp.result.tallies import is_block_name
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.grid import Grid
from spadwarp.scene.medium import grid_cells
from spadwarp.transport import RunOptions, resolve_derivatives, simulate
from spadwarp.values import SEED, ArgumentError, check_integer

if TYPE_CHECKING:
    import torch

__all__ = ["render"]


def render(
    scene: SceneLike, parameters: Mapping[str, torch.Tensor], *, photons: int, seed: int, device: str | None = None
) -> torch.Tensor:
    """Expected detections per pulse of a scene as a differentiable function of its parameters.

    The backward pass takes the derivatives that the photons scored on their way (`simulate(derivatives=…)`); nothing is
    taped. They come from photons of their own, so that the gradient of a squared error of the histogram is unbiased.

    Args:
        scene: With values for all that is not a parameter.
        parameters: By name ("medium.absorption", "medium.scattering", "medium.anisotropy", "targets[k].reflectance",
            or short, as `read_unknowns` takes them) tensors of one number each. "medium.grid.absorption" and
            "medium.grid.scattering", or "medium.grid.extinction" at fixed albedo: tensors `[x, y, z]`, the mean of the
            cells of each block [1/m]; cells differ from it as they do in the scene. As of `simulate(blocks=…)`, their
            numbers divide those of the cells.
        photons: Of each of the two runs.
        seed: 64 bits; another one for every step, or the noise of the simulation is learned.
        device: As in `simulate`; the tensors may lie elsewhere.

    Returns:
        `[H, W, T]` before instrument response and noise, of the type and on the device of the first parameter.

    Raises:
        ArgumentError: A parameter that has no scored derivative, is no single number, no blocks, or out of the scene's
            range.
        ConfigError: Cells that cannot be divided so, or have no slope.
        FileError: torch is not installed.
    """
    import torch

    base, seed = as_scene(scene), check_integer("seed", seed, SEED)
    names, shape = _checked(base, parameters)
    of_grid = [name for name in names if is_block_name(name)]

    class Rendering(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, *values: torch.Tensor) -> torch.Tensor:
            arrays = {name: value.detach().double().cpu().numpy() for name, value in zip(names, values, strict=True)}
            numbers = {name: float(value) for name, value in arrays.items() if name not in of_grid}
            at = with_values(base, numbers)
            options: dict[str, Any] = {"photons": photons, "seed": seed, "device": device}
            with tempfile.TemporaryDirectory() as folder:
                if of_grid:
                    means = {name.rpartition(".")[2]: arrays[name] for name in of_grid}
                    at = with_block_means(at, means, Path(folder))
                result = simulate(at, **options)
                scale = at.detectable_photons_per_pulse
                ctx.slopes = None
                if any(ctx.needs_input_grad):
                    other = simulate(
                        at, derivatives=names, blocks=shape, run=RunOptions(first_photon=photons), **options
                    )
                    ctx.slopes = [(scale * other.derivatives[name].sum(axis=-4)).astype(np.float32) for name in names]
            return torch.as_tensor(scale * result.histogram, dtype=values[0].dtype, device=values[0].device)

        @staticmethod
        def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, ...]:
            (gradient,) = gradients
            slopes = [torch.as_tensor(cube, dtype=gradient.dtype, device=gradient.device) for cube in ctx.slopes]
            return tuple((gradient * cube).sum((-3, -2, -1)) for cube in slopes)

    return Rendering.apply(  # type: ignore[no-any-return,no-untyped-call]
        *(value if is_block_name(name) else value.reshape(()) for name, value in parameters.items())
    )


def _checked(scene: Scene, parameters: Mapping[str, torch.Tensor]) -> tuple[list[str], tuple[int, ...] | None]:
    """Full names of the parameters, those of a grid without the block, and the numbers of blocks."""
    import torch

    plain = [name for name in parameters if not is_block_name(name)]
    unknowns = dict(zip(plain, read_unknowns(scene, plain), strict=True)) if plain else {}
    names, shapes = list[str](), set[tuple[int, ...]]()
    for name, value in parameters.items():
        unknown, is_tensor = unknowns.get(name), isinstance(value, torch.Tensor)
        if unknown is None:
            if not is_tensor or value.ndim != 3:
                raise ArgumentError(f"parameters: {name} is not a tensor [x, y, z] of blocks")
            shapes.add(tuple(value.shape))
        elif not unknown.is_light or unknown.per_pixel:
            raise ArgumentError(f"parameters: {unknown} has no scored derivative")
        elif not is_tensor or value.numel() != 1:
            raise ArgumentError(f"parameters: {unknown} is not a tensor of one number")
        names.append(unknown.name if unknown else name)
    if len(shapes) > 1:
        raise ArgumentError(f"parameters: blocks of different numbers, {sorted(shapes)}")
    shape = shapes.pop() if shapes else None
    resolve_derivatives(scene, [name for name in names if is_block_name(name)], shape)
    return names, shape


# Blocks of a grid


def with_block_means(scene: Scene, means: Mapping[str, Floats], folder: Path) -> Scene:
    """The scene with other cells: the same addition to all of a block, so that its mean is the one given.

    Args:
        scene: With a grid, divided into blocks as `simulate` divides it.
        means: By "absorption" and "scattering", or by "extinction" at fixed albedo, `[x, y, z]` [1/m].
        folder: For the file of the cells, without which the scene is of no use.

    Raises `ArgumentError` where cells would be negative.
    """
    cells = grid_cells(scene.medium)
    extinction, albedo = cells.extinction.astype(np.float64), cells.albedo.astype(np.float64)
    arrays: dict[str, Any]
    if "extinction" in means:
        if len(means) > 1:
            raise ArgumentError(
                "medium.grid.extinction cannot be combined with medium.grid.absorption and medium.grid.scattering"
            )
        arrays = {"extinction": _moved("extinction", extinction, means["extinction"]), "albedo": albedo}
    else:
        arrays = {"absorption": extinction * (1.0 - albedo), "scattering": extinction * albedo}
        arrays |= {kind: _moved(kind, arrays[kind], values) for kind, values in means.items()}
    if cells.anisotropy is not None:
        arrays["anisotropy"] = cells.anisotropy
    path = folder / "cells.npz"
    np.savez(path, size=cells.size, **arrays)
    old = scene.medium.grid
    assert old is not None
    grid = Grid(file=str(path), translation=cells.centre, rotation_deg=old.rotation_deg, tracking=old.tracking)
    return scene.model_copy(update={"medium": scene.medium.model_copy(update={"grid": grid})})


def _moved(kind: str, cells: Floats, means: Floats) -> Floats:
    shape = [n for count, along in zip(means.shape, cells.shape, strict=True) for n in (count, along // count)]
    blocks = cells.reshape(shape)
    step = means[:, None, :, None, :, None] - blocks.mean(axis=(1, 3, 5), keepdims=True)
    moved = (blocks + step).reshape(cells.shape)
    if not moved.min() >= 0.0:
        worst = float(moved.min())
        raise ArgumentError(
            f"medium.grid.{kind}: the means of the blocks make cells of {worst:.3g} 1/m, outside [0, inf)"
        )
    return moved
