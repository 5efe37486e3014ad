"""Kernels that were compiled when the package was built: a first run then compiles nothing on common CPUs.

The archive has CPU objects by Warp's own names, which contain a hash of the source and the options of a kernel: one
that was changed since is not found and is compiled as ever. It serves the version of Warp that it was made with.
"""

import contextlib
import json
import os
import platform
import secrets
import zipfile
import zlib
from pathlib import Path

import warp as wp

# Made by .ci/compile_kernels.py; a checkout has none.
ARCHIVE = Path(__file__).with_name("compiled.zip")
MANIFEST = "manifest.json"

TARGET = "x86-64-v3"
"""The processors whose instructions the objects use: Intel since 2013 and AMD since 2017, but for the smallest."""
FEATURES = ("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe")
"""These instructions by their names in /proc/cpuinfo."""

# An archive that is damaged, or a cache that cannot be written: kernels are then compiled as without it.
_UNUSABLE = (OSError, RuntimeError, ValueError, KeyError, zipfile.BadZipFile, zlib.error)


def unpack_kernels() -> int:
    """Puts the compiled kernels of this package into Warp's kernel cache, where they are not there already.

    For programs of their own, before their first kernel; `spadwarp` calls it.

    Returns:
        The number of modules added: 0 where the package has none for this version of Warp, system and processor, and
        where it is damaged or the cache cannot be written.
    """
    if not ARCHIVE.exists():
        return 0
    wp.init()
    with contextlib.suppress(*_UNUSABLE), zipfile.ZipFile(ARCHIVE) as archive:
        if this_system() == json.loads(archive.read(MANIFEST)) and set(FEATURES) <= _processor_features():
            # The end of this key is what Warp adds to the names of objects for the processor at hand.
            ending = "cpu" + wp.get_cpu_kernel_cache_key().rpartition("-")[2]
            return sum(_unpack(archive, name, ending) for name in archive.namelist() if name.endswith(".o"))
    return 0


def this_system() -> dict[str, str]:
    """What an archive must be made for to be of use here, the features of the processor aside."""
    return {"warp": wp.__version__, "system": platform.system(), "machine": platform.machine(), "target": TARGET}


def _processor_features() -> set[str]:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("flags"):
            return set(line.split())
    return set()


def _unpack(archive: zipfile.ZipFile, name: str, ending: str) -> bool:
    module = name.removesuffix(".o")
    folder = Path(wp.config.kernel_cache_dir) / module
    parts = {f"{module}.o": folder / f"{module}.{ending}.o", f"{module}.meta": folder / f"{module}.meta"}
    missing = {part: path for part, path in parts.items() if not path.exists()}
    for part, path in missing.items():
        folder.mkdir(parents=True, exist_ok=True)
        temporary = folder / f".{secrets.token_hex(8)}"
        temporary.write_bytes(archive.read(part))
        os.replace(temporary, path)
    return bool(missing)
