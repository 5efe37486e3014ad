"""Manifests and records of shards that are not as they should be: an error that names file and entry."""

import json
import shutil

import pytest

import spadwarp
from helpers.cli import run
from helpers.datasets import make, recipe
from spadwarp.dataset import FrameReader, read_manifest, verify_dataset
from spadwarp.values import FileError

SMALL = {"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 1, "scenes_per_target": 1}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "data"
    make(recipe(**SMALL), folder)
    return folder


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "data")


def changed(manifest, path, value):
    """The manifest with another value at a path such as "splits.train.frames"; `...` removes it."""
    *outer, last = path.split(".")
    table = manifest
    for name in outer:
        table = table[name]
    if value is ...:
        del table[last]
    else:
        table[last] = value
    return manifest


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("splits", ...),
        ("splits", []),
        ("splits.train", ...),
        ("splits.test.shards", ["../../../etc/passwd"]),
        ("splits.test.shards", ["/etc/passwd"]),
        ("splits.test.frames", -1),
        ("targets", "staircase"),
        ("height", 10**9),
        ("width", None),
        ("depth_step", float("inf")),
        ("files", {"../secret": {"bytes": 3, "sha256": "0" * 64}}),
        ("files", {"frames-00000.h5": {"bytes": 3}}),
        ("format_version", "one"),
        ("format_version", 99),
        ("format", "another"),
    ],
)
def test_a_manifest_that_is_not_whole_is_refused(path, value, folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(changed(manifest, path, value)))
    with pytest.raises(FileError, match=r"manifest\.json: ") as caught:
        read_manifest(folder)
    name = path.split(".")[-1]
    assert name in str(caught.value) or name.startswith("format")
    for read in (FrameReader, verify_dataset):
        with pytest.raises(FileError, match=r"manifest\.json: "):
            read(folder)


@pytest.mark.parametrize(
    "text", ["[]", "3", "null", '"text"', "{", "", "[" * 100_000, '{"a": ' * 10_000, "\xff", "NaN"]
)
def test_a_manifest_that_is_no_table_is_refused(text, folder):
    (folder / "manifest.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(FileError, match=r"manifest\.json: "):
        read_manifest(folder)
    for words in (("info", folder), ("info", folder, "--verify"), ("view", folder, "--out", folder / "x.png")):
        assert "manifest.json" in run(*words, code=1).stderr


def test_a_target_that_is_in_no_split_is_refused(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["targets"][0] += "x"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(FileError, match=r"manifest\.json: not a whole manifest: the target .*x' is in no split"):
        read_manifest(folder)


@pytest.mark.parametrize(
    "text", ["[]", "{", '{"../x.h5": {"bytes": 1, "sha256": "0"}}', '{"frames-00000.h5": 3}', "9" * 5000]
)
def test_a_record_that_is_not_whole_is_made_again(text, whole, folder):
    (folder / "shards" / "00000.json").write_text(text)
    (folder / "manifest.json").unlink()
    assert any("00000.json" in line or "not the record" in line for line in verify_dataset(folder))
    report = make(recipe(**SMALL), folder)
    assert report.made == ("frames-00000.h5",) and len(report.broken) == 1
    assert read_manifest(folder) == read_manifest(whole)


def test_a_manifest_whose_numbers_are_not_those_of_the_files_is_noticed(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, value, word in (("height", 25, "depth"), ("targets", [], "target"), ("scenes", 0, "scene")):
        (folder / "manifest.json").write_text(json.dumps(changed(json.loads(json.dumps(manifest)), name, value)))
        with pytest.raises(spadwarp.FileError, match=rf"frames-00000\.h5: not a whole spadwarp frames: {word}"):
            FrameReader(folder, "test")[0]
