"""Kernels of transport are loaded once: the one that the launches take."""

from types import SimpleNamespace

import pytest

import spadwarp_kernels as sk
from spadwarp_kernels.transport import launch

LARGE = 64 * 64 * 2048  # voxels of a component, 67 MB


@pytest.fixture
def made(monkeypatch):
    """Whether the kernels that are loaded keep low words apart; none is compiled."""
    choices = []

    def make(spec, cuda, split_accumulators):
        choices.append(split_accumulators)
        return SimpleNamespace(module=SimpleNamespace(load=lambda device, block: None))

    monkeypatch.setattr(launch, "make_transport_kernel", make)
    return choices


@pytest.mark.parametrize("split_accumulators", [False, True])
def test_one_kernel_is_loaded(made, monkeypatch, split_accumulators):
    monkeypatch.setattr(
        launch, "splits_accumulators", lambda spec, model, photon_count: split_accumulators and photon_count == 20
    )
    monkeypatch.setattr(launch, "check_kind", lambda name, value, kind: None)
    sk.load_transport_kernel(sk.TransportSpec("next_event"), "cpu", model=object(), photon_count=20)
    assert made == [split_accumulators]


def test_small_launches_after_a_large_one_take_its_kernel():
    """A run whose last launch is small needs no second kernel."""
    device = SimpleNamespace(is_cuda=True, is_capturing=True)
    model = SimpleNamespace(split_accumulators=True, device=device, tally_size=3 * LARGE)
    spec, words = sk.TransportSpec("next_event"), object()
    assert launch._split_accumulators(spec, model, SimpleNamespace(split_accumulators=None), 1) is None
    assert launch._split_accumulators(spec, model, SimpleNamespace(split_accumulators=words), 1) is words
    model.split_accumulators = False
    assert launch._split_accumulators(spec, model, SimpleNamespace(split_accumulators=words), 1) is None
