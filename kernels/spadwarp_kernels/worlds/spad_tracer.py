"""The full camera: Monte Carlo transport of photons through the water and against the shapes, world by world."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.optics.camera import make_camera, make_gate
from spadwarp_kernels.optics.laser import make_laser
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.surface.mesh import Textures, make_surfaces, surface_choices, update_surfaces
from spadwarp_kernels.transport.launch import CUDA_THREADS, Data, Model, launch_transport, make_data
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import make_medium
from spadwarp_kernels.water.phase_functions import Guiding

from .shapes import BOX, CAPSULE, CONE, CYLINDER, MESH, PLANE, SPHERE, Shapes, ShapeTable
from .spad_camera import CAMERA_OUTPUTS, WorldCameras, check_memory
from .spad_config import SpadConfig

__all__ = ["SpadTracer"]

wp.set_module_options({"enable_backward": False})

ESTIMATORS = ("guided", "next_event")

# ---- The shapes of each camera's world as one triangle mesh in the camera's optical frame, placed anew on the device.


SEGMENTS, RINGS = 48, 24


def _profile(kind: int) -> np.ndarray:
    """Radius, height and end (-1 or 1 of a capsule) of a round shape of size 1 from bottom to top, [3, rows]."""
    if kind == CYLINDER:
        return np.array([(0.0, 1.0, 1.0, 0.0), (-1.0, -1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0)])
    if kind == CONE:
        return np.array([(0.0, 1.0, 0.0), (-1.0, -1.0, 1.0), (0.0, 0.0, 0.0)])
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, RINGS + 1)
    rows = np.array([np.abs(np.cos(angle)), np.sin(angle), np.zeros(RINGS + 1)])
    rows[0, [0, -1]] = 0.0
    if kind == CAPSULE:  # twice the middle
        rows = np.insert(rows, RINGS // 2, rows[:, RINGS // 2], axis=1)
        rows[2] = np.repeat([-1.0, 1.0], RINGS // 2 + 1)
    return rows


def _triangles(kind: int) -> tuple[np.ndarray, np.ndarray]:
    """A shape: vertices [n, 3, 3], matrices whose product with its size is the point, and faces [m, 3].

    Round shapes become polygons with as much cross-section as the circle, half of which lie outside of it.
    """
    end = np.zeros(1)
    if kind in (PLANE, BOX):
        x = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in ((0,) if kind == PLANE else (-1, 1))], float)
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces = np.array([(0, 2, 3, 1)] if kind == PLANE else sides)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    else:
        radius, height, end = np.repeat(_profile(kind), SEGMENTS, axis=1)
        number = np.arange(radius.size)
        angle = 2.0 * np.pi * (number % SEGMENTS) / SEGMENTS
        radius = math.sqrt(2.0 * np.pi / SEGMENTS / math.sin(2.0 * np.pi / SEGMENTS)) * radius
        x = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
        here, there = number, number // SEGMENTS * SEGMENTS + (number + 1) % SEGMENTS
        quads = np.stack([here, there, here + SEGMENTS, there + SEGMENTS], axis=1)[:-SEGMENTS]
        faces = quads[:, [0, 1, 2, 2, 1, 3]].reshape(-1, 3)
        a, b, c = np.swapaxes((x + end[:, None] * (0.0, 0.0, 1.0))[faces], 0, 1)
        faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9]
    vertices = np.zeros((len(x), 3, 3))
    if kind in (SPHERE, CAPSULE):
        vertices[:, :, 0], vertices[:, 2, 1] = x, end
    elif kind in (CYLINDER, CONE):
        vertices[:, :2, 0], vertices[:, 2, 1] = x[:, :2], x[:, 2]
    else:
        vertices = np.eye(3) * x[:, :, None] * (0.5 if kind == PLANE else 1.0)
    return vertices, faces


@wp.struct
class Corners:
    """Vertices of all cameras' meshes."""

    camera: wp.array[int]
    shape: wp.array[int]
    source: wp.array[int]  # index in the shape's own `wp.Mesh`; -1 for other shapes
    of_size: wp.array[wp.mat33]  # of these, the matrix whose product with the size is the point


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
    size = table.size[k]
    camera = wp.transform_multiply(camera_q[corners.camera[i]], optical)
    x = corners.of_size[i] * size
    if corners.source[i] >= 0:
        mesh = wp.mesh_get(table.mesh[k])
        x = wp.cw_mul(size, mesh.points[corners.source[i]])
    elif table.kind[k] == PLANE:
        # Without a width it goes as far as the camera can see.
        below = wp.transform_point(wp.transform_inverse(table.pose[k]), wp.transform_get_translation(camera))
        for axis in range(2):
            if size[axis] <= 0.0:
                x[axis] = below[axis] + 2.0 * reach * corners.of_size[i][axis, axis]
    points[i] = wp.transform_point(wp.transform_inverse(camera), wp.transform_point(table.pose[k], x))


@wp.kernel(enable_backward=False)
def _reflectance_kernel(
    shape: wp.array[int], table: ShapeTable, reflectance: wp.array[float], corner_reflectance: wp.array[wp.vec3]
):
    """Writes both, the latter if there is one. Launch: faces."""
    i = wp.tid()
    reflectance[i] = table.reflectance[shape[i]]
    if corner_reflectance.shape[0] > 0:
        corner_reflectance[i] = wp.vec3(reflectance[i])


class CameraMeshes:
    """A triangle mesh for each camera, of what stands in its world, and the shape of each of its faces."""

    def __init__(self, shapes: Shapes, world: list[int], device: wp.Device) -> None:
        table = shapes.table
        kind, first, member = (array.numpy() for array in (table.kind, table.first, table.member))
        own = {one.id: one for one in shapes.meshes}
        keys = np.where(kind == MESH, table.mesh.numpy(), kind.astype(np.uint64)).tolist()
        parts: dict[int, tuple[np.ndarray, ...]] = {}  # source and vertices, see `Corners`, and faces
        for k in member.tolist():
            if keys[k] in parts:
                continue
            if kind[k] != MESH:
                vertices, faces = _triangles(int(kind[k]))
                parts[keys[k]] = np.full(len(vertices), -1), vertices, faces
            elif (mesh := own.get(keys[k])) is None:
                raise ArgumentError(f"the wp.Mesh with the id mesh[{k}] is not found; give it instead")
            else:
                count = mesh.points.size
                parts[keys[k]] = np.arange(count), np.zeros((count, 3, 3)), mesh.indices.numpy().reshape(-1, 3)
        self.shapes, self.device = shapes, device
        self._indices, self.face_shape, self._ends, rows = [], [], [0], []
        for v, w in enumerate(world):
            seen = np.concatenate([member[first[w] : first[w + 1]], member[first[-2] : first[-1]]])
            if not seen.size:
                raise ArgumentError(f"world {w} of camera {v} has no shapes")
            sources, vertices, faces = zip(*(parts[keys[k]] for k in seen), strict=True)
            counts = [len(each) for each in sources]
            ends = np.cumsum(counts)
            self._indices.append(np.concatenate([f + e - n for f, e, n in zip(faces, ends, counts, strict=True)]))
            self.face_shape.append(np.repeat(seen, [len(each) for each in faces]))
            self._ends.append(self._ends[-1] + int(ends[-1]))
            columns = (np.full(ends[-1], v), np.repeat(seen, counts), np.concatenate(sources), np.concatenate(vertices))
            rows.append(columns)
        self.corners = Corners()
        for (name, var), column in zip(Corners.vars.items(), zip(*rows, strict=True), strict=True):
            setattr(self.corners, name, wp.array(np.concatenate(column), dtype=var.type.dtype, device=device))
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
    water: wp.array2d[float],
):
    """Expected detections per pulse of one camera, and those of backscatter: light of the tally, blurred by the
    response, whose taps have zeros for the _RUN - 1 bins before and after it. Launch: (pixels, runs of bins)."""
    pixel, run = wp.tid()
    pixels = rates.shape[0]
    parts = tally.shape[1] / rates.shape[1]
    first = run * _RUN
    start = first * parts + lowest
    after = parts * (_RUN - 1)
    total = _Run(dark)
    scattered = _Run(0.0)
    for s in range(wp.max(0, -start), wp.min(taps.shape[0] - after, tally.shape[1] - start)):
        back = float(wp.float64(tally[pixels + pixel, start + s]) * factor)
        light = float(wp.float64(tally[pixel, start + s]) * factor) + back
        for r in range(wp.static(_RUN)):
            total[r] += taps[s + after - parts * r] * light
            scattered[r] += taps[s + after - parts * r] * back
    for r in range(wp.static(_RUN)):
        if first + r < rates.shape[1]:
            rates[pixel, first + r] = total[r]
            water[pixel, first + r] = scattered[r]


@wp.kernel(enable_backward=False)
def _advance_kernel(offset: wp.array[wp.uint64], count: wp.uint64):
    offset[0] = offset[0] + count


class SpadTracer(WorldCameras):
    """As `SpadCamera`, with all scattering: photons are traced through the water and against the shapes.

    A step is a loop over the cameras of launches that wait for nothing, then one launch for the counts of all; it
    allocates nothing and reads nothing back, so that it can be captured in a CUDA graph, after a first one that checks
    the poses and builds the meshes. Round shapes become polygons of 48 sides. The light of a photon depends on
    `config.seed` and its number, and every step has new photons.

    Args:
        shapes: What stands in the worlds. Kinds and meshes stay; poses, sizes, reflectance and the points of meshes may
            change in place.
        config, cameras, frame, outputs, body, offset, device: As for `SpadCamera`.
        world: World of each camera, a list; by default camera k is in world k.
        photons: Of a step and camera, 1 ... 2^26.
        estimator: "guided" or "next_event".
        oversampling: Bins of the tally in one of the histogram: what lies within one of them arrives in its middle.
        lanes: Cameras that a GPU traces side by side, each with memory of its own: 16 B a pixel and bin of the tally.

    Attributes:
        rates, histogram, counts, depth, distance, status, significance, true_depth, normal, reflectance, step: As of
            `SpadCamera`; `rates` have the noise of the photons that were traced. A detection is told from the traced
            light that has met no surface.
        data: Ledger of the last step, for `read_ledger`, and the tally of one of the cameras.

    Raises:
        ArgumentError: A number out of range, a world without shapes, or arrays that do not fit.
    """

    traced = True

    def __init__(
        self,
        shapes: Shapes,
        config: SpadConfig | None = None,
        cameras: int = 1,
        *,
        photons: int = 1_000_000,
        world: Sequence[int] | None = None,
        frame: str | None = None,
        outputs: Sequence[str] = CAMERA_OUTPUTS,
        body: Any = None,
        offset: Any = None,
        estimator: str = "guided",
        oversampling: int = 4,
        lanes: int = 8,
        device: wp.DeviceLike = None,
    ) -> None:
        check.kind("shapes", shapes, Shapes)
        self._parts = check.integer("oversampling", oversampling, 1, 1024)
        options: dict[str, Any] = {"world": world, "frame": frame, "outputs": outputs, "body": body, "offset": offset}
        super().__init__(config, cameras, **options, device=shapes.device if device is None else device)
        if self.config.camera_matrix is not None:
            raise ArgumentError(
                "config.camera_matrix: SpadTracer has square pixels about the axis; give a field of view"
            )
        sizes = {f"config.{name}": getattr(self.config, name) for name in ("height", "width", "bins")}
        check_memory("tallies", {**sizes, "oversampling": self._parts}, 16, shapes.device, rows=4)
        if self.device != shapes.device:
            raise ArgumentError(f"shapes are on {shapes.device} and not on {self.device}")
        check.choice("estimator", estimator, ESTIMATORS)
        self.photons = check.integer("photons", photons, 1, 1 << 26)
        self.shapes, self._estimator = shapes, estimator
        worlds = self._world.numpy().tolist()
        if max(worlds) >= shapes.worlds:
            raise ArgumentError(f"world = {max(worlds)} is none of the {shapes.worlds} worlds of the shapes")
        self._meshes = CameraMeshes(shapes, worlds, self.device)
        taps, self._lowest = self.config.bin_response(self._parts)
        self._taps = wp.array(np.pad(taps, (_RUN - 1) * self._parts), dtype=float, device=self.device)
        lanes = check.integer("lanes", lanes, 1, 64)
        self._lane_count = min(lanes, self.cameras if self.device.is_cuda else 1)
        self._models: list[Model] = []
        # Memory that cameras share which are traced one after the other; lanes run side by side on a GPU, each on its
        # stream, None for the current one. Tally and cursor are a lane's own, ledger and offset those of all.
        self._lanes: list[tuple[wp.Stream | None, Data]] = []
        self.data: Data | None = None

    def update(self, camera_q: wp.array | None = None, body_q: wp.array | None = None) -> None:
        """A step; see `SpadCamera.update`."""
        poses = self._cast_rays(self.shapes, camera_q, body_q)
        self._meshes.place(poses, self._optical(self.shapes.frame), self.config.gate_paths[1])
        if not self._models:
            self._build()
        data, models = self.data, self._models
        data.ledger.zero_()
        for stream, _ in self._lanes[1:]:
            stream.wait_stream(self.device.stream)
        for v in range(self.cameras):
            stream, own = self._lanes[v % len(self._lanes)]
            with wp.ScopedStream(stream, sync_enter=False):
                self._trace(v, models[v], own)
        for stream, _ in self._lanes[1:]:
            self.device.stream.wait_stream(stream)
        wp.launch(_advance_kernel, 1, [data.offset, self.cameras * self.photons], device=self.device)
        self._detect()

    def _trace(self, v: int, model: Model, data: Data) -> None:
        """Expected detections of one camera, on the device's current stream."""
        config, surfaces, photons = self.config, model.surfaces, self.photons
        inputs = [self._face_shape[v], self.shapes.table]
        outputs = [surfaces.reflectance, surfaces.corner_reflectance]
        wp.launch(_reflectance_kernel, surfaces.reflectance.size, inputs, outputs, device=self.device)
        update_surfaces(surfaces, model.mesh, model.camera)
        data.tally.zero_()
        threads = CUDA_THREADS // len(self._lanes)
        launch_transport(
            self._spec, model, data, seed=config.seed, first_id=v * photons, photon_count=photons, threads=threads
        )
        pixels = config.height * config.width
        factor = config.photons * config.pde / (model.scale * photons)
        tally = data.tally.reshape((2 * pixels, model.gate.bins))
        outputs = [rows[v * pixels : (v + 1) * pixels] for rows in (self._light, self._water)]
        runs = (pixels, -(-config.bins // int(_RUN)))
        inputs = [tally, factor, self._sensor.dark, self._taps, self._lowest]
        wp.launch(_rates_kernel, runs, inputs, outputs, device=self.device)

    def rebuild(self) -> None:
        """Builds the trees anew at the next step, for where things are then: faster rays where they have moved far.

        Not within a graph: captured steps keep the trees that they were captured with.
        """
        self._models = []

    def _build(self) -> None:
        """Meshes, surfaces and models; reads the points back."""
        config = self.config
        medium = make_medium(config.absorption, config.scattering, anisotropy=config.anisotropy)
        laser = make_laser("uniform_cone", half_angle=config.half_angle, position=config.laser_position)
        lens = {"aperture_radius": config.aperture_radius, "focus": 0.5 * sum(config.gate_distance)}
        camera = make_camera(config.width, config.height, config.pixel_tangent, **lens)
        gate = make_gate(self._parts * config.bins, one_way_metres=config.gate_distance)
        limits, guiding = Limits(), Guiding()
        limits.max_path, limits.max_collisions, limits.weight_cutoff = gate.stop, 64, _ROULETTE_BELOW
        guiding.probability = guiding.surface_probability = 0.3
        guiding.anisotropy, guiding.return_probability, guiding.return_anisotropy = 0.97, 0.1, 0.5
        # 2^62 units hold the thousandth part of all photons in one bin; 2^58 units are the largest contribution.
        scale = min(2.0**72 / self.photons, 2.0**58)
        extent = gate.stop + math.hypot(*config.laser_position)  # no photon that counts comes further
        moving: dict[str, Any] = {"camera": camera, "extent": extent}
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
            for k in range(self._lane_count):
                tally = wp.zeros(2 * config.height * config.width * gate.bins, dtype=wp.int64, device=self.device)
                data = dataclasses.replace(shared, tally=tally, cursor=wp.zeros(1, dtype=int, device=self.device))
                self._lanes.append((wp.Stream(self.device) if k else None, data))
            self.data = self._lanes[0][1]

    def _textures(self, owner: np.ndarray) -> "Textures | None":
        """The shapes' images for the faces of one camera's mesh."""
        images = self.shapes.table.textures
        if not images.face.size:
            return None
        first = self.shapes.table.first_face.numpy()[owner]
        _, start, each = np.unique(owner, return_index=True, return_inverse=True)
        row = np.where(first >= 0, first + np.arange(len(owner)) - start[each], 0)
        textures = Textures()
        textures.face = wp.array(np.where(first >= 0, images.face.numpy()[row], -1), dtype=int, device=self.device)
        textures.coordinates = wp.array(images.coordinates.numpy()[row], dtype=wp.vec2, device=self.device)
        textures.region, textures.texels = images.region, images.texels
        return textures
