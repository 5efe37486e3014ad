"""The section `scan`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from spadwarp.scene.sections import Section


class Scan(Section):
    """How the beam moves over the scene."""

    section: ClassVar[str] = "scan"
    mode: Literal["none", "confocal"] = "none"
    """confocal: the beam visits the pixels in turn and each sees its own light alone"""
    distance: float = Field(math.inf, ge=1e-6, le=math.inf, allow_inf_nan=True)
    """range at which a confocal beam crosses its pixel's line of sight [m]; inf is parallel"""
