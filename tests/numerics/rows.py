"""The hard numerical cases: one row each, with where its test is or why it has none.

A test of this folder names its row with ``@pytest.mark.numerics(section=1, case="...")``; a marked
test of another folder is named here, with what its naive computation does. A row that has neither
a test nor a reason fails in ``test_numerics_rows.py``.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]

SECTIONS = {
    1: "Interpolant and sampler",
    2: "Feature guidance",
    3: "Range image",
    4: "VAE and GAN",
    5: "Latent statistics and EMA",
    6: "Alignment loss",
    7: "Optimisation, distribution, resume",
    8: "Metrics",
}


@dataclass(frozen=True)
class Elsewhere:
    """A test outside this folder.

    Args:
        test: ``folder/test_file.py::test_name`` below ``tests``.
        naive: How its naive computation fails.
        precisions: Precisions it passes in, separated by commas.
    """

    test: str
    naive: str
    precisions: str = "float32"


@dataclass(frozen=True)
class Row:
    """A hard case.

    Args:
        section: A key of :data:`SECTIONS`.
        case: Its name, unique in the section.
        elsewhere: Its tests outside this folder.
        left_out: Why it has no test; empty if it has one.
    """

    section: int
    case: str
    elsewhere: tuple[Elsewhere, ...] = ()
    left_out: str = ""


def _row(section: int, case: str, *elsewhere: Elsewhere, left_out: str = "") -> Row:
    return Row(section, case, elsewhere, left_out)


ROWS = (
    # 1. Interpolant and sampler
    _row(
        1,
        "score near the data",
        Elsewhere(
            "flow/test_interpolant.py::test_sde_drift_equals_the_divided_form_and_is_finite_at_both_ends",
            "v - t score is NaN or infinite at t = 0",
            "float64, float32, bfloat16",
        ),
    ),
    _row(
        1,
        "diffusion that is infinite at the noise",
        left_out="no sampler offers w = 2 t / (1 - t): w is eta 2 t everywhere, and finite",
    ),
    _row(
        1,
        "last step of the SDE",
        Elsewhere(
            "flow/test_sde.py::test_last_step_keeps_fine_detail",
            "a full drift step leaves 0.077 of a deviation of 0.1",
        ),
    ),
    _row(
        1,
        "cosine path at the data",
        Elsewhere(
            "flow/test_interpolant.py::test_sde_drift_equals_the_divided_form_and_is_finite_at_both_ends",
            "the score has cot(0): NaN or infinite at t = 0",
            "float64, float32, bfloat16",
        ),
    ),
    _row(
        1,
        "time in half precision",
        Elsewhere(
            "nn/test_sit.py::test_1000_times_have_1000_embeddings_in_half_precision",
            "fewer than 600 of 1000 times distinct; d embedding / dt off by more than 50 %",
            "bfloat16",
        ),
    ),
    _row(
        1,
        "state in half precision",
        Elsewhere(
            "flow/test_solvers.py::test_float32_state_is_close_to_float64",
            "a bfloat16 state is off by more than 1e-4 RMSE after 256 Euler steps",
        ),
    ),
    _row(1, "multistep solver on unequal steps"),
    _row(1, "inversion to noise and back"),
    _row(
        1,
        "noise and the size of the batch",
        Elsewhere(
            "flow/test_sde.py::test_noise_per_sample_makes_a_sample_independent_of_its_batch",
            "one generator for the batch gives sample 0 other noise at batch 8 than at batch 1",
        ),
    ),
    # 2. Feature guidance
    _row(
        2,
        "energy averaged over the batch",
        Elsewhere(
            "flow/test_guidance.py::test_strength_does_not_depend_on_the_batch",
            "the term of sample 0 is less than half as long at batch 8",
        ),
    ),
    _row(
        2,
        "no token selected",
        Elsewhere(
            "flow/test_guidance.py::test_an_empty_mask_means_no_guidance", "the mean of none is NaN"
        ),
    ),
    _row(2, "gradient far longer than the velocity"),
    _row(
        2,
        "gradient that is not finite",
        Elsewhere(
            "flow/test_guidance.py::test_a_gradient_that_is_not_finite_is_dropped_and_counted",
            "one infinite number makes the gradient of the sample NaN",
        ),
        Elsewhere(
            "flow/test_guidance.py::test_energy_of_half_precision_features_is_computed_in_float32",
            "the squared length of float16 features is infinite",
            "float16",
        ),
        Elsewhere(
            "flow/test_guidance.py::test_tokens_of_length_zero_have_a_finite_gradient",
            "normalize has a gradient above 1e9 at zero",
        ),
    ),
    _row(2, "guidance of the last step"),
    _row(2, "memory of the evaluations"),
    # 3. Range image
    _row(
        3,
        "points without a direction",
        Elsewhere(
            "geometry/test_projection.py::test_points_without_a_direction_are_dropped_and_counted",
            "arcsin(z / r) is NaN for the origin, a denormal, infinite and NaN points",
        ),
    ),
    _row(
        3,
        "arcsine near the pole",
        Elsewhere(
            "geometry/test_projection.py::test_inclination_near_the_zenith",
            "float32 arcsin is off by more than 1e-4 rad",
            "float64",
        ),
    ),
    _row(
        3,
        "quadrant of the azimuth",
        Elsewhere(
            "geometry/test_projection.py::test_eight_compass_directions",
            "arctan(y / x) is wrong for 4 of 8 directions and NaN for 0 / 0",
            "float64",
        ),
    ),
    _row(
        3,
        "seam of the azimuth",
        Elsewhere(
            "geometry/test_projection.py::test_signed_zero_behind_the_sensor",
            "y = +0 falls into column 0, y = -0 into column 1023",
        ),
    ),
    _row(
        3,
        "corner or centre of the pixel",
        Elsewhere(
            "geometry/test_projection.py::test_mean_angle_of_a_round_trip",
            "corners turn points by 0.219 degrees up and 0.176 sideways",
            "float64",
        ),
    ),
    _row(3, "rows of equal pitch and real beams"),
    _row(
        3,
        "logarithm at zero and below",
        Elsewhere(
            "geometry/test_range_codec.py::test_log_inverse_is_exact",
            "ranges come back 1e-4 m too long",
            "float64",
        ),
        Elsewhere(
            "geometry/test_range_codec.py::test_log_of_a_missing_return",
            "log2 of an unclamped -2 m is NaN",
        ),
    ),
    _row(
        3,
        "a missing return is not a range of zero",
        Elsewhere(
            "geometry/test_range_codec.py::test_empty_image_decodes_to_no_point",
            "noise about -1 becomes a ring of points at the sensor",
        ),
    ),
    _row(3, "scans of 0, 1 and 2 points"),
    _row(3, "damaged scan file"),
    _row(3, "interpolation at the seam"),
    _row(3, "empty cells of the feature grid"),
    # 4. VAE and GAN
    _row(
        4,
        "log variance beyond its clamp",
        Elsewhere(
            "nn/test_vae.py::test_log_variance_beyond_the_clamp_comes_back",
            "gradient 0 beyond a plain clamp: 25 and -35 stay",
        ),
        Elsewhere(
            "nn/test_vae.py::test_kl_of_half_precision_moments_is_finite",
            "float16 exp(18) is infinite",
            "float16",
        ),
    ),
    _row(4, "loss of weight zero"),
    _row(
        4,
        "adaptive weight of the adversarial loss",
        left_out="the weight is a constant, as in the official code: nothing is divided by a norm",
    ),
    _row(4, "discriminator loss that is scaled down"),
    _row(4, "batch norm on real and fake batches"),
    _row(
        4,
        "attention scores before scaling",
        Elsewhere(
            "nn/test_layers.py::test_attention_with_large_queries_survives_half_precision",
            "unscaled float16 products are infinite",
            "float16",
        ),
    ),
    _row(
        4,
        "group norm of a constant image",
        Elsewhere(
            "nn/test_layers.py::test_group_norm_of_an_empty_scan_is_finite",
            "0 / 0 without eps",
            "float32, bfloat16",
        ),
        Elsewhere(
            "nn/test_layers.py::test_group_norm_of_half_precision_images_has_float32_statistics",
            "float16 mean square of deviation 300 is infinite",
            "float16",
        ),
    ),
    _row(4, "decoding in half precision"),
    # 5. Latent statistics and EMA
    _row(
        5,
        "infinite latent",
        Elsewhere(
            "nn/test_latent_norm.py::test_a_broken_latent_leaves_the_statistics_alone",
            "nan_to_num: running_var infinite for good",
        ),
    ),
    _row(
        5,
        "tiny variance",
        Elsewhere(
            "nn/test_latent_norm.py::test_denormalise_inverts_normalise_for_any_variance",
            "an inverse without eps is 29 % off at variance 1e-4",
        ),
        Elsewhere(
            "nn/test_latent_norm.py::test_statistics_survive_a_large_mean",
            "mean square minus squared mean is more than 10 % off at mean 3000",
        ),
    ),
    _row(5, "batch of one"),
    _row(
        5,
        "EMA of the latent statistics",
        Elsewhere(
            "nn/test_ema.py::test_copied_statistics_keep_up_with_a_drifting_vae",
            "averaged statistics lag by 3.9 % behind a drift of 10 %",
        ),
    ),
    _row(5, "integer buffers"),
    _row(
        5,
        "EMA in bfloat16",
        Elsewhere(
            "nn/test_ema.py::test_a_thousand_updates_move_by_the_exact_amount",
            "a bfloat16 average stays at 1.0 after 1000 updates towards 2",
        ),
        Elsewhere(
            "nn/test_ema.py::test_the_average_of_a_bf16_network_is_float32",
            "that of the test before",
            "bfloat16",
        ),
    ),
    _row(5, "statistics before any update"),
    _row(
        5,
        "statistics updated twice in a step",
        Elsewhere(
            "nn/test_latent_norm.py::test_a_later_update_does_not_change_the_backward_of_an_earlier_pass",
            "the backward of an evaluated batch norm reads later statistics: over 10 % off",
        ),
    ),
    # 6. Alignment loss
    _row(6, "vectors of length zero"),
    _row(6, "cosine in half precision"),
    _row(6, "scale of the features"),
    _row(6, "collapse of the gradients"),
    # 7. Optimisation, distribution, resume
    _row(
        7,
        "clipping of gradients that are not finite",
        Elsewhere(
            "modules/test_gradients.py::TestNonFiniteGradients::test_a_clipped_non_finite_gradient_would_break_the_weights",
            "[1, inf, 2] is clipped to [0, NaN, 0]",
        ),
        Elsewhere(
            "modules/test_gradients.py::TestNonFiniteGradients::test_a_bad_step_changes_neither_weights_nor_moments_nor_averages",
            "that of the test before, in a whole training step",
        ),
    ),
    _row(7, "clipping of scaled gradients"),
    _row(7, "three networks in one graph"),
    _row(7, "parameters a pass does not use"),
    _row(7, "uneven last batch"),
    _row(
        7,
        "synchronised batch norm in one process",
        Elsewhere(
            "nn/test_layers.py::test_synced_batch_norm_in_two_processes_equals_one_with_both_batches",
            "one-pass float32 variance is more than 1 % off at mean 3000",
        ),
    ),
    _row(7, "resume in the middle"),
    _row(7, "seeds of loader processes"),
    _row(7, "recompilation at the last batch"),
    # 8. Metrics
    _row(
        8,
        "root of a singular covariance product",
        Elsewhere(
            "metrics/test_functional.py::test_empty_directions_add_no_error",
            "roots of eigenvalues lose half of the digits: more than 1e-6 off",
            "float64",
        ),
    ),
    _row(8, "Frechet distance of few samples"),
    _row(
        8,
        "accumulation of moments",
        Elsewhere(
            "metrics/test_functional.py::test_a_shift_leaves_the_covariance",
            "float32 sums of squares are off by more than 0.5 at mean 1e4",
        ),
    ),
    _row(8, "Jensen-Shannon distance and empty counts"),
    _row(8, "floor of the Jensen-Shannon distance"),
    _row(8, "empty cloud in a matching"),
    _row(8, "padding in the Chamfer distance"),
    _row(8, "sliced Wasserstein of unequal sizes"),
    _row(8, "constant and NaN features"),
)


def marked_tests(path: Path) -> dict[str, tuple[int, str] | None]:
    """Tests of a file with the marker: name -> ``(section, case)``, or None without arguments.

    Args:
        path: A Python file. A marked class gives its own name.
    """
    found: dict[str, tuple[int, str] | None] = {}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        for mark in getattr(node, "decorator_list", ()):
            call = mark if isinstance(mark, ast.Call) else None
            if ast.unparse(call.func if call else mark) != "pytest.mark.numerics":
                continue
            values = {k.arg: ast.literal_eval(k.value) for k in (call.keywords if call else ())}
            found[node.name] = (values["section"], values["case"]) if values else None
    return found
