"""SpadTracer against SpadCamera where both know the light, and a step that stays on the device."""

import dataclasses
import io

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk

SMALL = {"width": 16, "height": 12, "bins": 64, "gate": (0.5, 6.0), "pulse_energy": 1e-12, "pulses": 1000}


def transforms(rows, device):
    return wp.array(np.array(rows, np.float32), dtype=wp.transform, device=device)


def square(device):
    corners = np.array([(-0.7, -0.7, 0), (0.7, -0.7, 0), (0.7, 0.7, 0), (-0.7, 0.7, 0)], np.float32)
    faces = wp.array([0, 1, 2, 0, 2, 3], dtype=int, device=device)
    uv = (corners[:, :2] / 1.4 + 0.5)[[[0, 1, 2], [0, 2, 3]]]
    return wp.Mesh(wp.array(corners, dtype=wp.vec3, device=device), faces), uv


def garden(device):
    """One shape of every kind before a wall, in two worlds; the mesh has an image of two halves."""
    kinds = ["sphere", "capsule", "ellipsoid", "cylinder", "box", "cone"]
    sizes = [(0.35, 0, 0), (0.2, 0.25, 0), (0.4, 0.3, 0.2), (0.25, 0.3, 0), (0.3, 0.2, 0.25), (0.3, 0.35, 0)]
    turn = np.array([0.3, -0.2, 0.4, 0.85]) / np.linalg.norm([0.3, -0.2, 0.4, 0.85])
    places = [(-1.0, -0.6), (0.0, -0.6), (1.0, -0.6), (-1.0, 0.6), (0.0, 0.6), (1.0, 0.6)]
    mesh, uv = square(device)
    return sk.make_shapes(
        ["plane", *kinds, "mesh"],
        [(0, 0, 0), *sizes, (1, 1, 1)],
        body=[-1, 0, 1, 2, 3, 4, 5, -1],
        local=[(0, 0, 4, 0, 0, 0, 1), *[(0, 0, 0, *turn)] * 6, (0, 0, 3, 0, 0, 0, 1)],
        mesh=[None] * 7 + [mesh],
        reflectance=[0.5, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
        world=[-1, 0, 0, 0, 0, 0, 0, 1],
        worlds=2,
        first_face=[-1] * 7 + [0],
        textures=sk.make_textures(np.zeros(2, int), uv, [np.array([[0.25, 0.25, 1.0, 1.0]])], device=device),
        device=device,
    ), transforms([(x, y, 2.5, 0, 0, 0, 1) for x, y in places], device)


@pytest.mark.parametrize("use_warp_bvh", [False, True])
def test_without_scattering_both_cameras_see_the_same(use_warp_bvh, device):
    """Light of the whole image and of its parts, in absorbing water; edges of polygons aside."""
    config = sk.SpadConfig(**SMALL, absorption=0.05, scattering=0.0, dark_rate=2e3)
    fine = dataclasses.replace(config, width=64, height=48, dark_rate=0.0)  # the camera's rays are at pixel centres
    shapes, bodies = garden(device)
    poses = transforms([(0.1, 0, -0.2, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 1)], device)
    camera = sk.SpadCamera(fine, 2, device=device)
    camera.update(shapes, poses, bodies)
    dark = config.dark_rate * config.bin_path / config.speed
    theirs = camera.rates.numpy().astype(float).reshape(2, 12, 4, 16, 4, 64).sum(axis=(2, 4))
    tracer = sk.SpadTracer(shapes, config, 2, photons=400_000, use_warp_bvh=use_warp_bvh)
    tracer.update(poses, bodies)
    mine = tracer.rates.numpy() - dark
    for world in range(2):
        assert mine[world].sum() == pytest.approx(theirs[world].sum(), rel=0.01)
        for part in (np.s_[:6, :8], np.s_[:6, 8:], np.s_[6:, :8], np.s_[6:, 8:]):
            assert mine[world][part].sum() == pytest.approx(theirs[world][part].sum(), rel=0.03)
    # The image on the square: dark to the left, bright to the right.
    for part in (np.s_[1, 5:7, 6:8], np.s_[1, 5:7, 8:10]):
        assert mine[part].sum() == pytest.approx(theirs[part].sum(), rel=0.06)
    # When the light arrives, pixel by pixel.
    path = config.gate_paths[0] + (np.arange(64) + 0.5) * config.bin_path
    mean = [one[1] @ path / one[1].sum(axis=-1) for one in (mine, theirs)]
    width = config.bin_path / 4  # of a bin of the tally
    assert np.median(abs(mean[0] - mean[1])) < 0.2 * width and abs(np.median(mean[0] - mean[1])) < 0.1 * width
    camera = sk.SpadCamera(config, 2, device=device)
    camera.update(shapes, poses, bodies)
    assert np.array_equal(tracer.true_depth.numpy(), camera.true_depth.numpy())


def small_step(device, photons=20_000):
    shapes, bodies = garden(device)
    tracer = sk.SpadTracer(shapes, sk.SpadConfig(**SMALL), 2, photons=photons)
    poses = transforms([(0, 0, 0, 0, 0, 0, 1)] * 2, device)
    return tracer, bodies, lambda: tracer.update(poses, bodies)


def test_a_step_stays_on_the_device(device, monkeypatch):
    tracer, _, step = small_step(device)
    step()

    def refuse(*_, **__):
        raise AssertionError("read by the host")

    for name in ("numpy", "list"):
        monkeypatch.setattr(wp.array, name, refuse)
    for name in ("synchronize", "synchronize_device", "synchronize_stream"):
        monkeypatch.setattr(wp, name, refuse)
    with wp.ScopedMemoryTracker("one_step", print=False) as tracker:
        step()
        report = io.StringIO()
        tracker.report(file=report)
    monkeypatch.undo()
    assert "No allocations" in report.getvalue() or "one_step" not in report.getvalue(), report.getvalue()
    assert tracer.step.numpy()[0] == 2 and tracer.data.offset.numpy()[0] == 2 * 2 * 20_000


def test_a_captured_step_is_the_step(device):
    """Replays trace new photons and follow the bodies, as calls do."""
    (tracer, bodies, step), (other, other_bodies, other_step) = small_step(device), small_step(device)
    step()
    other_step()
    with wp.ScopedCapture(device=device) as capture:
        step()
    seen = []
    for k in range(2):
        moved = bodies.numpy()
        moved[:, 1] += 0.1 * k
        bodies.assign(moved)
        other_bodies.assign(moved)
        wp.capture_launch(capture.graph)
        other_step()
        for name in ("rates", "histogram", "counts", "depth", "step"):
            mine, theirs = getattr(tracer, name).numpy(), getattr(other, name).numpy()
            assert np.array_equal(mine, theirs, equal_nan=mine.dtype.kind == "f"), name
        seen.append(tracer.rates.numpy().copy())
    assert not np.array_equal(seen[0], seen[1])
    tracer.rebuild()  # the tree is another, the light is not
    other_step()
    step()
    mine, theirs = tracer.rates.numpy().sum(), other.rates.numpy().sum()
    assert mine == pytest.approx(theirs, rel=1e-3)


def test_the_map_of_the_view_skips_rays_and_changes_no_bit(device, monkeypatch):
    """With bodies that have moved, and a floor that goes past the lens."""
    from spadwarp_kernels.worlds import spad_tracer

    def trace():
        shapes = sk.make_shapes(
            ["plane", "plane", "sphere", "box"],
            [(0, 0, 0), (0, 0, 0), (0.4, 0, 0), (0.4, 0.3, 0.2)],
            body=[-1, -1, 0, 1],
            local=[(0, 1, 0, 0.7071068, 0, 0, 0.7071068), (0, 0, 4, 0, 0, 0, 1), *[(0, 0, 0, 0.6, 0, 0, 0.8)] * 2],
            device=device,
        )
        tracer = sk.SpadTracer(shapes, sk.SpadConfig(**SMALL), photons=20_000)
        pose = transforms([(0, 0, 0, 0, 0, 0, 1)], device)
        for x in (-0.5, 0.5):
            tracer.update(pose, transforms([(x, 0.2, 2, 0, 0, 0, 1), (-x, 0, 3, 0, 0, 0, 1)], device))
        return tracer.rates.numpy(), sk.read_ledger(tracer.data)[1]

    rates, counters = trace()
    make, update = spad_tracer.make_surfaces, spad_tracer.update_surfaces
    monkeypatch.setattr(spad_tracer, "make_surfaces", lambda *a, **k: make(*a, **k | {"camera": None}))
    monkeypatch.setattr(spad_tracer, "update_surfaces", lambda surfaces, mesh, camera: update(surfaces, mesh))
    others, more = trace()
    assert np.array_equal(rates, others)
    assert more["shadow_queries"] == more["contributions"] == counters["contributions"]
    assert 0 < counters["shadow_queries"] < 0.4 * more["shadow_queries"]


def test_steps_have_photons_of_their_own(device):
    """Their mean converges as that of independent runs does."""
    tracer, _, step = small_step(device, photons=5_000)
    sums = []
    for _ in range(16):
        step()
        sums.append(tracer.rates.numpy()[1].astype(float).sum())
    assert np.unique(sums).size == 16
    one = np.std(sums[:8] + sums[8:]) / np.mean(sums)
    pairs = np.std(np.mean(np.reshape(sums, (8, 2)), axis=1)) / np.mean(sums)
    assert 0.3 < pairs / one < 1.1  # 0.71 on average


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"cameras": 3}, "world = 2 is none of the 2 worlds"),
        ({"photons": 0}, r"photons = 0 is outside \[1, 67108864\]"),
        ({"estimator": "analog"}, "estimator = 'analog' is not one of 'guided', 'next_event'"),
    ],
)
def test_errors_name_the_argument(arguments, text):
    shapes, _ = garden("cpu")
    with pytest.raises(sk.ArgumentError, match=text):
        sk.SpadTracer(shapes, sk.SpadConfig(**SMALL), **{"cameras": 2} | arguments)
