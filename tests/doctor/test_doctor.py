"""`spadwarp doctor`: the self-test against known values, and messages about what is wrong."""

import re
import subprocess
import sys

import pytest
import warp as wp

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, run, tables
from spadwarp.validate import references


@pytest.mark.slow
def test_self_test_measures_what_is_known(tmp_path):
    printed = run("doctor", *DEVICE, "--json", tmp_path / "report.json").stdout
    report = tables(tmp_path / "report.json")
    assert report["healthy"] and not report["problems"] and bool(report["gpu"]) == (not wp.is_cuda_available())
    for test in report["tests"]:
        assert abs(test["value"] - test["reference"]) <= 4.5 * test["standard_error"] < 0.02
        assert test["name"] in printed
    assert report["facts"]["Packages"]["warp-lang"] == wp.__version__
    assert "cpu" in report["facts"]["Devices"]


def test_a_wrong_simulator_is_found_out(monkeypatch):
    monkeypatch.setattr(references, "SLABS", (references.SLABS[0]._replace(transmitted=0.67),))
    outcome = run("doctor", *DEVICE, "--quiet", code=1)
    assert "self-test: transmitted by the slab" in outcome.stderr and "FAILED" in outcome.stderr
    assert outcome.stdout == ""


def test_a_cache_that_cannot_be_written_is_a_problem(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "file" / "cache"))
    found = spadwarp.doctor.diagnose(device="cpu", self_test=False)
    assert not found.healthy and "set WARP_CACHE_PATH" in found.problems[0]


ARRIVAL = """
import numpy as np, spadwarp
spadwarp.arrival_time(np.ones((1, 1, 16)), gate_start=0.0, bin_width=1e-9, method="peak", device="cpu")
"""


@pytest.mark.slow
def test_a_cache_that_cannot_be_used_is_named(tmp_path):
    """In a process of its own, whose kernels are not loaded yet."""

    def last_line(cache, code=1):
        environment = {**ENVIRONMENT, "WARP_CACHE_PATH": str(cache)}
        process = subprocess.run([sys.executable, "-c", ARRIVAL], env=environment, capture_output=True, text=True)
        assert process.returncode == code, process.stderr
        return process.stderr.splitlines()[-1] if code else ""

    cache = tmp_path / "cache"
    last_line(cache, code=0)
    for pattern, content in (("*.o", b"not a program"), ("*.meta", b"{")):
        for path in cache.rglob(pattern):
            path.write_bytes(content)
        assert f"DeviceError: Warp's kernel cache {cache}" in (text := last_line(cache)) and "WARP_CACHE_PATH" in text
    (tmp_path / "file").touch()
    text = last_line(tmp_path / "file" / "cache")
    assert "Not a directory" in text and "set WARP_CACHE_PATH" in text


@pytest.mark.parametrize(
    ("version", "words"),
    [(None, "no NVIDIA driver"), (12080, r"runs CUDA 12\.8; Warp needs 13\.0"), (13000, "nvidia-smi")],
)
def test_what_is_missing_for_a_gpu(version, words, monkeypatch):
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(spadwarp.doctor, "_driver_cuda", lambda: version)
    monkeypatch.setattr(spadwarp.doctor.Path, "exists", lambda self: False)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    [reason] = spadwarp.doctor._gpu_reasons()
    assert re.search(words, reason)
