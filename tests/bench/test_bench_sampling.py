"""What accuracy costs in time: certificate, Pareto front, files, and interrupted runs."""

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
from r3dpa.bench.report import pareto_front
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

TINY = Effort(samples=4, reference_steps=16, evaluations=(2, 4), rounds=2, batch=2)
MIXTURE = GaussianMixture(torch.eye(3, dtype=torch.float64), 0.5, torch.ones(3))


@pytest.fixture(scope="module")
def ckpt(tmp_path_factory):
    path = tmp_path_factory.mktemp("ckpt") / "tiny.safetensors"
    guided = {"perturbed_attention": {"block": 1, "scale": 1.5}}  # which is not measured
    return tiny_checkpoint(path, stage="few_step", step=7, sampling=guided)


@pytest.fixture(scope="module")
def model(ckpt):
    return ModelProblem(read_checkpoint(ckpt), "cpu", 2)


def test_the_front_holds_what_no_other_row_beats_in_both():
    generator = np.random.default_rng(0)
    for _ in range(20):
        times, errors = generator.permuted(np.arange(24.0).reshape(2, 12), axis=1)
        rows = [
            {"label": str(i), "seconds": s, "error": e}
            for i, (s, e) in enumerate(zip(times, errors, strict=True))
        ]
        beaten = [((times < times[i]) & (errors < errors[i])).any() for i in range(12)]
        expected = {str(i) for i in range(12) if not beaten[i]}
        front = pareto_front(rows)
        assert set(front) == expected
        assert front == sorted(front, key=lambda label: times[int(label)])


class TestErrors:
    @pytest.mark.parametrize(("steps", "exact"), [(8, False), (400, True)])
    def test_a_coarse_reference_judges_nothing(self, steps, exact):
        """Heun-8 and Heun-4 are as far apart as the errors that they should judge."""
        ways = [Setting(SamplerConfig("ab2", count), batch=2) for count in (8, 32)]
        effort = replace(TINY, samples=32, reference_steps=steps)
        found = run_problem(MixtureProblem(toy_mixture(), 32, 2), ways, effort)
        assert [row["converged"] for row in found["rows"]] == [exact, exact]

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
        assert plain["precision"] == 0
        assert 0 < rounded["precision"] < 0.1
        assert rounded["squared"] != plain["squared"]
        assert plain["range_rmse_m"] >= 0
        assert 0 < plain["mask_iou"] <= 1

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
    words += ["--rounds", "1", "--nfe", "[2]", "--reference_steps", "16", "--batch_size", "2"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "_SOLVERS", (("euler", 1.0), ("ab2", 2.0)))
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

    def test_table_and_picture(self, folder):
        out, text = folder
        assert {path.name for path in out.iterdir()} == {
            "sampling.json",
            "summary.md",
            "pareto.png",
        }
        summary = (out / "summary.md").read_text()
        assert "(pareto.png)" in summary
        problem = json.loads((out / "sampling.json").read_text())["problems"]["model"]
        for label in problem["front"]:
            assert f"{label} *" in text
            assert f"{label} *" in summary


EFFORT = {"samples": 4, "evaluations": (2,), "rounds": 2, "batch": 2, "reference_steps": 16}


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
        assert all(len(each) == 2 for each in rounds)
        assert rounds[0][0] == first[0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"reference_steps": 1}, "reference_steps must be at least 2, got 1"),
        ({"evaluations": (1,)}, "midpoint cannot make a step with 1 network evaluation"),
    ],
)
def test_refused_numbers_leave_no_unfinished_work(given, message, ckpt, tmp_path):
    """It would block the corrected command."""
    with pytest.raises(ValueError, match=message):
        sampling(tmp_path, ckpt, quick=True, effort=EFFORT | given)
    assert not (tmp_path / "work").exists()


def test_options_of_a_model_are_refused_without_one(tmp_path):
    """Without it they would be ignored: the mixture has its own numbers."""
    words = ["bench", "sampling", "--out", str(tmp_path / "out"), "--scenes", "4", "--nfe", "[4]"]
    with pytest.raises(ValueError, match="--num, --nfe: for a model, give --ckpt"):
        main(words)
    assert not (tmp_path / "out").exists()
