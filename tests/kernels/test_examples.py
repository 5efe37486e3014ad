"""The kernel library's examples, small: they run, and what comes out is right."""

import ast
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
from helpers.statistics_of_samples import chi2_p

SIMULATORS = {"newton", "mujoco", "mujoco_warp"}  # each in its own example
FOLDER = Path(__file__).parents[2] / "kernels" / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_examples_need_the_kernel_library_alone(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sk":
            assert node.attr in sk.__all__, node.attr
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for name in [node.module] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names]:
                top = name.split(".")[0]
                assert top in {"numpy", "warp", "spadwarp_kernels", "matplotlib"} | sys.stdlib_module_names | SIMULATORS


@pytest.mark.slow
def test_moving_target(monkeypatch):
    """The brightest light of the middle pixels has gone to the wave and back, step by step."""
    module = example("moving_target")
    monkeypatch.setattr(module, "WIDTH", 17)
    monkeypatch.setattr(module, "HEIGHT", 13)
    steps, photons = 3, 60_000
    video = module.film(steps, photons, device="cpu")
    assert video.shape == (steps, 13, 17, module.BINS)
    width = (module.GATE[1] - module.GATE[0]) / module.BINS
    for step, frame in enumerate(video):
        phase = -3.0 * 2.0 * step / steps
        depth = module.DISTANCE + 0.3 * np.sin(phase)
        slope = 0.3 * 2.5 * abs(np.cos(phase))
        path = depth + np.hypot(depth, 0.1)
        peak = module.GATE[0] + (frame[4:9, 8].sum(axis=0).argmax() + 0.5) * width
        assert abs(peak - path) < 1.5 * width + 0.02 + 0.16 * slope  # a pixel is 0.16 m wide
    # Frames are independent runs: another seed differs, the same one does not.
    assert np.array_equal(module.film(1, photons, device="cpu")[0], video[0])


@pytest.fixture(scope="module")
def depth_camera():
    module = example("depth_camera")
    camera = module.CramerRaoCamera(24, 18, pulses=100, device="cpu")
    return module, camera, *module.sea_floor(camera)


def test_depth_camera(depth_camera):
    """Noise grows with distance; no estimate where nothing was hit; every frame is drawn anew."""
    _, camera, depth, normal = depth_camera
    frames, true = np.stack([camera.frame(depth, normal).numpy() for _ in range(60)]), depth.numpy()
    assert np.isnan(true).any() and np.isnan(frames[:, np.isnan(true)]).all()
    error = frames - true
    near, far = true < np.nanquantile(true, 0.3), true > np.nanquantile(true, 0.7)
    assert 1e-4 < np.nanmedian(np.abs(error[:, near])) < np.nanmedian(np.abs(error[:, far]))
    error = error[:, near]
    error = error[:, (np.abs(error) < 0.5).all(axis=0)]  # pixels without a photon of the background
    assert error.shape[1] > 20
    assert np.mean(error.mean(axis=0) ** 2 / error.var(axis=0)) * 60 == pytest.approx(1.0, abs=0.7)
    worlds = wp.zeros((4, *depth.shape), dtype=float, device="cpu")
    with pytest.raises(sk.ArgumentError, match=r"depth \(4, 18, 24\) .* are not images of \(18, 24\)"):
        camera.frame(worlds, normal)


@pytest.mark.slow
def test_depth_camera_takes_torch(depth_camera):
    torch = pytest.importorskip("torch")
    module, _, depth, normal = depth_camera
    one, other = (module.CramerRaoCamera(24, 18, device="cpu") for _ in range(2))
    tensors = wp.to_torch(depth), wp.to_torch(normal)
    noisy = wp.to_torch(one.frame(wp.from_torch(tensors[0]), wp.from_torch(tensors[1], dtype=wp.vec3)))
    assert noisy.shape == (18, 24) and noisy.dtype == torch.float32
    assert np.array_equal(noisy.numpy(), other.frame(depth, normal).numpy(), equal_nan=True)
    old = module.ThresholdCamera(farthest=6.0, sigma=0.02).frame(depth, normal).numpy()
    assert np.isnan(old[depth.numpy() >= 6.0]).all()
    assert np.nanstd(old - depth.numpy()) == pytest.approx(0.02, rel=0.3)


@pytest.mark.slow
def test_own_phase_function():
    """In the transport kernel the directions after one scattering follow the density: χ² over 1 − cos θ."""
    module = example("own_phase_function")
    structs, count = lit_box(), 1 << 20
    medium, laser, limits = structs["medium"], structs["laser"], structs["limits"]
    medium.extinction, medium.albedo, laser.profile = 1.0, 1.0, 2
    limits.max_path, limits.max_collisions = 1e30, 2
    model = sk.Model("cpu", mesh=None, surfaces=sk.make_surfaces(None, device="cpu"), scale=1.0, **structs)
    data = sk.make_data(model, record_count=count, histogram=False)
    spec = sk.TransportSpec("none", phase=module.PURE_WATER, mesh=False, records=True)
    sk.launch_transport(spec, model, data, seed=3, first_id=0, photon_count=count)
    mu = data.records.direction.numpy()[:, 2].astype(np.float64)

    def cdf(t):
        mu = 1.0 - t
        return 0.5 - 0.5 * (mu + 0.835 / 3 * mu**3) / (1 + 0.835 / 3)

    assert chi2_p(1.0 - mu, cdf) > 1e-3
    reflected, transmitted = module.slab(module.PURE_WATER, 200_000, albedo=1.0, device="cpu")
    assert reflected + transmitted == pytest.approx(1.0, abs=1e-3)  # nothing is absorbed
    assert transmitted > np.exp(-1.0)


@pytest.mark.slow
@pytest.mark.parametrize("simulator", ["newton", "mujoco_warp"])
@pytest.mark.filterwarnings("default")  # those of the simulators
def test_cameras_in_simulators(simulator):
    """A stranger's program, short; the camera looks down from a falling box, past the ball on the floor."""
    pytest.importorskip(simulator)
    path = FOLDER / f"{simulator}_camera.py"
    body = path.read_text().partition("def main")[2].partition("\n\n\n")[0].split("\n", 2)[2]
    assert len(body.splitlines()) <= 20
    camera = example(path.stem).main(worlds=2, steps=20, device="cpu")
    height = 3.0 - 0.5 * 9.81 * 0.2**2 - 0.25
    assert np.nanmedian(camera.depth.numpy(), axis=(1, 2)) == pytest.approx(height, abs=0.05)
    assert np.nanmin(camera.depth.numpy()) == pytest.approx(height - 0.6, abs=0.1)  # the top of the ball


@pytest.mark.slow
def test_vehicles_stop_before_an_obstacle():
    """In clear water with the margin, in murky water too late."""
    clearance, began = example("obstacle_stop").main(extinctions=np.array([0.2, 3.0]), start=5.0, device="cpu")
    assert clearance[0] == pytest.approx(1.0, abs=0.15) and clearance[1] < 0.0
    assert began[0] == pytest.approx(1.0 + 1.5**2 + 0.15, abs=0.15) and began[1] < 2.0
