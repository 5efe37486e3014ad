"""Weights and checkpoints of training that somebody has changed, or that were cut."""

import json
import struct

import pytest
from safetensors.torch import load_file, save_file

from spadwarp.denoise.baselines import compared
from spadwarp.denoise.network_files import WEIGHTS, weights_metadata
from spadwarp.denoise.networks import load_network
from spadwarp.values import FileError, SpadwarpError

SOURCE = WEIGHTS / "usdn.safetensors"


def saved(folder, values, **metadata):
    save_file(values, folder / "usdn.safetensors", metadata={"model": "usdn", **metadata})
    return folder / "usdn.safetensors"


@pytest.mark.parametrize("text", ["{", "[" * 10_000, '{"a": ' * 5_000])
def test_a_header_that_is_not_json_is_refused(text, tmp_path):
    with pytest.raises(FileError, match=r"usdn\.safetensors: its header is damaged"):
        weights_metadata("usdn", saved(tmp_path, load_file(SOURCE), recipe=text))


def test_weights_that_are_not_finite_are_refused(tmp_path):
    values = load_file(SOURCE)
    name = next(iter(values))
    values[name].view(-1)[0] = float("nan")
    with pytest.raises(FileError, match=f"{name} is not finite"):
        load_network("usdn", saved(tmp_path, values))


def test_sizes_that_a_header_declares_and_the_file_does_not_have(tmp_path):
    content, path = SOURCE.read_bytes(), tmp_path / "usdn.safetensors"
    (length,) = struct.unpack_from("<Q", content)
    header = json.loads(content[8 : 8 + length])
    name = next(key for key in header if key != "__metadata__")
    header[name]["shape"] = [2**40, 2**20]
    text = json.dumps(header).encode()
    for changed in (
        struct.pack("<Q", len(text)) + text + content[8 + length :],
        struct.pack("<Q", 2**63) + content[8:],
        content[: len(content) // 2],
        content[:8],
        b"\x00" * 100,
        b"",
    ):
        path.write_bytes(changed)
        for read in (lambda: load_network("usdn", path), lambda: compared([], path)):
            with pytest.raises(SpadwarpError, match=r"usdn\.safetensors"):
                read()
