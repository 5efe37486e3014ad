"""`spadwarp doctor`: is everything there, and does it compute what it should?"""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, fail, say


@app.command()
def doctor(
    device: opt.Device = None,
    self_test: Annotated[bool, typer.Option("--self-test/--no-self-test", help="Trace two small scenes.")] = True,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Check the installation, and run a self-test.

    Shows versions, devices, driver, kernel cache, and what is missing for a GPU.

    The self-test takes a few seconds, and about twice as long when it first compiles its kernels. It compares ballistic
    light from a plate with the lidar equation, and a slab with published values. Exit code 1 for a problem or a failed
    test.

    \b
    Example:
      spadwarp doctor
      spadwarp doctor --device cpu --json report.json
    """
    outputs = opt.check_outputs(json=json_path, overwrite=overwrite)
    found = spadwarp.doctor.diagnose(device=device, self_test=self_test, progress=None if quiet else complain)
    if not quiet:
        for title, facts in found.facts.items():
            say(f"{title}\n{opt.rows(facts, indent='  ')}")
        if found.gpu:
            say("No GPU is used\n" + "\n".join(f"  {reason}" for reason in found.gpu))
        if found.tests:
            took = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in found.seconds.items())
            say(f"Self-test ({took})")
            say(opt.rows({test.name: _verdict(test) for test in found.tests}, indent="  "))
    outputs.write_json({**dataclasses.asdict(found), "healthy": found.healthy})
    if not found.healthy:
        failed = [f"self-test: {test.name}: {_verdict(test)}" for test in found.tests if not test.passed]
        fail("\n".join([*found.problems, *failed]))


def _verdict(test: spadwarp.doctor.SelfTest) -> str:
    verdict = "ok" if test.passed else "FAILED"
    if not test.standard_error:
        return f"{test.value:g} ({verdict})"
    return f"{test.value:.5f} ± {test.standard_error:.5f}, known: {test.reference:.5f} ({verdict})"
