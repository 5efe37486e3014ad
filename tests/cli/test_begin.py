"""First steps: a scene to start from, examples by name, JSON Schema for editors, help by stage of work."""

import functools
import json
import re
import tomllib
from pathlib import Path

import pytest
import typer.main

import spadwarp
from helpers.cli import DEVICE, ROOT, run, tables
from helpers.scenes import scene as make_scene
from spadwarp.cli import app
from spadwarp.cli.app import STAGES
from spadwarp.files import json_schema


def test_init_writes_a_scene_that_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    printed = run("init", "mine").stdout
    assert "written: mine.toml" in printed and "--out mine/" in printed
    text = Path("mine.toml").read_text()
    assert "spadwarp plan mine.toml" in text and text.count("mine.toml") == 3 and "scene.toml" not in text
    scene = spadwarp.load_scene("mine.toml")
    assert [str(one) for one in spadwarp.check(scene) if one.level == "warning"] == []
    assert "mine.toml exists; --overwrite" in run("init", "mine", code=2).stderr
    for name in ("-", "folder/-x.toml"):  # no command would take it as a file
        assert "begins as an option does" in run("init", "--", name, code=2).stderr
    run("init", "mine", "--example", "harbour_5m", "--overwrite")
    assert spadwarp.load_scene("mine.toml") == spadwarp.load_scene("harbour_5m")
    printed = run("init", "--schema", "scene").stdout
    assert "#:schema ./scene.schema.json" in printed and "even-better-toml" in printed
    assert tables("scene.schema.json") == json.loads(json.dumps(json_schema(spadwarp.Scene)))


def test_every_choice_in_the_template_is_valid():
    """A commented field, taken alone, makes a valid scene or displaces the ones that it stands for; so does a commented
    section with all its fields."""
    text = spadwarp.scene.template()
    section, taken = "", 0
    whole = re.sub(r"^# (?=\[|sun_|depth )", "", text, flags=re.MULTILINE)
    assert spadwarp.Scene.from_dict(tomllib.loads(whole)).daylight.depth == 20.0
    for line in re.sub(r"^# \[(?:.*\n)+?\n", "", text, flags=re.MULTILINE).splitlines():
        section = line.split("]")[0].strip("[") if line.startswith("[") else section
        if line.startswith("# ") and " = " in line and section:
            fields = tomllib.loads(line[2:])
            if section == "medium":
                fields = fields | ({"albedo": 0.7} if "extinction" in fields else {})
            key = "targets[0]" if section == "targets" else section
            spadwarp.Scene.from_dict(tomllib.loads(text)).with_overrides({key: fields})
            taken += 1
    assert taken >= 4


def test_examples_go_by_name(tmp_path, monkeypatch):
    """Unless a file has that name."""
    monkeypatch.chdir(tmp_path)
    printed = run("list", "--json", "printed.json").stdout
    known = tables("printed.json")
    assert {path.stem for path in (ROOT / "configs" / "scenes").glob("*.toml")} == set(known["scenes"])
    assert all(name in printed for names in known.values() for name in names)
    assert run("list", "scenes", "plane_5m", "--json", "one.json").stdout.startswith("# A grey wall")
    assert tables("one.json") == {"scenes": {"plane_5m": known["scenes"]["plane_5m"]}}
    assert spadwarp.load_scene("plane_5m") == spadwarp.load_scene(ROOT / "configs" / "scenes" / "plane_5m.toml")
    assert spadwarp.dataset.load_recipe("small").name == "spadwarp small"
    assert spadwarp.denoise.load_training_recipe("usdn").model == "usdn"
    small = ("--set", "camera.width=4", "--set", "camera.height=4", "--set", "output.png=false", "--photons", 1000)
    run("simulate", "plane_5m", "--out", "out", *small, *DEVICE)
    Path("plane_5m").write_text(make_scene().to_toml())
    assert spadwarp.load_scene("plane_5m") == make_scene()


# JSON Schema


MODELS = {"scenes": spadwarp.Scene, "datasets": spadwarp.dataset.Recipe, "training": spadwarp.denoise.TrainingRecipe}


@functools.cache
def validator(kind):
    schema = json.loads(json.dumps(json_schema(MODELS[kind]), allow_nan=False))
    import jsonschema  # takes seconds

    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("kind", MODELS)
def test_all_configurations_fit_their_schema_which_describes_every_field(kind):
    texts = [path.read_text() for path in (ROOT / "configs" / kind).glob("*.toml")]
    texts += [spadwarp.scene.template(), make_scene().to_toml()] if kind == "scenes" else []
    assert texts
    for text in texts:
        validator(kind).validate(tomllib.loads(text))
    for table in json_schema(MODELS[kind])["$defs"].values():
        for name, field in table.get("properties", {}).items():
            assert field.get("description"), (kind, name)


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        ('laser.pulse_energy = "150 nJ"', True),
        ('targets = [{builtin = "staircase", translation = [0, "20 cm", 5], scale = 0.5}]', True),
        ('medium = {preset = "uwoc-clear", group_index = "fresh"}', True),
        ('medium = {extinction = 1.0, albedo = "lu2024"}', True),
        ("domain = {shape = 'slab', lower = -1.0}", True),
        ("camera.focus_distance = inf", True),
        ("medium.layers = [{start = 1.0, preset = 'uwoc-clear'}]", True),
        ("laser.pulse_energy = -1.0", False),
        ("laser.puls_energy = 1.0", False),
        ('laser.pulse_energy = "many"', False),
        ('medium.preset = "uwoc-cleer"', False),
        ('targets = [{builtin = "stairs"}]', False),
        ('transport.estimator = "guess"', False),
        ("gate.bins = 1.5", False),
    ],
)
def test_a_schema_takes_what_a_scene_takes(text, fits):
    assert validator("scenes").is_valid(tomllib.loads(text)) is fits


def test_help_shows_every_command_once_by_stage_with_an_example_and_all_its_options():
    assert run("--version").stdout == f"spadwarp {spadwarp.__version__}\n"
    commands = typer.main.get_command(app).commands
    assert sorted(name for names in STAGES.values() for name in names) == sorted(commands)
    printed = run("--help").stdout
    assert printed.count("...") == 1 and all(f"\n{stage}:\n" in printed for stage in STAGES)
    for name, command in commands.items():
        assert f"{name} {command.get_short_help_str(limit=200)}" in " ".join(printed.split())
        assert f"spadwarp {name}" in run(name, "--help").stdout.split("Example", 1)[1]
        for option in command.params:
            assert option.name == "help" or option.help, (name, option.name)
