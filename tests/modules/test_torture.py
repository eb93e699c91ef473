"""Thirty steps through what breaks trainings: finite, one of them skipped, exact on resume."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_stages import QUICK, STAGES, assert_equal_runs, from_previous, load

from r3dpa.cli import main
from r3dpa.data import LidarDataset, find_scans, read_scan, write_bin
from r3dpa.nn import VAE, Posterior

BAD_ENCODING = 5  # of the run, counted from 0: a batch each
HALF, WHOLE = 15, 30


@pytest.fixture(scope="session")
def hard_scans(smoke_root, vae_checkpoint, tmp_path_factory):
    """Six scans: two of a single return, four as they are; the first one will be emptied."""
    folder = tmp_path_factory.mktemp("hard_scans")
    ordinary = [read_scan(scan.path) for scan in find_scans(str(smoke_root))[:4]]
    one = np.array([[10.0, 1.0, -1.0, 0.5]], np.float32)
    for number, points in enumerate([one, one, *ordinary]):
        write_bin(folder / "scans" / f"{number:06d}.bin", torch.from_numpy(points))
    return folder


@pytest.mark.numerics
@pytest.mark.slow
@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.filterwarnings("ignore:step .* was skipped")
def test_torture(stage, precision, smoke_args, vae_checkpoint, hard_scans, tmp_path, monkeypatch):
    encode, calls = VAE.encode, []

    def encode_badly(self, image):
        posterior = encode(self, image)
        calls.append((image > -1).sum().item())
        if len(calls) - 1 == BAD_ENCODING:
            moments = torch.cat([posterior.mean, posterior.logvar], dim=1)
            moments = moments + torch.zeros_like(moments).index_fill_(2, torch.tensor(1), torch.inf)
            return Posterior(moments)
        return posterior

    monkeypatch.setattr(VAE, "encode", encode_badly)
    get = LidarDataset.__getitem__

    def get_hard(self, index):
        sample = get(self, index)
        if sample["name"].endswith("000000"):  # no scan without a return can be read from a file
            sample["range_image"] = torch.full_like(sample["range_image"], -1.0)
            sample["valid_mask"] = torch.zeros_like(sample["valid_mask"])
            if "feature_grid" in sample:
                sample["feature_grid"] = torch.zeros_like(sample["feature_grid"])
        return sample

    monkeypatch.setattr(LidarDataset, "__getitem__", get_hard)

    def fit(run_dir, *words):
        more = [*QUICK, *from_previous(stage, vae_checkpoint), "--trainer.precision", precision]
        more += ["--data.class_path", "r3dpa.data.LidarDataModule"]
        more += ["--data.init_args.scans", str(hard_scans / "scans")]
        more += ["--data.init_args.features_dir", str(hard_scans / "grids")]
        more += ["--data.init_args.val_every=null", "--data.init_args.batch_size=1"]
        if stage == "flow_matching":  # a bad posterior in the cache would come back each epoch
            more += ["--model.init_args.cache_latents=false"]
        calls.clear()
        arguments = smoke_args(stage, run_dir, *more, *words)
        place = arguments.index("--data.init_args.root")  # of another class
        del arguments[place : place + 2]
        main(arguments)

    fit(tmp_path / "whole", "--trainer.max_steps", str(WHOLE))
    assert 0 in calls
    assert 1 in calls
    fit(tmp_path / "parts", "--trainer.max_steps", str(HALF))
    last = str(tmp_path / "parts" / "checkpoints" / "last.ckpt")
    monkeypatch.setattr("test_torture.BAD_ENCODING", -1)  # it lies before the resume
    fit(tmp_path / "parts", "--trainer.max_steps", str(WHOLE), "--ckpt_path", last)

    assert_equal_runs(tmp_path / "whole", tmp_path / "parts", WHOLE)
    for name in ("whole", "parts"):
        content = load(tmp_path / name)
        assert content["callbacks"]["StepGuard"] == {"skipped": 1, "in_a_row": 0}
        assert all(value.isfinite().all() for value in content["state_dict"].values())
    assert len(list((tmp_path / "whole" / "bad_batches").iterdir())) == 1
