"""Configurations name classes of a few packages only, and nothing else is imported."""

from __future__ import annotations

import os
import sys

import pytest
import torch
import yaml
from lightning import LightningModule
from torch import nn

from r3dpa.checkpoints import NetworkState, read_checkpoint
from r3dpa.cli import main
from r3dpa.cli.evaluate import reference
from r3dpa.imports import PACKAGES

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")

COMMANDS = ("fit", "validate", "test", "predict", "features")


@pytest.fixture
def hostile(tmp_path, monkeypatch):
    """Name of a package whose import makes the file ``imported`` in the test's folder."""
    name = f"hostile_{tmp_path.name}".replace("-", "_")
    package = tmp_path / "packages" / name
    package.mkdir(parents=True)
    package.joinpath("__init__.py").write_text(
        "from pathlib import Path\n"
        "from lightning import LightningDataModule, LightningModule\n"
        f"Path({str(tmp_path / 'imported')!r}).touch()\n"
        "class Model(LightningModule): pass\n"
        "class Data(LightningDataModule): pass\n"
    )
    monkeypatch.syspath_prepend(str(package.parent))
    yield name
    sys.modules.pop(name, None)


@pytest.fixture
def refused(tmp_path, capsys):
    """``refused(command, content, *words)``: error about a YAML file with this content."""

    def run(command, content, *words):
        path = tmp_path / "hostile.yaml"
        path.write_text(yaml.safe_dump(content))
        with pytest.raises((ValueError, SystemExit)) as stop:
            main([command, "--config", str(path), "--run_dir", str(tmp_path), *words])
        assert not (tmp_path / "imported").exists()
        return str(stop.value) + capsys.readouterr().err

    return run


@pytest.mark.parametrize("command", COMMANDS)
def test_hostile_yaml_is_refused_before_its_class_is_imported(command, hostile, tmp_path):
    path, key = tmp_path / "hostile.yaml", "data" if command == "features" else "model"
    path.write_text(yaml.safe_dump({key: {"class_path": f"{hostile}.Model"}}))
    with pytest.raises(
        ValueError,
        match=rf"hostile\.yaml: configuration key {key}: class '{hostile}\.Model' is refused.*"
        rf"--allow-imports {hostile}",
    ):
        main([command, "--config", str(path)])
    assert not (tmp_path / "imported").exists()


def test_nested_class(refused, hostile):
    arguments = {"vae": {"class_path": f"{hostile}.Model"}}
    model = {"class_path": "r3dpa.modules.VAEAlignment", "init_args": arguments}
    message = refused("fit", {"model": model})
    assert f"configuration key model.vae: class '{hostile}.Model' is refused" in message


def test_classes_in_lists_and_in_arguments_of_any_type(refused, hostile):
    callbacks = [{"class_path": f"{hostile}.Model"}]
    message = refused("fit", {"trainer": {"callbacks": callbacks}})
    assert f"class '{hostile}.Model' is refused" in message
    logger = {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "x"}}
    logger["init_args"]["name"] = {"class_path": f"{hostile}.Model"}
    refused("fit", {"trainer": {"logger": [logger]}})


@pytest.mark.parametrize(
    "name",
    [
        "os.system",
        "r3dpa.io.os.system",  # where it is defined counts
        "r3dpa.checkpoints.files.subprocess.run",
        "builtins.eval",
        "torch.hub.load",
        "torch.load",
        "r3dpa.cli.main",
        "r3dpa.bench.hardware.peak_of",
        # With weights_only=False it unpickles whatever the file holds.
        "r3dpa.modules.VAEAlignment.load_from_checkpoint",
    ],
)
def test_functions_that_run_what_they_are_told(refused, name):
    message = refused("fit", {"model": {"class_path": name, "init_args": {"command": "true"}}})
    assert "is refused" in message


def test_a_configuration_cannot_allow_itself(refused, hostile):
    content = {"allow_imports": hostile, "model": {"class_path": f"{hostile}.Model"}}
    assert "is refused" in refused("fit", content)


def test_allowed_for_one_command_only(refused, hostile, tmp_path):
    content = {"model": {"class_path": f"{hostile}.Model"}}
    path = tmp_path / "trusted.yaml"
    path.write_text(yaml.safe_dump(content))
    # Allowed, the module is imported, and the run stops at the next thing that is wrong.
    words = ["fit", "--config", str(path), f"--allow-imports=torch,{hostile}"]
    with pytest.raises((ValueError, SystemExit)) as stop:
        main([*words, "--trainer.max_steps", "none"])
    assert "is refused" not in str(stop.value)
    assert (tmp_path / "imported").exists()
    (tmp_path / "imported").unlink()
    del sys.modules[hostile]
    assert "is refused" in refused("fit", content)


@pytest.mark.parametrize("words", [["--allow-imports", "a/b"], ["--allow-imports="]])
def test_an_option_that_names_no_package(words):
    with pytest.raises(ValueError, match="--allow-imports needs names of packages"):
        main(["fit", *words])


def test_data_yaml_of_other_commands(hostile, tmp_path):
    path = tmp_path / "data.yaml"
    path.write_text(yaml.safe_dump({"data": {"class_path": f"{hostile}.Data"}}))
    with pytest.raises(ValueError, match=rf"class '{hostile}\.Data' is refused"):
        reference(path, tmp_path / "out.safetensors")
    assert not (tmp_path / "imported").exists()


def test_packages_exist_and_hold_nothing_that_unpickles():
    for name in PACKAGES:
        __import__(name)
    assert LightningModule.__module__ not in PACKAGES
    assert not {"torch", "lightning", "lightning.pytorch"} & set(PACKAGES)


class TestCheckpoints:
    """Class paths stored in checkpoints: networks of ``r3dpa.nn`` and nothing else."""

    def lightning(self, path, class_path, init_args=None, **more):
        config = {"class_path": class_path, "init_args": init_args or {}}
        content = {
            "pytorch-lightning_version": "2.6.6",
            "state_dict": {"vae.weight": torch.zeros(1)},
            "hyper_parameters": {"vae": config},
            **more,
        }
        torch.save(content, path)
        return path

    def test_hostile_class_is_not_imported(self, hostile, tmp_path):
        path = self.lightning(tmp_path / "a.ckpt", f"{hostile}.Model")
        with pytest.raises(ValueError, match=rf"a\.ckpt: vae: class '{hostile}.Model' is not all"):
            read_checkpoint(path)
        assert not (tmp_path / "imported").exists()

    @pytest.mark.parametrize(
        "name",
        [
            *("os.system", "r3dpa.nn.os", "r3dpa.nn.vae.nn.Linear", "r3dpa.nnx.VAE", "VAE", "", 3),
            *(None, "r3dpa.nn..vae.VAE", "r3dpa.nn.vae."),
            "r3dpa.nn.backbones.ScaLR.from_checkpoint",
        ],
    )
    def test_other_names(self, name, tmp_path):
        with pytest.raises(ValueError, match=r"a\.ckpt: vae: class"):
            read_checkpoint(self.lightning(tmp_path / "a.ckpt", name))

    def test_pickled_code_is_not_run(self, tmp_path):
        class Evil:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "imported"),)

        path = self.lightning(tmp_path / "a.ckpt", "r3dpa.nn.VAE", extra=Evil())
        with pytest.raises(ValueError, match=r"a\.ckpt: the file would run \S*mkdir when loaded"):
            read_checkpoint(path)
        assert not (tmp_path / "imported").exists()

    @pytest.mark.parametrize(
        ("class_path", "init_args"),
        [
            ("r3dpa.nn.SiT", {"depth": 10**9}),
            ("r3dpa.nn.SiT", {"hidden_size": 2**62}),
            ("r3dpa.nn.VAE", {"num_res_blocks": 10**8}),
            ("r3dpa.nn.VAE", {"channels": 0}),
            ("r3dpa.nn.VAE", {"channels": "many"}),
            ("r3dpa.nn.PatchDiscriminator", {"num_layers": 10**8}),
            ("r3dpa.nn.VAE", ["no", "mapping"]),
        ],
    )
    def test_sizes_that_would_never_be_built(self, class_path, init_args, tmp_path):
        path = self.lightning(tmp_path / "a.ckpt", class_path, init_args)
        with pytest.raises(ValueError, match=r"cannot read .*a\.ckpt: vae: "):
            read_checkpoint(path)

    def test_networks_still_check_after_a_refusal(self, tmp_path):
        with pytest.raises(ValueError, match="more than 8 parameters"):
            NetworkState("r3dpa.nn.SiT", {}, {"weight": torch.zeros(1)}).check()
        network = nn.Sequential(*(nn.BatchNorm1d(1) for _ in range(9)))  # counted in files alone
        with pytest.raises(ValueError, match="not allowed"):
            NetworkState.of(network, {})
