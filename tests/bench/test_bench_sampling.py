"""What accuracy costs in time: certificate, Pareto front, advice, files, and interrupted runs."""

import json
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from tiny_networks import tiny_checkpoint

from r3dpa.bench import sampling as bench
from r3dpa.bench.problems import GaussianMixture, MixtureProblem, ModelProblem, Setting, toy_mixture
from r3dpa.bench.report import (
    Errors,
    Row,
    duration,
    front_of,
    pareto_front,
    quality_levels,
    resampled_errors,
    sentences,
)
from r3dpa.bench.sampling import (
    Effort,
    Work,
    errors_of,
    reference,
    run_problem,
    sampling,
    settings_of,
)
from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli import main
from r3dpa.generation import SamplerConfig
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))
TINY = Effort(samples=4, reference_steps=16, evaluations=(2, 4), rounds=2, batch=2)
MIXTURE = GaussianMixture(torch.eye(3, dtype=torch.float64), 0.5, torch.ones(3))


def row(label, seconds, error, precision="fp32", batch=4, precision_error=0.0, decoder="full"):
    solver, steps = label.rsplit(" ", 1)
    way = Setting(SamplerConfig(solver, int(steps)), precision, batch, decoder)
    errors = Errors([error**2] * 4, precision_error, None, None)
    return Row(label, way, errors, [seconds], 1.0, 0.0)


@pytest.fixture(scope="module")
def ckpt(tmp_path_factory):
    path = tmp_path_factory.mktemp("ckpt") / "tiny.safetensors"
    guided = {"perturbed_attention": {"block": 1, "scale": 1.5}}  # which is not measured
    return tiny_checkpoint(path, GEOMETRY, stage="few_step", step=7, sampling=guided)


@pytest.fixture(scope="module")
def model(ckpt):
    return ModelProblem(read_checkpoint(ckpt), "cpu", 2)


class TestFront:
    def test_without_noise_it_is_that_of_brute_force(self):
        generator = np.random.default_rng(0)
        for _ in range(20):
            times, errors = generator.integers(1, 9, (2, 12)).astype(float)
            expected = [
                not any(
                    times[j] <= times[i]
                    and errors[j] <= errors[i]
                    and (times[j] < times[i] or errors[j] < errors[i])
                    for j in range(12)
                )
                for i in range(12)
            ]
            spread = np.ones(40)
            front = pareto_front(times[:, None] * spread, errors[:, None] * spread)
            assert front.tolist() == expected

    def test_a_difference_within_the_noise_does_not_dominate(self):
        """Rows of equal time: errors 1 and 1.1 overlap, 1 and 3 do not."""
        noise = np.random.default_rng(0).normal(0, 0.3, (3, 500))
        errors = np.array([[1.0], [1.1], [3.0]]) + noise
        times = np.ones((3, 500))
        assert pareto_front(times, errors).tolist() == [True, True, False]

    def test_times_within_the_tolerance_are_equal(self):
        times = np.array([[1.0], [1.04]]) * np.ones(40)
        errors = np.array([[2.0], [1.0]]) * np.ones(40)
        assert pareto_front(times, errors).tolist() == [True, True]
        assert pareto_front(times[::-1], errors, 0.05).tolist() == [False, True]

    def test_scenes_are_resampled_together(self):
        """A row of twice the error has twice the error in every resample."""
        squared = np.random.default_rng(0).uniform(0, 1, 50)
        spread = resampled_errors(np.stack([squared, 4 * squared]))
        np.testing.assert_allclose(spread[1], 2 * spread[0])
        assert spread[0].std() > 0

    def test_sentences_follow_the_front(self):
        rows = [row("ab2 16", 1.6, 0.072), row("euler 9", 2.0, 0.5), row("ab2 8", 0.8, 0.163)]
        front = front_of(rows, 0.0)
        assert [each.label for each in front] == ["ab2 8", "ab2 16"]
        assert sentences(front) == [
            "From 800 ms (ab2 8) to 1.6 s (ab2 16): the error of the latents falls from 0.163 to "
            "0.072, 2.26 times less, for 800 ms more a scene."
        ]
        assert duration(3.2e-5) == "32 µs"


class TestQuality:
    ROWS = (
        *(row("euler 4", 1.0, 0.5), row("ab2 4", 1.1, 0.19), row("ab2 8", 2.0, 0.06)),
        *(row("ab2 16", 4.0, 0.019), row("ab2 32", 8.0, 0.004), row("euler 32", 7.9, 0.01)),
        row("ab2 8", 0.1, 0.001, batch=1),
        row("ab2 8", 0.2, 0.011, precision="bf16", precision_error=0.01),
    )

    def test_levels_follow_from_the_error_of_bf16(self):
        """Limits 0.01, 0.04 and 0.1: other kinds of rows, faster as they may be, do not count."""
        levels = quality_levels(self.ROWS)
        assert levels["good"] == {
            "solver": "ab2",
            "steps": 16,
            "shift": 1.0,
            "error": pytest.approx(0.019),
            "seconds_share": 0.5,
        }
        assert {name: level["steps"] for name, level in levels.items()} == {
            "draft": 8,
            "good": 16,
            "best": 32,
        }

    def test_instant_is_the_best_row_of_few_steps_in_a_fifth_of_the_time_of_good(self):
        few = [
            row("average_velocity 2", 0.6, 0.07, decoder="thin"),
            row("average_velocity 4", 0.8, 0.05, decoder="thin"),
            row("average_velocity 8", 1.2, 0.04, decoder="thin"),
            row("average_velocity 8", 0.7, 0.01),
        ]
        levels = quality_levels([*self.ROWS, *few])
        assert levels["instant"]["steps"] == 4
        assert levels["good"] == quality_levels(self.ROWS)["good"]
        assert quality_levels([*self.ROWS, few[3]])["instant"]["error"] == pytest.approx(0.01)
        slow = [row("average_velocity 8", 1.2, 0.04, decoder="thin")]
        assert quality_levels([*self.ROWS, *slow])["instant"]["steps"] == 8

    def test_a_best_row_above_bf16_sets_the_limits(self):
        levels = quality_levels(self.ROWS[:3])
        errors = {level: choice["error"] for level, choice in levels.items()}
        # 0.5 is within 10 times 0.06, but a tenth more time buys 0.19.
        assert errors == pytest.approx({"best": 0.06, "good": 0.19, "draft": 0.19})


class TestErrors:
    @pytest.mark.parametrize(("steps", "exact"), [(8, False), (400, True)])
    def test_a_coarse_reference_judges_nothing(self, steps, exact):
        """Heun-8 and Heun-4 are as far apart as the errors that they should judge."""
        ways = [Setting(SamplerConfig("ab2", count), batch=2) for count in (8, 32)]
        effort = replace(TINY, samples=32, reference_steps=steps)
        found = run_problem(MixtureProblem(toy_mixture(), 32, 2), ways, effort)
        assert [row.converged for row in found.rows] == [exact, exact]

    def test_one_gaussian_has_a_solution_in_closed_form(self):
        """Noise x goes to ``mean + std x``: velocity of a single Gaussian is a linear map."""
        problem = MixtureProblem(
            GaussianMixture(torch.full((1, 2), 3.0).double(), 0.5, torch.ones(1)), 16
        )
        noise = torch.randn(16, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        found = problem.converged(1000, range(16)).latents
        torch.testing.assert_close(found, 3 + 0.5 * noise, atol=1e-5, rtol=0)

    def test_evaluations_known_beforehand_are_those_that_are_counted(self, model):
        """A counter stands before the velocity."""
        for way in settings_of(TINY):
            counted = Mock(wraps=MIXTURE.velocity)
            MixtureProblem(Mock(means=MIXTURE.means, velocity=counted), 2).solve(way, range(2))
            assert counted.call_count == way.nfe
        assert model._generator(way).generate([0]).nfe == way.nfe

    def test_error_of_the_precision_alone(self, model):
        exact, _ = reference(model, 16, 3, Work())
        whole = Setting(SamplerConfig("ab2", 8))
        ways = [whole, replace(whole, precision="bf16")]
        plain, rounded = errors_of(model, ways, exact, Work())
        assert plain.precision == 0
        assert 0 < rounded.precision < 0.1
        assert rounded.squared != plain.squared
        assert plain.range_rmse_m >= 0
        assert 0 < plain.mask_iou <= 1

    def test_the_reference_of_a_model_starts_from_the_noise_of_its_scenes(self, model):
        """With Heun's 64 steps in float32 and in float64 only rounding is between them."""
        ours = model.solve(Setting(SamplerConfig("heun", 64)), range(3))
        exact = model.converged(64, range(3))
        torch.testing.assert_close(ours.latents.double(), exact.latents, atol=1e-4, rtol=0)
        both = (ours.range_m > 0) & (exact.range_m > 0)
        assert (ours.range_m - exact.range_m)[both].abs().max() < 0.01


@pytest.fixture(scope="module")
def folder(ckpt, tmp_path_factory):
    """Everything that a small run of the command writes, and what it prints."""
    out = tmp_path_factory.mktemp("sampling")
    words = ["--ckpt", str(ckpt), "--out", str(out), "--quick", "--device", "cpu", "--scenes", "4"]
    words += ["--rounds", "2", "--nfe", "[4,2]", "--reference_steps", "16", "--batch_size", "2"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "_SOLVERS", (("euler", 1.0), ("ab2", 1.0), ("ab2", 2.0)))
        patch.setattr(bench, "_TOY_QUICK", replace(TINY, reference_steps=64))
        patch.setattr("sys.argv", ["/home/me/bin/r3dpa", "bench", "--ckpt", "/home/me/last.ckpt"])
        with redirect_stdout(StringIO()) as printed:
            main(["bench", "sampling", *words])
    return out, printed.getvalue()


class TestFiles:
    def test_json(self, folder):
        out, _ = folder
        content = json.loads((out / "sampling.json").read_text())
        assert content["command"] == "r3dpa bench --ckpt last.ckpt"
        assert "/home/me" not in (out / "sampling.json").read_text()
        assert content["model"] == {"file": "tiny.safetensors", "stage": "few_step", "step": 7}
        assert content["problems"].keys() == {"mixture", "model"}
        for problem in content["problems"].values():
            labels = [line["label"] for line in problem["rows"]]
            assert len(set(labels)) == len(labels)
            assert set(problem["front"]) <= set(labels)
            assert len(problem["sentences"]) == max(0, len(problem["front"]) - 1)
            for line in problem["rows"]:
                assert line["flop_s"] == pytest.approx(line["flop"] / line["seconds"])
                work = line["nfe"] * problem["flop"]["evaluation"] + problem["flop"]["rest"]
                if line["decoder"] == "full":
                    assert line["flop"] == pytest.approx(work)
                else:
                    assert line["flop"] < work
        assert any("bf16" in line["label"] for line in content["problems"]["model"]["rows"])
        labels = [line["label"] for line in content["problems"]["model"]["rows"]]
        assert any("batch 1" in label for label in labels)
        few = [label for label in labels if label.startswith("average_velocity")]
        names = ("average_velocity", "average_velocity thin")
        assert few == [f"{name} {steps}" for name in names for steps in (1, 2, 4, 8)]

    def test_pictures_and_levels(self, folder):
        out, text = folder
        names = {path.name for path in out.iterdir()}
        assert names == {*("sampling.json", "summary.md", "quality.json", "pareto.png")}
        levels = json.loads((out / "quality.json").read_text())["levels"]
        assert list(levels) == ["instant", "draft", "good", "best"]
        assert levels["instant"]["solver"] == "average_velocity"
        summary = (out / "summary.md").read_text()
        assert "(pareto.png)" in summary
        assert "- quality good: " in summary
        assert "quality good: " in text


EFFORT = {"samples": 4, "evaluations": (2, 4), "rounds": 3, "batch": 2, "reference_steps": 16}


class TestInterruptedRun:
    def test_it_goes_on_where_it_was(self, ckpt, tmp_path, monkeypatch):
        """Stopped in the second round of the timing; what was solved is not solved again."""
        monkeypatch.setattr(bench, "_SOLVERS", (("ab2", 1.0),))
        monkeypatch.setattr(bench, "_TOY_QUICK", TINY)
        piece, solve, solved = Work.piece, ModelProblem.solve, []

        def stopping(self, name, make):
            if self.folder is not None and name == "round_2":
                raise KeyboardInterrupt
            return piece(self, name, make)

        with monkeypatch.context() as patch:
            patch.setattr(Work, "piece", stopping)
            with pytest.raises(KeyboardInterrupt):
                sampling(tmp_path, ckpt, quick=True, effort=EFFORT)
        kept = {path.stem for path in (tmp_path / "work").iterdir()}
        assert {"reference_16_0", "reference_8_2", "errors_0", "round_1"} <= kept
        with pytest.raises(ValueError, match="other options"):
            sampling(tmp_path, ckpt, quick=True, effort=EFFORT | {"samples": 6})
        first = torch.load(tmp_path / "work" / "round_1.pt", weights_only=True)
        monkeypatch.setattr(
            ModelProblem, "solve", lambda self, *given: solved.append(given) or solve(self, *given)
        )
        sampling(tmp_path, ckpt, quick=True, effort=EFFORT)
        assert not solved
        assert not (tmp_path / "work").exists()
        found = json.loads((tmp_path / "sampling.json").read_text())["problems"]["model"]
        rounds = [line["rounds"] for line in found["rows"]]
        assert all(len(each) == 3 for each in rounds)
        assert rounds[0][0] == first[0]
