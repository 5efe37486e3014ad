"""The renderer as a function of torch."""

import pytest

import spadwarp
from helpers.inverse import CLEAR, plate

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.physics
NAMES = ("medium.absorption", "medium.scattering", "targets[0].reflectance")


def parameters(scene):
    values = (scene.medium.absorption, scene.medium.scattering, scene.targets[0].reflectance)
    return {
        name: torch.tensor(value, dtype=torch.float64, requires_grad=True)
        for name, value in zip(NAMES, values, strict=True)
    }


def test_gradients_are_those_of_clear_water():
    """Light ∝ Γ exp(−a L), in every pixel and bin."""
    scene = plate(CLEAR)
    values = parameters(scene)
    light = spadwarp.inverse.render(scene, values, photons=100_000, seed=3, device="cpu")
    result = spadwarp.simulate(scene, photons=100_000, seed=3, device="cpu")
    assert light.shape == (8, 8, 160) and light.dtype == torch.float64
    torch.testing.assert_close(light, torch.tensor(result.detections))
    total = light.sum()
    total.backward()
    path = float((result.detections.sum(axis=2) * result.true_path()).sum() / result.detections.sum())
    absorption, _, reflectance = (values[name].grad.item() for name in NAMES)
    assert -absorption / path == pytest.approx(total.item(), rel=0.02)
    assert 0.4 * reflectance == pytest.approx(total.item(), rel=0.02)


def test_gradients_of_a_loss_point_to_the_truth():
    scene = plate()
    measured = torch.tensor(spadwarp.simulate(scene, photons=400_000, seed=1, device="cpu").detections.sum((0, 1)))
    for factor in (0.7, 1.4):
        values = parameters(scene)
        moved = {"medium.scattering": torch.tensor(0.7 * factor, dtype=torch.float64, requires_grad=True)}
        light = spadwarp.inverse.render(scene, {**values, **moved}, photons=100_000, seed=2, device="cpu")
        ((light.sum((0, 1)) - measured) ** 2).sum().backward()
        assert (moved["medium.scattering"].grad > 0) == (factor > 1)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("depth", 1.0, "no scored derivative"),
        ("absorption", [1.0, 2.0], "a tensor of one number"),
        ("medium.absorption", -1.0, "medium.absorption"),
    ],
)
def test_other_parameters_are_refused(name, value, words):
    with pytest.raises(spadwarp.SpadwarpError, match=words):
        spadwarp.inverse.render(plate(), {name: torch.tensor(value)}, photons=1000, seed=1, device="cpu")
    with pytest.raises(spadwarp.ArgumentError, match="tensor"):
        spadwarp.inverse.render(plate(), {"absorption": 0.1}, photons=1000, seed=1, device="cpu")
