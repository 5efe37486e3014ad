"""How fast this machine is: named cases, each a scene that `run` times."""

from spadwarp.benchmark.cases import CASES, BenchResult, load_report, ratios, report, run

__all__ = ["CASES", "BenchResult", "load_report", "ratios", "report", "run"]
