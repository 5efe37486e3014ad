"""The promise of what stays as it is."""

import importlib.util
import inspect
from pathlib import Path

import warp as wp

import spadwarp_kernels as sk

FOLDER = Path(__file__).parents[2] / "kernels"


def test_public_signatures_are_those_that_were_promised():
    """Names, arguments, defaults, fields of structs, and constants, one a line."""
    spec = importlib.util.spec_from_file_location("signatures", FOLDER / "signatures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    promised, found = ((text.splitlines()) for text in (module.PLACE.read_text(), module.signatures()))
    gone, new = ([line for line in a if line not in b] for a, b in ((promised, found), (found, promised)))
    assert not gone, (
        f"callers rely on {gone}; if it has to be, write kernels/signatures.txt anew and say so in CHANGELOG"
    )
    assert not new and promised == found, f"{new} is new: run `python kernels/signatures.py`"


def test_everything_public_is_documented():
    for name in sk.__all__:
        thing = getattr(sk, name)
        if isinstance(thing, (wp.Function, wp.Kernel)):
            thing = thing.func or thing.native_func
        if callable(thing) and not isinstance(thing, tuple):
            assert inspect.getdoc(thing), name
