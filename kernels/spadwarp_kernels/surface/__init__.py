"""The target: its reflectance, patterns on it, and how it reflects."""

from .ggx import ggx_brdf, ggx_normals, ggx_pdf, reflection_pdf, sample_ggx, sample_reflection, unshadowed
from .lambert import lambert_brdf, sample_cosine_law, sample_lambert
from .mesh import Surfaces, Textures, make_surfaces, make_textures, surface_choices, update_surfaces
from .reflectance import reflectance_at
from .trace import SurfaceHit, intersect_mesh, intersect_surfaces, offset_from_surface

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
    "make_surfaces",
    "make_textures",
    "offset_from_surface",
    "reflectance_at",
    "reflection_pdf",
    "sample_cosine_law",
    "sample_ggx",
    "sample_lambert",
    "sample_reflection",
    "surface_choices",
    "unshadowed",
    "update_surfaces",
]
