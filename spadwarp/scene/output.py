"""The section `output`."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from spadwarp.scene.sections import Section


class Output(Section):
    """What a run writes into its directory."""

    section: ClassVar[str] = "output"
    result: bool = Field(True, description="everything, as HDF5")
    exr: bool = Field(True, description="truth and depth, as EXR")
    png: bool = Field(True, description="pictures for a first look")
    pdf: bool = Field(False, description="the same pictures as vectors, for print")
    depth_method: Literal["peak", "centroid", "matched", "likelihood"] = Field(
        "centroid", description="how the depth frame is made"
    )
