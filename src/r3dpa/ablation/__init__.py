"""Tables of the paper's ablations: rows of training stages, run once each, tested and compared."""

from r3dpa.ablation.budget import Budget, budget_of
from r3dpa.ablation.plan import Plan, Row, Scale, Stage, Table, make_plan, read_scale
from r3dpa.ablation.report import OrderResult, write_table
from r3dpa.ablation.runner import RunSettings, run_plan
from r3dpa.ablation.wandb_rows import log_rows

__all__ = [
    "Budget",
    "OrderResult",
    "Plan",
    "Row",
    "RunSettings",
    "Scale",
    "Stage",
    "Table",
    "budget_of",
    "log_rows",
    "make_plan",
    "read_scale",
    "run_plan",
    "write_table",
]
