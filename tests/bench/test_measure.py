"""Interleaved timing: order, ratios with intervals, A/A check; FLOP and peak."""

import time
from itertools import cycle

import numpy as np
import pytest
import torch

from r3dpa.bench.measure import Ratio, compare, flop_of, peak_bytes, timed


def case(seconds):
    values = cycle(seconds)
    return lambda: next(values)


class TestCompare:
    def test_runs_there_and_back_and_leaves_the_first_round_out(self):
        calls = []

        def noted(name, seconds):
            run = case(seconds)
            return lambda: calls.append(name) or run()

        # "a" is also the repeated case: two of its times belong to each round.
        cases = {"a": noted("a", [99, 99, 2, 4, 6, 8]), "b": noted("b", [99, 6, 12])}
        found = compare(cases, rounds=2)
        assert calls == ["a", "b", "a", *["a", "b", "a"], *["a", "b", "a"]]
        # Backwards in the first round that counts: the repeat comes first there.
        assert found.seconds == {"a": [4, 6], "b": [6, 12]}
        assert found.repeat.value == pytest.approx(5 / 5)

    def test_a_case_that_differs_from_itself_is_not_sound(self):
        """Its two runs of a round take 1 s and 2 s; every second round goes backwards."""
        slower = case([1.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 2.0, 1.0])
        found = compare({"a": slower}, 4)
        assert not found.sound

    def test_interval_of_a_ratio(self):
        noise = np.random.default_rng(0).uniform(0.9, 1.1, (2, 50))
        ratio = Ratio.of((3 * noise[0]).tolist(), noise[1].tolist())
        assert ratio.value == pytest.approx(np.median(3 * noise[0]) / np.median(noise[1]))
        assert 2.7 < ratio.low < ratio.value < ratio.high < 3.3
        # Rounds are drawn together: what slows both down does not widen the interval.
        shared = Ratio.of((3 * noise[0]).tolist(), noise[0].tolist())
        assert (shared.low, shared.high) == pytest.approx((3, 3))

    def test_processor_time_counts_for_one_thread(self, one_thread):
        sleep = timed(lambda: time.sleep(0.01))
        assert sleep() < 0.01
        torch.set_num_threads(2)
        assert 0.01 < sleep() < 1


class TestWork:
    def test_flop_of_a_product_and_of_attention(self):
        """Attention: two products of (4 x 8) and (8 x 4), 2 heads."""
        a, b, q = torch.ones(3, 5), torch.ones(5, 7), torch.ones(1, 2, 4, 8)
        assert flop_of(lambda: a @ b) == 2 * 3 * 5 * 7
        attention = torch.nn.functional.scaled_dot_product_attention
        assert flop_of(lambda: attention(q, q, q)) == 2 * 2 * (2 * 4 * 8 * 4)

    def test_peak_memory_grows_with_what_is_held(self):
        before = peak_bytes(torch.device("cpu"))
        held = torch.ones(2**26)  # 256 MiB; the peak may have been higher already
        assert peak_bytes(torch.device("cpu")) >= max(before, held.nbytes)
