"""SpadTracer against SpadCamera where both know the light, and a step that stays on the device."""

import dataclasses

import numpy as np
import pytest

import spadwarp_kernels as sk
from helpers.worlds import SMALL, STILL, garden, square, transforms


@pytest.mark.slow
def test_without_scattering_both_cameras_see_the_same(device):
    """Light of the whole image and of its parts, in absorbing water; edges of polygons aside."""
    config = sk.SpadConfig(**SMALL, absorption=0.05, scattering=0.0, dark_rate=2e3)
    fine = dataclasses.replace(config, width=64, height=48, dark_rate=0.0)  # the camera's rays are at pixel centres
    shapes, bodies = garden(device)
    poses = transforms([(0.1, 0, -0.2, 0, 0, 0, 1), STILL], device)
    camera = sk.SpadCamera(fine, 2, frame="optical", device=device)
    camera.update(shapes, poses, bodies)
    dark = config.dark_rate * config.bin_path / config.speed
    theirs = camera.rates.numpy().astype(float).reshape(2, 12, 4, 16, 4, 64).sum(axis=(2, 4))
    tracer = sk.SpadTracer(shapes, config, 2, photons=400_000, frame="optical")
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
    camera = sk.SpadCamera(config, 2, frame="optical", device=device)
    camera.update(shapes, poses, bodies)
    assert np.array_equal(tracer.true_depth.numpy(), camera.true_depth.numpy())


def test_the_map_of_the_view_skips_rays_and_changes_no_bit(device, monkeypatch):
    """With bodies that have moved, and a floor that goes past the lens."""
    from spadwarp_kernels.worlds import spad_tracer

    mesh, uv = square(device)

    def trace():
        shapes = sk.make_shapes(
            ["plane", "plane", "sphere", "box", "mesh"],  # the mesh has an image, so that the kernel is the garden's
            [(0, 0, 0), (0, 0, 0), (0.4, 0, 0), (0.4, 0.3, 0.2), (1, 1, 1)],
            body=[-1, -1, 0, 1, 1],
            local=[(0, 1, 0, 0.7071068, 0, 0, 0.7071068), (0, 0, 4, 0, 0, 0, 1), *[(0, 0, 0, 0.6, 0, 0, 0.8)] * 3],
            mesh=[None] * 4 + [mesh],
            first_face=[-1] * 4 + [0],
            textures=sk.make_textures(np.zeros(2, int), uv, [np.array([[0.25, 1.0]])], device=device),
            device=device,
        )
        tracer = sk.SpadTracer(shapes, sk.SpadConfig(**SMALL), photons=20_000, frame="optical")
        pose = transforms([STILL], device)
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
    shapes, bodies = garden(device)
    tracer = sk.SpadTracer(shapes, sk.SpadConfig(**SMALL), 2, photons=5_000, frame="optical")
    sums = []
    for _ in range(16):
        tracer.update(transforms([STILL] * 2, device), bodies)
        sums.append(tracer.rates.numpy()[1].astype(float).sum())
    assert np.unique(sums).size == 16
    one = np.std(sums[:8] + sums[8:]) / np.mean(sums)
    pairs = np.std(np.mean(np.reshape(sums, (8, 2)), axis=1)) / np.mean(sums)
    assert 0.3 < pairs / one < 1.1  # 0.71 on average
