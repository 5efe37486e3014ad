"""Datasets for trainers: float depth, clean depth, labels, intensity and numbers, as Parquet, WebDataset or Zarr."""

from __future__ import annotations

import io
import itertools
import os
import shutil
import tarfile
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.dataset.card import card, croissant
from spadwarp.dataset.read import FrameReader
from spadwarp.dataset.recipe import SPLITS
from spadwarp.dataset.shards import FIELDS, HISTOGRAM_FIELDS, Column, checksum, columns_of
from spadwarp.io.text import json_text, write_json, write_text
from spadwarp.scene import Scene
from spadwarp.scene.sight import depth_from_time
from spadwarp.transport import Progress
from spadwarp.values import ArgumentError, FileError, check_choice, check_integer

__all__ = ["EXPORT_FIELDS", "EXPORT_FORMATS", "export_dataset"]

FEATURE_NAMES = ("peak_depth", "peak_counts", "second_depth", "second_counts", "first_depth", "mean_depth")
"""Channels of `histogram_features`."""

EXPORT_FORMATS = ("parquet", "webdataset", "zarr")

EXPORT_FIELDS, _NUMBERS = FIELDS | columns_of("exported"), columns_of("numbers")
"""Images of an exported frame, and its numbers."""

_DEFAULT = ("noisy", "clean", "label", "intensity", "bound")
_OF_HISTOGRAMS = ("features", *HISTOGRAM_FIELDS)
_ZARR_FRAMES = 16  # of a chunk


def export_dataset(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    format: str = "parquet",
    *,
    fields: Sequence[str] | None = None,
    frames_per_file: int = 1000,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Writes a dataset as others load it in one line; returns `out`.

    - `"parquet"`: `datasets.load_dataset(out)` of Hugging Face, with its splits and shaped arrays.
    - `"webdataset"`: `train-00000.tar`, … of `.npy` images and one `.json` a frame.
    - `"zarr"`: `frames.zarr`, a group for each split: `xarray.open_zarr(out / "frames.zarr", group="train")`.

    All hold float32 depth in metres, `label` as uint8, and for each frame the numbers `sample`, `scene`, `target`,
    `backscatter_fraction`, `attenuation_lengths`, `distance`, `gate_near`, `gate_far`, `pulses` and `photons`. Beside
    them a card (`README.md`) and Croissant metadata (`croissant.json`).

    Args:
        folder: The dataset.
        out: A new folder.
        format: Of `EXPORT_FORMATS`.
        fields: Images, of `EXPORT_FIELDS`; default: noisy, clean, label, intensity, bound, and with traced scenes
            features. Scenes that were not traced have NaN in features, counts, expected and polarisation.
        frames_per_file: At most, in [1, 1000000]; Parquet and WebDataset.
        overwrite: Whether an existing `out` is replaced.
        progress: Called with ("frames", frames written, frames to write).

    Raises `ArgumentError`: an argument out of range, or a field that the dataset does not have; `FileError`: no
    dataset, `out` exists or cannot be written, or a package is missing.
    """
    check_choice("format", format, EXPORT_FORMATS)
    frames_per_file = check_integer("frames_per_file", frames_per_file, "[1, 1000000]")
    place, out = Path(folder), Path(out)
    if out.exists() and not overwrite and not (out.is_dir() and not any(out.iterdir())):
        raise FileError(f"{out} exists; overwrite replaces it")
    source = _Source(place, fields, progress or (lambda *_: None))
    out.parent.mkdir(parents=True, exist_ok=True)
    write = {"parquet": _write_parquet, "webdataset": _write_webdataset, "zarr": _write_zarr}[format]
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as temporary:
        made = Path(temporary) / "made"
        made.mkdir()
        try:
            write(source, made, frames_per_file)
        except OSError as error:
            raise FileError(f"{out}: cannot be written: {error}") from error
        # Of a Zarr store, which has a file for each chunk, its metadata.
        found = sorted(path for path in made.rglob("zarr.json" if format == "zarr" else "*") if path.is_file())
        files = {path.relative_to(made).as_posix(): checksum(path) for path in found}
        write_json(croissant(source.manifest, format, files, source.columns), made / "croissant.json", indent=1)
        write_text(card(source.manifest, format, files, source.columns), made / "README.md")
        if out.exists():
            shutil.rmtree(out)
        os.replace(made, out)
    return out


class _Source:
    """The frames of a dataset by split, as rows of columns."""

    def __init__(self, folder: Path, fields: Sequence[str] | None, progress: Progress) -> None:
        base = FrameReader(folder, "all", fields=())
        self.folder, self.manifest, self.shape = folder, base.manifest, base.shape
        sizes = {name: self.manifest["splits"][name]["frames"] for name in SPLITS}
        self.sizes = {name: size for name, size in sizes.items() if size}
        self._progress, self._done = progress, 0
        self._numbers = {name: base.scene_numbers(name) for name in ("pulses", "photons")}
        bins = base.histogram_bins
        chosen = tuple(fields) if fields else (*_DEFAULT, *(("features",) if bins else ()))
        for name in chosen:
            check_choice("fields", name, [*EXPORT_FIELDS])
        if not bins and (lost := [name for name in chosen if name in _OF_HISTOGRAMS]):
            raise ArgumentError(f"fields: {lost[0]!r}: no scene of {folder} was traced: it has no histograms")
        if "polarisation" in chosen and "polarisation" not in base.histogram_fields:
            raise ArgumentError(f"fields: 'polarisation': the camera of {folder} does not record it")
        self.fields = tuple(dict.fromkeys(chosen))
        deep = {"": (), "axis": (3,), "feature": (len(FEATURE_NAMES),), "bin": (bins,)}
        images = {name: EXPORT_FIELDS[name] for name in self.fields}
        self.columns = {name: replace(image, shape=(*deep[image.axis], *base.shape)) for name, image in images.items()}
        self.columns |= _NUMBERS

    def rows(self, split: str) -> Iterator[dict[str, Any]]:
        """The frames of a split, all columns of each."""
        reader = FrameReader(self.folder, split, fields=[name for name in self.fields if name not in _OF_HISTOGRAMS])
        cubes = reader.with_fields("counts")
        for index in range(len(reader)):
            item = cast(dict[str, Any], reader[index])
            scene = int(item["scene"])
            row: dict[str, Any] = {name: item[name] if name == "normal" else item[name][0] for name in reader.fields}
            for name in (name for name in self.fields if name in _OF_HISTOGRAMS):
                row[name] = self._histogram(name, cubes, index, scene)
            row |= {"gate_near": item["gate"][0], "gate_far": item["gate"][1]}
            row |= {name: values[scene] for name, values in self._numbers.items()}
            row |= {name: item[name] for name in _NUMBERS if name in item}
            yield row | {"target": self.manifest["targets"][int(item["target"])]}
            self._done += 1
            self._progress("frames", self._done, sum(self.sizes.values()))

    def _histogram(self, name: str, cubes: FrameReader, index: int, scene: int) -> NDArray[np.float32]:
        if not self._numbers["photons"][scene]:
            return np.full(self.columns[name].shape, np.nan, np.float32)
        if name == "features":
            return histogram_features(cubes[index]["counts"], cubes.scene(index))
        return cast(dict[str, Any], cubes.with_fields(name)[index])[name]

    def files(self, size: int) -> Iterator[tuple[str, int, int, Iterator[dict[str, Any]]]]:
        """Split, number of the file in it, files of the split, and rows of each file with at most so many."""
        for split, length in self.sizes.items():
            rows, count = self.rows(split), -(-length // size)
            for number in range(count):
                yield split, number, count, itertools.islice(rows, size)


def _blocks(rows: Iterator[dict[str, Any]], size: int) -> Iterator[list[dict[str, Any]]]:
    while block := list(itertools.islice(rows, size)):
        yield block


def _write_parquet(source: _Source, out: Path, size: int) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    def array_of(column: Column, values: list[Any]) -> Any:
        if column.is_text:
            return pa.array(values, pa.string())
        array = pa.array(np.array(values, column.kind).reshape(-1))
        for side in reversed(column.shape):
            array = pa.ListArray.from_arrays(pa.array(np.arange(0, len(array) + 1, side, dtype=np.int32)), array)
        return array

    schema = pa.schema(
        pa.field(name, array_of(one, []).type, metadata={"unit": one.unit, "description": one.meaning})
        for name, one in source.columns.items()
    )
    per_row = sum(int(np.prod(column.shape)) * 4 for column in source.columns.values())
    group = int(np.clip((1 << 26) // max(per_row, 1), 1, 1000))  # rows of 64 MiB
    (out / "data").mkdir()
    for split, number, count, rows in source.files(size):
        path = out / "data" / f"{split}-{number:05}-of-{count:05}.parquet"
        with parquet.ParquetWriter(path, schema, compression="zstd") as file:
            for block in _blocks(rows, group):
                arrays = [array_of(column, [row[name] for row in block]) for name, column in source.columns.items()]
                file.write_table(pa.table(arrays, schema=schema))


def _write_webdataset(source: _Source, out: Path, size: int) -> None:
    def add(file: tarfile.TarFile, name: str, content: bytes) -> None:
        entry = tarfile.TarInfo(name)
        entry.size = len(content)
        file.addfile(entry, io.BytesIO(content))

    for split, number, _, rows in source.files(size):
        with tarfile.open(out / f"{split}-{number:05}.tar", "w") as file:
            for row in rows:
                key = f"{int(row['sample']):09}"
                for name in source.fields:
                    packed = io.BytesIO()
                    np.save(packed, np.asarray(row[name], source.columns[name].kind))
                    add(file, f"{key}.{name}.npy", packed.getvalue())
                add(file, f"{key}.json", json_text({name: row[name] for name in _NUMBERS}, indent=None).encode())


def _write_zarr(source: _Source, out: Path, size: int) -> None:
    import zarr

    store = zarr.open_group(out / "frames.zarr", mode="w")
    for split, length in source.sizes.items():
        group: Any = store.create_group(split)
        for name, side in zip(("y", "x"), source.shape, strict=True):
            group.create_array(name, data=np.arange(side), dimension_names=[name])
        for name, column in source.columns.items():
            image = [*([column.axis] if column.axis else []), "y", "x"] if column.shape else []
            array = group.create_array(
                name,
                shape=(length, *column.shape),
                dtype="string" if column.is_text else column.kind,
                chunks=(min(_ZARR_FRAMES, length), *column.shape),
                dimension_names=["frame", *image],
            )
            array.attrs.update({"units": column.unit, "long_name": column.meaning})
        for number, block in enumerate(_blocks(source.rows(split), _ZARR_FRAMES)):
            first = number * _ZARR_FRAMES
            for name, column in source.columns.items():
                kind = np.dtypes.StringDType() if column.is_text else column.kind
                group[name][first : first + len(block)] = np.array([row[name] for row in block], dtype=kind)
    # Readers look for the metadata of all arrays in one place; zarr remarks that its version 3 does not yet say so.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for path in (None, *source.sizes):
            zarr.consolidate_metadata(store.store, path=path)


def histogram_features(counts: ArrayLike, scene: Scene) -> NDArray[np.float32]:
    """Features of a frame's histograms `[6, H, W]`, by `FEATURE_NAMES`.

    Planar depth [m] and counts of the window with most counts, as long as pulse and jitter together (FWHM); the same of
    the best window that does not overlap with it; depth of the first count, and of the mean of all counts. NaN where
    there are no counts.

    Args:
        counts: `[T, H, W]`.
        scene: Of the frame.
    """
    cube = np.asarray(counts, np.float64)
    bins, total = len(cube), cube.sum(axis=0)
    fwhm = np.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps) * 1e-12
    width = int(np.clip(round(fwhm / scene.gate.bin_width), 1, bins))
    sums = np.concatenate([np.zeros((1, *total.shape)), np.cumsum(cube, axis=0)])
    windows = sums[width:] - sums[:-width]  # of the bins k to k + width - 1
    number = np.arange(bins)[:, None, None]

    def depth(bin: NDArray[np.float64]) -> NDArray[np.float64]:
        return depth_from_time(scene.gate.start + (bin + 0.5) * scene.gate.bin_width, scene=scene)

    def mean_bin(weight: NDArray[np.float64]) -> NDArray[np.float64]:
        amount = weight.sum(axis=0)
        return np.divide((weight * number).sum(axis=0), amount, out=np.full(total.shape, np.nan), where=amount > 0)

    features = []
    for _ in range(2):
        start = windows.argmax(axis=0)
        inside = (number >= start) & (number < start + width)
        features += [depth(mean_bin(np.where(inside, cube, 0.0))), np.where(inside, cube, 0.0).sum(axis=0)]
        windows = np.where(np.abs(number[: len(windows)] - start) >= width, windows, -1.0)
        cube = np.where(inside, 0.0, cube)
    cube = np.asarray(counts, np.float64)
    first = np.where(total > 0, (cube > 0).argmax(axis=0), np.nan)
    return np.stack([*features, depth(first), depth(mean_bin(cube))]).astype(np.float32)
