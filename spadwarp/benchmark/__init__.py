"""How fast this machine is, in numbers that can be kept and compared: `run` measures named cases."""

from spadwarp.benchmark.cases import CASES, GROUPS, Case
from spadwarp.benchmark.results import BenchResult, load_report, ratios, report
from spadwarp.benchmark.runs import TransportRun, run

__all__ = ["CASES", "GROUPS", "BenchResult", "Case", "TransportRun", "load_report", "ratios", "report", "run"]
