"""The documentation: links lead somewhere, its references are current, figures can be drawn."""

import functools
import importlib.util
import re
import shlex
import tomllib

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import spadwarp
from helpers.coarse_pictures import coarse_pictures
from helpers.hostile import datasets
from helpers.pages import PAGES, README, ROOT, blocks, by_name, commands, prose, text_of
from helpers.scenes import scene as make_scene
from spadwarp.cli import app
from spadwarp.frames import InstrumentResponse, record_frames
from spadwarp.transport.records import save_records

DOCUMENTS = [
    path for place in ("", "docs/**/", "bench/**/", "kernels/", "spadwarp/**/") for path in ROOT.glob(f"{place}*.md")
]
FIGURES = sorted((ROOT / "docs" / "figures").glob("*.py"))


def anchors(page):
    """Anchors that the headings of a Markdown page get, code blocks left out, and those of its equations."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    named = re.findall(r'<a id="([\w-]+)"></a>', text_of(page))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}.union(named)


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_and_images_lead_somewhere(page):
    for link in re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", prose(page)) + re.findall(r'src="([^"]+)"', text_of(page)):
        if not re.match(r"[a-z]+:", link):
            name, _, anchor = link.partition("#")
            target = page.parent / name if name else page
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


def test_equations_have_one_number_and_an_anchor_each():
    """(P3) is the third equation of its page, and `physics.md#eq-p3` leads to it."""
    letters = {}
    for page in PAGES:
        text = text_of(page)
        numbers = re.findall(r"\\tag\{([A-Z])(\d+)\}", text)
        assert text.count("```math") == len(numbers), page.name
        for place, (letter, number) in enumerate(numbers, 1):
            assert letters.setdefault(letter, page) == page and int(number) == place, f"{page.name}: ({letter}{number})"
        anchored = re.findall(r'^ *<a id="eq-(\w+)"></a>\n\n *```math\n(?:.*\n)*?.*\\tag\{(\w+)\}', text, re.MULTILINE)
        assert [(first.upper(), second) for first, second in anchored] == [
            (letter + number,) * 2 for letter, number in numbers
        ]


@pytest.mark.parametrize("page", [*PAGES, README, ROOT / "CONTRIBUTING.md"], ids=by_name)
def test_links_have_titles_and_commands_fit_the_page(page):
    """A link shows a title, not a file of the documentation; a command of a page is read without scrolling. In the
    gallery, every picture has its commands."""
    text = text_of(page)
    assert not re.findall(r"\[`?[\w/]+\.md`?\]\(", text)
    assert not [line for _, code in blocks(page, "sh", "bash") for line in code.splitlines() if len(line) > 88]
    if page.name == "gallery.md":
        assert len(re.findall(r"^!\[[^\]]+\]\([^)]+\)\n\n```sh\n", text, re.MULTILINE)) == text.count("![") > 5


@functools.cache
def help_of(*command):
    return CliRunner().invoke(app, [*command, "--help"]).stdout


@pytest.mark.parametrize("page", [README, *PAGES], ids=by_name)
def test_commands_in_the_text_name_what_there_is(page):
    """Commands, options, configurations and scripts."""
    for line in commands(page):
        try:
            words = shlex.split(line)
        except ValueError:  # a quotation that goes on, in a job's script
            continue
        if words[:1] == ["python"] and words[1].startswith("kernels/examples/"):
            known = text_of(ROOT / words[1])
        elif "spadwarp" in words[:1] or words[-2:-1] == ["spadwarp"]:
            words = words[words.index("spadwarp") + 1 :]
            known = help_of(*words[:1]) + "--help"
        else:
            continue
        assert known, words
        for word in words:
            assert not word.startswith("--") or word.partition("=")[0] in known, words
            assert not re.match(r"configs/\S+\.toml", word) or (ROOT / word).is_file(), words


@pytest.mark.parametrize("page", [*PAGES, ROOT / "docs" / "reference" / "scene.md"], ids=by_name)
def test_scenes_in_the_text_are_valid(page, monkeypatch):
    """A block of TOML is a scene, or sections that lie over one."""
    monkeypatch.chdir(ROOT)
    for _, code in blocks(page, "toml") if page.name != "tutorial.md" else ():
        tables = tomllib.loads(code)
        if {"camera", "gate"} <= set(tables):
            spadwarp.Scene.from_dict(tables)
        else:
            spadwarp.load_scene("configs/scenes/plane_5m.toml", tables)


def test_reference_is_that_of_the_code():
    made = load(ROOT / "docs" / "reference.py").pages()
    old = [name for name, text in made.items() if (ROOT / "docs" / "reference" / name).read_text() != text]
    assert not old, f"docs/reference: {', '.join(old)} differ from the code: run `python docs/reference.py`"
    assert len(list((ROOT / "docs" / "reference").iterdir())) == len(made)
    assert "| `warm_up` | integer | [0, 1000000000000] | `500` | updates in which" in made["training.md"]


def test_every_image_is_shown_somewhere():
    shown = "".join(map(text_of, [*PAGES, README]))
    unused = [path.name for path in (ROOT / "docs" / "images").glob("*.png") if path.name not in shown]
    assert not unused


@pytest.mark.parametrize("path", FIGURES, ids=by_name)
def test_figure_scripts_import_and_say_how_to_run_them(path):
    module = load(path)
    assert callable(module.main)
    assert f"python docs/figures/{path.name}" in module.__doc__


@pytest.mark.slow
@pytest.mark.physics
def test_figure_of_a_capture_finds_its_own_model(tmp_path, monkeypatch):
    """Counts that the detector model drew: the response is found again, and the distributions of errors agree."""
    figure = load(ROOT / "docs" / "figures" / "measured.py")
    height, bins, width = 40, 120, 1e-10
    place = 6e-9 + 1e-9 * np.add.outer(np.arange(height), np.arange(height)) / height  # a slope
    response = InstrumentResponse(sigma=2e-10, tail=1e-10)
    edges = np.arange(bins + 1) * width
    expected = 12.0 * np.diff(response.cumulative(edges - place[..., None]), axis=-1) + 0.02
    counts = np.random.default_rng(3).poisson(expected)
    measured, simulated, fitted = figure.compare(counts, width, bins=bins, fwhm=6e-10)
    assert fitted.response.fwhm == pytest.approx(response.fwhm, rel=0.1)
    assert fitted.background == pytest.approx(0.02, rel=0.2)
    # Kolmogorov's distance of two samples of this size is below this in 999 of 1000 cases.
    assert figure.largest_difference(measured.errors, simulated.errors) < 1.95 * np.sqrt(2.0 / measured.errors.size)
    coarse_pictures(monkeypatch.setattr)
    figure.draw(measured, simulated, tmp_path / "measured.png")
    assert (tmp_path / "measured.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.filterwarnings("ignore:not enough photons")  # 2000 photons
def test_formats_page_names_everything_in_the_files(tmp_path):
    """Every dataset and attribute of a result with errors, of frames with tags, of analytic frames and of records."""
    scene = make_scene(transport={"photons": 2000, "seed": 1})
    result = spadwarp.simulate(scene, device="cpu")
    record_frames(result, tmp_path / "frames.h5", pulses=100, frames=1, seed=1, tags=True, device="cpu")
    save_records(
        spadwarp.transport.trace(make_scene(targets=[]), photons=10, device="cpu"), tmp_path / "records.h5", scene=scene
    )
    paths = [result.save(tmp_path / "result.h5"), tmp_path / "frames.h5", tmp_path / "records.h5"]
    paths.append(spadwarp.simulate_analytic(scene, frames=1, device="cpu").save(tmp_path / "analytic.h5"))
    text = text_of(ROOT / "docs" / "formats.md")
    for path in paths:
        with h5py.File(path) as file:
            names = [*file.attrs, *datasets(path)]
        missing = [name for name in names if f"`{name}`" not in text]
        assert not missing, f"{path.name}: docs/formats.md does not name {missing}"
