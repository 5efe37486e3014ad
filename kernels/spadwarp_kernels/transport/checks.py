"""What `launch_transport` checks before it launches: a kernel trusts what it is given."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_choice,
    check_device,
    check_fields,
    check_integer,
    check_number,
    check_struct,
    check_vector,
)
from spadwarp_kernels.base.tables import TABLE_CELLS
from spadwarp_kernels.estimators.contribution import takes_collisions
from spadwarp_kernels.estimators.estimator import Estimator
from spadwarp_kernels.estimators.registry import ESTIMATORS, make_estimator
from spadwarp_kernels.optics.camera import PLAIN, Camera, Gate, Lens, check_camera
from spadwarp_kernels.optics.laser import LASER_PROFILES, Laser, Scan
from spadwarp_kernels.optics.port import PortKind, check_port
from spadwarp_kernels.photon.spec import MOST_POINTS, TransportSpec
from spadwarp_kernels.photon.state import Records
from spadwarp_kernels.riders.polarisation import MATRIX_POINTS, MOST_CHANNELS, Polarisation
from spadwarp_kernels.surface.mesh import Surfaces, check_faces, check_patches, surface_choices
from spadwarp_kernels.surface.patches import BRUTE_FORCE_FACES
from spadwarp_kernels.tally.blocks import BLOCK_DERIVATIVES, MOST_BLOCK_DERIVATIVES
from spadwarp_kernels.tally.ledger import LEDGER_SLOTS, LEDGER_WIDTH
from spadwarp_kernels.tally.scores import DERIVATIVES, MOST_DERIVATIVES, Derivatives
from spadwarp_kernels.tally.tally import COMPONENTS
from spadwarp_kernels.water.grid import Grid
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Medium, Water
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN, TABULATED, Guiding, PhaseFunction

if TYPE_CHECKING:
    from .launch import Data, Model

_CHOICES = tuple(name for name, kind in TransportSpec.__annotations__.items() if kind is bool)
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


def check_spec(spec: Any) -> None:
    """A `TransportSpec` of an estimator that exists, with a phase function and a lens that go with it."""
    if not isinstance(spec, TransportSpec):
        raise ArgumentError(f"spec = {spec!r} is not a TransportSpec")
    check_choice("estimator", spec.estimator, ESTIMATORS)
    for name, kind in (("phase", PhaseFunction), ("lens", Lens)):
        if not isinstance(getattr(spec, name), kind):
            raise ArgumentError(f"spec.{name} = {getattr(spec, name)!r} is not a {kind.__name__}")
    for name in ("port", "laser_port"):
        if not isinstance(getattr(spec, name), PortKind | None):
            raise ArgumentError(f"spec.{name} = {getattr(spec, name)!r} is not a PortKind or None")
    if not isinstance(spec.grid, Water | None):
        raise ArgumentError(f"spec.grid = {spec.grid!r} is not REGULAR_TRACKING, DELTA_TRACKING or None")
    if spec.grid is not None and (spec.layered or spec.random_albedo):
        raise ArgumentError("spec.grid goes without spec.layered and spec.random_albedo")
    for name in _CHOICES:
        if not isinstance(getattr(spec, name), bool):
            raise ArgumentError(f"spec.{name} = {getattr(spec, name)!r} is not True or False")
    if spec.confocal and spec.lens.name == PLAIN.name:
        raise ArgumentError("spec.confocal = True needs spec.lens = CALIBRATED")
    if spec.reflecting and not spec.bounded:
        raise ArgumentError("spec.reflecting = True needs spec.bounded = True")
    if spec.merged and (spec.estimator not in ("guided", "next_event") or spec.reflecting or spec.signed):
        raise ArgumentError(
            "spec.merged goes with guided and next_event, without spec.reflecting, spec.derivatives and spec.channels"
        )
    _check_kinds(spec)
    # A block has 48 KiB of shared memory for queues.
    check_integer("spec.points", spec.points, 1, 2 if len(spec.derivatives) > 4 else MOST_POINTS)
    if spec.points > 1 and (spec.estimator != "guided" or spec.reflecting or spec.blocks or takes_collisions(spec)):
        raise ArgumentError(
            f"spec.points = {spec.points}: more than 1 goes with spec.estimator = 'guided', without spec.reflecting, "
            "spec.blocks and DELTA_TRACKING"
        )
    check_integer("spec.channels", spec.channels, 0, MOST_CHANNELS if spec.polarised else 0)
    if spec.polarised and (spec.derivatives or spec.blocks):
        raise ArgumentError("spec.polarised goes without spec.derivatives and spec.blocks")


def _check_kinds(spec: TransportSpec) -> None:
    """Of the derivatives, which exist for the spec's water and surfaces."""
    if not isinstance(spec.derivatives, tuple) or len(spec.derivatives) > MOST_DERIVATIVES:
        raise ArgumentError(
            f"spec.derivatives = {spec.derivatives!r} is not a tuple of at most {MOST_DERIVATIVES} names"
        )
    for p, kind in enumerate(spec.derivatives):
        check_choice(f"spec.derivatives[{p}]", kind, DERIVATIVES)
    if not isinstance(spec.blocks, tuple) or len(set(spec.blocks)) < len(spec.blocks):
        raise ArgumentError(f"spec.blocks = {spec.blocks!r} is not a tuple of different names")
    for q, kind in enumerate(spec.blocks):
        check_choice(f"spec.blocks[{q}]", kind, BLOCK_DERIVATIVES)
    if spec.blocks and (spec.grid is None or spec.reflecting or spec.merged):
        raise ArgumentError("spec.blocks need spec.grid, and go without spec.reflecting and spec.merged")
    if spec.derivatives and spec.random_albedo:
        raise ArgumentError("spec.derivatives go without spec.random_albedo, which has no scattering coefficient")
    if spec.grid is not None and {*spec.derivatives} - {"reflectance"}:
        raise ArgumentError("spec.derivatives: with spec.grid, whose water has no one value, they are of reflectance")
    if "anisotropy" in spec.derivatives and spec.phase.name != HENYEY_GREENSTEIN.name:
        raise ArgumentError("spec.derivatives: anisotropy needs spec.phase = HENYEY_GREENSTEIN")
    if "reflectance" in spec.derivatives and not spec.mesh:
        raise ArgumentError("spec.derivatives: reflectance needs spec.mesh = True")


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
        for name, kind in (("cells", wp.vec4), ("guide", wp.int32)):
            check_array(f"model.medium.phase.{name}", getattr(medium.phase, name), kind, (3, TABLE_CELLS), device)
    if spec.layered:
        layers = model.layers
        start = check_array("model.layers.start", layers.start, wp.float32, (None,), device)
        check_integer("number of model.layers", start.size, 1)
        check_vector("model.layers.axis", layers.axis, unit=True)
        for name in ("extinction", "albedo", "anisotropy"):
            check_array(f"model.layers.{name}", getattr(layers, name), wp.float32, start.shape, device)
    if spec.grid is not None:
        _check_grid(model.layers.grid, device)


def _check_grid(grid: Grid, device: wp.Device) -> None:
    sizes = {"size": list(grid.size), "block_size": list(grid.block_size)}
    for name, size in sizes.items():
        for count in size:
            check_integer(f"model.layers.grid.{name}", count, 1)
    cells, blocks = (math.prod(size) for size in sizes.values())
    for name in ("extinction", "albedo", "residual"):
        check_array(f"model.layers.grid.{name}", getattr(grid, name), wp.float32, (cells,), device)
    anisotropy = check_array("model.layers.grid.anisotropy", grid.anisotropy, wp.float32, (None,), device)
    if anisotropy.size:
        check_array("model.layers.grid.anisotropy", anisotropy, wp.float32, (cells,), device)
    edge = check_integer("model.layers.grid.block_edge", grid.block_edge, 1)
    if sizes["block_size"] != [-(-count // edge) for count in sizes["size"]]:
        raise ArgumentError(f"model.layers.grid: {sizes['block_size']} blocks of {edge} cells; see make_grid")
    for name, kind in (("block_majorant", wp.float32), ("block_control", wp.vec2)):
        check_array(f"model.layers.grid.{name}", getattr(grid, name), kind, (blocks,), device)


def _check_laser(spec: TransportSpec, model: Model) -> None:
    laser, device = model.laser, model.device
    check_vector("model.laser.position", laser.position)
    if not spec.confocal:
        check_vector("model.laser.axis", laser.axis, unit=True)
    if spec.measured_beam:
        rows = check_array("model.laser.rows", laser.rows, wp.float32, (None,), device)
        check_integer("rows of the laser's profile", rows.size, 1)
        columns = check_array("model.laser.columns", laser.columns, wp.float32, (rows.size, None), device)
        check_integer("columns of the laser's profile", columns.shape[1], 1)
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
        check_array("model.limits.boundary.images", boundary.images, wp.vec3i, (None,), model.device)
    if spec.rotated_domain:
        check_vector("model.limits.origin", limits.origin)
        rows = [[limits.rotation[i, j] for j in range(3)] for i in range(3)]
        for row in rows:
            check_vector("model.limits.rotation, a row", row, unit=True)


def _check_surfaces(spec: TransportSpec, model: Model) -> None:
    surfaces, device = model.surfaces, model.device
    faces = check_array("model.surfaces.reflectance", surfaces.reflectance, wp.float32, (None,), device).size
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
    check_array("model.surfaces.nodes", surfaces.nodes, wp.vec4, (None,), device)
    check_array("model.surfaces.near_depth", surfaces.near_depth, wp.float32, (None, None), device)
    if spec.pattern:
        check_array("model.surfaces.corner_reflectance", surfaces.corner_reflectance, wp.vec3, (faces,), device)
        textured = check_array("model.surfaces.textures.face", surfaces.textures.face, wp.int32, (None,), device).size
        if textured:
            check_array("model.surfaces.textures.face", surfaces.textures.face, wp.int32, (faces,), device)
            check_array(
                "model.surfaces.textures.coordinates", surfaces.textures.coordinates, wp.vec2, (faces, 3), device
            )
    if spec.specular:
        check_array("model.surfaces.specular", surfaces.specular, wp.float32, (faces,), device)
        check_array("model.surfaces.roughness", surfaces.roughness, wp.float32, (faces,), device)


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
        count = model.layers.start.size
        check_array("model.derivatives.waters", derivatives.waters, wp.int32, (count,), device)
    if "reflectance" in spec.derivatives:
        count = model.surfaces.reflectance.size
        check_array("model.derivatives.faces", derivatives.faces, wp.int32, (count,), device)


def _check_polarisation(spec: TransportSpec, model: Model) -> None:
    polarisation, device = model.polarisation, model.device
    if model.medium.axis_threshold < 1.0:
        raise ArgumentError(
            f"model.medium.axis_threshold = {model.medium.axis_threshold}; spec.polarised = True needs 1, without the "
            "near-axis rule, which has no plane of scattering"
        )
    points = check_array("model.polarisation.first", polarisation.first, wp.vec4, (None,), device).size
    check_integer("points of model.polarisation.first", points, MATRIX_POINTS, MATRIX_POINTS)
    check_array("model.polarisation.last", polarisation.last, wp.float32, (points,), device)
    for k in range(spec.channels):
        check_number(f"model.derivatives.scale[{k}]", model.derivatives.scale[k], "(0, inf)")
    if spec.specular:
        count = model.surfaces.reflectance.size
        check_array("model.polarisation.facet_index", polarisation.facet_index, wp.float32, (count,), device)


def _check_scan(model: Model, estimator: Estimator) -> None:
    scan, camera = model.scan, model.camera
    most = camera.width * camera.height if estimator.scores else 2**31 - 1
    count = check_integer("model.scan.count", scan.count, 1, most)
    for name, kind in (("axis", wp.vec3), ("view", wp.vec4)):
        array = check_array(f"model.scan.{name}", getattr(scan, name), kind, (None,), model.device)
        check_integer(f"entries of model.scan.{name}", array.size, count)


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
            if name == "scores" and not spec.derivatives:
                continue
            shape = (None, len(spec.derivatives)) if name == "scores" else (None,)
            array = check_array(f"data.records.{name}", getattr(data.records, name), var.type.dtype, shape, device)
            if array.shape[0] < photon_count:
                raise ArgumentError(
                    f"data.records.{name} has room for {array.shape[0]} photons; spec.records = True needs "
                    f"{photon_count}, see record_count of make_data"
                )
