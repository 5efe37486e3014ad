"""A plate in water, small enough that fits take seconds; one set of derivatives for all tests, so one kernel."""

from spadwarp.scene import Scene

UNKNOWN = "absorption,scattering,reflectance"
TRUTH = {"medium.absorption": 0.25, "medium.scattering": 0.7, "targets[0].reflectance": 0.4}
CLEAR = {"medium.absorption": 0.25, "medium.scattering": 1e-6}

TABLES = {
    "medium": {"absorption": 0.25, "scattering": 0.7, "anisotropy": 0.85, "group_index": "seawater"},
    "laser": {
        "preset": "picoquant-visuv-532",
        "half_angle_deg": 14.0,
        "position": [-0.05, 0, 0],
        "pulse_energy": 1e-13,
    },
    "camera": {"width": 8, "height": 8, "horizontal_fov_deg": 22.0, "aperture_diameter": 0.02},
    "detector": {"preset": "photon-force-pf32-microlens", "dark_count_rate": 1.0},
    "gate": {"start_ns": 6.0, "bin_width_ps": 110.0, "bins": 160},
    "targets": [{"builtin": "plane", "size": [3.0, 3.0], "translation": [0.0, 0.0, 1.5], "reflectance": 0.4}],
    "transport": {"estimator": "guided", "max_collisions": 40, "weight_cutoff": 1e-5, "axis_threshold": 1.0},
}


def plate(overrides=None):
    """The scene, with other values."""
    scene = Scene.from_dict(TABLES)
    return scene.with_overrides(overrides) if overrides else scene
