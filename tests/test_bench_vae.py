"""The bench of VAEs: work against published counts, figures against a second way to them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from r3dpa.bench.timing import Comparison, Ratio, Times
from r3dpa.bench.vae import (
    NETS,
    Reconstruction,
    VAECost,
    VAESettings,
    peak_bytes,
    reconstruction,
    vae,
    vae_flop,
)
from r3dpa.checkpoints import NetworkState, read_checkpoint, save_checkpoint
from r3dpa.data import LidarDataset, find_scans
from r3dpa.geometry import ScanGeometry
from r3dpa.nn import VAE

CONF = Path(__file__).resolve().parents[1] / "conf"
CASES = ["fp32", "fp32 channels-last", "bf16", "bf16 channels-last"]
SIZES = VAESettings(batch_size=3, rounds=2, image_size=(16, 64), num_scans=2)
TINY = {
    "class_path": "r3dpa.nn.VAE",
    "init_args": {
        "latent_channels": 2,
        "channels": 32,
        "channel_multipliers": [1, 1],
        "strides": [[2, 2]],
        "num_res_blocks": 1,
    },
}


@pytest.fixture(scope="module")
def bench(vae_checkpoint, smoke_root, tmp_path_factory):
    """Text and JSON of an untrained VAE of a YAML file and of a trained one."""
    folder = tmp_path_factory.mktemp("bench_vae")
    path, out = folder / "vae_tiny.yaml", folder / "figures.json"
    path.write_text(yaml.safe_dump(TINY))
    text = vae([str(path)], {"smoke": vae_checkpoint}, smoke_root, settings=SIZES, out=out)
    return text, json.loads(out.read_text())


def test_work_of_the_published_size():
    """Both figures are of the cost model; all but the attention is linear in the columns."""
    config = yaml.safe_load((CONF / "net" / "vae_h2p4d8.yaml").read_text())
    network = NetworkState(config["class_path"], config["init_args"], {}).new()
    flop = vae_flop(network, (64, 1024))
    assert flop["encode"] / 1e9 == pytest.approx(361.5, abs=0.05)
    assert flop["decode"] / 1e9 == pytest.approx(467.3, abs=0.05)
    assert 2 * flop["decode"] < vae_flop(network, (64, 2048))["decode"] < 2.1 * flop["decode"]


def test_every_named_net_is_shipped():
    assert all((CONF / "net" / f"vae_{name}.yaml").is_file() for name in NETS)


def test_each_vae_is_measured_in_all_cases(bench):
    _, content = bench
    tiny, smoke = content["vaes"]
    assert [cost["name"] for cost in (tiny, smoke)] == ["tiny", "smoke"]
    for cost in (tiny, smoke):
        assert cost["image_size"] == [16, 64]
        for half in ("encode", "decode"):
            assert list(cost[half]["ms"]) == CASES
            assert all(times["rounds"] == 2 for times in cost[half]["ms"].values())
            assert all(0 < times["min"] < 1e4 for times in cost[half]["ms"].values())
        assert list(cost["decode_peak_bytes"]) == CASES
    assert tiny["latent_size"] == [2, 8, 32]
    network = VAE(**TINY["init_args"])
    parts = (network.encoder, network.quant_conv), (network.decoder, network.post_quant_conv)
    assert list(tiny["parameters"].values()) == [
        sum(p.numel() for module in part for p in module.parameters()) for part in parts
    ]
    assert tiny["flop"] == vae_flop(network, (16, 64))


def test_only_trained_weights_have_a_reconstruction(bench):
    text, content = bench
    tiny, smoke = content["vaes"]
    assert (tiny["weights"], smoke["weights"]) == ("untrained", "last.ckpt")
    assert tiny["reconstruction"] is None
    assert smoke["reconstruction"]["scans"] == 2
    assert text.count("untrained: no reconstruction figure") == 1


def test_where_it_was_measured_is_told_without_paths(bench, smoke_root):
    text, content = bench
    assert content["settings"]["batch_size"] == 3
    assert content["settings"]["scans"] == smoke_root.name
    assert {"cpu", "threads", "load"} <= set(content["machine"])
    assert str(smoke_root.parent) not in text
    assert "fp32 against itself" in text


def test_reconstruction_by_a_loop_over_pixels(vae_checkpoint, smoke_root):
    """Weights of three steps predict no return at many pixels: both figures have work to do."""
    checkpoint = read_checkpoint(vae_checkpoint)
    geometry = ScanGeometry.from_dict(dict(checkpoint.geometry))
    network = checkpoint.network("vae").build().eval()
    dataset = LidarDataset(find_scans(smoke_root)[:2], geometry.projection, geometry.codec)
    images = torch.stack([dataset[index]["range_image"] for index in range(2)])
    with torch.no_grad():
        decoded = network.decode(network.encode(images).mean)
        network.halve_decoder_()
        # one by one, as other batches are summed in another order
        low = [network.decode(half) for half in latents_of(checkpoint, images)]
    sensor, codec = geometry.projection.sensor, geometry.codec
    pixels = [
        codec.decode(image, sensor).flatten().tolist()
        for image in (images, decoded, torch.cat(low).float())
    ]
    errors = [abs(a - b) for a, b, _ in zip(*pixels, strict=True) if a > 0 and b > 0]
    low_errors = [abs(b - c) for _, b, c in zip(*pixels, strict=True) if b > 0 and c > 0]
    same = [(a > 0) == (b > 0) for a, b, _ in zip(*pixels, strict=True)]
    assert 0.1 < sum(same) / len(same) < 0.99
    found = reconstruction(checkpoint.network("vae").build().eval(), images, geometry)
    assert found.scans == 2
    assert found.error_m == pytest.approx(sum(errors) / len(errors), rel=1e-4)
    assert found.agreement == pytest.approx(sum(same) / len(same), abs=1e-3)
    assert found.bf16_error_m == pytest.approx(sum(low_errors) / len(low_errors), rel=1e-2)


def latents_of(checkpoint, images):
    """Latents of each image."""
    network = checkpoint.network("vae").build().eval()
    return [network.encode(image[None]).mean for image in images]


def test_a_vae_without_any_return_has_no_error(vae_checkpoint):
    checkpoint = read_checkpoint(vae_checkpoint)
    geometry = ScanGeometry.from_dict(dict(checkpoint.geometry))
    network = checkpoint.network("vae").build().eval()
    torch.nn.init.zeros_(network.decoder.conv_out.weight)
    torch.nn.init.constant_(network.decoder.conv_out.bias, -2.0)
    found = reconstruction(network, torch.zeros(1, 1, 16, 64), geometry)
    assert found == Reconstruction(1, None, 0.0, None)


def cost_of(ms, flop, found=None):
    """A VAE whose cases take 1, 2, 3 and 4 times ``ms`` a batch."""
    times = {case: Times(3, n * ms, n * ms - 1, n * ms + 1) for n, case in enumerate(CASES, 1)}
    ratios = {case: Ratio(n, n - 0.5, n + 0.5) for n, case in enumerate(CASES[1:], 2)}
    sound = Comparison(times, ratios, Ratio(1.0, 0.9, 1.1))
    disturbed = replace(sound, repeat=Ratio(1.3, 1.2, 1.4))
    parameters, work = {"encode": 10**6, "decode": 2 * 10**6}, {"encode": flop, "decode": 2 * flop}
    peaks = dict.fromkeys(CASES, 3 * 2**20) | {"bf16": None}
    return VAECost(
        "x", "untrained", (4, 8), (2, 2, 4), parameters, work, sound, disturbed, peaks, found
    )


def test_times_are_those_of_one_scene():
    """20 ms a batch of 2 are 10 ms a scene: 5 GFLOP in it are 500 GFLOP/s."""
    first, second, third, _ = cost_of(20.0, 2_500_000_000).times(batch_size=2)
    assert first[:5] == ["x", "fp32", "10 (9.5..10.5)", "1", "500"]
    assert first[5:] == ["10 (9.5..10.5)", "1", "250", "3"]
    assert second[2:5] == ["20 (19.5..20.5)", "2.000 (1.500..2.500)", "250"]
    assert third[-1] == "-"


def test_a_disturbed_machine_is_told():
    decode, encode = cost_of(20.0, 1).verdicts()
    assert decode.endswith("1.300 (1.200..1.400): the machine was not quiet, no ratio counts")
    assert encode.endswith("1.000 (0.900..1.100)")


def test_facts_of_a_trained_vae():
    assert cost_of(1.0, 10**9, Reconstruction(4, 0.25, 0.9, None)).facts() == [
        *["x", "4x8", "2x2x4", "1.00", "2.00", "1.0", "2.0"],
        *["0.2500", "0.9000", "-"],
    ]


@pytest.mark.slow  # what the allocator keeps depends on the tests before
def test_peak_is_what_one_call_needs_whatever_was_freed_before():
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("this system does not tell the peak of one call")
    mebibytes = lambda n: torch.ones(n, 2**18)  # noqa: E731
    del (before := [mebibytes(1) for _ in range(50)])[:]
    assert before == []
    for _ in range(2):
        found = peak_bytes(lambda: [mebibytes(1) for _ in range(64)], torch.device("cpu"))
        assert 60 * 2**20 < found < 80 * 2**20


def test_a_checkpoint_without_range_encoding_is_timed_only(vae_checkpoint, smoke_root, tmp_path):
    checkpoint = replace(read_checkpoint(vae_checkpoint), geometry=None)
    path, tiny = save_checkpoint(checkpoint, tmp_path / "bare.safetensors"), tmp_path / "tiny.yaml"
    tiny.write_text(yaml.safe_dump(TINY))
    text = vae([str(tiny)], {"tiny": path}, smoke_root, settings=replace(SIZES, rounds=1))
    assert "bare.safetensors (range encoding unknown): no reconstruction figure" in text
    assert "untrained" not in text  # the checkpoint replaces the net of its name
    assert "4x4x16" in text


def test_what_is_no_vae_is_refused(vae_checkpoint, tmp_path):
    with pytest.raises(ValueError, match=r"vae_h9\.yaml of a VAE; name one of h2p4d8"):
        vae(["h9"], conf=CONF)
    with pytest.raises(ValueError, match="describes a SiT, not a VAE"):
        vae([str(CONF / "net" / "sit_demo.yaml")])
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("trainer: {}\n")
    with pytest.raises(ValueError, match=r"wrong\.yaml names no class_path"):
        vae([str(wrong)])
    checkpoint = read_checkpoint(vae_checkpoint)
    bare = {name: state for name, state in checkpoint.networks.items() if name != "vae"}
    path = save_checkpoint(replace(checkpoint, networks=bare), tmp_path / "bare.safetensors")
    with pytest.raises(ValueError, match="has no vae"):
        vae([str(CONF / "net" / "vae_demo.yaml")], {"demo": path})


@pytest.mark.parametrize("name", ["batch_size", "rounds", "num_scans"])
def test_counts_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        VAESettings(**{name: 0})


def test_quick_measures_the_demo(smoke_root):
    text = vae(scans=smoke_root, conf=CONF, quick=True)
    assert "demo  32x256  8x8x32" in text
