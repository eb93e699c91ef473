"""``r3dpa sample``, ``convert`` and ``report``: what they print, write, and refuse."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from PIL import Image
from tiny_labelled import labelled_checkpoint
from tiny_networks import tiny_checkpoint

from lidarsim import Semantic
from lidarsim.scan_files import read_npz, read_points, read_scan
from r3dpa import pretrained
from r3dpa.checkpoints import convert
from r3dpa.cli import main
from r3dpa.cli.parser import parse
from r3dpa.cli.runs import report
from r3dpa.flow.solvers import ODE_SOLVERS
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import (
    LidarSensor,
    SphericalProjection,
    in_range,
    points_of,
)
from r3dpa.io import source_commit
from r3dpa.pretrained import Weights
from r3dpa.scene_files.sample import sample as sample_command
from r3dpa.viz.scenes import COLOURS

SENSOR = LidarSensor(beams=16, columns=64)  # of conf/smoke.yaml


def sample(checkpoint, out, *more, pictures=0, steps=("--steps", 3)):
    words = ["--ckpt", checkpoint, "--out", out, "--num", 3, *steps, "--pictures", pictures, *more]
    main(["sample", *map(str, words)])
    return json.loads((out / "metadata.json").read_text())


@pytest.fixture(scope="module")
def scenes(tiny_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("scenes") / "new" / "folder"
    sample(tiny_file, out, pictures=2)
    return out


def values(folder):
    return {p.stem: read_scan(p)[:, :3] for p in sorted((folder / "bin").iterdir())}


def assert_same_scenes(actual, expected, num=3):
    """Up to the rounding of another batch size: 1e-5 in the latents, 1e-3 m in the points."""
    actual, expected = values(actual), values(expected)
    assert len(actual) == num
    for name, points in actual.items():
        np.testing.assert_allclose(points, expected[name], atol=1e-3, rtol=0)


class TestSample:
    def test_a_greater_number_adds_to_a_finished_folder(self, tiny_file, scenes, tmp_path):
        sample(tiny_file, tmp_path, "--num", 2)
        first = (tmp_path / "bin/000001.bin").stat().st_mtime_ns
        metadata = sample(tiny_file, tmp_path)
        assert (metadata["num"], metadata["drawn_by_last_run"]) == (3, 1)
        assert (tmp_path / "bin/000001.bin").stat().st_mtime_ns == first
        assert_same_scenes(tmp_path, scenes)
        assert np.load(tmp_path / "range_m.npy").shape[0] == 3

    def test_writes_every_scene(self, scenes):
        clouds = values(scenes)
        assert list(clouds) == ["000000", "000001", "000002"]
        projection = SphericalProjection(SENSOR)
        for points, range_m in zip(clouds.values(), np.load(scenes / "range_m.npy"), strict=True):
            assert 0 < len(points) <= SENSOR.beams * SENSOR.columns
            assert in_range(torch.from_numpy(points), SENSOR).all()
            np.testing.assert_array_equal(points, points_of(torch.from_numpy(range_m), projection))
        assert not np.array_equal(clouds["000000"], clouds["000001"])
        assert {p.name for p in scenes.iterdir()} == {
            *("bin", "range_m.npy", "range", "birds_eye", "scene_3d", "scenes.png"),
            *("scenes.html", "metadata.json"),
        }
        drawn = [scenes / "scenes.png"]
        for folder in ("range", "birds_eye", "scene_3d"):
            drawn += sorted((scenes / folder).iterdir())
        assert len(drawn) == 1 + 3 * 2  # of three scenes two, as asked for
        for path in drawn:
            with Image.open(path) as picture:
                assert len(picture.convert("RGB").getcolors(1 << 20)) > 10

    def test_other_forms_on_demand_and_scenes_are_kept(self, tiny_file, scenes, tmp_path):
        sample(tiny_file, tmp_path, "--formats", "ply,npz")
        names = {"ply", "scenes.npz", "range_m.npy", "metadata.json"}
        assert {p.name for p in tmp_path.iterdir()} == names
        clouds = read_npz(tmp_path / "scenes.npz")
        for name, points in values(scenes).items():
            np.testing.assert_array_equal(clouds[name], points)
            np.testing.assert_array_equal(read_points(tmp_path / "ply" / f"{name}.ply"), points)
        before = (tmp_path / "range_m.npy").read_bytes()
        with pytest.raises(ValueError, match=r"holds scenes already.*--overwrite"):
            sample(tiny_file, tmp_path, "--seed", 1)
        assert (tmp_path / "range_m.npy").read_bytes() == before
        assert sample(tiny_file, tmp_path, "--seed", 1, "--overwrite")["seed"] == 1
        assert (tmp_path / "range_m.npy").read_bytes() != before

    def test_labels_and_intensity_are_written(self, tmp_path):
        ckpt = labelled_checkpoint(tmp_path)
        sample(
            ckpt, tmp_path / "out", "--solver", "euler", "--shift", 1, "--device", "cpu", pictures=1
        )
        sampler = SamplerConfig("euler", steps=3)
        scenes = SceneGenerator.from_checkpoint(ckpt, sampler, device="cpu").generate(3)
        for index in range(3):
            points = read_scan(tmp_path / "out" / "bin" / f"{index:06d}.bin")
            labels = np.fromfile(tmp_path / "out" / "labels" / f"{index:06d}.label", "<u4")
            assert np.array_equal(labels, scenes.point_labels(index).numpy())
            np.testing.assert_allclose(points[:, 3], scenes.point_intensity(index), atol=1e-5)
        assert (tmp_path / "out" / "scenes.html").exists()
        with Image.open(tmp_path / "out" / "classes.png") as picture:
            names = {Semantic(int(each)).name for each in scenes[0].point_labels.unique()}
            wanted = {tuple(round(255 * part) for part in to_rgb(COLOURS[name])) for name in names}
            found = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
            assert wanted <= found

    def test_metadata_is_enough_to_repeat_the_run(self, scenes, tiny_file):
        metadata = json.loads((scenes / "metadata.json").read_text())
        expected = {
            "checkpoint": str(tiny_file),
            "stage": "joint",
            "step": 3,
            "weights": "ema",
            "interpolant": "linear",
            "precision": "fp32",
            "r3dpa": "0.1.0",
            "commit": source_commit(),
            "torch": torch.__version__,
        }
        assert {key: metadata[key] for key in expected} == expected
        numbers = ("num", "seed", "nfe", "batch_size", "drawn_by_last_run")
        assert [metadata[key] for key in numbers] == [3, 0, 3, 8, 3]
        assert metadata["sampler"] == asdict(SamplerConfig.of_quality("good").changed(steps=3))
        assert metadata["geometry"]["projection"]["sensor"]["beams"] == SENSOR.beams
        assert metadata["seconds_per_scene"] > 0
        assert metadata["threads"] == torch.get_num_threads()

    def test_options_reach_the_sampler(self, tiny_file, tmp_path, capsys):
        words = ["--solver", "heun", "--seed", 5, "--num", 1, "--shift", 2]
        words += ["--precision", "bf16"]
        metadata = sample(tiny_file, tmp_path, *words)
        assert (metadata["sampler"]["solver"], metadata["sampler"]["shift"]) == ("heun", 2)
        assert [metadata[key] for key in ("nfe", "seed", "num")] == [5, 5, 1]
        assert metadata["precision"] == "bf16"
        assert ": 5 network evaluations each, " in capsys.readouterr().out

    def test_every_solver_can_be_chosen(self):
        for solver in (*ODE_SOLVERS, "euler_maruyama"):
            parse(sample_command, ["--ckpt", "a", "--out", "b", "--solver", solver], "sample")

    def test_instant_takes_few_steps_and_the_thin_decoder(self, tiny_file, tmp_path, capsys):
        few = tiny_checkpoint(tmp_path / "few.safetensors", stage="few_step")
        words = ["--num", 1, "--quality", "instant"]
        found = sample(few, tmp_path / "thin", *words, steps=())
        assert found["sampler"]["solver"] == "average_velocity"
        assert (found["nfe"], found["decoder"]) == (found["sampler"]["steps"], "thin")
        assert "quality instant: average_velocity, " in capsys.readouterr().out
        full = sample(few, tmp_path / "full", *words, "--decoder", "full", steps=())
        assert full["decoder"] == "full"
        ranges = [np.load(tmp_path / name / "range_m.npy") for name in ("thin", "full")]
        assert not np.array_equal(*ranges)
        only = ["vae", "ema", "ema_latent_norm"]
        convert(few, tmp_path / "without.safetensors", networks=only)
        without = sample(tmp_path / "without.safetensors", tmp_path / "no", *words, steps=())
        assert without["decoder"] == "full"
        assert np.array_equal(np.load(tmp_path / "no" / "range_m.npy"), ranges[1])
        with pytest.raises(ValueError, match="is of stage 'joint' and has no thin_decoder"):
            sample(tiny_file, tmp_path / "joint", *words, "--decoder", "thin", steps=())
        with pytest.raises(ValueError, match="a checkpoint of stage few_step"):
            sample(tiny_file, tmp_path / "joint", *words, steps=())

    @pytest.mark.parametrize(
        ("words", "expected", "line"),
        [
            (["--steps", 4], SamplerConfig("ab3", 4, shift=2.5), "ab3, 4 steps, shift 2.5"),
            (["--shift", 1.5], SamplerConfig("ab3", 16, shift=1.5), "ab3, 16 steps, shift 1.5"),
            (["--solver", "ab2"], SamplerConfig("ab2", 16, shift=2.5), "ab2, 16 steps, shift 2.5"),
            (["--solver", "euler_maruyama"], SamplerConfig(steps=16), "euler_maruyama, 16 steps"),
            (
                ["--quality", "draft", "--steps", 3],
                SamplerConfig("ab3", 3, shift=2.5),
                "ab3, 3 steps, shift 2.5",
            ),
            (["--quality", "draft"], SamplerConfig.of_quality("draft"), None),
        ],
    )
    def test_single_settings_keep_the_rest_of_the_quality_and_what_runs_is_printed(
        self, words, expected, line, tiny_file, tmp_path, capsys
    ):
        """The measured levels are those of quality.json."""
        found = sample(tiny_file, tmp_path / "out", "--num", 1, *words, steps=())
        assert found["sampler"] == asdict(expected)
        said = "quality draft: " if line is None else f"sampler: {line}\n"
        assert said in capsys.readouterr().out

    def test_guidance_by_the_model_itself_changes_nothing(
        self, tiny_file, scenes, tmp_path, monkeypatch
    ):
        """v + s (v - v) = v, for twice the evaluations; paths are kept as they are given."""
        monkeypatch.chdir(tiny_file.parent)
        words = ("--autoguidance", tiny_file.name, "--guidance_scale", 3)
        metadata = sample(tiny_file.name, tmp_path, *words)
        assert_same_scenes(tmp_path, scenes)
        assert metadata["nfe"] == 6
        assert metadata["autoguidance"]["scale"] == 3
        assert metadata["autoguidance"]["interval"] == [0, 1]
        assert metadata["checkpoint"] == metadata["autoguidance"]["checkpoint"] == tiny_file.name
        for folder in (tiny_file.parent, tmp_path, Path.home()):
            assert str(folder) not in (tmp_path / "metadata.json").read_text()

    def test_the_name_of_weights_can_be_the_guide(self, tiny_file, tmp_path, monkeypatch):
        known = {"mine": Weights("mine", tiny_file, tiny_file.with_suffix(".md"))}
        monkeypatch.setattr(pretrained, "shipped", lambda: known)
        metadata = sample(tiny_file, tmp_path, "--autoguidance", "mine", "--num", 1)
        assert metadata["autoguidance"]["checkpoint"] == "mine"
        written = metadata["checkpoint_written"]
        assert metadata["autoguidance"]["checkpoint_written"] == written

    def test_the_guidance_of_the_weights_is_recorded_and_can_be_turned_off(self, tmp_path):
        recorded = {"perturbed_attention": {"block": 1, "scale": 1.5}}
        path = tiny_checkpoint(tmp_path / "guided.safetensors", sampling=recorded)
        guided = sample(path, tmp_path / "guided")
        assert (guided["guidance_scale"], guided["nfe"]) == (1.5, 6)
        plain = sample(path, tmp_path / "plain", "--guidance_scale", 1)
        assert (plain["guidance_scale"], plain["nfe"]) == (1, 3)

    def test_options_that_say_nothing_are_refused_and_nothing_is_touched(self, tiny_file, tmp_path):
        """Not even with --overwrite in a folder that holds scenes."""
        (tmp_path / "metadata.json").write_text("{}")
        (tmp_path / "range_m.npy").write_bytes(b"scenes")
        with pytest.raises(ValueError, match=r"--guidance_interval needs --autoguidance"):
            sample(tiny_file, tmp_path, "--guidance_interval", 0, 0.5, "--overwrite", "true")
        with pytest.raises(ValueError, match=r"guidance_scale 2 needs a checkpoint that records"):
            sample(tiny_file, tmp_path, "--guidance_scale", 2, "--overwrite", "true")
        assert (tmp_path / "range_m.npy").read_bytes() == b"scenes"
        assert len(list(tmp_path.iterdir())) == 2


def test_scenes_in_the_geometry_of_another_sensor(tiny_file, tmp_path, capsys):
    beams = {"inclination_deg": [1.0, -3.0, -7.0, -11.0, -15.0, -19.0]}
    path = tmp_path / "six.yaml"
    path.write_text(json.dumps({"sensor": {"shots": 48, "max_range_m": 40.0}, "lasers": beams}))
    metadata = sample(tiny_file, tmp_path / "six", "--sensor", path)
    seen = metadata["geometry"]["projection"]["sensor"]
    assert (seen["beams"], seen["columns"], seen["range_max_m"]) == (6, 48, 40.0)
    assert np.load(tmp_path / "six" / "range_m.npy").shape == (3, 6, 48)
    assert f"as seen by {path}: 6 x 48, up to 40 m" in capsys.readouterr().out
    for points in values(tmp_path / "six").values():
        degrees = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
        off = np.abs(degrees[:, None] - np.array(beams["inclination_deg"])).min(axis=1)
        assert len(points)
        assert off.max() < 1e-3
    with pytest.raises(ValueError, match="hdl32e looks from"):
        sample(tiny_file, tmp_path / "refused", "--sensor", "hdl32e")
    assert not (tmp_path / "refused").exists()


def test_an_exported_training_gives_the_same_scenes(joint_checkpoint, tmp_path, capsys):
    exported = tmp_path / "joint.safetensors"
    exported.touch()
    main(["convert", str(joint_checkpoint), str(exported), "--overwrite"])
    out = capsys.readouterr().out
    for name in ("vae", "discriminator", "sit", "latent_norm", "ema", "ema_latent_norm"):
        assert f"\n{name} " in out
    sample(joint_checkpoint, tmp_path / "trained", "--num", 1)
    metadata = sample(exported, tmp_path / "exported", "--num", 1)
    assert (metadata["stage"], metadata["step"]) == ("joint", 3)
    assert_same_scenes(tmp_path / "exported", tmp_path / "trained", num=1)
    sample(exported, tmp_path / "last", "--num", 1, "--weights", "last")
    average, last = (np.load(tmp_path / n / "range_m.npy") for n in ("exported", "last"))
    assert not np.allclose(average, last, atol=1e-2)


def test_report_of_a_run_that_has_logged_nothing(tmp_path):
    (tmp_path / "config.yaml").write_text("")
    with pytest.raises(ValueError, match=r"no logged values yet: .*log_every_n_steps"):
        report(tmp_path)


def test_report_draws_curves_and_lists_the_means_of_their_ends(tmp_path, capsys):
    """20 values 20, 19, ..., 1 over two runs: first tenth 19.5, last tenth 1.5."""
    for version, start in ((0, 20), (1, 10)):
        rows = [f"{20 - value},{value}" for value in range(start, start - 10, -1)]
        (tmp_path / f"version_{version}").mkdir()
        text = "\n".join(["step,train/loss", *rows, ""])
        (tmp_path / f"version_{version}" / "metrics.csv").write_text(text)
    (tmp_path / "version_2").mkdir()  # of `r3dpa validate`, which is no part of the training
    (tmp_path / "version_2" / "metrics.csv").write_text("step,val/loss\n0,99\n")
    main(["report", str(tmp_path)])
    with Image.open(tmp_path / "loss_curves.png") as picture:
        assert min(picture.size) >= 100
    printed = capsys.readouterr().out
    assert "val/loss" not in printed
    (row,) = [x for x in printed.splitlines() if x.startswith("train/loss")]
    assert row.split()[1:] == ["19.5", "1.5", "-18"]


def test_one_scene_is_counted_in_the_singular(tmp_path, capsys):
    checkpoint = tiny_checkpoint(tmp_path / "tiny.safetensors")
    sample(checkpoint, tmp_path / "made", "--num", 1)
    assert f"1 scene in {tmp_path / 'made'}: 3 network" in capsys.readouterr().out
