"""What goes in comes out: scenes through text, files and pickles; older words; any tables."""

import math
import pickle
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.minimal_scene import CAMERA, MINIMAL, scene
from spadwarp.scene import Scene, load_scene, presets
from spadwarp.values import ConfigError

SCENES = sorted((Path(__file__).parents[2] / "configs" / "scenes").glob("*.toml"))


def test_none_takes_a_field_back_to_its_default():
    base = scene(transport={"max_path": 10.0, "photons": 5})
    back = base.with_overrides({"transport": {"max_path": None, "photons": None}})
    assert back == scene()
    paper = scene(detector={"preset": "lu2024"}).with_overrides({"detector.pdp": None})
    assert (paper.detector.pdp, paper.detector.preset) == (0.247, None)
    assert reloaded(paper) == paper


def test_dotted_nested_and_keyword_overrides_say_the_same():
    base = scene()
    one = base.with_overrides(["medium.extinction=0.9", "gate.bins=7"])
    assert one == base.with_overrides({"medium.extinction": 0.9, "gate.bins": 7})
    assert one == base.with_overrides({"medium": {"extinction": 0.9}, "gate": {"bins": 7}})
    assert one == base.with_overrides(medium={"extinction": 0.9}, gate={"bins": 7})
    assert base == scene()


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["preset", "width", "0", "x"]), inner),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=100)
@given(
    st.dictionaries(st.sampled_from([*Scene.model_fields, "x"]), json_like, max_size=4),
    st.dictionaries(st.sampled_from([*Scene.model_fields, "gate.bins", "targets[0].scale"]), json_like, max_size=3),
)
def test_any_tables_are_a_scene_or_a_config_error(tables, overrides):
    try:
        Scene.from_dict({**MINIMAL, **tables}).with_overrides(overrides)
    except ConfigError as error:
        assert error.problems


vector = st.tuples(*[st.floats(-100, 100)] * 3)


def some(optional=None, **fields):
    """Tables with these fields, and some of the optional ones; what is no strategy is itself."""

    def strategies(table):
        return {name: value if isinstance(value, st.SearchStrategy) else st.just(value) for name, value in table}

    return st.fixed_dictionaries(strategies(fields.items()), optional=strategies((optional or {}).items()))


TWO_TERM = {"phase_function": "two_term_henyey_greenstein"}
GRID = {"shape": "cloud", "size": [1.0, 2.0, 1.5], "extinction": 2.0, "translation": [0.0, 0.0, 1.2]}
LENS = {"width": 8, "height": 6, "fx": st.floats(10, 50), "aperture_diameter": 0.01}
section_values = {
    "medium": st.one_of(
        some(extinction=st.floats(1e-3, 9), albedo=st.floats(0, 1) | st.just("lu2024")),
        some({"grid": some({"turbulence": st.floats(0.1, 1), "seed": st.integers(0, 9)}, **GRID)}, **MINIMAL["medium"]),
        some(absorption=st.floats(1e-3, 9), scattering=st.floats(0, 9)),
        some({"group_index": 1.36, "salinity": st.floats(0, 40)}, chlorophyll=st.floats(0, 9)),
        some({"salinity": 20.0, "temperature": 5.0}, preset=st.sampled_from(sorted(presets("medium")))),
        some(preset="uwoc-clear", scattering=st.floats(0, 9)),
        some(preset="uwoc-clear", **TWO_TERM, g1=st.floats(0, 0.99), g2=st.floats(-0.9, 0), alpha=st.floats(0, 1)),
    ),
    "laser": some(
        {"preset": st.sampled_from(sorted(presets("laser"))), "pulse_energy": st.floats(1e-12, 1)},
        position=vector,
        frame=st.sampled_from(["camera", "world"]),
    )
    | some(average_power=st.floats(1e-3, 1)),
    "camera": st.one_of(
        st.just(CAMERA),
        some({"pixel_pitch_um": st.floats(1, 100)}, preset="lu2024"),
        some(
            {
                "fy": st.floats(10, 50),
                "cx": st.floats(-3, 9),
                "distortion": st.lists(st.floats(-0.01, 0.01), min_size=4, max_size=5),
                "focus_distance": st.sampled_from([0.5, math.inf]),
                "position": vector,
                "rotation_deg": vector,
            },
            **LENS,
        ),
    ),
    "scan": some({"mode": st.sampled_from(["none", "confocal"]), "distance": st.sampled_from([3.0, math.inf])}),
    "detector": some({"wrap": st.booleans(), "irf": '/a "b"\\c\x07\n.csv', "filter_fwhm_nm": st.floats(1, 9)}),
    "gate": some(start_ns=st.floats(0, 500), bin_width_ps=st.floats(1, 1e4), bins=10.0),
    "targets": st.lists(
        some(
            {"scale": st.floats(0.1, 9) | st.just([1, 2, 3]), "size": st.lists(st.just(2.5), min_size=1, max_size=3)},
            builtin=st.text(min_size=1, max_size=9),
            translation=vector,
        ),
        max_size=3,
    ),
    "domain": some() | some(shape="slab", lower=0, upper=3.5) | some(shape="box", lower=-1, upper=[1, 2, 3]),
    "transport": some(
        {"max_path": st.floats(1, 100) | st.none(), "lateral_limit": st.sampled_from([3.0, math.inf])},
        seed=st.integers(0, 2**64 - 1),
    ),
    "analytic": some({"backscatter_fraction": st.floats(0, 1)}),
}


def reloaded(one: Scene) -> Scene:
    return Scene.from_dict(tomllib.loads(one.to_toml()))


@settings(max_examples=12)
@given(st.fixed_dictionaries(section_values))
def test_the_text_of_a_scene_reloads_to_an_equal_scene(tables):
    one = Scene.from_dict(tables)
    assert reloaded(one) == one
    assert hash(reloaded(one)) == hash(one)
    assert reloaded(one).to_toml() == one.to_toml()
    assert one.with_overrides(one.to_dict()) == one


def test_a_loaded_scene_keeps_its_files_and_survives_pickling(tmp_path, monkeypatch):
    """Relative paths start at the scene's file, those of overrides at the working directory."""
    path = tmp_path / "scene.toml"
    path.write_text(scene(targets=[{"mesh": "a.stl"}, {"mesh": "/b.stl"}], detector={"irf": "irf.csv"}).to_toml())
    monkeypatch.chdir("/")
    one = load_scene(path, ["targets[1].mesh=c.stl"])
    assert one.source == path and one.detector.irf == str(tmp_path / "irf.csv")
    assert [target.mesh for target in one.targets] == [str(tmp_path / "a.stl"), "/c.stl"]
    assert load_scene(path, {"targets": [{"mesh": "d.stl"}]}).targets[0].mesh == "/d.stl"
    again = pickle.loads(pickle.dumps(one))
    assert (again, again.source, again.medium.given) == (one, path, one.medium.given)
    assert one != one.with_overrides(["gate.bins=3"])


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_shipped_scene_loads_and_reloads(path):
    one = load_scene(path)
    assert reloaded(one) == one


@pytest.mark.parametrize(
    ("mesh", "written"),
    [
        ("project/run/part.stl", "part.stl"),
        ("project/part.stl", "../part.stl"),
        ("project/run/../meshes/part.stl", "../meshes/part.stl"),
        ("elsewhere/part.stl", None),
        ("project/linked/part.stl", "../linked/part.stl"),
    ],
)
def test_files_beside_a_scene_file_move_with_it(mesh, written, tmp_path):
    for name in ("project/run", "project/meshes", "elsewhere"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "project" / "linked").symlink_to(tmp_path / "elsewhere")
    place = tmp_path / mesh
    place.write_bytes(b"")
    made = scene(targets=[{"mesh": str(place)}], detector={"irf": str(place.with_suffix(".csv"))})
    file = tmp_path / "project" / "run" / "scene.toml"
    file.write_text(made.to_toml(folder=file.parent))
    assert tomllib.loads(file.read_text())["targets"][0]["mesh"] == (written or str(place))
    back = load_scene(file)
    assert [Path(name).resolve() for name in back.files] == [Path(name).resolve() for name in made.files]
    file_text = file.read_text()
    assert load_scene(file).to_toml(folder=file.parent) == file_text
    if written is not None and "linked" not in mesh:
        (tmp_path / "project").rename(tmp_path / "moved")
        moved = load_scene(tmp_path / "moved" / "run" / "scene.toml")
        assert all(path.is_relative_to(tmp_path / "moved") for path in moved.files)
        assert ".." not in str(moved.files[0])
        (tmp_path / "moved" / "run" / "scene.toml").write_text(file_text.replace(written, f"../run/{written}"))
        assert load_scene(tmp_path / "moved" / "run" / "scene.toml") == moved
