"""Interleaved timing: order, ratios with intervals, and the check of the first case on itself."""

from __future__ import annotations

import time

import numpy as np
import pytest

from r3dpa.bench.timing import Ratio, Times, compare, seconds


class TestCompare:
    def test_runs_there_and_back_and_leaves_the_first_round_out(self):
        calls = []

        def case(name, milliseconds):
            values = iter(milliseconds)

            def run():
                calls.append(name)
                return next(values) / 1000

            return run

        # "a" is also the repeated case: two of its times belong to each round.
        cases = {"a": case("a", [99, 99, 2, 4, 6, 8]), "b": case("b", [99, 6, 12])}
        found = compare(cases, rounds=2)
        assert calls == ["a", "b", "a", *["a", "b", "a"], *["a", "b", "a"]]
        # Backwards in the second round: the repeat comes first there.
        assert found.ms["a"] == Times(2, 5.0, 4.0, 6.0)
        assert found.ms["b"] == Times(2, 9.0, 6.0, 12.0)
        assert found.over_first.keys() == {"b"}
        assert found.over_first["b"].value == pytest.approx(9 / 5)
        assert found.repeat.value == pytest.approx(5 / 5)

    def test_interval_of_a_ratio(self):
        rng = np.random.default_rng(0)
        noise = rng.uniform(0.9, 1.1, (2, 50))
        ratio = Ratio.of((3 * noise[0]).tolist(), noise[1].tolist())
        assert ratio.value == pytest.approx(np.median(3 * noise[0]) / np.median(noise[1]))
        assert 2.7 < ratio.low < ratio.value < ratio.high < 3.3
        # Rounds are drawn together: what slows both down does not widen the interval.
        shared = Ratio.of((3 * noise[0]).tolist(), noise[0].tolist())
        assert (shared.low, shared.high) == pytest.approx((3, 3))

    def test_a_difference_between_equal_cases_is_told(self):
        rising = iter(range(1, 100))
        found = compare({"only": lambda: float(next(rising))}, rounds=3)
        assert found.sound
        alternating = iter([1.0, 1.0, 2.0, 1.0, 1.0, 2.0, 2.0, 1.0])
        found = compare({"only": lambda: next(alternating)}, rounds=3)
        assert not found.sound
        assert found.repeat.value == 2

    def test_seconds_takes_the_time_of_the_function(self):
        assert 0.01 < seconds(lambda: time.sleep(0.01))() < 1
