"""The target: its reflectance, patterns on it, and how it reflects."""

from .ggx import ggx_brdf, ggx_normals, ggx_pdf, sample_ggx, unshadowed
from .mesh import (
    SurfaceHit,
    Surfaces,
    Textures,
    intersect_mesh,
    intersect_surfaces,
    lambert_brdf,
    offset_from_surface,
    reflectance_at,
    segment_meets_box,
)

__all__ = [
    "SurfaceHit",
    "Surfaces",
    "Textures",
    "ggx_brdf",
    "ggx_normals",
    "ggx_pdf",
    "intersect_mesh",
    "intersect_surfaces",
    "lambert_brdf",
    "offset_from_surface",
    "reflectance_at",
    "sample_ggx",
    "segment_meets_box",
    "unshadowed",
]
