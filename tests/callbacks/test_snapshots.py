"""Snapshots of the average: when and what is written, and which may guide which model."""

import hashlib
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from tiny_networks import GEOMETRY, SIT_ARGS, VAE_ARGS

from r3dpa.callbacks import EMASnapshots
from r3dpa.checkpoints import (
    NetworkState,
    read_checkpoint,
    read_snapshot,
    save_checkpoint,
    weights_sha256,
)
from r3dpa.cli import main
from r3dpa.flow.autoguidance import renormalised
from r3dpa.geometry import ScanGeometry
from r3dpa.modules import FlowMatching, JointAlignment, VAEAlignment
from r3dpa.nn import VAE, LatentNorm, PatchDiscriminator, SiT


def module(kind=FlowMatching, **more):
    """A module as the command line leaves it: with the configuration of its SiT."""
    torch.manual_seed(0)
    made = kind(VAE(**VAE_ARGS), SiT(**SIT_ARGS), **more)
    made.hparams["sit"] = {"class_path": "r3dpa.nn.SiT", "init_args": SIT_ARGS}
    made.geometry = GEOMETRY
    made.latent_norm.update(2 + 3 * torch.randn(8, 4, 4, 16))
    if made.ema is not None:
        made.ema.reset(made.sit, made.latent_norm)
    return made


def trainer(folder, step=0, max_steps=64, rank=0, resumed=False):
    return SimpleNamespace(
        default_root_dir=folder,
        ckpt_path=str(folder / "checkpoints" / "last.ckpt") if resumed else None,
        global_step=step,
        max_steps=max_steps,
        is_global_zero=rank == 0,
        fast_dev_run=False,
    )


def run(callback, made, folder, steps, **more):
    callback.on_fit_start(trainer(folder, **more), made)
    for step in steps:
        callback.on_train_batch_end(trainer(folder, step, **more), made, None, None, 0)
    return sorted(path.name for path in folder.rglob("*.safetensors"))


@pytest.fixture(scope="module")
def first_pair(tmp_path_factory):
    """The pair of all tests, whose files no test changes."""
    folder, made = tmp_path_factory.mktemp("run"), module()
    run(EMASnapshots(steps=[2]), made, folder, [1, 2], max_steps=-1)
    path = folder / "snapshots" / "step_0000002.safetensors"
    early = read_checkpoint(path)
    vae = NetworkState.of(made.vae, VAE_ARGS)
    return path, replace(early, networks={**early.networks, "vae": vae})


@pytest.fixture
def pair(first_pair, tmp_path):
    """Path of a snapshot, and the checkpoint of the same run at its end."""
    path, end = first_pair
    shutil.copytree(path.parent, tmp_path / "snapshots")
    return tmp_path / "snapshots" / path.name, replace(end, path=tmp_path / "end.ckpt")


def with_norm(checkpoint, mean, variance):
    """The checkpoint with other latent statistics, eps left out of the sums."""
    state = checkpoint.network("ema_latent_norm")
    values = {
        **state.state_dict,
        "running_mean": torch.as_tensor(mean).expand(4),
        "running_var": torch.as_tensor(variance).expand(4) - state.arguments["eps"],
    }
    changed = {"ema_latent_norm": replace(state, state_dict=values)}
    return replace(checkpoint, networks={**checkpoint.networks, **changed})


def rewritten(path, checkpoint):
    save_checkpoint(replace(checkpoint, path=path), path, overwrite=True)
    return path


def test_steps_are_fractions_of_the_training(tmp_path):
    """Of 64 steps: 1/32, 1/16 and 1/8 are 2, 4 and 8."""
    names = run(EMASnapshots(), module(), tmp_path, range(1, 65))
    assert names == [f"step_{step:07d}.safetensors" for step in (2, 4, 8)]
    assert len(list(tmp_path.rglob("*"))) == 1 + 6  # nothing temporary is left
    assert run(EMASnapshots(), module(), tmp_path / "other", range(1, 65), rank=1) == []


def test_a_snapshot_is_the_average_with_all_that_describes_it(tmp_path):
    norm = LatentNorm(4, eps=1e-2, momentum=0.3, legacy_inverse=True, replace_non_finite=True)
    made = module(latent_norm=norm)
    with torch.no_grad():
        made.sit.pos_embed.add_(1)  # the weights of the step are not those of the average
    run(EMASnapshots(steps=[2]), made, tmp_path, [2])
    found = read_checkpoint(tmp_path / "snapshots" / "step_0000002.safetensors")
    assert (found.stage, found.step, found.interpolant) == ("flow_matching", 2, "linear")
    assert ScanGeometry.from_dict(found.geometry) == GEOMETRY
    assert set(found.networks) == {"ema", "ema_latent_norm"}
    for name, average in (("ema", made.ema.sit), ("ema_latent_norm", made.ema.latent_norm)):
        built = found.network(name).build()
        assert type(built) is type(average)
        for key, value in average.state_dict().items():
            assert torch.equal(built.state_dict()[key], value)
    for name in ("eps", "momentum", "legacy_inverse", "replace_non_finite"):
        assert getattr(built, name) == getattr(norm, name)
    with pytest.raises(ValueError, match=r"has no vae.*not kept in a snapshot"):
        found.network("vae")


def test_snapshots_of_an_earlier_run_are_refused(tmp_path):
    """They would be taken for weak models of the new one."""
    run(EMASnapshots(steps=[1]), module(), tmp_path, [1])
    with pytest.raises(ValueError, match=r"holds snapshots of an earlier run: delete them"):
        run(EMASnapshots(steps=[1]), module(), tmp_path, [1])


def test_a_killed_writer_does_not_stop_the_next(tmp_path):
    """The description is renamed first: alone, it is what a killed process leaves."""
    made = module()
    run(EMASnapshots(steps=[1]), made, tmp_path, [1])
    path = tmp_path / "snapshots" / "step_0000001.safetensors"
    path.unlink()
    assert run(EMASnapshots(steps=[1]), made, tmp_path, [1], resumed=True) == [path.name]
    read_checkpoint(path)


def test_a_stage_without_average_says_that_it_keeps_none(tmp_path, caplog):
    made = module(VAEAlignment, discriminator=PatchDiscriminator(channels=4))
    assert made.ema is None
    with caplog.at_level("INFO", "lightning.pytorch.utilities.rank_zero"):
        assert run(EMASnapshots(steps=[1]), made, tmp_path, [1]) == []
    assert "stage vae_alignment averages no SiT" in caplog.text


def test_a_stage_that_trains_its_vae_keeps_none(tmp_path, caplog):
    """No later SiT has the latents of that step, so `read_snapshot` would refuse it."""
    joint = module(JointAlignment, discriminator=PatchDiscriminator(channels=4))
    assert joint.ema is not None
    with caplog.at_level("INFO", "lightning.pytorch.utilities.rank_zero"):
        assert run(EMASnapshots(steps=[1]), joint, tmp_path, [1]) == []
    assert "stage joint averages no SiT over fixed latents" in caplog.text


def test_a_resumed_run_replaces_what_an_abandoned_one_left_after_its_checkpoint(tmp_path):
    """Killed after step 3 with a checkpoint of step 2, whose own snapshot stays."""
    run(EMASnapshots(steps=[2, 3]), module(), tmp_path, [1, 2, 3])
    other, callback = module(), EMASnapshots(steps=[2, 3])
    with torch.no_grad():
        other.ema.sit.pos_embed.add_(1)
    second, third = sorted(tmp_path.rglob("*.safetensors"))
    before, resumed = second.read_bytes(), trainer(tmp_path, 2, resumed=True)
    callback.on_fit_start(resumed, other)
    callback.on_train_start(resumed, other)
    for step in (2, 3, 3):  # the first batch is accumulated
        callback.on_train_batch_end(trainer(tmp_path, step), other, None, None, 0)
    found = read_checkpoint(third).network("ema").state_dict["pos_embed"]
    assert torch.equal(found, other.ema.sit.pos_embed)
    assert second.read_bytes() == before


def test_networks_built_by_hand_and_endless_trainings_get_no_snapshots(tmp_path):
    by_hand = module()
    by_hand.hparams["sit"] = by_hand.sit
    with pytest.raises(ValueError, match="built by hand"):
        EMASnapshots().on_fit_start(trainer(tmp_path), by_hand)
    with pytest.raises(ValueError, match="max_steps is -1"):
        EMASnapshots().on_fit_start(trainer(tmp_path, max_steps=-1), module())


def test_a_run_of_the_command_line_keeps_and_extends_them(smoke_args, vae_checkpoint, tmp_path):
    config = tmp_path / "snapshots.yaml"
    callback = {"class_path": "r3dpa.callbacks.EMASnapshots", "init_args": {"steps": [1, 2, 3]}}
    config.write_text(yaml.safe_dump({"trainer": {"callbacks": [callback], "logger": False}}))
    words = smoke_args("flow_matching", tmp_path / "run", "--config", str(config))
    words += ["--model.init_args.init_from", str(vae_checkpoint), "--trainer.limit_val_batches=0"]
    main([*words, "--trainer.max_steps=2"])
    folder = tmp_path / "run" / "snapshots"
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    first, second = sorted(folder.glob("*.safetensors"))
    early, end = read_checkpoint(second).network("ema"), read_checkpoint(last).network("ema")
    assert all(torch.equal(early.state_dict[key], end.state_dict[key]) for key in end.state_dict)
    assert early.init_args == end.init_args
    found = read_snapshot(first, read_checkpoint(last))
    assert found.step == 1
    assert any(
        not torch.equal(value, end.state_dict[key]) for key, value in found.sit.state_dict().items()
    )
    first.unlink()  # behind the checkpoint: it does not come back
    written = second.stat().st_mtime_ns
    main([*words, "--trainer.max_steps=3", "--ckpt_path", str(last)])
    assert sorted(path.name for path in folder.glob("*.safetensors")) == [
        second.name,
        "step_0000003.safetensors",
    ]
    assert second.stat().st_mtime_ns == written


def test_a_snapshot_of_the_same_latents_is_used_as_it_is(pair):
    path, strong = pair
    weak = read_snapshot(path, strong)
    assert (weak.step, weak.scale) == (2, 1.0)
    assert torch.equal(weak.shift, torch.zeros(4))
    assert not weak.sit.training
    assert not any(parameter.requires_grad for parameter in weak.sit.parameters())


def test_statistics_that_drifted_apart_are_converted(pair):
    """Raw latents 2 + 3 z and 5 + 6 z' are the same where z' = z / 2 - 1 / 2."""
    path, strong = pair
    rewritten(path, with_norm(read_checkpoint(path), 5.0, 36.0))
    strong = with_norm(strong, 2.0, 9.0)
    weak = read_snapshot(path, strong)
    assert weak.scale == pytest.approx(0.5, abs=1e-6)
    torch.testing.assert_close(weak.shift, torch.full((4,), -0.5))
    raw = torch.randn(2, 4, 4, 16)
    norms = [
        c.network("ema_latent_norm").build().normalise(raw) for c in (strong, read_checkpoint(path))
    ]
    shift = weak.shift[:, None, None]
    torch.testing.assert_close(weak.scale * norms[0] + shift, norms[1], atol=1e-5, rtol=1e-5)
    velocity = renormalised(weak.sit.velocity, weak.scale, weak.shift)
    assert velocity(norms[0], torch.tensor([0.0, 1.0])).isfinite().all()


def test_statistics_of_the_last_step_are_those_of_the_last_weights(pair):
    path, strong = pair
    networks = strong.networks
    last = {
        "sit": networks["ema"],
        "latent_norm": with_norm(strong, 2.0, 9.0).network("ema_latent_norm"),
    }
    strong = replace(strong, networks={**networks, **last})
    assert read_snapshot(path, strong, "last").scale != 1
    assert read_snapshot(path, strong, "ema").scale == 1


@pytest.mark.parametrize(("variance", "refused"), [(1.12, False), (1.18, True)])
def test_channels_that_scale_apart_are_refused_beyond_the_tolerance(pair, variance, refused):
    """One channel r times wider: it is r^(3/4) from the geometric mean, the others r^(-1/4).

    Deviations 1.058 and 1.086 give 4.3 % and 6.4 %.
    """
    path, strong = pair
    rewritten(path, with_norm(read_checkpoint(path), 0.0, 1.0))
    strong = with_norm(strong, 0.0, torch.tensor([variance, 1.0, 1.0, 1.0]))
    if not refused:
        read_snapshot(path, strong)
        return
    with pytest.raises(ValueError, match=r"step_0000002.*differ by 6\.4% between channels"):
        read_snapshot(path, strong)


def test_a_snapshot_of_another_vae_is_refused(pair):
    """As in stage joint, whose VAE trains on after the snapshot."""
    path, strong = pair
    vae = strong.network("vae")
    key = "decoder.conv_out.bias"
    moved = {**vae.state_dict, key: vae.state_dict[key] + 1e-6}
    networks = {**strong.networks, "vae": replace(vae, state_dict=moved)}
    strong = with_norm(replace(strong, networks=networks), 2.0, 9.0)
    with pytest.raises(ValueError, match=r"another VAE, as within stage joint.*flow_matching"):
        read_snapshot(path, strong)


def test_a_vae_that_nobody_knows_is_another_one(pair):
    path, strong = pair
    rewritten(path, replace(read_checkpoint(path), left_out={}))
    unknown = {name: state for name, state in strong.networks.items() if name != "vae"}
    with pytest.raises(ValueError, match="another VAE"):
        read_snapshot(path, replace(strong, networks=unknown, left_out={}))


def test_models_that_do_not_belong_together_are_refused(pair, tmp_path):
    path, strong = pair
    early = read_checkpoint(path)
    arguments = SIT_ARGS | {"input_size": [4, 8]}
    wide = {**early.networks, "ema": NetworkState.of(SiT(**arguments), arguments)}
    fresh = {**early.networks, "ema_latent_norm": NetworkState.of(LatentNorm(4), {"channels": 4})}
    for other, message in (
        (replace(early, interpolant="cosine"), "on the cosine path.* linear"),
        (replace(early, networks=wide), r"latents \(4, 4, 8\).*\(4, 4, 16\)"),
        (replace(early, networks=fresh), r"other\.safetensors: ema_latent_norm holds no fitted"),
    ):
        path = rewritten(tmp_path / "other.safetensors", other)
        with pytest.raises(ValueError, match=message):
            read_snapshot(path, strong)


def test_a_checkpoint_without_average_is_no_snapshot(pair, vae_checkpoint):
    with pytest.raises(ValueError, match=r"vae_alignment and holds no averaged SiT.*snapshots"):
        read_snapshot(vae_checkpoint, pair[1])


def test_the_hash_of_weights_knows_their_values_and_names_alone():
    """By hand: names in order, each before its bytes."""
    state = {"b": torch.ones(2, dtype=torch.bfloat16), "a": torch.arange(4.0).reshape(2, 2)}
    expected = hashlib.sha256(b"a")
    expected.update(np.arange(4, dtype="<f4").tobytes())
    expected.update(b"b" + b"\x80\x3f" * 2)
    assert weights_sha256(state) == expected.hexdigest()
    turned = {"a": state["a"].T.contiguous().T, "b": state["b"]}
    assert not turned["a"].is_contiguous()
    assert weights_sha256(turned) == expected.hexdigest()
    for other in ({"a": state["a"] + 1, "b": state["b"]}, {"a": state["a"], "c": state["b"]}):
        assert weights_sha256(other) != expected.hexdigest()
