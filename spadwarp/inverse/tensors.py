"""The renderer as a function of torch: expected histograms whose gradients are the scored derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.errors import ArgumentError, FileError
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, read_unknowns, with_values
from spadwarp.limits import SEED, check_integer
from spadwarp.scene import SceneLike, as_scene
from spadwarp.transport import simulate

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
            or short, as `read_unknowns` takes them) tensors of one number each.
        photons: Of each of the two runs.
        seed: 64 bits; another one for every step, or the noise of the simulation is learned.
        device: As in `simulate`; the tensors may lie elsewhere.

    Returns:
        `[H, W, T]` before instrument response and noise, of the type and on the device of the first parameter.

    Raises:
        ArgumentError: A parameter that has no scored derivative, is no single number or out of the scene's range.
        FileError: torch is not installed.
    """
    try:
        import torch
    except ModuleNotFoundError as error:
        raise FileError("render needs torch: pip install 'spadwarp[torch]'") from error
    given, seed = as_scene(scene), check_integer("seed", seed, SEED)
    unknowns = read_unknowns(given, list(parameters))
    for one, value in zip(unknowns, parameters.values(), strict=True):
        if one.name in (DEPTH, BACKGROUND) or one.per_pixel:
            raise ArgumentError(f"parameters: {one} has no scored derivative")
        if not isinstance(value, torch.Tensor) or value.numel() != 1:
            raise ArgumentError(f"parameters: {one} is not a tensor of one number")
    names = tuple(one.name for one in unknowns)

    class Rendering(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, *values: torch.Tensor) -> torch.Tensor:
            numbers = {name: float(value) for name, value in zip(names, values, strict=True)}
            at = with_values(given, numbers)
            run: dict[str, Any] = {"photons": photons, "seed": seed, "device": device}
            result = simulate(at, **run)
            scale = at.laser.photons_per_pulse * at.detections_per_photon
            ctx.slopes = None
            if any(ctx.needs_input_grad):
                other = simulate(at, first_photon=photons, derivatives=list(names), **run)
                ctx.slopes = [(scale * cube.sum(axis=0)).astype(np.float32) for cube in other.derivatives.values()]
            return torch.as_tensor(scale * result.histogram, dtype=values[0].dtype, device=values[0].device)

        @staticmethod
        def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, ...]:
            (gradient,) = gradients
            slopes = [torch.as_tensor(cube, dtype=gradient.dtype, device=gradient.device) for cube in ctx.slopes]
            return tuple((gradient * cube).sum() for cube in slopes)

    shapes = [value.reshape(()) for value in parameters.values()]
    return Rendering.apply(*shapes)  # type: ignore[no-any-return,no-untyped-call]
