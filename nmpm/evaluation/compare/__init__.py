"""Models on scenes of any family, their own or others, beside the simulator's uncertainty and trivial predictors."""

from nmpm.evaluation.compare.measure import compare, count_steps
from nmpm.evaluation.compare.outcome import Outcome
from nmpm.evaluation.compare.predictors import Candidate, make_predictors
from nmpm.evaluation.compare.report import write_report
from nmpm.evaluation.compare.table import failure_lines, origin_lines, outcome_table

__all__ = [
    "Candidate",
    "Outcome",
    "compare",
    "count_steps",
    "failure_lines",
    "make_predictors",
    "origin_lines",
    "outcome_table",
    "write_report",
]
