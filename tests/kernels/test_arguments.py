"""What launches with beginners' arguments: an error that names argument, value and range, before anything runs."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import on_device
from helpers.lidar import lidar
from helpers.lit_box import lit_box
from helpers.meshes import mesh_of
from spadwarp_kernels import analytic, detection
from spadwarp_kernels.optics import DOME_PORT

NEXT_EVENT = sk.TransportSpec("next_event")


@pytest.fixture(scope="module")
def box():
    shape = trimesh.creation.box((1.0, 1.0, 1.0))
    shape.apply_translation((0.0, 0.0, 5.0))
    return mesh_of(shape.vertices, shape.faces)


def model_of(mesh, *, keep=True, use_warp_bvh=False, device="cpu", scale=2.0**50, **changes):
    """A lit box in water; `changes` are structs, or fields of them as `struct__field`."""
    made = lit_box()
    for name, value in changes.items():
        owner, _, field = name.partition("__")
        if field:
            setattr(made[owner], field, value)
        else:
            made[owner] = value
    surfaces = sk.make_surfaces(mesh, 0.5, use_warp_bvh=use_warp_bvh) if mesh else sk.make_surfaces(None, device="cpu")
    return sk.Model(device=device, mesh=mesh if keep else None, surfaces=surfaces, scale=scale, **made)


def launch(model, spec=NEXT_EVENT, *, data=None, photon_count=10, seed=1, first_id=0):
    data = sk.make_data(model) if data is None else data
    sk.launch_transport(spec, model, data, seed=seed, first_id=first_id, photon_count=photon_count)
    return data


def test_what_is_valid_runs_also_with_a_count_that_is_written_as_a_float(box):
    """What a spec does not read may be anything."""
    data = launch(model_of(box, guiding__probability=2.0, limits__lateral=-1.0), photon_count=1e3)
    assert sum(sk.read_ledger(data)[0].values()) * sk.LEDGER_UNIT == 1000
    launch(model_of(None), sk.TransportSpec("next_event", mesh=False))


CALIBRATED = {"camera__focal": wp.vec2(20.0, 20.0), "camera__view": wp.vec4(-0.1, -0.1, 0.1, 0.1)}


@pytest.mark.parametrize(
    ("spec", "changes", "text"),
    [
        ({}, {"medium__extinction": -0.1}, r"model.medium.extinction = -0.1\d* is outside \[0, inf\)"),
        ({}, {"laser__axis": wp.vec3(0.0)}, r"model.laser.axis .* has the length 0; a unit vector is needed"),
        ({}, {"camera": sk.Camera()}, r"model.camera.width = 0 is outside \[1,"),
        ({}, {"gate__stop": 8.0}, r"model.gate.stop = 8.0 is outside \(8.0, inf\)"),
        ({"estimator": "guided"}, {"guiding__probability": 2.0}, r"guiding.probability = 2.0 is outside \[0, 1\)"),
        ({"bounded": True}, {"limits__lateral": -1.0}, r"model.limits.lateral = -1.0 is outside \(0, inf\)"),
        ({"layered": True}, {}, "model.layers.start is None; a wp.array of float32"),
        ({"phase": sk.TABULATED}, {}, "model.medium.phase.cells is None"),
        ({"lens": sk.CALIBRATED}, {}, r"model.camera.focal\[0\] = 0.0 is outside \(0, inf\)"),
        ({"lens": sk.CALIBRATED, "confocal": True}, CALIBRATED, r"model.scan.count = 0 is outside \[1, 12\]"),
        ({"rotated_domain": True}, {}, "model.limits.rotation = .* a unit vector is needed"),
        ({"phase": "henyey_greenstein"}, {}, "spec.phase = 'henyey_greenstein' is not a"),
        ({"bounded": "yes"}, {}, "spec.bounded = 'yes' is not True or False"),
        ({"records": True}, {}, r"has room for 0 photons; spec.records = True needs 10"),
        ({"use_warp_bvh": True}, {"use_warp_bvh": True, "keep": False}, r"use_warp_bvh = True reads the mesh that the"),
        ({}, {"scale": math.nan}, "model.scale = nan is outside"),
        ({}, {"medium": sk.Gate()}, "model.medium is a Gate; a Medium is needed"),
        ({}, {"device": "gpu"}, "model.device = 'gpu' is not a device of this machine"),
    ],
)
def test_models_and_specs(box, spec, changes, text):
    """Arrays that were missing, an empty camera or gate, and a mesh that nobody keeps were segmentation faults."""
    with pytest.raises(sk.ArgumentError, match=text):
        launch(model_of(box, **changes), sk.TransportSpec(**{"estimator": "next_event", **spec}))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"photon_count": 0}, r"photon_count = 0 is outside \[1, 67108864\]"),
        ({"first_id": 2**64 - 5}, r"first_id = 18446744073709551611 is outside \[0, 18446744073709551606\]"),
        ({"spec": "next_event"}, "spec = 'next_event' is not a TransportSpec"),
        ({"spec": sk.TransportSpec("other")}, "estimator = 'other' is not one of 'none', 'analog', 'next_event', 'gui"),
    ],
)
def test_launches(box, arguments, text):
    with pytest.raises(sk.ArgumentError, match=text):
        launch(model_of(box), **arguments)


def test_data_of_another_model(box):
    model = model_of(box)
    with pytest.raises(sk.ArgumentError, match=r"data.tally is a wp.array of int64, shape \(288,\); .* \(576,\)"):
        launch(model_of(box, camera__width=8), data=sk.make_data(model))
    with pytest.raises(sk.ArgumentError, match="tally is ndarray of shape"):
        sk.make_data(model, tally=np.zeros(9))
    for name, other in (("offset", wp.int64), ("gradients", wp.float32)):  # where none are needed
        for value in (wp.zeros(1, dtype=wp.vec4, device="cpu"), wp.zeros(1, dtype=other, device="cpu"), 3):
            with pytest.raises(sk.ArgumentError, match=rf"data\.{name}"):
                launch(model, data=dataclasses.replace(sk.make_data(model), **{name: value}))


def test_meshes_and_rasters_of_another_model(box):
    with pytest.raises(sk.ArgumentError, match=r"spec.mesh = True needs surfaces of a mesh"):
        launch(model_of(None))
    other = wp.Mesh(wp.clone(box.points), wp.clone(box.indices))
    spec = sk.TransportSpec("next_event", use_warp_bvh=True)
    with pytest.raises(sk.ArgumentError, match=r"spec\.use_warp_bvh = True reads the mesh that the surfaces were made"):
        launch(dataclasses.replace(model_of(box, use_warp_bvh=True), mesh=other), spec)
    scan = sk.Scan()
    scan.count, scan.axis = 12, wp.zeros(12, dtype=wp.vec3, device="cpu")
    scan.view = wp.zeros(5, dtype=wp.vec4, device="cpu")
    model = dataclasses.replace(model_of(box, **CALIBRATED), scan=scan)
    with pytest.raises(sk.ArgumentError, match=r"entries of model.scan.view = 5 is outside"):
        launch(model, sk.TransportSpec("next_event", lens=sk.CALIBRATED, confocal=True))


PORT = {"index": (1.0, 1.5, 1.34), "group_index": (1.0, 1.5, 1.36)}
SEA = {"index": 1.34, "normal": (0.0, 0.0, 1.0), "height": 0.0}
NONE = {"kinds": (), "value": (), "scale": (1.0,), "channels": 1, "device": "cpu"}
TILT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
CORNERS, ONES = np.zeros((1, 3, 2)), np.ones((2, 2, 2))
GRID = {"extinction": ONES, "albedo": ONES, "size": (1.0, 1.0, 1.0), "device": "cpu"}
CELLS = sk.make_grid(np.ones((4, 2, 2)), np.ones((4, 2, 2)), size=(1.0, 1.0, 1.0), device="cpu")


def in_cells(**choices):
    sk.make_transport_kernel(sk.TransportSpec(grid=sk.REGULAR_TRACKING, **choices))


def polarised(**arguments):
    sk.make_polarisation(**arguments, device="cpu")


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: sk.make_boundary([1, 0, 0], [0, 0]), r"high has shape \(2,\); \(3,\)"),
        (lambda: sk.make_boundary([0, 0, 0], [0, 0, 0]), "all faces let all light out"),
        (lambda: sk.make_boundary([0, 1, 0], [0, 0, 0], max_reflections=9), "max_reflections = 9 is outside"),
        (lambda: sk.make_grid(**GRID | {"extinction": np.ones((2, 2))}), r"extinction has shape \(2, 2\); \(any, any"),
        (lambda: sk.make_grid(**GRID | {"extinction": -ONES}), r"extinction\[0, 0, 0\] = -1 is outside \[0, inf\)"),
        (lambda: sk.make_grid(**GRID | {"albedo": np.ones((2, 2, 3))}), r"albedo has shape \(2, 2, 3\); \(2, 2, 2\)"),
        (lambda: sk.make_grid(**GRID, rotation=np.ones((3, 3))), "rotation = "),
        (lambda: sk.make_blocks(CELLS, (3, 2, 1), [1.0]), "does not divide 4"),
        (lambda: sk.make_blocks(CELLS, (2, 2, 1), []), "kinds of derivatives by block"),
        (lambda: sk.make_transport_kernel(sk.TransportSpec(blocks=("absorption",))), r"spec\.blocks"),
        (lambda: in_cells(blocks=("absorption", "absorption")), r"spec\.blocks"),
        (lambda: in_cells(blocks=("absorption",), bounded=True, reflecting=True), r"spec\.blocks"),
        (lambda: sk.make_layers([0, 5, 1], [1] * 3, [0] * 3, [0] * 3), r"start\[2\] = 1 is outside \[5.0, inf\)"),
        (lambda: sk.make_layers([0, 1], [0.3], [0, 0], [0, 0]), r"extinction has shape \(1,\); \(2,\)"),
        (lambda: sk.interpolated_density([0.1], [1.0]), "two or more"),
        (lambda: sk.interpolated_density([0.1, 0.1], [1.0, 1.0]), "ascending"),
        (lambda: sk.interpolated_density([-0.1, 1.0], [1.0, 1.0]), "outside"),
        (lambda: sk.interpolated_density([0.1, 1.0], [1.0, -1.0]), r"values\[1\] = -1"),
        (lambda: sk.sphere_integral(lambda t: None), "what function returns has shape"),
        (lambda: sk.surface_choices(sk.Surfaces()), "surfaces.corner_reflectance is None"),
        (lambda: sk.make_textures(np.array([3]), CORNERS, [CORNERS[0]]), r"face\[0\] = 3 is not whole or outside \[-1"),
        (lambda: sk.make_textures(np.array([0]), CORNERS, [[[0.5, 2.0]]]), r"images\[0\]\[0, 1\] = 2 is outside \["),
        (lambda: sk.make_derivatives(**NONE, waters=[0.5]), r"waters\[0\] = 0.5 is not whole or outside"),
        (lambda: sk.make_sea((0.01, 0.0), **SEA), r"variances\[1\] = 0.0 is outside"),
        (lambda: sk.make_sea((0.01, 0.01), **SEA, along=(0.0, 0.0, 2.0)), "length of along in the plane"),
        (lambda: sk.make_flat_port(**PORT, distance=0.0), "reaches through the port"),
        (lambda: sk.make_flat_port(**PORT, distance=0.001, normal=TILT, aperture_radius=0.02), "through the port"),
        (lambda: sk.make_dome_port(**PORT, radius=0.05, thickness=0.0, centre=(0.0, 0.0, 0.06)), "too far"),
        (lambda: analytic.make_optics([]), r"port = \[\] is not a PortKind or None"),
        (lambda: polarised(laser=(1.0, 0.9, 0.9, 0.0)), "not a Stokes vector"),
        (lambda: polarised(matrix=lambda c: np.full((len(c), 5), 1.5)), r"matrix\(cosines\)\[0, 0\] = 1.5"),
        (lambda: polarised(matrix=lambda c: np.zeros((3, 5))), r"has shape \(3, 5\)"),
        (lambda: polarised(channels=[[1.0, 0.0]]), r"channels has shape \(1, 2\); \(1, 4\)"),
    ],
)
def test_parts_of_a_model(call, text):
    with pytest.raises(sk.ArgumentError, match=text):
        call()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"reflectance": np.full(12, 0.5)}, r"reflectance is ndarray of shape \(12,\); a wp.array of float32"),
        ({"reflectance": [0.1] * 11 + [1.5]}, r"reflectance\[11\] = 1.5 is outside \[0, 1\]"),
        ({"corner_reflectance": [[0.1, 0.2, -0.5]] * 12}, r"corner_reflectance\[0, 2\] = -0.5 is outside"),
        ({"specular": 0.6, "reflectance": 0.5}, r"reflectance\[0\] \+ specular\[0\] = 1.1 is outside \[0, 1\]"),
        ({"specular": [0.0] * 5}, "specular has 5 entries; the mesh has 12 faces"),
        ({"camera": sk.Camera()}, r"camera.width = 0 is outside \[1,"),
    ],
)
def test_surfaces(box, arguments, text):
    arrays = {name: on_device(value) for name, value in arguments.items() if isinstance(value, list)}
    with pytest.raises(sk.ArgumentError, match=text):
        sk.make_surfaces(box, **arguments | arrays)


def arrays(*shapes, dtype=float):
    return [wp.full(shape, 0.01, dtype=dtype, device="cpu") for shape in shapes]


def wrong_rate(hazard, rate):
    values = hazard.numpy().copy()
    values[2, 3] = rate
    return wp.array(values, device="cpu")


EVENTS = {"edges": np.linspace(0, 1e-7, 9), "recorded": 8, "period": 1e-6, "pulses": 10, "seed": 1}
MATRIX = {"row_start": np.array([0, 1]), "source_bin": np.array([0]), "weight": np.ones(1), "width": np.ones(1)}


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda h: sk.first_photon_counts(wrong_rate(h, -1.0), pulses=1, seed=1), "hazard of pixel 2 holds numbers"),
        (lambda h: sk.event_counts(wrong_rate(h, math.nan), **EVENTS), "hazard of pixel 2 holds numbers"),
        (lambda h: sk.first_photon_counts(h.flatten(), pulses=1, seed=1), r"shape \(48,\); .* shape \(any, any\)"),
        (lambda h: sk.event_counts(h, **EVENTS | {"edges": np.zeros(5)}), r"edges has shape \(5,\); \(9,\)"),
        (lambda h: sk.event_counts(h, **EVENTS | {"edges": np.zeros(9)}), "edges do not rise from 0"),
        (lambda h: sk.arrival_bins(h, background=arrays((0, 1))[0]), r"background has shape \(0, 1\)"),
        (lambda h: sk.arrival_bins(h, method="matched", response=np.zeros((16, 3))), "largest of response = 0.0"),
        (lambda h: detection.add_crosstalk(h, h, image_width=5, probability=0.1), "image_width = 5 does not divide"),
        (
            lambda h: sk.expected_detections(h, **MATRIX | {"source_bin": np.array([8])}, noise_rate=arrays(6)[0]),
            r"source_bin\[0\] = 8 is not whole or outside \[0, 7\]",
        ),
        (lambda h: sk.expected_detections(h, **MATRIX, noise_rate=arrays(3)[0]), r"noise_rate is .* shape \(3,\)"),
    ],
)
def test_detection(call, text):
    """Most of these read or wrote beyond an array."""
    with pytest.raises(sk.ArgumentError, match=text):
        call(arrays((6, 8))[0])


DOME, PORTS = analytic.make_optics(DOME_PORT, DOME_PORT), sk.make_dome_port(**PORT, radius=0.08, thickness=0.006)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"sigma": 0.0}, r"lidar.sigma = 0.0 is outside \(0, inf\)"),
        ({"axis": (0.0, 0.0, 0.0)}, "lidar.axis .* a unit vector is needed"),
        ({"optics": DOME}, r"lidar\.ports\.camera\.index\[0\] = 0.0 is outside \[1, inf\)"),
        ({"optics": DOME, "port": PORTS, "profile": 2, "radius": 0.1}, "a collimated beam does not stay one behind a"),
        ({"optics": DOME, "port": PORTS, "lu2024": 1}, "lidar.lu2024 = 1 is for a camera and a laser in the water"),
        ({"optics": "flat"}, "is not of make_optics"),
    ],
)
def test_lidars_and_their_optics(changes, text):
    view, numbers = wp.zeros(4, dtype=wp.vec3d, device="cpu"), arrays(4, dtype=wp.float64)[0]
    given = {name: value for name, value in changes.items() if name == "optics"}
    one = lidar(**{name: value for name, value in changes.items() if name not in ("optics", "port")})
    if "port" in changes:
        one.ports.camera = one.ports.laser = changes["port"]
    with pytest.raises(sk.ArgumentError, match=text):
        sk.signal_map(one, view, numbers, view, numbers, **given)


def test_maps_of_another_size():
    view, (three, four, nine) = wp.zeros(4, dtype=wp.vec3d, device="cpu"), arrays(3, 4, 9, dtype=wp.float64)
    with pytest.raises(sk.ArgumentError, match=r"distance is a wp.array of float64, shape \(3,\); .* \(4,\)"):
        sk.single_scatter_table(lidar(), nine, view, three)
    with pytest.raises(sk.ArgumentError, match=r"level is a wp.array of float64, shape \(3,\)"):
        analytic.outlier_probabilities(four, three, three)
    sight, maps, tables = wp.zeros(4, dtype=wp.vec3, device="cpu"), arrays(4, 4, 4, 4), arrays((1, 2), (1, 2))
    keywords = {"laser": (0, 0, 0), "gate_paths": (1.0, 2.0), "first_frame": 0, "frames": 2, "seed": 1}
    sk.sample_frames(sight, *maps, *tables, **keywords)
    with pytest.raises(sk.ArgumentError, match=r"probability is a wp.array of float32, shape \(3,\)"):
        sk.sample_frames(sight, *maps[:2], *arrays(3), *maps[3:], *tables, **keywords)
    with pytest.raises(sk.ArgumentError, match=r"columns of paths = 1 is outside \[2,"):
        sk.sample_frames(sight, *maps, *arrays((1, 1), (1, 1)), **keywords)
    with pytest.raises(sk.ArgumentError, match=r"frames = -1 is outside \[0,"):
        sk.sample_frames(sight, *maps, *tables, **keywords | {"frames": -1})
