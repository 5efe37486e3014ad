"""Compiled kernels, put where Warp looks for them and only where they can be used; what is made once."""

import json
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.lit_box import lit_box
from spadwarp_kernels import unpack_kernels
from spadwarp_kernels.base import kernels as compiled
from spadwarp_kernels.transport import launch


@pytest.fixture
def archive(tmp_path, monkeypatch):
    """Makes an archive with one module, for a system of these properties; Warp's cache is a folder of its own."""

    def make(features=compiled.FEATURES, **changed):
        with zipfile.ZipFile(tmp_path / "compiled.zip", "w") as file:
            file.writestr(compiled.MANIFEST, json.dumps({**compiled.this_system(), **changed}))
            for ending in ("o", "sm75.ptx", "sm80.cubin", "sm90.cubin", "meta"):
                file.writestr(f"wp_module_0123456.{ending}", b"{}")
        monkeypatch.setattr(compiled, "_processor_features", lambda: set(features))

    wp.init()
    monkeypatch.setattr(compiled, "ARCHIVE", tmp_path / "compiled.zip")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    return make


def test_compiled_kernels_have_the_names_that_warp_looks_for(archive, tmp_path, device):
    archive()
    unpack_kernels()

    @wp.kernel(module="unique")
    def fill(values: wp.array(dtype=float)):
        values[wp.tid()] = 1.0

    wp.launch(fill, dim=1, outputs=[wp.zeros(1, dtype=float, device=device)], device=device)
    ours = tmp_path / "cache" / "wp_module_0123456"
    (own,) = (folder for folder in ours.parent.glob("wp_*fill*") if folder.is_dir())
    own_names, our_names = (
        {file.name.removeprefix(f"{folder.name}.") for file in folder.iterdir()} for folder in (own, ours)
    )
    sources = {"cpp", "cu"}
    assert own_names - sources <= our_names  # what Warp has compiled is there, by the names it looks for
    assert all(name == "meta" or name.endswith((".o", ".ptx", ".cubin")) for name in our_names)  # and nothing temporary


def test_gpus_get_ptx_or_machine_code_as_their_driver_reads(archive, tmp_path, monkeypatch):
    gpus = [("ptx", 80), ("ptx", 80), ("ptx", 120), ("cubin", 89), ("cubin", 90), ("cubin", 75)]
    answers = ("get_cuda_output_format.return_value", "get_cuda_compile_arch.return_value")
    made = [Mock(**dict(zip(answers, gpu, strict=True))) for gpu in gpus]
    made.insert(0, Mock(**{"get_cuda_compile_arch.side_effect": RuntimeError("too old for this Warp")}))
    monkeypatch.setattr(wp, "get_cuda_devices", lambda: made)
    archive(features=())
    assert unpack_kernels() == 3
    names = {path.name.partition(".")[2] for path in (tmp_path / "cache" / "wp_module_0123456").iterdir()}
    assert names == {"sm80.ptx", "sm120.ptx", "sm89.cubin", "sm90.cubin", "meta"}


def test_what_is_there_stays(archive, tmp_path):
    archive()
    unpack_kernels()
    (place,) = (tmp_path / "cache").glob("*/*.o")
    place.write_bytes(b"Warp's own")
    assert unpack_kernels() == 0 and place.read_bytes() == b"Warp's own"


@pytest.mark.parametrize("changed", [{"warp": "1.0"}, {"system": "Plan9"}, {"machine": "vax"}, {"features": ("avx",)}])
def test_an_archive_for_another_system_is_left_alone(archive, tmp_path, monkeypatch, changed):
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    archive(**changed)
    assert unpack_kernels() == 0 and not (tmp_path / "cache").exists()


def test_none_and_a_damaged_archive_are_no_failure(archive):
    assert unpack_kernels() == 0
    compiled.ARCHIVE.write_bytes(b"not a zip file")
    assert unpack_kernels() == 0
    for manifest in ({}, {compiled.MANIFEST: "not JSON"}):
        with zipfile.ZipFile(compiled.ARCHIVE, "w") as file:
            for name, text in manifest.items():
                file.writestr(name, text)
        assert unpack_kernels() == 0


def test_each_thread_gets_its_own_function():
    @compiled.memoised
    def make(number):
        @wp.func
        def one() -> int:
            return wp.static(number)

        return one

    before = sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-6)  # threads take turns all the time
        with ThreadPoolExecutor(8) as pool:
            made = list(pool.map(make, range(100)))
    finally:
        sys.setswitchinterval(before)
    assert [function.func.__closure__[0].cell_contents for function in made] == list(range(100))
    assert [make(number) for number in range(100)] == made


def test_the_kernel_that_is_loaded_is_launched(device, monkeypatch):
    made, make = [], launch.make_transport_kernel
    monkeypatch.setattr(launch, "make_transport_kernel", lambda *choices: made.append(make(*choices)) or made[-1])
    model = sk.Model(device, mesh=None, surfaces=sk.make_surfaces(None, device=device), scale=2.0**50, **lit_box())
    spec = sk.TransportSpec("next_event", mesh=False)
    sk.load_transport_kernel(spec, device)
    sk.launch_transport(spec, model, sk.make_data(model), seed=1, first_id=0, photon_count=20)
    assert len(made) == 2 and made[0] is made[1]
