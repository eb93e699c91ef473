"""What accuracy costs in time: certificate, rule of dropping, front, sentences, and the files."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
import torch
from tiny_networks import tiny_networks

from r3dpa.bench import sampling as bench
from r3dpa.bench.distributions import sliced_wasserstein, verdict
from r3dpa.bench.error_budget import budget, certified_reference
from r3dpa.bench.front import (
    Row,
    duration,
    pareto_front,
    quality_levels,
    resampled_errors,
    save_quality_levels,
    sentences,
    steps_along,
)
from r3dpa.bench.hardware import flop_of, peak_of
from r3dpa.bench.mixture import GaussianMixture, toy_mixture
from r3dpa.bench.problems import MixtureProblem, ModelProblem, Setting
from r3dpa.bench.sampling import Effort, run_problem, sampling, settings_of
from r3dpa.bench.timing import Spent, measure
from r3dpa.flow.solvers import evaluations
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.metrics.bootstrap import Interval

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
TINY = Effort(samples=4, reference_steps=64, evaluations=(2, 4), rounds=2, batch=2, resamples=40)
MIXTURE = GaussianMixture(torch.eye(3, dtype=torch.float64), 0.5, torch.ones(3))


def row(label, seconds, error, **changes):
    solver, steps = label.rsplit(" ", 1)
    values = {
        **{"label": label, "name": solver, "solver": solver, "steps": int(steps), "shift": 1.0},
        **{"nfe": int(steps), "precision": "fp32", "compiled": False, "batch": 4, "error": error},
        **{"error_interval": (error, error), "discretisation": error, "precision_error": None},
        **{"range_rmse_m": None, "mask_iou": None, "converged": True, "seconds": seconds},
        **{"seconds_interval": (seconds, seconds), "end_to_end": seconds, "quiet": True},
        **{"flop": 1.0, "flop_s": 1.0, "peak_share": 0.5},
    }
    return Row(**values | changes)


@pytest.fixture(scope="module")
def make():
    """Generators of a SiT and a VAE with random weights."""
    vae, sit, norm = tiny_networks()
    geometry = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))

    def make(setting):
        return SceneGenerator(vae, sit, norm, geometry, precision=setting.precision)

    return make


class TestTiming:
    def case(self, seconds, core=None):
        values = cycle(seconds)
        return lambda: Spent((s := next(values)), s, core)

    def test_measurements_after_an_unusual_control_are_dropped(self):
        """Three measurements a round (a, b, a again), the warm-up first.

        The control is 10 % slow before "b" in its second of three rounds, and 4 % in the third.
        """
        usual, slow, near = 1.0, 1.1, 1.04
        controls = self.case(
            [usual] * 3 + [usual] * 3 + [usual, slow, usual] + [usual, near, usual]
        )
        found = measure({"a": self.case([1.0]), "b": self.case([7.0, 2.0, 9.0, 4.0])}, 3, controls)
        assert found.series["a"].kept == (True, True, True)
        assert found.series["b"].kept == (True, False, True)
        assert found.series["b"].of_kept(found.series["b"].device) == [2.0, 4.0]
        assert found.dropped == pytest.approx(1 / 9)
        assert found.sound
        assert found.repeat.value == 1

    def test_steal_drops_measurements_of_one_thread(self):
        stolen = self.case([1.0], core=0.8)
        found = measure({"a": stolen}, 2, self.case([1.0]), threads=1)
        assert found.dropped == 1
        assert not found.series["a"].enough
        assert found.series["a"].kept == (True, True)  # what is left would tell nothing
        assert found.series["a"].device == (0.8, 0.8)  # the processor's own time
        several = measure({"a": stolen}, 2, self.case([1.0]), threads=2)
        assert several.dropped == 0
        assert several.series["a"].device == (1.0, 1.0)

    def test_a_case_that_differs_from_itself_is_not_sound(self):
        """Its two runs of a round take 1 s and 2 s; every second round goes backwards."""
        slower = self.case([1.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 2.0, 1.0])
        found = measure({"a": slower}, 4, self.case([1.0]))
        assert not found.sound
        assert found.tolerance >= 0.5


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
        assert pareto_front(times, errors, tolerance=0.05).tolist() == [False, True]

    def test_steps_buy_something_each(self):
        times = np.array([[3.0], [1.0], [2.0]]) * np.ones(40)
        errors = np.array([[1.0], [5.0], [5.0]]) * np.ones(40)
        assert steps_along(times, errors, np.array([True, True, True])) == [1, 0]

    def test_errors_are_resampled_by_scene_for_all_rows_alike(self):
        squared = np.random.default_rng(0).uniform(1, 2, (1, 30))
        spread = resampled_errors(np.concatenate([squared, 4 * squared]))
        np.testing.assert_allclose(spread[1], 2 * spread[0])
        assert spread[0].std() > 0


class TestSentences:
    def test_numbers_are_those_of_the_rows(self):
        rows = [row("ab2 8", 0.8, 0.163), row("ab2 16", 1.6, 0.072), row("ab2 32", 3.0, 0.07)]
        told = sentences(rows, [r.error for r in rows], "the error", floor=0.01)
        assert told == [
            "From 800 ms (ab2 8) to 1.6 s (ab2 16): the error falls from 0.163 to 0.072, "
            "2.26 times less, for 800 ms more a scene.",
            "From 1.6 s (ab2 16) to 3 s (ab2 32): the error ties (0.072 and 0.07), "
            "for 1.4 s more a scene.",
        ]

    @pytest.mark.parametrize(
        ("seconds", "text"), [(1.5, "1.5 s"), (0.0521, "52.1 ms"), (3.2e-5, "32 µs")]
    )
    def test_durations(self, seconds, text):
        assert duration(seconds) == text


class TestQuality:
    ROWS = (
        *(row("euler 4", 1.0, 0.5), row("ab2 4", 1.1, 0.19), row("ab2 8", 2.0, 0.06)),
        *(row("ab2 16", 4.0, 0.019), row("ab2 32", 8.0, 0.004), row("euler 32", 7.9, 0.01)),
        row("euler_maruyama 25", 0.5, None, discretisation=None),
        row("ab2 8", 0.1, 0.001, batch=1),
        row("ab2 8", 0.2, 0.011, precision="bf16", precision_error=0.01),
        row("euler 8", 0.1, 0.001, name="euler autoguided"),
    )

    def test_levels_follow_from_the_error_of_bf16(self):
        """Limits 0.01, 0.04 and 0.1: other kinds of rows, faster as they may be, do not count."""
        levels = quality_levels(self.ROWS)
        assert levels == {
            "draft": {
                "solver": "ab2",
                "steps": 8,
                "shift": 1.0,
                "error": 0.06,
                "seconds_share": 0.25,
            },
            "good": {
                "solver": "ab2",
                "steps": 16,
                "shift": 1.0,
                "error": 0.019,
                "seconds_share": 0.5,
            },
            "best": {
                "solver": "ab2",
                "steps": 32,
                "shift": 1.0,
                "error": 0.004,
                "seconds_share": 1.0,
            },
        }

    def test_a_best_row_above_bf16_sets_the_limits(self):
        few = [r for r in self.ROWS if r.label in ("euler 4", "ab2 4", "ab2 8")][:3]
        levels = quality_levels(few)
        errors = {level: choice["error"] for level, choice in levels.items()}
        # 0.5 is within 10 times 0.06, but a tenth more time buys 0.19.
        assert errors == {"best": 0.06, "good": 0.19, "draft": 0.19}

    def test_file(self, tmp_path):
        save_quality_levels(quality_levels(self.ROWS), "a machine", tmp_path / "quality.json")
        stored = json.loads((tmp_path / "quality.json").read_text())
        assert stored["measured_on"] == "a machine"
        level = stored["levels"]["good"]
        SamplerConfig(level["solver"], level["steps"], shift=level["shift"])

    def test_nothing_to_choose_from(self):
        with pytest.raises(ValueError, match="no deterministic row"):
            quality_levels([row("euler_maruyama 25", 0.5, None)])


class TestErrorBudget:
    def test_a_coarse_reference_is_not_certified(self):
        """Heun-8 and Heun-4 are as far apart as the errors that they should judge."""
        problem = MixtureProblem(toy_mixture())
        ways = [Setting(SamplerConfig("ab2", steps)) for steps in (8, 32)]
        for steps, good in ((8, False), (1000, True)):
            reference = certified_reference(problem, steps, 32)
            errors = budget(problem, ways, reference, lambda *_: None)
            assert all(reference.certifies(e.rmse) for e in errors) == good

    def test_a_row_below_ten_times_the_references_own_error_is_told(self):
        way = Setting(SamplerConfig("heun", 32), batch=2)
        effort = replace(TINY, reference_steps=32)
        found = run_problem(MixtureProblem(MIXTURE, 2), [way], effort)
        assert found.rows[0].error == 0
        assert found.unsure == ("heun 63",)
        assert found.rows[0].converged is False

    def test_one_gaussian_has_a_solution_in_closed_form(self):
        """Noise x goes to ``mean + std x``: velocity of a single Gaussian is a linear map."""
        mixture = GaussianMixture(torch.full((1, 2), 3.0).double(), 0.5, torch.ones(1))
        problem = MixtureProblem(mixture)
        noise = problem._draw(16, torch.Generator().manual_seed(0))
        found = problem.converged(1000, 16).latents
        torch.testing.assert_close(found, 3 + 0.5 * noise, atol=1e-5, rtol=0)

    def test_counted_evaluations_are_those_known_beforehand(self, make):
        ways = settings_of(TINY, "cpu", False, ())
        for problem in (MixtureProblem(MIXTURE, 2), ModelProblem(make, 2)):
            found = run_problem(problem, ways, TINY)
            for way, line in zip(ways, found.rows, strict=True):
                if way.deterministic:
                    assert line.nfe == evaluations(way.sampler.solver, way.sampler.steps)
                assert line.label.startswith(f"{way.name} {line.nfe}")
                work = line.nfe * found.flop[0] + found.flop[1]
                assert line.flop == pytest.approx(work)

    def test_precision_is_told_apart_from_discretisation(self, make):
        problem = ModelProblem(make, 2)
        reference = certified_reference(problem, 64, 3)
        whole = Setting(SamplerConfig("ab2", 8))
        half = replace(whole, precision="bf16")
        exact, rounded = budget(problem, [whole, half], reference, lambda *_: None)
        assert exact.precision == 0
        assert 0 < rounded.precision < 0.1
        assert rounded.discretisation == exact.discretisation == exact.rmse
        assert rounded.rmse != exact.rmse
        assert exact.range_rmse_m >= 0
        assert 0 < exact.mask_iou <= 1

    def test_the_reference_of_a_model_starts_from_the_noise_of_its_scenes(self, make):
        """With Heun's 64 steps in float32 and in float64 only rounding is between them."""
        problem = ModelProblem(make, 2)
        ours = problem.solve(Setting(SamplerConfig("heun", 64)), 3)
        reference = problem.converged(64, 3)
        assert ours.nfe == reference.nfe == 127
        torch.testing.assert_close(ours.latents.double(), reference.latents, atol=1e-4, rtol=0)
        both = (ours.range_m > 0) & (reference.range_m > 0)
        assert (ours.range_m - reference.range_m)[both].abs().max() < 0.01

    def test_generators_of_one_network_keep_their_own_times(self, make):
        problem = ModelProblem(make, 2)
        few, many = (problem._generator(Setting(SamplerConfig("euler", n))) for n in (2, 5))
        first = few.generate([0]).latents
        assert many.generate([0]).nfe == 5
        assert torch.equal(few.generate([0]).latents, first)


class TestHardware:
    def test_flop_of_a_product(self):
        a, b = torch.ones(3, 5), torch.ones(5, 7)
        assert flop_of(lambda: a @ b) == 2 * 3 * 5 * 7

    def test_attention_is_counted(self):
        """Two products of (4 x 8) and (8 x 4), 2 heads."""
        q = torch.ones(1, 2, 4, 8)
        attention = torch.nn.functional.scaled_dot_product_attention
        assert flop_of(lambda: attention(q, q, q)) == 2 * 2 * (2 * 4 * 8 * 4)

    def test_a_processor_is_measured(self, one_thread):
        peak = peak_of(torch.device("cpu"), "fp32")
        assert peak.source == "measured"
        assert 1e8 < peak.flop_s < 1e13

    @pytest.mark.parametrize(("share", "text"), [(1.2, "wrong"), (0.001, "bound"), (0.5, "")])
    def test_impossible_and_tiny_shares_are_flagged(self, share, text):
        assert text in bench._suspicion(share)
        assert bool(bench._suspicion(share)) == bool(text)


class TestDistances:
    def test_sliced_distance_of_a_shift(self):
        """Moved by d along every direction: the mean square of cosines over directions is 1/D."""
        a = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)).double()
        moved = a + torch.tensor([3.0, 0, 0])
        found = sliced_wasserstein(a, moved, torch.Generator().manual_seed(1))
        assert found == pytest.approx(3 / 3**0.5, rel=0.2)
        assert sliced_wasserstein(a, a.flip(0), torch.Generator().manual_seed(1)) == 0

    @pytest.mark.parametrize(
        ("ends", "floor", "text"),
        [
            ((1, 0.5, 2), 0, "worse"),
            ((-1, -2, -0.5), 0, "better"),
            ((1, -0.5, 2), 0, "tie"),
            ((1, 0.5, 2), 1.5, "tie"),
        ],
    )
    def test_verdicts(self, ends, floor, text):
        assert verdict(Interval(*ends), floor) == text


@pytest.fixture(scope="module")
def folder(make, tmp_path_factory):
    """Everything that a small run writes, and what it prints."""
    out = tmp_path_factory.mktemp("sampling")
    patch = pytest.MonkeyPatch()
    patch.setattr(bench, "_effort", lambda *given, **options: TINY)
    patch.setattr("sys.argv", ["/home/me/bin/r3dpa", "bench", "--ckpt", "/home/me/last.ckpt"])
    text = sampling(out, make, quick=True, about={"stage": "joint"})
    patch.undo()
    return out, text


class TestFiles:
    def test_json(self, folder):
        out, _ = folder
        content = json.loads((out / "sampling.json").read_text())
        assert content["command"] == "r3dpa bench --ckpt last.ckpt"
        assert "/home/me" not in (out / "sampling.json").read_text()
        assert content["model"] == {"stage": "joint"}
        assert content["problems"].keys() == {"mixture", "model"}
        for problem in content["problems"].values():
            labels = [line["label"] for line in problem["rows"]]
            assert len(set(labels)) == len(labels)
            assert set(problem["front"]) <= set(labels)
            assert len(problem["sentences"]) == max(0, len(problem["front"]) - 1)
            assert problem["reference"]["steps"] == 64
            assert problem["reference"]["nfe"] == 127
            assert problem["timing"]["seconds"].keys() == set(labels)
            for line in problem["rows"]:
                assert line["seconds"] > 0
                assert line["end_to_end"] > 0
                assert line["flop_s"] == pytest.approx(line["flop"] / line["seconds"])
        model = content["problems"]["model"]
        assert set(model["budget"]) == {"floor", "model", "discretisation", "precision"}
        assert any("bf16" in label for label in model["budget"]["precision"])

    def test_sentences_tell_the_rows(self, folder):
        out, text = folder
        content = json.loads((out / "sampling.json").read_text())
        for problem in content["problems"].values():
            rows = {line["label"]: line for line in problem["rows"]}
            steps = zip(problem["front"], problem["front"][1:], strict=False)
            for sentence, (cheap, dear) in zip(problem["sentences"], steps, strict=True):
                assert sentence in text
                found = re.search(r"falls from (\S+) to (\S+), (\S+) times less", sentence)
                before, after = rows[cheap]["error"], rows[dear]["error"]
                expected = [before, after, before / after]
                assert [float(n) for n in found.groups()] == pytest.approx(expected, rel=0.006)
                assert f"({cheap})" in sentence
                assert f"({dear})" in sentence

    def test_csv_holds_all_rows(self, folder):
        out, _ = folder
        content = json.loads((out / "sampling.json").read_text())
        with (out / "sampling.csv").open(newline="") as file:
            lines = list(csv.DictReader(file))
        expected = [
            (name, line["label"])
            for name, problem in content["problems"].items()
            for line in problem["rows"]
        ]
        assert [(line["problem"], line["label"]) for line in lines] == expected

    def test_pictures_page_and_levels(self, folder):
        out, _ = folder
        names = {path.name for path in out.iterdir()}
        assert names == {
            *("sampling.json", "sampling.csv", "summary.md", "quality.json"),
            *("pareto.png", "pareto.html", "discretisation.png"),
        }
        levels = json.loads((out / "quality.json").read_text())["levels"]
        assert list(levels) == ["draft", "good", "best"]
        summary = (out / "summary.md").read_text()
        assert "(pareto.png)" in summary
        assert "- quality good: " in summary

    def test_data_without_a_model_are_refused(self, tmp_path):
        with pytest.raises(ValueError, match="without a checkpoint"):
            sampling(tmp_path / "out", data=tmp_path, quick=True)

    def test_counts_below_one_are_refused(self, tmp_path):
        with pytest.raises(ValueError, match=r"at least 2, rounds.*got 1"):
            sampling(tmp_path, scenes=1)
