"""The parameters of a scene by which its histogram can be differentiated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import shown, suggestion
from spadwarp.scene import Scene
from spadwarp.transport.block_derivatives import (
    block_parameters,
    block_scales,
    check_blocks,
    is_of_grid,
)
from spadwarp.transport.placement import config_error

if TYPE_CHECKING:
    import warp as wp

    from spadwarp.mesh import TriangleMesh

__all__ = [
    "Parameter",
    "derivative_kinds",
    "derivative_names",
    "derivative_units",
    "make_derivatives",
    "resolve_derivatives",
]


@dataclass(frozen=True)
class Parameter:
    """A number of a scene.

    Attributes:
        name: Its place in the scene, such as "medium.layers[1].scattering".
        kind: One of `spadwarp_kernels.DERIVATIVES`.
        value: The number.
        waters: Indices into `scene.medium.waters`: where it holds.
        target: Index into `scene.targets`, else -1.
        problem: Why there is no derivative; empty if there is.
    """

    name: str
    kind: str
    value: float
    waters: tuple[int, ...] = ()
    target: int = -1
    problem: str = ""


_OF_CELLS = "the grid's water differs from cell to cell; medium.grid.absorption and others go by block of its cells"


def _parameters(scene: Scene) -> dict[str, Parameter]:
    """Of the scene, by name; those without a derivative too."""
    medium = scene.medium
    everywhere = 'albedo = "lu2024" draws the scattering anew at every collision' if medium.albedo == "lu2024" else ""
    if scene.polarised:
        everywhere = "light is polarised, whose matrices have no derivatives; simulate the scene without polarisation"
    found: list[Parameter] = []
    in_water = everywhere or (_OF_CELLS if medium.grid is not None else "")
    for k, water in enumerate(medium.waters):
        place = "medium" if k == 0 else f"medium.layers[{k - 1}]"
        for kind in ("absorption", "scattering"):
            value = float(getattr(water, kind))
            nothing = kind == "scattering" and value <= 0.0
            problem = in_water or ("its value is 0, where light that is scattered has no slope" if nothing else "")
            found.append(Parameter(f"{place}.{kind}", kind, value, (k,), problem=problem))
        own = water.anisotropy
        inherits = [i for i, other in enumerate(medium.waters) if i and other.anisotropy is None] if k == 0 else []
        problem = in_water
        if medium.has_phase_table:
            law = medium.phase_function if medium.molecular_share == 0.0 else "of chlorophyll's particles and water"
            problem = problem or f'it goes with phase_function = "henyey_greenstein" only, not with {law}'
        value = medium.anisotropy if own is None else own
        found.append(Parameter(f"{place}.anisotropy", "anisotropy", value, (k, *inherits), problem=problem))
    for k, target in enumerate(scene.targets):
        from_file = isinstance(target.reflectance, str)
        name = f"targets[{k}].reflectance{'_scale' if from_file else ''}"
        value = float(target.reflectance_scale if from_file else target.reflectance)
        problem = everywhere or ("its value is 0" if value <= 0.0 else "")
        found.append(Parameter(name, "reflectance", value, target=k, problem=problem))
    return {one.name: one for one in found}


def derivative_names(scene: Scene) -> tuple[str, ...]:
    """Names of all parameters of a scene by which its histogram can be differentiated; those of a grid's cells without
    the block."""
    import spadwarp_kernels as sk

    found = [name for name, one in _parameters(scene).items() if not one.problem]
    for kind in sk.BLOCK_DERIVATIVES if scene.medium.grid is not None else ():
        try:
            check_blocks(scene, [f"medium.grid.{kind}"], None)
        except ConfigError:
            continue
        found.append(f"medium.grid.{kind}")
    return tuple(found)


def resolve_derivatives(scene: Scene, names: Iterable[str], blocks: Sequence[int] | None = None) -> tuple[str, ...]:
    """The full names of parameters.

    A short name, "absorption", stands for "medium.absorption" where no other parameter of the scene ends with it.
    "medium.grid.absorption", ".scattering" and ".extinction" stand for those of all blocks, of which `blocks` gives the
    number along the edges of the box: "medium.grid.absorption[0,0,0]", ..., behind all others.

    Raises:
        ArgumentError: No list of names, or more than the kernel takes.
        ConfigError: A name that the scene does not have, that stands for several, is given twice, or whose parameter
            has no derivative, or blocks that the grid cannot be divided into.
    """
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ArgumentError(f"derivatives = {shown(names)} is not a list of names")
    import spadwarp_kernels as sk

    known, found, asked = _parameters(scene), list[str](), list(names)
    of_grid = check_blocks(scene, [name for name in asked if is_of_grid(name)], blocks)
    for name in (name for name in asked if not is_of_grid(name)):
        one = _resolve(scene, name, known)
        if one.problem:
            raise config_error(scene, f"derivatives: {one.name} = {one.value:g} has none: {one.problem}")
        if one.name in found:
            raise ConfigError(f"derivatives: {one.name} is named twice")
        found.append(one.name)
    if len(found) > sk.MOST_DERIVATIVES:
        raise ArgumentError(
            f"derivatives: {len(found)} names; one run takes {sk.MOST_DERIVATIVES}, and another run of the same seed "
            "has the same photons"
        )
    return (*found, *of_grid.names)


def _resolve(scene: Scene, name: Any, known: dict[str, Parameter]) -> Parameter:
    if not isinstance(name, str):
        raise ArgumentError(f"derivatives: {shown(name)} is not a name")
    if name in known:
        return known[name]
    if (scaled := known.get(f"{name}_scale")) is not None:
        raise ConfigError(f"derivatives: {name} is from the file; {scaled.name}, the factor on it, has a derivative")
    ends = [one for one in known.values() if one.kind == name or one.name.endswith(f".{name}")]
    if len(ends) == 1:
        return ends[0]
    if ends:
        meant = ", ".join(one.name for one in ends)
        raise ConfigError(f"derivatives: {name!r} is one of {len(ends)} parameters of the scene; give one of {meant}")
    names = derivative_names(scene) or tuple(known)
    raise config_error(scene, f"derivatives: {shown(name)} is not one of {', '.join(names)}{suggestion(name, names)}")


def derivative_units(scene: Scene, names: Sequence[str], scale: float) -> tuple[float, ...]:
    """Of each derivative's tallies [fraction of an emitted photon per unit of the parameter], a power of two.

    Coarser than the histogram's by about the score that the light of a bin may have: its path, 1/b, that of the most
    telling scattering, or two bounces. The brightest bin has 16 times the room that it needs by this estimate.
    """
    known, of_grid, units = _parameters(scene), block_parameters(names), list[float]()
    for name in _others(names):
        one = known[name]
        largest = {
            "absorption": scene.path_limit,
            "scattering": max(scene.path_limit, 1.0 / max(one.value, 1e-6)),
            "anisotropy": (3.0 + abs(one.value)) / (1.0 - one.value**2) if one.kind == "anisotropy" else 0.0,
            "reflectance": 2.0 / max(one.value, 1e-9),
        }[one.kind]
        units.append(2.0 ** math.ceil(math.log2(largest)) / scale)
    for of_kind in block_scales(scene, of_grid, scale):
        units += [1.0 / of_kind] * math.prod(of_grid.shape)
    return tuple(units)


def _others(names: Sequence[str]) -> list[str]:
    return [name for name in names if not is_of_grid(name)]


def make_derivatives(
    scene: Scene, names: Sequence[str], mesh: TriangleMesh | None, scale: float, device: wp.Device, grid: Any
) -> Any:
    """The parameters as the kernels take them; `grid` is that of the model's layers."""
    import spadwarp_kernels as sk

    known, of_grid = _parameters(scene), block_parameters(names)
    chosen = [known[name] for name in _others(names)]
    waters = [sum(1 << p for p, one in enumerate(chosen) if k in one.waters) for k in range(len(scene.medium.waters))]
    faces: Any = ()
    if mesh is not None:
        bits = [sum(1 << p for p, one in enumerate(chosen) if one.target == k) for k in range(len(scene.targets))]
        faces = np.array(bits, dtype=np.int32)[mesh.target]
    return sk.make_derivatives(
        [one.kind for one in chosen],
        [one.value for one in chosen],
        [1.0 / unit for unit in derivative_units(scene, _others(names), scale)],
        waters=waters,
        faces=faces,
        blocks=sk.make_blocks(grid, of_grid.shape, block_scales(scene, of_grid, scale)) if of_grid.kinds else None,
        device=device,
    )


def derivative_kinds(scene: Scene, names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What the kernel is compiled for: kinds of parameters, and of those by block."""
    known = _parameters(scene)
    return tuple(known[name].kind for name in _others(names)), block_parameters(names).kinds
