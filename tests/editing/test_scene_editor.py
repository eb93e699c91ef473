"""Edits with tiny random networks: what must stay stays, seeds are independent of their batch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_networks import VAE_ARGS, tiny_checkpoint, tiny_networks

from lidarsim import RecordedScan, Simulator
from r3dpa.data import write_bin
from r3dpa.editing import EditSettings, SceneEditor
from r3dpa.editing.objects import ObjectLibrary
from r3dpa.editing.regions import (
    angle_box,
    box3d,
    box3d_front_m,
    dropped_beams,
    mask_of_tokens,
    sector_weights,
    token_mask,
)
from r3dpa.flow.guidance import FeatureGuidance
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import (
    NUM_CLASSES,
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
    points_of,
    range_image,
)
from r3dpa.nn import VAE
from r3dpa.pretrained import objects_file
from r3dpa.scene_vae import SceneVAE
from r3dpa.scenes import Scene

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=1.0, range_max_m=50.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))
MASK = angle_box(GEOMETRY.projection, -60, 20, -20, 0)
SETTINGS = EditSettings(steps=6)


@pytest.fixture(scope="module")
def generator():
    networks = tiny_networks(spread=0.05)
    return SceneGenerator(*networks, GEOMETRY, SamplerConfig("heun", steps=3))


@pytest.fixture(scope="module")
def editor(generator):
    return SceneEditor(generator, SETTINGS)


@pytest.fixture(scope="module")
def scan():
    random = torch.Generator().manual_seed(1)
    range_m = 5 + 20 * torch.rand(16, 64, generator=random)
    return torch.where(torch.rand(16, 64, generator=random) < 0.2, -1.0, range_m)


FEATURE = torch.eye(8)[0]


class TestInpaint:
    def test_outside_the_mask_the_scan_stays_bit_by_bit(self, editor, scan):
        """And the tokens outside keep their latents."""
        result = editor.inpaint(scan, MASK, range(2), feature=FEATURE)
        assert result.range_m.shape == (2, 16, 64)
        for made in result.range_m:
            assert made[~MASK].equal(scan[~MASK])
            assert not made[MASK].equal(scan[MASK])
        latents = editor.encode(scan[None])[0]
        kept = ~token_mask(MASK, (2, 8)).view(2, 8)
        kept = kept.repeat_interleave(2, 0).repeat_interleave(2, 1)
        assert result.latents[0][:, kept].equal(latents[:, kept])
        assert not result.latents[0][:, ~kept].equal(latents[:, ~kept])

    def test_guidance_raises_the_cosine_and_none_is_none(self, generator, scan):
        cosines = {}
        for strength in (0.0, 0.8):
            own = SceneEditor(generator, EditSettings(steps=6, strength=strength))
            cosines[strength] = own.inpaint(scan, MASK, range(2), feature=FEATURE)
        assert (cosines[0.8].cosine > cosines[0.0].cosine).all()
        plain = SceneEditor(generator, SETTINGS).inpaint(scan, MASK, range(2))
        assert plain.latents.equal(cosines[0.0].latents)
        assert plain.cosine is None

    def test_a_later_start_lies_on_the_path_of_the_network(self, scan):
        """At t = 0.5 of the cosine path, where a network of velocity 0 leaves it."""
        still = SceneGenerator(*tiny_networks(spread=0.0), GEOMETRY, path="cosine")
        editor = SceneEditor(still, EditSettings("euler", 4))
        result = editor.inpaint(scan, MASK, [3], seed=1, start=0.5)
        latents, noise = editor.encode(scan[None]), still.noise([3], 1)
        edited = token_mask(MASK, (2, 8)).view(2, 8)
        edited = edited.repeat_interleave(2, 0).repeat_interleave(2, 1)
        expected = torch.where(edited, (latents + noise) * 2**-0.5, latents)
        torch.testing.assert_close(result.latents, expected)

    def test_the_weights_get_no_gradients(self, generator, scan):
        generator.sit.requires_grad_(True)
        SceneEditor(generator, EditSettings(steps=2)).inpaint(scan, MASK, [0], feature=FEATURE)
        weights = [*generator.sit.parameters(), *generator.vae.parameters()]
        assert all(weight.grad is None and not weight.requires_grad for weight in weights)

    def test_evaluations_are_those_of_inversion_and_way_back(self, generator, scan):
        calls = []
        real = generator.sit.velocity
        generator.sit.velocity = lambda x, time: calls.append(len(x)) or real(x, time)
        try:
            result = SceneEditor(generator, EditSettings("euler", 5)).inpaint(scan, MASK, [0])
        finally:
            del generator.sit.velocity
        assert result.nfe == 10
        assert len(calls) == 10 + 5  # and the way back without an edit, which is measured

    def test_a_box_changes_nothing_unless_something_is_drawn_in_front_of_it(self, editor, scan):
        """Returns lie beyond 1 m, so that a near side at 1 m moves nothing."""
        ways = {}
        for metres in (None, 1.0, 20.0):
            front_m = None if metres is None else torch.where(MASK, metres, 0.0)
            ways[metres] = editor.inpaint(scan, MASK, range(2), feature=FEATURE, front_m=front_m)
        assert ways[1.0].latents.equal(ways[None].latents)
        assert not ways[20.0].latents.equal(ways[None].latents)
        assert ways[20.0].range_m[:, ~MASK].equal(scan[~MASK].expand(2, -1))
        kept = ~mask_of_tokens(token_mask(MASK, (2, 8)), (2, 8), (4, 16))
        assert ways[20.0].latents[..., kept].equal(ways[None].latents[..., kept])
        with pytest.raises(ValueError, match=r"near side: must have the shape \(16, 64\)"):
            editor.inpaint(scan, MASK, [0], front_m=torch.ones(8, 64))

    def test_steps_start_from_the_scan_outside_the_mask_after_a_correction(self, generator, scan):
        """Five Euler steps there, and five back, of which four are corrected at one evaluation."""
        kept = ~mask_of_tokens(token_mask(MASK, (2, 8)), (2, 8), (4, 16))
        outside, real = [], generator.sit.velocity
        generator.sit.velocity = lambda x, time: outside.append(x[..., kept]) or real(x, time)
        try:
            editor = SceneEditor(generator, EditSettings("euler", 5))
            editor.inpaint(scan, MASK, [0], front_m=torch.where(MASK, 20.0, 0.0))
        finally:
            del generator.sit.velocity
        there, back = outside[1:5], outside[6:14]
        for inverted, after_correction in zip(reversed(there), back[1::2], strict=True):
            assert after_correction.equal(inverted)

    def test_corrected_steps_count_as_evaluations(self, generator, scan):
        """Steps to .8, .6, .4 and .2 of five; the last one ends at 0."""
        editor = SceneEditor(generator, EditSettings("euler", 5))
        front_m = torch.where(MASK, 20.0, 0.0)
        assert editor.inpaint(scan, MASK, [0], front_m=front_m).nfe == 2 * 5 + 4

    def test_masks_that_leave_nothing_are_refused(self, editor, scan):
        for mask in (torch.zeros(16, 64, dtype=torch.bool), torch.ones(16, 64, dtype=torch.bool)):
            with pytest.raises(ValueError, match=r"selects (nothing|all)"):
                editor.inpaint(scan, mask, [0])


@pytest.mark.slow
def test_the_cars_of_r3dpa_s_stand_in_their_box():
    """Two draws to the left of a simulated scan; by features alone, most of a car stands nearer."""
    editor = SceneEditor.from_checkpoint("r3dpa-s", EditSettings(steps=8), device="cpu")
    projection = editor.generator.geometry.projection
    scan = editor.pixels(Simulator().scan(0).points)
    place = ((0.0, 9.0, -0.95), (4.2, 1.8, 1.5))
    mask, front_m = box3d(projection, *place), box3d_front_m(projection, *place)
    car = ObjectLibrary.load(objects_file("r3dpa-s")).feature("car")

    def share_in_front(front_m):
        range_m = editor.inpaint(scan, mask, 2, feature=car, front_m=front_m).range_m[:, mask]
        return ((range_m > 0) & (range_m < near_side_m - 0.5)).float().mean()

    near_side_m = front_m[mask]
    assert share_in_front(front_m) < 0.6 * share_in_front(None)


def test_a_scene_does_not_depend_on_its_batch(generator, scan):
    """Up to rounding of another batch size: 1e-4 in latents of size 1."""
    missing = dropped_beams(GEOMETRY.projection, range(0, 16, 2))
    few = EditSettings(steps=2)
    together = SceneEditor(generator, few, batch_size=2)
    alone = SceneEditor(generator, few, batch_size=1)
    for edit, rounding in (
        (lambda by, indices: by.inpaint(scan, MASK, indices, 5, feature=FEATURE), 1e-4),
        (lambda by, indices: by.complete(scan, missing, indices, 5), 0),
        (lambda by, indices: by.vary(scan, indices, 5), 1e-4),
    ):
        several, single = edit(together, [0, 2]), edit(alone, [2])
        torch.testing.assert_close(several.latents[1:], single.latents, atol=rounding, rtol=0)
        assert not several.latents[0].allclose(several.latents[1], atol=1e-2)


def test_scenes_made_anew_lose_single_returns_by_number_and_seed(scan):
    """88 % of the returns are kept by a decoder that gives each the logit 2 / 1.3."""
    codec = RangeCodec("log2", return_channel=True)
    _, sit, norm = tiny_networks(spread=0.05)
    vae = VAE(**VAE_ARGS | {"in_channels": 2})
    with torch.no_grad():
        vae.decoder.conv_out.weight.zero_()
        vae.decoder.conv_out.bias[:] = torch.tensor([0.0, 2.0 / 1.3])
    geometry = ScanGeometry(GEOMETRY.projection, codec, GEOMETRY.grid_size)
    generator, few = SceneGenerator(vae, sit, norm, geometry), EditSettings(steps=2)
    together = SceneEditor(generator, few, batch_size=2)
    alone = SceneEditor(generator, few, batch_size=1)
    grids, weights = [torch.ones(16, 8)] * 2, sector_weights([(0, 0), (180, 1)], (2, 8))
    for edit in (
        lambda by, indices, seed: by.inpaint(scan, MASK, indices, seed),
        lambda by, indices, seed: by.vary(scan, indices, seed),
        lambda by, indices, seed: by.mix(grids, weights, indices, seed),
    ):
        holes = edit(together, [0, 2, 3], 5).range_m[:, MASK] < 0
        assert holes.float().mean().item() == pytest.approx(0.12, abs=0.05)
        assert not holes[0].equal(holes[1])
        assert (edit(alone, [2, 3], 5).range_m[:, MASK] < 0).equal(holes[1:])
        assert not (edit(alone, [2], 6).range_m[0, MASK] < 0).equal(holes[1])


class TestMix:
    def test_each_half_nears_its_own_source(self, generator):
        """Unit vectors 0 and 1 as the features of everything left and everything right."""
        sources = [torch.eye(8)[k].expand(16, 8).clone() for k in range(2)]
        weights = sector_weights([(0, 0), (180, 1)], (2, 8))
        own = SceneEditor(generator, EditSettings(steps=6, strength=0.8))
        result = own.mix(sources, weights, range(2))
        plain = SceneEditor(generator, EditSettings(steps=6, strength=0.0))
        assert (result.cosine > plain.mix(sources, weights, range(2)).cosine).all()
        with torch.no_grad():
            features = generator.sit.project_features(result.latents, torch.zeros(2))
        cosine = features / features.norm(dim=-1, keepdim=True)
        toward = cosine[..., 0] - cosine[..., 1]
        left = weights[0].bool()
        assert toward[:, left].mean() > toward[:, ~left].mean()

    def test_guidance_that_was_left_out_is_said(self, generator, monkeypatch):
        monkeypatch.setattr(FeatureGuidance, "num_dropped", 3)
        sources = [torch.ones(16, 8), torch.eye(8)[0].expand(16, 8)]
        weights = sector_weights([(0, 0), (180, 1)], (2, 8))
        with pytest.warns(UserWarning, match="3 gradients of the guidance were not finite"):
            SceneEditor(generator, EditSettings("heun", 3)).mix(sources, weights, [3])

    def test_strength_0_is_the_plain_sampler(self, generator):
        own = SceneEditor(generator, EditSettings("heun", 3, strength=0.0))
        sources = [torch.ones(16, 8), torch.eye(8)[0].expand(16, 8)]
        result = own.mix(sources, sector_weights([(0, 0), (180, 1)], (2, 8)), [3], seed=2)
        expected = generator.generate([3], seed=2)
        torch.testing.assert_close(result.latents, expected.latents, atol=1e-5, rtol=0)


class TestComplete:
    def test_known_pixels_stay_and_what_the_scan_holds_elsewhere_is_not_used(self, generator, scan):
        editor = SceneEditor(generator, EditSettings(steps=2))
        missing = dropped_beams(GEOMETRY.projection, range(0, 16, 2))
        result = editor.complete(scan, missing)
        assert result.range_m[0][~missing].equal(scan[~missing])
        other = torch.where(missing, 30.0, scan)
        assert editor.complete(other, missing).range_m.equal(result.range_m)

    def test_results_differ_little_and_cost_three_evaluations(self, editor, scan):
        missing = dropped_beams(GEOMETRY.projection, range(0, 16, 2))
        result = editor.complete(scan, missing, 2)
        assert result.nfe == 3
        assert not result.latents[0].equal(result.latents[1])
        with pytest.raises(ValueError, match=r"start must be a time above 0"):
            editor.complete(scan, missing, start=0.0)


class TestScans:
    """Points, arrays, tensors, files, scans and scenes: all are one scan."""

    def test_every_kind_of_scan_has_the_same_latents(self, editor, tmp_path):
        random = torch.Generator().manual_seed(0)
        points = torch.cat(
            [8 * torch.randn(500, 3, generator=random), torch.rand(500, 1, generator=random)], 1
        )
        write_bin(tmp_path / "scan.bin", points)
        range_m = range_image(points[:, :3], GEOMETRY.projection)[0]
        recorded = RecordedScan(points[:, :3].numpy(), points[:, 3].numpy())
        scene = Scene(range_m, GEOMETRY.projection)
        given = [points, points.numpy(), points[:, :3], range_m, range_m.numpy(), range_m[None]]
        given += [str(tmp_path / "scan.bin"), tmp_path / "scan.bin", recorded, scene]
        first, *others = (editor.encode(scan) for scan in given)
        assert all(latents.equal(first) for latents in others)
        mask = MASK.numpy()
        edited = editor.inpaint(points.numpy(), mask, 1)
        assert edited.range_m.equal(editor.inpaint(range_m, MASK, 1).range_m)

    @pytest.mark.parametrize(
        ("scan", "message"),
        [
            (torch.zeros(5, 2), r"points \(P, 3\) or \(P, 4\), or a range image \(16, 64\)"),
            (torch.full((5, 3), torch.nan), "NaN or infinite"),
            (torch.full((5, 3), 4000.0), "no point within 1..50 m; coordinates must be metres"),
            (torch.zeros(0, 3), "no point within"),
        ],
    )
    def test_points_and_images_that_are_no_scan_are_refused(self, editor, scan, message):
        with pytest.raises(ValueError, match=message):
            editor.encode(scan)


def labelled_editor(**vae_args):
    codec = RangeCodec(return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
    further = {"in_channels": 2, "intensity": True, "num_classes": NUM_CLASSES}
    networks = tiny_networks(spread=0.05, vae_args=VAE_ARGS | further | vae_args)
    geometry = ScanGeometry(GEOMETRY.projection, codec, GEOMETRY.grid_size)
    return SceneEditor(SceneGenerator(*networks, geometry), EditSettings(steps=2))


@pytest.fixture(scope="module")
def labelled():
    editor = labelled_editor()
    layer = editor.generator.vae.encoder.further_in
    torch.nn.init.normal_(layer.weight)  # as a training makes it
    return editor


@pytest.fixture(scope="module")
def recorded():
    random = np.random.default_rng(0)
    points = (10 * random.normal(size=(2000, 3))).astype(np.float32)
    return RecordedScan(points, random.random(2000), labels=np.full(2000, 26, np.uint32))


class TestLabels:
    """Checkpoints with intensity and labels."""

    def test_intensity_and_labels_are_encoded(self, labelled, recorded):
        latents = labelled.encode(recorded)
        vae = SceneVAE(labelled.generator.vae, labelled.generator.geometry)
        points = np.column_stack([recorded.points, recorded.intensity])
        expected = labelled.generator.latent_norm.normalise(vae.encode(points, recorded.labels))
        assert latents.equal(expected)
        trucks = replace(recorded, labels=recorded.labels + 1)
        assert not latents.equal(labelled.encode(trucks))
        dark = replace(recorded, intensity=0 * recorded.intensity, labels=None)
        assert labelled.encode(recorded.points).equal(labelled.encode(dark))
        with pytest.raises(ValueError, match=r"intensities up to 2\d\d.*divide them by their full"):
            labelled.encode(replace(recorded, intensity=255 * recorded.intensity))

    def test_scans_without_them_are_edited_where_the_encoder_does_not_see_them(self, recorded):
        editor = labelled_editor(encode_further=False)
        latents = editor.encode(recorded)
        assert latents.equal(editor.encode(recorded.points))
        range_m = editor.pixels(recorded.points).range_m
        result = editor.inpaint(recorded.points, MASK, 1)
        assert result.range_m[0][~MASK].equal(range_m[~MASK])
        assert (result.labels[0] > 0)[MASK].equal(result.range_m[0][MASK] > 0)
        assert len(result.intensity[0][MASK & (result.range_m[0] > 0)].unique()) > 2

    def test_results_have_those_of_the_scan_outside_the_mask(self, labelled, recorded):
        scan = labelled.pixels(recorded)
        for result in (labelled.inpaint(recorded, MASK, 1), labelled.complete(recorded, MASK)):
            outside = ~MASK & (scan.range_m > 0)
            assert result.intensity[0][outside].equal(scan.intensity[outside])
            assert (result.labels[0][outside] == 26).all()
            made = MASK & (result.range_m[0] > 0)
            assert made.any()
            assert len(result.labels[0][made].unique()) > 2
            assert len(result.intensity[0][made].unique()) > 20
            assert (result.labels > 0).equal(result.range_m > 0)
        assert labelled.vary(recorded, 1).labels is not None


class TestVaryAndInterpolate:
    def test_less_noise_leaves_more_of_the_scan(self, editor, scan):
        latents = editor.encode(scan[None])
        far = [
            (editor.vary(scan, range(2), start=start).latents - latents).norm().item()
            for start in (0.1, 0.5, 1.0)
        ]
        assert far[0] < far[1] < far[2]

    def test_the_ends_come_back_and_the_middle_lies_between(self, generator, scan):
        editor = SceneEditor(generator, EditSettings(steps=24))
        second = scan.roll(17, dims=1)
        result = editor.interpolate(scan, second, 5)
        ends = editor.encode(torch.stack([scan, second]))
        assert (result.latents[[0, -1]] - ends).abs().max() < 1e-2
        assert result.round_trip_m < 0.05
        far = (result.latents - ends[:1]).flatten(1).norm(dim=1)
        assert (far.diff() > 0).all()

    def test_a_single_frame_and_starts_outside_are_refused(self, editor, scan):
        with pytest.raises(ValueError, match="at least 2"):
            editor.interpolate(scan, scan, 1)
        for start in (0.0, 1.5):
            with pytest.raises(ValueError, match=r"start must be a time above 0"):
                editor.vary(scan, [0], start=start)


@pytest.mark.parametrize("shape", [(16, 1), (8, 64), (2, 8), (16, 128), (64,), (1, 16, 64)])
def test_masks_of_another_shape_are_refused(editor, scan, shape):
    mask = torch.zeros(shape, dtype=torch.bool)
    mask[..., :1] = True
    for edit in (editor.inpaint, editor.complete):
        with pytest.raises(ValueError, match=r"must have the shape \(16, 64\) of the range image"):
            edit(scan, mask, 1)


@pytest.mark.parametrize(
    ("feature", "given"),
    [
        (torch.ones(9), r"shape \(9,\) with 0 not finite"),
        (torch.full((8,), torch.nan), r"shape \(8,\) with 8 not finite"),
        (torch.ones(1), r"shape \(1,\) with 0"),
    ],
)
def test_features_of_no_object_are_refused(editor, scan, feature, given):
    with pytest.raises(ValueError, match=rf"feature must be \(8,\) finite numbers, .*{given}"):
        editor.inpaint(scan, MASK, 1, feature=feature)


def test_images_that_are_no_scans_are_not_encoded(editor, scan):
    images = torch.stack([scan, scan.roll(5, dims=1)])
    single = editor.encode(images[1])
    torch.testing.assert_close(editor.encode(images.numpy())[1:], single)  # rounding of a batch
    with pytest.raises(ValueError, match=r"got shape \(8, 64\)"):
        editor.encode(images[:, :8])
    images[1, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="NaN or infinite values"):
        editor.encode(images)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"solver": "euler_maruyama"}, "runs both ways, one of euler"),
        ({"strength": 1.5}, r"strength must lie in 0..1, got 1.5"),
        ({"window": (0.8, 0.2)}, "window must be two times"),
        ({"steps": 0}, "at least one step"),
        ({"shift": 0.0}, "shift"),
    ],
)
def test_settings_that_cannot_work_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        EditSettings(**given)


def test_a_checkpoint_is_edited_with_its_averaged_weights(tmp_path, scan):
    path = tiny_checkpoint(tmp_path / "tiny.safetensors", GEOMETRY, spread=0.05)
    found = SceneEditor.from_checkpoint(path, SETTINGS).vary(scan, 2)
    networks = tiny_networks(spread=0.05)
    expected = SceneEditor(SceneGenerator(*networks, GEOMETRY), SETTINGS).vary(scan, range(2))
    assert torch.equal(found.latents, expected.latents)
    assert torch.equal(found.points(1), points_of(expected.range_m[1], GEOMETRY.projection))


def test_an_editor_says_what_it_is(editor):
    assert repr(editor) == "SceneEditor(16 x 64 pixels, midpoint, 6 steps, cpu)"
