"""Evaluations with given numbers, as `r3dpa test` would write them."""

from r3dpa.metrics.results import Evaluation, MetricResult


def evaluation(step=None, **values):
    about = {"protocol": {"name": "default"}, "reference": "r", "seed": 0, "published": False}
    about |= dict.fromkeys(("solver", "steps", "precision", "commit", "feature_source"))
    about |= {"backbones": {}, "source": "s", "extra": {} if step is None else {"step": step}}
    rows = tuple(
        MetricResult(name, value, (value - 0.1, value + 0.1), scale=-2)
        for name, value in values.items()
    )
    return Evaluation("x", rows, about)
