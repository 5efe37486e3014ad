"""The simulator against physics whose answer is known without it.

>>> import spadwarp
>>> results = spadwarp.validate.run(["slab", "cube60"], photons=1_000_000, seed=1)
>>> all(result.passed for result in results)
True
"""

from spadwarp.validate.cases import CASES, FAMILY_LEVEL, Case, CaseResult, draw_results, report, run
from spadwarp.values import guarded

__all__ = ["CASES", "FAMILY_LEVEL", "Case", "CaseResult", "draw_results", "report", "run"]
guarded(__name__)
