"""A single-photon depth camera for a robot simulator: depth and normals in, noisy depth out, all on the device.

Underwater depth cameras of robot simulators cut off at a range and add Gaussian noise (`ThresholdCamera`). This one
(`CramerRaoCamera`) has the same interface. Its noise is the Cramér–Rao bound of single-photon timing behind the light
that the water and the surface leave over, and some of its pixels report light that the water scattered back. It makes
no histograms: `spadwarp_kernels.SpadCamera` does, for many worlds at once.

    python kernels/examples/depth_camera.py --frames 100 --picture frame.png

Arrays are Warp's; those of torch go in and out without a copy:

    noisy = wp.to_torch(camera.frame(wp.from_torch(depth), wp.from_torch(normal, dtype=wp.vec3)))
"""

import argparse
import math
import time

import numpy as np
import warp as wp

import spadwarp_kernels as sk

C0 = 299_792_458.0


class ThresholdCamera:
    """What is common: depth up to a range, plus noise of one standard deviation [m]."""

    def __init__(self, *, farthest=10.0, sigma=0.02, seed=1):
        self.farthest, self.sigma, self.seed, self.count = farthest, sigma, seed, 0

    def frame(self, depth, normal):
        """Noisy depth float32 `[H, W]` [m], NaN beyond the range."""
        out = wp.empty(depth.shape, dtype=float, device=depth.device)
        self.count += 1
        inputs = [depth, self.farthest, self.sigma, wp.uint64(self.seed), wp.uint64(self.count)]
        wp.launch(_threshold, dim=depth.shape, inputs=inputs, outputs=[out], device=depth.device)
        return out


@wp.kernel(enable_backward=False)
def _threshold(
    depth: wp.array2d(dtype=float),
    farthest: float,
    sigma: float,
    seed: wp.uint64,
    count: wp.uint64,
    # Out:
    out: wp.array2d(dtype=float),
):
    i, j = wp.tid()
    block = sk.random_block(seed, count, wp.uint32(i * depth.shape[1] + j), wp.uint32(0))
    noise = wp.sqrt(-2.0 * wp.log(1.0 - sk.u01(block[0]))) * wp.cos(6.2831853 * sk.u01(block[1]))
    value = depth[i, j] + sigma * noise
    out[i, j] = wp.where(depth[i, j] < farthest, value, wp.NAN)


class CramerRaoCamera:
    """A pulsed laser beside a SPAD array in water, with the interface of `ThresholdCamera`.

    Args:
        width, height: Of the image [pixels].
        horizontal_fov: Full angle [rad]; pixels are square.
        absorption, scattering: Of the water [1/m].
        anisotropy: g of its Henyey–Greenstein phase function.
        pulses: Of a frame.
        pulse_energy: [J], at 532 nm.
        gate: Times of flight that are recorded, as range in this water [m].
    """

    def __init__(
        self,
        width,
        height,
        *,
        horizontal_fov=1.2,
        absorption=0.1,
        scattering=0.2,
        anisotropy=0.924,
        pulses=20_000,
        pulse_energy=4e-8,
        gate=(1.0, 12.0),
        seed=1,
        device=None,
    ):
        self.device = wp.get_device(device)
        self.shape, self.pulses, self.seed, self.count = (height, width), pulses, seed, 0
        tangent = 2.0 * math.tan(0.5 * horizontal_fov) / width
        lidar = sk.Lidar()
        lidar.photons = pulse_energy * 532e-9 / (6.62607015e-34 * C0)
        lidar.pde, lidar.dark = 0.25, 1000.0
        lidar.scattering, lidar.extinction = scattering, absorption + scattering
        lidar.speed = C0 / 1.3638  # group index of seawater
        lidar.laser, lidar.axis = wp.vec3d(0.05, 0.0, 0.0), wp.vec3d(0.0, 0.0, 1.0)
        half_angle = 0.65 * horizontal_fov  # a cone that covers the image's corners
        lidar.profile, lidar.spread = sk.LASER_PROFILES.index("uniform_cone"), 1.0 - math.cos(half_angle)
        lidar.tan2 = math.tan(half_angle) ** 2
        lidar.pixel_tangent, lidar.aperture_area = tangent, math.pi * 0.01**2
        lidar.start, lidar.stop = (2.0 * distance / lidar.speed for distance in gate)
        lidar.sigma = 100e-12  # of pulse and timing together [s]
        lidar.source, lidar.nearest = sk.BACKSCATTER_SOURCES.index("single_scatter"), 0.05
        self.lidar = lidar

        column, row = np.meshgrid(np.arange(width) + 0.5 - 0.5 * width, np.arange(height) + 0.5 - 0.5 * height)
        view = np.stack([column * tangent, row * tangent, np.ones_like(column)], axis=-1).reshape(-1, 3)
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        t = 1.0 - np.cos(np.linspace(0.0, np.pi, 4097))
        g = anisotropy
        phase = (1.0 - g * g) / (4.0 * np.pi * ((1.0 - g) ** 2 + 2.0 * g * t) ** 1.5)
        self.view = wp.array(view, dtype=wp.vec3d, device=self.device)
        self.view32 = wp.array(view, dtype=wp.vec3, device=self.device)
        self.phase = wp.array(phase, dtype=wp.float64, device=self.device)
        self.no_profile = wp.zeros((1, 1), dtype=float, device=self.device)

    def frame(self, depth, normal, reflectance=0.2):
        """Noisy depth float32 `[H, W]` [m], NaN where nothing returns.

        Args:
            depth: float32 `[H, W]`, planar [m]; NaN, infinite or 0 where nothing is hit.
            normal: vec3 `[H, W]`, unit, in the camera frame (+x right, +y down, +z forward), either side.
            reflectance: A number.
        """
        if depth.shape != self.shape or normal.shape != self.shape:
            raise sk.ArgumentError(
                f"depth {depth.shape} and normal {normal.shape} are not images of {self.shape}; a call for each world"
            )
        count = self.view.size
        distance, bright = (wp.empty(count, dtype=wp.float64, device=self.device) for _ in range(2))
        facing = wp.empty(count, dtype=wp.vec3d, device=self.device)
        inputs = [depth.flatten(), normal.flatten(), reflectance, self.view]
        wp.launch(_surfaces, dim=count, inputs=inputs, outputs=[distance, facing, bright], device=self.device)

        signal, arrival = sk.signal_map(self.lidar, self.view, distance, facing, bright)
        paths, cumulative, backscatter = sk.single_scatter_table(self.lidar, self.phase, self.view, distance)
        _, fisher, sigma_time, _, outlier = sk.statistics_maps(
            self.lidar,
            self.phase,
            self.no_profile,
            self.view,
            signal,
            arrival,
            backscatter,
            count_law="per_pulse",
            acquisitions=self.pulses,
        )
        true, sigma, chance, flat = (wp.empty(count, dtype=float, device=self.device) for _ in range(4))
        inputs = [self.lidar, self.view, distance, backscatter, fisher, sigma_time, outlier]
        wp.launch(_statistics, dim=count, inputs=inputs, outputs=[true, sigma, chance, flat], device=self.device)
        noisy, _ = sk.sample_frames(
            self.view32,
            true,
            sigma,
            chance,
            flat,
            paths,
            cumulative,
            laser=(0.05, 0.0, 0.0),
            gate_paths=(self.lidar.start * self.lidar.speed, self.lidar.stop * self.lidar.speed),
            first_frame=self.count,
            frames=1,
            seed=self.seed,
        )
        self.count += 1
        return noisy.reshape(self.shape)


@wp.kernel(enable_backward=False)
def _surfaces(
    depth: wp.array(dtype=float),
    normal: wp.array(dtype=wp.vec3),
    reflectance: float,
    view: wp.array(dtype=wp.vec3d),
    # Out:
    distance: wp.array(dtype=wp.float64),
    facing: wp.array(dtype=wp.vec3d),
    bright: wp.array(dtype=wp.float64),
):
    """From the simulator's buffers to what the photon budget takes. Launch: pixels."""
    i = wp.tid()
    z = depth[i]
    r = wp.float64(0.0)
    if wp.isfinite(z) and z > 0.0:
        r = wp.float64(z) / view[i][2]
    n = wp.vec3d(normal[i])
    distance[i] = r
    facing[i] = wp.where(wp.dot(n, view[i]) > wp.float64(0.0), -n, n)
    bright[i] = wp.float64(reflectance)


@wp.kernel(enable_backward=False)
def _statistics(
    lidar: sk.Lidar,
    view: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    backscatter: wp.array(dtype=wp.float64),
    fisher: wp.array(dtype=wp.float64),
    sigma_time: wp.array(dtype=wp.float64),
    outlier: wp.array(dtype=wp.float64),
    # Out:
    depth: wp.array(dtype=float),
    sigma: wp.array(dtype=float),
    chance: wp.array(dtype=float),
    flat: wp.array(dtype=float),
):
    """True depth, its standard deviation, and how often a pixel reports background instead. Launch: pixels."""
    i = wp.tid()
    depth[i] = wp.NAN
    sigma[i] = 0.0
    chance[i] = 0.0
    flat[i] = 0.0
    if fisher[i] > wp.float64(0.0):
        # path = |r u - laser| + r, so that a time of flight changes with range by (1 + cosine) / speed.
        light = wp.normalize(distance[i] * view[i] - lidar.laser)
        per_time = lidar.speed / (wp.float64(1.0) + wp.dot(light, view[i])) * view[i][2]
        dark = lidar.dark * (lidar.stop - lidar.start)
        depth[i] = float(distance[i] * view[i][2])
        # No bound is worse than a guess anywhere in the gate.
        guess = per_time * (lidar.stop - lidar.start) / wp.float64(3.4641016)
        sigma[i] = float(wp.min(sigma_time[i] * per_time, guess))
        chance[i] = float(outlier[i])
        flat[i] = float(dark / (dark + backscatter[i]))


def sea_floor(camera):
    """Depth and normals of a rippled floor with a pipe on it, as a simulator's renderer would leave them."""
    x, y = np.meshgrid(np.linspace(-6.0, 6.0, 241), np.linspace(-4.0, 2.5, 161))
    z = 5.0 - 1.2 * y + 0.08 * np.sin(6.0 * x + 2.0 * y)
    z -= np.sqrt(np.clip(0.35**2 - (x - 0.6 - 0.3 * y) ** 2, 0.0, None))
    first = (np.arange(160)[:, None] * 241 + np.arange(240)).ravel()
    faces = np.stack([first, first + 241, first + 1, first + 1, first + 241, first + 242], axis=1)
    points = wp.array(np.stack([x, y, z], axis=-1).reshape(-1, 3), dtype=wp.vec3, device=camera.device)
    mesh = wp.Mesh(points, wp.array(faces.ravel(), dtype=int, device=camera.device))
    lens = sk.Camera()
    lens.height, lens.width = camera.shape
    lens.pixel_tangent = camera.lidar.pixel_tangent
    depth, distance, reflectance = (wp.empty(camera.shape, dtype=float, device=camera.device) for _ in range(3))
    normal = wp.empty(camera.shape, dtype=wp.vec3, device=camera.device)
    none = wp.empty((0, 0), dtype=wp.vec3, device=camera.device)
    wp.launch(
        sk.truth_kernel,
        dim=camera.shape,
        inputs=[lens, sk.make_surfaces(mesh), none, none],
        outputs=[depth, distance, normal, reflectance],
        device=camera.device,
    )
    return depth, normal


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--device", help='"cpu" or "cuda:0"; by default the GPU, if there is one')
    parser.add_argument("--picture", help="PNG of a frame of both cameras (needs matplotlib)")
    options = parser.parse_args()
    camera = CramerRaoCamera(*options.size, device=options.device)
    depth, normal = sea_floor(camera)
    noisy = camera.frame(depth, normal)  # compiles the kernels
    wp.synchronize_device(camera.device)
    began = time.perf_counter()
    for _ in range(options.frames):
        noisy = camera.frame(depth, normal)
    wp.synchronize_device(camera.device)
    rate = options.frames / (time.perf_counter() - began)
    error = np.abs(noisy.numpy() - depth.numpy())
    print(f"{rate:.1f} frames/s of {options.size[0]} x {options.size[1]} on {camera.device.name}")
    print(f"error {1000 * np.nanmedian(error):.1f} mm in the median pixel, {np.mean(error > 0.5):.2%} off by 0.5 m")
    if options.picture:
        from matplotlib import pyplot

        frames = {"depth": depth, "threshold and noise": ThresholdCamera().frame(depth, normal), "SPAD": noisy}
        pyplot.rcParams.update({"font.size": 8, "axes.titlesize": 8})
        figure, axes = pyplot.subplots(1, 3, figsize=(7.2, 2.0), sharey=True, layout="constrained")
        colours = pyplot.colormaps["viridis_r"].with_extremes(bad="0.85", under="black", over="#d55e00")
        for axis, (title, image) in zip(axes, frames.items(), strict=True):
            shown = axis.imshow(image.numpy(), vmin=2.0, vmax=12.0, cmap=colours)
            axis.set(title=title, xlabel="column [pixel]")
        axes[0].set_ylabel("row [pixel]")
        bar = figure.colorbar(shown, ax=axes, label="depth z [m]\ngrey: none", extend="both", shrink=0.8)
        bar.minorticks_on()
        figure.savefig(options.picture, dpi=200)


if __name__ == "__main__":
    main()
