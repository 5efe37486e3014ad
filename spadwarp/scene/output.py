"""The section `output`."""

from __future__ import annotations

from typing import ClassVar, Literal

from spadwarp.scene.sections import Section


class Output(Section):
    """What a run writes into its directory."""

    section: ClassVar[str] = "output"
    result: bool = True
    """everything, as HDF5"""
    exr: bool = True
    """truth and depth, as EXR"""
    png: bool = True
    """pictures for a first look"""
    pdf: bool = False
    """the same pictures as vectors, for print"""
    depth_method: Literal["peak", "centroid", "matched", "likelihood"] = "centroid"
    """how the depth frame is made"""
