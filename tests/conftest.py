"""What all tests share: devices, markers, runs. Hypothesis draws the same examples each time, and nothing fails because
a machine is slow."""

import contextlib
import os
import sys

# Tests run side by side; threads of BLAS and OpenMP that wait for small matrices would take the cores from each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")  # BM3D's, which sets that of torch too

import pytest
from hypothesis import HealthCheck, settings

import spadwarp
from helpers.quick import sitecustomize
from helpers.runs import RUN
from helpers.scenes import scene
from helpers.statistics_of_samples import DEVICES

settings.register_profile(
    "spadwarp", deadline=None, derandomize=True, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("spadwarp")


def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, default=54, metavar="N", help="cases of the fuzzing harness, tests/fuzz")


def pytest_collection_modifyitems(items):
    """What is marked neither `physics` nor `slow` is `fast`."""
    for item in items:
        if not {"physics", "slow"} & {mark.name for mark in item.iter_markers()}:
            item.add_marker("fast")


@pytest.fixture(params=DEVICES)
def device(request):
    """The CPU, and the first GPU where there is one; bits are never compared between them."""
    return request.param


@pytest.fixture(scope="session")
def whole():
    return spadwarp.simulate(scene(), **RUN, device="cpu")


@pytest.fixture(scope="session")
def cluster():
    """Two cores of Ray for all tests of this process. None of its processes stays, even of a Ray that did not start."""
    ray = pytest.importorskip("ray")
    psutil = pytest.importorskip("psutil")
    here, started = psutil.Process(), set()
    before = set(here.children())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([os.path.dirname(sitecustomize.__file__), *sys.path]))
        try:
            try:
                cores = {"num_cpus": 2, "num_gpus": 0}
                ray.init(**cores, include_dashboard=False, log_to_driver=False, object_store_memory=100 << 20)
            finally:
                started = set(here.children(recursive=True)) - before
            yield
        finally:
            ray.shutdown()
            for process in started:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
            psutil.wait_procs(started, timeout=10)
