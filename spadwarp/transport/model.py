"""A scene as the kernels take it: parameter structs, the mesh's BVH, the compile-time choices; and its truth maps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.device import physical_memory, pick_device
from spadwarp.errors import ConfigError, DeviceError
from spadwarp.mesh import build_mesh, focus_distance
from spadwarp.result import COMPONENTS, Truth
from spadwarp.scene import Camera, Laser, Scene, SceneLike, as_scene, phase_function, scattering_matrix
from spadwarp.scene.camera import pixel_views, to_camera, to_world, view_box
from spadwarp.scene.laser import load_profile, profile_extent
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.port import PortGeometry
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.scene import camera_port, laser_port
from spadwarp.scene.sight import lines_of_sight, pixel_directions, scan_axes
from spadwarp.transport.derivatives import derivative_kinds, make_derivatives
from spadwarp.transport.tally_unit import tally_scale

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh

__all__ = ["points_per_flight", "truth_maps"]

# The albedo of Lu et al. 2024 is uniform in (0, 0.97).
_LU2024_ALBEDO = 0.97

_UNLIMITED = 1.0e30

# Regular tracking is the faster one up to about this many cells.
_MOST_REGULAR_CELLS = 32**3

MeshCache = dict[str, tuple[wp.Mesh, NDArray[np.int32]]]
"""Device → its mesh, and the faces of that."""


def build_model(
    scene: Scene,
    device: wp.Device,
    mesh: TriangleMesh | None,
    *,
    camera: bool = True,
    copies: float = 1,
    scale: float | None = None,
    mesh_cache: MeshCache | None = None,
    derivatives: Sequence[str] = (),
) -> sk.Model:
    """The scene on a device.

    Args:
        scene: What to simulate.
        device: From `spadwarp.device.pick_device`.
        mesh: From `spadwarp.mesh.build_mesh`.
        copies: Histograms that the run will hold on the device, for the check of its memory.
        scale: Tally units per emitted photon; None: `tally_scale(scene, mesh)`.
        mesh_cache: Meshes of earlier scenes on their devices; one of the same faces is refitted and not built anew.
        camera: Without one a history's path is limited by `transport.max_path` alone, not by the end of the gate.
        derivatives: Full names of parameters, from `resolve_derivatives`.

    Raises:
        ConfigError: The histogram has more bins than an index can count, laser or camera stand outside the domain, or
            the phase function's table is not a density.
        FileError: That table or the beam's profile cannot be read.
        DeviceError: The device has too little memory.
    """
    _check_domain(scene, camera)
    _check_discs(scene, camera)
    if camera:
        _check_gate(scene)
    lens, limits = _camera(scene, mesh), _limits(scene, camera)
    if scene.domain.reflecting:
        limits.boundary = _boundary(scene, device)
    if scale is None:
        scale = tally_scale(scene, mesh) if camera else 1.0
    # Behind a port, light bends: the map of what the lens sees for certain is of straight lines.
    mapped = lens if camera and scene.camera.port is None else None
    device_mesh, surfaces = _surfaces(mesh, mapped, device, mesh_cache)
    parts: dict[str, Any] = {}
    if scene.medium.layers:
        parts["layers"] = _layers(scene, device)
    if scene.medium.grid is not None:
        parts["layers"] = _grid(scene, device)
    if scene.scan.mode != "none":
        parts["scan"] = _scan(scene, device)
    if derivatives:
        grid = parts["layers"].grid if "layers" in parts else sk.Layers().grid
        parts["derivatives"] = make_derivatives(scene, derivatives, mesh, scale, device, grid)
    if scene.polarised:
        parts |= _polarised(scene, mesh, scale, device)
    model = sk.Model(
        device=device,
        medium=_medium(scene, device),
        laser=_laser(scene, device),
        camera=lens,
        gate=_gate(scene, limits.max_path),
        limits=limits,
        guiding=_guiding(scene, limits.max_path),
        mesh=device_mesh,
        surfaces=surfaces,
        scale=scale,
        **parts,
    )
    if camera:
        spare = _check_size(scene, model, copies, len(derivatives) + len(scene.camera.tallied_channels))
        model = dataclasses.replace(model, split_accumulators=spare)
    return model


def _largest_albedo(albedo: float | str) -> float:
    return _LU2024_ALBEDO if isinstance(albedo, str) else albedo


def _medium(scene: Scene, device: wp.Device) -> Any:
    medium = sk.Medium()
    medium.extinction = scene.medium.extinction
    medium.albedo = _largest_albedo(scene.medium.albedo)
    medium.anisotropy = scene.medium.anisotropy
    medium.axis_threshold = scene.transport.axis_threshold
    if scene.medium.has_phase_table:
        medium.phase = sk.make_phase_tables(phase_function(scene.medium).over_t, device=device)
    return medium


def _gate(scene: Scene, max_path: float) -> Any:
    """The gate in path [m]; light by a longer path than histories may have is outside it for every estimator."""
    speed = scene.medium.pulse_speed
    gate = sk.Gate()
    gate.start, gate.stop = scene.gate.start * speed, min(scene.gate.stop * speed, max_path)
    gate.bins_per_metre = 1.0 / (scene.gate.bin_width * speed)
    gate.bins = scene.gate.bins
    return gate


def _limits(scene: Scene, camera: bool) -> Any:
    limits = sk.Limits()
    lower, upper = np.array(scene.domain.bounds)
    if _has_rotated_domain(scene):
        limits.rotation = wp.mat33(*rotation_matrix(scene.camera.rotation_deg).ravel())
        limits.origin = wp.vec3(*scene.camera.position)
    else:
        lower, upper = lower - scene.camera.position, upper - scene.camera.position
    limits.lower = wp.vec3(*np.maximum(lower, -_UNLIMITED))
    limits.upper = wp.vec3(*np.minimum(upper, _UNLIMITED))
    limits.lateral = min(scene.transport.lateral_limit, _UNLIMITED)
    limits.max_path = scene.path_limit if camera else scene.transport.max_path or _UNLIMITED
    limits.weight_cutoff = scene.transport.weight_cutoff
    limits.max_collisions = scene.transport.max_collisions
    return limits


def _boundary(scene: Scene, device: wp.Device) -> Any:
    """What the faces of the domain reflect."""
    behind, water = scene.domain.reflecting, scene.medium.phase_index
    low, high = ([behind.get(f"{axis}_{side}", 0.0) / water for axis in "xyz"] for side in ("low", "high"))
    return sk.make_boundary(low, high, max_reflections=scene.domain.max_reflections, device=device)


def _guiding(scene: Scene, max_path: float) -> Any:
    """Probabilities of guided flights, measured on plane, staircase, harbour and a tank 7.5 attenuation lengths long.

    Each event divides the weight of light that was not guided by 1 - probability, so that optically thick water, where
    events are many, needs smaller ones; vessels do too, see `guided_part` of the kernel library. Those of a grid were
    measured in and behind clouds of optical depth 0.5 to 6.
    """
    beam = scene.beam
    if scene.medium.varies:
        far_point = [p + 0.5 * max_path * u for p, u in zip(beam.position, beam.axis, strict=True)]
        thickness = max(2.0 * scene.optical_depth(beam.position, far_point), 1e-6)
    else:
        thickness = max(scene.medium.extinction * max_path, 1e-6)
    guiding = sk.Guiding()
    in_grid = scene.medium.grid is not None
    guiding.probability = 0.3 * min(1.0, math.sqrt((6.0 if in_grid else 10.0) / thickness))
    guiding.surface_probability = 0.3
    guiding.anisotropy = 1.0 - 0.03 * min(max(thickness / 6.0, 1.0), 4.0 / 3.0) if in_grid else 0.97
    guiding.return_probability = 0.1 * min(1.0, 5.0 / thickness)
    guiding.return_anisotropy = 0.5
    return guiding


def _device_mesh(mesh: TriangleMesh, device: wp.Device, cache: MeshCache | None) -> wp.Mesh:
    """The mesh with its BVH; where only its vertices differ from those of the cached one, that one, refitted."""
    earlier = None if cache is None else cache.get(str(device))
    if earlier is not None and np.array_equal(earlier[1], mesh.faces) and earlier[0].points.size == len(mesh.vertices):
        earlier[0].points.assign(mesh.vertices)
        earlier[0].refit()
        return earlier[0]
    built = wp.Mesh(
        wp.array(mesh.vertices, dtype=wp.vec3, device=device),
        wp.array(mesh.faces.ravel(), dtype=int, device=device),
        # The fastest to traverse, by measurement.
        bvh_constructor="cubql" if device.is_cuda else None,
        bvh_leaf_size=1 if device.is_cuda else 2,
    )
    if cache is not None:
        cache[str(device)] = built, mesh.faces
    return built


def _surfaces(
    mesh: TriangleMesh | None, lens: Any, device: wp.Device, cache: MeshCache | None
) -> tuple[wp.Mesh | None, Any]:
    """The mesh with its BVH, and its surfaces as the kernels take them."""
    if mesh is None:
        return None, sk.make_surfaces(None, device=device)
    device_mesh = _device_mesh(mesh, device, cache)
    arrays: dict[str, Any] = {}
    if mesh.specular is not None and mesh.roughness is not None:
        arrays["specular"] = wp.array(mesh.specular, dtype=float, device=device)
        arrays["roughness"] = wp.array(mesh.roughness, dtype=float, device=device)
    if mesh.pattern is not None:
        arrays["corner_reflectance"] = wp.array(mesh.pattern.corners, dtype=wp.vec3, device=device)
        if mesh.pattern.images:
            arrays["textures"] = sk.make_textures(
                mesh.pattern.texture, mesh.pattern.coordinates, mesh.pattern.images, device=device
            )
    reflectance: wp.array = wp.array(mesh.reflectance, dtype=float, device=device)
    return device_mesh, sk.make_surfaces(device_mesh, reflectance, camera=lens, **arrays)


def _layers(scene: Scene, device: wp.Device) -> Any:
    """The medium and its layers as the kernels take them."""
    medium, camera = scene.medium, scene.camera
    axis = np.array(medium.layer_axis) / math.hypot(*medium.layer_axis)
    shift = float(axis @ camera.position)
    return sk.make_layers(
        [-_UNLIMITED, *(layer.start - shift for layer in medium.layers)],
        [water.extinction for water in medium.waters],
        [_largest_albedo(water.albedo) for water in medium.waters],
        [medium.anisotropy if water.anisotropy is None else water.anisotropy for water in medium.waters],
        axis=(axis @ rotation_matrix(camera.rotation_deg)).tolist(),
        device=device,
    )


def _grid(scene: Scene, device: wp.Device) -> Any:
    """The grid on a device, in the camera's frame."""
    cells, camera = grid_cells(scene.medium), scene.camera
    layers = sk.Layers()
    layers.grid = sk.make_grid(
        cells.extinction,
        np.clip(cells.albedo, 0.0, 1.0),
        cells.anisotropy,
        size=cells.size,
        centre=tuple(to_camera(camera, cells.centre).tolist()),
        rotation=rotation_matrix(camera.rotation_deg).T @ cells.rotation,
        device=device,
    )
    return layers


def transport_spec(scene: Scene, mesh: TriangleMesh | None, *, derivatives: Sequence[str] = (), **choices: Any) -> Any:
    """The compile-time choices of a scene and of the derivatives asked for; `choices` override them."""
    kinds, by_block = derivative_kinds(scene, derivatives)
    spec = sk.TransportSpec(
        estimator=scene.transport.estimator,
        phase=sk.TABULATED if scene.medium.has_phase_table else sk.HENYEY_GREENSTEIN,
        random_albedo=scene.medium.albedo == "lu2024",
        mesh=mesh is not None,
        brute_force=mesh is not None and mesh.face_count <= sk.BRUTE_FORCE_FACES,
        bounded=scene.domain.shape != "unbounded" or math.isfinite(scene.transport.lateral_limit),
        roulette=scene.transport.termination == "roulette",
        pattern=mesh is not None and mesh.pattern is not None,
        specular=mesh is not None and mesh.specular is not None,
        layered=bool(scene.medium.layers),
        lens=sk.PLAIN if _has_plain_lens(scene) else sk.CALIBRATED,
        measured_beam=scene.laser.profile == "measured",
        confocal=scene.scan.mode == "confocal",
        rotated_domain=_has_rotated_domain(scene),
        port=port_kind(camera_port(scene)),
        laser_port=port_kind(laser_port(scene)),
        reflecting=bool(scene.domain.reflecting),
        grid=_grid_tracking(scene),
        derivatives=kinds,
        blocks=by_block,
        polarised=scene.polarised,
        # Those of a scene go with its own estimator.
        points=1 if "estimator" in choices else points_per_flight(scene, kinds, by_block),
        channels=len(scene.camera.tallied_channels),
    )
    return spec._replace(**choices)


def _grid_tracking(scene: Scene) -> Any:
    """How photons fly through the cells; None without a grid."""
    grid = scene.medium.grid
    if grid is None:
        return None
    regular = grid.tracking == "regular"
    if grid.tracking == "auto":
        regular = grid_cells(scene.medium).extinction.size <= _MOST_REGULAR_CELLS
    return sk.REGULAR_TRACKING if regular else sk.DELTA_TRACKING


def points_per_flight(scene: Scene, kinds: Sequence[str] = (), by_block: Sequence[str] = ()) -> int:
    """Points at which a flight is scored, with these kinds of derivatives and those by block.

    Raises `ConfigError` for what cannot be combined with several.
    """
    points = scene.transport.points_per_flight
    if points == 1:
        return points
    estimator = scene.transport.estimator
    against = {
        f'estimator = "{estimator}"': estimator != "guided",
        "faces of the domain that reflect": bool(scene.domain.reflecting),
        "derivatives by block": bool(by_block),
        'medium.grid.tracking = "delta"': _grid_tracking(scene) is sk.DELTA_TRACKING,
    }
    if any(against.values()):
        names = " and ".join(name for name, found in against.items() if found)
        text = f"transport.points_per_flight = {points} cannot be combined with {names}; take 1"
        raise ConfigError(text, source=scene.source)
    if points > 2 and len(kinds) > 4:
        text = f"transport.points_per_flight = {points} goes with up to 4 derivatives; take 2"
        raise ConfigError(text, source=scene.source)
    return points


def _laser(scene: Scene, device: wp.Device) -> Any:
    beam = scene.beam
    laser: Any = sk.Laser()
    laser.position = wp.vec3(*beam.position)
    laser.axis = wp.vec3(*beam.axis)
    if (port := laser_port(scene)) is not None:
        laser.port = port_parameters(scene, port, beam.position, 0.0, 0.0)
    if beam.profile == "measured":
        rows, columns = sk.profile_tables(load_profile(beam))
        laser.rows = wp.array(rows, dtype=float, device=device)
        laser.columns = wp.array(columns, dtype=float, device=device)
        laser.extent = wp.vec2(*profile_extent(beam))
        return laser
    laser.profile = sk.LASER_PROFILES.index(beam.profile)
    if beam.profile == "gaussian":
        laser.tan2 = math.tan(beam.half_angle) ** 2
    else:
        laser.spread = 2.0 * math.sin(0.5 * beam.half_angle) ** 2
    laser.radius = beam.beam_radius
    return laser


def _camera(scene: Scene, mesh: TriangleMesh | None) -> Any:
    camera = scene.camera
    lens = sk.Camera()
    lens.width, lens.height = camera.width, camera.height
    lens.pixel_tangent = camera.pixel_tangent
    lens.aperture_area = camera.aperture_area
    if (focus := focus_distance(scene, mesh)) is not None:
        lens.aperture_radius, lens.inverse_focus = camera.aperture_radius, 1.0 / focus
    if not _has_plain_lens(scene):
        k1, k2, p1, p2, k3 = camera.distortion
        lens.focal, lens.principal = wp.vec2(*camera.focal_pixels), wp.vec2(*camera.principal_point)
        lens.radial, lens.tangential = wp.vec3(k1, k2, k3), wp.vec2(p1, p2)
        lens.view = wp.vec4(*view_box(camera))
    if (port := camera_port(scene)) is not None:
        lens.port = port_parameters(scene, port, (0.0, 0.0, 0.0), lens.aperture_radius, lens.inverse_focus)
    return lens


def port_kind(port: PortGeometry | None) -> Any:
    """The kernels' kind of a port; None: there is none."""
    return None if port is None else sk.FLAT_PORT if port.shape == "flat" else sk.DOME_PORT


def port_parameters(
    scene: Scene, port: PortGeometry, origin: tuple[float, float, float], aperture_radius: float, inverse_focus: float
) -> Any:
    """A port as the kernels take it."""
    left, top, right, bottom = view_box(scene.camera)
    corners = np.array([[x, y, 1.0] for x in (left, right) for y in (top, bottom)])
    normal = np.array(port.normal if port.shape == "flat" else (0.0, 0.0, 1.0))
    # Between the corners, cosines are larger; the lens sees the view by up to its radius over the focus aside.
    cosine = float(((corners @ normal) / np.linalg.norm(corners, axis=1)).min())
    angle = math.acos(min(max(cosine, -1.0), 1.0)) + math.atan(aperture_radius * inverse_focus) + 0.01
    choices: dict[str, Any] = {
        "thickness": port.thickness,
        "index": port.index,
        "group_index": port.group_index,
        "origin": origin,
        "aperture_radius": aperture_radius,
        "largest_angle": min(angle, 1.55),
    }
    try:
        if port.shape == "flat":
            return sk.make_flat_port(distance=port.distance, normal=port.normal, **choices)
        return sk.make_dome_port(radius=port.radius, centre=port.centre, **choices)
    except sk.ArgumentError as error:
        raise ConfigError(f"camera.port or laser.port: {error}", source=scene.source) from None


def _has_plain_lens(scene: Scene) -> bool:
    """Whether the image needs no intrinsics and no view of its own for each photon."""
    return scene.camera.is_plain and scene.scan.mode == "none"


def _scan(scene: Scene, device: wp.Device) -> Any:
    """A raster over the pixels: the beam goes through the middle of each."""
    axes, views = scan_axes(scene).reshape(-1, 3), pixel_views(scene.camera).reshape(-1, 4)
    scan = sk.Scan()
    scan.count = len(axes)
    scan.axis = wp.array(axes.astype(np.float32), dtype=wp.vec3, device=device)
    scan.view = wp.array(views.astype(np.float32), dtype=wp.vec4, device=device)
    return scan


def _has_rotated_domain(scene: Scene) -> bool:
    """Whether the domain has faces that are not parallel to the camera's axes."""
    return scene.domain.shape != "unbounded" and any(scene.camera.rotation_deg)


def _polarised(scene: Scene, mesh: TriangleMesh | None, scale: float, device: wp.Device) -> dict[str, Any]:
    """Polarised light of the model, and tallies of the camera's channels in the unit of its histogram."""
    rows = _channel_rows(scene.camera)
    facets: Any = ()
    if mesh is not None and mesh.specular is not None:
        index = np.array([target.specular_index for target in scene.targets]) / scene.medium.phase_index
        facets = index[mesh.target]
    parts: dict[str, Any] = {
        "polarisation": sk.make_polarisation(
            laser=_emitted_stokes(scene.laser),
            matrix=scattering_matrix(scene.medium),
            channels=rows,
            facet_index=facets,
            device=device,
        )
    }
    if rows:
        parts["derivatives"] = sk.make_derivatives([], [], [scale] * len(rows), channels=len(rows), device=device)
    return parts


def _emitted_stokes(laser: Laser) -> tuple[float, float, float, float]:
    """Stokes vector (1, Q, U, V) of a laser's light with respect to its beam's right.

    U counts towards the second direction, right × axis, which is the beam's up, so that an angle towards its down is
    negative there.
    """
    if laser.polarisation == "linear":
        double = math.radians(2.0 * laser.polarisation_angle_deg)
        return 1.0, math.cos(double), -math.sin(double), 0.0
    return 1.0, 0.0, 0.0, {"none": 0.0, "right_circular": 1.0, "left_circular": -1.0}[laser.polarisation]


def _channel_rows(camera: Camera) -> list[list[float]]:
    """Of each channel but "I", the row whose product with the Stokes vector at the lens it gets."""
    if camera.polarisation == "none":
        return []
    if camera.polarisation == "stokes":
        return np.eye(4)[1:].tolist()
    leak, double = 1.0 / camera.analyser_extinction_ratio, math.radians(2.0 * camera.analyser_angle_deg)
    part = 0.5 * (1.0 - leak)
    along = [0.5 * (1.0 + leak), part * math.cos(double), part * math.sin(double), 0.0]
    return [along, [along[0], -along[1], -along[2], 0.0]]


# What is refused


def _check_domain(scene: Scene, camera: bool) -> None:
    """Refuses a camera or a laser, or the way out of its port, outside the domain."""
    beam = scene.beam
    ways = {"laser.position": (laser_port(scene), beam.position, beam.axis)}
    if camera:
        ways["camera.position"] = (camera_port(scene), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    for name, (port, position, axis_of) in ways.items():
        point, slack = np.asarray(position, np.float64), 0.0
        if port is not None:
            # The water begins behind the port, which may be a face of the domain.
            name, slack = f"{name}, its axis behind the port", 1e-6
            point = port.enter(position, axis_of)[0]
            if not np.isfinite(point).all():
                text = f"{name}: light along the axis does not get through the port: turn the axis or the port"
                raise ConfigError(text, source=scene.source)
        for axis, value, low, high in zip(
            "xyz", to_world(scene.camera, point).tolist(), *scene.domain.bounds, strict=True
        ):
            if not low - slack <= value <= high + slack:
                text = f"{name}: {axis} = {value} is outside [{low}, {high}], the domain"
                raise ConfigError(text, source=scene.source)


def _check_discs(scene: Scene, camera: bool) -> None:
    """Refuses a lens or a beam that reaches through a face that reflects: beyond it nothing is mirrored."""
    beam, discs = scene.beam, {}
    if beam.profile == "collimated" and laser_port(scene) is None:
        discs["laser.beam_radius"] = (beam.position, beam.axis, beam.beam_radius)
    if camera and camera_port(scene) is None and not scene.camera.pinhole:
        discs["camera.aperture_diameter"] = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), scene.camera.aperture_radius)
    for name, (position, axis, radius) in discs.items():
        centre = to_world(scene.camera, np.asarray(position, np.float64))
        across = rotation_matrix(scene.camera.rotation_deg) @ np.asarray(axis, np.float64)
        for face in scene.domain.reflecting:
            k, high = "xyz".index(face[0]), face.endswith("high")
            beyond = radius * math.sqrt(max(1.0 - across[k] ** 2, 0.0)) - abs(scene.domain.bounds[high][k] - centre[k])
            if beyond > 0.0:
                text = f"{name}: reaches {beyond:.4g} m through {face} of the domain, which has an outside_index"
                raise ConfigError(text, source=scene.source)


def _check_gate(scene: Scene) -> None:
    """Refuses a gate that begins after the longest path."""
    begin, max_path = scene.gate.start * scene.medium.pulse_speed, scene.transport.max_path
    if max_path is not None and max_path <= begin:
        text = f"transport.max_path = {max_path} m is outside ({begin:g}, inf), the path at which the gate begins"
        raise ConfigError(text, source=scene.source)


def _check_size(scene: Scene, model: sk.Model, copies: float, signed: int) -> bool:
    """Refuses what cannot fit before anything is computed; returns whether half as much again would, which is more than
    the low words of the histograms take."""
    camera, size = scene.camera, model.tally_size
    shape = f"{camera.height} x {camera.width} pixels x {scene.gate.bins} bins x {len(COMPONENTS)} components"
    if signed and size * signed >= 2**31:
        text = f"{shape} x {signed} derivatives or channels = {size * signed} is outside [1, {2**31 - 1}]"
        way_out = "fewer pixels, bins or blocks, or fewer derivatives a run, with the same seed"
        raise ConfigError(f"{text}; {way_out}", source=scene.source)
    if size >= 2**31:
        text = f"camera and gate: {shape} = {size} is outside [1, {2**31 - 1}]"
        raise ConfigError(text, source=scene.source)
    cuda = model.device.is_cuda
    # On the CPU counts on the device, their copy in the result, and the total of the components.
    needed = (8 if cuda else 16) * size * (1 + signed) * copies / 2**30
    available = model.device.free_memory if cuda else physical_memory()
    if available is not None and needed > available / 2**30:
        raise DeviceError(
            f"{shape} need {needed:.1f} GiB on {model.device.alias}; {available / 2**30:.1f} GiB are available"
        )
    return available is None or 1.5 * needed <= available / 2**30


# Truth maps


def truth_maps(scene: SceneLike, *, device: str | None = None) -> Truth:
    """Depth, range, normal and reflectance at the pixel centres, by rays against the scene's meshes.

    Behind a port rays bend: depth is z of the point that is hit, range the length of the bent ray from the lens.
    """
    scene = as_scene(scene)
    return trace_truth(scene, build_model(scene, pick_device(device), build_mesh(scene), camera=False))


def trace_truth(scene: Scene, model: sk.Model) -> Truth:
    """`truth_maps` for a model that is already on its device."""
    shape = (scene.camera.height, scene.camera.width)
    if model.mesh is None:
        nothing = np.full(shape, np.nan, np.float32)
        return Truth(depth=nothing, range=nothing, normal=np.full((*shape, 3), np.nan, np.float32), reflectance=nothing)
    origins = directions = wp.zeros((0, 0), dtype=wp.vec3, device=model.device)
    if not scene.camera.is_plain:
        directions = wp.array(pixel_directions(scene.camera).astype(np.float32), dtype=wp.vec3, device=model.device)
    lines = lines_of_sight(scene)
    depth, distance, reflectance = (wp.empty(shape, dtype=float, device=model.device) for _ in range(3))
    normal = wp.empty(shape, dtype=wp.vec3, device=model.device)
    if scene.camera.port is not None:
        # A ray that does not get through goes where nothing is.
        passes = np.isfinite(lines.direction).all(axis=-1, keepdims=True)
        rays = [np.where(passes, lines.start, 1e9), np.where(passes, lines.direction, [0.0, 0.0, 1.0])]
        origins, directions = (wp.array(part.astype(np.float32), dtype=wp.vec3, device=model.device) for part in rays)
    wp.launch(
        sk.truth_kernel,
        dim=shape,
        inputs=[model.camera, model.surfaces, origins, directions],
        outputs=[depth, distance, normal, reflectance],
        device=model.device,
    )
    ranges = distance.numpy()
    if scene.camera.port is not None:
        ranges = (ranges + lines.lead).astype(np.float32)
    return Truth(depth=depth.numpy(), range=ranges, normal=normal.numpy(), reflectance=reflectance.numpy())
