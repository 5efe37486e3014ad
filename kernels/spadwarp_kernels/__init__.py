"""Warp functions and kernels for photon transport, SPAD detection and depth; needs warp and numpy only.

Functions marked `wp.func` go into the caller's own kernels; `launch_transport` walks photons against the caller's own
`wp.Mesh`.
"""

from .analytic import sample_frames
from .analytic_budget import BACKSCATTER_SOURCES, Lidar, signal_map, single_scatter_table
from .batches import Batches
from .camera import Camera, lens_point, pixel_direction, project, project_calibrated
from .cramer_rao import COUNT_LAWS, statistics_maps
from .depth import arrival_bins
from .detector import dark_count_rates, event_counts, expected_detections, first_photon_counts
from .direction import one_minus_cosine, orthonormal_basis, rotate_direction, sample_lambert, snap_direction
from .domain import Limits, exit_distance
from .gate import C0, Gate, gate_bin
from .guided import Guiding, PhaseGuide
from .laser import LASER_PROFILES, Laser, Scan, emit_photon, profile_tables
from .launch import (
    Data,
    Model,
    launch_transport,
    load_transport_kernel,
    make_data,
    make_layers,
    make_records,
    make_surfaces,
    make_textures,
    read_ledger,
    surface_choices,
)
from .layers import Layers, layer_index, layered_extinction, layered_free_path, layered_water
from .lens import CALIBRATED, PINHOLE, Lens
from .medium import Medium, free_path
from .microfacet import ggx_brdf, ggx_normals, ggx_pdf, sample_ggx, unshadowed
from .phase import (
    HENYEY_GREENSTEIN,
    PhaseFunction,
    henyey_greenstein_pdf,
    sample_henyey_greenstein,
)
from .phase_densities import (
    fournier_forand_density,
    henyey_greenstein_density,
    interpolated_density,
    sphere_integral,
    two_term_henyey_greenstein_density,
)
from .philox import philox4x32, random_block, u01, u01_fine
from .score import COMPONENTS, next_event_value
from .shadow import near_depth_map
from .surface import (
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
from .tabulated import TABULATED, make_phase_tables
from .tally import COUNTERS, LEDGER_ENTRIES, LEDGER_UNIT, to_fixed_point
from .transport import (
    ESTIMATORS,
    FEW_FACES,
    Records,
    TransportSpec,
    make_transport_kernel,
)
from .truth import truth_kernel

__all__ = [
    "BACKSCATTER_SOURCES",
    "C0",
    "CALIBRATED",
    "COMPONENTS",
    "COUNTERS",
    "COUNT_LAWS",
    "ESTIMATORS",
    "FEW_FACES",
    "HENYEY_GREENSTEIN",
    "LASER_PROFILES",
    "LEDGER_ENTRIES",
    "LEDGER_UNIT",
    "PINHOLE",
    "TABULATED",
    "Batches",
    "Camera",
    "Data",
    "Gate",
    "Guiding",
    "Laser",
    "Layers",
    "Lens",
    "Lidar",
    "Limits",
    "Medium",
    "Model",
    "PhaseFunction",
    "PhaseGuide",
    "Records",
    "Scan",
    "SurfaceHit",
    "Surfaces",
    "Textures",
    "TransportSpec",
    "arrival_bins",
    "dark_count_rates",
    "emit_photon",
    "event_counts",
    "exit_distance",
    "expected_detections",
    "first_photon_counts",
    "fournier_forand_density",
    "free_path",
    "gate_bin",
    "ggx_brdf",
    "ggx_normals",
    "ggx_pdf",
    "henyey_greenstein_density",
    "henyey_greenstein_pdf",
    "interpolated_density",
    "intersect_mesh",
    "intersect_surfaces",
    "lambert_brdf",
    "launch_transport",
    "layer_index",
    "layered_extinction",
    "layered_free_path",
    "layered_water",
    "lens_point",
    "load_transport_kernel",
    "make_data",
    "make_layers",
    "make_phase_tables",
    "make_records",
    "make_surfaces",
    "make_textures",
    "make_transport_kernel",
    "near_depth_map",
    "next_event_value",
    "offset_from_surface",
    "one_minus_cosine",
    "orthonormal_basis",
    "philox4x32",
    "pixel_direction",
    "profile_tables",
    "project",
    "project_calibrated",
    "random_block",
    "read_ledger",
    "reflectance_at",
    "rotate_direction",
    "sample_frames",
    "sample_ggx",
    "sample_henyey_greenstein",
    "sample_lambert",
    "segment_meets_box",
    "signal_map",
    "single_scatter_table",
    "snap_direction",
    "sphere_integral",
    "statistics_maps",
    "surface_choices",
    "to_fixed_point",
    "truth_kernel",
    "two_term_henyey_greenstein_density",
    "u01",
    "u01_fine",
    "unshadowed",
]
