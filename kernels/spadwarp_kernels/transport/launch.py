"""Launching the transport kernel: what it takes (Model), what it writes (Data), and the call itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError, Need
from spadwarp_kernels.base.native import zeros
from spadwarp_kernels.base.philox import round_keys
from spadwarp_kernels.base.tables import TABLE_CELLS
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.optics.camera import PLAIN, SCANNED, Camera, Gate, check_camera, ready_camera
from spadwarp_kernels.optics.laser import LASER_PROFILES, Laser, Scan
from spadwarp_kernels.optics.polarisation import MATRIX_POINTS, Polarisation
from spadwarp_kernels.optics.port import FLAT_PORT, check_port
from spadwarp_kernels.optics.sea import Sea
from spadwarp_kernels.photon.derivatives import (
    DERIVATIVES,
    MOST_BLOCK_DERIVATIVES,
    MOST_DERIVATIVES,
    Derivatives,
    ready_blocks,
    threads_of_blocks,
)
from spadwarp_kernels.photon.queue import BLOCK_SIZE
from spadwarp_kernels.photon.spec import TransportSpec, check_spec
from spadwarp_kernels.photon.state import Launch, Records, Sink, World, make_records
from spadwarp_kernels.surface.mesh import Surfaces, check_faces, check_patches, surface_choices
from spadwarp_kernels.surface.patches import BRUTE_FORCE_FACES
from spadwarp_kernels.tally import ledger
from spadwarp_kernels.tally.flux import FLUX_KINDS, Flux
from spadwarp_kernels.tally.tally import (
    COMPONENTS,
    exact_sums,
    find_overflow_kernel,
    fold_accumulators,
    splitting_pays,
    tally_components,
)
from spadwarp_kernels.water.limits import Limits, ready_limits
from spadwarp_kernels.water.medium import Layers, Lines, Medium, ready_medium
from spadwarp_kernels.water.phase_functions import TABULATED, Guiding

from .loops import make_transport_kernel

__all__ = ["Data", "Model", "launch_transport", "load_transport_kernel", "make_data", "prepare_transport"]
__all__ += ["read_ledger"]

# The structs of a model, by name.
_STRUCTS = {name: var.type for name, var in World.vars.items() if name not in ("seed", "keys")}


@dataclass(frozen=True)
class Model:
    """What is transported through: immutable, on one device.

    Raises:
        ArgumentError: Another kind of struct, a device that does not exist, or a scale that is not positive.
    """

    device: wp.Device  # Warp device that holds the arrays
    medium: Medium  # parameter structs
    laser: Laser  # likewise
    camera: Camera  # likewise
    gate: Gate  # likewise
    limits: Limits  # likewise
    guiding: Guiding  # likewise
    mesh: wp.Mesh | None  # target, or None for water alone; kept here so that its BVH lives as long as the model
    surfaces: Surfaces  # the struct that kernels take, made from the mesh by `make_surfaces`
    scale: float  # tally units per emitted photon
    layers: Layers = field(default_factory=Layers)  # of a layered spec, from `make_layers`; empty otherwise
    scan: Scan = field(default_factory=Scan)  # raster of a confocal spec; empty otherwise
    derivatives: Derivatives = field(default_factory=Derivatives)
    """The parameters of a spec with derivatives or channels, from `make_derivatives`."""
    polarisation: Polarisation = field(default_factory=Polarisation)
    """Those of a polarised spec, from `make_polarisation`."""
    lines: Lines = field(default_factory=Lines)
    """Of a spec with `lines`, from `make_lines`."""
    flux: Flux = field(default_factory=Flux)  # sections of a spec with flux, from `make_flux`
    sea: Sea = field(default_factory=Sea)  # the surface of a sea, from `make_sea`; of index 0 without one
    split_accumulators: bool = False
    """Whether large launches on CUDA may take half the tally's memory more where that makes them faster, with the same
    sums."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "device", check.device("model.device", self.device))
        for name, struct in _STRUCTS.items():
            check.kind(f"model.{name}", getattr(self, name), struct)
        if self.mesh is not None and not isinstance(self.mesh, wp.Mesh):
            raise ArgumentError(f"model.mesh is {type(self.mesh).__name__}; a wp.Mesh or None is needed")
        check.number("model.scale", self.scale, "(0, inf)")

    @property
    def tally_size(self) -> int:
        return len(self.components) * self.camera.width * self.camera.height * self.gate.bins

    @property
    def components(self) -> tuple[str, ...]:
        """Those of the tally, the first of its axes."""
        return tally_components(self.has_sea)

    @property
    def has_sea(self) -> bool:
        """Whether there is a surface of a sea."""
        return float(self.sea.index) > 0.0


@dataclass
class Data:
    """What transport writes: mutable, on one device; several launches may add to one."""

    tally: wp.array  # int64 [component * height * width * bin], fixed point
    ledger: wp.array  # int64 [LEDGER_WIDTH * LEDGER_SLOTS]; the sum over slots is the ledger, see `read_ledger`
    records: Records  # terminal states of the last launch's photons
    cursor: wp.array
    """int32 [1]: how many photons of the running launch have been handed out; launches that share it go to one
    stream."""
    offset: wp.array | None = None
    """uint64 [1], added to the photons' ids where `spec.stepped` is set; the caller moves it on."""
    reflecting: bool = False  # whether faces of the domain reflect, so that `read_ledger` reports on them
    has_sea: bool = False  # whether there is a surface of a sea, likewise
    gradients: wp.array | None = None
    """int64 [voxel of the tally * derivative], the tally of a spec's derivatives, or of its channels; None without
    them."""
    flux: wp.array | None = None  # int64 [model.flux.size], the tally of its sections; None without them
    split_accumulators: wp.array | None = None
    """uint32, as long as the tally, zero between launches; made by the first launch that is large enough, see
    `tally.splitting_pays`."""
    flux_halves: wp.array | None = None  # likewise the low bits of `flux`, see `tally.add_to_halves`


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
    check.kind("model", model, Model)
    size = check.integer("bins of the tally", model.tally_size, 0) if histogram else 1
    if tally is None:
        tally = zeros(size, wp.int64, model.device)
    else:
        check.array("tally", tally, wp.int64, (size,), model.device, contiguous=True)
    derivatives = check.integer("derivatives", derivatives, 0, MOST_DERIVATIVES + MOST_BLOCK_DERIVATIVES)
    signed = check.integer("bins of data.gradients", size * derivatives, 0)
    return Data(
        tally=tally,
        ledger=wp.zeros(ledger.LEDGER_SLOTS * ledger.LEDGER_WIDTH, dtype=wp.int64, device=model.device),
        records=make_records(record_count, device=model.device, derivatives=derivatives),
        cursor=wp.zeros(1, dtype=int, device=model.device),
        offset=wp.zeros(1, dtype=wp.uint64, device=model.device),
        reflecting=any((*model.limits.boundary.low, *model.limits.boundary.high)),
        has_sea=model.has_sea,
        gradients=zeros(signed, wp.int64, model.device) if histogram and derivatives else None,
        flux=zeros(model.flux.size, wp.int64, model.device) if model.flux.size else None,
    )


# ---- What a launch checks before it: a kernel trusts what it is given.


# Fields of a part of the model, by its path, and what each must be, see `check.fields`.
Needs = Iterator[tuple[str, Mapping[str, Need]]]

# What each laser profile reads.
_BEAM = ({"spread": "[0, 2]"}, {"tan2": "[0, inf)"}, {"radius": "[0, inf)"})


def check_launch(spec: TransportSpec, model: Model, data: Data, photon_count: int) -> None:
    """Everything that the kernel of a spec reads and writes: numbers in range, arrays long enough and on the device."""
    check_spec(spec)
    for needs in (_surface_needs, _water_needs, _light_needs, _limit_needs, _rider_needs):
        for path, fields in needs(spec, model):
            check.fields(f"model.{path}", attrgetter(path)(model), fields, model.device)
    _check_data(spec, model, data, photon_count)


def _water_needs(spec: TransportSpec, model: Model) -> Needs:
    layers, grid = model.layers, model.layers.grid
    yield "medium", {"extinction": "[0, inf)", "albedo": "[0, 1]", "anisotropy": "(-1, 1)", "axis_threshold": "(0, 1]"}
    if (mixed := spec.phase.constituents) or spec.phase.name == TABULATED.name:
        yield "medium.phase", dict.fromkeys(("cells", "guide"), (3 + mixed, TABLE_CELLS))
    if spec.layered:
        yield "layers", {"start": (None,), "axis": "unit"}
        check.integer("number of model.layers", layers.start.size, 1)
        yield "layers", dict.fromkeys(("extinction", "albedo", "anisotropy"), layers.start.shape)
        if mixed:
            yield "layers", {"shares": layers.start.shape}
    if spec.grid is not None:
        yield "layers.grid", dict.fromkeys(("size", "block_size", "block_edge"), "[1, inf)")
        cells, blocks, edge = math.prod(grid.size), math.prod(grid.block_size), grid.block_edge
        if [*grid.block_size] != [-(-count // edge) for count in grid.size]:
            raise ArgumentError(f"model.layers.grid: {[*grid.block_size]} blocks of {edge} cells; see make_grid")
        yield "layers.grid", dict.fromkeys(("extinction", "albedo", "residual"), (cells,))
        yield "layers.grid", dict.fromkeys(("block_majorant", "block_control"), (blocks,))
        yield "layers.grid", {"anisotropy": (None,)}
        if grid.anisotropy.size:
            yield "layers.grid", {"anisotropy": (cells,)}
        if mixed:
            yield "layers.grid", {"shares": (cells,)}


def _light_needs(spec: TransportSpec, model: Model) -> Needs:
    laser, camera, estimator = model.laser, model.camera, make_estimator(spec)
    yield "laser", {"position": "(-inf, inf)"}
    if spec.measured_beam:
        yield "laser", {"rows": (None,), "extent": "(0, inf)"}
        check.integer("rows of the laser's profile", laser.rows.size, 1)
        yield "laser", {"columns": (laser.rows.size, None)}
        check.integer("columns of the laser's profile", laser.columns.shape[1], 1)
    else:
        yield "laser", _BEAM[check.integer("model.laser.profile", laser.profile, 0, len(LASER_PROFILES) - 1)]
    if spec.laser_port is not None:
        check_port("model.laser.port", laser.port, spec.laser_port)
    if (spec.sea is not None) != model.has_sea:
        raise ArgumentError(
            f"spec.sea = {spec.sea and spec.sea.name} does not go with model.sea.index = {float(model.sea.index):g}"
        )
    if spec.sea:
        yield "sea", {"normal": "unit", "along": "unit", "spread_along": "unit", "index": "(1, 4]", "delay": "(0, 4]"}
        yield "sea", {"height": "(-inf, inf)", "slope": "[0, 1]", "spread": "[0, 1]", "extinction": "[0, inf)"}
        if spec.waves:
            yield "sea.waves", {"heights": (None, None), "cell": "(0, inf)", "low": "(-inf, inf)"}
            yield "sea.waves", dict.fromkeys(("normal", "columns", "rows"), "unit")
            yield "sea", {"slope": "(0, 1]"}
        if model.medium.axis_threshold < 1.0:
            raise ArgumentError(f"model.medium.axis_threshold = {model.medium.axis_threshold}; spec.sea needs 1")
    if spec.confocal:
        most = camera.width * camera.height if estimator.scores else 2**31 - 1
        count = check.integer("model.scan.count", model.scan.count, 1, most)
        arrays = ("pose",) if spec.lens.name == SCANNED.name else ("axis", "view")
        yield "scan", dict.fromkeys(arrays, (None,))
        for name in arrays:
            check.integer(f"entries of model.scan.{name}", getattr(model.scan, name).size, count)
    else:
        yield "laser", {"axis": "unit"}
    if estimator.scores:
        check_camera("model.camera", camera, calibrated=spec.lens.name != PLAIN.name)
        yield "gate", {"bins": "[1, inf)", "start": "(-inf, inf)", "bins_per_metre": "(0, inf)"}
        yield "gate", {"stop": f"({float(model.gate.start)}, inf)"}
        if (port := FLAT_PORT if spec.sea else spec.port) is not None:
            check_port("model.camera.port", camera.port, port)
    if estimator.cross is not None:
        yield "camera", {"aperture_radius": "(0, inf)"}
    if estimator.direct is not None:
        yield "guiding", dict.fromkeys(("probability", "surface_probability", "return_probability"), "[0, 1)")
        yield "guiding", dict.fromkeys(("anisotropy", "return_anisotropy"), "(-1, 1)")


def _limit_needs(spec: TransportSpec, model: Model) -> Needs:
    yield "limits", {"max_path": "(0, inf)", "weight_cutoff": "[0, 1)", "max_collisions": "[0, inf)"}
    if spec.bounded:
        yield "limits", {"lateral": "(0, inf)", "lower": "(-inf, inf)", "upper": "(-inf, inf)"}
        for axis, (low, high) in enumerate(zip(model.limits.lower, model.limits.upper, strict=True)):
            check.number(f"model.limits.upper[{axis}]", high, f"({float(low)}, inf)")
    if spec.reflecting:
        yield "limits.boundary", {"low": "[0, 1e9]", "high": "[0, 1e9]", "max_reflections": "[0, inf)"}
        yield "limits.boundary", {"images": (None,)}
    if spec.rotated_domain:
        yield "limits", {"origin": "(-inf, inf)", "rotation": "unit"}


def _surface_needs(spec: TransportSpec, model: Model) -> Needs:
    if not spec.mesh:
        return
    surfaces = model.surfaces
    yield "surfaces", {"reflectance": (None,), "nodes": (None,), "near_depth": (None, None)}
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
    check_faces("model.surfaces", surfaces, faces, model.device)
    if spec.use_warp_bvh and (model.mesh is None or model.mesh.id != surfaces.mesh):
        raise ArgumentError(
            "spec.use_warp_bvh = True reads the mesh that the surfaces were made of, which has to be model.mesh: the "
            "model keeps it"
        )
    if spec.brute_force and model.device.is_cuda:
        check_patches("model.surfaces", surfaces, faces, model.device)
    if spec.pattern:
        yield "surfaces", {"corner_reflectance": (faces,)}
        yield "surfaces.textures", {"face": (None,)}
        if surfaces.textures.face.size:
            yield "surfaces.textures", {"face": (faces,), "coordinates": (faces, 3)}
    if spec.specular:
        yield "surfaces", {"specular": (faces,), "roughness": (faces,)}


def _rider_needs(spec: TransportSpec, model: Model) -> Needs:
    derivatives, faces = model.derivatives, (model.surfaces.reflectance.size,) if spec.mesh else ()
    for p, kind in enumerate(spec.derivatives):
        check.number(f"model.derivatives.value[{p}]", derivatives.value[p], DERIVATIVES[kind])
        last = max(spec.phase.constituents - 1, 0)
        check.integer(f"model.derivatives.constituent[{p}]", derivatives.constituent[p], 0, last)
    for p in range(spec.signed):
        check.number(f"model.derivatives.scale[{p}]", derivatives.scale[p], "(0, inf)")
    if spec.blocks:
        blocks = derivatives.blocks
        for edge, (count, cells) in enumerate(zip(blocks.grid.size, model.layers.grid.size, strict=True)):
            check.integer(f"model.derivatives.blocks.grid.size[{edge}]", count, 1, cells)
        count = check.integer("model.derivatives.blocks.count", blocks.count, 1, MOST_BLOCK_DERIVATIVES)
        if count != math.prod(blocks.grid.size):
            raise ArgumentError(f"model.derivatives.blocks.count = {count}; see make_blocks")
        for q in range(len(spec.blocks)):
            check.number(f"model.derivatives.blocks.scale[{q}]", blocks.scale[q], "(0, inf)")
    if spec.derivatives and spec.layered:
        yield "derivatives", {"waters": (model.layers.start.size,)}
    if "reflectance" in spec.derivatives:
        yield "derivatives", {"faces": faces}
    if (spec.polarised or spec.flux) and model.medium.axis_threshold < 1.0:
        raise ArgumentError(
            f"model.medium.axis_threshold = {model.medium.axis_threshold}; spec.polarised and spec.flux need 1, "
            "without the near-axis rule, which has no plane of scattering and is not exact"
        )
    for kind, name in zip(
        FLUX_KINDS if spec.flux or model.flux.size else (), ("tracks", "collisions", "planes"), strict=False
    ):
        sections = getattr(model.flux, name)
        if (kind in spec.flux) != bool(sections.shape and sections.shape[0]):
            raise ArgumentError(f"spec.flux = {spec.flux!r} is not the kinds of the sections of model.flux")
    if spec.polarised:
        yield "polarisation", {"first": (MATRIX_POINTS,), "last": (MATRIX_POINTS,)}
        if spec.specular and spec.mesh:
            yield "polarisation", {"facet_index": faces}


def _check_data(spec: TransportSpec, model: Model, data: Data, photon_count: int) -> None:
    device, scores = model.device, make_estimator(spec).scores

    def fits(name: str, dtype: type, size: int | None) -> None:
        check.array(f"data.{name}", getattr(data, name), dtype, (size,), device, contiguous=True)

    bins = 2 * model.tally_size // len(COMPONENTS) if spec.merged else model.tally_size
    fits("tally", wp.int64, check.integer("bins of the tally", bins, 1) if scores else None)
    signed = spec.signed + len(spec.blocks) * model.derivatives.blocks.count if scores else 0
    if signed or data.gradients is not None:
        fits("gradients", wp.int64, check.integer("bins of data.gradients", bins * signed, 1) if signed else None)
    if spec.flux or data.flux is not None:
        fits("flux", wp.int64, check.integer("model.flux.size", model.flux.size, 1) if spec.flux else None)
    if data.split_accumulators is not None:
        fits("split_accumulators", wp.uint32, data.tally.size)
    fits("ledger", wp.int64, ledger.LEDGER_SLOTS * ledger.LEDGER_WIDTH)
    fits("cursor", wp.int32, 1)
    if spec.stepped or data.offset is not None:
        fits("offset", wp.uint64, 1)
    check.kind("data.records", data.records, Records)
    if spec.records:
        shapes: dict[str, Need] = dict.fromkeys(Records.vars, (None,))
        shapes["log_derivatives"] = (None, len(spec.derivatives))
        for name in shapes if spec.derivatives else [*shapes][:-1]:
            check.fields("data.records", data.records, {name: shapes[name]}, device)
            room = getattr(data.records, name).shape[0]
            if room < photon_count:
                raise ArgumentError(
                    f"data.records.{name} has room for {room} photons; spec.records = True needs {photon_count}, see "
                    "record_count of make_data"
                )


# ---- The launch.


# Threads of a CUDA launch: enough to fill any GPU, few enough that flushing their counts costs nothing.
CUDA_THREADS = 1 << 19

# In one launch.
_MOST_PHOTONS = 1 << 26

# Additions of a photon to a volume of flux, about.
_FLUX_ADDITIONS = 64


def load_transport_kernel(spec: TransportSpec, device: wp.DeviceLike = None) -> None:
    """Compiles the kernel of a spec for a device, or loads it from Warp's cache, ahead of the first launch."""
    check_spec(spec)
    device = check.device("device", device)
    make_transport_kernel(spec, device.is_cuda).module.load(device, BLOCK_SIZE if device.is_cuda else 1)
    # Loaded here and not by a worker: each thread that compiles makes Warp prepare its headers anew, 1.5 s on a CPU.
    wp.load_module(find_overflow_kernel.module, device=device)


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
    photon_count = check.integer("photon_count", photon_count, 1, _MOST_PHOTONS)
    first_id = check.integer("first_id", first_id, 0, 2**64 - photon_count)
    launch = prepare_transport(spec, model, data, seed=seed, photon_count=photon_count, threads=threads)
    launch(first_id, photon_count)


def prepare_transport(
    spec: TransportSpec, model: Model, data: Data, *, seed: int, photon_count: int, threads: int = CUDA_THREADS
) -> Callable[[int, int], None]:
    """Launches like `launch_transport`, of model and data as they are now, which are checked once.

    Returns the launch, a function of `first_id` and of a `photon_count` of at most the one here, which it does not
    check. Args and raises: as `launch_transport`.
    """
    check.kind("model", model, Model)
    check.kind("data", data, Data)
    most = check.integer("photon_count", photon_count, 1, _MOST_PHOTONS)
    seed = check.integer("seed", seed, 0, 2**64 - 1)
    blocks = check.integer("threads", threads, BLOCK_SIZE) // BLOCK_SIZE
    check_launch(spec, model, data, most)
    device, flux = model.device, model.flux.size
    pays = model.split_accumulators and make_estimator(spec).scores
    pays = pays and splitting_pays(model.tally_size // len(model.components), most)
    split_accumulators = _low_words(device, data, "split_accumulators", data.tally.size, pays)
    flux_halves = _low_words(device, data, "flux_halves", -(-flux // 2), splitting_pays(flux, _FLUX_ADDITIONS * most))
    kernel = make_transport_kernel(spec, device.is_cuda)
    sink = Sink()
    sink.tally, sink.ledger, sink.scale, sink.records = data.tally, data.ledger, model.scale, data.records
    sink.gradients, sink.low = data.gradients, split_accumulators
    sink.flux, sink.flux_halves = data.flux, flux_halves
    shared = None if spec.blocks else _make_world(spec, model, seed, 0)

    def launch(first_id: int, photon_count: int) -> None:
        threads = BLOCK_SIZE * min(-(-photon_count // BLOCK_SIZE), blocks) if device.is_cuda else 1
        if spec.blocks:
            threads = threads_of_blocks(threads, model.derivatives.blocks)
        data.cursor.zero_()
        part = Launch()
        part.first_id, part.photon_count, part.threads = first_id, photon_count, threads
        part.cursor, part.offset = data.cursor, data.offset
        world = _make_world(spec, model, seed, threads) if shared is None else shared
        wp.launch(kernel, dim=threads, inputs=[world, sink, part], device=device, block_dim=BLOCK_SIZE)
        for low, tally in ((split_accumulators, data.tally), (flux_halves, data.flux)):
            if low is not None:
                fold_accumulators(low, tally)

    return launch


def _low_words(device: wp.Device, data: Data, name: str, size: int, pays: bool) -> wp.array | None:
    """The array of that name for a launch on CUDA for which it pays, made by the first such launch; None for others."""
    if not (pays and device.is_cuda):
        return None
    if getattr(data, name) is None and not device.is_capturing:  # what is made there belongs to the graph
        setattr(data, name, wp.zeros(size, dtype=wp.uint32, device=device))
    low: wp.array | None = getattr(data, name)
    return low


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


def read_ledger(data: Data) -> tuple[dict[str, int], dict[str, int]]:
    """Ledger entries (units of LEDGER_UNIT photon) and counters summed over slots; waits for the device.

    Entries are LEDGER_ENTRIES and, behind a laser's port, what that reflects: `laser_port`. Counters are COUNTERS and,
    where faces of the domain reflect, BOUNDARY_COUNTERS; with the surface of a sea SEA_ENTRIES and SEA_COUNTERS, too.
    """
    check.kind("data", data, Data)
    check.array("data.ledger", data.ledger, wp.int64, (ledger.LEDGER_SLOTS * ledger.LEDGER_WIDTH,))
    for name in ("reflecting", "has_sea"):
        check.kind(f"data.{name}", getattr(data, name), bool)
    sums = exact_sums(data.ledger.numpy().reshape(ledger.LEDGER_WIDTH, ledger.LEDGER_SLOTS))
    values = dict(zip(ledger.ALL_ENTRIES, sums, strict=True))
    for name in ("before_gate", "after_gate"):
        values[name] <<= int(ledger.OUTSIDE_SHIFT)
    entries = (*ledger.LEDGER_ENTRIES, ledger.PORT_ENTRY) if values[ledger.PORT_ENTRY] else ledger.LEDGER_ENTRIES
    entries += ledger.SEA_ENTRIES if data.has_sea else ()
    counters = ledger.COUNTERS + ledger.BOUNDARY_COUNTERS * data.reflecting + ledger.SEA_COUNTERS * data.has_sea
    return {name: values[name] for name in entries}, {name: values[name] for name in counters}
