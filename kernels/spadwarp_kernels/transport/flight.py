"""Stage flight: how far the photon flies before it collides."""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.medium.layers import Layers
from spadwarp_kernels.medium.limits import Limits
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import Flight, PhotonState, is_planned
from spadwarp_kernels.random.philox import (
    STREAM_ROULETTE,
    STREAM_TRANSPORT,
    RoundKeys,
    random_block_keyed,
    u01,
    u01_tail,
)
from spadwarp_kernels.random.splitmix import join_words
from spadwarp_kernels.sensor.camera import Camera
from spadwarp_kernels.sensor.gate import Gate


@made_once
def make_fly(spec: TransportSpec, plan_flight: wp.Function | None) -> wp.Function:
    """The Warp function ``(s, medium, layers, camera, gate, limits, keys, id) -> Flight``."""
    plans = plan_flight is not None
    water_free_path = spec.water.free_path

    @wp.func
    def fly(
        s: PhotonState,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        keys: RoundKeys,
        id: wp.uint64,
    ) -> Flight:
        f = Flight()
        f.block = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_TRANSPORT)
        seed = join_words(f.block[0], f.block[2])
        f.distance = water_free_path(medium, layers, s.x, s.u, u01_tail(f.block[0], f.block[2]), seed)
        f.reach = wp.min(f.distance, limits.max_path - s.path)
        if wp.static(plans):
            plan = plan_flight(s, medium, camera, gate, limits, keys, id)
            f.sample_block = plan.block
            f.lens = plan.lens
            f.lens_weight = plan.lens_weight
            f.interval = plan.interval
            if is_planned(f):
                f.reach = wp.max(f.reach, f.interval[1])
        return f

    return fly


@wp.func
def draw_albedo(s: PhotonState, medium: Medium, keys: RoundKeys, id: wp.uint64) -> float:
    """The albedo of the next collision, uniform in [0, medium.albedo)."""
    return medium.albedo * u01(random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_ROULETTE)[1])
