from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file
from tiny_labelled import labelled_checkpoint
from tiny_networks import tiny_checkpoint, tiny_networks

from r3dpa import SceneGenerator, SceneVAE, pretrained
from r3dpa.checkpoints import NetworkState, convert, load_into, read_checkpoint, save_checkpoint
from r3dpa.cli import main
from r3dpa.nn import VAE
from r3dpa.scene_files.generated import written


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Folder of shipped weights with one name, ``tiny``."""
    folder = tmp_path / "weights"
    folder.mkdir()
    tiny_checkpoint(folder / "tiny.safetensors")
    (folder / "tiny.md").write_text("# tiny: the card\n")
    monkeypatch.setattr(pretrained, "_FOLDER", folder)
    return folder


def test_a_name_a_file_and_a_repository_are_taken_alike(shipped, monkeypatch):
    asked = []

    def snapshot_download(name, allow_patterns):
        asked.append((name, allow_patterns))
        return str(shipped)

    hub = SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    sources = ("tiny", shipped / "tiny.safetensors", "hf://owner/name")
    first, *others = (SceneGenerator.from_pretrained(source, device="cpu") for source in sources)
    expected = first.generate(2).range_m
    for other in others:
        assert torch.equal(other.generate(2).range_m, expected)
    assert asked == [("owner/name", ["*.safetensors", "*.yaml", "*.objects"])]
    assert SceneVAE.from_pretrained("tiny", "cpu").vae.latent_channels == first.sit.in_channels
    assert read_checkpoint("hf://owner/name/tiny.safetensors").path == sources[1]
    shutil.copytree(shipped, shipped / "v2")
    file = "v2/tiny.safetensors"
    assert read_checkpoint(f"hf://owner/name/{file}").path == shipped / file
    assert asked[-1][1] == [file, "v2/tiny.yaml", "v2/tiny.objects"]


def test_commands_use_the_weights_of_the_package(shipped, tmp_path, monkeypatch):
    out = tmp_path / "scenes"
    words = ["sample", "--out", str(out), "--num", "1", "--steps", "2", "--pictures", "0"]
    with pytest.raises(FileNotFoundError, match=r"^the weights r3dpa-s are not in .*\(tiny\)$"):
        main(words)
    for name in ("tiny.yaml", "tiny.safetensors"):
        shutil.copy(shipped / name, shipped / name.replace("tiny", pretrained.DEFAULT_WEIGHTS))
    main(words)
    about = json.loads((out / "metadata.json").read_text())
    assert about["checkpoint"] == "r3dpa-s"
    assert about["checkpoint_written"] == written(shipped / "r3dpa-s.safetensors")


def test_a_stage_starts_from_averages_where_a_file_has_nothing_else(shipped):
    vae, sit, norm = tiny_networks(spread=0.3)
    load_into({"sit": sit, "latent_norm": norm, "vae": vae}, read_checkpoint("tiny"), stage="joint")
    saved = load_file(shipped / "tiny.safetensors")
    weights = {f"ema.{name}": value for name, value in sit.state_dict().items()}
    weights |= {f"ema_latent_norm.{name}": value for name, value in norm.state_dict().items()}
    for name, value in weights.items():
        torch.testing.assert_close(value, saved[name])


def test_unknown_names_are_answered_with_the_known_ones(shipped):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint file large; .*\(tiny\)"):
        read_checkpoint("large")
    with pytest.raises(ValueError, match="unknown weights 'large'; choose from tiny"):
        pretrained.models("large")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (None, "pip install"),
        (OSError("no route to host"), "cannot be read: no route to host"),
        (ValueError("404 not found"), "cannot be read: 404"),
    ],
)
def test_a_repository_that_cannot_be_read_is_one_line(monkeypatch, fault, message):
    def snapshot_download(*_, **__):
        raise fault

    hub = fault and SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    with pytest.raises(ValueError, match=f"hf://owner/name.*{message}") as error:
        read_checkpoint("hf://owner/name")
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="give hf://owner/name"):
        read_checkpoint("hf://owner")


def test_models_lists_and_shows_cards(shipped):
    assert "tiny" in pretrained.models()
    assert pretrained.models("tiny") == "# tiny: the card\n"


def test_a_decoder_that_was_trained_on_takes_the_place_of_the_first(tmp_path):
    first = labelled_checkpoint(tmp_path, encode_further=False)
    content = read_checkpoint(first)
    state = content.network("vae")

    def changed(part, name):
        weights = {
            key: value + 0.01 if key.startswith(part) else value
            for key, value in state.state_dict.items()
        }
        networks = {"vae": replace(state, state_dict=weights)}
        return save_checkpoint(replace(content, networks=networks), tmp_path / name)

    out = tmp_path / "out.safetensors"
    convert(first, out, decoder=changed("decoder.", "decoder.safetensors"))
    before, after = load_file(first), load_file(out)
    others = {key for key in before if not torch.equal(before[key], after[key])}
    assert others == {key for key in before if key.startswith("vae.decoder.")}
    with pytest.raises(ValueError, match=r"encoder\.safetensors has another encoder than"):
        convert(first, out, decoder=changed("quant_conv.", "encoder.safetensors"), overwrite=True)


def test_decoders_are_averaged_by_their_share(tmp_path):
    first = labelled_checkpoint(tmp_path, encode_further=False)
    content = read_checkpoint(first)
    state = content.network("vae")
    raised = {k: v + 0.5 if k.startswith("decoder.") else v for k, v in state.state_dict.items()}
    networks = {"vae": replace(state, state_dict=raised)}
    other = save_checkpoint(replace(content, networks=networks), tmp_path / "other.safetensors")
    out = tmp_path / "out.safetensors"
    convert(first, out, decoder=other, decoder_share=0.25)
    before, after = load_file(first), load_file(out)
    for key, value in before.items():
        expected = value + 0.125 if key.startswith("vae.decoder.") else value
        torch.testing.assert_close(after[key], expected, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match=r"decoder_share 0\.5 needs a decoder"):
        convert(first, out, decoder_share=0.5, overwrite=True)
    with pytest.raises(ValueError, match="decoder_share must be above 0 and at most 1, got 0"):
        convert(first, out, decoder=other, decoder_share=0.0, overwrite=True)
    arguments = dict(state.arguments) | {"intensity": False, "num_classes": 0}
    fewer = VAE(**arguments)
    fewer.load_state_dict(state.state_dict, strict=False)
    networks = {"vae": NetworkState.of(fewer, arguments)}
    other = save_checkpoint(replace(content, networks=networks), tmp_path / "fewer.safetensors")
    with pytest.raises(ValueError, match="have other layers, so that their weights have no mean"):
        convert(first, out, decoder=other, decoder_share=0.5, overwrite=True)


@pytest.mark.parametrize("stage", ["flow_matching", "few_step"])
def test_a_flow_that_was_trained_on_takes_the_place_of_the_first(tmp_path, stage):
    few = tiny_checkpoint(tmp_path / "few.safetensors", stage="few_step")
    out = tmp_path / "out.safetensors"
    guidance = {"perturbed_attention": {"block": 1, "scale": 2.0}}
    content = read_checkpoint(
        tiny_checkpoint(tmp_path / "first.safetensors", stage=stage, sampling=guidance)
    )

    def trained_on(*names):
        networks = dict(content.networks)
        for name in names:
            state = networks[name]
            weights = {key: value + 1 for key, value in state.state_dict.items()}
            networks[name] = replace(state, state_dict=weights)
        path = tmp_path / f"{names[0]}.safetensors"
        return save_checkpoint(replace(content, networks=networks), path)

    moved = trained_on("ema", "ema_latent_norm")
    convert(few, out, flow=moved)
    assert read_checkpoint(out).sampling == content.sampling != {}
    before, after, others = load_file(few), load_file(out), load_file(moved)
    assert read_checkpoint(out).networks["ema"].class_path.endswith("AverageVelocitySiT")
    taken = {key for key in before if not torch.equal(before[key], after[key])}
    assert {key.split(".")[0] for key in taken} == {"ema", "ema_latent_norm"}
    assert not any(key.startswith("ema.average.") for key in taken)  # few steps stay
    assert all(torch.equal(after[key], others[key]) for key in taken)
    wide = tiny_checkpoint(tmp_path / "wide.safetensors", sit_args={"mlp_ratio": 2.0})
    heads = tiny_checkpoint(tmp_path / "heads.safetensors", sit_args={"num_heads": 1})
    cosine = save_checkpoint(
        replace(content, interpolant="cosine"), tmp_path / "cosine.safetensors"
    )
    for other, message in (
        (wide, r"blocks\.0\.mlp\.fc1\.bias has shape"),
        (heads, r"ema has num_heads 1 there and 2 here"),
        (cosine, r"was trained on the cosine path, .* on the linear path"),
        (trained_on("vae"), "has another encoder than"),
    ):
        with pytest.raises(ValueError, match=message):
            convert(few, out, flow=other, overwrite=True)


def test_half_precision_rounds_all_but_statistics(shipped, tmp_path):
    out = tmp_path / "half.safetensors"
    names = ["vae", "ema", "ema_latent_norm"]
    convert(shipped / "tiny.safetensors", out, networks=names, half=True)
    weights, before = load_file(out), load_file(shipped / "tiny.safetensors")
    assert {name.split(".")[0] for name in weights} == set(names)
    for name, value in weights.items():
        if "latent_norm" in name:
            assert torch.equal(value, before[name])
        elif value.is_floating_point():
            assert value.dtype == torch.float16
            torch.testing.assert_close(value.float(), before[name], rtol=1e-3, atol=1e-6)
    generator = SceneGenerator.from_pretrained(out, device="cpu")
    assert generator.generate(1).range_m.isfinite().all()
    assert {p.dtype for p in generator.sit.parameters()} == {torch.float32}
