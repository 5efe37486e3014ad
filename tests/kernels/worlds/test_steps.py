"""Steps of both cameras, which stay on the device and can be captured."""

import io

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.worlds import SMALL, STILL, garden, transforms

pytestmark = pytest.mark.parametrize("kind", ["camera", "tracer"])


def small_step(kind, device):
    """A camera, the bodies that it sees, and its step."""
    (shapes, bodies), poses, config = garden(device), transforms([STILL] * 2, device), sk.SpadConfig(**SMALL)
    if kind == "tracer":
        camera = sk.SpadTracer(shapes, config, 2, photons=20_000, frame="optical")
        return camera, bodies, lambda: camera.update(poses, bodies)
    camera = sk.SpadCamera(config, 2, frame="optical", device=device)
    points = wp.empty((2, 12, 16), dtype=wp.vec3, device=device)

    def step():
        camera.update(shapes, poses, bodies)
        camera.point_cloud(points)

    return camera, bodies, step


def test_a_step_stays_on_the_device(kind, device, monkeypatch):
    """No allocation, and nothing read by the host."""
    camera, _, step = small_step(kind, device)
    step()

    def refuse(*_, **__):
        raise AssertionError("read by the host")

    part = wp.array.__getitem__

    def view(array, key):
        return part(array, key) if array.ndim > 1 or isinstance(key, slice) else refuse()

    monkeypatch.setattr(wp.array, "__getitem__", view)
    for name in ("numpy", "list"):
        monkeypatch.setattr(wp.array, name, refuse)
    for name in ("synchronize", "synchronize_device", "synchronize_stream"):
        monkeypatch.setattr(wp, name, refuse)
    with wp.ScopedMemoryTracker("step", print=False) as tracker:
        step()
        report = io.StringIO()
        tracker.report(file=report)
    monkeypatch.undo()
    assert "step" not in report.getvalue().replace("Scope: step", ""), report.getvalue()
    assert camera.step.numpy()[0] == 2
    if kind == "tracer":
        assert camera.data.offset.numpy()[0] == 2 * 2 * 20_000


def test_a_captured_step_is_the_step(kind, device):
    """Replays of a graph move bodies, draw new frames and trace new photons as calls do."""
    (camera, bodies, step), (other, other_bodies, other_step) = small_step(kind, device), small_step(kind, device)
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
        for name in ("rates", "histogram", "counts", "depth", "true_depth", "step"):
            mine, theirs = getattr(camera, name).numpy(), getattr(other, name).numpy()
            assert np.array_equal(mine, theirs, equal_nan=mine.dtype.kind == "f"), name
        seen.append(camera.histogram.numpy().copy())
    assert not np.array_equal(seen[0], seen[1])
    if kind == "tracer":
        camera.rebuild()  # the tree is another, the light is not
        other_step()
        step()
        assert camera.rates.numpy().sum() == pytest.approx(other.rates.numpy().sum(), rel=1e-3)
