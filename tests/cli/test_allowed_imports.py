"""What a YAML file or a checkpoint from elsewhere names is not run."""

import sys

import pytest
import torch
import yaml

from r3dpa.checkpoints import networks, read_checkpoint
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


@pytest.mark.parametrize("words", [[], ["--allow_import", "torch.distributed"]])
@pytest.mark.parametrize("command", ["fit", "features", "convert"])
def test_no_argument_of_any_type_starts_a_shell(command, words, tmp_path, monkeypatch):
    """Not even a class that may be named: an argument without a base class gets plain values."""
    shell = {
        "class_path": "torch.distributed.elastic.multiprocessing.subprocess_handler."
        "SubprocessHandler",
        "init_args": {
            "entrypoint": "/bin/sh",
            "args": ["-c", f"echo > {tmp_path / 'run'}"],
            "env": {},
            "stdout": None,
            "stderr": None,
            "local_rank_id": 0,
            "numa_options": None,
        },
    }
    size = {"in_features": 1, "out_features": 1, "device": shell}
    extractor = {"class_path": "torch.nn.Linear", "init_args": size}
    data = {"root": str(tmp_path / "data"), "num_scans": 2, "extractor": extractor}
    content = {"data": {"class_path": "r3dpa.data.SimulatedDataModule", "init_args": data}}
    if command == "fit":
        content["model"] = {"class_path": "lightning.pytorch.demos.BoringModel"}
    if command == "convert":
        content = {"sit_args": {"alignment_depth": shell}}
        words = [str(tmp_path / "official.pt"), str(tmp_path / "out.safetensors"), *words]
    path = tmp_path / "hostile.yaml"
    path.write_text(yaml.safe_dump(content))
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, OSError, SystemExit)):
        main([command, "--config", str(path), *words])
    assert not (tmp_path / "run").exists()


def test_a_package_is_imported_only_if_the_command_line_allows_it(tmp_path, monkeypatch, capsys):
    package, path = "package_of_a_user", tmp_path / "own.yaml"
    text = "from r3dpa.data import LidarDataModule\nclass Own(LidarDataModule): ..."
    (tmp_path / f"{package}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    content = {"data": {"class_path": f"{package}.Own", "init_args": {"scans": "scans"}}}
    for more in ({}, {"allow_import": [package]}):
        path.write_text(yaml.safe_dump(content | more))
        with pytest.raises(SystemExit) as stop:
            main(["fit", "--config", str(path)])
        assert stop.value.code == 2
        assert package not in sys.modules
    path.write_text(yaml.safe_dump(content))
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(["fit", "--config", str(path), "--print_config", "--allow_import", package])
    assert stop.value.code == 0
    assert f"{package}.Own" in capsys.readouterr().out


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

    def test_a_network_of_a_user_needs_the_command_line(self, tmp_path, monkeypatch):
        """Nothing in the file allows it; the package stays allowed until the process ends."""
        package = "networks_of_a_user"
        text = "from torch import nn\nclass Own(nn.Linear): ..."
        (tmp_path / f"{package}.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setattr(networks, "_further_packages", [])
        path = tmp_path / "own.ckpt"
        init_args = {"in_features": 1, "out_features": 1, "bias": False}
        config = {"class_path": f"{package}.Own", "init_args": init_args}
        content = {
            "pytorch-lightning_version": "2.6.6",
            "state_dict": {"vae.weight": torch.zeros(1, 1)},
            "hyper_parameters": {"vae": config, "allow_import": [package]},
            "allow_import": [package],
        }
        torch.save(content, path)
        words = ["convert", str(path), str(tmp_path / "own.safetensors")]
        with pytest.raises(ValueError, match=r"Own' is not allowed: .* --allow_import PACKAGE"):
            main(words)
        assert package not in sys.modules
        main([*words, "--allow_import", package])
        assert type(read_checkpoint(words[2]).network("vae").build()).__name__ == "Own"

    @pytest.mark.parametrize(
        ("class_path", "message"),
        [
            ("absent_package.Own", r"cannot be imported \(No module .*: install its package, or"),
            ("r3dpa.nn.Absent", "does not exist"),
            ("absent_package_2.Own", "is not allowed"),  # whose name only starts alike
        ],
    )
    def test_a_class_that_cannot_be_imported(self, class_path, message, tmp_path, monkeypatch):
        monkeypatch.setattr(networks, "_further_packages", ["absent_package"])
        with pytest.raises(ValueError, match=message):
            read_checkpoint(self.lightning(tmp_path / "a.ckpt", class_path))

    @pytest.mark.parametrize("init_args", [{"channels": "many"}, ["no", "mapping"]])
    def test_arguments_that_no_network_takes(self, init_args, tmp_path):
        path = self.lightning(tmp_path / "a.ckpt", "r3dpa.nn.VAE", init_args)
        with pytest.raises(ValueError, match=r"cannot read .*a\.ckpt: "):
            read_checkpoint(path)
