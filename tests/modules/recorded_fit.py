"""``r3dpa fit`` that notes, in ``<run_dir>/seen_<process>.txt``, the scans it trains on."""

from __future__ import annotations

import sys
from pathlib import Path

from lightning.pytorch import LightningModule

from r3dpa.cli import main


def note(self, batch, batch_idx):
    path = Path(self.trainer.default_root_dir) / f"seen_{self.global_rank}.txt"
    with path.open("a") as file:
        file.writelines(f"{name}\n" for name in batch["name"])


if __name__ == "__main__":
    LightningModule.on_train_batch_start = note
    main(sys.argv[1:])
