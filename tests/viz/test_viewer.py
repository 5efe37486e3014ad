"""The page of a run holds the run's numbers, alone, and shows them in a browser; the video shows when light arrives."""

import base64
import json
import re
import shutil
import sys
import zlib

import numpy as np
import pytest
from PIL import Image

import spadwarp
from helpers.headless import BROWSER, Browser
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import record_frames
from spadwarp.result.result import COMPONENTS
from spadwarp.scene.camera import pixel_directions
from spadwarp.values import FileError
from spadwarp.viz import viewer

pytest.importorskip("plotly")


@pytest.fixture(scope="module")
def result():
    return make_result(make_scene(width=16, height=12, bins=48, laser={"position": [0.3, 0.1, 0.0]}))


@pytest.fixture(scope="module")
def frames(result, tmp_path_factory):
    """A directory with frames of it, bright enough for some counts in every pixel."""
    out, methods = tmp_path_factory.mktemp("frames"), ("peak", "centroid")
    record_frames(result, out / "frames.h5", pulses=2_000_000, frames=2, seed=4, methods=methods, device="cpu")
    return out


@pytest.fixture(scope="module")
def page(result, tmp_path_factory):
    return spadwarp.viz.view(result, tmp_path_factory.mktemp("page") / "view.html", device="cpu")


def carried(page):
    """What the page's script reads."""
    return json.loads(re.search(r'type="application/json">(.*?)</script>', page.read_text(), re.DOTALL).group(1))


def unpacked(text, kind, shape):
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), kind).reshape(shape)


def shown(layer, shape):
    """Values of a layer as the script computes them, summed over blocks."""
    if layer["kind"] == "whole":
        return layer["factor"] * unpacked(layer["codes"], "<u2", shape).astype(float)
    codes = unpacked(layer["codes"], "u1", shape).astype(float)
    return np.where(codes > 0, layer["factor"] * layer["lowest"] * 10 ** ((codes - 1) * layer["decades"] / 254), 0.0)


def test_a_page_needs_nothing_but_itself(page):
    text = page.read_text()
    assert not re.search(r"<(script|link|img|iframe)[^>]*\b(src|href)=", text)
    assert "__" not in re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)


def test_a_page_holds_the_results_numbers(result, page):
    data = carried(page)
    shape = result.truth.depth.shape
    images = {name: unpacked(text, "<f4", shape) for name, text in data["images"].items()}
    np.testing.assert_array_equal(images["depth"], result.depth(device="cpu").astype(np.float32))
    np.testing.assert_array_equal(images["truth"], result.truth.depth)
    np.testing.assert_allclose(images["error"], result.depth(device="cpu") - result.truth.depth, atol=1e-6)
    np.testing.assert_allclose(images["intensity"], result.detections.sum(axis=2), rtol=1e-6)
    x, y, z = (unpacked(text, "<f4", shape) for text in data["cloud"])
    np.testing.assert_array_equal(z, images["depth"])
    rays = pixel_directions(result.scene.camera)
    for axis, values in enumerate((x, y)):
        np.testing.assert_allclose(values / z, rays[..., axis] / rays[..., 2], rtol=1e-5)
    arrival = unpacked(data["arrival"], "<f4", shape)
    np.testing.assert_allclose(arrival, 1e9 * result.true_path() / result.pulse_speed, rtol=1e-6)
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detector.pde
    for layer, name in zip(data["histograms"], COMPONENTS, strict=True):
        values, exact = shown(layer, (12, 16, 48)), result.component(name) * per_pulse
        bright = exact > 2e-7 * exact.max()
        np.testing.assert_allclose(values[bright], exact[bright], rtol=0.034)
        assert (values[exact == 0] == 0).all()
    np.testing.assert_allclose(data["edges"], 1e9 * result.bin_edges, atol=1e-5)
    assert (data["block"], data["merged"]) == (1, 1)


def test_histograms_that_are_too_large_are_merged_and_keep_their_sum(result, tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "HISTOGRAM_BYTES", 900)
    page = spadwarp.viz.view(result, tmp_path / "small.html", device="cpu")
    data = carried(page)
    block, merged = data["block"], data["merged"]
    assert block > 1 and merged > 1
    assert sum(len(layer["codes"]) for layer in data["histograms"]) <= 1200
    edges = data["edges"]
    shape = (-(-12 // block), -(-16 // block), len(edges) - 1)
    total = sum(shown(layer, shape).sum() for layer in data["histograms"])
    assert total == pytest.approx(result.detections.sum(), rel=0.01)
    assert edges[-1] == pytest.approx(1e9 * result.bin_edges[-1])


def test_a_page_of_frames_holds_counts_to_the_last(frames):
    import h5py

    page = spadwarp.viz.view(frames, frames / "view.html", frame=1)
    data = carried(page)
    with h5py.File(frames / "frames.h5") as file:
        counts, expected = file["counts"][1], file["expected"][...] * file.attrs["pulses"]
        depth = file["depth/centroid"][1]
    np.testing.assert_array_equal(shown(data["histograms"][0], counts.shape), counts)
    values = shown(data["histograms"][1], counts.shape)
    bright = expected > 2e-7 * expected.max()
    np.testing.assert_allclose(values[bright], expected[bright], rtol=0.034)
    np.testing.assert_array_equal(unpacked(data["images"]["depth"], "<f4", depth.shape), depth)
    for wrong, words in (({"frame": 2}, r"frame = 2 is outside \[0, 2"), ({"method": "likelihood"}, "peak, centroid")):
        with pytest.raises(ValueError, match=words):
            spadwarp.viz.view(frames, **wrong)


def test_a_page_needs_plotly(result, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(FileError, match=r"pip install 'spadwarp\[view\]'"):
        spadwarp.viz.view(result, tmp_path / "view.html")


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome")
def test_a_click_in_a_browser_shows_that_pixels_histogram(result, page, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.command("Page.navigate", url=f"{page.as_uri()}#2,3")
        browser.wait("document.body?.dataset.ready === 'yes'")
        assert browser.run("document.getElementById('pixel').textContent").startswith("row 2, column 3: ")
        position = browser.run(
            """(() => { const panel = document.getElementById("image-depth"); panel.scrollIntoView();
            const { left, top } = panel.getBoundingClientRect(), { xaxis, yaxis } = panel._fullLayout;
            return [left + xaxis._offset + xaxis.l2p(10), top + yaxis._offset + yaxis.l2p(7)]; })()"""
        )
        browser.click(*position)
        browser.wait("document.getElementById('pixel').textContent.startsWith('row 7, column 10: ')", seconds=20)
        assert browser.run("location.hash") == "#7,10"
        per_pulse = result.scene.laser.photons_per_pulse * result.scene.detector.pde
        width = result.scene.gate.bin_width * 1e9
        for index, name in enumerate(COMPONENTS):  # bins that are added up keep their light
            time, drawn = (
                np.array(browser.run(f"Array.from(document.getElementById('histogram').data[{index}].{axis})"))
                for axis in "xy"
            )
            light = (np.diff(time) * drawn[:-1]).sum() / width
            np.testing.assert_allclose(light, result.component(name)[7, 10].sum() * per_pulse, rtol=0.02)
        browser.run("document.getElementById('merge').click()")
        for index, name in enumerate(COMPONENTS):
            drawn = np.array(browser.run(f"Array.from(document.getElementById('histogram').data[{index}].y)"))
            exact = result.component(name)[7, 10] * per_pulse
            bright = exact > 1e-6 * exact.max()
            np.testing.assert_allclose(drawn[:-1][bright], exact[bright], rtol=0.034)
        on_target, reported = np.isfinite(result.truth.depth), np.isfinite(result.depth())
        points = browser.run("document.getElementById('cloud').data.map((trace) => trace.x.length)")
        assert [points[0], points[2]] == [np.sum(reported & on_target), np.sum(reported & ~on_target)]
        # Ticks of the range axis are where light of that range arrives: r + |r u - p| over the speed.
        ticks = browser.run(
            "(({ tickvals, ticktext }) => tickvals.map((time, k) => [time, Number(ticktext[k])]))"
            "(document.getElementById('histogram').layout.xaxis2)"
        )
        u = pixel_directions(result.scene.camera)[7, 10]
        for time, distance in ticks:
            path = distance + np.linalg.norm(distance * u - np.array(result.scene.laser.position))
            assert time == pytest.approx(1e9 * path / result.pulse_speed, rel=1e-5)
        assert len(ticks) >= 3
    finally:
        browser.close()


# Video


@pytest.mark.slow
def test_a_video_is_bright_when_the_target_returns_light(result, tmp_path):
    path = spadwarp.viz.video(result, tmp_path / "light.gif", scale="linear", fps=10)
    filled = np.flatnonzero(result.detections.any(axis=(0, 1)))
    brightness, durations = [], []
    with Image.open(path) as images:
        for index in range(images.n_frames):
            images.seek(index)
            durations.append(images.info["duration"])
            # Equal pictures in a row are stored once, with a longer duration.
            brightness += [np.asarray(images.convert("L"), float)[40:-150].mean()] * round(durations[-1] / 100)
    assert sum(durations) == 100 * (filled[-1] - filled[0] + 1)
    assert int(np.argmax(brightness)) == int(result.detections.sum(axis=(0, 1))[filled[0] :].argmax())


def test_pictures_are_merged_and_windows_cut(result, frames, tmp_path):
    edges = 1e9 * result.bin_edges
    path = spadwarp.viz.video(frames, tmp_path / "some.gif", window_ns=(edges[10] + 0.01, edges[30] - 0.01), pictures=5)
    with Image.open(path) as images:
        assert images.n_frames == 5
    for wrong, message in (
        ({"window_ns": (1.0, 2.0)}, "is not in the gate"),
        ({"pictures": 0}, "pictures = 0"),
        ({"fps": 0}, "fps = 0"),
        ({"frame": 5}, r"frame = 5 is outside"),
        ({"path": tmp_path / "x.avi"}, "ends neither in .gif nor in .mp4"),
    ):
        with pytest.raises(ValueError, match=message):
            spadwarp.viz.video(frames, **{"path": tmp_path / "x.gif", **wrong})


def test_an_mp4_is_written_or_the_error_names_what_is_missing(result, tmp_path, monkeypatch):
    try:
        path = spadwarp.viz.video(result, tmp_path / "light.mp4", pictures=8)
        assert path.read_bytes()[4:8] == b"ftyp"
    except FileError as error:
        assert "pip install 'spadwarp[video]'" in str(error)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(FileError, match=r"an MP4 needs ffmpeg: pip install 'spadwarp\[video\]', or write a \.gif"):
        spadwarp.viz.video(result, tmp_path / "none.mp4", pictures=2)
    assert not (tmp_path / "none.mp4").exists()


def test_a_page_is_never_written_over_its_source(tmp_path):
    path, link = make_result(make_scene(width=4, height=4, bins=8)).save(tmp_path / "result.h5"), tmp_path / "link"
    before = path.read_bytes()
    link.symlink_to(path)
    for source, page in ((path, path), (tmp_path, path), (str(link), str(path)), (path, link)):
        with pytest.raises(spadwarp.FileError, match="is not replaced"):
            spadwarp.viz.view(source, page)
    assert path.read_bytes() == before
