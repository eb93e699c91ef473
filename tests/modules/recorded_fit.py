"""``r3dpa fit`` that notes, in ``<run_dir>/seen_<process>.txt``, the scans it trains on."""

from __future__ import annotations

import sys
from pathlib import Path

from r3dpa.callbacks import StepGuard
from r3dpa.cli import main

begin = StepGuard.on_train_batch_start


def begin_and_note(self, trainer, module, batch, batch_idx):
    path = Path(trainer.default_root_dir) / f"seen_{trainer.global_rank}.txt"
    with path.open("a") as file:
        file.writelines(f"{name}\n" for name in batch["name"])
    begin(self, trainer, module, batch, batch_idx)


if __name__ == "__main__":
    StepGuard.on_train_batch_start = begin_and_note
    main(sys.argv[1:])
