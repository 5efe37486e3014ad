"""Launching the transport kernel: what it takes (Model), what it writes (Data), and the call itself."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from spadwarp_kernels.estimators.contribution import COMPONENTS
from spadwarp_kernels.intersect.bvh import pack_bvh
from spadwarp_kernels.medium.layers import Layers
from spadwarp_kernels.medium.limits import Limits
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.phase.phase_function import Guiding
from spadwarp_kernels.photon.lanes import BLOCK_SIZE
from spadwarp_kernels.random.philox import round_keys
from spadwarp_kernels.sensor.camera import Camera
from spadwarp_kernels.sensor.gate import Gate
from spadwarp_kernels.sensor.visibility import near_depth_map
from spadwarp_kernels.source.laser import Laser
from spadwarp_kernels.source.scan import Scan
from spadwarp_kernels.surface.mesh import Surfaces, Textures
from spadwarp_kernels.tally.tally import COUNTERS, LEDGER_ENTRIES, LEDGER_SLOTS, LEDGER_WIDTH, OUTSIDE_SHIFT

from .kernel import BRUTE_FORCE_FACES, Records, TransportSpec, make_transport_kernel


@dataclass(frozen=True)
class Model:
    """What is transported through: immutable, on one device.

    Attributes:
        device: Warp device that holds the arrays.
        medium, laser, camera, gate, limits, guiding: Parameter structs.
        mesh: Target, or None for water alone; kept here so that its BVH lives as long as the model.
        surfaces: The struct that kernels take, made from the mesh by `make_surfaces`.
        scale: Tally units per emitted photon.
        layers: Of a layered spec, from `make_layers`; empty otherwise.
        scan: Raster of a confocal spec; empty otherwise.
    """

    device: wp.Device
    medium: Medium
    laser: Laser
    camera: Camera
    gate: Gate
    limits: Limits
    guiding: Guiding
    mesh: wp.Mesh | None
    surfaces: Surfaces
    scale: float
    layers: Layers = field(default_factory=Layers)
    scan: Scan = field(default_factory=Scan)

    @property
    def tally_size(self) -> int:
        return len(COMPONENTS) * self.camera.width * self.camera.height * self.gate.bins


@dataclass
class Data:
    """What transport writes: mutable, on one device; several launches may add to one.

    Attributes:
        tally: int64 [component * height * width * bin], fixed point.
        ledger: int64 [LEDGER_WIDTH * LEDGER_SLOTS]; the sum over slots is the ledger, see `read_ledger`.
        records: Terminal states of the last launch's photons.
        cursor: int32 [1]: how many photons of the running launch have been handed out; launches that share it go to one
            stream.
    """

    tally: wp.array
    ledger: wp.array
    records: Records
    cursor: wp.array


def make_data(model: Model, *, tally: wp.array | None = None, record_count: int = 0, histogram: bool = True) -> Data:
    """Zeroed tallies for a model, or the caller's own int64 array of `model.tally_size` to add to.

    `histogram=False` makes none, for the estimator "none", which has nothing to put into it.
    """
    size = model.tally_size if histogram else 1
    if tally is None:
        tally = wp.zeros(size, dtype=wp.int64, device=model.device)
    elif tally.dtype is not wp.int64 or tally.size != size or not tally.is_contiguous or tally.ndim != 1:
        raise ValueError(f"tally is {tally.dtype.__name__} {tally.shape}; contiguous int64 ({size},) is needed")
    return Data(
        tally=tally,
        ledger=wp.zeros(LEDGER_SLOTS * LEDGER_WIDTH, dtype=wp.int64, device=model.device),
        records=make_records(record_count, device=model.device),
        cursor=wp.zeros(1, dtype=int, device=model.device),
    )


def make_records(count: int, *, device: wp.DeviceLike = None) -> Records:
    """Room for the terminal states of `count` photons."""
    records = Records()
    records.position = wp.zeros(count, dtype=wp.vec3, device=device)
    records.direction = wp.zeros(count, dtype=wp.vec3, device=device)
    records.weight = wp.zeros(count, dtype=float, device=device)
    records.path = wp.zeros(count, dtype=float, device=device)
    records.collisions = wp.zeros(count, dtype=int, device=device)
    records.reason = wp.zeros(count, dtype=int, device=device)
    return records


def make_layers(
    start: Sequence[float],
    extinction: Sequence[float],
    albedo: Sequence[float],
    anisotropy: Sequence[float],
    *,
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    device: wp.DeviceLike = None,
) -> Layers:
    """The layers of a layered spec, one entry of each list for a layer; see `Layers` for their meaning."""
    columns = {"start": start, "extinction": extinction, "albedo": albedo, "anisotropy": anisotropy}
    if len({len(column) for column in columns.values()}) > 1:
        sizes = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
        raise ValueError(f"layers: {sizes} entries; one each for every layer are needed")
    layers = Layers()
    layers.axis = wp.vec3(*axis)
    for name, column in columns.items():
        setattr(layers, name, wp.array(column, dtype=float, device=device))
    return layers


def make_surfaces(
    mesh: wp.Mesh | None,
    reflectance: wp.array | float = 0.5,
    *,
    corner_reflectance: wp.array | None = None,
    textures: "Textures | None" = None,
    specular: wp.array | float | None = None,
    roughness: wp.array | float = 0.2,
    camera: "Camera | None" = None,
    device: wp.DeviceLike = None,
) -> Surfaces:
    """The kernel's view of a mesh.

    Lambertian reflectance plus `specular` must not exceed 1 anywhere. `surface_choices` has the fields of
    `TransportSpec` that go with what is returned.

    Args:
        mesh: Any `wp.Mesh`; None for no surface at all. After a refit, make the surfaces anew; the arrays may stay.
        reflectance: Lambertian, in [0, 1]: one number or a float32 array with one entry a face.
        corner_reflectance: Lambertian reflectance at the corners of each face, vec3 [faces], interpolated between them;
            takes the place of `reflectance`.
        textures: From `make_textures`; multiplies the corners', which default to `reflectance`.
        specular: Reflectance of the facets of a rough specular lobe, in [0, 1]: one number or an array as above.
        roughness: GGX width parameter of the lobe, in [0.01, 1]: one number or an array as above.
        camera: Saves most of the rays between scattering events and its lens.
        device: Where the empty arrays go if there is no mesh.

    Raises:
        ValueError: An array whose length is not the number of faces.
    """
    surfaces = Surfaces()
    device = device if mesh is None else mesh.device
    face_count = 0 if mesh is None else mesh.indices.size // 3

    def by_face(name: str, value: wp.array | float | None, dtype: type) -> wp.array:
        if mesh is None or value is None:
            return wp.zeros(0, dtype=dtype, device=device)
        if not isinstance(value, wp.array):
            value = wp.full(face_count, value, dtype=dtype, device=device)
        if len(value) != face_count:
            raise ValueError(f"{name} has {len(value)} entries; the mesh has {face_count} faces")
        return value

    surfaces.reflectance = by_face("reflectance", reflectance, float)
    if textures is not None and corner_reflectance is None:
        rows = surfaces.reflectance.numpy()[:, None].repeat(3, axis=1)
        corner_reflectance = wp.array(rows, dtype=wp.vec3, device=device)
    surfaces.corner_reflectance = by_face("corner_reflectance", corner_reflectance, wp.vec3)
    surfaces.specular = by_face("specular", specular, float)
    surfaces.roughness = by_face("roughness", None if specular is None else roughness, float)
    surfaces.textures = no_textures(device) if textures is None else textures
    surfaces.nodes = wp.zeros(0, dtype=wp.vec4, device=device)
    surfaces.faces = wp.zeros(0, dtype=wp.vec4, device=device)
    surfaces.order = wp.zeros(0, dtype=int, device=device)
    surfaces.near_depth = wp.zeros((0, 0), dtype=float, device=device)
    if mesh is None:
        return surfaces
    if textures is not None:
        by_face("textures.face", textures.face, int)
    points = mesh.points.numpy()
    lower, upper = points.min(axis=0), points.max(axis=0)
    extent = float(abs(points).max())
    padding = 1e-6 * extent + 1e-6
    surfaces.mesh = mesh.id
    surfaces.nodes, surfaces.faces, surfaces.order = pack_bvh(mesh, extent)
    surfaces.lower = wp.vec3(*(lower - padding))
    surfaces.upper = wp.vec3(*(upper + padding))
    if camera is not None:
        surfaces.near_depth = near_depth_map(mesh, camera)
    return surfaces


def surface_choices(surfaces: Surfaces) -> dict[str, bool]:
    """The fields of `TransportSpec` that surfaces need: `pattern` and `specular`."""
    return {"pattern": surfaces.corner_reflectance.size > 0, "specular": surfaces.specular.size > 0}


def no_textures(device: wp.DeviceLike = None) -> Textures:
    textures = Textures()
    textures.face = wp.zeros(0, dtype=int, device=device)
    textures.coordinates = wp.zeros((0, 3), dtype=wp.vec2, device=device)
    textures.region = wp.zeros(0, dtype=wp.vec3i, device=device)
    textures.texels = wp.zeros(0, dtype=float, device=device)
    return textures


def make_textures(
    face: np.ndarray, coordinates: np.ndarray, images: Sequence[np.ndarray], *, device: wp.DeviceLike = None
) -> Textures:
    """Images for the faces of a mesh.

    Args:
        face: Index into `images` for each face, -1 for none; integers [faces].
        coordinates: (u, v) at the corners of each face, [faces, 3, 2]: (0, 0) is the image's lower left corner, (1, 1)
            its upper right one; outside of [0, 1] it repeats.
        images: Reflectance factors in [0, 1], each [rows, columns], the first row on top.
        device: Where to.
    """
    ends = np.cumsum([0, *(image.size for image in images)])
    region = [(start, image.shape[1], image.shape[0]) for start, image in zip(ends, images, strict=False)]
    textures = Textures()
    textures.face = wp.array(np.asarray(face, np.int32), dtype=int, device=device)
    textures.coordinates = wp.array(np.asarray(coordinates, np.float32), dtype=wp.vec2, device=device)
    textures.region = wp.array(np.array(region, np.int32), dtype=wp.vec3i, device=device)
    texels = np.concatenate([np.asarray(image, np.float32).ravel() for image in images])
    textures.texels = wp.array(texels, dtype=float, device=device)
    return textures


# Threads of a CUDA launch: enough to fill any GPU, few enough that flushing their counts costs nothing.
CUDA_THREADS = 1 << 19


def load_transport_kernel(spec: TransportSpec, device: wp.DeviceLike = None) -> None:
    """Compiles the kernel of a spec for a device, or loads it from Warp's cache, ahead of the first launch."""
    device = wp.get_device(device)
    make_transport_kernel(spec, device.is_cuda).module.load(device, BLOCK_SIZE if device.is_cuda else 1)


def launch_transport(
    spec: TransportSpec, model: Model, data: Data, *, seed: int, first_id: int, photon_count: int
) -> None:
    """Walks the photons first_id ... first_id + photon_count - 1 and adds them to `data`; asynchronous on CUDA.

    Args:
        spec: Compile-time choices; each new one compiles a kernel (seconds), cached on disk.
        model, data: On the same device.
        seed: 0 ... 2^64 - 1. A photon's history depends on (seed, id) alone.
        first_id: 64-bit.
        photon_count: 1 ... 2^26 in one launch.

    Raises:
        ValueError: A count out of range, or surfaces that the spec does not describe, see `surface_choices`.
    """
    if not 0 < photon_count <= 1 << 26:
        raise ValueError(f"photon_count = {photon_count} is outside [1, 2^26]")
    if spec.brute_force and not 0 < model.surfaces.order.size <= BRUTE_FORCE_FACES:
        raise ValueError(f"spec.brute_force = True is for meshes of 1 to {BRUTE_FORCE_FACES} faces")
    for name, needed in surface_choices(model.surfaces).items():
        if spec.mesh and getattr(spec, name) != needed:
            raise ValueError(
                f"spec.{name} = {getattr(spec, name)} does not go with the model's surfaces, see surface_choices"
            )
    threads = min(-(-photon_count // BLOCK_SIZE) * BLOCK_SIZE, CUDA_THREADS) if model.device.is_cuda else 1
    data.cursor.zero_()
    wp.launch(
        make_transport_kernel(spec, model.device.is_cuda),
        dim=threads,
        inputs=[
            model.medium,
            model.layers,
            model.laser,
            model.camera,
            model.gate,
            model.limits,
            model.guiding,
            model.surfaces,
            model.scan,
            seed,
            round_keys(seed),
            first_id,
            photon_count,
            model.scale,
        ],
        outputs=[data.tally, data.ledger, data.records, data.cursor],
        device=model.device,
        block_dim=BLOCK_SIZE,
    )


def read_ledger(data: Data) -> tuple[dict[str, int], dict[str, int]]:
    """Ledger entries (units of LEDGER_UNIT photon) and counters summed over slots; waits for the device."""
    totals = data.ledger.numpy().reshape(LEDGER_WIDTH, LEDGER_SLOTS).sum(axis=1)
    names = LEDGER_ENTRIES + COUNTERS
    values = {name: int(total) for name, total in zip(names, totals, strict=True)}
    for name in ("before_gate", "after_gate"):
        values[name] <<= int(OUTSIDE_SHIFT)
    return {n: values[n] for n in LEDGER_ENTRIES}, {n: values[n] for n in COUNTERS}
