"""Notebooks: short names, pictures with numbers, labelled arrays, tables."""

import dataclasses
import math
import sys
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

import spadwarp
from helpers.coarse_pictures import coarse_pictures
from helpers.scenes import scene as make_scene

SCENE = make_scene(gate={"start_ns": 0.0, "bin_width_ps": 400.0, "bins": 64})


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    coarse_pictures(monkeypatch.setattr)


@pytest.fixture(scope="module")
def result():
    return spadwarp.simulate(SCENE, photons=20_000, device="cpu")


@pytest.fixture(scope="module")
def frames(result):
    few = dataclasses.replace(result, second_moment=None, batch_size=0)  # whose noise is nobody's business here
    return spadwarp.detect(few, pulses=500, frames=3, seed=2, device="cpu")


@pytest.fixture(scope="module")
def analytic():
    return spadwarp.simulate_analytic(SCENE, frames=2, seed=1, device="cpu")


@pytest.fixture(
    params=["scene", "result", *(pytest.param(one, marks=pytest.mark.slow) for one in ("frames", "analytic"))]
)
def shown(request):
    return SCENE if request.param == "scene" else request.getfixturevalue(request.param)


def test_names_are_short_and_pages_have_numbers_and_a_picture(shown):
    text, page, figure = repr(shown), shown._repr_html_(), shown.plot()
    assert len(text) < 160 and text.startswith(f"{type(shown).__name__}(") and "4 x 4 pixels" in text
    assert str(shown) == text
    assert page.count("<tr>") >= 5 and "data:image/png;base64," in page and len(page) < 200_000
    assert isinstance(figure, Figure) and figure._repr_png_().startswith(b"\x89PNG")


def test_each_kind_of_picture_of_a_result(result, frames):
    titles = {kind: result.plot(kind).axes[0].get_title() for kind in ("depth", "intensity", "histogram", "truth")}
    assert len(set(titles.values())) == 4
    assert "peak" in result.plot("depth", method="peak").axes[0].get_title()
    with pytest.raises(spadwarp.ArgumentError, match="kind = 'film' is not one of 'depth'"):
        result.plot("film")
    with pytest.raises(spadwarp.ArgumentError, match=r"frame = 3 is outside \[0, 3\)"):
        frames.plot(3)


def test_a_scene_whose_mesh_is_missing_still_has_numbers_and_its_text_is_escaped():
    page = make_scene(targets=[{"mesh": "<b>.stl"}])._repr_html_()
    assert "no such file" in page and "extinction" in page and "<img" not in page
    assert "<b>.stl" not in page and "&lt;b&gt;.stl" in page


@pytest.mark.slow
def test_a_proposal_is_a_table():
    proposal = spadwarp.plan(SCENE, photons=20_000, largest_range=False, device="cpu")
    assert len(repr(proposal)) < 160
    page = proposal._repr_html_()
    assert "gate.start_ns" in page and "forward scattering" in page and proposal.limit in page


def test_a_bar_on_a_terminal_counts_to_the_end(capsys):
    spadwarp.simulate(SCENE, photons=20_000, device="cpu", progress=spadwarp.viz.progress_bar())
    text = capsys.readouterr().err
    assert "loading kernels" in text and "100 %  20 000 of 20 000 photons" in text and text.endswith("\n")


def test_a_bar_in_a_notebook_is_one_that_changes(monkeypatch):
    display = pytest.importorskip("IPython.display")
    shown = []
    handle = SimpleNamespace(update=lambda html: shown.append(html.data))
    monkeypatch.setattr(display, "display", lambda html, display_id: shown.append(html.data) or handle)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=True)))
    bar = spadwarp.viz.progress_bar("frames")
    for stage, done, total in (("compile", 0, 0), ("<note>", 0, 0), ("frames", 1, 4), ("frames", 4, 4)):
        bar(stage, done, total)
    assert [text.split("</progress> ")[1] for text in shown][1:] == [
        "&lt;note&gt;",
        " 25 %  1 of 4 frames",
        "100 %  4 of 4 frames",
    ]


# xarray


def test_a_result_as_labelled_arrays(result, tmp_path):
    data = result.to_xarray()
    data.to_netcdf(tmp_path / "result.nc", engine="scipy")
    assert dict(data.sizes) == {"component": 3, "y": 4, "x": 4, "time": 64, "axis": 3}
    assert np.array_equal(data.histogram.sel(component="backscatter"), result.component("backscatter"))
    assert np.allclose(data.histogram.sum("component"), result.histogram, rtol=1e-12)
    assert np.array_equal(data.standard_error, result.standard_error)
    assert data.time.attrs["units"] == "s" and data.depth.attrs["units"] == "m"
    assert np.allclose(data.path, data.time * result.pulse_speed)
    nearest = data.histogram.sum(("component", "x", "y")).sel(time=9e-9, method="nearest")
    assert nearest.time == result.bin_centres[np.abs(result.bin_centres - 9e-9).argmin()]
    assert spadwarp.Scene.from_dict(tomllib.loads(data.attrs["scene"])) == result.scene


def test_frames_and_maps_as_labelled_arrays(frames, analytic):
    data = frames.to_xarray()
    assert np.array_equal(data.counts, frames.counts) and data.counts.dims == ("frame", "y", "x", "time")
    assert data.attrs["pulses"] == 500 and math.isclose(float(data.bin_width.sum()), 64 * 400e-12)
    maps = analytic.to_xarray()
    assert np.array_equal(maps.sigma_depth, analytic.sigma_depth, equal_nan=True)
    assert maps.sigma_depth.attrs["units"] == "m" and maps.depth.dims == ("frame", "y", "x")


# Data frames


def test_tables_as_data_frames():
    rows = spadwarp.budget(SCENE, [1.0, 2.0])
    table = spadwarp.to_pandas(rows)
    assert list(table.range) == [1.0, 2.0] and "sigma_depth" in table.columns
    curves = spadwarp.sweep(SCENE, vary="medium.extinction=0.1:0.3:3", device="cpu")
    swept = spadwarp.to_pandas(curves)
    assert swept.index.name == "medium.extinction" and list(swept.index) == pytest.approx([0.1, 0.2, 0.3])
    assert np.array_equal(swept.signal, curves.column("signal"))
    assert spadwarp.to_pandas(spadwarp.scene.presets("medium")).name[0] == "petzold-autec-8"
    with pytest.raises(spadwarp.ArgumentError, match="data classes or dicts"):
        spadwarp.to_pandas([1, 2])
