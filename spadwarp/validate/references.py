"""The reference values of the cases, each with its source.

Some published values have more digits here than were published: those of the float64 references of the test suite
(`tests/reference/`). The tests compare these references with the published digits, and the values here with the
references.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple


class Slab(NamedTuple):
    """An index-matched slab, normal incidence: fractions that leave it, `transmitted` with the direct beam, or their
    derivatives."""

    anisotropy: float
    albedo: float
    optical_depth: float
    reflected: Any
    transmitted: Any

    @property
    def text(self) -> str:
        depth = "half-space" if math.isinf(self.optical_depth) else f"τ {self.optical_depth:g}"
        return f"g {self.anisotropy:g}, ω {self.albedo:g}, {depth}"


# Rows 1–3 and the isotropic half-space: van de Hulst, "Multiple Light Scattering" (1980); Prahl. The others:
# adding–doubling.
SLABS = (
    Slab(0.75, 0.9, 2.0, 0.09739464, 0.66095770),
    Slab(0.0, 0.5, 1.0, 0.09911919, 0.44605839),
    Slab(0.924, 0.8, 3.0, 0.01735090, 0.49253490),
    Slab(0.0, 1.0, 4.0, 0.69092618, 0.30907382),
    Slab(-0.5, 0.9, 1.0, 0.36729029, 0.50184716),
    Slab(0.924, 0.97, 7.5, 0.10822358, 0.61149022),
    Slab(0.0, 0.8, math.inf, 0.28525450, 0.0),
    Slab(0.924, 0.95, math.inf, 0.10773397, 0.0),
)


# Derivatives at an extinction of 1 1/m by absorption [m], scattering [m] and anisotropy: adding–doubling,
# differentiated numerically.
SLAB_DERIVATIVES = (
    Slab(0.0, 0.9, 0.5, (-0.15272215, 0.15742895, -0.18840523), (-0.46695804, -0.17009768, 0.18806004)),
    Slab(0.0, 0.9, 2.0, (-0.95368366, 0.22686175, -0.24997523), (-1.17738796, -0.26992162, 0.23115400)),
    Slab(0.0, 0.9, 8.0, (-1.63715047, 0.18287816, -0.21256956), (-0.29527945, -0.04178317, 0.03199551)),
    Slab(0.5, 0.9, 0.5, (-0.07898399, 0.08149315, -0.18624387), (-0.50015071, -0.09201544, 0.20497228)),
    Slab(0.5, 0.9, 2.0, (-0.66549053, 0.19152481, -0.39040836), (-1.48073237, -0.24998057, 0.46368231)),
    Slab(0.5, 0.9, 8.0, (-1.57833685, 0.18069401, -0.36763430), (-0.79779839, -0.09731067, 0.16375440)),
    Slab(0.924, 0.9, 0.5, (-0.00902234, 0.00829725, -0.10478131), (-0.48347152, -0.01037582, 0.13060156)),
    Slab(0.924, 0.9, 2.0, (-0.08811821, 0.02901992, -0.36240427), (-1.66786320, -0.05107528, 0.62809605)),
    Slab(0.924, 0.9, 8.0, (-0.42092961, 0.05840857, -0.71951477), (-2.86269922, -0.14106234, 1.66293832)),
)


class Stack(NamedTuple):
    """Layers from the illuminated side on: (anisotropy, albedo, extinction [1/m], thickness [m]); normal incidence."""

    layers: tuple[tuple[float, float, float, float], ...]
    reflected: float
    transmitted: float

    @property
    def text(self) -> str:
        return "τ " + ", ".join(f"{extinction * thickness:g}" for *_, extinction, thickness in self.layers)


# Adding–doubling. The same layers from both sides.
_LAYERS = ((0.924, 0.8, 1.0, 1.0), (0.5, 0.9, 3.0, 0.5), (0.0, 0.5, 0.5, 1.0))
STACKS = (Stack(_LAYERS, 0.11763994, 0.30108700), Stack(_LAYERS[::-1], 0.14047414, 0.30510878))

# Diffuse light by the cosine of its direction to the face's normal: adding–doubling.
EXIT_COSINE_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
EXIT_COSINES = (
    (SLABS[0], "exit_z_low", (0.00541087, 0.01644196, 0.02370346, 0.02622244, 0.02561590)),
    (SLABS[0], "exit_z_high", (0.00701837, 0.02727954, 0.05625321, 0.10640841, 0.32866287)),
    (SLABS[6], "exit_z_low", (0.01317904, 0.03823315, 0.06010053, 0.07883574, 0.09490605)),
)


# A short pulse on a half-space, normal incidence: fractions reflected by bin of path [m]. Doubling at complex
# absorption, transformed back to path length (Abate & Whitt 1995).
TIME_RESOLVED_MEDIUM = {"scattering": 0.9, "absorption": 0.1, "anisotropy": 0.5}
TIME_RESOLVED_EDGES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
TIME_RESOLVED = (0.04104309, 0.03773958, 0.06089517, 0.07164072, 0.04903578)

# Exact: ⟨z⟩ [m], ⟨r²⟩ [m²] for isotropic scattering of 1/m after a path of 5 m; ⟨z⟩, ⟨r²⟩, ⟨cosθ⟩ for g = 0.924 after
# 5 collisions.
AFTER_PATH = (0.993262, 8.013476)
AFTER_COLLISIONS = (4.295598, 27.128079, 0.673535)

# ⟨cosθ⟩ after 5 collisions, g = 0.924, by the rule's threshold (1: off): density of the cosine from collision to
# collision.
NEAR_AXIS = {0.9: 0.70988679, 0.97: 0.68573084, 0.9998: 0.67353803, 1.0: 0.67353452}

# Reflectance of the isotropic half-space, ω = 0.8, by weight cut-off (0: none): sums of the orders of scattering that
# survive.
CUTOFF = {0.05: 0.28315764, 2e-4: 0.28525224, 0.0: 0.28525450}


# Light of an isotropic point source, isotropic scattering of 1/m, after a path [m], by shell of radius [m]:
# Fourier–Laplace solution of the transport equation; the outermost shell holds the unscattered front.
FLUENCE_ABSORPTION, FLUENCE_PATH = 0.2, 5.0
FLUENCE_EDGES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
FLUENCE = (0.0169338, 0.0877305, 0.1297344, 0.0951447, 0.0383361)

# Fractions absorbed, pencil and isotropic source: MCX's `cube60` benchmark, published to 0.01 %.
CUBE60 = (0.1769, 0.8857)
CUBE60_ROUNDING = 0.5e-4

# Collected fractions by optical path from 2 m on in bins of 1 m: quadrature. Key: what is summed; rows and columns
# from 0.
SINGLE_SCATTER: dict[str, tuple[slice, slice, tuple[float, ...]]] = {
    "whole field": (slice(0, 32), slice(0, 32), (3.442913e-9, 2.050495e-9, 1.021325e-9, 5.080060e-10, 2.684784e-10)),
    "on axis, 2 × 2 pixels": (slice(15, 17), slice(15, 17), (0.0, 0.0, 7.17902e-12, 9.87632e-12, 5.37423e-12)),
    "rows 15–16, columns 6–7": (
        slice(15, 17),
        slice(6, 8),
        (9.56975e-11, 4.64951e-11, 2.05836e-11, 1.01402e-11, 5.35647e-12),
    ),
    "rows 9–10, columns 8–9": (
        slice(9, 11),
        slice(8, 10),
        (6.44637e-12, 4.02951e-11, 2.05685e-11, 1.01337e-11, 5.35337e-12),
    ),
}

# The same for light reflected once by the plane at 5 m: quadrature.
LAMBERTIAN: dict[str, tuple[slice, slice, float]] = {
    "whole field": (slice(0, 32), slice(0, 32), 9.9012051e-9),
    "on axis, 8 × 8 pixels": (slice(12, 20), slice(12, 20), 6.3366294e-10),
    "upper left corner, 8 × 8 pixels": (slice(0, 8), slice(0, 8), 6.0534246e-10),
    "lower right corner, 8 × 8 pixels": (slice(24, 32), slice(24, 32), 6.0889339e-10),
}

# Fournier–Forand of n 1.10, µ 3.5835: parts scattered by more than 90° and by less than this angle [°], from its closed
# integral; ⟨cosθ⟩ after 1 and 5 collisions, ⟨z⟩ [m] and ⟨r²⟩ [m²] at the fifth, 1/c = 1 m, exact for that ⟨cosθ⟩.
FOURNIER_FORAND_ANGLE = 0.1
FOURNIER_FORAND = (0.01831268, 0.06828709, 0.92996306, 0.69555021, 4.34698866, 27.34160312)

# The same as SINGLE_SCATTER's whole field: quadrature.
FOURNIER_FORAND_SINGLE_SCATTER = (5.995214e-9, 3.578479e-9, 1.784040e-9, 8.877888e-10, 4.693142e-10)
