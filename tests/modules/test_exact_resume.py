"""An interrupted run equals one that was not: two processes, loader processes, accumulation."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from stage_runs import QUICK, STAGES, assert_equal_runs

from r3dpa.data import kitti360_scans

SCRIPT = Path(__file__).with_name("recorded_fit.py")


@pytest.fixture(scope="module")
def resume_root(tmp_path_factory):
    """Scans for more than three steps an epoch; made by whoever trains first."""
    return tmp_path_factory.mktemp("resume") / "data"


def seen(run_dir):
    """Scans of each process in the order of the training."""
    return [(run_dir / f"seen_{rank}.txt").read_text().split() for rank in (0, 1)]


@pytest.mark.ddp
@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_three_steps_a_resume_and_three_more(
    stage, smoke_args, resume_root, from_previous, tmp_path
):
    """Bit for bit, within the first epoch, of which each scan is seen once and none twice."""
    more = [*QUICK, *from_previous(stage)]
    more += ["--trainer.devices=2", "--trainer.strategy=ddp", "--trainer.accumulate_grad_batches=2"]
    more += ["--data.init_args.batch_size=1", "--data.init_args.num_workers=2"]
    more += ["--data.init_args.num_scans=24", "--data.init_args.root", str(resume_root)]

    def fit(run_dir, *words):
        arguments = smoke_args(stage, run_dir, *more, *words)
        command = [sys.executable, str(SCRIPT), *arguments]
        subprocess.run(command, check=True, timeout=600, capture_output=True)

    fit(tmp_path / "whole", "--trainer.max_steps=6")
    fit(tmp_path / "parts", "--trainer.max_steps=3")
    assert [len(names) for names in seen(tmp_path / "parts")] == [6, 6]
    last = str(tmp_path / "parts" / "checkpoints" / "last.ckpt")
    fit(tmp_path / "parts", "--trainer.max_steps=6", "--ckpt_path", last)

    assert seen(tmp_path / "parts") == seen(tmp_path / "whole")
    num_scans = len(kitti360_scans(resume_root, "train"))
    epoch = num_scans // 2
    assert epoch > 6  # or the interruption would not be within it
    first = Counter(name for names in seen(tmp_path / "parts") for name in names[:epoch])
    assert len(first) == 2 * epoch
    assert set(first.values()) == {1}
    assert_equal_runs(tmp_path / "whole", tmp_path / "parts", 6)
