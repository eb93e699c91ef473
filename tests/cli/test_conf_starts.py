"""Every YAML under ``conf`` is used: a stage starts with it, or its network is built.

Networks and images are tiny here; the slow tests start them at their own sizes.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from fault_commands import Command

from r3dpa import viz
from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.cli import main
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn import VAE, LatentNorm, SiT, UNet

THIN_DECODER = {"latent_channels": 4, "channels": 32, "num_res_blocks": 0}
THIN_DECODER |= {"channel_multipliers": [1, 1, 1], "strides": [[2, 2], [2, 2]]}
TINY_UNET = {"input_size": [4, 16], "in_channels": 4, "channels": 32, "num_res_blocks": 1}
TINY_UNET |= {"channel_multipliers": [1, 2], "feature_dim": 16, "projector_dim": 32}
CONF = Path(__file__).resolve().parents[2] / "conf"
ELSEWHERE = {  # by the test that starts them
    "test_rgb_stages": "data/dead_leaves data/images experiment/image_vae "
    "experiment/rgb_pretraining demo/rgb_pretraining net/sd_vae r3dpa_s_2/rgb_prior",
    "test_shipped_networks": "net/vae_h2p4d8 net/vae_h1p4d4 net/vae_h16d4 net/vae_h16p2d16",
    "test_stage_cli": "data/points experiment/waffleiron_s data/labelled_points "
    "experiment/waffleiron_s_2 experiment/waffleiron_judge",
    "test_documented_commands": "launch/nodes data/kitti360_paper",
    "test_baselines": "demo/lidm demo/lidm_first_stage demo/r2dm demo/r2flow "
    + " ".join(f"baseline/{path.stem}" for path in CONF.glob("baseline/*.yaml")),
    "test_ablate": " ".join(
        p.relative_to(CONF).with_suffix("").as_posix() for p in CONF.glob("ablation/**/*.yaml")
    ),
}
EXPERIMENTS = ("vae_alignment", "joint", "joint_unet", "flow_matching", "few_step")
STARTS = {  # data by overlay of the demo; the experiments alone are started by `smoke_args`
    "demo/vae_alignment": "kitti360",
    "demo/joint": "demo_folder",
    "demo/joint_unet": "folder",
    "demo/flow_matching": "demo",
    "demo/few_step": "simulated",
}
R3DPA_S = {  # in the order given
    "trained": ("data", "vae_alignment"),
    "more": ("data", "vae_alignment", "vae_more"),
    "decoder": ("data", "vae_alignment", "vae_decoder"),
    "flow": ("data", "flow_matching"),
    "few_step": ("data", "flow_matching", "few_step"),
    "demo": ("demo_data", "vae_alignment", "demo_vae"),
    "demo_flow": ("demo_folder", "flow_matching", "demo_flow"),
}
R3DPA_S_2 = {
    "vae": ("vae_alignment",),
    "encoder": ("vae_alignment", "encoder"),
    "vae_rgb": ("teacher", "vae_alignment", "vae_rgb"),
    "decoder": ("vae_alignment", "vae_decoder"),
    "decoder_labels": ("vae_alignment", "decoder_labels"),
    "perceptual": ("vae_alignment", "decoder_labels", "perceptual"),
    "flow": ("teacher", "flow_matching"),
    "aligned": ("teacher", "flow_matching", "aligned"),
    "readout": ("teacher", "flow_matching", "readout"),
    "joint": ("teacher", "joint"),
    "few_step": ("teacher", "flow_matching", "few_step"),
    "control_vae": ("vae_alignment", "vae_decoder", "control_vae"),
    "control_flow": ("flow_matching", "control_flow"),
}
VELOCITIES = sorted(path.stem for kind in ("sit", "unet") for path in CONF.glob(f"net/{kind}_*"))
QUIET = {
    "trainer.accelerator": "cpu",
    "trainer.devices": 1,
    "trainer.fast_dev_run": "true",
    "trainer.enable_model_summary": "false",
    "trainer.enable_progress_bar": "false",
    "data.init_args.num_workers": 0,
    "data.init_args.batch_size": 1,
}
GEOMETRIC = "r3dpa.features.GeometricFeatures"
SIMULATED = {"data.init_args.num_scans": 12}  # as in smoke.yaml: the same folder
WIDE = f"{{class_path: {GEOMETRIC}, init_args: {{dim: 768}}}}"
pytestmark = pytest.mark.filterwarnings("ignore:.*fast_dev_run.*")


def test_no_file_is_left_out():
    files = {path.relative_to(CONF).with_suffix("").as_posix() for path in CONF.rglob("*.yaml")}
    started = {"smoke", "trainer", "demo/trainer", *STARTS}
    started |= {f"experiment/{name}" for name in EXPERIMENTS}
    started |= {f"data/{name}" for name in STARTS.values()}
    started |= {f"net/{name}" for name in VELOCITIES}
    started |= {
        f"r3dpa_s/{name}"
        for names in R3DPA_S.values()
        for name in (*names, "vae", "sit", "trainer")
    }
    started |= {
        f"r3dpa_s_2/{name}"
        for names in R3DPA_S_2.values()
        for name in (*names, "data", "vae", "trainer")
    }
    elsewhere = set(" ".join(ELSEWHERE.values()).split())
    assert files == started | elsewhere
    assert not started & elsewhere


@pytest.fixture
def start(tmp_path, caplog, monkeypatch):
    """``start(configs, settings)`` runs ``r3dpa fit`` for one batch, with blank pictures."""
    for name in ("scenes_sheet", "reconstruction_figure"):  # drawn in tests/callbacks
        monkeypatch.setattr(viz, name, lambda *_: np.zeros((2, 2, 3), np.uint8))

    def start(configs, settings):
        files = [name if isinstance(name, Path) else CONF / f"{name}.yaml" for name in configs]
        words = [word for path in files for word in ("--config", str(path))]
        words += [f"--{key}={value}" for key, value in (QUIET | settings).items()]
        main(["fit", *words, f"--run_dir={tmp_path / 'run'}"])
        assert "`Trainer.fit` stopped: `max_steps=1` reached" in caplog.text
        kinds = (".ckpt", ".safetensors", ".rows")  # the last of cached latents
        written = [path for path in (tmp_path / "run").rglob("*") if path.suffix in kinds]
        assert not written  # a trial must not look like a run, nor replace one

    return start


def start_flow(folder, vae, size, sit=None, codec=RangeCodec()):
    """Setting with the checkpoint that a flow or, with a SiT, few steps start from."""
    network = VAE(**vae)
    channels = network.latent_channels
    norm = LatentNorm(channels)
    norm.num_batches_tracked.fill_(1)
    rows, columns = (side // s for side, s in zip(size, network.stride, strict=True))
    geometry = ScanGeometry(
        SphericalProjection(LidarSensor(*size)), codec, (rows // 2, columns // 2)
    )
    networks = {
        "vae": NetworkState.of(network, vae),
        "latent_norm": NetworkState.of(norm, {"channels": channels}),
    }
    if sit is not None:
        networks["ema"] = networks["sit"] = NetworkState.of(SiT(**sit), sit)
        networks["ema_latent_norm"] = networks["latent_norm"]
    content = Checkpoint(Path("v"), "vae_alignment", networks, geometry=geometry.to_dict())
    return {"model.init_args.init_from": save_checkpoint(content, folder / "vae.safetensors")}


def net(name):
    return yaml.safe_load((CONF / f"net/{name}.yaml").read_text()).get("init_args", {})


@pytest.mark.parametrize(("experiment", "data"), STARTS.items())
def test_experiments_with_tiny_networks(experiment, data, start, smoke_root, tmp_path):
    """Each with other data, all of which are the scans of the smoke size here."""
    stage = experiment.removeprefix("demo/")
    configs = ["trainer", f"data/{data}", f"experiment/{stage}", "demo/trainer", experiment]
    smoke = yaml.safe_load((CONF / "smoke.yaml").read_text())
    smoke_file = "smoke"
    if stage == "joint_unet":  # whose network has other arguments
        smoke["model"]["init_args"]["sit"] = {"init_args": TINY_UNET}
        smoke_file = tmp_path / "smoke.yaml"
        smoke_file.write_text(yaml.safe_dump(smoke))
    configs += [smoke_file, f"data/{data}"]  # again, in place of the data of smoke.yaml
    settings = {
        f"data.init_args.{'scans' if 'folder' in data else 'root'}": smoke_root,
        "data.init_args.sensor": "{beams: 16, columns: 64}",
        "data.init_args.grid_size": "[2, 8]",
        "data.init_args.extractor": f"{{class_path: {GEOMETRIC}, init_args: {{dim: 16}}}}",
    }
    if data in ("demo", "simulated"):
        settings |= SIMULATED
    if stage in ("flow_matching", "few_step"):
        networks = smoke["model"]["init_args"]
        sit = networks["sit"]["init_args"] if stage == "few_step" else None
        settings |= start_flow(tmp_path, networks["vae"]["init_args"], (16, 64), sit)
    if stage == "few_step":
        settings |= {
            "model.init_args.sit.init_args.average_blocks": 1,
            "model.init_args.thin_decoder.init_args": json.dumps(THIN_DECODER),
        }
    start(configs, settings)


def small_r3dpa_s(edition, grid_size):
    """Arguments of the networks of an edition for images of 16 x 64, and settings of these."""
    vae, sit = (
        yaml.safe_load((CONF / f"{part}.yaml").read_text())["init_args"]
        for part in (f"{edition}/vae", "r3dpa_s/sit")
    )
    sit["input_size"] = [2, 4]
    settings = {
        "data.init_args.sensor": "{beams: 16, columns: 64}",
        "data.init_args.grid_size": grid_size,
        "model.init_args.sit.init_args.input_size": "[2, 4]",
    }
    return vae, sit, settings


@pytest.mark.parametrize(
    "name",
    [name if name == "demo" else pytest.param(name, marks=pytest.mark.slow) for name in R3DPA_S],
)
def test_r3dpa_s_and_its_demo_start(name, start, smoke_root, tmp_path):
    given = R3DPA_S[name]
    vae, sit, settings = small_r3dpa_s("r3dpa_s", "[2, 2]")
    if "demo_folder" in given:
        settings["data.init_args.scans"] = smoke_root
    else:
        settings |= {"data.init_args.root": tmp_path / "data", "data.init_args.num_scans": 2}
    if name != "trained":
        codec = RangeCodec("log2", return_channel=True)
        exported = None if name == "flow" else sit
        settings |= start_flow(tmp_path, vae, (16, 64), exported, codec)
    configs = ["trainer", *(f"r3dpa_s/{part}" for part in ("trainer", *given))]
    start(configs, settings)


@pytest.mark.parametrize(
    "name",
    [n if n == "joint" else pytest.param(n, marks=pytest.mark.slow) for n in R3DPA_S_2],
)
def test_the_second_edition_of_r3dpa_s_starts(name, start, tmp_path):
    vae, sit, settings = small_r3dpa_s("r3dpa_s_2", "[2, 2]")
    settings |= {"data.init_args.root": tmp_path / "data", "data.init_args.num_scans": 2}
    if "teacher" in R3DPA_S_2[name]:
        settings["data.init_args.extractor"] = (
            f"{{class_path: {GEOMETRIC}, init_args: {{dim: 128}}}}"
        )
    if name.startswith("vae"):
        later = ("intensity", "num_classes", "refinement")
        vae = {key: value for key, value in vae.items() if key not in later}
    channels = {} if name.startswith("vae") else {"intensity_channel": True, "num_classes": 15}
    codec = RangeCodec("log2", return_channel=True, **channels)
    settings |= start_flow(tmp_path, vae, (16, 64), sit, codec)
    files = ("trainer", "data", *R3DPA_S_2[name])
    start(["trainer", *(f"r3dpa_s_2/{part}" for part in files)], settings)


def test_few_steps_keep_the_arguments_of_the_sit_of_the_flow(tmp_path):
    """In a process of its own, as users run it: others parsed before it hid that they were lost."""
    overlay = tmp_path / "few_step.yaml"
    sit = {"class_path": "r3dpa.nn.AverageVelocitySiT", "init_args": {"average_blocks": 3}}
    model = {"class_path": "r3dpa.modules.FewStep", "init_args": {"sit": sit}}
    overlay.write_text(yaml.safe_dump({"model": model}))
    names = ("trainer", "r3dpa_s/data", "r3dpa_s/flow_matching")
    configs = [f"--config={path}" for path in (*(CONF / f"{n}.yaml" for n in names), overlay)]
    command = Command(tmp_path / "log", ["fit", *configs, "--print_config"])
    status, printed = command.end()
    assert status == 0, printed
    network = yaml.safe_load(printed)["model"]["init_args"]["sit"]
    expected = yaml.safe_load((CONF / "r3dpa_s/sit.yaml").read_text())["init_args"]
    assert network["class_path"] == sit["class_path"]
    assert {name: network["init_args"][name] for name in expected} == expected


def test_feature_grids_have_the_tokens_of_the_sit_and_come_from_shipped_weights():
    demo = yaml.safe_load((CONF / "demo/joint.yaml").read_text())["model"]["init_args"]["sit"]
    for data in set(STARTS.values()):
        settings = yaml.safe_load((CONF / f"data/{data}.yaml").read_text())["data"]["init_args"]
        assert settings["extractor"]["class_path"].endswith("WaffleIronS")
        with torch.device("meta"):
            sit = SiT(**(demo["init_args"] if "demo" in data else net("sit_b2")))
        assert tuple(settings["grid_size"]) == sit.grid_size


@pytest.mark.parametrize("name", VELOCITIES)
def test_velocity_networks_are_built_at_their_own_size(name):
    with torch.device("meta"):
        network = (SiT if name.startswith("sit") else UNet)(**net(name))
        latents = torch.empty(2, network.in_channels, *network.input_size)
        output = network(latents, torch.empty(2))
    assert output.velocity.shape == latents.shape
    assert output.features.shape[2] == network.feature_dim


@pytest.mark.slow
@pytest.mark.parametrize("stage", EXPERIMENTS)
def test_experiments_at_their_own_size(stage, start, smoke_root, tmp_path):
    """With 64 x 1024 range images of the scans there are."""
    settings = SIMULATED | {
        "data.init_args.root": smoke_root,
        "data.init_args.extractor": WIDE,
        "data.init_args.features_dir": smoke_root / f"wide_grids_{stage}",
        "trainer.callbacks": [],
        "trainer.limit_val_batches": 0,
    }
    if stage in ("flow_matching", "few_step"):
        sit = net("sit_b2") if stage == "few_step" else None
        settings |= start_flow(tmp_path, net("vae_h2p4d8"), (64, 1024), sit)
    start(("trainer", "data/simulated", f"experiment/{stage}"), settings)


# Widths, depths and heads of DiT and SiT; millions of parameters as those papers print them, which
# count neither the projector nor the fixed position embedding.
@pytest.mark.parametrize(
    ("width", "depth", "heads", "millions"),
    [(384, 12, 6, 33), (768, 12, 12, 130), (1024, 24, 16, 458), (1152, 28, 16, 675)],
)
def test_a_size_is_three_overrides(width, depth, heads, millions):
    sizes = {"hidden_size": width, "depth": depth, "num_heads": heads}
    with torch.device("meta"):
        sit = SiT(**{**net("sit_b2"), **sizes})
    head = sum(p.numel() for p in sit.projector.parameters())
    count = sum(p.numel() for p in sit.parameters()) - head
    assert count / 1e6 == pytest.approx(millions, rel=0.02)
