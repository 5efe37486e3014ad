"""Datasets: what is drawn, what is written, what a kill or a bad file does to it, and what the readers give back."""

import json
import math

import h5py
import numpy as np
import pytest
from scipy import stats

import spadwarp
from spadwarp.dataset.plan import Plan
from spadwarp.dataset.reading import FIELDS
from spadwarp.dataset.shards import checksum

BS = (0.042, 0.183, 0.480)

TABLES = {
    "name": "test",
    "seed": 11,
    "scenes_per_target": 2,
    "scenes_per_shard": 1,
    "targets": {"builtin": ["staircase", "amphora", "car"], "validation": ["car"], "test": ["staircase"]},
    "pose": {"distance": [15.0], "yaw_deg": {"low": -20.0, "high": 20.0}},
    "water": {"attenuation_lengths": {"low": 0.5, "high": 2.0}},
    "exposure": {"signal_photons": {"low": 20.0, "high": 200.0, "log": True}},
    "gate": {"before": 1.5, "behind": 1.0, "bins": 128},
    "frames": {"per_scene": 3, "backscatter_fraction": list(BS)},
    "scene": {
        "medium": {"extinction": 0.1, "albedo": 0.5},
        "laser": {"preset": "paper", "half_angle_deg": 14.0, "repetition_rate": 5e6},
        "camera": {"preset": "paper", "width": 36, "height": 24},
        "detector": {"preset": "paper"},
    },
}


def recipe(**changes):
    return spadwarp.Recipe.from_dict(TABLES).with_overrides(changes) if changes else spadwarp.Recipe.from_dict(TABLES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("dataset") / "data"
    spadwarp.make_dataset(recipe(), place, device="cpu")
    return place


def checksums(place):
    return {path.relative_to(place).as_posix(): checksum(path) for path in sorted(place.rglob("*.*")) if path.is_file()}


def test_splits_share_neither_targets_nor_seeds(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    splits = manifest["splits"]
    assert splits["test"]["targets"] == ["staircase"] and splits["validation"]["targets"] == ["car"]
    assert splits["train"]["targets"] == ["amphora"]
    assert len({one["seed"] for one in splits.values()}) == 3
    listed = [(folder / f"{name}.txt").read_text().split() for name in splits]
    assert sorted(name for names in listed for name in names) == sorted(
        path.name for path in folder.glob("frames-*.h5")
    )
    for name, files in zip(splits, listed, strict=True):
        for file in files:
            with h5py.File(folder / file) as shard:
                assert shard.attrs["split"] == name
                assert shard.attrs["target"] in splits[name]["targets"]


def test_every_dataset_of_a_file_has_the_same_first_dimension(folder):
    for path in [*folder.glob("frames-*.h5"), *folder.glob("scenes/*.h5"), folder / "scenes.h5"]:
        with h5py.File(path) as file:
            assert len({one.shape[0] for one in file.values()}) == 1
            assert all(one.attrs["unit"] and one.attrs["description"] for one in file.values())


def test_label_noisy_and_clean_depth_agree(folder):
    deviations = []
    for item in spadwarp.iterate_dataset(folder, "all", fields=("noisy", "clean", "label", "bound")):
        noisy, clean, label, bound = (item[name][0] for name in ("noisy", "clean", "label", "bound"))
        stray = label == 1
        assert np.isin(label, (0, 1)).all()
        # A stray pixel always reports something, in the water before what it looks at.
        assert np.isfinite(noisy[stray]).all()
        step = 1e-4
        assert (noisy[stray & np.isfinite(clean)] <= clean[stray & np.isfinite(clean)] + step).all()
        # Others report the target with the noise of the bound, or nothing where there is none.
        assert (np.isnan(noisy) == np.isnan(bound))[~stray].all()
        seen = ~stray & np.isfinite(bound)
        deviations.append(((noisy - clean) / np.hypot(bound, step))[seen])
    z = np.concatenate(deviations)
    assert z.size > 5000
    assert stats.kstest(z, "norm").pvalue > 1e-3


def test_realised_fraction_is_the_requested_one(folder):
    values = []
    for item in spadwarp.iterate_dataset(folder, "all", fields=("label",)):
        label = item["label"]
        values.append(stats.binomtest(int(label.sum()), label.size, float(item["backscatter_fraction"])).pvalue)
        assert min(abs(item["backscatter_fraction"] - one) for one in BS) < 1e-6
    assert min(values) > 1e-3 / len(values)


def test_a_sample_is_the_same_in_any_dataset_around_it(folder, tmp_path):
    """Not its shard, not the number of scenes beside it, not the split of other targets changes a scene's frames."""
    other = {**TABLES, "scenes_per_shard": 2, "targets": {**TABLES["targets"], "validation": []}}
    spadwarp.make_dataset(spadwarp.Recipe.from_dict(other), tmp_path / "other", device="cpu")
    first = {item["sample"]: item for item in spadwarp.FrameReader(folder, "test")}
    second = {item["sample"]: item for item in spadwarp.FrameReader(tmp_path / "other", "test")}
    assert first.keys() == second.keys()
    for sample, item in first.items():
        for name, value in item.items():
            np.testing.assert_array_equal(value, second[sample][name])


def test_rerun_makes_what_is_missing_or_broken_and_gives_the_same_bytes(tmp_path):
    place, whole = tmp_path / "data", recipe(**{"frames.per_scene": 1})
    spadwarp.make_dataset(whole, place, device="cpu")
    before = checksums(place)
    (place / "frames-00001.h5").unlink()
    damaged = bytearray((place / "frames-00002.h5").read_bytes())
    damaged[-100] ^= 1
    (place / "frames-00002.h5").write_bytes(damaged)
    (place / "shards/00003.json").write_text("{")
    (place / "scenes/scenes-00004.h5").write_bytes(b"")
    wrong = "\n".join(spadwarp.verify_dataset(place))
    for name in ("frames-00001.h5: missing", "frames-00002.h5: damaged", "00003.json", "scenes-00004.h5: damaged"):
        assert name in wrong
    report = spadwarp.make_dataset(whole, place, device="cpu")
    assert report.made == tuple(f"frames-0000{k}.h5" for k in (1, 2, 3, 4)) and len(report.kept) == 2
    assert checksums(place) == before and not spadwarp.verify_dataset(place)


def test_parts_make_one_dataset(tmp_path):
    whole = recipe(**{"frames.per_scene": 1})
    spadwarp.make_dataset(whole, tmp_path / "one", device="cpu")
    for part in (2, 1):
        report = spadwarp.make_dataset(whole, tmp_path / "two", device="cpu", shard=(part, 2))
        assert len(report.made) == 3 and len(report.missing) == (3 if part == 2 else 0)
    assert checksums(tmp_path / "one") == checksums(tmp_path / "two")


def test_readers_agree_and_augmented_items_are_parts_of_frames(folder):
    torch = pytest.importorskip("torch")
    images = [name for name in FIELDS if name not in ("counts", "expected")]
    plain = spadwarp.FrameReader(folder, "train", fields=images)
    tensors = spadwarp.SpadDataset(folder, "train", fields=images)
    assert len(plain) == len(tensors) == 6
    for name, value in plain[4].items():
        assert torch.equal(torch.nan_to_num(tensors[4][name]), torch.nan_to_num(torch.as_tensor(value)))
    cut = spadwarp.SpadDataset(folder, "train", crop=12, augment=True, repeats=20)
    assert len(cut) == 120
    item = cut[17]
    assert item["noisy"].shape == (1, 12, 12)
    np.testing.assert_array_equal(cut[17]["noisy"], item["noisy"])
    cut.set_epoch(1)
    assert not np.array_equal(cut[17]["noisy"], item["noisy"])
    frame = plain[17 % 6]["noisy"][0]
    windows = np.lib.stride_tricks.sliding_window_view(frame, (12, 12)).reshape(-1, 12, 12)
    turned = [
        np.rot90(one, k) for one in (item["noisy"][0].numpy(), item["noisy"][0].numpy()[:, ::-1]) for k in range(4)
    ]
    assert any(np.array_equal(np.nan_to_num(a), np.nan_to_num(b)) for a in windows for b in turned)


def test_plan_needs_no_order():
    plan = Plan(recipe())
    assert plan.scene(3).scene == plan.scene(3).scene != plan.scene(2).scene
    assert plan.scene(3).fractions == tuple(plan.fraction(9 + k) for k in range(3))
    assert not math.isnan(plan.scene(0).fractions[0])
