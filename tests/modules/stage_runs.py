"""What the tests of whole trainings share."""

from __future__ import annotations

import torch

STAGES = ("vae_alignment", "joint", "flow_matching", "few_step")
QUICK = ["--trainer.logger=false", "--trainer.limit_val_batches=0", "--trainer.callbacks=[]"]


def load(run_dir):
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)


def assert_equal_runs(run_dir, other_dir, num_steps):
    """Step, all weights and all moments of the optimizer, bit for bit."""
    runs = [load(path) for path in (run_dir, other_dir)]
    assert [run["global_step"] for run in runs] == [num_steps] * 2
    states = [(run["state_dict"], run["optimizer_states"][0]["state"]) for run in runs]
    torch.testing.assert_close(*states, atol=0, rtol=0)
