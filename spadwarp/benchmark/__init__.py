"""How fast this machine is, in numbers that can be kept and compared: `run` measures named cases."""

from spadwarp.benchmark.cases import CASES, GROUPS, Case
from spadwarp.benchmark.runs import (
    MARGIN,
    BenchResult,
    Comparison,
    TransportRun,
    compare,
    history,
    load_report,
    newest_report,
    report,
    run,
)

__all__ = ["CASES", "GROUPS", "MARGIN", "BenchResult", "Case", "Comparison", "TransportRun", "compare", "history"]
__all__ += ["load_report", "newest_report", "report", "run"]
