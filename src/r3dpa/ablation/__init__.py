"""Ablation tables of the paper: rows of ``r3dpa fit`` commands, run once each and compared."""

from r3dpa.ablation.plan import make_plan
from r3dpa.ablation.runs import budget_of, run_plan
from r3dpa.ablation.tables import log_rows, write_table

__all__ = ["budget_of", "log_rows", "make_plan", "run_plan", "write_table"]
