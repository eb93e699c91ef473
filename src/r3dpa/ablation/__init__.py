"""Ablation tables of the paper: rows of training stages, run once each, tested and compared."""

from r3dpa.ablation.plan import make_plan, read_scale
from r3dpa.ablation.run import budget_of, run_plan
from r3dpa.ablation.tables import log_rows, write_table

__all__ = ["budget_of", "log_rows", "make_plan", "read_scale", "run_plan", "write_table"]
