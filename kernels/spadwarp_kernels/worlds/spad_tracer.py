"""The full camera: Monte Carlo transport of photons through the water and against the shapes, world by world."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_choice, check_integer, check_kind
from spadwarp_kernels.optics.camera import Camera, Gate
from spadwarp_kernels.optics.laser import LASER_PROFILES, Laser
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.surface.mesh import Textures, make_surfaces, surface_choices, update_surfaces
from spadwarp_kernels.transport.launch import CUDA_THREADS, Data, Model, launch_transport, make_data
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Medium
from spadwarp_kernels.water.phase_functions import Guiding

from .shapes import BOX, CAPSULE, CONE, CYLINDER, ELLIPSOID, MESH, PLANE, SPHERE, Shapes, ShapeTable
from .spad_camera import SpadConfig, WorldCameras, check_config, check_memory

__all__ = ["SpadTracer"]

wp.set_module_options({"enable_backward": False})

ESTIMATORS = ("guided", "next_event")

# ---- The shapes of each camera's world as one triangle mesh in the camera's optical frame, placed anew on the device.


SEGMENTS, RINGS = 48, 24


def _revolution(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A surface of revolution from (radius, height, lift) rows: vertices [n, 4] of x, y, z and lift, and faces."""
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    # As much cross-section as the circle has: half of the polygon lies outside.
    size = math.sqrt(2.0 * np.pi / SEGMENTS / math.sin(2.0 * np.pi / SEGMENTS))
    radius = size * profile[:, :1]
    columns = [radius * np.cos(angle), radius * np.sin(angle)]
    columns += [np.broadcast_to(profile[:, k : k + 1], columns[0].shape) for k in (1, 2)]
    vertices = np.stack(columns, axis=-1).reshape(-1, 4)
    row = np.arange(len(profile) - 1)[:, None] * SEGMENTS
    here, there = np.arange(SEGMENTS), (np.arange(SEGMENTS) + 1) % SEGMENTS
    quads = np.stack([row + here, row + there, row + SEGMENTS + here, row + SEGMENTS + there], axis=-1).reshape(-1, 4)
    faces = quads[:, [0, 1, 2, 2, 1, 3]].reshape(-1, 3)
    corners = vertices[faces, :4]
    area = np.linalg.norm(
        np.cross(corners[:, 1, :3] - corners[:, 0, :3], corners[:, 2, :3] - corners[:, 0, :3]), axis=1
    )
    lifted = np.ptp(corners[..., 3], axis=1) > 0.0
    return vertices, faces[(area > 1e-9) | lifted]


def _profile(kind: int) -> np.ndarray:
    """(radius, height, lift) from the bottom to the top, of a shape of size 1."""
    if kind == CYLINDER:
        return np.array([(0.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
    if kind == CONE:
        return np.array([(0.0, -1.0, 0.0), (1.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, RINGS + 1)
    rows = np.stack([np.abs(np.cos(angle)), np.sin(angle), np.zeros_like(angle)], axis=1)
    rows[[0, -1], 0] = 0.0
    if kind == CAPSULE:
        low, high = rows[: RINGS // 2 + 1].copy(), rows[RINGS // 2 :].copy()
        low[:, 2], high[:, 2] = -1.0, 1.0
        return np.concatenate([low, high])
    return rows


def _unit_triangles(kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n, 4] and faces [m, 3] of a shape of size 1, see `_corner`."""
    if kind == PLANE:
        corners = [(-1, -1, 0, 0), (1, -1, 0, 0), (1, 1, 0, 0), (-1, 1, 0, 0)]
        return np.array(corners, float), np.array([(0, 1, 2), (0, 2, 3)])
    if kind == BOX:
        corners = np.array([(x, y, z, 0) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
        return corners, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return _revolution(_profile(kind))


@wp.struct
class Corners:
    """Vertices of all cameras' meshes."""

    camera: wp.array[int]
    shape: wp.array[int]
    unit: wp.array[wp.vec4]  # x, y, z for a shape of size 1, and on which end of a capsule it is (lift)
    source: wp.array[int]  # index in the shape's own `wp.Mesh`; -1 for other shapes


@wp.func
def _corner(kind: int, size: wp.vec3, unit: wp.vec4) -> wp.vec3:
    scale = size  # of a box or an ellipsoid
    lift = float(0.0)
    if kind == SPHERE:
        scale = wp.vec3(size[0])
    elif kind == CAPSULE:
        scale = wp.vec3(size[0])
        lift = size[1] * unit[3]
    elif kind == PLANE:
        scale = wp.vec3(0.5 * size[0], 0.5 * size[1], 0.0)
    elif kind != BOX and kind != ELLIPSOID:
        scale = wp.vec3(size[0], size[0], size[1])
    return wp.cw_mul(scale, wp.vec3(unit[0], unit[1], unit[2])) + wp.vec3(0.0, 0.0, lift)


@wp.kernel(enable_backward=False)
def _place_kernel(
    corners: Corners,
    table: ShapeTable,
    camera_q: wp.array[wp.transform],
    optical: wp.transform,
    reach: float,
    # Out:
    points: wp.array[wp.vec3],
):
    """Launch: vertices."""
    i = wp.tid()
    k = corners.shape[i]
    kind = table.kind[k]
    size = table.size[k]
    camera = wp.transform_multiply(camera_q[corners.camera[i]], optical)
    x = wp.vec3(0.0)
    if corners.source[i] >= 0:
        mesh = wp.mesh_get(table.mesh[k])
        x = wp.cw_mul(size, mesh.points[corners.source[i]])
    else:
        x = _corner(kind, size, corners.unit[i])
        if kind == PLANE:
            # Without a width it goes as far as the camera can see.
            below = wp.transform_point(wp.transform_inverse(table.pose[k]), wp.transform_get_translation(camera))
            for axis in range(2):
                if size[axis] <= 0.0:
                    x[axis] = below[axis] + reach * corners.unit[i][axis]
    points[i] = wp.transform_point(wp.transform_inverse(camera), wp.transform_point(table.pose[k], x))


@wp.kernel(enable_backward=False)
def _reflectance_kernel(
    shape: wp.array[int],
    table: ShapeTable,
    # Out:
    reflectance: wp.array[float],
    corner_reflectance: wp.array[wp.vec3],
):
    """Launch: faces."""
    i = wp.tid()
    value = table.reflectance[shape[i]]
    reflectance[i] = value
    if corner_reflectance.shape[0] > 0:
        corner_reflectance[i] = wp.vec3(value)


class CameraMeshes:
    """A triangle mesh for each camera, of what stands in its world, and the shape of each of its faces."""

    def __init__(self, shapes: Shapes, world: list[int], device: wp.Device) -> None:
        table = shapes.table
        kind, first, member = (array.numpy() for array in (table.kind, table.first, table.member))
        own, ids = {one.id: one for one in shapes.meshes}, table.mesh.numpy().tolist()
        parts = {}  # of shapes that are not meshes, and of meshes
        for k in member.tolist():
            key = ids[k] if kind[k] == MESH else -int(kind[k])
            if key not in parts:
                parts[key] = _mesh_triangles(k, own.get(key)) if kind[k] == MESH else _unit_triangles(int(kind[k]))
        self.shapes, self.device = shapes, device
        self._indices, self.face_shape, self._ends = [], [], [0]
        camera, shape, unit, source = [], [], [np.zeros((0, 4))], []
        for v, w in enumerate(world):
            seen = np.concatenate([member[first[w] : first[w + 1]], member[first[-2] : first[-1]]])
            held = [parts[ids[k] if kind[k] == MESH else -int(kind[k])] for k in seen]
            counts = np.array([len(vertices) for vertices, _ in held], int)
            start = np.append(0, np.cumsum(counts))
            faces = [faces + begin for (_, faces), begin in zip(held, start, strict=False)]
            self._indices.append(np.concatenate([np.zeros((0, 3), int), *faces]))
            self.face_shape.append(np.repeat(seen, np.array([len(each) for each in faces], int)))
            self._ends.append(self._ends[-1] + int(start[-1]))
            camera.append(np.full(start[-1], v))
            shape.append(np.repeat(seen, counts))
            unit += [vertices for vertices, _ in held]
            own_index = np.arange(start[-1]) - np.repeat(start[:-1], counts)
            source.append(np.where(np.repeat(kind[seen], counts) == MESH, own_index, -1))
        self.corners = Corners()
        for name, rows in (("camera", camera), ("shape", shape), ("source", source)):
            setattr(self.corners, name, wp.array(np.concatenate(rows), dtype=int, device=device))
        self.corners.unit = wp.array(np.concatenate(unit), dtype=wp.vec4, device=device)
        self.points = wp.zeros(self._ends[-1], dtype=wp.vec3, device=device)

    def place(self, camera_q: wp.array, optical: wp.transform, reach: float) -> None:
        """Writes all points for the poses of shapes and cameras."""
        inputs = [self.corners, self.shapes.table, camera_q, optical, reach]
        wp.launch(_place_kernel, self.points.size, inputs, [self.points], device=self.device)

    def build(self) -> list[wp.Mesh]:
        """Meshes, whose trees are built for where the points are now."""
        # The fastest to walk, by measurement.
        kind: dict[str, Any] = {"bvh_constructor": "cubql", "bvh_leaf_size": 1} if self.device.is_cuda else {}
        return [
            wp.Mesh(self.points[start:stop], wp.array(indices.ravel(), dtype=int, device=self.device), **kind)
            for indices, start, stop in zip(self._indices, self._ends, self._ends[1:], strict=False)
        ]


def _mesh_triangles(k: int, mesh: wp.Mesh | None) -> tuple[np.ndarray, np.ndarray]:
    """Stand-in vertices and the faces of the mesh of a shape."""
    if mesh is None:
        raise ArgumentError(f"the wp.Mesh with the id mesh[{k}] is not found; give it instead")
    return np.zeros((mesh.points.size, 4)), mesh.indices.numpy().reshape(-1, 3)


# ---- The camera.


# Weight below which a photon plays Russian roulette. In water of 0.3 / m before a wall at 6 m: a third of the events
# less, 4 % more noise.
_ROULETTE_BELOW = 0.1


# Bins that a thread computes: what they need of the tally overlaps.
_RUN = wp.constant(2)
_Run = wp.types.vector(length=2, dtype=float)


@wp.kernel(enable_backward=False)
def _rates_kernel(
    tally: wp.array2d[wp.int64],
    factor: wp.float64,
    dark: float,
    taps: wp.array[float],
    lowest: int,
    # Out:
    rates: wp.array2d[float],
):
    """Expected detections per pulse of one camera: light of the tally, blurred by the response.

    `taps` has zeros for the _RUN - 1 bins before and after the response. Launch: (pixels, runs of bins).
    """
    pixel, run = wp.tid()
    parts = tally.shape[1] / rates.shape[1]
    first = run * _RUN
    start = first * parts + lowest
    after = parts * (_RUN - 1)
    total = _Run(dark)
    for s in range(wp.max(0, -start), wp.min(taps.shape[0] - after, tally.shape[1] - start)):
        light = float(wp.float64(tally[pixel, start + s]) * factor)
        for r in range(wp.static(_RUN)):
            total[r] += taps[s + after - parts * r] * light
    for r in range(wp.static(_RUN)):
        if first + r < rates.shape[1]:
            rates[pixel, first + r] = total[r]


@wp.kernel(enable_backward=False)
def _advance_kernel(offset: wp.array[wp.uint64], count: wp.uint64):
    offset[0] = offset[0] + count


@dataclasses.dataclass(frozen=True)
class _Lane:
    """Memory that cameras share which are traced one after the other; lanes run side by side on a GPU."""

    stream: wp.Stream | None  # none for the device's current one
    data: Data  # its tally and cursor; the ledger and the offset are those of all lanes


class SpadTracer(WorldCameras):
    """As `SpadCamera`, with all scattering: photons are traced through the water and against the shapes.

    A step is a loop over the cameras of launches that wait for nothing, then one launch for the counts of all; it
    allocates nothing and reads nothing back, so that it can be captured in a CUDA graph, after a first one that checks
    the poses and builds the meshes. Round shapes become polygons of
    48 sides. The light of a photon depends on `config.seed` and its number, and every step has new photons.

    Args:
        shapes: What stands in the worlds. Kinds and meshes stay; poses, sizes, reflectance and the points of meshes may
            change in place.
        config, cameras, frame, device: As for `SpadCamera`.
        world: World of each camera, a list; by default camera k is in world k.
        photons: Of a step and camera, 1 ... 2^26.
        estimator: "guided" or "next_event".
        oversampling: Bins of the tally in one of the histogram: what lies within one of them arrives in its middle.
        lanes: Cameras that a GPU traces side by side, each with memory of its own: 8 B a pixel and bin of the tally.
        use_warp_bvh: See `make_surfaces`.

    Attributes:
        rates, histogram, counts, depth, true_depth, normal, reflectance, step: As of `SpadCamera`; `rates` have the
            noise of the photons that were traced.
        data: Ledger of the last step, for `read_ledger`, and the tally of one of the cameras.

    Raises:
        ArgumentError: A number out of range, a world without shapes, or arrays that do not fit.
    """

    def __init__(
        self,
        shapes: Shapes,
        config: SpadConfig | None = None,
        cameras: int = 1,
        *,
        photons: int = 1_000_000,
        world: Sequence[int] | None = None,
        frame: str = "optical",
        estimator: str = "guided",
        oversampling: int = 4,
        lanes: int = 8,
        use_warp_bvh: bool = False,
        device: wp.DeviceLike = None,
    ) -> None:
        check_kind("shapes", shapes, Shapes)
        config = check_config(config)
        self._parts = check_integer("oversampling", oversampling, 1, 1024)
        sizes = {"config.height": config.height, "config.width": config.width, "config.bins": config.bins}
        check_memory("tallies", {**sizes, "oversampling": self._parts}, 8, shapes.device, rows=4)
        super().__init__(config, cameras, world=world, frame=frame, device=shapes.device if device is None else device)
        if self.device != shapes.device:
            raise ArgumentError(f"shapes are on {shapes.device} and not on {self.device}")
        check_choice("estimator", estimator, ESTIMATORS)
        self.photons = check_integer("photons", photons, 1, 1 << 26)
        self.shapes, self._use_warp_bvh = shapes, use_warp_bvh
        worlds = self._world.numpy().tolist()
        if max(worlds) >= shapes.worlds:
            raise ArgumentError(f"world = {max(worlds)} is none of the {shapes.worlds} worlds of the shapes")
        self._meshes = CameraMeshes(shapes, worlds, self.device)
        for v, faces in enumerate(self._meshes.face_shape):
            if not len(faces):
                raise ArgumentError(f"world {worlds[v]} of camera {v} has no shapes")
        taps, self._lowest = self.config.bin_response(self._parts)
        self._taps = wp.array(np.pad(taps, (_RUN - 1) * self._parts), dtype=float, device=self.device)
        self._lane_count = min(check_integer("lanes", lanes, 1, 64), self.cameras if self.device.is_cuda else 1)
        self._estimator = estimator
        self._models: list[Model] = []
        self._lanes: list[_Lane] = []
        self.data: Data | None = None

    def update(self, camera_q: wp.array, body_q: wp.array | None = None) -> None:
        """A step; see `SpadCamera.update`."""
        self._cast_rays(self.shapes, camera_q, body_q)
        self._meshes.place(camera_q, self._optical, self.config.gate_paths[1])
        if not self._models:
            self._build()
        data, models = self.data, self._models
        data.ledger.zero_()
        for lane in self._lanes[1:]:
            lane.stream.wait_stream(self.device.stream)
        for v in range(self.cameras):
            lane = self._lanes[v % len(self._lanes)]
            with wp.ScopedStream(lane.stream, sync_enter=False):
                self._trace(v, models[v], lane)
        for lane in self._lanes[1:]:
            self.device.stream.wait_stream(lane.stream)
        wp.launch(_advance_kernel, 1, [data.offset, self.cameras * self.photons], device=self.device)
        self._detect()

    def _trace(self, v: int, model: Model, lane: _Lane) -> None:
        """Expected detections of one camera, on the device's current stream."""
        config, surfaces, photons = self.config, model.surfaces, self.photons
        inputs = [self._face_shape[v], self.shapes.table]
        outputs = [surfaces.reflectance, surfaces.corner_reflectance]
        wp.launch(_reflectance_kernel, surfaces.reflectance.size, inputs, outputs, device=self.device)
        update_surfaces(surfaces, model.mesh, model.camera)
        lane.data.tally.zero_()
        threads = CUDA_THREADS // len(self._lanes)
        launch_transport(
            self._spec, model, lane.data, seed=config.seed, first_id=v * photons, photon_count=photons, threads=threads
        )
        pixels = config.height * config.width
        factor = config.photons * config.pde / (model.scale * photons)
        tally = lane.data.tally.reshape((pixels, model.gate.bins))
        rates = self.rates[v].reshape((pixels, config.bins))
        runs = (pixels, -(-config.bins // int(_RUN)))
        inputs = [tally, factor, self._dark, self._taps, self._lowest]
        wp.launch(_rates_kernel, runs, inputs, [rates], device=self.device)

    def rebuild(self) -> None:
        """Builds the trees anew at the next step, for where things are then: faster rays where they have moved far.

        Not within a graph: captured steps keep the trees that they were captured with.
        """
        self._models = []

    def _build(self) -> None:
        """Meshes, surfaces and models; reads the points back."""
        config = self.config
        medium, laser, camera, gate = Medium(), Laser(), Camera(), Gate()
        limits, guiding = Limits(), Guiding()
        medium.extinction = config.absorption + config.scattering
        medium.albedo = config.scattering / medium.extinction if medium.extinction > 0.0 else 0.0
        medium.anisotropy, medium.axis_threshold = config.anisotropy, 1.0
        laser.position, laser.axis = wp.vec3(*config.laser_position), wp.vec3(0.0, 0.0, 1.0)
        laser.profile, laser.spread = LASER_PROFILES.index("uniform_cone"), 1.0 - math.cos(config.half_angle)
        camera.width, camera.height, camera.pixel_tangent = config.width, config.height, config.pixel_tangent
        camera.aperture_radius, camera.aperture_area = config.aperture_radius, math.pi * config.aperture_radius**2
        camera.inverse_focus = 2.0 / (config.gate[0] + config.gate[1])
        gate.start, gate.stop = config.gate_paths
        gate.bins, gate.bins_per_metre = self._parts * config.bins, self._parts / config.bin_path
        limits.max_path, limits.max_collisions, limits.weight_cutoff = gate.stop, 64, _ROULETTE_BELOW
        guiding.probability = guiding.surface_probability = 0.3
        guiding.anisotropy, guiding.return_probability, guiding.return_anisotropy = 0.97, 0.1, 0.5
        # 2^62 units hold the thousandth part of all photons in one bin; 2^58 units are the largest contribution.
        scale = min(2.0**72 / self.photons, 2.0**58)
        extent = gate.stop + math.hypot(*config.laser_position)  # no photon that counts comes further
        moving: dict[str, Any] = {"camera": camera, "extent": extent, "use_warp_bvh": self._use_warp_bvh}
        self._face_shape, models = [], []
        for mesh, owner in zip(self._meshes.build(), self._meshes.face_shape, strict=True):
            self._face_shape.append(wp.array(owner, dtype=int, device=self.device))
            reflectance = wp.zeros(len(owner), dtype=float, device=self.device)
            textures = self._textures(owner)
            corners = None if textures is None else wp.zeros(len(owner), dtype=wp.vec3, device=self.device)
            surfaces = make_surfaces(mesh, reflectance, corner_reflectance=corners, textures=textures, **moving)
            models.append(Model(self.device, medium, laser, camera, gate, limits, guiding, mesh, surfaces, scale))
        self._models = models
        choices = surface_choices(models[0].surfaces)
        self._spec = TransportSpec(self._estimator, stepped=True, merged=True, roulette=True, **choices)
        if self.data is None:
            shared = make_data(models[0], histogram=False)
            self._lanes = [self._make_lane(k, models[0], shared) for k in range(self._lane_count)]
            self.data = self._lanes[0].data

    def _make_lane(self, k: int, model: Model, shared: Data) -> _Lane:
        size = self.config.height * self.config.width * model.gate.bins
        tally = wp.zeros(size, dtype=wp.int64, device=self.device)
        data = dataclasses.replace(shared, tally=tally, cursor=wp.zeros(1, dtype=int, device=self.device))
        return _Lane(wp.Stream(self.device) if k > 0 else None, data)

    def _textures(self, owner: np.ndarray) -> "Textures | None":
        """The shapes' images for the faces of one camera's mesh."""
        table = self.shapes.table
        if not table.textures.face.size:
            return None
        first = table.first_face.numpy()[owner]
        _, start, each = np.unique(owner, return_index=True, return_inverse=True)
        number = np.arange(len(owner)) - start[each]  # of the face in its own mesh
        row = np.where(first >= 0, first + number, 0)
        textures = Textures()
        face = np.where(first >= 0, table.textures.face.numpy()[row], -1)
        textures.face = wp.array(face, dtype=int, device=self.device)
        textures.coordinates = wp.array(table.textures.coordinates.numpy()[row], dtype=wp.vec2, device=self.device)
        textures.region, textures.texels = table.textures.region, table.textures.texels
        return textures
