"""A small dataset that the tests share."""

import contextlib
import multiprocessing

from spadwarp.dataset import Recipe, make_dataset
from spadwarp.dataset.shards import checksum

FRACTIONS = (0.042, 0.183, 0.480)

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
    "frames": {"per_scene": 3, "backscatter_fraction": list(FRACTIONS)},
    "scene": {
        "medium": {"extinction": 0.1, "albedo": 0.5},
        "laser": {"preset": "lu2024", "half_angle_deg": 14.0, "repetition_rate": 5e6},
        "camera": {"preset": "lu2024", "width": 36, "height": 24},
        "detector": {"preset": "lu2024"},
    },
}


def recipe(**changes):
    return Recipe.from_dict(TABLES).with_overrides(changes)


def make(dataset, folder, **options):
    return make_dataset(dataset, folder, device="cpu", **options)


@contextlib.contextmanager
def making(dataset, folder, **options):
    """A forked process that makes a dataset, and is killed at the end of the block if it has not ended."""
    process = multiprocessing.get_context("fork").Process(target=make, args=(dataset, folder), kwargs=options)
    process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()
        process.close()


def written(dataset, folder):
    """The path of a recipe's file in a folder."""
    path = folder / "recipe.toml"
    path.write_text(dataset.to_toml())
    return path


def checksums(folder):
    paths = (path for path in sorted(folder.rglob("*.*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): checksum(path) for path in paths}
