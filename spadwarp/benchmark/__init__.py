"""How fast this machine is, in numbers that can be kept and compared: `run` measures named cases."""

from spadwarp.benchmark.cases import CASES, GROUPS, Case
from spadwarp.benchmark.comparison import MARGIN, Comparison, compare, history, newest_report
from spadwarp.benchmark.results import BenchResult, load_report, report
from spadwarp.benchmark.runs import TransportRun, run

__all__ = ["CASES", "GROUPS", "MARGIN", "BenchResult", "Case", "Comparison", "TransportRun", "compare", "history"]
__all__ += ["load_report", "newest_report", "report", "run"]
