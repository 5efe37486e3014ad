"""What a transport kernel is compiled for."""

from collections.abc import Iterable
from typing import Any, NamedTuple, get_origin

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.optics.camera import PLAIN, SCANNED, Lens
from spadwarp_kernels.optics.laser import Beam, make_beam
from spadwarp_kernels.optics.polarisation import MOST_CHANNELS
from spadwarp_kernels.optics.port import PortKind
from spadwarp_kernels.optics.sea import WAVES, SeaKind
from spadwarp_kernels.optics.visibility import Sight, make_sight
from spadwarp_kernels.surface.ray_cast import Faces, make_faces
from spadwarp_kernels.tally.flux import FLUX_KINDS
from spadwarp_kernels.water.limits import Domain, make_domain
from spadwarp_kernels.water.medium import HOMOGENEOUS, LAYERED, MOST_LINES, Water
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN, PhaseFunction

from .derivatives import BLOCK_DERIVATIVES, DERIVATIVES, MOST_DERIVATIVES
from .state import merged_index, tally_index

__all__ = ["TransportSpec"]

MOST_POINTS = 3

_WORDS = {
    bool: "True or False",
    PortKind | None: "a PortKind or None",
    SeaKind | None: "FACETS, WAVES or None",
    Water | None: "REGULAR_TRACKING, DELTA_TRACKING or None",
}

# Fields that cannot be combined, and those that need another.
_EXCLUDED = {
    "sea": ("port", "laser_port", "reflecting", "grid", "merged"),
    "lines": ("polarised", "derivatives", "grid", "random_albedo"),
    "grid": ("layered", "random_albedo"),
    "merged": ("reflecting", "derivatives", "channels"),
    "blocks": ("reflecting", "merged"),
    "derivatives": ("random_albedo",),  # which has no scattering coefficient
    "polarised": ("derivatives", "blocks"),
    "flux": ("polarised", "random_albedo"),
    "sun": ("measured_beam", "confocal", "polarised"),
}
_NEEDED = {"reflecting": "bounded", "blocks": "grid", "sun": "sea"}


class TransportSpec(NamedTuple):
    """Compile-time choices: the key of the kernel cache."""

    estimator: str = "next_event"  # one of ESTIMATORS; "none" transports without a camera
    phase: PhaseFunction = HENYEY_GREENSTEIN  # phase function of the water
    random_albedo: bool = False  # draw the albedo uniformly from [0, medium.albedo] at each collision
    mesh: bool = True  # trace rays against a mesh
    brute_force: bool = False
    """On CUDA, try every face rather than walk the tree; for meshes of up to BRUTE_FORCE_FACES faces."""
    bounded: bool = False  # honour the domain and the lateral limit
    roulette: bool = False  # russian roulette instead of the weight cut-off
    records: bool = False  # write the terminal state of each photon
    layered: bool = False  # the water is that of the layers, not that of the medium
    pattern: bool = False  # the reflectance varies within faces: corners and textures
    specular: bool = False  # faces have a rough specular lobe beside the Lambertian one
    lens: Lens = PLAIN  # how the camera images
    measured_beam: bool = False  # emit from the laser's measured profile
    confocal: bool = False
    """Beam and pixel scan together: each photon has a beam axis and a pixel of its own. Needs CALIBRATED, or SCANNED:
    then each has a pose of laser and camera of its own."""
    rotated_domain: bool = False  # the domain has axes of its own
    reflecting: bool = False  # faces of the domain reflect, as `Limits.boundary` says; needs `bounded`
    use_warp_bvh: bool = False  # rays take `wp.mesh_query_ray`, see `make_surfaces`
    stepped: bool = False
    """Photons are numbered from `data.offset[0]` on, which is on the device: a captured launch can draw new ones."""
    merged: bool = False
    """The tally is [2, pixel, bin], of light that has met a surface, and of backscatter. The ledger's counts of what is
    below one unit do not tell components then."""
    port: PortKind | None = None
    """What the camera looks through, FLAT_PORT or DOME_PORT, as `Camera.port` describes it; None: it is in the
    water."""
    laser_port: PortKind | None = None  # the same of the laser and `Laser.port`
    sea: SeaKind | None = None
    """FACETS or WAVES: the surface `Model.sea` parts air from water. `Camera.port` is then its mean plane as the lens
    sees it, in the frame of the water and without a window, and there are no other ports. The tally has one more
    component, of light that met the surface alone."""
    grid: Water | None = None
    """The water in a box is that of the cells of `Layers.grid`, tracked by REGULAR_TRACKING or DELTA_TRACKING; None:
    there is no grid."""
    derivatives: tuple[str, ...] = ()
    """Kinds of the parameters by which the histogram is differentiated, each one of DERIVATIVES and described in
    `Model.derivatives`; at most MOST_DERIVATIVES."""
    blocks: tuple[str, ...] = ()
    """Kinds of the coefficients of a grid's cells by which it is differentiated block by block, each one of
    BLOCK_DERIVATIVES; the blocks are those of `Derivatives.blocks`."""
    polarised: bool = False
    """Photons carry a Stokes vector, and scores are of the light that it stands for, see `Model.polarisation`."""
    lines: bool = False
    """Photons carry light of other wavelengths, see `Model.lines`, of which each of `channels` is one; not in cells."""
    points: int = 1
    """At how many points of a flight `guided` scores it, 1 to MOST_POINTS (1 if it leads aside); more than one without
    `reflecting`, `blocks` and DELTA_TRACKING, three with up to 4 derivatives."""
    flux: tuple[str, ...] = ()
    """Kinds of the sections of `Model.flux`, each one of FLUX_KINDS; for estimators that neither guide light nor let
    it fly on after its last event, and without `polarised`."""
    sun: bool = False
    """The light is that of sun and sky, see `make_sun`, through the surface of a sea."""
    channels: int = 0
    """What the receiver takes of polarised light beside its intensity, at most MOST_CHANNELS, or lines at other
    wavelengths, at most MOST_LINES, each with a tally of its own."""

    @property
    def signed(self) -> int:
        """Tallies of a voxel that have signs, beside the histogram's: of derivatives or of channels."""
        return len(self.derivatives) + self.channels

    @property
    def waves(self) -> bool:
        """Whether the surface of the sea has resolved waves."""
        return self.sea is not None and self.sea.name == WAVES.name

    @property
    def on_cpu(self) -> "TransportSpec":
        """What of it makes a difference on a CPU, where a core walks the tree."""
        return self._replace(brute_force=False)

    # ---- What transport asks of the packages below, each made for the choices that it owns.

    @property
    def water(self) -> Water:
        """Of the water, with the phase function."""
        return (self.grid or (LAYERED if self.layered else HOMOGENEOUS))._replace(phase=self.phase)

    @property
    def domain(self) -> Domain:
        """Of the limits."""
        return make_domain(self.bounded, self.rotated_domain, self.reflecting)

    @property
    def faces(self) -> Faces:
        """Of the mesh."""
        tried = self.mesh and self.brute_force and not self.use_warp_bvh
        return make_faces(self.mesh, tried, self.pattern, self.specular)

    @property
    def sight(self) -> Sight:
        """Of the camera."""
        return make_sight(self.lens, self.port, self.confocal, self.sea)

    @property
    def beam(self) -> Beam:
        """Of the laser."""
        moves = self.lens.name == SCANNED.name
        return make_beam(self.measured_beam, self.laser_port, self.confocal, moves, self.sun)

    @property
    def tally_index(self) -> wp.Function:
        """Where the tally has a contribution, see the function of that name."""
        return merged_index if self.merged else tally_index

    @property
    def varies(self) -> bool:
        """Whether the water differs from place to place."""
        return self.layered or self.grid is not None

    @property
    def local_albedo(self) -> bool:
        """Whether the albedo at an event is that of the water there."""
        return self.varies and not self.random_albedo

    @property
    def chooses_meetings(self) -> bool:
        """Whether `guided` chooses the chance with which a flight meets a surface: in water without cells."""
        return self.mesh and self.water.profile is None and not self.reflecting

    @property
    def scores_collisions(self) -> bool:
        """Whether `guided` scores half the points of flights where the photon collides: where that is by chance."""
        return self.water.profile is not None and self.water.profile.draw is None


def check_spec(spec: Any) -> None:
    """A `TransportSpec` whose choices exist and can be combined; raises `ArgumentError`."""
    if not isinstance(spec, TransportSpec):
        raise ArgumentError(f"spec = {spec!r} is not a TransportSpec")
    for name, kind in TransportSpec.__annotations__.items():
        value, kind = getattr(spec, name), tuple if get_origin(kind) is tuple else kind
        if kind not in (str, int) and not isinstance(value, kind):  # those are checked by value
            raise ArgumentError(f"spec.{name} = {value!r} is not {_WORDS.get(kind) or f'a {kind.__name__}'}")
    choices: dict[str, tuple[Iterable[str], int]] = {
        "derivatives": (DERIVATIVES, MOST_DERIVATIVES),
        "blocks": (BLOCK_DERIVATIVES, len(BLOCK_DERIVATIVES)),
        "flux": (FLUX_KINDS, len(FLUX_KINDS)),
    }
    for name, (allowed, most) in choices.items():
        check.integer(f"length of spec.{name}", len(getattr(spec, name)), 0, most)
        for index, kind in enumerate(getattr(spec, name)):
            check.choice(f"spec.{name}[{index}]", kind, allowed)
    # A block has 48 KiB of shared memory for queues.
    check.integer("spec.points", spec.points, 1, 2 if len(spec.derivatives) > 4 else MOST_POINTS)
    check.integer("spec.channels", spec.channels, 0, MOST_CHANNELS * spec.polarised + MOST_LINES * spec.lines)
    for one, others in _EXCLUDED.items():
        if getattr(spec, one) and any(getattr(spec, other) for other in others):
            raise ArgumentError(f"spec.{one} cannot be combined with spec." + ", spec.".join(others))
    for one, other in _NEEDED.items():
        if getattr(spec, one) and not getattr(spec, other):
            raise ArgumentError(f"spec.{one} needs spec.{other}")
    scanned, guided = spec.lens.name == SCANNED.name, spec.estimator == "guided"
    for wrong, text in (
        (spec.confocal and spec.lens.name == PLAIN.name, "confocal = True needs spec.lens = CALIBRATED"),
        (spec.sea and spec.confocal and not scanned, "sea: a scan needs spec.lens = SCANNED"),
        (
            scanned and (not spec.confocal or spec.polarised or spec.reflecting),
            "lens = SCANNED needs spec.confocal = True, and cannot be combined with spec.polarised and spec.reflecting",
        ),
        (spec.merged and not (guided or spec.estimator == "next_event"), "merged needs guided or next_event"),
        (len(set(spec.blocks)) < len(spec.blocks), f"blocks = {spec.blocks!r} names one twice"),
        (
            spec.grid and {*spec.derivatives} - {"reflectance"},
            "derivatives: with spec.grid, whose water has no one value, they are of reflectance",
        ),
        (
            "anisotropy" in spec.derivatives and spec.phase.name != HENYEY_GREENSTEIN.name,
            "derivatives: anisotropy needs spec.phase = HENYEY_GREENSTEIN",
        ),
        ("reflectance" in spec.derivatives and not spec.mesh, "derivatives: reflectance needs spec.mesh = True"),
        (
            spec.points > 1 and (not guided or spec.reflecting or spec.blocks or spec.scores_collisions),
            f"points = {spec.points}: more than 1 needs spec.estimator = 'guided', and cannot be combined with "
            "spec.reflecting, spec.blocks and DELTA_TRACKING",
        ),
        (spec.flux and (guided or spec.estimator == "analog"), "flux cannot be combined with analog and guided"),
    ):
        if wrong:
            raise ArgumentError(f"spec.{text}")
