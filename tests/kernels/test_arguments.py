"""What launches with beginners' arguments: an error that names argument, value and range, before anything runs."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
from spadwarp_kernels import analytic, detection


@pytest.fixture(scope="module")
def box():
    shape = trimesh.creation.box((1.0, 1.0, 1.0))
    shape.apply_translation((0.0, 0.0, 5.0))
    points = wp.array(shape.vertices, dtype=wp.vec3, device="cpu")
    return wp.Mesh(points, wp.array(shape.faces.ravel(), dtype=int, device="cpu"))


def structs(**changes):
    """A lit box in water: the structs of a model by name, fresh ones for every test."""
    made = lit_box()
    for name, value in changes.items():
        owner, _, field = name.partition("__")
        setattr(made[owner], field, value)
    return made


def launch(box, spec, *, data=None, photon_count=10, model=None, seed=1, first_id=0, **changes):
    if model is None:
        surfaces = sk.make_surfaces(box, 0.5)
        model = sk.Model(device="cpu", mesh=box, surfaces=surfaces, scale=2.0**50, **structs(**changes))
    data = sk.make_data(model) if data is None else data
    sk.launch_transport(spec, model, data, seed=seed, first_id=first_id, photon_count=photon_count)
    return data


NEXT_EVENT = sk.TransportSpec("next_event")


def test_what_is_valid_runs_also_with_a_count_that_is_written_as_a_float(box):
    data = launch(box, NEXT_EVENT, photon_count=1e3)
    assert sum(sk.read_ledger(data)[0].values()) * sk.LEDGER_UNIT == 1000


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"medium__extinction": -0.1}, r"model.medium.extinction = -0.1\d* is outside \[0, inf\)"),
        ({"medium__extinction": math.nan}, r"model.medium.extinction = nan is outside \[0, inf\)"),
        ({"medium__albedo": 1.5}, r"model.medium.albedo = 1.5 is outside \[0, 1\]"),
        ({"medium__anisotropy": 1.0}, r"model.medium.anisotropy = 1.0 is outside \(-1, 1\)"),
        ({"medium__axis_threshold": 0.0}, r"model.medium.axis_threshold = 0.0 is outside \(0, 1\]"),
        ({"laser__axis": wp.vec3(0.0)}, r"model.laser.axis .* has the length 0; a unit vector is needed"),
        ({"laser__profile": 7}, r"model.laser.profile = 7 is outside \[0, 2\]"),
        ({"camera__pixel_tangent": 0.0}, r"model.camera.pixel_tangent = 0.0 is outside \(0, inf\)"),
        ({"camera__aperture_area": math.inf}, r"model.camera.aperture_area = inf is outside \(0, inf\)"),
        ({"gate__stop": 8.0}, r"model.gate.stop = 8.0 is outside \(8.0, inf\)"),
        ({"gate__bins_per_metre": -1.0}, r"model.gate.bins_per_metre = -1.0 is outside \(0, inf\)"),
        ({"limits__max_path": 0.0}, r"model.limits.max_path = 0.0 is outside \(0, inf\)"),
        ({"limits__weight_cutoff": 1.0}, r"model.limits.weight_cutoff = 1.0 is outside \[0, 1\)"),
        ({"photon_count": 0}, r"photon_count = 0 is outside \[1, 67108864\]"),
        ({"photon_count": 1.5}, "photon_count = 1.5 is not an integer"),
        ({"seed": -1}, r"seed = -1 is outside \[0, 18446744073709551615\]"),
        ({"first_id": 2**64 - 5}, r"first_id = 18446744073709551611 is outside \[0, 18446744073709551606\]"),
    ],
)
def test_a_number_out_of_range(box, changes, text):
    with pytest.raises(sk.ArgumentError, match=text):
        launch(box, NEXT_EVENT, **changes)


def test_guiding_and_bounds_are_read_by_those_who_use_them_alone(box):
    launch(box, NEXT_EVENT, guiding__probability=2.0, limits__lateral=-1.0)
    with pytest.raises(sk.ArgumentError, match=r"model.guiding.probability = 2.0 is outside \[0, 1\)"):
        launch(box, sk.TransportSpec("guided"), guiding__probability=2.0)
    with pytest.raises(sk.ArgumentError, match=r"model.limits.lateral = -1.0 is outside \(0, inf\)"):
        launch(box, sk.TransportSpec("next_event", bounded=True), limits__lateral=-1.0)


@pytest.mark.parametrize(
    ("name", "text"),
    [("camera", r"model.camera.width = 0 is outside \[1,"), ("gate", r"model.gate.bins = 0 is outside")],
)
def test_a_camera_or_gate_that_was_left_empty(box, name, text):
    """These were segmentation faults."""
    model = sk.Model(
        device="cpu",
        mesh=box,
        surfaces=sk.make_surfaces(box),
        scale=1.0,
        **structs() | {name: sk.Camera() if name == "camera" else sk.Gate()},
    )
    with pytest.raises(sk.ArgumentError, match=text):
        launch(box, NEXT_EVENT, model=model)


def test_an_offset_or_gradients_of_another_kind_are_refused_where_none_are_needed(box):
    model = sk.Model(device="cpu", mesh=box, surfaces=sk.make_surfaces(box, 0.5), scale=2.0**50, **structs())
    for name, other in (("offset", wp.int64), ("gradients", wp.float32)):
        for value in (wp.zeros(1, dtype=wp.vec4, device="cpu"), wp.zeros(1, dtype=other, device="cpu"), 3):
            data = dataclasses.replace(sk.make_data(model), **{name: value})
            with pytest.raises(sk.ArgumentError, match=rf"data\.{name}"):
                launch(box, NEXT_EVENT, model=model, data=data)


def test_records_without_room_for_them(box):
    """This was a segmentation fault, too."""
    with pytest.raises(sk.ArgumentError, match=r"has room for 0 photons; spec.records = True needs 10"):
        launch(box, sk.TransportSpec("next_event", records=True))


def test_a_mesh_that_is_not_there(box):
    model = sk.Model(device="cpu", mesh=None, surfaces=sk.make_surfaces(None, device="cpu"), scale=1.0, **structs())
    with pytest.raises(sk.ArgumentError, match=r"spec.mesh = True needs surfaces of a mesh"):
        launch(box, NEXT_EVENT, model=model)
    launch(box, sk.TransportSpec("next_event", mesh=False), model=model)


def test_the_bvh_of_warp_is_read_from_the_mesh_that_the_model_keeps(box):
    """With a mesh that nobody keeps this was a segmentation fault, too."""
    surfaces = sk.make_surfaces(box, 0.5, use_warp_bvh=True)
    spec = sk.TransportSpec("next_event", use_warp_bvh=True)
    for mesh in (None, wp.Mesh(wp.clone(box.points), wp.clone(box.indices))):
        model = sk.Model(device="cpu", mesh=mesh, surfaces=surfaces, scale=2.0**50, **structs())
        with pytest.raises(
            sk.ArgumentError, match=r"spec\.use_warp_bvh = True reads the mesh that the surfaces were made"
        ):
            launch(box, spec, model=model)
    model = sk.Model(device="cpu", mesh=box, surfaces=surfaces, scale=2.0**50, **structs())
    assert launch(box, spec, model=model).tally.numpy().any()


PORT = {"index": (1.0, 1.5, 1.34), "group_index": (1.0, 1.5, 1.36)}
NONE = {"kinds": (), "value": (), "scale": (1.0,), "channels": 1, "device": "cpu"}


@pytest.mark.parametrize(
    ("make", "arguments", "text"),
    [
        (sk.make_boundary, ([1, 0, 0], [0, 0]), r"high = \[0, 0\] is not three numbers"),
        (sk.make_boundary, (None, [0, 0, 0]), "low is .* a list is needed"),
        (sk.sphere_integral, (3.0,), "function = 3.0 is not a function"),
        (sk.sphere_integral, (lambda t: None,), "what function returns has shape"),
        (sk.surface_choices, (None,), "surfaces is .* a Surfaces is needed"),
        (sk.surface_choices, (sk.Surfaces(),), "surfaces.corner_reflectance is missing"),
        (analytic.make_optics, ([],), r"port = \[\] is not a PortKind"),
        (sk.make_polarisation, {"laser": 1.0, "device": "cpu"}, "laser = 1.0 is not a Stokes vector"),
        (sk.make_polarisation, {"matrix": 1.0, "device": "cpu"}, "matrix = 1.0 is not a function"),
        (sk.make_polarisation, {"channels": [1.0], "device": "cpu"}, r"channels\[0\] is .* a list is needed"),
        (sk.make_derivatives, {**NONE, "kinds": None}, "kinds is .* a list is needed"),
        (sk.make_derivatives, {**NONE, "waters": [0.5]}, "waters holds numbers that are not whole"),
        (sk.make_derivatives, {**NONE, "faces": "x"}, "faces is .* not an array of numbers"),
        (sk.make_derivatives, {**NONE, "blocks": 3}, "blocks is .* a Blocks is needed"),
        (sk.make_dome_port, {"radius": 1e300, "thickness": 0.01, **PORT}, r"radius = 1e\+300 is outside \(0, 1e9\]"),
    ],
)
def test_parts_of_a_model_name_what_is_wrong(make, arguments, text):
    positional, named = ((), arguments) if isinstance(arguments, dict) else (arguments, {})
    with pytest.raises(sk.ArgumentError, match=text):
        make(*positional, **named)


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        (sk.TransportSpec("next_event", layered=True), "model.layers.start is None; a wp.array of float32"),
        (sk.TransportSpec("next_event", phase=sk.TABULATED), "model.medium.phase.cells is None"),
        (sk.TransportSpec("next_event", measured_beam=True), "model.laser.rows is None"),
        (sk.TransportSpec("next_event", lens=sk.CALIBRATED), r"model.camera.focal\[0\] = 0.0 is outside \(0, inf\)"),
        (
            sk.TransportSpec("next_event", rotated_domain=True),
            "model.limits.rotation = .* a unit vector is needed",
        ),
        (sk.TransportSpec("next_event", phase="henyey_greenstein"), "spec.phase = 'henyey_greenstein' is not a"),
        (sk.TransportSpec("next_event", bounded="yes"), "spec.bounded = 'yes' is not True or False"),
        ("next_event", "spec = 'next_event' is not a TransportSpec"),
    ],
)
def test_a_spec_whose_data_are_missing(box, spec, text):
    """The first three were segmentation faults."""
    with pytest.raises(sk.ArgumentError, match=text):
        launch(box, spec)


def test_a_scan_without_its_raster(box):
    camera = structs()["camera"]
    camera.focal, camera.view = wp.vec2(20.0, 20.0), wp.vec4(-0.1, -0.1, 0.1, 0.1)
    model = sk.Model(
        device="cpu", mesh=box, surfaces=sk.make_surfaces(box), scale=1.0, **structs() | {"camera": camera}
    )
    scan = sk.Scan()
    scan.count, scan.axis = 12, wp.zeros(12, dtype=wp.vec3, device="cpu")
    scan.view = wp.zeros(5, dtype=wp.vec4, device="cpu")
    spec = sk.TransportSpec("next_event", lens=sk.CALIBRATED, confocal=True)
    with pytest.raises(sk.ArgumentError, match=r"model.scan.count = 0 is outside \[1, 12\]"):
        launch(box, spec, model=model)
    with pytest.raises(sk.ArgumentError, match=r"entries of model.scan.view = 5 is outside"):
        launch(box, spec, model=dataclasses.replace(model, scan=scan))


def test_data_of_another_model(box):
    small = launch(box, NEXT_EVENT)
    with pytest.raises(sk.ArgumentError, match=r"data.tally is a wp.array of int64, shape \(288,\); .* \(576,\)"):
        launch(box, NEXT_EVENT, data=small, camera__width=8)
    with pytest.raises(sk.ArgumentError, match="tally is ndarray of shape"):
        sk.make_data(
            sk.Model("cpu", mesh=None, surfaces=sk.make_surfaces(None), scale=1, **structs()), tally=np.zeros(9)
        )
    for scale in (0.0, math.nan):
        with pytest.raises(sk.ArgumentError, match=r"model.scale = .* is outside"):
            sk.Model("cpu", mesh=None, surfaces=sk.make_surfaces(None), scale=scale, **structs())
    with pytest.raises(sk.ArgumentError, match=r"model.medium is a Gate; a Medium is needed"):
        sk.Model("cpu", mesh=None, surfaces=sk.make_surfaces(None), scale=1, **structs() | {"medium": sk.Gate()})
    with pytest.raises(sk.ArgumentError, match=r"model.device = 'gpu' is not a device of this machine"):
        sk.Model("gpu", mesh=None, surfaces=sk.make_surfaces(None), scale=1, **structs())


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"reflectance": 1.5}, r"reflectance = 1.5 is outside \[0, 1\]"),
        ({"reflectance": np.full(12, 0.5)}, r"reflectance is ndarray of shape \(12,\); a wp.array of float32"),
        ({"reflectance": [0.1] * 11 + [1.5]}, r"reflectance\[11\] = 1.5 is outside \[0, 1\]"),
        ({"reflectance": [0.1] * 11 + [math.nan]}, r"reflectance\[11\] = nan is outside \[0, 1\]"),
        ({"corner_reflectance": [[0.1, 0.2, -0.5]] * 12}, r"corner_reflectance\[0\] = -0.5 is outside"),
        ({"specular": 0.6, "reflectance": 0.5}, r"reflectance\[0\] \+ specular\[0\] = 1.1 is outside \[0, 1\]"),
        ({"specular": 0.1, "roughness": 0.0}, r"roughness = 0.0 is outside \[0.01, 1\]"),
        ({"camera": sk.Camera()}, r"camera.width = 0 is outside \[1,"),
    ],
)
def test_surfaces_out_of_range(box, arguments, text):
    for name, value in arguments.items():
        if isinstance(value, list):
            arguments[name] = wp.array(value, dtype=wp.vec3 if np.ndim(value) == 2 else float, device="cpu")
    with pytest.raises(sk.ArgumentError, match=text):
        sk.make_surfaces(box, **arguments)


def test_textures_layers_and_phase_functions_out_of_range():
    image, corners = np.full((2, 2), 0.5), np.zeros((1, 3, 2))
    with pytest.raises(sk.ArgumentError, match=r"face holds 3 to 3, outside \[-1, 0\]"):
        sk.make_textures(np.array([3]), corners, [image])
    with pytest.raises(sk.ArgumentError, match=r"images\[0\] holds 0.5 to 2.0, outside \[0, 1\]"):
        sk.make_textures(np.array([0]), corners, [np.array([[0.5, 2.0]])])
    with pytest.raises(sk.ArgumentError, match=r"extinction\[1\] = -1 is outside \(0, inf\)"):
        sk.make_layers([0, 1], [1, -1], [0, 0], [0, 0])
    with pytest.raises(sk.ArgumentError, match=r"start\[2\] = 1 is outside \[5.0, inf\)"):
        sk.make_layers([0, 5, 1], [1, 1, 1], [0, 0, 0], [0, 0, 0])
    with pytest.raises(sk.ArgumentError, match=r"g = 1 is outside \(-1, 1\)"):
        sk.henyey_greenstein_density(0.5, 1)


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
        (lambda h: sk.first_photon_counts(h.numpy(), pulses=1, seed=1), "hazard is ndarray of shape .* a wp.array"),
        (lambda h: sk.first_photon_counts(wrong_rate(h, -1.0), pulses=1, seed=1), "hazard of pixel 2 holds numbers"),
        (lambda h: sk.event_counts(wrong_rate(h, math.nan), **EVENTS), "hazard of pixel 2 holds numbers"),
        (lambda h: sk.first_photon_counts(h, pulses=-1, seed=1), r"pulses = -1 is outside \[0, 2147483647\]"),
        (lambda h: sk.first_photon_counts(h, pulses=1, frames=0, seed=1), r"frames = 0 is outside \[1,"),
        (lambda h: sk.first_photon_counts(h, pulses=1, seed=-3), "seed = -3 is outside"),
        (lambda h: sk.first_photon_counts(h.flatten(), pulses=1, seed=1), r"shape \(48,\); .* shape \(any, any\)"),
        (lambda h: sk.event_counts(h, **EVENTS | {"recorded": 9}), r"recorded = 9 is outside \[1, 8\]"),
        (lambda h: sk.event_counts(h, **EVENTS | {"edges": np.zeros(5)}), r"edges has shape \(5,\); \(9,\)"),
        (lambda h: sk.event_counts(h, **EVENTS | {"edges": np.zeros(9)}), "edges do not rise from 0"),
        (lambda h: sk.event_counts(h, **EVENTS | {"period": 0}), r"period = 0 is outside \(0, inf\)"),
        (lambda h: sk.arrival_bins(h, stop=9), r"stop = 9 is outside \[0, 8\]"),
        (lambda h: sk.arrival_bins(h, background=arrays((0, 1))[0]), r"background has shape \(0, 1\)"),
        (lambda h: sk.arrival_bins(h, method="matched", response=np.zeros((16, 3))), "response holds 0.0 to 0.0"),
        (lambda h: detection.add_crosstalk(h, h, image_width=5, probability=0.1), "image_width = 5 does not divide"),
        (
            lambda h: sk.expected_detections(h, **MATRIX | {"source_bin": np.array([8])}, noise_rate=arrays(6)[0]),
            r"source_bin holds 8 to 8, outside \[0, 7\]",
        ),
        (lambda h: sk.expected_detections(h, **MATRIX, noise_rate=arrays(3)[0]), r"noise_rate is .* shape \(3,\)"),
    ],
)
def test_detection(call, text):
    """Most of these read or wrote beyond an array."""
    with pytest.raises(sk.ArgumentError, match=text):
        call(arrays((6, 8))[0])


def lidar(**changes):
    one = sk.Lidar()
    one.photons, one.pde, one.extinction, one.scattering, one.speed = 1e9, 0.2, 0.3, 0.2, 2.2e8
    one.axis, one.spread, one.tan2 = wp.vec3d(0.0, 0.0, 1.0), 0.02, 0.04
    one.pixel_tangent, one.aperture_area, one.sigma, one.dark = 0.01, 1e-4, 1e-10, 1e3
    one.stop, one.source, one.nearest = 1e-7, 1, 0.05
    for name, value in changes.items():
        setattr(one, name, value)
    return one


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"sigma": 0.0}, r"lidar.sigma = 0.0 is outside \(0, inf\)"),
        ({"extinction": -1.0}, r"lidar.extinction = -1.0 is outside \[0, inf\)"),
        ({"photons": math.nan}, r"lidar.photons = nan is outside \[0, inf\)"),
        ({"stop": 0.0}, r"lidar.stop = 0.0 is outside \(0.0, inf\)"),
        ({"axis": wp.vec3d(0.0)}, "lidar.axis .* a unit vector is needed"),
        ({"source": 9}, r"lidar.source = 9 is outside \[0, 2\]"),
    ],
)
def test_a_lidar_out_of_range(changes, text):
    view = wp.zeros(4, dtype=wp.vec3d, device="cpu")
    distance, reflectance = (wp.ones(4, dtype=wp.float64, device="cpu") for _ in range(2))
    sk.signal_map(lidar(), view, distance, view, reflectance)
    with pytest.raises(sk.ArgumentError, match=text):
        sk.signal_map(lidar(**changes), view, distance, view, reflectance)


def test_maps_of_another_size():
    view = wp.zeros(4, dtype=wp.vec3d, device="cpu")
    distance = wp.ones(3, dtype=wp.float64, device="cpu")
    with pytest.raises(sk.ArgumentError, match=r"distance is a wp.array of float64, shape \(3,\); .* \(4,\)"):
        sk.single_scatter_table(lidar(), wp.ones(9, dtype=wp.float64, device="cpu"), view, distance)
    sight = wp.zeros(4, dtype=wp.vec3, device="cpu")
    maps, tables = arrays(4, 4, 4, 4), arrays((1, 2), (1, 2))
    keywords = {"laser": (0, 0, 0), "gate_paths": (1.0, 2.0), "first_frame": 0, "frames": 2, "seed": 1}
    sk.sample_frames(sight, *maps, *tables, **keywords)
    with pytest.raises(sk.ArgumentError, match=r"probability is a wp.array of float32, shape \(3,\)"):
        sk.sample_frames(sight, *maps[:2], *arrays(3), *maps[3:], *tables, **keywords)
    with pytest.raises(sk.ArgumentError, match=r"columns of paths = 1 is outside \[2,"):
        sk.sample_frames(sight, *maps, *arrays((1, 1), (1, 1)), **keywords)
    with pytest.raises(sk.ArgumentError, match=r"frames = -1 is outside \[0,"):
        sk.sample_frames(sight, *maps, *tables, **keywords | {"frames": -1})
    with pytest.raises(sk.ArgumentError, match=r"level is a wp.array of float64, shape \(3,\)"):
        analytic.outlier_probabilities(wp.ones(4, dtype=wp.float64), distance, distance)
