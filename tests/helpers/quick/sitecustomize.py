"""How kernels of the tests are compiled, in every process: Python runs this file where its folder is on PYTHONPATH.

Warp's inlining and -O2 make kernels a seventh faster, which small runs never earn back: these compile in a third of the
time.
"""

import importlib.abc
import importlib.util
import sys

FLAGS = {"cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=50", "optimization_level": 1}


class _Finder(importlib.abc.MetaPathFinder):
    """Sets the flags when Warp's configuration is imported."""

    def find_spec(self, name, path, target=None):
        if name != "warp.config":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        run = spec.loader.exec_module

        def run_and_set(module):
            run(module)
            vars(module).update(FLAGS)

        spec.loader.exec_module = run_and_set
        return spec


if "warp.config" in sys.modules:
    vars(sys.modules["warp.config"]).update(FLAGS)
else:
    sys.meta_path.insert(0, _Finder())
