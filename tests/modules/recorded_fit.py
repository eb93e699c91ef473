"""``r3dpa fit`` that notes, in ``<run_dir>/seen_<process>.txt``, the scans it trains on."""

from __future__ import annotations

import sys
from pathlib import Path

from r3dpa.cli import main
from r3dpa.modules import GenerativeModule

begin = GenerativeModule.on_train_batch_start


def begin_and_note(self, batch, batch_idx):
    path = Path(self.trainer.default_root_dir) / f"seen_{self.global_rank}.txt"
    with path.open("a") as file:
        file.writelines(f"{name}\n" for name in batch["name"])
    begin(self, batch, batch_idx)


if __name__ == "__main__":
    GenerativeModule.on_train_batch_start = begin_and_note
    main(sys.argv[1:])
