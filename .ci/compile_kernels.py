"""Compiles the kernels of common runs into kernels/spadwarp_kernels/compiled.zip, which goes into the wheel.

python .ci/compile_kernels.py

With both packages installed, on Linux x86-64, before the wheels are built; no GPU is needed. The scenes that come with
the package are run with both estimators on the CPU, their counts drawn and their depth estimated; one is reconstructed;
a camera for simulators is run. Warp compiles for `x86-64-v3` meanwhile, and keeps the objects under the names that it
looks for later. For GPUs the same kernels are compiled, and the transport kernels that these scenes take there.
"""

import contextlib
import json
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import warp as wp
import warp._src.build

import spadwarp
import spadwarp_kernels as sk
from spadwarp.io.paths import examples
from spadwarp_kernels.base import kernels as compiled
from spadwarp_kernels.photon.queue import BLOCK_SIZE
from spadwarp_kernels.surface import bvh, patches
from spadwarp_kernels.transport import launch


def compile_for_target() -> None:
    """Replaces the processor at hand, for which Warp would compile."""
    build = warp._src.build.build_cpu

    def build_for_target(*args: Any, extra_flags: str = "", **options: Any) -> Any:
        assert "-march=native" in extra_flags.split(), extra_flags
        flags = extra_flags.replace("-march=native", f"-target-cpu {compiled.TARGET}")
        return build(*args, extra_flags=flags, **options)

    warp._src.build.build_cpu = build_for_target


class Launched:
    """The kernels that are launched from now on, as a GPU would take them: modules, and the threads of a block."""

    def __init__(self) -> None:
        self.modules: dict[wp.Module, int] = {}
        self._on_cpu: set[wp.Module] = set()  # of transport kernels, which GPUs have of their own
        self._launch, self._make = wp.launch, launch.make_transport_kernel
        wp.launch, launch.make_transport_kernel = self._record, self._record_transport

    def _record(self, kernel: wp.Kernel, *args: Any, block_dim: int = 256, **options: Any) -> Any:
        if kernel.module not in self._on_cpu:
            self.modules[kernel.module] = block_dim
        return self._launch(kernel, *args, block_dim=block_dim, **options)

    def _record_transport(self, spec: sk.TransportSpec, cuda: bool = False) -> wp.Kernel:
        kernel = self._make(spec, cuda)
        self._on_cpu.add(kernel.module)
        self.modules[self._make(spec, True).module] = BLOCK_SIZE
        return kernel

    def compile(self) -> None:
        for module in (bvh, patches):  # which only GPUs have
            self.modules[wp.get_module(module.__name__)] = 256
        for module, block_dim in self.modules.items():
            module.options["block_dim"] = block_dim
            wp.compile_aot_module(module, arch=compiled.PTX, use_ptx=True)
            wp.compile_aot_module(module, arch=compiled.CUBIN, use_ptx=False)


def run_common() -> None:
    for name in examples("scenes"):
        for estimator in ("guided", "next_event"):
            with contextlib.suppress(spadwarp.ConfigError):  # of scenes that one of them cannot trace
                scene = spadwarp.load_scene(name, {"transport.estimator": estimator})
                result = spadwarp.simulate(scene, photons=64 * scene.scan_positions, device="cpu")
        response = spadwarp.frames.detector_response(scene.detector, scene.laser)
        result.depth(device="cpu")
        result.depth(method="matched", irf=response, device="cpu")
        spadwarp.detect(result, pulses=1000, seed=0, device="cpu")
        with contextlib.suppress(spadwarp.ConfigError, spadwarp.ArgumentError):  # of scenes that only `simulate` takes
            spadwarp.simulate_analytic(scene, frames=1, seed=0, device="cpu")
        print(name, flush=True)
    whole = spadwarp.simulate("staircase_15m", photons=2**17, device="cpu")
    spadwarp.check(whole.scene, device="cpu")
    spadwarp.reconstruct(whole, device="cpu")


def run_cameras() -> None:
    """The cameras for simulators with shapes that are no meshes."""
    pose = wp.array([wp.transform_identity()], dtype=wp.transform, device="cpu")
    shapes = sk.make_shapes(["plane"], [(0, 0, 0)], local=[(0, 0, 3, 0, 0, 0, 1)], frame="optical", device="cpu")
    for method in ("centroid", "matched", "likelihood"):
        camera = sk.SpadCamera(sk.SpadConfig(width=4, height=4, method=method), device="cpu")
        camera.update(shapes, pose)
        camera.update_from_images(camera.true_depth)


def pack(cache: Path) -> None:
    with zipfile.ZipFile(compiled.ARCHIVE, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr(compiled.MANIFEST, json.dumps(compiled.this_system()))
        for path in sorted(path for path in cache.glob("*/*") if path.suffix in (".o", ".ptx", ".cubin")):
            archive.write(path, re.sub(r"\.cpu[0-9a-f]+\.o$", ".o", path.name))
        for path in sorted(cache.glob("*/*.meta")):
            archive.write(path, path.name)
    size = compiled.ARCHIVE.stat().st_size
    print(f"{compiled.ARCHIVE}: {len(archive.namelist())} files, {size / 2**20:.2f} MiB")


def main() -> None:
    compiled.ARCHIVE.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as cache:
        wp.config.kernel_cache_dir = cache
        compile_for_target()
        launched = Launched()
        run_common()
        run_cameras()
        launched.compile()
        pack(Path(wp.config.kernel_cache_dir))


if __name__ == "__main__":
    main()
