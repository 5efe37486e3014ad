"""A scene as the kernels take it: parameter structs, the mesh's BVH, the compile-time choices; and its truth maps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

import spadwarp_kernels as sk
from spadwarp.device import physical_memory, pick_device
from spadwarp.mesh import TriangleMesh, build_mesh, focus_distance
from spadwarp.result import Truth
from spadwarp.scene import Camera, Laser, Scene, SceneLike, Sun, as_scene, phase_function, scattering_matrix
from spadwarp.scene.camera import pixel_directions, pixel_views, to_camera, to_world, view_box
from spadwarp.scene.laser import load_profile, profile_extent
from spadwarp.scene.medium import MIXTURE, cell_shares, constituent_order, grid_cells
from spadwarp.scene.port import PortGeometry
from spadwarp.scene.pose import rotation_matrix, sideways, vector_of
from spadwarp.scene.scene import Shots, camera_port, laser_port, mean_plane, shots_of
from spadwarp.scene.sight import lines_of_sight, scan_axes, within_port
from spadwarp.transport.derivatives import derivative_kinds, make_derivatives
from spadwarp.transport.plan import tally_limits
from spadwarp.values import ArgumentError, ConfigError, DeviceError
from spadwarp.water.seawater import WATER_DEPOLARISATION

__all__ = ["points_per_flight", "target_map", "truth_maps", "wave_errors"]

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
    """The scene on a device; the mesh is that of `spadwarp.mesh.build_mesh`.

    Without a `camera` a history's path is limited by `transport.max_path` alone, not by the end of the gate. The run
    will hold so many `copies` of the histogram on the device, for the check of its memory. `mesh_cache` has meshes of
    earlier scenes; one of the same faces is refitted and not built anew. `derivatives` are full names.

    Raises `ConfigError`: the histogram has more bins than an index can count, laser or camera stand outside the domain,
    or the phase function's table is not a density; `FileError`: that table or the beam's profile cannot be read;
    `DeviceError`: the device has too little memory.
    """
    _check_places(scene, mesh, camera)
    begin, max_path = scene.gate.start * scene.medium.pulse_speed, scene.transport.max_path
    if camera and max_path is not None and max_path <= begin:
        text = f"transport.max_path = {max_path} m is outside ({begin:g}, inf) m, the path at which the gate begins"
        raise ConfigError(text, source=scene.source)
    if scale is None:
        scale = tally_limits(scene, mesh).scale if camera else 1.0
    sea = None if scene.surface is None else _sea(scene, device)
    lens, limits = _camera(scene, mesh, sea), _limits(scene, device, camera)
    # Behind a port, light bends: the map of what the lens sees for certain is of straight lines to a lens at rest.
    straight = scene.camera.port is None and scene.surface is None and scene.scan.mode != "trajectory"
    mapped = lens if camera and straight else None
    device_mesh, surfaces = _surfaces(mesh, mapped, device, mesh_cache)
    parts: dict[str, Any] = {}
    if scene.medium.varies:
        parts["layers"] = _layers(scene, device)
    if scene.scan.mode != "none":
        parts["scan"] = _scan(scene, device)
    if derivatives:
        grid = parts.get("layers", sk.Layers()).grid
        parts["derivatives"] = make_derivatives(scene, derivatives, mesh, scale, device, grid)
    if sea is not None:
        parts["sea"] = sea
    scales = [scale] * len(scene.tallied_channels)
    if scene.polarised:
        parts["polarisation"] = _polarisation(scene, mesh, device)
    if scene.medium.inelastic or scene.medium.beside:
        parts["lines"], scales = _lines(scene, scale, device)
    if scales:
        parts["derivatives"] = sk.make_derivatives([], [], scales, channels=len(scales), device=device)
    if camera and scene.flux:
        parts["flux"] = _flux(scene, device)
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
        spare = _check_size(scene, model, copies, len(derivatives) + len(scene.tallied_channels))
        model = dataclasses.replace(model, split_accumulators=spare)
    return model


def _filled(struct: Any, **fields: Any) -> Any:
    """A struct of the kernels with values in its fields."""
    for name, value in fields.items():
        setattr(struct, name, value)
    return struct


def _largest_albedo(albedo: float | str) -> float:
    return _LU2024_ALBEDO if isinstance(albedo, str) else albedo


def _medium(scene: Scene, device: wp.Device) -> Any:
    water, medium = scene.medium, sk.Medium()
    if water.has_phase_table:
        law, order = phase_function(water), constituent_order(scene.medium)
        parts = [law.constituents[k].over_t for k in order]
        medium.phase = sk.make_phase_tables(law.over_t, constituents=parts, device=device)
        shares = _shares(scene)[0] if order else []
        medium.shares = wp.vec4(*shares, *[0.0] * (sk.MOST_CONSTITUENTS - len(shares)))
    numbers = {"extinction": water.extinction, "albedo": _largest_albedo(water.albedo), "anisotropy": water.anisotropy}
    return _filled(medium, **numbers, axis_threshold=scene.transport.axis_threshold)


def _shares(scene: Scene) -> list[list[float]]:
    """Of the constituents in that order, in the medium and its layers."""
    medium, order = scene.medium, constituent_order(scene.medium)
    if not order:
        return []
    return [[medium.shares_in(water)[k] for k in order] for water in medium.waters]


def _gate(scene: Scene, max_path: float) -> Any:
    """The gate in path [m]; light by a longer path than histories may have is outside it for every estimator."""
    gate, speed = scene.gate, scene.medium.pulse_speed
    span = {"start": gate.start * speed, "stop": min(gate.stop * speed, max_path)}
    return _filled(sk.Gate(), **span, bins_per_metre=1.0 / (gate.bin_width * speed), bins=gate.bins)


def _limits(scene: Scene, device: wp.Device, camera: bool) -> Any:
    limits, transport, domain = sk.Limits(), scene.transport, scene.domain
    lower, upper = np.array(domain.bounds)
    if _has_rotated_domain(scene):
        limits.rotation = wp.mat33(*rotation_matrix(scene.camera.rotation_deg).ravel())
        limits.origin = wp.vec3(*scene.camera.position)
    else:
        lower, upper = lower - scene.camera.position, upper - scene.camera.position
    if behind := domain.reflecting:
        water = scene.medium.phase_index
        low, high = ([behind.get(f"{axis}_{side}", 0.0) / water for axis in "xyz"] for side in ("low", "high"))
        limits.boundary = sk.make_boundary(low, high, max_reflections=domain.max_reflections, device=device)
    return _filled(
        limits,
        lower=wp.vec3(*np.maximum(lower, -_UNLIMITED)),
        upper=wp.vec3(*np.minimum(upper, _UNLIMITED)),
        lateral=min(transport.lateral_limit, _UNLIMITED),
        # Light that comes after the camera's gate still counts where flux is tallied.
        max_path=scene.path_limit if camera and not scene.flux else transport.max_path or _UNLIMITED,
        weight_cutoff=transport.weight_cutoff,
        max_collisions=transport.max_collisions,
    )


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
        ports = [camera_port(scene), laser_port(scene)] if scene.surface is not None else []
        # Of the path down to the sea and back what is in the air, as a length in water.
        in_air = sum(port.distance * port.group_index[0] / port.group_index[2] for port in ports if port is not None)
        thickness = max(scene.medium.extinction * (max_path - in_air), 1e-6)
    in_grid = scene.medium.grid is not None
    return _filled(
        sk.Guiding(),
        probability=0.3 * min(1.0, math.sqrt((6.0 if in_grid else 10.0) / thickness)),
        surface_probability=0.8,
        anisotropy=min(max(scene.medium.anisotropy or 0.0, 0.5), 0.99),
        return_probability=0.1 * min(1.0, 5.0 / thickness),
        return_anisotropy=0.5,
    )


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
    device_mesh, arrays = _device_mesh(mesh, device, cache), dict[str, Any]()
    for name in ("specular", "roughness") if mesh.specular is not None and mesh.roughness is not None else ():
        arrays[name] = wp.array(getattr(mesh, name), dtype=float, device=device)
    if (pattern := mesh.pattern) is not None:
        arrays["corner_reflectance"] = wp.array(pattern.corners, dtype=wp.vec3, device=device)
        if pattern.images:
            arrays["textures"] = sk.make_textures(pattern.texture, pattern.coordinates, pattern.images, device=device)
    reflectance: wp.array = wp.array(mesh.reflectance, dtype=float, device=device)
    return device_mesh, sk.make_surfaces(device_mesh, reflectance, camera=lens, **arrays)


def _layers(scene: Scene, device: wp.Device) -> Any:
    """The medium and its layers, or its grid of cells, in the camera's frame."""
    medium, camera = scene.medium, scene.camera
    rotation = rotation_matrix(camera.rotation_deg)
    if medium.grid is not None:
        cells, layers, order = grid_cells(medium), sk.Layers(), constituent_order(scene.medium)
        layers.grid = sk.make_grid(
            cells.extinction,
            np.clip(cells.albedo, 0.0, 1.0),
            cells.anisotropy,
            size=cells.size,
            centre=tuple(to_camera(camera, cells.centre).tolist()),
            rotation=rotation.T @ cells.rotation,
            shares=cell_shares(medium)[..., order] if order else (),
            device=device,
        )
        return layers
    axis = np.array(medium.layer_axis) / math.hypot(*medium.layer_axis)
    shift = float(axis @ camera.position)
    return sk.make_layers(
        [-_UNLIMITED, *(layer.start - shift for layer in medium.layers)],
        [water.extinction for water in medium.waters],
        [_largest_albedo(water.albedo) for water in medium.waters],
        [medium.anisotropy if water.anisotropy is None else water.anisotropy for water in medium.waters],
        axis=(axis @ rotation).tolist(),
        shares=_shares(scene),
        device=device,
    )


def transport_spec(scene: Scene, mesh: TriangleMesh | None, *, derivatives: Sequence[str] = (), **choices: Any) -> Any:
    """The compile-time choices of a scene and of the derivatives asked for; `choices` override them."""
    kinds, by_block = derivative_kinds(scene, derivatives)
    phase = sk.TABULATED if scene.medium.has_phase_table else sk.HENYEY_GREENSTEIN
    if scene.medium.phase_function == MIXTURE:
        phase = sk.make_mixture(len(scene.medium.constituents))
    spec = sk.TransportSpec(
        estimator=scene.transport.estimator,
        phase=phase,
        random_albedo=scene.medium.albedo == "lu2024",
        mesh=mesh is not None,
        brute_force=mesh is not None and mesh.face_count <= sk.BRUTE_FORCE_FACES,
        bounded=scene.domain.shape != "unbounded" or math.isfinite(scene.transport.lateral_limit),
        roulette=scene.transport.termination == "roulette",
        pattern=mesh is not None and mesh.pattern is not None,
        specular=mesh is not None and mesh.specular is not None,
        layered=bool(scene.medium.layers),
        lens=_lens(scene),
        measured_beam=scene.laser.profile == "measured",
        confocal=scene.scan.mode != "none",
        rotated_domain=_has_rotated_domain(scene),
        port=None if scene.surface else port_kind(camera_port(scene)),
        laser_port=None if scene.surface else port_kind(laser_port(scene)),
        sea=None if scene.surface is None else sk.FACETS if scene.surface.waves is None else sk.WAVES,
        reflecting=bool(scene.domain.reflecting),
        grid=_grid_tracking(scene),
        derivatives=kinds,
        blocks=by_block,
        polarised=scene.polarised,
        lines=bool(scene.medium.inelastic or scene.medium.beside),
        # Those of a scene go with its own estimator.
        points=1 if "estimator" in choices else points_per_flight(scene, kinds, by_block),
        channels=len(scene.tallied_channels),
        flux=() if "estimator" in choices else tuple(dict.fromkeys(section.kind for section in scene.flux)),
        sun=scene.sun is not None,
    )
    return spec._replace(**choices)


def _grid_tracking(scene: Scene) -> Any:
    """How photons fly through the cells; None without a grid."""
    grid = scene.medium.grid
    if grid is None:
        return None
    small = grid.tracking == "auto" and grid_cells(scene.medium).extinction.size <= _MOST_REGULAR_CELLS
    return sk.REGULAR_TRACKING if small or grid.tracking == "regular" else sk.DELTA_TRACKING


def points_per_flight(scene: Scene, kinds: Sequence[str] = (), by_block: Sequence[str] = ()) -> int:
    """Points at which a flight is scored, with these kinds of derivatives and those by block.

    Raises `ConfigError` for a number that cannot be combined with the rest.
    """
    points, estimator = scene.transport.points_per_flight, scene.transport.estimator
    against = {
        f'estimator = "{estimator}"': estimator != "guided",
        "faces of the domain that reflect": bool(scene.domain.reflecting),
        "derivatives by block": bool(by_block),
        'medium.grid.tracking = "delta"': _grid_tracking(scene) is sk.DELTA_TRACKING,
    }
    found = " and ".join(name for name, holds in against.items() if holds)
    if points == "auto":
        return 1 if found else 2
    problem = f"cannot be combined with {found}; take 1" if found else ""
    if not found and points > 2 and len(kinds) > 4:
        problem = "goes with up to 4 derivatives; take 2"
    if points > 1 and problem:
        raise ConfigError(f"transport.points_per_flight = {points} {problem}", source=scene.source)
    return points


def _flux(scene: Scene, device: wp.Device) -> Any:
    """The sections of the tally of flux in the camera's frame."""
    camera, speed, sections, positions = scene.camera, scene.medium.pulse_speed, list[Any](), list[float]()
    rotation, absorption = rotation_matrix(camera.rotation_deg), scene.medium.range.absorption
    for section in scene.flux:
        scale = section.scale(absorption)
        if section.voxels is not None:
            gates: Any = {"gates": section.gates, "gate_start": section.gate_start_ns * 1e-9 * speed}
            if section.gate_width_ps is not None:
                gates["gate_path"] = section.gate_width_ps * 1e-12 * speed
            frame: Any = {"rotation": rotation, "origin": camera.position, "scale": scale, **gates}
            lower = [low if math.isfinite(low) else 0.0 for low in section.lower]
            box: Any = {"lower": lower, "edge": section.edges, "estimator": section.estimator}
            sections.append(sk.make_flux_volume(section.voxels, **box, **frame))
            continue
        axis, right = section.normal, sideways(section.normal)
        bins: Any = {"polar": section.polar_bins, "azimuth": section.azimuth_bins if section.polar_bins else 0}
        frame = {"axis": axis @ rotation, "right": right @ rotation, "centre": to_camera(camera, section.centre)}
        count = len(section.positions or ())
        sections.append(sk.make_flux_planes(count, radius=section.radius, scale=scale, **bins, **frame))
        positions += [position - float(axis @ camera.position) for position in section.positions or ()]
    return sk.make_flux(sections, positions, device=device)


def _sun(scene: Scene, sun: Sun) -> Any:
    """The light of sun and sky in the camera's frame."""
    surface, rotation = scene.surface, rotation_matrix(scene.camera.rotation_deg)
    assert surface is not None
    down, waves = -np.array(surface.normal), dict[str, Any]()
    if (field := surface.wave_field) is not None:
        columns = np.array(surface.wave_axis) @ rotation
        waves["patch"] = [field.size[0] * columns, field.size[1] * np.cross(down @ rotation, columns)]
        waves["crest"] = field.amplitude
    direction, plane = sun.direction(down) @ rotation, mean_plane(scene)
    return sk.make_sun(direction.tolist(), down=plane.normal, distance=plane.distance, sky=sun.sky, **waves)


def _laser(scene: Scene, device: wp.Device) -> Any:
    if scene.sun is not None:
        return _sun(scene, scene.sun)
    beam = scene.beam
    laser: Any = _filled(sk.Laser(), position=wp.vec3(*beam.position), axis=wp.vec3(*beam.axis))
    if (port := laser_port(scene)) is not None and scene.surface is None:
        laser.port = port_parameters(scene, port, beam.position, 0.0, 0.0)
    if beam.profile == "measured":
        for name, table in zip(("rows", "columns"), sk.profile_tables(load_profile(beam)), strict=True):
            setattr(laser, name, wp.array(table, dtype=float, device=device))
        return _filled(laser, extent=wp.vec2(*profile_extent(beam)))
    if beam.profile == "gaussian":
        laser.tan2 = math.tan(beam.half_angle) ** 2
    else:
        laser.spread = 2.0 * math.sin(0.5 * beam.half_angle) ** 2
    return _filled(laser, profile=sk.LASER_PROFILES.index(beam.profile), radius=beam.beam_radius)


def _camera(scene: Scene, mesh: TriangleMesh | None, sea: Any) -> Any:
    camera = scene.camera
    size, area = {"width": camera.width, "height": camera.height}, camera.aperture_area
    lens = _filled(sk.Camera(), **size, pixel_tangent=scene.receiver.pixel_tangent, aperture_area=area)
    if (focus := focus_distance(scene, mesh)) is not None:
        lens.aperture_radius, lens.inverse_focus = camera.aperture_radius, 1.0 / focus
    if _lens(scene) is not sk.PLAIN:
        receiver = scene.receiver
        k1, k2, p1, p2, k3 = receiver.distortion
        lens.focal, lens.principal = wp.vec2(*receiver.focal_pixels), wp.vec2(*receiver.principal_point)
        lens.radial, lens.tangential = wp.vec3(k1, k2, k3), wp.vec2(p1, p2)
        lens.view, lens.columns = wp.vec4(*view_box(receiver)), receiver.width
    port = camera_port(scene)
    if port is None and scene.surface is not None and scene.sun is None:
        port = mean_plane(scene, from_below=True)
    if port is not None:
        of_port = _plane_of_shots if scene.scan.mode == "trajectory" else port_parameters
        lens.port = of_port(scene, port, (0.0, 0.0, 0.0), lens.aperture_radius, lens.inverse_focus, sea)
    return lens


def _plane_of_shots(scene: Scene, plane: PortGeometry, *lens: Any) -> Any:
    """`port_parameters` of the mean plane of a sea, with bounds that hold for all shots of a scan."""
    shots = _shots(scene)
    left, top, right, bottom = view_box(scene.receiver)
    corners = np.array([[x, y, 1.0] for x in (left, right) for y in (top, bottom)])
    normals = np.einsum("nij,i->nj", shots.rotation, plane.normal)
    steepest = normals[(normals @ (corners / np.linalg.norm(corners, axis=1, keepdims=True)).T).min(axis=1).argmin()]
    heights = plane.distance - shots.position @ plane.normal
    ends = [
        port_parameters(scene, dataclasses.replace(plane, distance=float(height), normal=vector_of(steepest)), *lens)
        for height in (heights.min(), heights.max())
    ]
    late = max(end.late for end in ends)
    return _filled(ends[1], normal=wp.vec3(*plane.normal), distance=plane.distance, late=late)


def _sea(scene: Scene, device: wp.Device) -> Any:
    """The surface of the sea as the kernels take it."""
    surface, plane, rotation = scene.surface, mean_plane(scene), rotation_matrix(scene.camera.rotation_deg)
    assert surface is not None
    along, waves = None, dict[str, Any]()
    if surface.direction is not None:
        along = (np.array(surface.direction) @ rotation).tolist()
    if (field := surface.wave_field) is not None:
        waves = {"heights": field.heights, "size": field.size, "device": device}
        waves["columns"] = (np.array(surface.wave_axis) @ rotation).tolist()
        waves["origin"] = to_camera(scene.camera, surface.point).tolist()
    try:
        return sk.make_sea(
            surface.slope_variances,
            index=plane.index[2] / plane.index[0],
            normal=tuple(-x for x in plane.normal),
            height=-plane.distance,
            along=along,
            delay=plane.group_index[0] / plane.group_index[2],
            extinction=surface.air_extinction,
            **waves,
        )
    except sk.ArgumentError as error:
        raise ConfigError(f"surface.waves: {error}; a larger shortest or more wind", source=scene.source) from None


def port_kind(port: PortGeometry | None) -> Any:
    """The kernels' kind of a port; None: there is none."""
    return None if port is None else sk.FLAT_PORT if port.shape == "flat" else sk.DOME_PORT


def port_parameters(
    scene: Scene, port: PortGeometry, origin: Any, aperture_radius: float, inverse_focus: float, sea: Any = None
) -> Any:
    """A port as the kernels take it; `sea`: what it is the mean plane of."""
    left, top, right, bottom = view_box(scene.receiver)
    corners = np.array([[x, y, 1.0] for x in (left, right) for y in (top, bottom)])
    normal = np.array(port.normal if port.shape == "flat" else (0.0, 0.0, 1.0))
    # Between the corners, cosines are larger; the lens sees the view by up to its radius over the focus aside.
    cosine = float(((corners @ normal) / np.linalg.norm(corners, axis=1)).min())
    angle = math.acos(min(max(cosine, -1.0), 1.0)) + math.atan(aperture_radius * inverse_focus) + 0.01
    choices: dict[str, Any] = {name: getattr(port, name) for name in ("thickness", "index", "group_index")}
    choices |= {"origin": origin, "aperture_radius": aperture_radius, "largest_angle": min(angle, 1.55)}
    try:
        if port.shape == "flat":
            return sk.make_flat_port(**choices, distance=port.distance, normal=port.normal, sea=sea)
        return sk.make_dome_port(radius=port.radius, centre=port.centre, **choices)
    except sk.ArgumentError as error:
        raise ConfigError(f"camera.port or laser.port: {error}", source=scene.source) from None


def _lens(scene: Scene) -> Any:
    """How the kernels image: plainly where the image needs no intrinsics and no view of its own for each photon."""
    if scene.scan.mode == "trajectory":
        return sk.SCANNED
    return sk.PLAIN if scene.camera.is_plain and scene.scan.mode == "none" else sk.CALIBRATED


def _shots(scene: Scene) -> Shots:
    """The shots of a scan along a trajectory in the frame of the scene's camera, in which light is traced."""
    shots, turn = shots_of(scene), rotation_matrix(scene.camera.rotation_deg).T
    position = to_camera(scene.camera, shots.position)
    return dataclasses.replace(shots, position=position, rotation=turn @ shots.rotation)


def _scan(scene: Scene, device: wp.Device) -> Any:
    """The poses of a trajectory's shots; or a raster over the pixels: the beam goes through the middle of each."""
    if scene.scan.mode == "trajectory":
        from scipy.spatial.transform import Rotation

        shots = _shots(scene)
        poses = np.concatenate([shots.position, Rotation.from_matrix(shots.rotation).as_quat()], axis=1)
        pose: wp.array = wp.array(poses.astype(np.float32), dtype=wp.transform, device=device)
        return _filled(sk.Scan(), count=len(poses), pose=pose)
    axes, views = scan_axes(scene).reshape(-1, 3), pixel_views(scene.camera).reshape(-1, 4)
    axis: wp.array = wp.array(axes.astype(np.float32), dtype=wp.vec3, device=device)
    view: wp.array = wp.array(views.astype(np.float32), dtype=wp.vec4, device=device)
    return _filled(sk.Scan(), count=len(axes), axis=axis, view=view)


def _has_rotated_domain(scene: Scene) -> bool:
    """Whether the domain has faces that are not parallel to the camera's axes."""
    return scene.domain.shape != "unbounded" and any(scene.camera.rotation_deg)


def _polarisation(scene: Scene, mesh: TriangleMesh | None, device: wp.Device) -> Any:
    """Polarised light of the model, and the camera's channels of it."""
    rows, facets = _channel_rows(scene.camera), ()  # type: tuple[Any, Any]
    if mesh is not None and mesh.specular is not None:
        index = np.array([target.specular_index for target in scene.targets]) / scene.medium.phase_index
        facets = index[mesh.target]
    emitted, matrix = _emitted_stokes(scene.laser), scattering_matrix(scene.medium)
    return sk.make_polarisation(laser=emitted, matrix=matrix, channels=rows, facet_index=facets, device=device)


def _lines(scene: Scene, scale: float, device: wp.Device) -> tuple[Any, list[float]]:
    """Light of other wavelengths, and the scale of each tally. Of inelastic scattering it is finer than the histogram's
    by as much as it holds less: at most as much as inelastic scattering is of elastic by any one angle."""
    water, wavelength = scene.medium, scene.laser.wavelength_nm
    if count := len(water.beside):
        # Of their molecules what their scattering by the medium's law has not; the law of both is that of the medium.
        again = [one.particle_scattering / water.particle_scattering for one in water.beside]
        molecules = [one.scattering - one.particle_scattering for one in (water, *water.beside)]
        found = sk.make_lines(
            [own - part * molecules[0] for own, part in zip(molecules[1:], again, strict=True)],
            [(1.0 - WATER_DEPOLARISATION) / (1.0 + WATER_DEPOLARISATION)] * count,
            [one.extinction for one in water.beside],
            [part * water.scattering for part in again],
            [1.0] * count,
            media=[_medium(scene, device)],
            elastic=True,
            device=device,
            delay=[one.group_index / water.group_index for one in water.beside],
        )
        return found, [scale] * count
    lines, least = water.inelastic, float(phase_function(water).density(np.linspace(0.01, math.pi, 500)).min())
    rows = np.array([one.in_waters(water.waters, wavelength) for one in lines])  # [line, water, coefficient]
    source, extinction, scattering = np.moveaxis(rows, (0, 1, 2), (2, 1, 0))
    passed = [one.passed for one in lines]
    media = [sk.make_medium(float(one.absorption), one.scattering) for one in water.waters]
    found = sk.make_lines(
        source, [one.anisotropy for one in lines], extinction, scattering, passed, media=media, device=device
    )
    parts = passed * (source / [[one.scattering] for one in water.waters]).max(axis=0) / (4.0 * math.pi * least)
    return found, [scale / 2.0 ** math.floor(math.log2(max(part, 1e-12))) for part in parts]


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


def _check_places(scene: Scene, mesh: TriangleMesh | None, camera: bool = True) -> None:
    """Refuses a laser or a target within the camera's port; a camera or a laser, or the way out of its port, outside
    the domain; and a lens or a beam that reaches through a face that reflects: beyond it nothing is mirrored."""
    corners = np.zeros((0, 3, 3)) if mesh is None or scene.camera.port is None else mesh.vertices[mesh.faces]
    if (camera or scene.surface) and (found := within_port(scene, corners.astype(np.float64))):
        raise ConfigError(": ".join(found), source=scene.source)
    beam, lens, domain = scene.beam, scene.camera, scene.domain
    radius = beam.beam_radius if beam.profile == "collimated" else 0.0
    ends = [("laser", laser_port(scene), beam.position, beam.axis, "beam_radius", radius)][scene.sun is not None :]
    if scene.surface is not None and scene.scan.mode == "trajectory":
        ends, camera = [], False  # the places are those of the shots
    if camera:
        radius, origin = 0.0 if lens.pinhole else lens.aperture_radius, (0.0, 0.0, 0.0)
        ends.append(("camera", camera_port(scene), origin, (0.0, 0.0, 1.0), "aperture_diameter", radius))
    for section, port, position, axis, field, radius in ends:
        name, point, slack = f"{section}.position", np.asarray(position, np.float64), 0.0
        if port is not None:
            # The water begins behind the port, which may be a face of the domain.
            name, slack, radius = f"{name}, its axis behind the port", 1e-6, 0.0
            point = port.enter(position, axis)[0]
            if not np.isfinite(point).all():
                text = f"{name}: light along the axis does not get through the port: turn the axis or the port"
                raise ConfigError(text, source=scene.source)
        centre = to_world(lens, point).tolist()
        for letter, value, low, high in zip("xyz", centre, *domain.bounds, strict=True):
            if not low - slack <= value <= high + slack:
                text = f"{name}: {letter} = {value} is outside [{low}, {high}] m, the domain"
                raise ConfigError(text, source=scene.source)
        across = rotation_matrix(lens.rotation_deg) @ np.asarray(axis, np.float64)
        for face in domain.reflecting:
            k, upper = "xyz".index(face[0]), face.endswith("high")
            beyond = radius * math.sqrt(max(1.0 - across[k] ** 2, 0.0)) - abs(domain.bounds[upper][k] - centre[k])
            if beyond > 0.0:
                text = f"reaches {beyond:.4g} m through {face} of the domain, which has an outside_index"
                raise ConfigError(f"{section}.{field}: {text}", source=scene.source)


def _check_size(scene: Scene, model: sk.Model, copies: float, signed: int) -> bool:
    """Refuses what cannot fit before anything is computed; returns whether half as much again would, which is more than
    the low words of the histograms take."""
    camera, size, cuda = scene.camera, model.tally_size, model.device.is_cuda
    shape = f"{camera.height} x {camera.width} pixels x {scene.gate.bins} bins x {len(scene.components)} components"
    outside, count = f"is outside [1, {2**31 - 1}]", size * max(signed, 1)
    if count >= 2**31 and signed:
        text = f"{shape} x {signed} derivatives or channels = {count} {outside}"
        way_out = "fewer pixels, bins or blocks, or fewer derivatives a run, with the same seed"
        raise ConfigError(f"{text}; {way_out}", source=scene.source)
    if count >= 2**31:
        raise ConfigError(f"camera and gate: {shape} = {size} {outside}", source=scene.source)
    # On the CPU counts on the device, their copy in the result, and the total of the components.
    needed = ((8 if cuda else 16) * size * (1 + signed) + 36 * model.flux.size) * copies / 2**30
    available = model.device.free_memory if cuda else physical_memory()
    if available is not None and needed > available / 2**30:
        free = f"{available / 2**30:.1f} GiB are available"
        raise DeviceError(f"{shape} need {needed:.1f} GiB on {model.device.alias}; {free}")
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
    shots = _shots(scene) if scene.scan.mode == "trajectory" else None

    def trace(begin: Any, along: Any, from_lens: Any) -> list[Any]:
        found = trace_rays(model, begin, along, shape)
        if shots is not None:  # in the frame of each pixel's shot
            turns = shots.rotation[shots.number]
            depth = np.einsum("hwi,hwi->hw", turns[..., 2], from_lens + found[1][..., None] * along)
            normal = np.einsum("hwij,hwi->hwj", turns, found[2])
            found[0], found[2] = depth.astype(np.float32), normal.astype(np.float32)
        return found

    (origin, view), (start, direction, lead) = _rays(scene, model)
    values = trace(start, direction, start - origin)
    values[1] = (values[1] + lead).astype(np.float32)
    if scene.surface is not None:  # what stands before the surface hides what is seen through it
        near = trace(origin, view, np.zeros(3))
        before = near[1] < np.nan_to_num(lead, nan=np.inf)
        pairs = zip(near, values, strict=True)
        values = [np.where(before[..., None] if a.ndim == 3 else before, a, b) for a, b in pairs]
    return Truth(**dict(zip(("depth", "range", "normal", "reflectance"), values, strict=True)))


def _rays(scene: Scene, model: sk.Model) -> tuple[tuple[Any, Any], tuple[Any, Any, Any]]:
    """Rays of pixels `[H, W, 3]`: begin and direction at the lens; and where they leave its port, or meet the surface
    of the sea, how they go on, and their lengths up to there. Empty: the camera's own, as `trace_rays` takes them."""
    camera, plane = scene.camera, camera_port(scene)
    if scene.scan.mode == "trajectory":
        origin, view = _shots(scene).lines()
    elif camera.is_plain and plane is None and scene.surface is None:
        origin = view = np.zeros((0, 0, 3))
    else:
        view = pixel_directions(camera)
        origin = np.zeros(view.shape)
    if scene.surface is None or scene.surface.waves is None:
        plane = mean_plane(scene, from_below=True) if plane is None and scene.surface is not None else plane
        return (origin, view), (origin, view, 0.0) if plane is None else plane.enter(origin, view)[:3]
    rays: Any = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=model.device) for a in (origin, view)]
    found: Any = [wp.empty_like(rays[0]), wp.empty_like(rays[0]), wp.empty(rays[0].shape, float, device=model.device)]
    wp.launch(sk.see_through_waves_kernel, rays[0].shape, [model.sea, *rays], found, device=model.device)
    start, direction, lead = (array.numpy().astype(np.float64) for array in found)
    return (origin, view), (start, direction, lead)


def wave_errors(scene: SceneLike, depth: ArrayLike | None = None, *, device: str | None = None) -> NDArray[np.float64]:
    """By how much depths by the mean plane of the sea are too large, `[H, W]` [m]: of light that goes from the lens by
    the waves before each pixel to a point in the water and back.

    `depth`: by the mean plane, such as `Result.depth` finds them, `[H, W]` [m]; less their errors they are depths by
    the true surface. By default those of the targets, NaN where none is seen below the waves.

    Raises `ConfigError`: a scene without `surface.waves`, or with a camera in the water; `ArgumentError`: depths of
    another shape.
    """
    scene = as_scene(scene)
    plane = camera_port(scene)
    if scene.surface is None or scene.surface.waves is None or plane is None:
        raise ConfigError("surface.waves, and a camera in the air above them, are needed", source=scene.source)
    model = build_model(scene, pick_device(device), build_mesh(scene), camera=False)
    (origin, _), (start, direction, lead) = _rays(scene, model)
    in_air = lead * plane.group_index[0] / plane.group_index[2]  # as a length in water
    lines = dataclasses.replace(lines_of_sight(scene), laser=np.zeros(3), laser_port=plane)
    if depth is None:
        truth = trace_truth(scene, model)
        in_water, actual = truth.range - lead, truth.depth
        path = np.where(in_water > 0.0, 2.0 * (in_air + in_water), np.nan)
        found = lines.depth_from_range(lines.range_from_path(path))
    else:
        found = np.asarray(depth, np.float64)
        if found.shape != lead.shape:
            raise ArgumentError(f"depth has the shape {found.shape}; that of the image, {lead.shape}, is needed")
        in_water = 0.5 * lines.path_from_range(lines.range_from_depth(found)) - in_air
        axis = np.array([0.0, 0.0, 1.0])
        if scene.scan.mode == "trajectory":
            shots = _shots(scene)
            axis = shots.rotation[shots.number][..., 2]
        actual = ((start - origin + np.where(in_water > 0.0, in_water, np.nan)[..., None] * direction) * axis).sum(-1)
    return np.asarray(found - actual, np.float64)


def first_hits(
    triangles: NDArray[np.float64], start: Any, direction: NDArray[np.float64], device: wp.Device
) -> NDArray[np.float64]:
    """Distances [m] along rays `[N, 3]` of the nearest of triangles `[F, 3, 3]`; NaN: none."""
    corners = triangles.reshape(-1, 3)
    faces: wp.array = wp.array(np.arange(len(corners)), dtype=int, device=device)
    mesh = wp.Mesh(wp.array(corners, dtype=wp.vec3, device=device), faces)
    model: Any = SimpleNamespace(device=device, camera=sk.Camera(), surfaces=sk.make_surfaces(mesh, 0.5), mesh=mesh)
    origins = np.broadcast_to(np.asarray(start, np.float64), direction.shape)
    return trace_rays(model, origins[None], direction[None], (1, len(direction)))[1][0].astype(np.float64)


def target_map(scene: SceneLike, *, device: str | None = None) -> NDArray[np.int32]:
    """Number of the target at each pixel's centre, from 0 in the order of the scene; -1 for none; int32 `[H, W]`."""
    scene, target = as_scene(scene), pick_device(device)
    mesh = build_mesh(scene)
    model = build_model(scene, target, mesh, camera=False)
    if mesh is None:
        return np.full((scene.camera.height, scene.camera.width), -1, np.int32)
    # The numbers take the place of what faces reflect.
    number: wp.array = wp.array(mesh.target.astype(np.float32), dtype=float, device=target)
    labelled = dataclasses.replace(model, surfaces=sk.make_surfaces(model.mesh, number))
    return np.nan_to_num(np.rint(trace_truth(scene, labelled).reflectance), nan=-1.0).astype(np.int32)


def trace_rays(model: sk.Model, origins: Any, directions: Any, shape: tuple[int, int]) -> list[NDArray[np.float32]]:
    """Depth, distance, normal and reflectance of what rays `[H, W, 3]` hit, NaN for nothing; of the camera's own rays
    where they are empty."""
    reach = 2.0 * np.abs(origins)[np.isfinite(origins)].max(initial=0.0)
    # A ray that does not get through a port goes where nothing is.
    if np.size(origins):
        passes = np.isfinite(origins + directions).all(axis=-1, keepdims=True)
        origins, directions = np.where(passes, origins, 1e9), np.where(passes, directions, [0.0, 0.0, 1.0])
    rays: Any = [
        wp.array(part.astype(np.float32), dtype=wp.vec3, device=model.device) for part in (origins, directions)
    ]
    depth, distance, reflectance = (wp.empty(shape, dtype=float, device=model.device) for _ in range(3))
    normal = wp.empty(shape, dtype=wp.vec3, device=model.device)
    inputs, outputs = [model.camera, model.surfaces, *rays], [depth, distance, normal, reflectance]
    wp.launch(sk.truth_kernel, dim=shape, inputs=inputs, outputs=outputs, device=model.device)
    found = [array.numpy() for array in (depth, distance, normal, reflectance)]
    if model.mesh is not None:  # a ray along a face may seem to meet its plane far beyond the mesh
        beyond = found[1] > np.linalg.norm(model.mesh.points.numpy(), axis=1).max() + reach
        found = [np.where(beyond.reshape(shape + (1,) * (one.ndim - 2)), np.float32(np.nan), one) for one in found]
    return found
