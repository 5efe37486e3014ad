"""The full camera: Monte Carlo transport of photons through the water and against the shapes, world by world."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_choice, check_integer, check_kind
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.optics.gate import Gate
from spadwarp_kernels.optics.laser import LASER_PROFILES, Laser
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.surface.mesh import Textures, make_surfaces, surface_choices, update_surfaces
from spadwarp_kernels.transport.launch import CUDA_THREADS, Data, Model, launch_transport, make_data
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Medium
from spadwarp_kernels.water.phase_functions import Guiding

from .cameras import WorldCameras
from .checks import check_room
from .config import SpadConfig, check_config
from .shapes import Shapes
from .triangles import CameraMeshes, _albedo_kernel

__all__ = ["SpadTracer"]

wp.set_module_options({"enable_backward": False})

ESTIMATORS = ("guided", "next_event")

# Weight below which a photon plays Russian roulette. In water of 0.3 / m before a wall at 6 m: a third of the events
# less, 4 % more noise.
_ROULETTE_BELOW = 0.1


# Bins that a thread computes: what they need of the tally overlaps.
_RUN = wp.constant(2)
_Run = wp.types.vector(length=2, dtype=float)


@wp.kernel(enable_backward=False)
def _rates_kernel(
    tally: wp.array2d(dtype=wp.int64),
    factor: wp.float64,
    dark: float,
    taps: wp.array(dtype=float),
    lowest: int,
    # Out:
    rates: wp.array2d(dtype=float),
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
def _advance_kernel(offset: wp.array(dtype=wp.uint64), count: wp.uint64):
    offset[0] = offset[0] + count


@dataclasses.dataclass(frozen=True)
class _Lane:
    """What cameras that are traced one after the other share; lanes run side by side on a GPU.

    Attributes:
        stream: None for the device's current one.
        data: Its tally and cursor; the ledger and the offset are those of all lanes.
    """

    stream: wp.Stream | None
    data: Data


class SpadTracer(WorldCameras):
    """As `SpadCamera`, with all scattering: photons are traced through the water and against the shapes.

    A step is a loop over the cameras of launches that wait for nothing, then one launch for the counts of all; it
    allocates nothing and reads nothing back, so that it can be captured in a CUDA graph, after a first one that checks
    the poses and builds the meshes. Round shapes become polygons of
    48 sides. The light of a photon depends on `config.seed` and its number, and every step has new photons.

    Args:
        shapes: What stands in the worlds. Kinds and meshes stay; poses, sizes, albedo and the points of meshes may
            change in place.
        config, cameras, frame, device: As for `SpadCamera`.
        world: World of each camera, a list; by default camera k is in world k.
        photons: Of a step and camera, 1 ... 2^26.
        estimator: "guided" or "next_event".
        oversampling: Bins of the tally in one of the histogram: what lies within one of them arrives in its middle.
        lanes: Cameras that a GPU traces side by side, each with memory of its own: 8 B a pixel and bin of the tally.
        public_tree: See `make_surfaces`.

    Attributes:
        rates, histogram, counts, depth, true_depth, normal, albedo, step: As of `SpadCamera`; `rates` have the noise of
            the photons that were traced.
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
        public_tree: bool = False,
        device: wp.DeviceLike = None,
    ) -> None:
        check_kind("shapes", shapes, Shapes)
        config = check_config(config)
        self._parts = check_integer("oversampling", oversampling, 1, 1024)
        sizes = {"config.height": config.height, "config.width": config.width, "config.bins": config.bins}
        check_room("tallies", {**sizes, "oversampling": self._parts}, 8, shapes.device, rows=4)
        super().__init__(config, cameras, world=world, frame=frame, device=shapes.device if device is None else device)
        if self.device != shapes.device:
            raise ArgumentError(f"shapes are on {shapes.device} and not on {self.device}")
        check_choice("estimator", estimator, ESTIMATORS)
        self.photons = check_integer("photons", photons, 1, 1 << 26)
        self.shapes, self._public_tree = shapes, public_tree
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
        self._look(self.shapes, camera_q, body_q)
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
        self._detection.launch()

    def _trace(self, v: int, model: Model, lane: _Lane) -> None:
        """Expected detections of one camera, on the device's current stream."""
        config, surfaces, photons = self.config, model.surfaces, self.photons
        inputs = [self._face_shape[v], self.shapes.table]
        outputs = [surfaces.reflectance, surfaces.corner_reflectance]
        wp.launch(_albedo_kernel, surfaces.reflectance.size, inputs, outputs, device=self.device)
        update_surfaces(surfaces, model.mesh, model.camera)
        lane.data.tally.zero_()
        launch_transport(
            self._spec,
            model,
            lane.data,
            seed=config.seed,
            first_id=v * photons,
            photon_count=photons,
            threads=CUDA_THREADS // len(self._lanes),
        )
        pixels = config.height * config.width
        factor = config.photons * config.pde / (model.scale * photons)
        dark = config.dark_rate * config.bin_path / config.speed
        tally = lane.data.tally.reshape((pixels, model.gate.bins))
        rates = self.rates[v].reshape((pixels, config.bins))
        runs = (pixels, -(-config.bins // int(_RUN)))
        inputs = [tally, factor, dark, self._taps, self._lowest]
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
        self._face_shape, models = [], []
        for mesh, owner in zip(self._meshes.build(), self._meshes.face_shape, strict=True):
            self._face_shape.append(wp.array(owner, dtype=int, device=self.device))
            reflectance = wp.zeros(len(owner), dtype=float, device=self.device)
            textures = self._textures(owner)
            corners = None if textures is None else wp.zeros(len(owner), dtype=wp.vec3, device=self.device)
            surfaces = make_surfaces(
                mesh,
                reflectance,
                corner_reflectance=corners,
                textures=textures,
                camera=camera,
                extent=extent,
                public_tree=self._public_tree,
            )
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
        _, start, count = np.unique(owner, return_index=True, return_counts=True)
        number = np.zeros(len(owner), int)  # of the face in its own mesh
        for begin, faces in zip(start, count, strict=True):
            number[begin : begin + faces] = np.arange(faces)
        row = np.where(first >= 0, first + number, 0)
        textures = Textures()
        face = np.where(first >= 0, table.textures.face.numpy()[row], -1)
        textures.face = wp.array(face, dtype=int, device=self.device)
        textures.coordinates = wp.array(table.textures.coordinates.numpy()[row], dtype=wp.vec2, device=self.device)
        textures.region, textures.texels = table.textures.region, table.textures.texels
        return textures
