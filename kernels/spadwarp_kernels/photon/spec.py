"""What a transport kernel is compiled for."""

from typing import NamedTuple

from spadwarp_kernels.optics.camera import PLAIN, Lens
from spadwarp_kernels.optics.port import PortKind
from spadwarp_kernels.water.medium import HOMOGENEOUS, LAYERED, Water
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN, PhaseFunction

__all__ = ["TransportSpec"]

MOST_POINTS = 3


class TransportSpec(NamedTuple):
    """Compile-time choices: the key of the kernel cache.

    Attributes:
        estimator: One of ESTIMATORS; "none" transports without a camera.
        phase: Phase function of the water.
        random_albedo: Draw the albedo uniformly from [0, medium.albedo] at each collision.
        mesh: Trace rays against a mesh.
        brute_force: On CUDA, try every face rather than walk the tree; for meshes of up to BRUTE_FORCE_FACES faces.
        bounded: Honour the domain and the lateral limit.
        roulette: Russian roulette instead of the weight cut-off.
        records: Write the terminal state of each photon.
        layered: The water is that of the layers, not that of the medium.
        pattern: The reflectance varies within faces: corners and textures.
        specular: Faces have a rough specular lobe beside the Lambertian one.
        lens: How the camera images.
        measured_beam: Emit from the laser's measured profile.
        confocal: Beam and pixel scan together: each photon has a beam axis and a pixel of its own. Needs CALIBRATED.
        rotated_domain: The domain has axes of its own.
        reflecting: Faces of the domain reflect, as `Limits.boundary` says; needs `bounded`.
        use_warp_bvh: Rays take `wp.mesh_query_ray`, see `make_surfaces`.
        stepped: Photons are numbered from `data.offset[0]` on, which is on the device: a captured launch can draw new
            ones.
        merged: The tally is [pixel, bin], for the light of all components together. The ledger's counts of what is
            below one unit do not tell components then.
        port: What the camera looks through, FLAT_PORT or DOME_PORT, as `Camera.port` describes it; None: it is in the
            water.
        laser_port: The same of the laser and `Laser.port`.
        grid: The water in a box is that of the cells of `Layers.grid`, tracked by REGULAR_TRACKING or DELTA_TRACKING;
            None: there is no grid.
        derivatives: Kinds of the parameters by which the histogram is differentiated, each one of DERIVATIVES and
            described in `Model.derivatives`; at most MOST_DERIVATIVES.
        blocks: Kinds of the coefficients of a grid's cells by which it is differentiated block by block, each one of
            BLOCK_DERIVATIVES; the blocks are those of `Derivatives.blocks`.
        polarised: Photons carry a Stokes vector, and scores are of the light that it stands for, see
            `Model.polarisation`.
        points: At how many points of a flight `guided` scores it, 1 to MOST_POINTS; more than one without `reflecting`,
            `blocks` and DELTA_TRACKING, three with up to 4 derivatives.
        channels: What the receiver takes of polarised light beside its intensity, at most MOST_CHANNELS, each with a
            tally of its own.
    """

    estimator: str = "next_event"
    phase: PhaseFunction = HENYEY_GREENSTEIN
    random_albedo: bool = False
    mesh: bool = True
    brute_force: bool = False
    bounded: bool = False
    roulette: bool = False
    records: bool = False
    layered: bool = False
    pattern: bool = False
    specular: bool = False
    lens: Lens = PLAIN
    measured_beam: bool = False
    confocal: bool = False
    rotated_domain: bool = False
    reflecting: bool = False
    use_warp_bvh: bool = False
    stepped: bool = False
    merged: bool = False
    port: PortKind | None = None
    laser_port: PortKind | None = None
    grid: Water | None = None
    derivatives: tuple[str, ...] = ()
    blocks: tuple[str, ...] = ()
    polarised: bool = False
    points: int = 1
    channels: int = 0

    @property
    def signed(self) -> int:
        """Tallies of a voxel that have signs, beside the histogram's: of derivatives or of channels."""
        return len(self.derivatives) + self.channels

    @property
    def water(self) -> Water:
        """What transport asks of the water."""
        return self.grid or (LAYERED if self.layered else HOMOGENEOUS)

    @property
    def varies(self) -> bool:
        """Whether the water differs from place to place."""
        return self.layered or self.grid is not None
