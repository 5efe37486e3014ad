"""The renderer as a function of torch."""

import numpy as np
import pytest

import spadwarp
from helpers.inverse import CLEAR, plate
from helpers.scenes import scene as small_scene
from spadwarp.inverse.tensors import with_block_means
from spadwarp.scene.medium import grid_cells

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.physics
NAMES = ("medium.absorption", "medium.scattering", "targets[0].reflectance")


def parameters(scene):
    values = zip(NAMES, (scene.medium.absorption, scene.medium.scattering, scene.targets[0].reflectance), strict=True)
    return {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in values}


def render(scene, values, photons=1000, seed=1):
    return spadwarp.inverse.render(scene, values, photons=photons, seed=seed, device="cpu")


def test_gradients_are_those_of_clear_water():
    """Light ∝ Γ exp(−a L), in every pixel and bin."""
    scene = plate(CLEAR)
    values = parameters(scene)
    light = render(scene, values, 100_000, seed=3)
    result = spadwarp.simulate(scene, photons=100_000, seed=3, device="cpu")
    assert light.shape == (8, 8, 160) and light.dtype == torch.float64
    torch.testing.assert_close(light, torch.tensor(result.detections))
    total = light.sum()
    total.backward()
    path = float((result.detections.sum(axis=2) * result.true_path()).sum() / result.detections.sum())
    absorption, _, reflectance = (values[name].grad.item() for name in NAMES)
    assert -absorption / path == pytest.approx(total.item(), rel=0.02)
    assert 0.4 * reflectance == pytest.approx(total.item(), rel=0.02)


@pytest.mark.slow
def test_gradients_of_a_loss_point_to_the_truth():
    scene = plate()
    measured = torch.tensor(spadwarp.simulate(scene, photons=400_000, seed=1, device="cpu").detections.sum((0, 1)))
    for factor in (0.7, 1.4):
        scattering = torch.tensor(0.7 * factor, dtype=torch.float64, requires_grad=True)
        light = render(scene, {**parameters(scene), "medium.scattering": scattering}, 100_000, seed=2)
        ((light.sum((0, 1)) - measured) ** 2).sum().backward()
        assert (scattering.grad > 0) == (factor > 1)


@pytest.mark.slow
def test_blocks_of_a_grid(tmp_path):
    """Means of blocks move the cells; gradients are the derivatives by block, beside that of a target."""
    cells = np.linspace(0.5, 1.5, 4 * 2 * 4).reshape(4, 2, 4)
    np.savez(tmp_path / "cells.npz", extinction=cells, albedo=np.full(cells.shape, 0.8), size=[1.0, 1.0, 1.0])
    grid = {"file": str(tmp_path / "cells.npz"), "scale": 1.2, "translation": [0.1, 0.0, 1.1], "tracking": "delta"}
    one = small_scene(medium={"grid": {**grid, "rotation_deg": [0.0, 20.0, 0.0]}}, transport={"estimator": "guided"})
    means = torch.tensor(cells.reshape(2, 2, 1, 2, 2, 2).mean(axis=(1, 3, 5)), requires_grad=True)
    reflectance = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    values = {"medium.grid.extinction": means, "reflectance": reflectance}
    light = render(one, values, 20_000, seed=3)
    names = ["medium.grid.extinction", "reflectance"]
    options = {"derivatives": names, "blocks": (2, 1, 2), "photons": 20_000, "seed": 3, "device": "cpu"}
    same, other = (spadwarp.simulate(one, **options, run=spadwarp.RunOptions(first_photon=k)) for k in (0, 20_000))
    torch.testing.assert_close(light, torch.tensor(same.detections), rtol=1e-3, atol=0)
    light.sum().backward()
    scale = one.laser.photons_per_pulse * one.detections_per_photon
    expected = scale * other.derivatives[names[0]].sum(axis=(3, 4, 5, 6))
    np.testing.assert_allclose(means.grad, expected, rtol=1e-3)
    assert reflectance.grad.item() == pytest.approx(scale * other.derivatives["targets[0].reflectance"].sum(), rel=1e-3)

    moved = with_block_means(one, {"extinction": means.detach().numpy() + 0.25}, tmp_path)
    np.testing.assert_allclose(grid_cells(moved.medium).extinction, cells + 0.25, rtol=1e-6)
    np.testing.assert_allclose(grid_cells(moved.medium).size, 1.2)
    for values, words in (
        ({"extinction": torch.ones(2, 2)}, "is not a tensor"),
        ({"extinction": torch.ones(3, 1, 1)}, "possible are 1, 2, 4"),
        ({"absorption": torch.zeros(1, 1, 1)}, "outside"),
        ({name: torch.ones(1, 1, 1) for name in ("absorption", "extinction")}, "cannot be combined with"),
    ):
        with pytest.raises(spadwarp.SpadwarpError, match=words):
            render(one, {f"medium.grid.{name}": value for name, value in values.items()})


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("depth", torch.tensor(1.0), "no scored derivative"),
        ("absorption", torch.tensor([1.0, 2.0]), "a tensor of one number"),
        ("medium.absorption", torch.tensor(-1.0), "medium.absorption"),
        ("absorption", 0.1, "tensor"),
    ],
)
def test_other_parameters_are_refused(name, value, words):
    with pytest.raises(spadwarp.SpadwarpError, match=words):
        render(plate(), {name: value})
