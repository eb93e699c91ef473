"""Ablation tables of the paper: rows of training stages, run once each, tested and compared."""

from r3dpa.ablation.budget import budget_of, flop_per_sample
from r3dpa.ablation.plan import Plan, Row, Scale, Stage, Table, make_plan, read_scale
from r3dpa.ablation.run import RunSettings, run_plan
from r3dpa.ablation.tables import OrderResult, write_table
from r3dpa.ablation.tracking import log_rows

__all__ = [
    "OrderResult",
    "Plan",
    "Row",
    "RunSettings",
    "Scale",
    "Stage",
    "Table",
    "budget_of",
    "flop_per_sample",
    "log_rows",
    "make_plan",
    "read_scale",
    "run_plan",
    "write_table",
]
