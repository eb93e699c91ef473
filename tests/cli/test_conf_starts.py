"""``r3dpa fit --trainer.fast_dev_run`` starts with every YAML under ``conf``.

Networks and images have their own sizes in the slow tests, but for the depth of the largest SiTs.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from PIL import Image
from safetensors.torch import save_file

from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.cli import main
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn import VAE, ImageVAE, LatentNorm, SiT
from r3dpa.nn.backbones import DINOv2

CONF = Path(__file__).resolve().parents[2] / "conf"
ELSEWHERE = {  # and the test that starts them
    "data/dead_leaves": "test_rgb_stages",
    "experiment/image_vae": "test_rgb_stages",
    "experiment/rgb_pretraining_demo": "test_rgb_stages",
    "net/image_vae_demo": "test_rgb_stages",
    "net/sit_rgb_demo": "test_rgb_stages",
    **{
        path.relative_to(CONF).with_suffix("").as_posix(): "test_ablate"
        for path in CONF.glob("ablation/*/*.yaml")
    },
}
EXPERIMENTS = ("vae_alignment", "joint", "flow_matching")
SCANS = ("demo", "demo_folder", "folder", "kitti360", "simulated")
VAES = sorted(path.stem for path in CONF.glob("net/vae_h*.yaml"))
SITS = ("sit_b2",)
UNETS = ("unet_lidm", "unet_small")
STARTED = {
    *("smoke", "trainer", "trainer_demo", "launch/nodes", "data/images", "data/points"),
    *("experiment/waffleiron_s", "experiment/rgb_pretraining", "net/sd_vae", "net/sit_rgb_b2"),
    *("net/discriminator", "net/discriminator_demo", "net/vae_demo", "net/sit_demo"),
    *("net/unet_demo", *(f"net/{name}" for name in (*VAES, *SITS, *UNETS))),
    *(f"data/{name}" for name in SCANS),
    *(f"experiment/{name}{size}" for name in EXPERIMENTS for size in ("", "_demo")),
}
QUIET = {
    "trainer.accelerator": "cpu",
    "trainer.devices": 1,
    "trainer.fast_dev_run": "true",
    "trainer.enable_model_summary": "false",
    "trainer.enable_progress_bar": "false",
    "data.init_args.num_workers": 0,
    "data.init_args.batch_size": 1,
}
GEOMETRIC = "r3dpa.nn.backbones.GeometricFeatures"
SIMULATED = {"data.init_args.num_scans": 12}  # as in smoke.yaml: the same folder
WIDE = f"{{class_path: {GEOMETRIC}, init_args: {{dim: 768}}}}"
WARNINGS = ("ignore:.*fast_dev_run.*", "ignore:.*LeafSpec.*is deprecated")
pytestmark = pytest.mark.filterwarnings(*WARNINGS)


def test_no_file_is_left_out():
    files = {path.relative_to(CONF).with_suffix("").as_posix() for path in CONF.rglob("*.yaml")}
    assert files == STARTED | set(ELSEWHERE)
    assert not STARTED & set(ELSEWHERE)


def words_of(configs, settings, run_dir):
    words = [word for name in configs for word in ("--config", str(CONF / f"{name}.yaml"))]
    words += [f"--{key}={value}" for key, value in (QUIET | settings).items()]
    return ["fit", *words, f"--run_dir={run_dir}"]


@pytest.fixture
def start(tmp_path, caplog):
    """``start(configs, settings)`` runs ``r3dpa fit`` for one batch."""

    def start(configs, settings):
        main(words_of(configs, settings, tmp_path / "run"))
        assert "`Trainer.fit` stopped: `max_steps=1` reached" in caplog.text
        weights = [
            p for p in (tmp_path / "run").rglob("*") if p.suffix in (".ckpt", ".safetensors")
        ]
        assert not weights  # a trial must not look like a run, nor replace one

    return start


def vae_file(folder, vae, size):
    """Checkpoint that flow matching starts from, of a VAE with random weights."""
    network, channels = VAE(**vae), vae["latent_channels"]
    norm = LatentNorm(channels)
    norm.num_batches_tracked.fill_(1)
    rows, columns = (side // s for side, s in zip(size, network.stride, strict=True))
    geometry = ScanGeometry(
        SphericalProjection(LidarSensor(*size)), RangeCodec(), (rows // 2, columns // 2)
    )
    networks = {
        "vae": NetworkState.of(network, vae),
        "latent_norm": NetworkState.of(norm, {"channels": channels}),
    }
    content = Checkpoint(Path("v"), "vae_alignment", networks, geometry=geometry.to_dict())
    return save_checkpoint(content, folder / "vae.safetensors")


def net(name):
    return yaml.safe_load((CONF / f"net/{name}.yaml").read_text())["init_args"]


def start_flow(folder, vae, size):
    return {"model.init_args.init_from": vae_file(folder, vae, size)}


@pytest.mark.parametrize("stage", EXPERIMENTS)
def test_experiments_with_tiny_networks(stage, start, smoke_root, tmp_path):
    settings = SIMULATED | {"data.init_args.root": smoke_root}
    if stage == "flow_matching":
        vae = yaml.safe_load((CONF / "smoke.yaml").read_text())["model"]["init_args"]["vae"]
        settings |= start_flow(tmp_path, vae["init_args"], (16, 64))
    start(("trainer", f"experiment/{stage}", "smoke"), settings)


@pytest.mark.slow
def test_nodes(smoke_root, tmp_path):
    """A process of its own: the group that it founds would stay for all tests after it."""
    settings = SIMULATED | {"data.init_args.root": smoke_root, "trainer.num_nodes": 1}
    configs = ("trainer", "launch/nodes", "experiment/vae_alignment", "smoke")
    words = [sys.executable, "-m", "r3dpa", *words_of(configs, settings, tmp_path)]
    told = subprocess.run(words, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    assert "distributed_backend=gloo" in told.stderr


@pytest.mark.parametrize("data", SCANS)
def test_scans(data, start, smoke_root, vae_checkpoint):
    """With the VAE alignment at smoke size, whose checkpoint comes with simulated scans."""
    key = "scans" if "folder" in data else "root"
    settings = {
        f"data.init_args.{key}": smoke_root,
        "data.init_args.sensor": "{beams: 16, columns: 64}",
        "data.init_args.grid_size": "[2, 8]",
        "data.init_args.extractor": f"{{class_path: {GEOMETRIC}, init_args: {{dim: 16}}}}",
    }
    if data in ("demo", "simulated"):
        settings |= SIMULATED
    start(("trainer", "experiment/vae_alignment", "smoke", f"data/{data}"), settings)


@pytest.mark.slow
@pytest.mark.parametrize("stage", [*EXPERIMENTS, "joint_unet"])
def test_demo_sizes(stage, start, smoke_root, tmp_path):
    settings = SIMULATED | {
        "data.init_args.root": smoke_root,
        "data.init_args.extractor": WIDE,
        "data.init_args.features_dir": smoke_root / "wide_grids",
    }
    if stage == "flow_matching":
        settings |= start_flow(tmp_path, net("vae_demo"), (32, 256))
    if stage == "joint_unet":
        stage, settings["model.init_args.sit"] = "joint", CONF / "net/unet_demo.yaml"
    configs = ("data/demo", f"experiment/{stage}", f"experiment/{stage}_demo")
    start(("trainer", "trainer_demo", *configs), settings)


def test_the_point_teacher(start, smoke_root):
    source = {f"data.init_args.source.init_args.{k}": v for k, v in (("root", smoke_root),)}
    source |= {
        "data.init_args.source.init_args.num_scans": 12,
        "data.init_args.source.init_args.simulation_seed": 0,
    }
    start(("trainer", "data/points", "experiment/waffleiron_s"), source)


def full_size(smoke_root, grid_size):
    """Settings for 64 x 1024 range images of the scans there are."""
    return SIMULATED | {
        "data.init_args.root": smoke_root,
        "data.init_args.extractor": WIDE,
        "data.init_args.features_dir": smoke_root / "wide_grids",
        "data.init_args.grid_size": list(grid_size),
        "trainer.callbacks": [],
        "trainer.limit_val_batches": 0,
    }


@pytest.mark.slow
@pytest.mark.parametrize("stage", EXPERIMENTS)
def test_experiments_at_their_own_size(stage, start, smoke_root, tmp_path):
    settings = full_size(smoke_root, (8, 64))
    if stage == "flow_matching":
        settings |= start_flow(tmp_path, net("vae_h2p4d8"), (64, 1024))
    start(("trainer", "data/simulated", f"experiment/{stage}"), settings)


@pytest.mark.slow
@pytest.mark.parametrize("name", VAES)
def test_vaes_at_their_own_size(name, start, smoke_root):
    stride = VAE(**net(name)).stride
    size = [side // s for side, s in zip((64, 1024), stride, strict=True)]
    settings = full_size(smoke_root, [side // 2 for side in size]) | {
        "model.init_args.vae": CONF / f"net/{name}.yaml",
        "model.init_args.sit.init_args.input_size": size,
        "model.init_args.sit.init_args.in_channels": net(name)["latent_channels"],
        "model.init_args.sit.init_args.hidden_size": 64,
        "model.init_args.sit.init_args.num_heads": 2,
    }
    start(("trainer", "data/simulated", "experiment/vae_alignment"), settings)


# Widths, depths and heads of DiT and SiT; millions of parameters as those papers print them, which
# count neither the projector nor the fixed position embedding.
@pytest.mark.parametrize(
    ("width", "depth", "heads", "millions"),
    [(384, 12, 6, 33), (768, 12, 12, 130), (1024, 24, 16, 458), (1152, 28, 16, 675)],
)
@pytest.mark.parametrize("patch", [2, 4, 8])
def test_a_size_is_two_overrides(width, depth, heads, millions, patch):
    sizes = {"hidden_size": width, "depth": depth, "num_heads": heads, "patch_size": patch}
    with torch.device("meta"):
        sit = SiT(**{**net("sit_b2"), **sizes})
    head = sum(p.numel() for p in sit.projector.parameters())
    count = sum(p.numel() for p in sit.parameters()) - head
    assert count / 1e6 == pytest.approx(millions, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SITS, *UNETS])
def test_velocity_networks_at_their_own_size(name, start, smoke_root, tmp_path):
    """On the latents of a narrow VAE; SiTs have one block more than they are aligned at."""
    thin = net("vae_h2p4d8") | {"channels": 32, "num_res_blocks": 1}
    settings = full_size(smoke_root, (8, 64)) | start_flow(tmp_path, thin, (64, 1024))
    settings |= {f"model.init_args.vae.init_args.{key}": thin[key] for key in thin}
    settings |= {f"data.init_args.{key}": "null" for key in ("extractor", "features_dir")}
    settings["model.init_args.sit"] = CONF / f"net/{name}.yaml"
    if name in SITS:
        given = net(name)
        settings["model.init_args.sit.init_args.depth"] = given["alignment_depth"] + 1
        settings["data.init_args.grid_size"] = [s // given["patch_size"] for s in (16, 128)]
    else:
        settings["data.init_args.grid_size"] = [4, 32]
    start(("trainer", "data/simulated", "experiment/flow_matching"), settings)


@pytest.mark.slow
def test_rgb_pretraining_at_its_own_size(start, tmp_path):
    """With random weights in the place of Stable Diffusion's VAE and of DINOv2."""
    torch.manual_seed(0)
    for index in range(3):
        path = tmp_path / "imagenet" / f"{index}.png"
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (300, 260), (80 * index, 100, 20)).save(path)
    save_file(ImageVAE(**net("sd_vae")).state_dict(), tmp_path / "vae.safetensors")
    torch.save(DINOv2().state_dict(), tmp_path / "dino.pth")
    settings = {
        "data.init_args.source.init_args.root": tmp_path / "imagenet",
        "data.init_args.val_every": 3,
        "model.init_args.init_from": tmp_path / "vae.safetensors",
        "model.init_args.teacher.init_args.weights": tmp_path / "dino.pth",
    }
    start(("trainer", "data/images", "experiment/rgb_pretraining"), settings)
