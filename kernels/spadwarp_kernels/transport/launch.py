"""Launching the transport kernel: what it takes (Model), what it writes (Data), and the call itself."""

from dataclasses import dataclass, field

import warp as wp

from spadwarp_kernels.base.arguments import check_array, check_device, check_integer, check_kind, check_seed
from spadwarp_kernels.base.native import zeros
from spadwarp_kernels.base.philox import round_keys
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.optics.camera import PLAIN, Camera, Gate, with_field
from spadwarp_kernels.optics.laser import Laser, Scan
from spadwarp_kernels.photon.lanes import BLOCK_SIZE
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import Records, make_records
from spadwarp_kernels.riders.polarisation import Polarisation
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.tally.blocks import MOST_BLOCK_DERIVATIVES, blocks_with_memory, threads_of_blocks
from spadwarp_kernels.tally.ledger import (
    BOUNDARY_COUNTERS,
    COUNTERS,
    LEDGER_ENTRIES,
    LEDGER_SLOTS,
    LEDGER_WIDTH,
    OUTSIDE_SHIFT,
    PORT_ENTRY,
)
from spadwarp_kernels.tally.scores import MOST_DERIVATIVES, Derivatives
from spadwarp_kernels.tally.tally import (
    COMPONENTS,
    find_overflow_kernel,
    fold_accumulators,
    fold_kernel,
    splitting_pays,
)
from spadwarp_kernels.water.limits import Limits, ready_limits
from spadwarp_kernels.water.medium import Layers, Medium, ready_medium
from spadwarp_kernels.water.phase_functions import Guiding

from .checks import check_launch, check_model, check_spec
from .kernel import make_transport_kernel

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
            enough, see `tally.split_accumulators`, and used by those after it.
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
    threads, derivatives = blocks * BLOCK_SIZE if model.device.is_cuda else 1, model.derivatives
    if spec.blocks:
        threads = threads_of_blocks(threads, derivatives.blocks)
        derivatives = _with_memory(derivatives, threads, model.device)
    data.cursor.zero_()
    camera = with_field(model.camera) if spec.lens == PLAIN else model.camera
    medium, limits = ready_medium(model.medium), ready_limits(model.limits)
    inputs = [medium, model.layers, model.laser, camera, model.gate, limits, model.guiding]
    inputs += [model.surfaces, model.scan, derivatives, model.polarisation]
    split_accumulators = _split_accumulators(spec, model, data, photon_count)
    wp.launch(
        make_transport_kernel(spec, model.device.is_cuda, split_accumulators is not None),
        dim=threads,
        inputs=[*inputs, seed, round_keys(seed), first_id, photon_count, model.scale],
        outputs=[data.tally, data.gradients, data.ledger, data.records, data.cursor, data.offset, split_accumulators],
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


def _with_memory(derivatives: Derivatives, threads: int, device: wp.Device) -> Derivatives:
    """With memory for the scores of blocks: of each launch its own, since several may run at a time."""
    found = Derivatives()
    for name in Derivatives.vars:
        setattr(found, name, getattr(derivatives, name))
    found.blocks = blocks_with_memory(derivatives.blocks, threads, device)
    return found


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
