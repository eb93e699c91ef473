"""Every baseline under the commands of r3dpa: fit, sample, test, convert, bench sampling."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_baselines import FIRST_STAGES, SETTINGS, TINY, fit_words

from lidarsim.scan_files import read_scan
from r3dpa.baselines import BASELINES, baseline_of
from r3dpa.baselines.lidm_networks import VQAutoencoder
from r3dpa.checkpoints import Checkpoint, NetworkState, read_checkpoint, save_checkpoint
from r3dpa.cli import main
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.scene_files.edits import EditSession
from r3dpa.scene_files.options import EditOptions
from r3dpa.stages import scene_generator


@pytest.fixture(scope="module", params=TINY)
def trained(request, baseline_once):
    """Stage and checkpoint of three steps."""
    more = []
    if request.param in FIRST_STAGES:
        stage, _ = FIRST_STAGES[request.param]
        first = baseline_once(stage)
        assert read_checkpoint(first).stage == stage
        more = [f"--model.init_args.init_from={first}"]
    return request.param, baseline_once(request.param, *more)


def test_every_baseline_is_tested_here():
    assert set(TINY) == set(BASELINES)


def test_a_checkpoint_is_rebuilt_from_what_it_says(trained):
    stage, path = trained
    checkpoint = read_checkpoint(path)
    assert checkpoint.stage == stage
    module = baseline_of(checkpoint)
    assert isinstance(module, BASELINES[stage])
    assert module.settings() == dict(checkpoint.settings)
    last = baseline_of(checkpoint, "last")
    differ = [
        not torch.equal(a, b)
        for a, b in zip(module.network.parameters(), last.network.parameters(), strict=True)
    ]
    assert any(differ)  # the average lags behind


def test_scenes_do_not_depend_on_the_batch(trained):
    _, path = trained
    generator = scene_generator(path, SamplerConfig("ddpm", 3), device="cpu")
    together = generator.generate([0, 1], seed=5)
    alone = generator.generate([1], seed=5)
    assert together.nfe == 3
    torch.testing.assert_close(together.latents[1:], alone.latents, atol=1e-4, rtol=0)
    assert not torch.equal(together.latents[0], together.latents[1])
    padded = scene_generator(path, SamplerConfig("ddpm", 3), device="cpu", batch_size=3)
    found = padded.generate([1], seed=5).latents
    torch.testing.assert_close(found, alone.latents, atol=1e-4, rtol=0)


def test_sample_and_convert(trained, tmp_path):
    stage, path = trained
    exported = tmp_path / "weights.safetensors"
    main(["convert", str(path), str(exported)])
    with pytest.raises(ValueError, match=f"stage {stage}, which has no official R3DPA layout"):
        main(["convert", str(path), str(tmp_path / "back.pt"), "--to", "official"])
    if stage == "lidm":  # any stage would do
        with pytest.raises(ValueError, match=r"weights\.safetensors is no \.ckpt of a run; scenes"):
            main(["test", stage, "--preset", "demo", "--ckpt_path", str(exported)])
    words = ["--num", "2", "--pictures", "0", "--solver", "euler", "--steps", "2"]
    for source, out in ((path, tmp_path / "a"), (exported, tmp_path / "b")):
        main(["sample", "--ckpt", str(source), "--out", str(out), *words])
    first, second = (np.load(tmp_path / name / "range_m.npy") for name in "ab")
    assert first.shape == (2, 16, 64)
    np.testing.assert_array_equal(first, second)
    assert json.loads((tmp_path / "b/metadata.json").read_text())["stage"] == stage
    points = read_scan(tmp_path / "a/bin/000000.bin")
    scenes = scene_generator(path, SamplerConfig("euler", 2), device="cpu").generate(2)
    if stage == "lidm":
        assert scenes.intensity is None
        assert not points[:, 3].any()
    else:
        assert scenes.intensity.min() < scenes.intensity.max()
        reflectance = (scenes.latents[:, 1].clamp(-1, 1) + 1) / 2
        np.testing.assert_allclose(scenes.intensity, reflectance, atol=1e-6)
        np.testing.assert_allclose(
            points[:, 3], scenes.intensity[0][scenes.range_m[0] > 0], atol=1e-5
        )


def test_edit_complete(trained, smoke_root, tmp_path):
    """What is known of a scan stays, with its intensity; no other edit takes a baseline."""
    stage, path = trained
    scan = next((smoke_root / "data_3d_raw").rglob("*.bin"))
    words = ["--scan", str(scan), "--ckpt", str(path), "--num", "2", "--pictures", "0"]
    words += ["--steps", "4", "--out", str(tmp_path / "out"), "--batch_size", "1"]
    more = ["--keep_every", "2", "--resamplings", "2"]
    if stage == "lidm":
        with pytest.raises(ValueError, match=r"would read nothing .* blocks of 4 x 8 pixels"):
            main(["edit", "complete", "--keep_every", "2", *words])
        assert not (tmp_path / "out").exists()
        more = ["--sector", "0", "180"]
    main(["edit", "complete", *words, *more])
    before, made = (np.load(tmp_path / "out" / name) for name in ("before.npy", "range_m.npy"))
    kept = np.asarray(Image.open(tmp_path / "out/mask.png")) == 0
    assert kept.sum() == 16 * 64 / 2
    np.testing.assert_array_equal(made[:, kept], np.broadcast_to(before[0, kept], (2, 512)))
    assert (made[0] != made[1]).any()
    about = json.loads((tmp_path / "out/metadata.json").read_text())
    assert about["nfe"] == (4 if stage == "lidm" else 3 * 2 + 1)
    with pytest.raises(ValueError, match=f"stage {stage}, which can only complete scans"):
        main(["edit", "vary", *words])
    with pytest.raises(ValueError, match=f"stage {stage} starts from noise"):
        main(["edit", "complete", "--keep_every", "2", "--start", "0.5", *words])


def test_completions_take_32_steps_by_default(trained, tmp_path):
    options = EditOptions(out=tmp_path, ckpt=trained[1], device="cpu")
    assert EditSession(options, 1).baseline.sampler.steps == 32


def test_the_published_sampler_is_the_default(trained):
    stage, path = trained
    generator = scene_generator(path, device="cpu")
    assert generator.sampler == BASELINES[stage].published
    with pytest.raises(ValueError, match=r"quality good is not measured for stage"):
        scene_generator(path, "good")


@pytest.mark.usefixtures("coarse_protocols")
@pytest.mark.parametrize(
    "trained",
    [s if s == "lidm" else pytest.param(s, marks=pytest.mark.slow) for s in TINY],
    indirect=True,
)
def test_test_scores_scenes(trained, smoke_root, tmp_path, monkeypatch):
    monkeypatch.setattr("r3dpa.callbacks.scene_scoring.save_figures", lambda *_, **__: None)
    stage, path = trained
    scorer = ["num_scenes=2", "batch_size=2", "allow_few=true", "spaces=[fgeo]"]
    scorer += ["sampler={solver: ddpm, steps: 2}"]  # its last noise keeps ranges off the limits
    words = [f"--scorer.{word}" for word in scorer]
    main(fit_words("test", stage, smoke_root, tmp_path, "--ckpt_path", str(path), *words))
    found = json.loads((tmp_path / "evaluation/evaluation.json").read_text())
    assert (found["about"]["solver"], found["about"]["extra"]["stage"]) == ("ddpm", stage)


@pytest.mark.parametrize("trained", sorted(set(TINY) - set(FIRST_STAGES)), indirect=True)
def test_known_pixels_of_a_completion_stay(trained):
    _, path = trained
    generator = scene_generator(path, SamplerConfig("ddpm", 3), device="cpu")
    image = generator.generate([0]).latents[0].clamp(-1, 1)
    known = torch.zeros(image.shape[1:], dtype=torch.bool)
    known[::2] = True
    found = generator.complete(image, known, seed=1, resamplings=2)
    assert found.nfe == 2 * 2 + 1
    difference = (found.latents - image).abs()
    assert difference[..., ::2, :].max() == 0
    assert difference[..., 1::2, :].max() > 5e-3


def test_reflectance_is_for_the_baselines(smoke_args, tmp_path):
    codec = "--data.init_args.codec={encoding: log2, reflectance: true}"
    with pytest.raises(ValueError, match=r"stage vae_alignment has no use for the reflectance"):
        main(smoke_args("vae_alignment", tmp_path, "--trainer.logger=false", codec))


def test_baselines_refuse_what_they_do_not_generate(smoke_root, tmp_path):
    codec = "{reflectance: false, return_channel: true, intensity_channel: true}"
    words = fit_words("fit", "r2flow", smoke_root, tmp_path, f"--data.init_args.codec={codec}")
    with pytest.raises(ValueError, match="stage r2flow generates no intensity_channel"):
        main(words)


@pytest.mark.slow
@pytest.mark.parametrize("stage", TINY)
@pytest.mark.filterwarnings("ignore:.*fast_dev_run.*")
def test_a_step_at_full_size(stage, smoke_root, tmp_path, caplog):
    """One scan of 64 x 1024; R2DM takes 40 s and 3.4 GB on a busy core."""
    more = []
    if stage in FIRST_STAGES:
        first = {"network": NetworkState.of(VQAutoencoder(), {})}
        content = Checkpoint(tmp_path, FIRST_STAGES[stage][0], first)
        path = save_checkpoint(content, tmp_path / "first.safetensors")
        more = [f"--model.init_args.init_from={path}"]
    names = ("num_scans", "batch_size", "num_workers")
    kept = {key: value for key, value in SETTINGS.items() if key.rpartition(".")[2] in names}
    kept |= {key: value for key, value in SETTINGS.items() if key.startswith("trainer.")}
    kept |= {"data.init_args.root": smoke_root, "run_dir": tmp_path}
    kept |= {"data.init_args.batch_size": 1, "trainer.limit_val_batches": 0}
    words = [f"--{key}={value}" for key, value in kept.items()]
    main(["fit", stage, "--preset", "simulated", *words, *more, "--trainer.fast_dev_run=true"])
    assert "`Trainer.fit` stopped: `max_steps=1` reached" in caplog.text


@pytest.mark.parametrize("trained", FIRST_STAGES, indirect=True)
def test_latents_are_completed(trained):
    _, path = trained
    generator = scene_generator(path, SamplerConfig("ddim", 4), device="cpu")
    image, other = torch.rand(2, 1, 16, 64, generator=torch.Generator().manual_seed(0)) - 0.5
    known = torch.zeros(16, 64, dtype=torch.bool)
    known[:, 16:48] = True
    found = generator.complete(image, known, seed=1)
    assert (found.nfe, found.range_m.shape) == (4, (1, 16, 64))
    assert not torch.equal(found.latents, generator.complete(other, known, seed=1).latents)
    none = torch.zeros_like(known)
    free, same = (generator.complete(x, none, seed=1).latents for x in (image, other))
    torch.testing.assert_close(free, same)
    # A latent is known where all of its pixels are: with a corner missing, it is not.
    corners, (height, width) = torch.ones_like(known), found.latents.shape[-2:]
    corners[:: 16 // height, :: 64 // width] = False
    with pytest.raises(ValueError, match="stage lidm would read nothing of the scan"):
        generator.complete(image, corners, seed=1)
    corners[0, 0] = True
    assert generator.known_latents(corners).nonzero().tolist() == [[0, 0, 0, 0]]
