"""Launching the transport kernel: what it takes (Model), what it writes (Data), and the call itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_attributes,
    check_device,
    check_fields,
    check_integer,
    check_kind,
    check_number,
    check_seed,
    check_struct,
    check_vector,
)
from spadwarp_kernels.base.native import zeros
from spadwarp_kernels.base.philox import round_keys
from spadwarp_kernels.base.tables import TABLE_CELLS
from spadwarp_kernels.estimators.estimator import Estimator
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.optics.camera import PLAIN, Camera, Gate, check_camera, ready_camera
from spadwarp_kernels.optics.laser import LASER_PROFILES, Laser, Scan
from spadwarp_kernels.optics.polarisation import MATRIX_POINTS, Polarisation
from spadwarp_kernels.optics.port import check_port
from spadwarp_kernels.photon.lanes import BLOCK_SIZE
from spadwarp_kernels.photon.sink import Sink
from spadwarp_kernels.photon.spec import TransportSpec, check_spec
from spadwarp_kernels.photon.state import Records, make_records
from spadwarp_kernels.photon.world import World
from spadwarp_kernels.surface.mesh import Surfaces, check_faces, check_patches, surface_choices
from spadwarp_kernels.surface.patches import BRUTE_FORCE_FACES
from spadwarp_kernels.tally.blocks import (
    MOST_BLOCK_DERIVATIVES,
    ready_blocks,
    threads_of_blocks,
)
from spadwarp_kernels.tally.ledger import (
    BOUNDARY_COUNTERS,
    COUNTERS,
    LEDGER_ENTRIES,
    LEDGER_SLOTS,
    LEDGER_WIDTH,
    OUTSIDE_SHIFT,
    PORT_ENTRY,
)
from spadwarp_kernels.tally.scores import DERIVATIVES, MOST_DERIVATIVES, Derivatives
from spadwarp_kernels.tally.tally import (
    COMPONENTS,
    find_overflow_kernel,
    fold_accumulators,
    fold_kernel,
    splitting_pays,
)
from spadwarp_kernels.water.limits import Limits, ready_limits
from spadwarp_kernels.water.medium import Grid, Layers, Medium, ready_medium
from spadwarp_kernels.water.phase_functions import TABULATED, Guiding

from .loops import make_transport_kernel

__all__ = ["Data", "Model", "launch_transport", "load_transport_kernel", "make_data", "read_ledger"]


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
        derivatives: The parameters of a spec with derivatives or channels, from `make_derivatives`.
        polarisation: Those of a polarised spec, from `make_polarisation`.
        split_accumulators: Whether large launches on CUDA may take half the tally's memory more where that makes them
            faster, with the same sums.

    Raises:
        ArgumentError: Another kind of struct, a device that does not exist, or a scale that is not positive.
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
    derivatives: Derivatives = field(default_factory=Derivatives)
    polarisation: Polarisation = field(default_factory=Polarisation)
    split_accumulators: bool = False

    def __post_init__(self) -> None:
        check_model(self)
        object.__setattr__(self, "device", wp.get_device(self.device))

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
        offset: uint64 [1], added to the photons' ids where `spec.stepped` is set; the caller moves it on.
        reflecting: Whether faces of the domain reflect, so that `read_ledger` reports on them.
        gradients: int64 [voxel of the tally * derivative], the tally of a spec's derivatives, or of its channels; None
            without them.
        split_accumulators: uint32, as long as the tally, zero between launches; made by the first launch that is large
            enough, see `tally.splitting_pays`, and used by those after it.
    """

    tally: wp.array
    ledger: wp.array
    records: Records
    cursor: wp.array
    offset: wp.array | None = None
    reflecting: bool = False
    gradients: wp.array | None = None
    split_accumulators: wp.array | None = None


def make_data(
    model: Model,
    *,
    tally: wp.array | None = None,
    record_count: int = 0,
    histogram: bool = True,
    derivatives: int = 0,
) -> Data:
    """Zeroed tallies for a model, or the caller's own int64 array of `model.tally_size` to add to.

    `histogram=False` makes none, for an estimator that scores nothing; `record_count` is the number of photons of the
    largest launch, where `spec.records` asks for their records; `derivatives` is how many the spec has, those by block
    included. Raises `ArgumentError`.
    """
    check_kind("model", model, Model)
    size = check_integer("bins of the tally", model.tally_size, 0) if histogram else 1
    if tally is None:
        tally = zeros(size, wp.int64, model.device)
    else:
        check_array("tally", tally, wp.int64, (size,), model.device, contiguous=True)
    derivatives = check_integer("derivatives", derivatives, 0, MOST_DERIVATIVES + MOST_BLOCK_DERIVATIVES)
    signed = check_integer("bins of data.gradients", size * derivatives, 0)
    return Data(
        tally=tally,
        ledger=wp.zeros(LEDGER_SLOTS * LEDGER_WIDTH, dtype=wp.int64, device=model.device),
        records=make_records(record_count, device=model.device, derivatives=derivatives),
        cursor=wp.zeros(1, dtype=int, device=model.device),
        offset=wp.zeros(1, dtype=wp.uint64, device=model.device),
        reflecting=any((*model.limits.boundary.low, *model.limits.boundary.high)),
        gradients=zeros(signed, wp.int64, model.device) if histogram and derivatives else None,
    )


# ---- What a launch checks before it: a kernel trusts what it is given.


_STRUCTS = {
    "medium": Medium,
    "laser": Laser,
    "camera": Camera,
    "gate": Gate,
    "limits": Limits,
    "guiding": Guiding,
    "surfaces": Surfaces,
    "layers": Layers,
    "scan": Scan,
    "derivatives": Derivatives,
    "polarisation": Polarisation,
}
_MEDIUM = {"extinction": "[0, inf)", "albedo": "[0, 1]", "anisotropy": "(-1, 1)", "axis_threshold": "(0, 1]"}
_GUIDING = {
    "probability": "[0, 1)",
    "surface_probability": "[0, 1)",
    "anisotropy": "(-1, 1)",
    "return_probability": "[0, 1)",
    "return_anisotropy": "(-1, 1)",
}
# What each laser profile reads.
_BEAM = ({"spread": "[0, 2]"}, {"tan2": "[0, inf)"}, {"radius": "[0, inf)"})


def check_model(model: Any) -> None:
    """Kinds of what a model holds, and a device that exists."""
    check_device("model.device", model.device)
    for name, struct in _STRUCTS.items():
        check_struct(f"model.{name}", getattr(model, name), struct)
    if model.mesh is not None and not isinstance(model.mesh, wp.Mesh):
        raise ArgumentError(f"model.mesh is {type(model.mesh).__name__}; a wp.Mesh or None is needed")
    check_number("model.scale", model.scale, "(0, inf)")


def check_launch(spec: TransportSpec, model: Model, data: Data, photon_count: int) -> None:
    """Everything that the kernel of a spec reads and writes: numbers in range, arrays long enough and on the device."""
    check_spec(spec)
    estimator = make_estimator(spec)
    if spec.mesh:
        _check_surfaces(spec, model)
    _check_water(spec, model)
    _check_laser(spec, model)
    _check_limits(spec, model)
    if estimator.scores:
        check_camera("model.camera", model.camera, calibrated=spec.lens.name != PLAIN.name)
        check_integer("model.gate.bins", model.gate.bins, 1)
        check_fields("model.gate", model.gate, {"start": "(-inf, inf)", "bins_per_metre": "(0, inf)"})
        check_number("model.gate.stop", model.gate.stop, f"({float(model.gate.start)}, inf)")
        if spec.port is not None:
            check_port("model.camera.port", model.camera.port, spec.port)
    if spec.laser_port is not None:
        check_port("model.laser.port", model.laser.port, spec.laser_port)
    if estimator.cross is not None:
        check_fields("model.camera", model.camera, {"aperture_radius": "(0, inf)"})
    if estimator.direct is not None:
        check_fields("model.guiding", model.guiding, _GUIDING)
    if spec.confocal:
        _check_scan(model, estimator)
    if spec.derivatives or spec.blocks:
        _check_derivatives(spec, model)
    if spec.polarised:
        _check_polarisation(spec, model)
    _check_data(spec, model, data, estimator, photon_count)


def _check_water(spec: TransportSpec, model: Model) -> None:
    medium, device = model.medium, model.device
    check_fields("model.medium", medium, _MEDIUM)
    if spec.phase.name == TABULATED.name:
        check_attributes("model.medium.phase", medium.phase, device, cells=(3, TABLE_CELLS), guide=(3, TABLE_CELLS))
    if spec.layered:
        layers = model.layers
        check_attributes("model.layers", layers, device, start=(None,))
        check_integer("number of model.layers", layers.start.size, 1)
        check_vector("model.layers.axis", layers.axis, unit=True)
        shape = layers.start.shape
        check_attributes("model.layers", layers, device, extinction=shape, albedo=shape, anisotropy=shape)
    if spec.grid is not None:
        _check_grid(model.layers.grid, device)


def _check_grid(grid: Grid, device: wp.Device) -> None:
    sizes = {"size": list(grid.size), "block_size": list(grid.block_size)}
    for name, size in sizes.items():
        for count in size:
            check_integer(f"model.layers.grid.{name}", count, 1)
    cells, blocks = (math.prod(size) for size in sizes.values())
    check_attributes("model.layers.grid", grid, device, extinction=(cells,), albedo=(cells,), residual=(cells,))
    check_attributes("model.layers.grid", grid, device, anisotropy=(None,))
    if grid.anisotropy.size:
        check_attributes("model.layers.grid", grid, device, anisotropy=(cells,))
    edge = check_integer("model.layers.grid.block_edge", grid.block_edge, 1)
    if sizes["block_size"] != [-(-count // edge) for count in sizes["size"]]:
        raise ArgumentError(f"model.layers.grid: {sizes['block_size']} blocks of {edge} cells; see make_grid")
    check_attributes("model.layers.grid", grid, device, block_majorant=(blocks,), block_control=(blocks,))


def _check_laser(spec: TransportSpec, model: Model) -> None:
    laser, device = model.laser, model.device
    check_vector("model.laser.position", laser.position)
    if not spec.confocal:
        check_vector("model.laser.axis", laser.axis, unit=True)
    if spec.measured_beam:
        check_attributes("model.laser", laser, device, rows=(None,))
        check_integer("rows of the laser's profile", laser.rows.size, 1)
        check_attributes("model.laser", laser, device, columns=(laser.rows.size, None))
        check_integer("columns of the laser's profile", laser.columns.shape[1], 1)
        for extent in laser.extent:
            check_number("model.laser.extent", extent, "(0, inf)")
    else:
        profile = check_integer("model.laser.profile", laser.profile, 0, len(LASER_PROFILES) - 1)
        check_fields("model.laser", laser, _BEAM[profile])


def _check_limits(spec: TransportSpec, model: Model) -> None:
    limits = model.limits
    check_fields("model.limits", limits, {"max_path": "(0, inf)", "weight_cutoff": "[0, 1)"})
    check_integer("model.limits.max_collisions", limits.max_collisions, 0)
    if spec.bounded:
        check_number("model.limits.lateral", limits.lateral, "(0, inf)")
        for low, high in zip(limits.lower, limits.upper, strict=True):
            check_number("model.limits.lower", low)
            check_number("model.limits.upper", high, f"({float(low)}, inf)")
    if spec.reflecting:
        boundary = limits.boundary
        for name, indices in (("low", boundary.low), ("high", boundary.high)):
            for axis in range(3):
                check_number(f"model.limits.boundary.{name}[{axis}]", indices[axis], "[0, 1e9]")
        check_integer("model.limits.boundary.max_reflections", boundary.max_reflections, 0)
        check_attributes("model.limits.boundary", boundary, model.device, images=(None,))
    if spec.rotated_domain:
        check_vector("model.limits.origin", limits.origin)
        rows = [[limits.rotation[i, j] for j in range(3)] for i in range(3)]
        for row in rows:
            check_vector("model.limits.rotation, a row", row, unit=True)


def _check_surfaces(spec: TransportSpec, model: Model) -> None:
    surfaces, device = model.surfaces, model.device
    check_attributes("model.surfaces", surfaces, device, reflectance=(None,), nodes=(None,), near_depth=(None, None))
    faces = surfaces.reflectance.size
    if faces == 0:
        raise ArgumentError("spec.mesh = True needs surfaces of a mesh, see make_surfaces; model.surfaces has no faces")
    if spec.brute_force and faces > BRUTE_FORCE_FACES:
        raise ArgumentError(
            f"spec.brute_force = True is for meshes of 1 to {BRUTE_FORCE_FACES} faces; model.surfaces has {faces}"
        )
    for name, needed in surface_choices(surfaces).items():
        if getattr(spec, name) != needed:
            raise ArgumentError(
                f"spec.{name} = {getattr(spec, name)} does not go with the model's surfaces, see surface_choices"
            )
    check_faces("model.surfaces", surfaces, faces, device)
    if spec.use_warp_bvh and (model.mesh is None or model.mesh.id != surfaces.mesh):
        raise ArgumentError(
            "spec.use_warp_bvh = True reads the mesh that the surfaces were made of, which has to be model.mesh: the "
            "model keeps it"
        )
    if spec.brute_force and device.is_cuda:
        check_patches("model.surfaces", surfaces, faces, device)
    if spec.pattern:
        textures = surfaces.textures
        check_attributes("model.surfaces", surfaces, device, corner_reflectance=(faces,))
        check_attributes("model.surfaces.textures", textures, device, face=(None,))
        if textures.face.size:
            check_attributes("model.surfaces.textures", textures, device, face=(faces,), coordinates=(faces, 3))
    if spec.specular:
        check_attributes("model.surfaces", surfaces, device, specular=(faces,), roughness=(faces,))


def _check_derivatives(spec: TransportSpec, model: Model) -> None:
    derivatives, device = model.derivatives, model.device
    for p, kind in enumerate(spec.derivatives):
        check_number(f"model.derivatives.value[{p}]", derivatives.value[p], DERIVATIVES[kind])
        check_number(f"model.derivatives.scale[{p}]", derivatives.scale[p], "(0, inf)")
    if spec.blocks:
        blocks = derivatives.blocks
        for edge, (count, cells) in enumerate(zip(blocks.grid.size, model.layers.grid.size, strict=True)):
            check_integer(f"model.derivatives.blocks.grid.size[{edge}]", count, 1, cells)
        count = check_integer("model.derivatives.blocks.count", blocks.count, 1, MOST_BLOCK_DERIVATIVES)
        if count != math.prod(blocks.grid.size):
            raise ArgumentError(f"model.derivatives.blocks.count = {count}; see make_blocks")
        for q in range(len(spec.blocks)):
            check_number(f"model.derivatives.blocks.scale[{q}]", blocks.scale[q], "(0, inf)")
    if spec.layered:
        check_attributes("model.derivatives", derivatives, device, waters=(model.layers.start.size,))
    if "reflectance" in spec.derivatives:
        check_attributes("model.derivatives", derivatives, device, faces=(model.surfaces.reflectance.size,))


def _check_polarisation(spec: TransportSpec, model: Model) -> None:
    polarisation, device = model.polarisation, model.device
    if model.medium.axis_threshold < 1.0:
        raise ArgumentError(
            f"model.medium.axis_threshold = {model.medium.axis_threshold}; spec.polarised = True needs 1, without the "
            "near-axis rule, which has no plane of scattering"
        )
    check_attributes("model.polarisation", polarisation, device, first=(MATRIX_POINTS,), last=(MATRIX_POINTS,))
    for k in range(spec.channels):
        check_number(f"model.derivatives.scale[{k}]", model.derivatives.scale[k], "(0, inf)")
    if spec.specular:
        check_attributes("model.polarisation", polarisation, device, facet_index=(model.surfaces.reflectance.size,))


def _check_scan(model: Model, estimator: Estimator) -> None:
    scan, camera = model.scan, model.camera
    most = camera.width * camera.height if estimator.scores else 2**31 - 1
    count = check_integer("model.scan.count", scan.count, 1, most)
    check_attributes("model.scan", scan, model.device, axis=(None,), view=(None,))
    for name in ("axis", "view"):
        check_integer(f"entries of model.scan.{name}", getattr(scan, name).size, count)


def _check_data(spec: TransportSpec, model: Model, data: Data, estimator: Estimator, photon_count: int) -> None:
    device = model.device
    bins = model.tally_size // len(COMPONENTS) if spec.merged else model.tally_size
    size = check_integer("bins of the tally", bins, 1) if estimator.scores else None
    check_array("data.tally", data.tally, wp.int64, (size,), device, contiguous=True)
    signed = spec.signed + len(spec.blocks) * model.derivatives.blocks.count
    if signed and size is not None:
        size = check_integer("bins of data.gradients", size * signed, 1)
        check_array("data.gradients", data.gradients, wp.int64, (size,), device, contiguous=True)
    elif data.gradients is not None:
        check_array("data.gradients", data.gradients, wp.int64, (None,), device)
    if data.split_accumulators is not None:
        check_array(
            "data.split_accumulators", data.split_accumulators, wp.uint32, (data.tally.size,), device, contiguous=True
        )
    check_array("data.ledger", data.ledger, wp.int64, (LEDGER_SLOTS * LEDGER_WIDTH,), device, contiguous=True)
    check_array("data.cursor", data.cursor, wp.int32, (1,), device)
    if spec.stepped or data.offset is not None:
        check_array("data.offset", data.offset, wp.uint64, (1,), device)
    check_struct("data.records", data.records, Records)
    if spec.records:
        for name, var in Records.vars.items():
            if name == "log_derivatives" and not spec.derivatives:
                continue
            shape = (None, len(spec.derivatives)) if name == "log_derivatives" else (None,)
            array = check_array(f"data.records.{name}", getattr(data.records, name), var.type.dtype, shape, device)
            if array.shape[0] < photon_count:
                raise ArgumentError(
                    f"data.records.{name} has room for {array.shape[0]} photons; spec.records = True needs "
                    f"{photon_count}, see record_count of make_data"
                )


# ---- The launch.


# Threads of a CUDA launch: enough to fill any GPU, few enough that flushing their counts costs nothing.
CUDA_THREADS = 1 << 19

# In one launch.
_MOST_PHOTONS = 1 << 26


def load_transport_kernel(
    spec: TransportSpec, device: wp.DeviceLike = None, *, model: Model | None = None, photon_count: int = _MOST_PHOTONS
) -> None:
    """Compiles the kernel of a spec for a device, or loads it from Warp's cache, ahead of the first launch.

    With `model`, the kernel of a first launch of `photon_count` photons, which later launches into the same data take,
    too: with a large tally on CUDA it may be another one, see `Model.split_accumulators`.
    """
    check_spec(spec)
    device = check_device("device", device)
    split_accumulators = False
    if model is not None:
        check_kind("model", model, Model)
        photon_count = check_integer("photon_count", photon_count, 1, _MOST_PHOTONS)
        split_accumulators = splits_accumulators(spec, model, photon_count)
    kernel = make_transport_kernel(spec, device.is_cuda, split_accumulators)
    kernel.module.load(device, BLOCK_SIZE if device.is_cuda else 1)
    if split_accumulators:
        wp.load_module(fold_kernel.module, device=device)
    # Loaded here and not by a worker: each thread that compiles makes Warp prepare its headers anew, 1.5 s on a CPU.
    wp.load_module(find_overflow_kernel.module, device=device)


def splits_accumulators(spec: TransportSpec, model: Model, photon_count: int) -> bool:
    """Whether a launch into a tally of the model keeps its low words apart; see `tally.split_accumulators`."""
    if not (model.split_accumulators and model.device.is_cuda and make_estimator(spec).scores):
        return False
    voxels = model.tally_size // len(COMPONENTS)
    return not (spec.signed or spec.blocks) and splitting_pays(voxels, photon_count)


def launch_transport(
    spec: TransportSpec,
    model: Model,
    data: Data,
    *,
    seed: int,
    first_id: int,
    photon_count: int,
    threads: int = CUDA_THREADS,
) -> None:
    """Walks the photons first_id ... first_id + photon_count - 1 and adds them to `data`; asynchronous on CUDA.

    Args:
        spec: Compile-time choices; each new one compiles a kernel (seconds), cached on disk.
        model, data: On the same device.
        seed: 0 ... 2^64 - 1. A photon's history depends on (seed, id) alone.
        first_id: 64-bit.
        photon_count: 1 ... 2^26 in one launch.
        threads: At most so many on CUDA, 128 or more: fewer for launches that share a GPU, so that each thread moves
            many photons.

    Raises:
        ArgumentError: Before anything is launched, for what the kernel of this spec cannot take: a number out of range,
            an array that is too short or on another device, or surfaces that the spec does not describe, see
            `surface_choices`.
    """
    check_kind("model", model, Model)
    check_kind("data", data, Data)
    photon_count = check_integer("photon_count", photon_count, 1, _MOST_PHOTONS)
    first_id = check_integer("first_id", first_id, 0, 2**64 - photon_count)
    seed = check_seed(seed)
    threads = check_integer("threads", threads, BLOCK_SIZE)
    check_launch(spec, model, data, photon_count)
    blocks = min(-(-photon_count // BLOCK_SIZE), threads // BLOCK_SIZE)
    threads = blocks * BLOCK_SIZE if model.device.is_cuda else 1
    if spec.blocks:
        threads = threads_of_blocks(threads, model.derivatives.blocks)
    data.cursor.zero_()
    split_accumulators = _split_accumulators(spec, model, data, photon_count)
    world, sink = _make_world(spec, model, seed, threads), _make_sink(model, data, split_accumulators)
    wp.launch(
        make_transport_kernel(spec, model.device.is_cuda, split_accumulators is not None),
        dim=threads,
        inputs=[world, sink, data.records, first_id, photon_count, threads, data.cursor, data.offset],
        device=model.device,
        block_dim=BLOCK_SIZE,
    )
    if split_accumulators is not None:
        fold_accumulators(split_accumulators, data.tally)


def _split_accumulators(spec: TransportSpec, model: Model, data: Data, photon_count: int) -> wp.array | None:
    """Those of `data` for a launch that uses them: a large one, and after it also smaller ones, which would need
    another kernel otherwise."""
    if not splits_accumulators(spec, model, photon_count if data.split_accumulators is None else _MOST_PHOTONS):
        return None
    if data.split_accumulators is None and not model.device.is_capturing:  # what is made there belongs to the graph
        data.split_accumulators = wp.zeros(data.tally.size, dtype=wp.uint32, device=model.device)
    return data.split_accumulators


def _make_world(spec: TransportSpec, model: Model, seed: int, threads: int) -> World:
    """The fields of a model as they are now. Bytes are all that a launch takes, and attribute by attribute costs Python
    0.3 ms; but what records a graph reads the attributes. The model keeps their arrays."""
    world = World()
    held, recorded = world.__ctype__(), model.device.is_capturing
    for name in _STRUCTS:
        if recorded:
            setattr(world, name, getattr(model, name))
        else:
            setattr(held, name, getattr(model, name).__ctype__())
    held.seed, held.keys = seed, round_keys(seed).__ctype__()
    ready_medium(world.medium, model.medium)
    ready_limits(world.limits, model.limits)
    if spec.lens == PLAIN:
        ready_camera(world.camera, model.camera)
    if spec.blocks:
        ready_blocks(world.derivatives.blocks, model.derivatives.blocks, threads, model.device)
    return world


def _make_sink(model: Model, data: Data, split_accumulators: wp.array | None) -> Sink:
    sink = Sink()
    sink.tally, sink.ledger, sink.scale = data.tally, data.ledger, model.scale
    if data.gradients is not None:
        sink.gradients = data.gradients
    if split_accumulators is not None:
        sink.low = split_accumulators
    return sink


def read_ledger(data: Data) -> tuple[dict[str, int], dict[str, int]]:
    """Ledger entries (units of LEDGER_UNIT photon) and counters summed over slots; waits for the device.

    Entries are LEDGER_ENTRIES and, behind a laser's port, what that reflects: `laser_port`. Counters are COUNTERS and,
    where faces of the domain reflect, BOUNDARY_COUNTERS.
    """
    check_kind("data", data, Data)
    check_array("data.ledger", data.ledger, wp.int64, (LEDGER_SLOTS * LEDGER_WIDTH,))
    slots = data.ledger.numpy().reshape(LEDGER_WIDTH, LEDGER_SLOTS)
    # In halves: light outside the gate may exceed 64 bits in all.
    high, low = (slots >> 32).sum(axis=1).tolist(), (slots & 0xFFFFFFFF).sum(axis=1).tolist()
    values = {
        name: (upper << 32) + lower
        for name, upper, lower in zip(
            LEDGER_ENTRIES + COUNTERS + (PORT_ENTRY,) + BOUNDARY_COUNTERS, high, low, strict=True
        )
    }
    for name in ("before_gate", "after_gate"):
        values[name] <<= int(OUTSIDE_SHIFT)
    entries = {n: values[n] for n in LEDGER_ENTRIES}
    if values[PORT_ENTRY]:
        entries[PORT_ENTRY] = values[PORT_ENTRY]
    counters = COUNTERS + BOUNDARY_COUNTERS if data.reflecting else COUNTERS
    return entries, {n: values[n] for n in counters}
