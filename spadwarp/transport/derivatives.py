"""The parameters of a scene by which its histogram can be differentiated, also by block of the cells of its grid."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import spadwarp_kernels as sk
from spadwarp.mesh import TriangleMesh
from spadwarp.result.tallies import GRID, BlockParameters, block_parameters, is_block_name
from spadwarp.scene import Scene
from spadwarp.scene.medium import constituent_order, grid_cells
from spadwarp.values import ArgumentError, ConfigError, shown, suggestion

__all__ = ["derivative_names", "resolve_derivatives"]


class Parameter(NamedTuple):
    """A number of a scene, of waters, of a target or a constituent (-1: of none), or a coefficient of a grid's cells
    (without value).

    Its kind is one of the kernels' `DERIVATIVES` or `BLOCK_DERIVATIVES`; `problem` says why there is no derivative.
    """

    kind: str
    value: float | None
    problem: str
    waters: tuple[int, ...] = ()
    target: int = -1
    constituent: int = -1


def _parameters(scene: Scene) -> dict[str, Parameter]:
    """Those of the scene, by name, such as "medium.layers[1].scattering"; also those without a derivative."""
    medium, found = scene.medium, dict[str, Parameter]()
    everywhere = 'albedo = "lu2024" draws the scattering anew at every collision' if medium.albedo == "lu2024" else ""
    if scene.polarised:
        everywhere = "light is polarised, whose matrices have no derivatives; simulate the scene without polarisation"
    if medium.inelastic:
        everywhere = "light of other wavelengths has no derivatives; leave out medium.inelastic"
    in_water = everywhere
    if medium.is_mixture and not everywhere:
        in_water = "the water is a sum of constituents; their concentrations have derivatives"
    if medium.grid is not None and not everywhere:
        in_water = "the grid's water differs from cell to cell; medium.grid.absorption and others go by block of cells"
    of_table = ""
    if medium.has_phase_table:
        law = medium.phase_function if medium.molecular_share == 0.0 else "of chlorophyll's particles and water"
        of_table = f'it goes with phase_function = "henyey_greenstein" only, not with {law}'
    for k, water in enumerate(medium.waters):
        place = "medium" if k == 0 else f"medium.layers[{k - 1}]"
        found[f"{place}.absorption"] = Parameter("absorption", float(water.absorption), in_water, (k,))
        dark = "its value is 0, where light that is scattered has no slope" if water.scattering <= 0.0 else ""
        found[f"{place}.scattering"] = Parameter("scattering", float(water.scattering), in_water or dark, (k,))
        inherits = [i for i, other in enumerate(medium.waters) if i and other.anisotropy is None] if k == 0 else []
        value = medium.anisotropy if water.anisotropy is None else water.anisotropy
        found[f"{place}.anisotropy"] = Parameter("anisotropy", value, in_water or of_table, (k, *inherits))
    for k, target in enumerate(scene.targets):
        from_file = isinstance(target.reflectance, str)
        value = float(target.reflectance_scale if from_file else target.reflectance)
        problem = everywhere or ("its value is 0" if value <= 0.0 else "")
        name = f"targets[{k}].reflectance{'_scale' if from_file else ''}"
        found[name] = Parameter("reflectance", value, problem, target=k)
    found |= _concentrations(scene, everywhere)
    return found | {
        f"{GRID}{kind}": Parameter(kind, None, _cells_problem(scene, kind)) for kind in sk.BLOCK_DERIVATIVES
    }


def _concentrations(scene: Scene, everywhere: str) -> dict[str, Parameter]:
    """Of the constituents: of all water but the layers that give their own, and of each of those."""
    medium, found = scene.medium, dict[str, Parameter]()
    if medium.grid is not None and not everywhere:
        everywhere = "the grid's water differs from cell to cell; take differences of two runs with one seed"
    for i, one in enumerate(medium.constituents):
        own = [k for k, layer in enumerate(medium.layers, 1) if one.name in (layer.concentrations or {})]
        shared = tuple(k for k in range(len(medium.waters)) if k not in own)
        places = {f"medium.constituents[{i}].concentration": shared}
        places |= {f"medium.layers[{k - 1}].concentrations.{one.name}": (k,) for k in own}
        for name, waters in places.items():
            value = medium.concentrations_in(medium.waters[waters[0]])[i]
            dark = "its value is 0, where light that is scattered has no slope"
            problem = everywhere or (dark if value <= 0.0 < one.scattering else "")
            found[name] = Parameter("concentration", value, problem, waters, constituent=i)
    return found


def _cells_problem(scene: Scene, kind: str) -> str:
    if scene.medium.grid is None:
        return "the scene has no medium.grid; medium.absorption and medium.scattering are those of its water"
    if scene.polarised:
        return "it cannot be combined with polarised light; simulate the scene without"
    if scene.domain.reflecting:
        return "it cannot be combined with faces that reflect; leave out domain.outside_index"
    values = np.ones(1) if kind == "absorption" else getattr(grid_cells(scene.medium), kind)
    if empty := int((values <= 0.0).sum()):
        return (
            f"it is 0 in {empty} of {values.size} cells, where light that is scattered has no slope; give the medium a "
            "little of it, or ask for medium.grid.absorption"
        )
    return ""


def derivative_names(scene: Scene) -> tuple[str, ...]:
    """Names of all parameters of a scene by which its histogram can be differentiated; those of a grid's cells without
    the block."""
    return tuple(name for name, parameter in _parameters(scene).items() if not parameter.problem)


def resolve_derivatives(scene: Scene, names: Iterable[str], blocks: Sequence[int] | None = None) -> tuple[str, ...]:
    """The full names of parameters.

    A short name, "absorption", stands for "medium.absorption" where no other parameter of the scene ends with it; a
    constituent's name for its concentration.
    "medium.grid.absorption", ".scattering" and ".extinction" stand for those of all blocks, of which `blocks` gives the
    number along the edges of the box, by default one: "medium.grid.absorption[0,0,0]", ..., behind all others.

    Raises `ArgumentError`: no list of names, no numbers of blocks, or more than the kernel takes; `ConfigError`: a name
    that the scene does not have, that stands for several, is given twice, or whose parameter has no derivative, or
    blocks that the grid cannot be divided into.
    """
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ArgumentError(f"derivatives = {shown(names)} is not a list of names")
    asked, known = list(names), _parameters(scene)
    numbered = [name for name in asked if is_block_name(name) and name.endswith("]")]
    of_blocks = block_parameters(numbered)
    if numbered and blocks is not None:
        raise ArgumentError(f"blocks need names of all blocks, such as {GRID}{of_blocks.kinds[0]}")
    asked = [name for name in asked if name not in numbered] + [f"{GRID}{kind}" for kind in of_blocks.kinds]
    found = list[str]()
    for name in asked:
        full = _full_name(scene, name, known)
        if full in found:
            raise ConfigError(f"derivatives: {full} is named twice")
        found.append(full)
    plain = [name for name in found if not is_block_name(name)]
    if len(plain) > sk.MOST_DERIVATIVES:
        raise ArgumentError(
            f"derivatives: {len(plain)} names; one run takes {sk.MOST_DERIVATIVES}, and another run of the same seed "
            "has the same photons"
        )
    kinds = tuple(known[name].kind for name in found if is_block_name(name))
    if kinds and not numbered:
        of_blocks = BlockParameters(kinds, _block_shape(scene, (1, 1, 1) if blocks is None else blocks))
    elif not kinds and blocks is not None:
        raise ConfigError("blocks need derivatives by medium.grid.absorption, .scattering or .extinction")
    if len(of_blocks.names) > sk.MOST_BLOCK_DERIVATIVES:
        way_out = "fewer blocks" + (", or one coefficient a run, with the same seed" if len(kinds) > 1 else "")
        text = f"blocks = {list(of_blocks.shape)} of {', '.join(kinds)} are {len(of_blocks.names)} derivatives"
        raise ArgumentError(f"{text}; one run takes {sk.MOST_BLOCK_DERIVATIVES}: {way_out}")
    return (*plain, *of_blocks.names)


def _full_name(scene: Scene, name: Any, known: dict[str, Parameter]) -> str:
    """Of a parameter that has a derivative."""
    if not isinstance(name, str):
        raise ArgumentError(f"derivatives: {shown(name)} is not a name")
    parts = [one.name for one in scene.medium.constituents]
    if name in parts:
        name = f"medium.constituents[{parts.index(name)}].concentration"
    if name not in known:
        if (scaled := f"{name}_scale") in known:
            raise ConfigError(f"derivatives: {name} is from the file; {scaled}, the factor on it, has a derivative")
        scalars = {full: item.kind for full, item in known.items() if item.value is not None}
        ends = [full for full, kind in scalars.items() if kind == name or full.endswith(f".{name}")]
        if len(ends) > 1:
            text = f"{name!r} is one of {len(ends)} parameters of the scene; give one of {', '.join(ends)}"
            raise ConfigError(f"derivatives: {text}")
        if not ends:
            names = derivative_names(scene) or tuple(known)
            text = f"{shown(name)} is not one of {', '.join(names)}{suggestion(name, names)}"
            raise ConfigError(f"derivatives: {text}", source=scene.source)
        (name,) = ends
    parameter = known[name]
    if parameter.problem:
        value = "" if parameter.value is None else f" = {parameter.value:g}"
        raise ConfigError(f"derivatives: {name}{value} has none: {parameter.problem}", source=scene.source)
    return str(name)


# Blocks of a grid's cells


def _block_shape(scene: Scene, blocks: Any) -> tuple[int, ...]:
    """The numbers of blocks, which divide those of the cells."""
    numbers = isinstance(blocks, Sequence | np.ndarray) and len(blocks) == 3
    if not numbers or any(isinstance(n, bool) or not isinstance(n, int | np.integer) for n in blocks):
        raise ArgumentError(f"blocks = {shown(blocks)} is not a list of 3 whole numbers")
    for edge, (count, along) in enumerate(zip(blocks, grid_cells(scene.medium).extinction.shape, strict=True)):
        if count < 1 or along % count:
            possible = ", ".join(str(n) for n in range(1, along + 1) if along % n == 0)
            text = f"blocks[{edge}] = {count} does not divide the {along} cells along {'xyz'[edge]} of medium.grid"
            raise ConfigError(f"{text}; possible are {possible}", source=scene.source)
    return tuple(map(int, blocks))


# For the kernels


def derivative_kinds(scene: Scene, names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Kinds of parameters, and of those by block, for which the kernel is compiled."""
    known = _parameters(scene) if names else {}
    return tuple(known[name].kind for name in names if not is_block_name(name)), block_parameters(names).kinds


def make_derivatives(
    scene: Scene, names: Sequence[str], mesh: TriangleMesh | None, scale: float, device: wp.Device, grid: Any
) -> Any:
    """The parameters as the kernels take them; `grid` is that of the model's layers."""
    known, of_blocks, blocks = _parameters(scene), block_parameters(names), None
    chosen = [known[name] for name in names if not is_block_name(name)]

    def bits(holds: Any) -> int:
        return sum(1 << p for p, parameter in enumerate(chosen) if holds(parameter))

    of_targets = [bits(lambda parameter, k=k: parameter.target == k) for k in range(len(scene.targets))]
    if of_blocks.kinds:
        cells = grid_cells(scene.medium)
        path = 4.0 * math.hypot(*(edge / count for edge, count in zip(cells.size, of_blocks.shape, strict=True)))
        means = {kind: getattr(cells, kind).mean() if kind != "absorption" else 0.0 for kind in of_blocks.kinds}
        scales = tuple(_coarser(scale, kind, float(mean), path) for kind, mean in means.items())
        blocks = sk.make_blocks(grid, of_blocks.shape, scales)
    order, parts = constituent_order(scene.medium), scene.medium.constituents
    part = [None if one.constituent < 0 else parts[one.constituent] for one in chosen]
    return sk.make_derivatives(
        [parameter.kind for parameter in chosen],
        [parameter.value or 0.0 if of is None else of.scattering for parameter, of in zip(chosen, part, strict=True)],
        [
            _coarser(scale, parameter.kind, parameter.value or 0.0, scene.path_limit * (of.extinction if of else 1.0))
            for parameter, of in zip(chosen, part, strict=True)
        ],
        extinction=[of.extinction if of else 0.0 for of in part],
        constituent=[order.index(one.constituent) if one.constituent in order else 0 for one in chosen],
        waters=[bits(lambda parameter, k=k: k in parameter.waters) for k in range(len(scene.medium.waters))],
        faces=() if mesh is None else np.array(of_targets, dtype=np.int32)[mesh.target],
        blocks=blocks,
        device=device,
    )


def _coarser(scale: float, kind: str, value: float, path: float) -> float:
    """Tally units of a derivative per emitted photon, times the unit of the parameter; a power of two.

    Coarser than the histogram's by about the log derivative that the light of a bin may have: its path [m] (of blocks
    four times the diagonal of one), 1/b, that of the scattering that depends on it most, or two bounces. The brightest
    bin has 16 times the space that it needs by this estimate.
    """
    if kind == "anisotropy":
        largest = (3.0 + abs(value)) / (1.0 - value**2)
    elif kind == "reflectance":
        largest = 2.0 / max(value, 1e-9)
    else:
        largest = path if kind == "absorption" else max(path, 1.0 / max(value, 1e-6))
    return scale / 2.0 ** math.ceil(math.log2(largest))
