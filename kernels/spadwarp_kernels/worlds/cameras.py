"""What the cameras of many worlds share: poses, rays against shapes, and the arrays that they fill."""

from collections.abc import Sequence

import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_device,
    check_integer,
    check_items,
    check_kind,
)

from .checks import check_poses, check_room
from .config import SpadConfig, check_config
from .detect import Detection
from .frames import optical_to
from .shapes import Shapes, ShapeTable, intersect_shapes, move_shapes

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def _trace_kernel(
    shapes: ShapeTable,
    camera_q: wp.array(dtype=wp.transform),
    optical: wp.transform,
    world: wp.array(dtype=int),
    view: wp.array(dtype=wp.vec3),
    # Out, [cameras, height, width]:
    depth: wp.array3d(dtype=float),
    normal: wp.array3d(dtype=wp.vec3),
    albedo: wp.array3d(dtype=float),
):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    pose = wp.transform_multiply(camera_q[v], optical)
    u = view[i * depth.shape[2] + j]
    hit = intersect_shapes(shapes, world[v], wp.transform_get_translation(pose), wp.transform_vector(pose, u))
    depth[v, i, j] = wp.NAN
    normal[v, i, j] = wp.vec3(wp.NAN)
    albedo[v, i, j] = wp.NAN
    if hit.shape >= 0:
        depth[v, i, j] = hit.distance * u[2]
        normal[v, i, j] = wp.quat_rotate_inv(wp.transform_get_rotation(pose), hit.normal)
        albedo[v, i, j] = hit.albedo


class WorldCameras:
    """The part that `SpadCamera` and `SpadTracer` share; see there."""

    def __init__(
        self,
        config: SpadConfig | None,
        cameras: int,
        *,
        world: wp.array | Sequence[int] | None,
        frame: str,
        device: wp.DeviceLike,
    ) -> None:
        self.config = check_config(config)
        self.device = check_device("device", device)
        self.cameras = check_integer("cameras", cameras, 1)
        sizes = {"cameras": self.cameras, "config.height": self.config.height, "config.width": self.config.width}
        image = tuple(sizes.values())
        sizes["config.bins"] = self.config.bins
        check_room("rates, counts and background", sizes, 8 + 24 // self.cameras, self.device, rows=3)
        self._optical = optical_to(frame)
        self._world = camera_worlds(world, self.cameras, self.device)
        self._most_worlds = 0 if isinstance(world, wp.array) else int(self._world.numpy().max()) + 1
        self._poses_checked = False
        self._detection = Detection(self.config, self.cameras, self.device)
        self.rates, self.histogram = self._detection.rates, self._detection.histogram
        self.counts, self.depth, self.step = self._detection.counts, self._detection.depth, self._detection.step
        self.true_depth = wp.full(image, wp.nan, dtype=float, device=self.device)
        self.normal = wp.zeros(image, dtype=wp.vec3, device=self.device)
        self.albedo = wp.zeros(image, dtype=float, device=self.device)

    def _look(self, shapes: Shapes, camera_q: wp.array, body_q: wp.array | None) -> None:
        """Moves the shapes and casts a ray a pixel."""
        check_kind("shapes", shapes, Shapes)
        check_array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
        if self._most_worlds > shapes.worlds:
            raise ArgumentError(f"world = {self._most_worlds - 1} is none of the {shapes.worlds} worlds of the shapes")
        if not (self._poses_checked or self.device.is_capturing):  # once: later steps wait for nothing
            check_poses("camera_q", camera_q)
            if body_q is not None:
                check_array("body_q", body_q, wp.transform, (None,), self.device)
                check_poses("body_q", body_q, shapes.bodies)
            self._poses_checked = True
        move_shapes(shapes, body_q)
        inputs = [shapes.table, camera_q, self._optical, self._world, self._detection.view]
        outputs = [self.true_depth, self.normal, self.albedo]
        wp.launch(_trace_kernel, self.true_depth.shape, inputs, outputs, device=self.device)

    def point_cloud(self, out: wp.array, *, frame: str = "optical") -> None:
        """Points of the noisy depth, vec3 `[cameras, height, width]` [m], in a frame of CAMERA_FRAMES; NaN for none."""
        check_array("out", out, wp.vec3, self.depth.shape, self.device)
        self._detection.points(optical_to(frame), out)


def camera_worlds(world: wp.array | Sequence[int] | None, cameras: int, device: wp.Device) -> wp.array:
    """World of each camera on the device."""
    if isinstance(world, wp.array):
        return check_array("world", world, wp.int32, (cameras,), device)
    world = (
        list(range(cameras))
        if world is None
        else [check_integer("world", one, 0) for one in check_items("world", world)]
    )
    if len(world) != cameras:
        raise ArgumentError(f"world has {len(world)} entries; one for each of {cameras} cameras is needed")
    return wp.array(world, dtype=int, device=device)
