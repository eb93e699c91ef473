"""Tiny settings of every baseline, and the words that train one."""

from __future__ import annotations

import json

#: Settings that make a stage tiny, on 16 x 64 images.
TINY = {
    "r2dm": {
        "network.init_args": {
            "in_channels": 2,
            "resolution": [16, 64],
            "base_channels": 8,
            "channel_multiplier": [1, 1, 1, 2],
            "num_residual_blocks": [1, 1, 1, 1],
            "gn_num_groups": 4,
            "attn_num_heads": 2,
        },
        "ema_after": 0,
        "ema_every": 1,
        "optimizer.warmup_steps": 0,
    },
    "r2flow": {
        "network.init_args": {
            "in_channels": 2,
            "resolution": [16, 64],
            "base_channels": 8,
            "time_channels": 8,
            "depths": [1, 1, 1, 1],
            "num_heads": [1, 1, 2, 2],
        },
        "ema_after": 0,
        "ema_every": 1,
        "optimizer.warmup_steps": 0,
    },
}
AUTOENCODER = {
    "num_codes": 8,
    "channels": 32,
    "channel_multipliers": [1, 1, 1, 1],
    "num_res_blocks": 1,
}
TINY["lidm"] = {
    "network.init_args": {
        "input_size": [4, 8],
        "channels": 32,
        "channel_multipliers": [1],
        "num_res_blocks": 1,
        "head_channels": 16,
    },
    "first_stage.init_args": AUTOENCODER,
}
FIRST_STAGES = {  # of the baselines that have one
    "lidm": (
        "lidm_first_stage",
        {
            "network.init_args": AUTOENCODER,
            "discriminator.init_args": {"channels": 8, "num_layers": 2},
        },
    ),
}
SETTINGS = {
    "data.init_args.num_scans": 12,
    "data.init_args.sensor.beams": 16,
    "data.init_args.sensor.columns": 64,
    "data.init_args.grid_size": "[2, 8]",
    "data.init_args.batch_size": 2,
    "data.init_args.num_workers": 0,
    "trainer.accelerator": "cpu",
    "trainer.devices": 1,
    "trainer.precision": "32-true",
    "trainer.max_steps": 3,
    "trainer.val_check_interval": 3,
    "trainer.limit_val_batches": 1,
    "trainer.logger": "false",
    "trainer.enable_progress_bar": "false",
    "trainer.enable_model_summary": "false",
    "trainer.callbacks": "[{class_path: r3dpa.callbacks.StepGuard}]",
}


def fit_words(command, stage, root, run_dir, *more):
    settings = SETTINGS | {"data.init_args.root": root, "run_dir": run_dir}
    for key, value in (TINY | dict(FIRST_STAGES.values()))[stage].items():
        inner = value if isinstance(value, dict) else {None: value}
        for name, number in inner.items():
            dotted = ".".join(filter(None, ("model.init_args", key, name)))
            settings[dotted] = json.dumps(number)
    words = [command, stage, "--preset", "demo"]
    return [*words, *(f"--{key}={value}" for key, value in settings.items()), *more]
