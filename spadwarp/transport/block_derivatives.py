"""Derivatives by block of the cells of `medium.grid`: their names, and what the kernels take."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import shown
from spadwarp.scene import Scene
from spadwarp.scene.medium import grid_cells
from spadwarp.transport.placement import config_error

if TYPE_CHECKING:
    from spadwarp.scene.grid import GridCells

__all__ = ["BlockParameters", "block_parameters", "block_scales", "check_blocks", "is_of_grid"]

_NAME = re.compile(r"medium\.grid\.(\w+)(?:\[(\d+),(\d+),(\d+)\])?")

Shape = tuple[int, int, int]


@dataclass(frozen=True)
class BlockParameters:
    """Coefficients of a grid's cells, block by block.

    Attributes:
        kinds: Each one of `spadwarp_kernels.BLOCK_DERIVATIVES`.
        shape: Number of blocks along the edges of the box.
    """

    kinds: tuple[str, ...] = ()
    shape: Shape = (1, 1, 1)

    @property
    def names(self) -> tuple[str, ...]:
        """Of each block, such as "medium.grid.absorption[0,2,1]"; kind by kind, the last index fastest."""
        places = list(itertools.product(*map(range, self.shape)))
        return tuple(f"medium.grid.{kind}[{i},{j},{k}]" for kind in self.kinds for i, j, k in places)


def is_of_grid(name: Any) -> bool:
    """Whether a name is that of a coefficient of the grid's cells, of one block or of all."""
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


def block_parameters(names: Sequence[str]) -> BlockParameters:
    """Those of full names, of all blocks in their order; other names are left out.

    Raises `ArgumentError` where blocks are missing.
    """
    found = [match for match in map(_NAME.fullmatch, names) if match is not None]
    if not found:
        return BlockParameters()
    kinds = tuple(dict.fromkeys(match[1] for match in found))
    i, j, k = (max(int(match[axis] or 0) for match in found) + 1 for axis in (2, 3, 4))
    whole = BlockParameters(kinds, (i, j, k))
    if tuple(match[0] for match in found) != whole.names:
        raise ArgumentError(
            f"derivatives: {shown(found[0][0])} ... are not all blocks in their order; ask for "
            f"medium.grid.{kinds[0]} and give blocks, the number of them along the edges"
        )
    return whole


def check_blocks(scene: Scene, names: Sequence[str], blocks: Sequence[int] | None) -> BlockParameters:
    """What names of `is_of_grid` and the number of blocks along the edges ask for; by default one block, all cells.

    Raises:
        ArgumentError: Names, or numbers of blocks, that are none.
        ConfigError: There is no grid, it has no such coefficient or no slope by it, or its cells cannot be divided so.
    """
    if not names:
        if blocks is not None:
            raise ConfigError("blocks go with derivatives by medium.grid.absorption, .scattering or .extinction")
        return BlockParameters()
    if scene.medium.grid is None:
        water = "medium.absorption and medium.scattering are those of its water"
        raise config_error(scene, f"derivatives: {names[0]}, but the scene has no medium.grid; {water}")
    if scene.polarised:
        raise config_error(scene, f"derivatives: {names[0]} goes without polarised light; simulate the scene without")
    if scene.domain.reflecting:
        raise config_error(
            scene, f"derivatives: {names[0]} goes without faces that reflect; leave out domain.outside_index"
        )
    cells = grid_cells(scene.medium)
    if any("[" in name for name in names):
        asked = block_parameters(names)
        if blocks is not None:
            raise ArgumentError(f"blocks go with names of all blocks, such as medium.grid.{asked.kinds[0]}")
    else:
        kinds = tuple(name.rpartition(".")[2] for name in names)
        asked = BlockParameters(kinds, _shape(scene, (1, 1, 1) if blocks is None else blocks, cells))
    _check_kinds(scene, asked, cells)
    return asked


def _shape(scene: Scene, blocks: Any, cells: GridCells) -> Shape:
    """The numbers of blocks, which divide those of the cells."""
    if isinstance(blocks, str) or not hasattr(blocks, "__len__") or len(blocks) != 3:
        raise ArgumentError(f"blocks = {shown(blocks)} is not a list of 3 whole numbers")
    for edge, (count, along) in enumerate(zip(blocks, cells.extinction.shape, strict=True)):
        if isinstance(count, bool) or not isinstance(count, int | np.integer):
            raise ArgumentError(f"blocks = {shown(blocks)} is not a list of 3 whole numbers")
        if count < 1 or along % count:
            possible = [n for n in range(1, along + 1) if along % n == 0]
            raise config_error(
                scene,
                f"blocks[{edge}] = {count} does not divide the {along} cells along {'xyz'[edge]} of medium.grid; "
                f"possible are {', '.join(map(str, possible))}",
            )
    i, j, k = map(int, blocks)
    return i, j, k


def _check_kinds(scene: Scene, asked: BlockParameters, cells: GridCells) -> None:
    import spadwarp_kernels as sk

    for kind in asked.kinds:
        if kind not in sk.BLOCK_DERIVATIVES:
            names = ", ".join(f"medium.grid.{one}" for one in sk.BLOCK_DERIVATIVES)
            raise config_error(scene, f"derivatives: medium.grid.{kind} is not one of {names}")
        values = {"scattering": cells.scattering, "extinction": cells.extinction}.get(kind)
        if values is not None and (empty := int((values <= 0.0).sum())):
            raise config_error(
                scene,
                f"derivatives: medium.grid.{kind} is 0 in {empty} of {values.size} cells, where light that is "
                "scattered has no slope; give the medium a little of it, or ask for medium.grid.absorption",
            )
        if asked.kinds.count(kind) > 1:
            raise ConfigError(f"derivatives: medium.grid.{kind} is named twice")
    if len(asked.names) > sk.MOST_BLOCK_DERIVATIVES:
        way_out = "fewer blocks" + (", or one coefficient a run, with the same seed" if len(asked.kinds) > 1 else "")
        raise ArgumentError(
            f"blocks = {list(asked.shape)} of {', '.join(asked.kinds)} are {len(asked.names)} derivatives; one run "
            f"takes {sk.MOST_BLOCK_DERIVATIVES}: {way_out}"
        )


def block_scales(scene: Scene, asked: BlockParameters, scale: float) -> tuple[float, ...]:
    """Tally units of each kind's derivatives per emitted photon, powers of two.

    Coarser than the histogram's by about the score that the light of a bin may have: four times the diagonal of a
    block, or the mean of 1/b.
    """
    if not asked.kinds:
        return ()
    cells = grid_cells(scene.medium)
    path = 4.0 * math.hypot(*(edge / count for edge, count in zip(cells.size, asked.shape, strict=True)))
    largest = {
        "absorption": path,
        "scattering": max(path, 1.0 / max(float(cells.scattering.mean()), 1e-6)),
        "extinction": max(path, 1.0 / max(float(cells.extinction.mean()), 1e-6)),
    }
    return tuple(scale / 2.0 ** math.ceil(math.log2(largest[kind])) for kind in asked.kinds)
