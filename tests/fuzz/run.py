# ruff: noqa: E402  (threads are switched off before anything is loaded)
"""The fuzzing harness by itself: `python tests/fuzz/run.py 20000 --out findings.jsonl`.

Each case runs in a child process of its own, forked from this one in which everything is loaded, with 60 s of the
processor and 2 GB.
"""

import argparse
import collections
import contextlib
import gc
import io
import json
import os
import sys
import tempfile
import time
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # threads do not survive a fork
sys.path[:0] = [str(Path(__file__).parents[1])]

from fuzz import api_calls, kernel_calls
from fuzz.cases import CATEGORIES, draw
from fuzz.command_lines import program
from fuzz.corpus import SPECIAL, Corpus, make_corpus
from fuzz.executed import run_case
from helpers.cli import run as run_command
from helpers.coarse_pictures import coarse_pictures
from helpers.quick import sitecustomize  # noqa: F401

FINE = ("done", "refused")


def warm_up(corpus: Path) -> None:
    """Loads what the commands load, and compiles or loads the kernels."""
    counts = ("--input", "bin_width=200ps,gate_start=1ns,group_index=1,irf=300ps")
    cpu = ("--device", "cpu")
    with tempfile.TemporaryDirectory() as out, contextlib.redirect_stderr(io.StringIO()):
        for number, (command, name, *rest) in enumerate((
            ("simulate", "calibrated.toml", "--photons", "50", *cpu),
            ("analytic", "scene.toml", "--frames", "1", *cpu),
            ("detect", "result.h5", "--pulses", "9", *cpu),
            ("depth", "counts.npy", *counts, "--method", "likelihood", *cpu),
            ("depth", "counts.ptu", *counts, "--method", "peak", *cpu),
            ("denoise", "depth.npy", "--model", "usdn", *cpu),
            ("export", "frames.h5", "--format", "mat"),
            ("view", "result.h5", *cpu),
            *(("simulate", name, "--photons", "50", *cpu) for name in SPECIAL),
        )):  # fmt: skip
            run_command(command, corpus / name, *rest, "--out", f"{out}/{number}{'.html' * (command == 'view')}")


def verdict_of(category: str, number: int, corpus: Corpus) -> tuple[str, str, str]:
    """Verdict, text and what was run."""
    if category == "kernels":
        return *kernel_calls.run(number), "kernels"
    if category == "api":
        return api_calls.run(number, corpus.folder)
    case = draw(number, corpus, category)
    return *run_case(case, corpus.folder), " ".join(case.arguments)[:300]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=int)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument(
        "--only", default=",".join([*CATEGORIES, "kernels", "api"]), help="categories, separated by commas"
    )
    parser.add_argument("--seconds", type=float, default=1e9, help="after which no further case begins")
    parser.add_argument("--out", help="findings as JSON lines")
    options = parser.parse_args()
    names, findings, began = options.only.split(","), 0, time.monotonic()
    counts = {name: collections.Counter() for name in names}
    with tempfile.TemporaryDirectory(prefix="corpus-") as folder:
        corpus = Corpus(Path(folder))
        make_corpus(corpus.folder)
        coarse_pictures()
        warm_up(corpus.folder)
        if "kernels" in names:
            kernel_calls.warm_up()
        if "api" in names:
            api_calls.warm_up(corpus.folder)
        program()
        gc.collect()
        gc.freeze()  # else the first collection of every child copies this process's memory
        for number in range(options.first, options.first + options.cases):
            if time.monotonic() > began + options.seconds:
                break
            category = names[number % len(names)]
            verdict, text, about = verdict_of(category, number, corpus)
            counts[category][verdict] += 1
            if verdict not in FINE:
                findings += 1
                print(f"{category} {number}: {verdict}: {about}\n{text}\n", file=sys.stderr, flush=True)
                if options.out:
                    with open(options.out, "a") as file:
                        print(json.dumps(dict(case=number, verdict=verdict, about=about, text=text)), file=file)
    verdicts = sorted({verdict for one in counts.values() for verdict in one}, key=lambda one: (one not in FINE, one))
    print(f"{'':12}" + "".join(f"{verdict:>12}" for verdict in verdicts))
    for name, one in counts.items():
        print(f"{name:12}" + "".join(f"{one[verdict]:12}" for verdict in verdicts))
    print(f"{sum(one.total() for one in counts.values())} cases, {findings} findings, {time.monotonic() - began:.0f} s")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
