"""The fast camera: one surface and single scattering a pixel, in closed form, for many worlds in one launch."""

from collections.abc import Sequence

import warp as wp

from spadwarp_kernels.analytic.lidar import Lidar, beam_path
from spadwarp_kernels.analytic.optics import IN_WATER
from spadwarp_kernels.analytic.signal import radiometric_signal
from spadwarp_kernels.base.arguments import check_array, check_number

from .cameras import WorldCameras
from .config import SpadConfig
from .shapes import Shapes

__all__ = ["SpadCamera"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_see = IN_WATER.see


@wp.kernel(enable_backward=False)
def _images_kernel(
    view: wp.array(dtype=wp.vec3),
    # In, [cameras, height, width]; those without an entry are left out:
    depth_in: wp.array3d(dtype=float),
    along_ray: int,
    normal_in: wp.array3d(dtype=wp.vec3),
    camera_q: wp.array(dtype=wp.transform),
    optical: wp.transform,
    albedo_in: wp.array3d(dtype=float),
    one_albedo: float,
    # Out:
    depth: wp.array3d(dtype=float),
    normal: wp.array3d(dtype=wp.vec3),
    albedo: wp.array3d(dtype=float),
):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    width = depth.shape[2]
    u = view[i * width + j]
    z = depth_in[v, i, j]
    if along_ray == 1:
        z = z * u[2]
    depth[v, i, j] = wp.where(wp.isfinite(z) and z > 0.0, z, wp.NAN)
    value = one_albedo
    if albedo_in.shape[0] > 0:
        value = albedo_in[v, i, j]
    albedo[v, i, j] = value
    n = wp.vec3(0.0)
    if normal_in.shape[0] > 0:
        n = normal_in[v, i, j]
        if camera_q.shape[0] > 0:
            n = wp.quat_rotate_inv(wp.transform_get_rotation(camera_q[v]), n)
        n = wp.quat_rotate_inv(wp.transform_get_rotation(optical), n)
    else:
        n = _slope(view, depth_in, along_ray, v, i, j)
    n = wp.normalize(n)
    normal[v, i, j] = wp.where(wp.dot(n, u) > 0.0, -n, n)


@wp.func
def _point(view: wp.array(dtype=wp.vec3), depth: wp.array3d(dtype=float), along_ray: int, v: int, i: int, j: int):
    u = view[i * depth.shape[2] + j]
    return wp.where(along_ray == 1, depth[v, i, j], depth[v, i, j] / u[2]) * u


@wp.func
def _neighbour_step(
    view: wp.array(dtype=wp.vec3),
    depth: wp.array3d(dtype=float),
    along_ray: int,
    v: int,
    i: int,
    j: int,
    di: int,
    dj: int,
) -> wp.vec3:
    """From a pixel to the nearer in depth of its two neighbours along one axis: not across an edge of a thing."""
    here = _point(view, depth, along_ray, v, i, j)
    best = wp.vec3(0.0)
    least = float(1.0e30)
    for side in range(2):
        sign = 2 * side - 1
        ii = i + sign * di
        jj = j + sign * dj
        if ii >= 0 and jj >= 0 and ii < depth.shape[1] and jj < depth.shape[2]:
            there = _point(view, depth, along_ray, v, ii, jj)
            gap = wp.abs(there[2] - here[2])
            if wp.isfinite(gap) and gap < least:
                least = gap
                best = float(sign) * (there - here)
    return best


@wp.func
def _slope(
    view: wp.array(dtype=wp.vec3), depth: wp.array3d(dtype=float), along_ray: int, v: int, i: int, j: int
) -> wp.vec3:
    """Normal of the surface through a pixel and its neighbours; towards the camera where it has none."""
    across = _neighbour_step(view, depth, along_ray, v, i, j, 0, 1)
    down = _neighbour_step(view, depth, along_ray, v, i, j, 1, 0)
    n = wp.cross(across, down)
    return wp.where(wp.length_sq(n) > 0.0, n, view[i * depth.shape[2] + j])


@wp.kernel(enable_backward=False)
def _signal_kernel(
    lidar: Lidar,
    view: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=float),
    normal: wp.array(dtype=wp.vec3),
    albedo: wp.array(dtype=float),
    # Out:
    signal: wp.array(dtype=float),
    path: wp.array(dtype=float),
):
    """Detections per pulse of the surface, and its path, infinite where there is none. Launch: cameras x pixels."""
    row = wp.tid()
    u = wp.vec3d(view[row % view.shape[0]])
    signal[row] = 0.0
    path[row] = wp.inf
    if depth[row] > 0.0:
        r = wp.float64(depth[row]) / u[2]
        value = radiometric_signal(lidar, _see(lidar.ports, u), r, wp.vec3d(normal[row]), wp.float64(albedo[row]))
        path[row] = float(beam_path(lidar, r * u) + r)
        if value > wp.float64(0.0) and wp.isfinite(value):
            signal[row] = float(value)


@wp.func
def _below(z: float) -> float:
    """Probability below z standard deviations."""
    return 0.5 * wp.erfc(-0.70710678118654752 * z)


@wp.kernel(enable_backward=False)
def _rates_kernel(
    signal: wp.array(dtype=float),
    path: wp.array(dtype=float),
    background: wp.array2d(dtype=float),
    gate_start: float,
    bin_path: float,
    sigma_path: float,
    dark: float,
    # Out:
    rates: wp.array2d(dtype=float),
):
    """Expected detections per pulse: surface, backscatter up to it, dark counts. Launch: (cameras x pixels, bins)."""
    row, k = wp.tid()
    scale = 1.0 / sigma_path
    low = (gate_start + float(k) * bin_path - path[row]) * scale
    high = low + bin_path * scale
    surface = float(0.0)
    if low < 9.0 and high > -9.0:
        # From the side on which both are small, where a difference keeps its digits.
        surface = wp.where(low > 0.0, _below(-low) - _below(-high), _below(high) - _below(low)) * signal[row]
    water = background[row % background.shape[0], k] * _below(-0.5 * (low + high))
    rates[row, k] = dark + water + wp.max(surface, 0.0)


class SpadCamera(WorldCameras):
    """Single-photon cameras in many worlds: histograms, counts and noisy depth of all in a few launches.

    A pixel sees one surface, the water between by single scattering, and dark counts. The first
    step checks the poses. Every other one allocates nothing, reads nothing back and has its random numbers from a
    counter on the device: it can be captured in a CUDA graph.

    Args:
        config: Laser, detector and water; the same for all cameras.
        cameras: Their number.
        world: World of each camera, as in Newton; by default camera k is in world k. Kept if it is an array on the
            device, which may change.
        frame: Of the cameras' poses, one of CAMERA_FRAMES: "optical" (+z forward, y down), "opengl" (-z forward, y up:
            Newton, MuJoCo, USD), "forward_left_up" (bodies in ROS).
        device: Of the arrays.

    Attributes:
        rates: Expected detections per pulse, float32 `[cameras, height, width, bins]`.
        histogram: Counts of the frame, int32 `[cameras, height, width, bins]`.
        counts: Sum of the histogram, int32 `[cameras, height, width]`.
        depth: Planar depth (z of the optical frame) from the histogram [m], float32 `[cameras, height, width]`; NaN for
            none.
        true_depth, normal, albedo: What is there, `[cameras, height, width]`: planar depth [m], unit normals towards
            the camera in the optical frame, reflectance; NaN for none.
        step: Number of the next step, int64 `[1]`. A step's random numbers depend on `config.seed` and it alone.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit.
    """

    def __init__(
        self,
        config: SpadConfig | None = None,
        cameras: int = 1,
        *,
        world: wp.array | Sequence[int] | None = None,
        frame: str = "optical",
        device: wp.DeviceLike = None,
    ) -> None:
        super().__init__(config, cameras, world=world, frame=frame, device=device)
        self._lidar = self.config.lidar()
        rows = self._detection.rows[0]
        self._signal, self._path = (wp.zeros(rows, dtype=float, device=self.device) for _ in range(2))
        self._none = wp.empty((0, 0, 0), dtype=float, device=self.device)
        self._no_normal = wp.empty((0, 0, 0), dtype=wp.vec3, device=self.device)
        self._no_pose = wp.empty(0, dtype=wp.transform, device=self.device)

    def update(self, shapes: Shapes, camera_q: wp.array, body_q: wp.array | None = None) -> None:
        """A step: moves the shapes, casts a ray a pixel, and draws a frame.

        Args:
            shapes: From `make_shapes`, `newton_shapes` or `mujoco_shapes`.
            camera_q: Poses of the cameras in their worlds, `wp.transform` `[cameras]`.
            body_q: Poses of the bodies, `wp.transform` `[bodies]`, as Newton's `state.body_q`.
        """
        self._look(shapes, camera_q, body_q)
        self._draw()

    def update_from_images(
        self,
        depth: wp.array,
        normal: wp.array | None = None,
        albedo: wp.array | float = 0.2,
        *,
        along_ray: bool = False,
        camera_q: wp.array | None = None,
    ) -> None:
        """A step from what the simulator's own camera has rendered, `[cameras, height, width]`.

        Args:
            depth: float32 [m], planar; 0, negative, NaN or infinite where nothing is.
            normal: vec3, either side, in the camera's frame or, with `camera_q`, in the world's; None takes them from
                the slope of the depth.
            albedo: float32 in [0, 1], or a number.
            along_ray: Depth is the distance from the lens, as Newton's `depth_image` is.
            camera_q: As in `update`.
        """
        shape, view = self.true_depth.shape, self._detection.view
        check_array("depth", depth, wp.float32, shape, self.device)
        number = 0.0
        if isinstance(albedo, wp.array):
            check_array("albedo", albedo, wp.float32, shape, self.device)
        else:
            number, albedo = check_number("albedo", albedo, "[0, 1]"), self._none
        if normal is not None:
            check_array("normal", normal, wp.vec3, shape, self.device)
        if camera_q is not None:
            check_array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
        inputs = [view, depth, int(bool(along_ray)), self._no_normal if normal is None else normal]
        inputs += [self._no_pose if camera_q is None else camera_q, self._optical, albedo, number]
        outputs = [self.true_depth, self.normal, self.albedo]
        wp.launch(_images_kernel, shape, inputs, outputs, device=self.device)
        self._draw()

    def _draw(self) -> None:
        """Signal, rates, counts and depth from the images of what is there."""
        config, detection = self.config, self._detection
        inputs = [self._lidar, detection.view, self.true_depth.flatten(), self.normal.flatten(), self.albedo.flatten()]
        outputs = [self._signal, self._path]
        wp.launch(_signal_kernel, detection.rows[0], inputs, outputs, device=self.device)
        inputs = [self._signal, self._path, detection.background, config.gate_paths[0], config.bin_path]
        inputs += [config.timing_sigma * config.speed, config.dark_rate * config.bin_path / config.speed]
        rates = self.rates.reshape(detection.rows)
        wp.launch(_rates_kernel, detection.rows, inputs, [rates], device=self.device)
        detection.launch()
