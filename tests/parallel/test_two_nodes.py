"""Ray over two nodes: what a node did that is lost is done again elsewhere."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.cli import ENVIRONMENT, ROOT

pytest.importorskip("ray")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="removes a node by a signal")
def test_a_run_that_loses_a_node_has_the_bits_of_a_local_one():
    environment = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(ROOT / "tests")])}
    command = [sys.executable, str(Path(__file__).with_name("two_nodes.py"))]
    process = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400)
    assert process.returncode == 0 and "same bits" in process.stdout, process.stderr[-3000:]
