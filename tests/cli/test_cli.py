"""The ``r3dpa`` command from the outside: what it prints, writes, and refuses."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli import COMMANDS, main
from r3dpa.data.scans import read_npz, read_ply, read_scan
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, SphericalProjection, in_range, points_of
from r3dpa.io import source_commit

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")

CONF = Path(__file__).resolve().parents[2] / "conf"
SENSOR = LidarSensor(beams=16, columns=64)  # of conf/smoke.yaml
LEGACY_VAE = ["--model.init_args.vae.init_args.legacy_upsample=true"]
CSV_LOGGER = json.dumps(
    [
        {
            "class_path": "lightning.pytorch.loggers.CSVLogger",
            "init_args": {"save_dir": "", "name": ""},
        }
    ]
)


@pytest.fixture(scope="module")
def joint_run(smoke_args, tmp_path_factory):
    """Run of the joint stage whose last and averaged weights have moved apart.

    Its VAE is one that the official layout can hold.
    """
    run_dir = tmp_path_factory.mktemp("joint")
    more = ["--trainer.logger", CSV_LOGGER, "--trainer.limit_val_batches=0"]
    more += ["--model.init_args.optimizer.lr=1e-2", "--model.init_args.ema_decay=0.5"]
    more += LEGACY_VAE
    main(smoke_args("joint", run_dir, *more))
    return run_dir


@pytest.fixture(scope="module")
def joint_checkpoint(joint_run):
    return joint_run / "checkpoints" / "last.ckpt"


def sample(checkpoint, out, *more):
    words = ["--ckpt", checkpoint, "--out", out, "--num", 3, "--steps", 3, *more]
    main(["sample", *map(str, words)])
    return out


@pytest.fixture(scope="module")
def scenes(joint_checkpoint, tmp_path_factory):
    return sample(joint_checkpoint, tmp_path_factory.mktemp("scenes") / "new" / "folder")


def python(code):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


class TestHelp:
    @pytest.mark.parametrize("args", ["['--help']", "['-h']", "[]"])
    def test_lists_every_command_and_loads_nothing_heavy(self, args):
        heavy = ["torch", "lightning", "matplotlib", "numpy", "wandb", "jsonargparse"]
        out = python(
            f"import sys; from r3dpa.cli import main; main({args}); "
            f"print('loaded', [name for name in {heavy} if name in sys.modules])"
        )
        listed = {line[2:19].strip() for line in out.splitlines() if line.startswith("  ")}
        assert listed == set(COMMANDS)
        assert out.splitlines()[-1] == "loaded []"

    def test_options_of_commands_are_listed_without_torch(self):
        out = python(
            "import sys; from r3dpa.cli import COMMANDS, main\n"
            "for name in COMMANDS:\n"
            "    if not COMMANDS[name].own_parser:\n"
            "        try: main([*name.split(), '--help'])\n"
            "        except SystemExit: pass\n"
            "print('loaded', [name for name in ('torch', 'lightning') if name in sys.modules])"
        )
        assert out.splitlines()[-1] == "loaded []"

    def test_every_line_says_what_the_command_does(self, capsys):
        main(["--help"])
        lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
        assert all(len(line.split()) > 3 for line in lines)

    @pytest.mark.parametrize("command", sorted(COMMANDS))
    def test_every_command_lists_its_options(self, command, capsys):
        with pytest.raises(SystemExit) as stop:
            main([*command.split(), "--help"])
        assert stop.value.code == 0
        out = capsys.readouterr().out
        assert f"{command} [" in out
        assert "--help" in out

    def test_version(self, capsys):
        main(["--version"])
        assert capsys.readouterr().out.strip() == "0.1.0"

    def test_module_form_is_the_same_command(self):
        out = subprocess.run(
            [sys.executable, "-m", "r3dpa"], capture_output=True, text=True, check=True, timeout=60
        ).stdout
        assert out.startswith("usage: r3dpa COMMAND")


class TestUsageErrors:
    def test_unknown_command(self, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["smaple"])
        assert stop.value.code == 2
        assert "unknown command 'smaple': give one of" in capsys.readouterr().err

    def test_unknown_option(self, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["sample", "--ckpt", "a", "--out", "b", "--stepz", "3"])
        assert stop.value.code == 2
        assert "--stepz" in capsys.readouterr().err

    def test_missing_option(self, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["sample", "--ckpt", "a"])
        assert stop.value.code == 2
        assert "out" in capsys.readouterr().err


class TestErrorsOnTheTerminal:
    """With the words of the process, not of a caller, an error is one line and exit status 1."""

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["report", "nowhere"], "r3dpa report: nowhere holds no version_"),
            (["sample", "--ckpt", "no.ckpt", "--out", "x"], "r3dpa sample: no checkpoint file no"),
            (["convert", "no.pt", "x.pt"], "r3dpa convert: no checkpoint file no.pt"),
        ],
    )
    def test_is_one_line(self, words, message, monkeypatch, tmp_path):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["r3dpa", *words])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code.startswith(message)
        assert "\n" not in stop.value.code

    def test_of_a_fit_that_has_not_started(self, monkeypatch, smoke_args, tmp_path):
        monkeypatch.setattr(sys, "argv", ["r3dpa", *smoke_args("flow_matching", tmp_path)])
        with pytest.raises(SystemExit, match=r"^r3dpa fit: .*give model\.init_from a checkpoint"):
            main()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["view", "scans", "--out", "file"], "file is a file; give another --out"),
        (["realism", "--scans", "scans", "--reference", "scans", "--out", "scans"], "is a folder"),
        (["bench", "training", "--out", "scans"], "scans is a folder; give --out the name"),
        (["bench", "training", "--out", "file/costs.json"], "file is a file; give another --out"),
    ],
)
def test_an_out_that_cannot_be_written_is_refused_before_the_work(
    words, message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "scans").mkdir()  # empty: whatever read it first would say so
    with pytest.raises(ValueError, match=message):
        main(words)


@pytest.fixture
def simulated(tmp_path):
    main(["simulate", "--out", str(tmp_path), "--scans", "3", "--drives", "0000", "0003"])
    return tmp_path


class TestSimulate:
    """One small scan each; what is asked for is recorded in the manifest."""

    CALIBRATION = "lasers: [{vert_correction: 0.02}, {vert_correction: -0.1}]"

    @pytest.fixture
    def simulate(self, tmp_path):
        """``simulate(*words)``: manifest of a data set of one scan."""
        calibration = tmp_path / "lasers.yaml"
        calibration.write_text(self.CALIBRATION)
        out = tmp_path / "out"

        def run(*words):
            fixed = ["--out", out, "--scans", 1, "--sensor", calibration]
            main(["simulate", *map(str, [*fixed, *words])])
            return json.loads((out / "simulation.json").read_text())

        return run

    def test_prints_what_each_effect_did_and_cost(self, simulate, capsys):
        simulate("--effects.range_noise", "off")
        lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
        assert lines["range_noise"].split()[1:4] == ["0", "0", "1"]
        assert lines["range_noise"].endswith("switched off")
        assert lines["detection_limit"].split()[1:4] == ["1", "0", "0"]
        assert lines["dual_return"].split()[1:4] == ["0", "1", "0"]
        assert lines["total"].endswith("100.0%")

    def test_sensor_and_return_mode(self, simulate):
        sensor = simulate("--return_mode", "dual")["sensor"]
        assert sensor["return_mode"] == "dual"
        assert sensor["lasers"]["inclination_rad"] == [0.02, -0.1]

    def test_weather_by_its_fields(self, simulate):
        weather = simulate("--weather.visibility_m", 50, "--weather.clear_sky", "false")["weather"]
        assert (weather["visibility_m"], weather["clear_sky"]) == (50, False)
        assert weather["rain_mm_h"] == 0

    @pytest.mark.parametrize(
        "words",
        [
            ["--effects.range_noise", "off", "--effects.soft_raydrop=on"],
            ["--effects", "{range_noise: off, soft_raydrop: on}"],
        ],
    )
    def test_switches_on_the_command_line(self, simulate, words):
        assert simulate(*words)["effects"] == {"range_noise": "off", "soft_raydrop": "on"}

    def test_switches_in_yaml_and_one_more_on_the_command_line(self, simulate, tmp_path):
        config = tmp_path / "request.yaml"
        config.write_text(
            "seed: 3\ndrives: ['0003']\nweather: {rain_mm_h: 2}\n"
            "effects: {range_noise: off, soft_raydrop: on, rolling_shutter: auto}\n"
        )
        manifest = simulate("--config", config, "--effects.ego_occlusion", "off")
        assert manifest["effects"] == {
            **{"ego_occlusion": "off", "range_noise": "off", "soft_raydrop": "on"}
        }
        assert (manifest["seed"], manifest["drives"]) == (3, ["0003"])
        assert manifest["weather"]["rain_mm_h"] == 2

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--effects.fogg", "off"], "there is no effect 'fogg'; there are dual_return, "),
            (["--effects.range_noise", "of"], "range_noise must be auto, on or off, got 'of'"),
            (["--sensor", "hdl65e"], "there is no sensor 'hdl65e': give hdl64e, "),
            (["--weather.rain_mm_h", "-1"], "^rain_mm_h must be 0 or greater, got -1"),
        ],
    )
    def test_wrong_words_are_named(self, simulate, words, message, tmp_path):
        with pytest.raises(ValueError, match=message):
            simulate(*words)
        assert not (tmp_path / "out").exists()

    def test_a_data_module_asks_for_the_same(self, simulate, tmp_path, capsys):
        config = tmp_path / "data.yaml"
        config.write_text(
            "data: {class_path: r3dpa.data.SimulatedDataModule, init_args: {"
            f"root: {tmp_path / 'data'}, num_scans: 2, simulation_sensor: "
            f"{tmp_path / 'lasers.yaml'}, effects: {{range_noise: off}}, "
            "weather: {rain_mm_h: 2}, extractor: r3dpa.nn.backbones.GeometricFeatures}}\n"
        )
        words = ["--scans", 2, "--effects.range_noise", "off", "--weather.rain_mm_h", 2]
        manifest = simulate(*words)
        main(["features", "--config", str(config)])
        assert json.loads((tmp_path / "data" / "simulation.json").read_text()) == manifest

    def test_an_interrupt_stops_it_in_one_line_and_the_same_command_goes_on(self, tmp_path):
        command = [sys.executable, "-m", "r3dpa", "simulate", "--out", tmp_path / "out"]
        command += ["--scans", "300", "--workers", "2", "--sensor", tmp_path / "lasers.yaml"]
        (tmp_path / "lasers.yaml").write_text(self.CALIBRATION)
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        while not list(tmp_path.rglob("data/*.bin")) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
        assert process.returncode == 130
        assert stderr == "r3dpa simulate: stopped; the same command continues\n"
        assert not list(tmp_path.rglob(".*.partial.*"))
        assert 0 < len(list(tmp_path.rglob("data/*.bin"))) < 300


class TestSimulateAndCheck:
    def test_simulated_scans_pass_the_check(self, simulated, capsys):
        scans = list(simulated.rglob("data_3d_raw/*/velodyne_points/data/*.bin"))
        drives = {path.parents[2].name for path in scans}
        assert drives == {f"2013_05_28_drive_{number}_sync" for number in ("0000", "0003")}
        capsys.readouterr()
        main(["check", str(simulated)])
        assert "3 scans in 2 drives, all usable" in capsys.readouterr().out

    def test_check_names_every_bad_scan_and_missing_folder(self, simulated, capsys):
        truncated, *_, infinite = sorted(simulated.rglob("data/*.bin"))
        truncated.write_bytes(truncated.read_bytes()[:-3])
        points = read_scan(infinite)
        points[1, 2] = np.inf
        infinite.write_bytes(points.tobytes())
        with pytest.raises(SystemExit) as stop:
            main(["check", str(simulated)])
        assert stop.value.code == 1
        bad = [line for line in capsys.readouterr().out.splitlines() if line.startswith("bad: ")]
        assert len(bad) == 2
        assert str(truncated) in bad[0]
        assert "not a multiple of 16" in bad[0]
        assert str(infinite) in bad[1]
        assert "NaN or infinite" in bad[1]

    def test_check_names_missing_drives(self, tmp_path, capsys):
        (tmp_path / "data_3d_raw" / "2013_05_28_drive_0000_sync").mkdir(parents=True)
        with pytest.raises(SystemExit) as stop:
            main(["check", str(tmp_path)])
        assert stop.value.code == 1
        missing = [x for x in capsys.readouterr().out.splitlines() if x.startswith("missing: ")]
        assert len(missing) == 9
        assert missing[0].endswith("drive_0000_sync/velodyne_points/data")
        assert missing[1].endswith("drive_0002_sync")

    def test_check_of_a_folder_that_does_not_exist(self, tmp_path, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["check", str(tmp_path / "nowhere")])
        assert stop.value.code == 1
        assert f"missing: {tmp_path / 'nowhere'}" in capsys.readouterr().out


def values(folder):
    return {p.stem: read_scan(p)[:, :3] for p in sorted((folder / "bin").iterdir())}


def assert_same_scenes(actual, expected, num=3):
    """Up to the rounding of another batch size: 1e-5 in the latents, 1e-3 m in the points."""
    actual, expected = values(actual), values(expected)
    assert len(actual) == num
    for name, points in expected.items():
        np.testing.assert_allclose(actual[name], points, atol=1e-3, rtol=0)


class TestSample:
    def test_writes_every_scene(self, scenes):
        clouds = values(scenes)
        assert list(clouds) == ["000000", "000001", "000002"]
        projection = SphericalProjection(SENSOR)
        for points, range_m in zip(clouds.values(), np.load(scenes / "range_m.npy"), strict=True):
            assert 0 < len(points) <= SENSOR.beams * SENSOR.columns
            assert in_range(torch.from_numpy(points), SENSOR).all()
            row, column = projection.pixel_of(torch.from_numpy(points))
            assert len(torch.unique(row * SENSOR.columns + column)) == len(points)
            np.testing.assert_array_equal(points, points_of(torch.from_numpy(range_m), projection))
        assert not np.array_equal(clouds["000000"], clouds["000001"])
        assert {p.name for p in scenes.iterdir()} == {
            *("bin", "range_m.npy", "range", "birds_eye", "scene_3d", "scenes.png"),
            *("scenes.html", "metadata.json"),
        }

    def test_other_forms_are_written_on_demand(self, joint_checkpoint, scenes, tmp_path):
        words = ("--formats", "ply,npz", "--pictures", 0)
        out = sample(joint_checkpoint, tmp_path, *words)
        assert {p.name for p in out.iterdir()} == {
            *("ply", "scenes.npz", "range_m.npy", "metadata.json")
        }
        clouds = read_npz(out / "scenes.npz")
        for name, points in values(scenes).items():
            np.testing.assert_array_equal(clouds[name], points)
            np.testing.assert_array_equal(read_ply(out / "ply" / f"{name}.ply"), points)

    def test_draws_every_scene(self, scenes):
        pictures = [scenes / "scenes.png"]
        for folder in ("range", "birds_eye", "scene_3d"):
            pictures += sorted((scenes / folder).iterdir())
        assert len(pictures) == 1 + 3 * 3
        for path in pictures:
            with Image.open(path) as picture:
                assert min(picture.size) >= 100
                assert len(picture.convert("RGB").getcolors(1 << 20)) > 10

    def test_metadata_is_enough_to_repeat_the_run(self, scenes, joint_checkpoint):
        metadata = json.loads((scenes / "metadata.json").read_text())
        expected = {
            "checkpoint": str(joint_checkpoint),
            "stage": "joint",
            "step": 3,
            "weights": "ema",
            "num": 3,
            "seed": 0,
            "interpolant": "linear",
            "nfe": 3,
            "precision": "fp32",
            "batch_size": 8,
            "compile": False,
            "formats": ["bin"],
            "autoguidance": None,
            "drawn_by_last_run": 3,
            "r3dpa": "0.1.0",
            "commit": source_commit(),
            "torch": torch.__version__,
        }
        assert {key: metadata[key] for key in expected} == expected
        assert metadata["sampler"] == {
            "solver": "euler_maruyama",
            "steps": 3,
            "sde_last_time": 0.04,
            "sde_last": "denoise",
            "shift": 1.0,
            "eta": 1.0,
        }
        assert metadata["geometry"]["projection"]["sensor"]["beams"] == SENSOR.beams
        assert metadata["seconds_per_scene"] > metadata["device_seconds_per_scene"] > 0
        assert metadata["threads"] == torch.get_num_threads()

    def test_options_reach_the_sampler(self, joint_checkpoint, tmp_path):
        out = sample(joint_checkpoint, tmp_path, "--solver", "heun", "--seed", 5, "--num", 1)
        metadata = json.loads((out / "metadata.json").read_text())
        assert metadata["sampler"]["solver"] == "heun"
        assert (metadata["nfe"], metadata["seed"], metadata["num"]) == (5, 5, 1)

    @pytest.mark.parametrize(
        ("solver", "evaluations"),
        [
            *[("euler", 3), ("midpoint", 6), ("ab2", 3), ("ab3", 3), ("dpmpp_2m", 3)],
            *[("unipc", 3), ("euler_maruyama", 3)],
        ],
    )
    def test_every_solver_can_be_chosen(
        self, solver, evaluations, joint_checkpoint, tmp_path, capsys
    ):
        words = ("--solver", solver, "--num", 1, "--pictures", 0)
        metadata = json.loads(
            (sample(joint_checkpoint, tmp_path, *words) / "metadata.json").read_text()
        )
        assert (metadata["sampler"]["solver"], metadata["nfe"]) == (solver, evaluations)
        assert f": {evaluations} network evaluations each, " in capsys.readouterr().out

    def test_a_quality_chooses_the_sampler_and_says_so(self, joint_checkpoint, tmp_path, capsys):
        words = ["--ckpt", joint_checkpoint, "--out", tmp_path / "out", "--num", 1]
        words += ["--quality", "draft", "--pictures", 0]
        main(["sample", *map(str, words)])
        metadata = json.loads((tmp_path / "out" / "metadata.json").read_text())
        chosen = metadata["sampler"]
        assert chosen == asdict(SamplerConfig.of_quality("draft"))
        line = f"quality draft: {chosen['solver']}, {chosen['steps']} steps, shift"
        assert line in capsys.readouterr().out
        with pytest.raises(ValueError, match=r"--quality draft chooses what --steps gives"):
            main(["sample", *map(str, words), "--steps", "4"])

    def test_guidance_by_the_model_itself_changes_nothing(self, joint_checkpoint, scenes, tmp_path):
        """v + s (v - v) = v, for twice the evaluations."""
        words = ("--autoguidance", joint_checkpoint, "--guidance_scale", 3, "--pictures", 0)
        out = sample(joint_checkpoint, tmp_path, *words)
        assert_same_scenes(out, scenes)
        metadata = json.loads((out / "metadata.json").read_text())
        assert metadata["nfe"] == 6
        assert metadata["autoguidance"]["scale"] == 3
        assert metadata["autoguidance"]["interval"] == [0, 1]

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--solver", "heun", "--eta", 0.5], "solver heun does not read eta"),
            (["--shift", 2], "solver euler_maruyama does not read shift"),
            (["--solver", "ab2", "--sde_last", "mean"], "solver ab2 does not read sde_last"),
            (["--guidance_scale", 2], "--guidance_scale, .* need --autoguidance"),
            (["--guidance_interval", "[0, 1]"], "--guidance_interval .* need --autoguidance"),
            (["--allow_other_latents", "true"], "--allow_other_latents .* --autoguidance"),
            (["--sde_last_time", 2], r"must lie in \(0, 1\), got 2"),
            (["--seed", -1], "seed must be at least 0, got -1"),
            (["--pictures", -1], "pictures must be at least 0, got -1"),
        ],
    )
    def test_options_that_say_nothing_are_refused_and_nothing_is_touched(
        self, words, message, joint_checkpoint, tmp_path
    ):
        """Not even with --overwrite in a folder that holds scenes."""
        (tmp_path / "metadata.json").write_text("{}")
        (tmp_path / "range_m.npy").write_bytes(b"scenes")
        with pytest.raises(ValueError, match=message):
            sample(joint_checkpoint, tmp_path, *words, "--overwrite", "true")
        assert (tmp_path / "range_m.npy").read_bytes() == b"scenes"
        assert len(list(tmp_path.iterdir())) == 2

    def test_metadata_holds_paths_as_they_are_given(self, joint_checkpoint, tmp_path, monkeypatch):
        monkeypatch.chdir(joint_checkpoint.parent)
        words = ["--pictures", 0, "--autoguidance", joint_checkpoint.name]
        out = sample(joint_checkpoint.name, tmp_path / "out", *words)
        text = (out / "metadata.json").read_text()
        assert json.loads(text)["checkpoint"] == joint_checkpoint.name
        for folder in (joint_checkpoint.parent, tmp_path, Path.home()):
            assert str(folder) not in text

    def test_an_interrupted_run_goes_on(self, joint_checkpoint, scenes, tmp_path, monkeypatch):
        def stop(*_):
            raise KeyboardInterrupt

        words = ("--batch_size", 1, "--pictures", 0)
        with monkeypatch.context() as patch:
            generate, calls = SceneGenerator.generate, []
            patch.setattr(
                SceneGenerator,
                "generate",
                lambda *args: stop() if len(calls) == 2 else calls.append(1) or generate(*args),
            )
            with pytest.raises(SystemExit) as stopped:
                sample(joint_checkpoint, tmp_path, *words)
        assert stopped.value.code == 130
        assert not (tmp_path / "metadata.json").exists()
        with pytest.raises(ValueError, match=r"unfinished run with seed 0, not 1"):
            sample(joint_checkpoint, tmp_path, *words, "--seed", 1)
        assert_same_scenes(sample(joint_checkpoint, tmp_path, *words), scenes)
        metadata = json.loads((tmp_path / "metadata.json").read_text())
        assert (metadata["drawn_by_last_run"], metadata["nfe"]) == (1, 3)

    def test_evaluations_are_the_mean_over_all_scenes(
        self, joint_checkpoint, tmp_path, monkeypatch
    ):
        """Batches of 2 and 1 scenes that took 5 and 8: as of a solver that chooses its steps."""
        generate, nfe = SceneGenerator.generate, iter([5, 8])
        monkeypatch.setattr(
            SceneGenerator, "generate", lambda *args: replace(generate(*args), nfe=next(nfe))
        )
        sample(joint_checkpoint, tmp_path, "--batch_size", 2, "--pictures", 0)
        assert json.loads((tmp_path / "metadata.json").read_text())["nfe"] == (2 * 5 + 8) / 3

    def test_fast_path_draws_about_the_same(self, joint_checkpoint, scenes, tmp_path):
        """bf16 moves few ranges by much more than its 0.4 % of the latents; see test_generation."""
        words = ("--precision", "bf16", "--decode_batch_size", 2, "--pictures", 0)
        fast = np.load(sample(joint_checkpoint, tmp_path, *words) / "range_m.npy")
        slow = np.load(scenes / "range_m.npy")
        assert ((fast > 0) == (slow > 0)).mean() > 0.95
        assert np.median(np.abs(fast - slow)[(fast > 0) & (slow > 0)]) < 0.3

    def test_scenes_depend_on_neither_batch_size_nor_number(
        self, joint_checkpoint, scenes, tmp_path
    ):
        more = sample(joint_checkpoint, tmp_path, "--num", 4, "--batch_size", 1)
        assert_same_scenes(more, scenes, num=4)

    def test_last_weights_differ_from_the_average(self, joint_checkpoint, scenes, tmp_path):
        last = values(sample(joint_checkpoint, tmp_path, "--num", 1, "--weights", "last"))
        points = values(scenes)["000000"]
        assert last["000000"].shape != points.shape or not np.allclose(
            last["000000"], points, atol=1e-2
        )

    def test_existing_scenes_are_kept(self, joint_checkpoint, scenes, tmp_path):
        out = sample(joint_checkpoint, tmp_path, "--num", 1)
        before = (out / "range_m.npy").read_bytes()
        with pytest.raises(ValueError, match=r"holds scenes already.*--overwrite"):
            sample(joint_checkpoint, out, "--num", 1, "--seed", 1)
        assert (out / "range_m.npy").read_bytes() == before
        sample(joint_checkpoint, out, "--num", 1, "--seed", 1, "--overwrite", "true")
        assert json.loads((out / "metadata.json").read_text())["seed"] == 1
        assert (out / "range_m.npy").read_bytes() != before

    def test_a_checkpoint_without_velocity_is_refused(self, vae_checkpoint, tmp_path):
        with pytest.raises(
            ValueError, match=r"stage vae_alignment.*joint or flow_matching"
        ) as error:
            sample(vae_checkpoint, tmp_path / "out")
        assert str(vae_checkpoint) in str(error.value)
        assert not (tmp_path / "out").exists()

    def test_missing_checkpoint_is_named(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"nothing\.ckpt"):
            sample(tmp_path / "nothing.ckpt", tmp_path / "out")

    def test_no_scenes_are_refused(self, joint_checkpoint, tmp_path):
        with pytest.raises(ValueError, match="num must be at least 1, got 0"):
            sample(joint_checkpoint, tmp_path, "--num", 0)


class TestConvert:
    def test_exported_checkpoint_gives_the_same_scenes(
        self, joint_checkpoint, scenes, tmp_path, capsys
    ):
        exported = tmp_path / "joint.safetensors"
        main(["convert", str(joint_checkpoint), str(exported)])
        out = capsys.readouterr().out
        for name in ("vae", "discriminator", "sit", "latent_norm", "ema", "ema_latent_norm"):
            assert f"\n{name} " in out
        assert_same_scenes(sample(exported, tmp_path / "scenes"), scenes)
        metadata = json.loads((tmp_path / "scenes" / "metadata.json").read_text())
        assert (metadata["stage"], metadata["step"]) == ("joint", 3)

    def test_existing_files_are_kept(self, joint_checkpoint, tmp_path):
        exported = tmp_path / "joint.safetensors"
        exported.write_bytes(b"precious")
        with pytest.raises(ValueError, match=r"joint\.safetensors exists already"):
            main(["convert", str(joint_checkpoint), str(exported)])
        assert exported.read_bytes() == b"precious"
        main(["convert", str(joint_checkpoint), str(exported), "--overwrite", "true"])
        assert read_checkpoint(exported).stage == "joint"

    def test_to_the_official_layout_and_back(self, joint_checkpoint, tmp_path):
        """The options of official scripts do not tell the sizes of a smoke model: given here."""
        official, back = tmp_path / "official.pt", tmp_path / "back.safetensors"
        main(["convert", str(joint_checkpoint), str(official), "--to", "official"])
        sit_args = "{num_heads: 2, alignment_depth: 2, input_size: [4, 16]}"
        words = [official, back, "--sit_args", sit_args, "--encoding", "linear"]
        main(["convert", *map(str, words)])
        before, after = read_checkpoint(joint_checkpoint), read_checkpoint(back)
        assert set(after.networks) == set(before.networks)
        for name, state in before.networks.items():
            for key, value in state.state_dict.items():
                assert torch.equal(after.network(name).state_dict[key], value), (name, key)


class TestReport:
    def test_draws_curves_and_prints_a_table(self, joint_run, capsys):
        main(["report", str(joint_run)])
        out = capsys.readouterr().out
        with Image.open(joint_run / "loss_curves.png") as picture:
            assert min(picture.size) >= 100
        (metrics,) = joint_run.glob("version_*/metrics.csv")
        columns = metrics.read_text().splitlines()[0].split(",")
        for name in (name for name in columns if name.startswith("train/")):
            (row,) = [line for line in out.splitlines() if line.startswith(f"{name} ")]
            first, last, change = map(float, row.split()[1:4])
            assert last - first == pytest.approx(change, abs=1e-3 * max(1, abs(first)))
        assert str(joint_run / "loss_curves.png") in out

    def test_values_are_means_of_the_ends(self, tmp_path, capsys):
        """20 values 20, 19, ..., 1 over two runs: first tenth 19.5, last tenth 1.5."""
        for version, start in ((0, 20), (1, 10)):
            rows = [f"{20 - value},{value}" for value in range(start, start - 10, -1)]
            (tmp_path / f"version_{version}").mkdir()
            text = "\n".join(["step,train/loss", *rows, ""])
            (tmp_path / f"version_{version}" / "metrics.csv").write_text(text)
        main(["report", str(tmp_path)])
        (row,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("train/loss")]
        assert row.split()[1:] == ["19.5", "1.5", "-18", "0.077"]

    def test_missing_run_is_an_error(self, tmp_path):
        with pytest.raises(ValueError, match=r"nowhere holds no version_\*/metrics.csv"):
            main(["report", str(tmp_path / "nowhere")])
