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


@settings(max_examples=150)
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


section_values = {
    "medium": st.one_of(
        st.fixed_dictionaries({"extinction": st.floats(1e-3, 9), "albedo": st.floats(0, 1) | st.just("lu2024")}),
        st.fixed_dictionaries({"absorption": st.floats(1e-3, 9), "scattering": st.floats(0, 9)}),
        st.fixed_dictionaries({"preset": st.sampled_from(sorted(presets("medium")))}),
        st.fixed_dictionaries({"preset": st.just("uwoc-clear"), "scattering": st.floats(0, 9)}),
        st.fixed_dictionaries(
            {"preset": st.just("uwoc-clear"), "phase_function": st.just("two_term_henyey_greenstein")}
            | {"g1": st.floats(0, 0.99), "g2": st.floats(-0.9, 0), "alpha": st.floats(0, 1)}
        ),
    ),
    "laser": st.fixed_dictionaries(
        {"position": vector},
        optional={
            "preset": st.sampled_from(sorted(presets("laser"))),
            "pulse_energy": st.floats(1e-12, 1),
            "frame": st.sampled_from(["camera", "world"]),
        },
    ),
    "camera": st.one_of(
        st.just(CAMERA),
        st.fixed_dictionaries({"preset": st.just("lu2024")}, optional={"pixel_pitch_um": st.floats(1, 100)}),
        st.fixed_dictionaries(
            {"width": st.just(8), "height": st.just(6), "fx": st.floats(10, 50), "aperture_diameter": st.just(0.01)},
            optional={
                "fy": st.floats(10, 50),
                "cx": st.floats(-3, 9),
                "distortion": st.lists(st.floats(-0.01, 0.01), min_size=4, max_size=5),
                "focus_distance": st.sampled_from([0.5, math.inf]),
                "position": vector,
                "rotation_deg": vector,
            },
        ),
    ),
    "scan": st.fixed_dictionaries(
        {}, optional={"mode": st.sampled_from(["none", "confocal"]), "distance": st.sampled_from([3.0, math.inf])}
    ),
    "detector": st.fixed_dictionaries({}, optional={"wrap": st.booleans(), "irf": st.just('/a "b"\\c\x07\n.csv')}),
    "gate": st.fixed_dictionaries(
        {"start_ns": st.floats(0, 500), "bin_width_ps": st.floats(1, 1e4), "bins": st.just(10.0)}
    ),
    "targets": st.lists(
        st.fixed_dictionaries(
            {"builtin": st.text(min_size=1, max_size=9), "translation": vector},
            optional={
                "scale": st.floats(0.1, 9) | st.just([1, 2, 3]),
                "size": st.lists(st.just(2.5), min_size=1, max_size=3),
            },
        ),
        max_size=3,
    ),
    "domain": st.sampled_from(
        [{}, {"shape": "slab", "lower": 0, "upper": 3.5}, {"shape": "box", "lower": -1, "upper": [1, 2, 3]}]
    ),
    "transport": st.fixed_dictionaries(
        {},
        optional={
            "seed": st.integers(0, 2**64 - 1),
            "max_path": st.floats(1, 100) | st.none(),
            "lateral_limit": st.sampled_from([3.0, math.inf]),
        },
    ),
    "analytic": st.fixed_dictionaries({}, optional={"backscatter_fraction": st.floats(0, 1)}),
}


def reloaded(one: Scene) -> Scene:
    return Scene.from_dict(tomllib.loads(one.to_toml()))


@settings(max_examples=100)
@given(st.fixed_dictionaries(section_values))
def test_the_text_of_a_scene_reloads_to_an_equal_scene(tables):
    one = Scene.from_dict(tables)
    assert reloaded(one) == one
    assert hash(reloaded(one)) == hash(one)
    assert reloaded(one).to_toml() == one.to_toml()
    assert one.with_overrides(one.to_dict()) == one


def test_a_loaded_scene_survives_files_pickling_and_copying(tmp_path):
    (tmp_path / "meshes").mkdir()
    path = tmp_path / "meshes" / "scene.toml"
    path.write_text(scene(targets=[{"mesh": "bust.stl"}]).to_toml())
    one = load_scene(path)
    assert one.source == path
    assert one.targets[0].mesh == str(tmp_path / "meshes" / "bust.stl")
    other = tmp_path / "other.toml"
    other.write_text(one.to_toml())
    assert load_scene(other) == one
    again = pickle.loads(pickle.dumps(one))
    assert (again, again.source, again.medium.given) == (one, path, one.medium.given)
    assert one != one.with_overrides(["gate.bins=3"])


def test_relative_paths_start_at_the_file_and_those_of_overrides_at_the_working_directory(tmp_path, monkeypatch):
    path = tmp_path / "scene.toml"
    path.write_text(scene(targets=[{"mesh": "a.stl"}, {"mesh": "/b.stl"}], detector={"irf": "irf.csv"}).to_toml())
    monkeypatch.chdir("/")
    one = load_scene(path, ["targets[1].mesh=c.stl"])
    assert [target.mesh for target in one.targets] == [str(tmp_path / "a.stl"), "/c.stl"]
    assert one.detector.irf == str(tmp_path / "irf.csv")
    assert load_scene(path, {"targets": [{"mesh": "d.stl"}]}).targets[0].mesh == "/d.stl"


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
    assert load_scene(file).to_toml(folder=file.parent) == file.read_text()
    if written is not None and "linked" not in mesh:
        (tmp_path / "project").rename(tmp_path / "moved")
        moved = load_scene(tmp_path / "moved" / "run" / "scene.toml")
        assert all(path.is_relative_to(tmp_path / "moved") for path in moved.files)
        assert ".." not in str(moved.files[0])


def test_a_path_with_dots_and_one_without_are_one_scene(tmp_path):
    (tmp_path / "run").mkdir()
    text = Scene.from_dict({**MINIMAL, "targets": [{"mesh": "NAME"}]}).to_toml()
    (tmp_path / "a.toml").write_text(text.replace("NAME", "part.stl"))
    (tmp_path / "run" / "b.toml").write_text(text.replace("NAME", "../part.stl"))
    assert load_scene(tmp_path / "a.toml") == load_scene(tmp_path / "run" / "b.toml")
