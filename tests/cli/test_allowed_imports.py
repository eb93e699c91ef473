"""What a YAML file or a checkpoint from elsewhere names is not run."""

import sys

import pytest
import torch
import yaml

from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli import main


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("fit", "os.system"),
        ("features", "os.system"),
        ("reference", "os.system"),
        ("fit", "torch.load"),
        ("fit", "r3dpa.io.os.system"),
    ],
)
def test_functions_that_run_commands_or_code_are_refused(command, name, tmp_path, capsys):
    call = {"class_path": name, "init_args": {"command": f"touch {tmp_path / 'run'}"}}
    path = tmp_path / "hostile.yaml"
    path.write_text(yaml.safe_dump({"data" if command != "fit" else "model": call}))
    words = ["--config", str(path)]
    if command == "reference":
        words = ["--data", str(path), "--out", str(tmp_path / "out.safetensors")]
    with pytest.raises((ValueError, SystemExit)) as stop:
        main([command, *words])
    assert "not allowed" in str(stop.value) + capsys.readouterr().err
    assert not (tmp_path / "run").exists()


class TestCheckpoints:
    """Class paths stored in checkpoints: networks of ``r3dpa.nn`` and nothing else."""

    def lightning(self, path, class_path, init_args=None):
        config = {"class_path": class_path, "init_args": init_args or {}}
        content = {
            "pytorch-lightning_version": "2.6.6",
            "state_dict": {"vae.weight": torch.zeros(1)},
            "hyper_parameters": {"vae": config},
        }
        torch.save(content, path)
        return path

    def test_hostile_class_is_not_imported(self, tmp_path, monkeypatch):
        (tmp_path / "hostile.py").write_text("class Model: pass")
        monkeypatch.syspath_prepend(str(tmp_path))
        path = self.lightning(tmp_path / "a.ckpt", "hostile.Model")
        with pytest.raises(ValueError, match=r"a\.ckpt: vae: class 'hostile.Model' is not allowed"):
            read_checkpoint(path)
        assert "hostile" not in sys.modules

    @pytest.mark.parametrize("init_args", [{"channels": "many"}, ["no", "mapping"]])
    def test_arguments_that_no_network_takes(self, init_args, tmp_path):
        path = self.lightning(tmp_path / "a.ckpt", "r3dpa.nn.VAE", init_args)
        with pytest.raises(ValueError, match=r"cannot read .*a\.ckpt: "):
            read_checkpoint(path)
