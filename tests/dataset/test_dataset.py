"""Datasets: what is drawn and written, what survives a kill or a bad file, and what the readers return."""

import json
import math
import os
import shutil
import signal
import time
import tomllib
import typing
from contextlib import ExitStack

import h5py
import numpy as np
import pytest
import trimesh
from scipy import stats

import spadwarp
from helpers.cli import DEVICE, ROOT, run, small_files, tables
from helpers.datasets import FRACTIONS, TABLES, checksums, make, making, recipe, written
from spadwarp.dataset import (
    FIELDS,
    SPLITS,
    FrameItem,
    FrameReader,
    Plan,
    Recipe,
    SpadDataset,
    TensorItem,
    load_recipe,
    verify_dataset,
)
from spadwarp.dataset.render import render_analytic
from spadwarp.dataset.shards import HISTOGRAM_FIELDS
from spadwarp.io.arrays import write_exr
from spadwarp.io.paths import lock
from spadwarp.mesh import build_mesh
from spadwarp.transport import truth_maps
from spadwarp.values import SPEED_OF_LIGHT


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("dataset") / "data"
    make(recipe(), place)
    return place


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """The same, of other shards and splits."""
    place = tmp_path_factory.mktemp("dataset") / "other"
    make(recipe(scenes_per_shard=2, **{"targets.validation": []}), place)
    return place


def test_splits_share_neither_targets_nor_seeds(folder):
    """And in each file, every dataset has the same first dimension, a unit and a description."""
    splits = json.loads((folder / "manifest.json").read_text())["splits"]
    found = {name: split["targets"] for name, split in splits.items()}
    assert found == {"train": ["amphora"], "validation": ["car"], "test": ["staircase"]}
    assert len({split["seed"] for split in splits.values()}) == 3
    listed = {name: (folder / f"{name}.txt").read_text().split() for name in splits}
    assert sorted(name for files in listed.values() for name in files) == sorted(
        path.name for path in folder.glob("frames-*.h5")
    )
    for name, files in listed.items():
        for file in files:
            with h5py.File(folder / file) as shard:
                assert shard.attrs["split"] == name and shard.attrs["target"] in splits[name]["targets"]
    for path in [*folder.glob("frames-*.h5"), *folder.glob("scenes/*.h5"), folder / "scenes.h5"]:
        with h5py.File(path) as file:
            assert len({stored.shape[0] for stored in file.values()}) == 1
            assert all(stored.attrs["unit"] and stored.attrs["description"] for stored in file.values())


PORTS = {"scene.camera.port": {"preset": "flat-glass"}, "scene.laser.port": "camera"}


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(None, id="water"),
        pytest.param(PORTS | {"scene.medium.phase_index": "seawater"}, id="port", marks=pytest.mark.slow),
    ],
)
def test_label_noisy_and_clean_depth_agree(folder, tmp_path, changes):
    if changes is not None:
        folder = tmp_path / "data"
        make(recipe(**changes), folder)
    deviations, step = [], 1e-4
    for item in FrameReader(folder, "all", fields=("noisy", "clean", "label", "bound")):
        noisy, clean, label, bound = (item[name][0] for name in ("noisy", "clean", "label", "bound"))
        outlier = label == 1
        assert np.isin(label, (0, 1)).all()
        # An outlier always reports a depth, in the water in front of the target.
        assert np.isfinite(noisy[outlier]).all()
        assert (noisy[outlier & np.isfinite(clean)] <= clean[outlier & np.isfinite(clean)] + step).all()
        # Others report the target with the noise of the bound, or nothing where there is none.
        assert (np.isnan(noisy) == np.isnan(bound))[~outlier].all()
        deviations.append(((noisy - clean) / np.hypot(bound, step))[~outlier & np.isfinite(bound)])
    z = np.concatenate(deviations)
    assert z.size > 5000 and stats.kstest(z, "norm").pvalue > 1e-3


def test_prior_is_the_density_of_background_at_the_measured_depth(folder):
    with h5py.File(folder / "scenes.h5") as file:
        profiles, edges = file["backscatter_profile"][...], file["profile_edges"][...]
    np.testing.assert_allclose((profiles * np.diff(edges)).sum(axis=1), 1.0, rtol=1e-4)
    for item in FrameReader(folder, "train", fields=("noisy", "prior")):
        noisy, prior = item["noisy"], item["prior"]
        assert (np.isnan(noisy) == np.isnan(prior)).all()
        bins = np.searchsorted(edges[item["scene"]], np.nan_to_num(noisy), side="right") - 1
        near_an_edge = np.abs(noisy[..., None] - edges[item["scene"]]).min(axis=-1) < 1e-4
        inside = (bins >= 0) & (bins < 64) & ~near_an_edge & np.isfinite(noisy)
        assert inside.mean() > 0.2
        np.testing.assert_array_equal(prior[inside], profiles[item["scene"]][bins[inside]])
        assert (prior[(bins < 0) & np.isfinite(noisy) & ~near_an_edge] == 0).all()


def test_realised_fraction_is_the_requested_one(folder):
    values = []
    for item in FrameReader(folder, "all", fields=("label",)):
        label = item["label"]
        values.append(stats.binomtest(int(label.sum()), label.size, float(item["backscatter_fraction"])).pvalue)
        assert min(abs(item["backscatter_fraction"] - fraction) for fraction in FRACTIONS) < 1e-6
    assert min(values) > 1e-3 / len(values)


def test_a_sample_is_the_same_in_any_dataset_around_it(folder, other):
    """Not its shard, not the number of scenes beside it, not the split of other targets changes a scene's frames."""
    first, second = ({item["sample"]: item for item in FrameReader(place, "test")} for place in (folder, other))
    assert first.keys() == second.keys()
    for sample, item in first.items():
        for name, value in item.items():
            np.testing.assert_array_equal(value, second[sample][name])


def test_a_split_without_frames_is_named_at_once(other):
    for reader in (FrameReader, SpadDataset):
        with pytest.raises(ValueError, match=r"split = 'validation': .*other has no frames in it; it has train, test"):
            reader(other, "validation")


def test_rerun_makes_what_is_missing_or_broken_and_gives_the_same_bytes(small, whole, tmp_path):
    """And removes what a process that was killed between the first byte of a shard and the last has left."""
    place, before = shutil.copytree(whole, tmp_path / "data"), checksums(whole)
    (place / "frames-00001.h5").unlink()
    damaged = bytearray((place / "frames-00002.h5").read_bytes())
    damaged[-100] ^= 1
    (place / "frames-00002.h5").write_bytes(damaged)
    (place / "shards/00003.json").write_text("{")
    (place / "scenes/scenes-00004.h5").write_bytes(b"")
    wrong = "\n".join(verify_dataset(place))
    for name in ("frames-00001.h5: missing", "frames-00002.h5: damaged", "scenes-00004.h5: damaged"):
        assert name in wrong
    for left in (".frames-00001.h5.0123456789abcdef.tmp", "shards/.00001.json.0123456789abcdef.tmp"):
        (place / left).write_bytes(b"begun")
    report = make(small, place)
    assert report.made == tuple(f"frames-0000{k}.h5" for k in (1, 2, 3, 4)) and len(report.kept) == 2
    assert checksums(place) == before and not verify_dataset(place)


def test_parts_make_one_dataset(small, whole, tmp_path):
    out = tmp_path / "data"
    for part in (2, 1):
        if part == 1:
            with pytest.raises(spadwarp.FileError, match="not finished"):
                FrameReader(out)
        report = make(small, out, part=(part, 2))
        assert len(report.made) == 3 and len(report.missing) == (3 if part == 2 else 0)
    assert checksums(out) == checksums(whole)


def test_items_hold_what_their_types_promise(folder):
    pytest.importorskip("torch")
    images = [name for name in FIELDS if name not in HISTOGRAM_FIELDS]
    for reader, items in ((FrameReader, FrameItem), (SpadDataset, TensorItem)):
        item, declared = reader(folder, "train", fields=images)[0], typing.get_origin(items)
        assert declared.__optional_keys__ == set(FIELDS)
        assert item.keys() == declared.__required_keys__ | set(images)
        kinds = dict(zip(declared.__parameters__, typing.get_args(items), strict=True))
        for name, variable in typing.get_type_hints(declared).items():
            kind = kinds[variable]
            names = {one.__name__ for one in type(item.get(name)).__mro__}
            assert name not in item or getattr(kind, "__forward_arg__", getattr(kind, "__name__", "")) in names, name


def test_readers_agree_and_augmented_items_are_parts_of_frames(folder):
    torch = pytest.importorskip("torch")
    images = [name for name in FIELDS if name not in HISTOGRAM_FIELDS]
    plain = FrameReader(folder, "train", fields=images)
    tensors = SpadDataset(folder, "train", fields=images)
    assert len(plain) == len(tensors) == 6
    for name, value in plain[4].items():
        assert torch.equal(torch.nan_to_num(tensors[4][name]), torch.nan_to_num(torch.as_tensor(value)))
    cut = SpadDataset(folder, "train", crop=12, augment=True, repeats=20)
    assert len(cut) == 120
    item = cut[17]
    assert item["noisy"].shape == (1, 12, 12)
    np.testing.assert_array_equal(cut[17]["noisy"], item["noisy"])
    cut.set_epoch(1)
    assert not np.array_equal(cut[17]["noisy"], item["noisy"])
    frame = plain[17 % 6]["noisy"][0]
    windows = np.lib.stride_tricks.sliding_window_view(frame, (12, 12)).reshape(-1, 12, 12)
    image = item["noisy"][0].numpy()
    rotated = [np.rot90(mirrored, k) for mirrored in (image, image[:, ::-1]) for k in range(4)]
    assert any(np.array_equal(a, b, equal_nan=True) for a in windows for b in rotated)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forked processes")
def test_kills_lose_nothing_but_the_shard_in_hand(small, whole, tmp_path):
    out, generator = tmp_path / "data", np.random.default_rng(5)

    def records():
        return {path.name: path.stat().st_mtime_ns for path in out.glob("shards/*.json")}

    for shards in (1, 4):
        with making(small, out) as process:
            while len(records()) < shards and process.is_alive():
                time.sleep(0.002)
            time.sleep(generator.uniform(0.0, 0.1))
        before = records()
    make(small, out)
    assert checksums(out) == checksums(whole)
    assert before and before.items() <= records().items()


@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
def test_a_full_disk_is_reported_and_loses_nothing_else(small, tmp_path):
    out = tmp_path / "data"
    make(small, out, part=(1, 6))
    before = checksums(out)
    with small_files(5000), pytest.raises(spadwarp.FileError, match=r"-00001\.h5: cannot be written"):
        make(small, out)
    assert checksums(out) == before and not list(out.rglob(".*.tmp"))


def test_unsuitable_folders_are_refused(folder, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "used").mkdir()
    (tmp_path / "used/thesis.txt").write_text("")
    for place in (tmp_path / "file", tmp_path / "file/below", tmp_path / "used"):
        with pytest.raises(spadwarp.FileError, match=str(place)):
            make(recipe(), place)
    with pytest.raises(spadwarp.ConfigError, match="another recipe"):
        make(recipe(seed=12), folder)
    for read in (FrameReader, verify_dataset):
        with pytest.raises(spadwarp.FileError, match="no dataset there"):
            read(tmp_path)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_reported(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(spadwarp.FileError, match="cannot be written"):
        make(recipe(), tmp_path / "data")


def test_traced_scenes_hold_their_histograms(tmp_path):
    changes = {"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 2, "gate.bins": 64}
    changes |= {"scene.camera.width": 12, "scene.camera.height": 8, "scenes_per_target": 1}
    changes |= {"monte_carlo.share": 1.0, "monte_carlo.photons": 40_000}
    totals = {}
    for form in ("sparse", "dense"):
        make(recipe(**changes, **{"monte_carlo.counts": form}), tmp_path / form)
        assert not verify_dataset(tmp_path / form)
        with h5py.File(tmp_path / form / "scenes.h5") as file:
            profile, edges = file["backscatter_profile"][...], file["profile_edges"][...]
            assert (file["photons"][...] == 40_000).all() and (file["noise_ratio"][...] > 0).all()
        np.testing.assert_allclose((profile * np.diff(edges)).sum(axis=1), 1.0, rtol=1e-4)
        fields = ("noisy", "clean", "label", "intensity", "counts", "expected")
        items = list(FrameReader(tmp_path / form, "test", fields=fields))
        totals[form] = [item["counts"] for item in items]
        for item in items:
            assert item["counts"].shape == item["expected"].shape == (64, 8, 12)
            assert math.isnan(item["backscatter_fraction"])
            counts, expected = item["counts"].sum(axis=0), item["expected"].sum(axis=0)
            # Pile-up is negligible: counts are Poisson about their expectation.
            chi2 = float(((counts - expected) ** 2 / expected).sum())
            assert 1e-3 < stats.chi2(96).sf(chi2) < 0.999
            np.testing.assert_array_equal(np.minimum(item["intensity"][0], 255), np.minimum(counts, 255))
            noisy, clean = item["noisy"][0], item["clean"][0]
            assert (np.isfinite(noisy) == (counts > 0)).all()
            right = np.isfinite(noisy) & (item["label"][0] == 0) & np.isfinite(clean)
            assert np.median(np.abs(noisy - clean)[right]) < 0.05
    np.testing.assert_array_equal(totals["sparse"], totals["dense"])
    make(recipe(**changes | {"monte_carlo.photons": "auto", "monte_carlo.time": 2.0}), tmp_path / "auto")
    with h5py.File(tmp_path / "auto" / "scenes.h5") as file:
        photons, ratio = file["photons"][...], file["noise_ratio"][...]
    assert (photons % 2**15 == 0).all() and (photons > 40_000).all() and (ratio > 0).all()


def plan_of_mesh(mesh, folder, *, scenes=1, yaw=0.0, **targets):
    (folder / "meshes").mkdir(exist_ok=True)
    mesh.export(folder / "meshes/block.stl")
    tables = {**TABLES, "targets": {"meshes": ["meshes"], **targets}, "scenes_per_target": scenes}
    return Plan(load_recipe(written(Recipe.from_dict(tables).with_overrides({"pose.yaw_deg": yaw}), folder)))


def test_the_centre_of_a_mesh_is_at_the_distance_of_the_recipe(tmp_path):
    block = trimesh.creation.box(bounds=[(1.0, 2.0, 3.0), (1.2, 2.4, 3.1)])
    plan = plan_of_mesh(block, tmp_path, scenes=3, yaw={"low": -20.0, "high": 20.0}, mesh_size=2.0)
    assert [target.name for target in plan.targets] == ["block"]
    assert plan.scene(2).scene == plan.scene(2).scene != plan.scene(1).scene
    for index in range(3):
        mesh = build_mesh(plan.scene(index).scene)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), [0.0, 0.0, 15.0], atol=1e-5)
        angle = np.radians(plan.scene(index).scene.targets[0].rotation_deg[1])
        sides = (np.cos(angle) + 0.5 * abs(np.sin(angle)), 2.0)
        np.testing.assert_allclose(np.ptp(mesh.bounds, axis=0)[:2], sides, rtol=1e-5)
    filled = Plan(plan.recipe.with_overrides({"pose.fill": 0.5, "pose.yaw_deg": 0.0})).scene(0).scene
    height = np.ptp(build_mesh(filled).bounds[:, 1])
    assert height == pytest.approx(0.5 * 15.0 * filled.camera.pixel_tangent * filled.camera.height, rel=1e-5)
    # Without a size, a mesh in metres stays as it is.
    for unit, options in ((1.0, {}), (1000.0, {"mesh_scale": 0.001})):
        box = trimesh.creation.box(extents=(1.1 * unit, 0.7 * unit, 0.3 * unit))
        size = np.ptp(build_mesh(plan_of_mesh(box, tmp_path, **options).scene(0).scene).bounds, axis=0)
        np.testing.assert_allclose(size, (1.1, 0.7, 0.3), rtol=1e-5)


def test_by_the_rates_a_pixel_reports_where_it_recorded_a_photon():
    faint = {"exposure.signal_photons": [1.5], "frames.backscatter_fraction": "rates", "pose.size": [0.5]}
    plan = Plan(recipe(**faint))
    rendered = render_analytic(plan, plan.scene(0), device="cpu")
    assert rendered.intensity_step == 1.0
    assert np.array_equal(rendered.depth > 0, rendered.intensity > 0)
    assert 0.1 < np.mean(rendered.depth > 0) < 0.9


def test_a_thin_target_between_the_pixels_of_the_exposure_gets_one(tmp_path):
    plan = plan_of_mesh(trimesh.creation.box(extents=(0.3, 2.0, 0.1)), tmp_path)
    seen = np.isfinite(truth_maps(plan.scene(0).scene, device="cpu").depth).any(axis=0)
    assert seen.any() and not seen[4::8].any()
    rendered = render_analytic(plan, plan.scene(0), device="cpu")
    assert 15.0 <= rendered.signal * rendered.scene.analytic.pulses_per_depth_frame <= 210.0


@pytest.mark.parametrize(
    ("orientation", "up", "front"),
    [("camera", (0, -1, 0), (0, 0, -1)), ("y_up", (0, 1, 0), (0, 0, 1)), ("z_up", (0, 0, 1), (0, -1, 0))],
)
def test_orientation_turns_what_is_up_in_the_file_up_in_the_image(orientation, up, front, tmp_path):
    arrow = np.array([np.zeros(3), 0.8 * np.array(up), 0.4 * np.array(front)])  # its tip, then its front
    tetrahedron = trimesh.Trimesh([*arrow, 0.1 * np.cross(up, front)], [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    placed = build_mesh(plan_of_mesh(tetrahedron, tmp_path, orientation=orientation).scene(0).scene)
    height, depth = placed.bounds[:, 1], placed.bounds[:, 2]
    assert np.ptp(height) == pytest.approx(0.8, rel=1e-5) and np.ptp(depth) == pytest.approx(0.4, rel=1e-5)
    tip = placed.vertices[np.argmin(placed.vertices[:, 1])]  # the image's +y is down
    nearest = placed.vertices[np.argmin(placed.vertices[:, 2])]
    assert tip[2] == pytest.approx(depth[1], abs=1e-5) and nearest[1] == pytest.approx(height[1], abs=1e-5)


@pytest.mark.parametrize(("side", "words"), [(900.0, "reaches the camera"), (1e-4, "less than a pixel")])
def test_a_mesh_in_another_unit_is_named_before_the_first_scene(side, words, tmp_path):
    plan = plan_of_mesh(trimesh.creation.box(extents=(side, side, side)), tmp_path)
    with pytest.raises(spadwarp.ConfigError) as caught:
        make(plan.recipe, tmp_path / "data")
    for text in ("block.stl", f"{side:.4g} x {side:.4g} x {side:.4g} m", words, "mesh_scale"):
        assert text in str(caught.value)
    assert not list((tmp_path / "data").glob("*.h5"))


@pytest.mark.slow
@pytest.mark.parametrize(("start", "workers"), [("fork", 2), ("spawn", 1)])
def test_a_torch_loader_gives_the_same_items_from_any_kind_of_worker(folder, start, workers):
    torch = pytest.importorskip("torch")
    pairs = SpadDataset(folder, "train", crop=16, augment=True, repeats=3)
    alone = list(torch.utils.data.DataLoader(pairs, batch_size=4))
    options = {"num_workers": workers, "multiprocessing_context": start, "persistent_workers": True}
    loader = torch.utils.data.DataLoader(pairs, batch_size=4, **options)
    for _ in range(2):
        for batch, expected in zip(loader, alone, strict=True):
            for name, values in expected.items():
                assert torch.equal(batch[name].nan_to_num(-1.0), values.nan_to_num(-1.0)), name


def test_scenes_follow_a_trajectory(small, tmp_path):
    rows = "".join(f"{0.1 * n},{0.2 * n},{-n}\n" for n in range(3))
    (tmp_path / "poses.csv").write_text("time,camera.position[0],targets[0].rotation_deg[1]\n" + rows)
    path = written(small.with_overrides({"scenes_per_target": 3, "trajectory": "poses.csv"}), tmp_path)
    make(path, tmp_path / "data")
    reader = FrameReader(tmp_path / "data", "test", fields=("clean",))
    assert len(reader) == 3
    for number in range(3):
        scene = reader.scene(number)
        assert scene.camera.position[0] == pytest.approx(0.2 * number) and scene.targets[0].rotation_deg[1] == -number
        truth = spadwarp.truth_maps(scene, device="cpu").depth
        np.testing.assert_array_equal(reader[number]["clean"][0], truth)
    with pytest.raises(spadwarp.ConfigError, match=r"3 rows are fewer than scenes_per_target = 4"):
        Plan(load_recipe(path).with_overrides({"scenes_per_target": 4}))


def test_depth_maps_of_an_engine_become_targets(tmp_path):
    depth = np.full((24, 36), 65504.0, np.float16)
    depth[4:20, 6:30] = 1500.0  # centimetres
    (tmp_path / "exports").mkdir()
    write_exr(tmp_path / "exports/wall_RGBD.EXR", {**dict.fromkeys("RGB", np.zeros_like(depth)), "A": depth})
    write_exr(tmp_path / "exports/wall_Base_Col.EXR", dict.fromkeys("RGB", np.full_like(depth, 0.25)))
    tables = {**TABLES, "targets": {"exports": ["exports"]}}
    path = written(Recipe.from_dict(tables), tmp_path)
    make(path, tmp_path / "data")
    for item in FrameReader(tmp_path / "data", fields=("clean", "noisy", "reflectance", "label")):
        clean, valid = item["clean"][0], depth < 60000
        assert (np.isfinite(clean) == valid).all() and item["distance"] == 15.0
        assert np.abs(clean[valid] - 15.0).max() < 1e-4 and (item["reflectance"][0][valid] == 0.25).all()
        right = valid & (item["label"][0] == 0)
        assert np.abs(item["noisy"][0][right] - 15.0).max() < 0.05
    traced = load_recipe(path).with_overrides({"monte_carlo.share": 0.5})
    with pytest.raises(spadwarp.ConfigError, match=r"monte_carlo.share"):
        Plan(traced)


def test_every_problem_of_a_recipe_is_named():
    wrong = {
        "pose": {"distance": -1.0, "yaw": 3.0},
        "water": {"attenuation_lengths": {"low": 2.0, "high": 1.0}},
        "frames": {"backscatter_fraction": [0.1, 1.5]},
        "exposure": {"pulses_per_depth_frame": 5.0, "signal_photons": 5.0},
    }
    with pytest.raises(spadwarp.ConfigError) as caught:
        Recipe.from_dict({**TABLES, **wrong})
    text = str(caught.value)
    for words in ("pose.distance", "[1e-9, 1e9]", "pose.yaw", "did you mean 'yaw_deg'", "low = 2.0", "1.5", "exposure"):
        assert words in text
    for given in ("6 m", {"low": "600 cm", "high": 6}, ["6 m", "600 cm"]):
        assert Recipe.from_dict({**TABLES, "pose": {"distance": given}}).pose.distance.limits == (6.0, 6.0)
    assert "literal[" not in text and "function-" not in text  # pydantic's names of a choice's branches
    # Traced scenes that are described, of which there are none unless it is said so.
    with pytest.raises(spadwarp.ConfigError, match=r"monte_carlo.*share is missing"):
        Recipe.from_dict({**TABLES, "monte_carlo": {"photons": 1000}})
    assert Recipe.from_dict({**TABLES, "monte_carlo": {"photons": 1000, "share": 0.0}}).monte_carlo.share == 0.0


INF, NAN = math.inf, math.nan
PLUME = {"probability": 0.5, "optical_depth": {"low": 0.5, "high": 2.0}, "cells": 12, "size": 1.5}
LAYERS = [{"start": 1.0, "extinction": 1.0, "albedo": 0.5}]
WRONG = [
    ({"scene.camera.pixels": 3}, r"camera\.pixels"),
    ({"targets.test": ["carr"]}, r"targets\.test: 'carr' is not one of the dataset's targets, .*; did you mean 'car'"),
    ({"gate.before": 1500}, r"gate\.before = 1500 is outside \(0, 15\) m, up to pose\.distance"),
    ({"pose.yaw_deg": {"min": -3}}, "did you mean 'low'"),
    ({"vary": {"medium.preset": ["uwoc-clear"]}}, "cannot be combined with water.attenuation_lengths"),
    ({"targets.test": ["car"], "targets.validation": ["car"]}, r"targets\."),
    ({"targets.builtin": ["boat"]}, r"targets\."),
    # What varies is tried when the recipe is read.
    ({"vary": {"medium.albedo": [0.1, NAN]}}, r"vary\.medium\.albedo holds"),
    ({"vary": {"medium.albedo": [0.1, -1.0]}}, r"vary: medium\.albedo = -1\.0"),
    ({"vary": {"medium.albedo": {"low": 0.1, "high": 1e7}}}, r"vary: medium\.albedo = 10000000\.0"),
    ({"vary": {"medium.albedo": {"low": 5e-324, "high": 1.0, "log": True}}}, "too far apart"),
    ({"vary": {"laser.preset": ["lu2024", "lu2042"]}}, r"vary: laser\.preset = 'lu2042'"),
    ({"vary": {"x": 3}}, "vary: x is not a known section"),
    ({"vary": {"medium.haze": 3}}, r"vary: medium\.haze is not a known field"),
    ({"plume": {**PLUME, "shape": ["fog"]}}, r"plume\.shape"),
    ({"plume": {**PLUME, "probability": 1.5}}, r"plume\.probability = 1\.5 .*is outside"),
    ({"plume": PLUME, "scene.medium.layers": LAYERS}, "cannot be combined with layers"),
]
for field in ("pose.distance", "pose.shift", "pose.reflectance", "exposure.signal_photons"):
    for value in (NAN, INF, -INF, [0.5, NAN], [NAN, 0.5], [0.5, INF], {"low": NAN, "high": 1.0}):
        WRONG.append(({field: value}, f"^{field}"))
WRONG += [({"frames.backscatter_fraction": value}, "^frames.backscatter_fraction") for value in (NAN, [0.5, 1e300])]
WRONG += [({"pose.distance": value}, r"^pose\.distance") for value in ([0.5, 1e300], {"low": 0.1, "high": INF})]


@pytest.mark.parametrize(("changes", "problem"), WRONG)
def test_recipes_that_cannot_be_are_refused(changes, problem):
    with pytest.raises(spadwarp.ConfigError, match=problem):
        Plan(recipe(**changes))


@pytest.mark.parametrize("path", sorted((ROOT / "configs/datasets").glob("*.toml")), ids=lambda path: path.stem)
def test_recipes_in_configs(path):
    given = load_recipe(path)
    plan = Plan(given)
    assert Recipe.from_dict(tomllib.loads(given.to_toml())) == given
    splits = {split: {target.name for target in plan.targets if target.split == split} for split in SPLITS}
    assert all(splits.values()) and "staircase" in splits["test"]
    if path.stem in ("lu2024", "montecarlo"):
        assert len(plan.targets) == 20 and plan.scene_count == 1000
    codes = (np.array([1, 65535]) * plan.depth_step + plan.depth_offset).tolist()
    for index in range(0, plan.scene_count, max(1, plan.scene_count // 7)):
        drawn = plan.scene(index)
        far = drawn.scene.gate.stop * SPEED_OF_LIGHT / drawn.scene.medium.group_index / 2.0
        assert codes[0] < 0.97 * (far - 2.0) and far < codes[1]


def test_part_of_the_scenes_have_a_plume_of_the_optical_depth_that_was_drawn():
    plain = Plan(load_recipe("small"))
    plan = Plan(plain.recipe.with_overrides({"plume": PLUME}))
    found = []
    for index in range(min(plan.scene_count, 24)):
        drawn, without = plan.scene(index), plain.scene(index)
        grid, depth = drawn.scene.medium.grid, drawn.scene.medium.extinction * drawn.distance
        # Everything else is as it was.
        assert drawn.scene.with_overrides({"medium.grid": None}) == without.scene and drawn.seed == without.seed
        if grid is not None:
            found.append(drawn.scene.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, drawn.distance)) - depth)
            assert 0.3 * drawn.distance <= grid.translation[2] <= 0.8 * drawn.distance
            assert plan.scene(index).scene == drawn.scene
    assert 4 <= len(found) <= 20
    assert 0.49 < min(found) < max(found) < 2.01


@pytest.mark.slow
def test_commands(tmp_path):
    path, out = written(recipe(), tmp_path), tmp_path / "data"

    make = ["dataset", path, "--out", out, *DEVICE, "--set", "frames.per_scene=1"]
    run(*make, "--part", "1/2", "--json", tmp_path / "part.json")
    assert tables(tmp_path / "part.json")["missing"] == tables(tmp_path / "part.json")["frames"] == 3
    assert "frames-00001.h5: missing" in run("info", out, "--verify", code=1).output
    run(*make, "--json", tmp_path / "report.json")
    assert tables(tmp_path / "report.json")["frames"] == tables(tmp_path / "report.json")["kept"] == 3
    assert "complete" in run("info", out, "--verify").output
    assert "staircase" in run("info", out).output
    run("view", out, "--pictures", "4", "--out", tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").read_bytes()[:4] == b"\x89PNG"
    for wrong in (["--part", "3/2"], ["--part", "x"], ["--workers", "2"]):
        run(*make, *wrong, code=2)


@pytest.mark.slow
def test_hugging_face_reads_the_frames(folder, tmp_path):
    datasets = pytest.importorskip("datasets")
    files = {split: [str(folder / name) for name in (folder / f"{split}.txt").read_text().split()] for split in SPLITS}
    read = datasets.load_dataset("hdf5", data_files=files, cache_dir=str(tmp_path))
    with h5py.File(files["test"][0]) as file:
        np.testing.assert_array_equal(np.array(read["test"][1]["depth"]), file["depth"][1])
        assert len(read["test"]) == 2 * len(file["depth"])


# Processes that make one dataset at the same time: each shard is made once, and nothing is lost


def test_a_shard_that_another_process_makes_is_waited_for(small, whole, tmp_path, monkeypatch):
    two = tmp_path / "two"
    make(small, two, part=(2, 2))
    other = ExitStack()
    other.enter_context(lock(two / "shards" / "00000.lock"))

    def finish(_seconds):
        """What the other process does in the meantime."""
        for name in ("frames-00000.h5", "scenes/scenes-00000.h5", "shards/00000.json"):
            shutil.copy2(whole / name, two / name)
        other.close()

    monkeypatch.setattr("time.sleep", finish)
    make(small, two)
    frames = "frames-00000.h5"
    assert (two / frames).stat().st_mtime_ns == (whole / frames).stat().st_mtime_ns  # not made twice
    assert checksums(two) == checksums(whole) and not verify_dataset(two)


def test_an_interrupt_ends_the_wait(small, tmp_path, monkeypatch):
    place = tmp_path / "data"
    make(small, place, part=(2, 2))
    monkeypatch.setattr("time.sleep", lambda _seconds: signal.raise_signal(signal.SIGINT))
    with lock(place / "shards" / "00000.lock"), pytest.raises(KeyboardInterrupt):
        make(small, place)
    assert not (place / "frames-00000.h5").exists()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_processes_that_share_a_file_system_make_one_dataset(small, whole, tmp_path, monkeypatch):
    """Calls for the whole and for parts of it, whose processes have the same numbers, as those of containers have."""
    out = tmp_path / "data"
    monkeypatch.setattr("os.getpid", lambda: 1)
    with ExitStack() as stack:
        processes = [stack.enter_context(making(small, out, part=part)) for part in ((1, 1), (1, 1), (2, 2))]
        for process in processes:
            process.join(timeout=120)
        assert [process.exitcode for process in processes] == [0, 0, 0]
    assert checksums(out) == checksums(whole) and not list(out.rglob(".*"))
