import math
from dataclasses import replace

import pytest
import torch

from r3dpa.feature_names import DEFAULT_SPACES, FREE_SPACES, SOURCES
from r3dpa.features import GeometricFeatures, WaffleIronS
from r3dpa.geometry import LidarSensor, unproject
from r3dpa.metrics.networks.liploc import LIPLoc
from r3dpa.metrics.networks.minkowski import SPVCNN, MinkowskiNet, official_name
from r3dpa.metrics.networks.pointnet import PointNet
from r3dpa.metrics.networks.rangenet import RangeNet, picked
from r3dpa.metrics.networks.rangevit import RangeViT, range_channels
from r3dpa.metrics.networks.sparse import pool_voxels, voxelize
from r3dpa.metrics.scene import DEFAULT, PUBLISHED, EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import (
    SceneFeatures,
    lip_loc_space,
    range_vit_space,
    scene_features,
    voxel_space,
)

SENSOR = LidarSensor(beams=16, columns=64)
CENTRE, CORNER = (replace(protocol, sensor=SENSOR) for protocol in (DEFAULT, PUBLISHED))
WIDTHS = (4, 4, 4, 4, 4, 4, 4, 4, 3)
RANGEVIT = {  # beginnings of our names and of the official ones
    "image_": "image_",
    "stem.": "rangevit.encoder.patch_embed.conv_block.",
    "embedding.": "rangevit.encoder.patch_embed.proj_block.1.",
    "encoder.": "rangevit.encoder.",
    "norm.": "rangevit.encoder.norm.",
    "upsample.": "rangevit.decoder.up_conv_block.conv_upsample.0.",
    "merge.": "rangevit.decoder.up_conv_block.conv1.",
    "output.": "rangevit.decoder.up_conv_block.conv_output.",
}
# Batches of other sizes are added up in another order; features are of size 1.
FLOAT32 = {"atol": 1e-5, "rtol": 1e-5}


def image(seed=0):
    """Range image with a quarter of empty pixels."""
    generator = torch.Generator().manual_seed(seed)
    range_m = 2 + 50 * torch.rand(16, 64, generator=generator)
    return torch.where(torch.rand(16, 64, generator=generator) < 0.25, 0.0, range_m)


def seen(count, protocol=CENTRE):
    return [through_sensor(EvaluationScene(f"{i}", None, image(i)), protocol) for i in range(count)]


# --- the way of a scene ---


def test_points_of_an_image_lie_on_centres_or_corners():
    """A single return in the pixel right of straight ahead: azimuth 0 is the corner of column 32.

    The row begins at 3 degrees and has a pitch of 28 / 16 degrees.
    """
    range_m = torch.zeros(16, 64)
    range_m[0, 32] = 10.0
    pitch, step = 28 / 16, 360 / 64
    for protocol, offset in ((CORNER, 0.0), (CENTRE, 0.5)):
        scene = through_sensor(EvaluationScene("a", None, range_m), protocol)
        up, aside = math.radians(3 - offset * pitch), math.radians(-offset * step)
        expected = [math.cos(up) * math.cos(aside), math.cos(up) * math.sin(aside), math.sin(up)]
        assert scene.points.tolist() == [pytest.approx([10 * v for v in expected], abs=1e-5)]
    assert (scene.range_m == torch.where(range_m > 0, 10.0, -1.0)).all()


def test_points_become_the_image_of_their_nearest_returns():
    points = torch.tensor([[10.0, 0.0, 0.0, 0.5], [8.0, 0.0, 0.0, 0.25], [70.0, 0.0, 0.0, 1.0]])
    scene = through_sensor(EvaluationScene("a", points), CENTRE)
    assert scene.range_m[scene.range_m > 0].tolist() == [8.0]  # 10 m is behind, 70 m beyond reach
    assert scene.intensity[scene.range_m > 0].tolist() == [0.25]
    assert scene.points.shape == (1, 3)
    assert through_sensor(EvaluationScene("a", points[:, :3]), CENTRE).intensity is None


def test_images_and_their_points_take_one_way():
    """Read as points or as image, a scene of pixel centres is the same."""
    (scene,) = seen(1)
    again = through_sensor(EvaluationScene("0", scene.points), CENTRE)
    torch.testing.assert_close(again.range_m, scene.range_m)
    torch.testing.assert_close(again.points, scene.points)
    # Where both are given, the image counts, whatever rays its points were made with.
    both = through_sensor(EvaluationScene("0", torch.zeros(3, 3), image(0)), CENTRE)
    assert torch.equal(both.points, scene.points)


# --- spaces ---


def test_point_spaces_are_means_before_the_lift():
    """The lift keeps angles, so the mean of the lifted features is the lifted mean."""
    scenes = seen(2)
    for name, extractor in (("fwid", WaffleIronS()), ("fgeo", GeometricFeatures())):
        space = scene_features(name, None, CENTRE)
        features = space(scenes)
        assert features.shape == (2, space.dim) == (2, {"fwid": 128, "fgeo": 64}[name])
        points = torch.nn.functional.pad(scenes[1].points, (0, 1), value=0.26)
        with torch.no_grad():
            expected = extractor(points).mean(dim=0)
        torch.testing.assert_close(extractor.lift(features[1:])[0], expected, **FLOAT32)
        torch.testing.assert_close(space(scenes[1:]), features[1:], **FLOAT32)


def test_range_vit_reads_the_image():
    network = RangeViT(SENSOR, 4, 64, 1, 1, 4, 6, 5)
    space = range_vit_space(network)
    expected = network(torch.stack([scene.range_m for scene in seen(2)]))
    assert torch.equal(space(seen(2)), expected)
    assert (space.dim, space.card["in_channels"]) == (10, 4)
    needs_intensity = range_vit_space(RangeViT(SENSOR, 5, 64, 1, 1, 4, 6, 5))
    with pytest.raises(ValueError, match=r"0: has no intensity.*rangevit_wo_i"):
        needs_intensity(seen(1))
    assert space.card["weights"] != needs_intensity.card["weights"]


def test_the_cast_of_lip_loc_is_that_of_the_protocol():
    """Clipped, an empty pixel is as black as a range of 0, and 55 m as white as 50 m."""
    network = LIPLoc(32, 8, 24, 1, 3)
    near, far = torch.full((16, 64), 20.0), torch.full((16, 64), 50.0)
    near[:, :9], far[:, :9] = -1.0, 55.0

    def features(protocol, range_m):
        return lip_loc_space(network, protocol)([EvaluationScene("a", None, range_m)])

    assert torch.equal(features(CENTRE, near), features(CENTRE, near.clamp(min=0)))
    assert torch.equal(features(CENTRE, far), features(CENTRE, far.clamp(max=50)))
    assert torch.equal(features(CORNER, near), network(near[None]))
    assert not torch.allclose(features(CORNER, near), features(CENTRE, near))
    assert not torch.allclose(features(CORNER, far), features(CENTRE, far))


def test_gpus_do_not_round_the_factors_of_convolutions():
    """Features are those of a CPU: TF32 is off inside, and as it was behind."""
    inside = []

    def extract(scenes):
        inside.append((torch.backends.cudnn.allow_tf32, torch.backends.cudnn.enabled))
        return torch.zeros(len(scenes), 2)

    before = torch.backends.cudnn.allow_tf32
    SceneFeatures("toy", 2, {}, extract)(seen(1))
    assert inside == [(False, True)]
    assert torch.backends.cudnn.allow_tf32 == before


@pytest.mark.parametrize("network_class", [MinkowskiNet, SPVCNN])
def test_voxel_spaces_pool_rings(network_class):
    torch.manual_seed(0)
    network = network_class(WIDTHS)
    space = voxel_space(network, replace(CENTRE, voxel_m=0.5))
    assert space.dim == 16 * 3
    features = space(seen(3))
    voxels, inputs = voxelize(seen(3)[2].points, 0.5)
    coordinates = torch.nn.functional.pad(voxels, (0, 1))
    with torch.no_grad():
        expected = pool_voxels(network(coordinates, inputs), coordinates, 1, voxel_m=0.5)
    torch.testing.assert_close(features[2:], expected, **FLOAT32)


@pytest.fixture(scope="module")
def range_net(tmp_path_factory):
    """RangeNet-21 with statistics that no space has, one with the usual ones, file of the first."""
    torch.manual_seed(0)
    network = RangeNet(21, 4, 3, mean=(5.0,) * 4, deviation=(2.0,) * 4)
    file = tmp_path_factory.mktemp("range_net") / "weights.pt"
    torch.save(network.state_dict(), file)
    return network, RangeNet(21, 4, 0), file


@pytest.mark.parametrize("name", ["frd", "frid_r2flow", "frid_lidm"])
def test_range_net_spaces_standardise_their_input_but_for_lidm(name, range_net):
    network, usual, file = range_net
    space, scene = scene_features(name, file, CENTRE), seen(1)[0]
    range_m = scene.range_m[None]
    if name == "frid_lidm":
        channels = range_channels(range_m, SENSOR)
    else:
        xyz = unproject(range_m, CENTRE.projection).movedim(-1, 1)
        channels = usual.normalise(torch.cat([range_m[:, None], xyz], dim=1))
        assert space.card["mean"] == pytest.approx([12.12, 10.88, 0.23, -1.04])
    expected = network.feature_map(channels)
    expected = picked(expected) if name == "frd" else expected.unflatten(2, (16, -1)).mean((3, 4))
    assert space.dim == expected.flatten(1).shape[1]
    torch.testing.assert_close(space([scene]), expected.flatten(1), **FLOAT32)


@pytest.mark.parametrize(("name", "size"), [("frid_lidm", (40, 1024)), ("frd", (64, 1800))])
def test_range_net_spaces_refuse_images_that_their_network_cannot_halve(name, size, range_net):
    protocol = replace(CENTRE, sensor=LidarSensor(beams=size[0], columns=size[1]))
    with pytest.raises(ValueError, match=rf"the images are {size[0]} x {size[1]}: leave {name}"):
        scene_features(name, range_net[2], protocol)


def test_remission_is_read_by_networks_of_five_channels(tmp_path):
    torch.manual_seed(0)
    torch.save(RangeNet(21, 5, 0).state_dict(), tmp_path / "weights.pt")
    space = scene_features("frd", tmp_path / "weights.pt", CENTRE)
    bright, dark = (
        through_sensor(EvaluationScene("a", None, image(), torch.full((16, 64), value)), CENTRE)
        for value in (1.0, 0.0)
    )
    assert not torch.equal(space([bright]), space([dark]))
    with pytest.raises(ValueError, match="0: has no intensity, which these weights of RangeNet"):
        space(seen(1))


def test_point_net_space_reads_empty_pixels_as_the_origin(tmp_path):
    torch.manual_seed(0)
    network = PointNet()
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    (scene,) = seen(1)
    points = torch.cat([scene.points, torch.zeros(1, 3)]) / 80
    space = scene_features("fpd", tmp_path / "weights.pth", CENTRE)
    torch.testing.assert_close(space([scene]), network(points.T[None]), **FLOAT32)


def test_the_second_judge_comes_with_the_package():
    """It is a network of its own, as FWID's, and takes part in no default comparison."""
    judges = {name: scene_features(name) for name in ("fwid", "fwid_judge")}
    assert [space.card["backbone"] for space in judges.values()] == [
        "waffleiron-s",
        "waffleiron-judge",
    ]
    assert judges["fwid"].card["weights"] != judges["fwid_judge"].card["weights"]
    features = judges["fwid_judge"](seen(2))
    assert features.shape == (2, 96)
    assert not torch.equal(features[0], features[1])
    assert "fwid_judge" in FREE_SPACES
    assert "fwid_judge" not in DEFAULT_SPACES
    assert "waffleiron-judge" not in SOURCES


def test_official_files_become_spaces(tmp_path):
    torch.manual_seed(0)
    networks = {"fsvd": MinkowskiNet(WIDTHS), "fpvd": SPVCNN(WIDTHS)}
    for name, network in networks.items():
        path = tmp_path / f"{name}.ckpt"
        state = {official_name(key): value for key, value in network.state_dict().items()}
        torch.save({"state_dict": state}, path)
        space = scene_features(name, path, CENTRE)
        assert (space.name, space.label) == (name, name.upper())
        assert torch.equal(space(seen(1)), voxel_space(network, CENTRE)(seen(1)))
        assert space.card == voxel_space(network, CENTRE).card
    network = RangeViT(SENSOR, 4, 64, 1, 1, 4, 6, 5)
    state = {}
    for key, value in network.state_dict().items():
        ours = next(name for name in RANGEVIT if key.startswith(name))
        state[RANGEVIT[ours] + key.removeprefix(ours)] = value
    torch.save({"state_dict": state}, tmp_path / "frid.ckpt")
    space = scene_features("frid", tmp_path / "frid.ckpt", CENTRE)
    assert torch.equal(space(seen(1)), range_vit_space(network)(seen(1)))


@pytest.mark.parametrize(
    ("name", "ckpt", "message"),
    [
        ("fid", None, "unknown feature space 'fid'; choose from frid, fld"),
        ("frid", None, r"frid needs weights: give --ckpt\.frid FILE"),
        ("fgeo", "x.ckpt", "fgeo has no weights: leave x.ckpt out"),
        ("fld", "x.ckpt", "x.ckpt: no such file"),
    ],
)
def test_spaces_that_cannot_be_had_are_named(name, ckpt, message):
    with pytest.raises(ValueError, match=message):
        scene_features(name, ckpt)


def test_broken_features_name_the_scene():
    card = {"backbone": "none", "layer": "", "weights": None, "preprocessing": ""}
    space = SceneFeatures("x", 1, card, lambda scenes: torch.tensor([[0.0], [math.nan]]))
    with pytest.raises(ValueError, match="1: its features of X hold NaN"):
        space(seen(2))
