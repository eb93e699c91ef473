from pathlib import Path

import torch

from r3dpa.cli import main
from r3dpa.nn.backbones import feature_source

CONF = Path(__file__).resolve().parents[2] / "conf"
TINY = {
    "data.init_args.source.init_args.num_scans": 12,
    "data.init_args.source.init_args.simulation_seed": 0,
    "data.init_args.batch_size": 1,
    "data.init_args.num_workers": 0,
    "model.init_args.network.init_args.width": 8,
    "model.init_args.network.init_args.depth": 3,
    "trainer.accelerator": "cpu",
    "trainer.enable_progress_bar": "false",
    "trainer.enable_model_summary": "false",
    "trainer.limit_val_batches": 1,
    "trainer.val_check_interval": 2,
    "trainer.log_every_n_steps": 1,
    "trainer.logger": "false",
    "trainer.max_steps": 4,
    "checkpoint.every_n_train_steps": 2,
    "checkpoint.save_top_k": -1,
}


def train(smoke_root, run_dir, *more):
    configs = ["trainer.yaml", "data/points.yaml", "experiment/waffleiron_s.yaml"]
    words = [word for name in configs for word in ("--config", str(CONF / name))]
    words += [f"--{key}={value}" for key, value in TINY.items()]
    words += [f"--data.init_args.source.init_args.root={smoke_root}", f"--run_dir={run_dir}"]
    main(["fit", *words, *more])
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def test_the_shipped_config_trains_resumes_exactly_and_gives_a_source(smoke_root, tmp_path):
    whole = train(smoke_root, tmp_path / "whole")
    middle = tmp_path / "whole" / "checkpoints" / "step=0000002.ckpt"
    resumed = train(smoke_root, tmp_path / "rest", f"--ckpt_path={middle}")
    for key, value in whole.items():
        assert torch.equal(resumed[key], value), key
    weights = tmp_path / "rest" / "waffleiron_s.safetensors"
    features = feature_source("waffleiron-s", weights, dim=16)(torch.rand(50, 4) * 10)
    assert features.shape == (50, 16)
    assert torch.allclose(features.norm(dim=1), torch.ones(50), atol=1e-5)
