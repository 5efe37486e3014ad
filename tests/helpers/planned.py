"""A scene whose experiment is planned: a plate, a little turned, in water of 2.4 optical depths."""

SCENE = {
    "medium": {"extinction": 0.4, "albedo": 0.7, "group_index": 1.36},
    "laser": {"position": [-0.1, 0, 0], "half_angle_deg": 10.0, "repetition_rate": 1e5, "pulse_energy": 1e-9},
    "camera": {"width": 16, "height": 12, "horizontal_fov_deg": 12.0, "aperture_diameter": 0.02},
    "gate": {"start_ns": 0.0, "bin_width_ps": 50.0, "bins": 10},
    "targets": [{"builtin": "plane", "size": [8, 8], "translation": [0, 0, 6.0], "rotation_deg": [0, 10, 0]}],
}
