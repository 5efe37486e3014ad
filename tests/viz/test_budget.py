"""Pictures of budgets and sweeps."""

import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.viz import draw_budget, draw_sweep

SCENE = scene(
    medium={"extinction": 0.3, "albedo": 0.7},
    laser={"half_angle_deg": 10.0, "position": [0.0, 0.0, 0.0]},
    camera={"width": 8, "height": 8, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01},
    gate={"start_ns": 5.0, "bin_width_ps": 50.0, "bins": 400},
)


@pytest.mark.slow
def test_pictures_are_written_whole(tmp_path):
    rows = spadwarp.budget(SCENE, ranges=[1, 3, 9], media=["uwoc-clear", "uwoc-harbour"])
    figure = draw_budget(rows, tmp_path / "budget.png")
    assert len(figure.axes) == 4
    assert [text.get_text() for text in figure.axes[0].get_xticklabels()] == ["1", "3", "9"]
    assert sorted(text.get_text() for text in figure.legends[0].get_texts()) == [
        "not reached: over 1 % false peaks",
        "uwoc-clear, c = 0.149 1/m",
        "uwoc-harbour, c = 2.17 1/m",
    ]
    for of in ("budget", "depth-error"):
        figure = draw_sweep(spadwarp.sweep(SCENE, vary="medium.extinction=0.1:2:3", of=of), tmp_path / f"{of}.pdf")
        assert all(axis.get_xlabel() == "medium.extinction [1/m]" for axis in figure.axes)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["budget.pdf", "budget.png", "depth-error.pdf"]
    assert (tmp_path / "budget.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "budget.pdf").read_bytes().startswith(b"%PDF")
