"""The parameters of a scene by which its histogram can be differentiated, also by block of the cells of its grid."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import spadwarp_kernels as sk
from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import shown, suggestion
from spadwarp.scene import Scene
from spadwarp.scene.grid import GridCells
from spadwarp.scene.medium import grid_cells

if TYPE_CHECKING:
    import warp as wp

    from spadwarp.mesh import TriangleMesh

__all__ = ["derivative_names", "resolve_derivatives"]

_OF_CELLS = "the grid's water differs from cell to cell; medium.grid.absorption and others go by block of its cells"


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


def _parameters(scene: Scene) -> dict[str, Parameter]:
    """Those of the scene, by name; also those without a derivative."""
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
        inherits = [i for i, other in enumerate(medium.waters) if i and other.anisotropy is None] if k == 0 else []
        problem = in_water
        if medium.has_phase_table:
            law = medium.phase_function if medium.molecular_share == 0.0 else "of chlorophyll's particles and water"
            problem = problem or f'it goes with phase_function = "henyey_greenstein" only, not with {law}'
        value = medium.anisotropy if water.anisotropy is None else water.anisotropy
        found.append(Parameter(f"{place}.anisotropy", "anisotropy", value, (k, *inherits), problem=problem))
    for k, target in enumerate(scene.targets):
        from_file = isinstance(target.reflectance, str)
        name = f"targets[{k}].reflectance{'_scale' if from_file else ''}"
        value = float(target.reflectance_scale if from_file else target.reflectance)
        problem = everywhere or ("its value is 0" if value <= 0.0 else "")
        found.append(Parameter(name, "reflectance", value, target=k, problem=problem))
    return {parameter.name: parameter for parameter in found}


def derivative_names(scene: Scene) -> tuple[str, ...]:
    """Names of all parameters of a scene by which its histogram can be differentiated; those of a grid's cells without
    the block."""
    names = [name for name, parameter in _parameters(scene).items() if not parameter.problem]
    for kind in sk.BLOCK_DERIVATIVES if scene.medium.grid is not None else ():
        try:
            _asked_blocks(scene, [f"medium.grid.{kind}"], None)
        except ConfigError:
            continue
        names.append(f"medium.grid.{kind}")
    return tuple(names)


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
    known, found, asked = _parameters(scene), list[str](), list(names)
    of_grid = _asked_blocks(scene, [name for name in asked if is_block_name(name)], blocks)
    for name in (name for name in asked if not is_block_name(name)):
        parameter = _resolve(scene, name, known)
        if parameter.problem:
            text = f"{parameter.name} = {parameter.value:g} has none: {parameter.problem}"
            raise ConfigError(f"derivatives: {text}", source=scene.source)
        if parameter.name in found:
            raise ConfigError(f"derivatives: {parameter.name} is named twice")
        found.append(parameter.name)
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
    ends = [item for item in known.values() if item.kind == name or item.name.endswith(f".{name}")]
    if len(ends) == 1:
        return ends[0]
    if ends:
        meant = ", ".join(item.name for item in ends)
        raise ConfigError(f"derivatives: {name!r} is one of {len(ends)} parameters of the scene; give one of {meant}")
    names = derivative_names(scene) or tuple(known)
    text = f"{shown(name)} is not one of {', '.join(names)}{suggestion(name, names)}"
    raise ConfigError(f"derivatives: {text}", source=scene.source)


def derivative_kinds(scene: Scene, names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Kinds of parameters, and of those by block, for which the kernel is compiled."""
    known = _parameters(scene)
    return tuple(known[name].kind for name in names if not is_block_name(name)), block_parameters(names).kinds


def make_derivatives(
    scene: Scene, names: Sequence[str], mesh: TriangleMesh | None, scale: float, device: wp.Device, grid: Any
) -> Any:
    """The parameters as the kernels take them; `grid` is that of the model's layers."""
    known, of_grid = _parameters(scene), block_parameters(names)
    chosen = [known[name] for name in names if not is_block_name(name)]
    waters = [
        sum(1 << p for p, parameter in enumerate(chosen) if k in parameter.waters)
        for k in range(len(scene.medium.waters))
    ]
    faces: Any = ()
    if mesh is not None:
        targets = range(len(scene.targets))
        bits = [sum(1 << p for p, parameter in enumerate(chosen) if parameter.target == k) for k in targets]
        faces = np.array(bits, dtype=np.int32)[mesh.target]
    return sk.make_derivatives(
        [parameter.kind for parameter in chosen],
        [parameter.value for parameter in chosen],
        [_tally_scale(scene, parameter, scale) for parameter in chosen],
        waters=waters,
        faces=faces,
        blocks=sk.make_blocks(grid, of_grid.shape, _block_scales(scene, of_grid, scale)) if of_grid.kinds else None,
        device=device,
    )


def _tally_scale(scene: Scene, parameter: Parameter, scale: float) -> float:
    """Tally units of a derivative per emitted photon, times the unit of the parameter; a power of two.

    Coarser than the histogram's by about the log derivative that the light of a bin may have: its path, 1/b, that of
    the scattering that depends on it most, or two bounces. The brightest bin has 16 times the space that it needs by
    this estimate.
    """
    largest = {
        "absorption": scene.path_limit,
        "scattering": max(scene.path_limit, 1.0 / max(parameter.value, 1e-6)),
        "anisotropy": (3.0 + abs(parameter.value)) / (1.0 - parameter.value**2)
        if parameter.kind == "anisotropy"
        else 0,
        "reflectance": 2.0 / max(parameter.value, 1e-9),
    }[parameter.kind]
    return scale / 2.0 ** math.ceil(math.log2(largest))


# Blocks of a grid's cells

_BLOCK_NAME = re.compile(r"medium\.grid\.(\w+)(?:\[(\d+),(\d+),(\d+)\])?")


@dataclass(frozen=True)
class BlockParameters:
    """Coefficients of a grid's cells, block by block.

    Attributes:
        kinds: Each one of `spadwarp_kernels.BLOCK_DERIVATIVES`.
        shape: Number of blocks along the edges of the box.
    """

    kinds: tuple[str, ...] = ()
    shape: tuple[int, ...] = (1, 1, 1)

    @property
    def names(self) -> tuple[str, ...]:
        """Of each block, such as "medium.grid.absorption[0,2,1]"; kind by kind, the last index fastest."""
        indices = list(itertools.product(*map(range, self.shape)))
        return tuple(f"medium.grid.{kind}[{i},{j},{k}]" for kind in self.kinds for i, j, k in indices)


def is_block_name(name: Any) -> bool:
    """Whether a name is that of a coefficient of the grid's cells, of one block or of all."""
    return isinstance(name, str) and _BLOCK_NAME.fullmatch(name) is not None


def block_parameters(names: Sequence[str]) -> BlockParameters:
    """Those of full names, of all blocks in their order; other names are left out.

    Raises `ArgumentError` where blocks are missing.
    """
    found = [match for match in map(_BLOCK_NAME.fullmatch, names) if match is not None]
    if not found:
        return BlockParameters()
    kinds = tuple(dict.fromkeys(match[1] for match in found))
    whole = BlockParameters(kinds, tuple(max(int(match[axis] or 0) for match in found) + 1 for axis in (2, 3, 4)))
    if tuple(match[0] for match in found) != whole.names:
        raise ArgumentError(
            f"derivatives: {shown(found[0][0])} ... are not all blocks in their order; ask for "
            f"medium.grid.{kinds[0]} and give blocks, the number of them along the edges"
        )
    return whole


def _asked_blocks(scene: Scene, names: Sequence[str], blocks: Sequence[int] | None) -> BlockParameters:
    """The parameters of block names and of the number of blocks along the edges; by default one block, all cells.

    Raises:
        ArgumentError: Names, or numbers of blocks, that are none.
        ConfigError: There is no grid, it has no such coefficient or no slope by it, or its cells cannot be divided so.
    """
    if not names:
        if blocks is not None:
            raise ConfigError("blocks need derivatives by medium.grid.absorption, .scattering or .extinction")
        return BlockParameters()
    problem = ""
    if scene.medium.grid is None:
        problem = ", but the scene has no medium.grid; medium.absorption and medium.scattering are those of its water"
    elif scene.polarised:
        problem = " cannot be combined with polarised light; simulate the scene without"
    elif scene.domain.reflecting:
        problem = " cannot be combined with faces that reflect; leave out domain.outside_index"
    if problem:
        raise ConfigError(f"derivatives: {names[0]}{problem}", source=scene.source)
    cells = grid_cells(scene.medium)
    if any("[" in name for name in names):
        asked = block_parameters(names)
        if blocks is not None:
            raise ArgumentError(f"blocks need names of all blocks, such as medium.grid.{asked.kinds[0]}")
    else:
        kinds = tuple(name.rpartition(".")[2] for name in names)
        asked = BlockParameters(kinds, _block_shape(scene, (1, 1, 1) if blocks is None else blocks, cells))
    _check_kinds(scene, asked, cells)
    return asked


def _block_shape(scene: Scene, blocks: Any, cells: GridCells) -> tuple[int, ...]:
    """The numbers of blocks, which divide those of the cells."""
    numbers = isinstance(blocks, Sequence | np.ndarray) and len(blocks) == 3
    if not numbers or any(isinstance(n, bool) or not isinstance(n, int | np.integer) for n in blocks):
        raise ArgumentError(f"blocks = {shown(blocks)} is not a list of 3 whole numbers")
    for edge, (count, along) in enumerate(zip(blocks, cells.extinction.shape, strict=True)):
        if count < 1 or along % count:
            possible = [n for n in range(1, along + 1) if along % n == 0]
            raise ConfigError(
                f"blocks[{edge}] = {count} does not divide the {along} cells along {'xyz'[edge]} of medium.grid; "
                f"possible are {', '.join(map(str, possible))}",
                source=scene.source,
            )
    return tuple(map(int, blocks))


def _check_kinds(scene: Scene, asked: BlockParameters, cells: GridCells) -> None:
    for kind in asked.kinds:
        if kind not in sk.BLOCK_DERIVATIVES:
            names = ", ".join(f"medium.grid.{name}" for name in sk.BLOCK_DERIVATIVES)
            raise ConfigError(f"derivatives: medium.grid.{kind} is not one of {names}", source=scene.source)
        values = {"scattering": cells.scattering, "extinction": cells.extinction}.get(kind)
        if values is not None and (empty := int((values <= 0.0).sum())):
            raise ConfigError(
                f"derivatives: medium.grid.{kind} is 0 in {empty} of {values.size} cells, where light that is "
                "scattered has no slope; give the medium a little of it, or ask for medium.grid.absorption",
                source=scene.source,
            )
        if asked.kinds.count(kind) > 1:
            raise ConfigError(f"derivatives: medium.grid.{kind} is named twice")
    if len(asked.names) > sk.MOST_BLOCK_DERIVATIVES:
        way_out = "fewer blocks" + (", or one coefficient a run, with the same seed" if len(asked.kinds) > 1 else "")
        raise ArgumentError(
            f"blocks = {list(asked.shape)} of {', '.join(asked.kinds)} are {len(asked.names)} derivatives; one run "
            f"takes {sk.MOST_BLOCK_DERIVATIVES}: {way_out}"
        )


def _block_scales(scene: Scene, asked: BlockParameters, scale: float) -> tuple[float, ...]:
    """As `_tally_scale`, of each kind: by four times the diagonal of a block, or the mean of 1/b."""
    cells = grid_cells(scene.medium)
    path = 4.0 * math.hypot(*(edge / count for edge, count in zip(cells.size, asked.shape, strict=True)))
    largest = {
        "absorption": path,
        "scattering": max(path, 1.0 / max(float(cells.scattering.mean()), 1e-6)),
        "extinction": max(path, 1.0 / max(float(cells.extinction.mean()), 1e-6)),
    }
    return tuple(scale / 2.0 ** math.ceil(math.log2(largest[kind])) for kind in asked.kinds)
