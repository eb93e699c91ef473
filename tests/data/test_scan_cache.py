"""Range images and posteriors kept on disk: same numbers, found by settings, safe when killed."""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from r3dpa.data import (
    Augmentation,
    CachedTensors,
    LatentDataset,
    LidarDataModule,
    LidarDataset,
    TensorCache,
    TensorCacheError,
    View,
    find_scans,
    range_image_cache,
    write_range_images,
)
from r3dpa.geometry import LidarSensor, RangeCodec, SphericalProjection


@pytest.fixture
def projection(sensor):
    return SphericalProjection(sensor)


@pytest.fixture
def scans(tmp_path, make_scans):
    return find_scans(make_scans(tmp_path / "scans", 5))


def moments(scans, scale=1.0):
    generator = torch.Generator().manual_seed(3)
    return scale * torch.randn(len(scans), 4, 2, 16, generator=generator)


def posterior_cache(root):
    return TensorCache(root, "posterior", {"vae": "abc"}, (4, 2, 16))


@pytest.mark.parametrize("codec", [RangeCodec(), RangeCodec("log2")])
def test_a_cached_sample_is_the_projected_one(tmp_path, scans, projection, codec):
    root = tmp_path / "images"
    assert write_range_images(scans, projection, codec, root) == 5
    images = CachedTensors(range_image_cache(root, projection, codec), scans)
    projected = LidarDataset(scans, projection, codec)
    cached = LidarDataset(scans, projection, codec, images=images)
    for index in range(5):
        for key, value in projected[index].items():
            if torch.is_tensor(value):
                assert torch.equal(cached[index][key], value), key
            else:
                assert cached[index][key] == value


def test_the_row_on_disk_by_hand(tmp_path, scans):
    """A float32 row of 512 bytes for each scan, and the line that names it."""
    cache, values = posterior_cache(tmp_path / "c"), moments(scans)
    with cache.writer() as add:
        add(scans, values)
    data = (cache.folder / "shard_00000.rows").read_bytes()
    assert len(data) == 5 * cache.row_bytes == 5 * 512
    assert torch.equal(torch.frombuffer(bytearray(data), dtype=torch.float32), values.flatten())
    line = (cache.folder / "shard_00000.jsonl").read_text().splitlines()[2]
    file = scans[2].path.stat()
    expected = {
        "scan": scans[2].name,
        "bytes": file.st_size,
        "mtime_ns": file.st_mtime_ns,
        "row": 2,
    }
    assert json.loads(line) == expected


def test_only_what_is_missing_is_projected(tmp_path, scans, projection, monkeypatch):
    root, read = tmp_path / "images", []
    write_range_images(scans[:3], projection, RangeCodec(), root)
    original = LidarDataset._project
    monkeypatch.setattr(
        LidarDataset, "_project", lambda self, scan: read.append(scan) or original(self, scan)
    )
    assert write_range_images(scans, projection, RangeCodec(), root) == 2
    assert read == scans[3:]
    assert write_range_images(scans, projection, RangeCodec(), root) == 0


@pytest.mark.parametrize(
    ("projection_of", "codec"),
    [
        (lambda s: SphericalProjection(LidarSensor(beams=8, columns=32)), RangeCodec("log2")),
        (lambda s: SphericalProjection(LidarSensor(beams=8, columns=64)), RangeCodec()),
        (
            lambda s: SphericalProjection(LidarSensor(beams=8, columns=32, range_max_m=40)),
            RangeCodec(),
        ),
    ],
)
def test_other_settings_never_find_these_rows(tmp_path, scans, projection, projection_of, codec):
    write_range_images(scans, projection, RangeCodec(), tmp_path)
    other = range_image_cache(tmp_path, projection_of(None), codec)
    assert other.missing(scans) == scans
    with pytest.raises(TensorCacheError, match="lacks 5 of 5, such as"):
        CachedTensors(other, scans)


def test_a_replaced_scan_is_noticed_and_made_again(tmp_path, scans, projection):
    cache = range_image_cache(tmp_path / "i", projection, RangeCodec())
    write_range_images(scans, projection, RangeCodec(), tmp_path / "i")
    images = CachedTensors(cache, scans)
    scans[1].path.write_bytes(scans[1].path.read_bytes() + scans[2].path.read_bytes())
    with pytest.raises(TensorCacheError, match=r"0000000001\.bin was replaced"):
        images.read(scans[1])
    assert write_range_images(scans, projection, RangeCodec(), tmp_path / "i") == 1
    expected = LidarDataset(scans, projection, RangeCodec())[1]["range_image"]
    assert torch.equal(CachedTensors(cache, scans).read(scans[1]), expected)


def test_a_scan_of_the_same_size_is_noticed_too(tmp_path, scans, projection):
    root = tmp_path / "i"
    write_range_images(scans, projection, RangeCodec(), root)
    images = CachedTensors(range_image_cache(root, projection, RangeCodec()), scans)
    points = np.fromfile(scans[1].path, "<f4").reshape(-1, 4)
    (2 * points).tofile(scans[1].path)
    with pytest.raises(TensorCacheError, match=r"0000000001\.bin was replaced"):
        images.read(scans[1])
    assert write_range_images(scans, projection, RangeCodec(), root) == 1
    again = CachedTensors(range_image_cache(root, projection, RangeCodec()), scans)
    expected = LidarDataset(scans, projection, RangeCodec())[1]["range_image"]
    assert torch.equal(again.read(scans[1]), expected)


@pytest.mark.parametrize("value", [torch.inf, torch.nan])
def test_what_is_not_finite_is_not_kept(tmp_path, scans, value):
    """It would cost a step in every epoch; the scans before it stay."""
    cache, values = posterior_cache(tmp_path), moments(scans)
    values[3, 0, 1, 2] = value
    with cache.writer() as add:
        add(scans[:2], values[:2])
        with pytest.raises(TensorCacheError, match=r"0000000003\.bin: .* posterior is not finite"):
            add(scans[2:], values[2:])
    assert cache.missing(scans) == scans[2:]


def test_an_unfinished_row_is_cut_off_and_made_again(tmp_path, scans):
    """A process killed between row and journal: the row does not count."""
    cache, values = posterior_cache(tmp_path), moments(scans)
    with cache.writer() as add:
        add(scans[:2], values[:2])
    with (cache.folder / "shard_00000.rows").open("ab") as file:
        file.write(b"x" * 700)
    with (cache.folder / "shard_00000.jsonl").open("a") as file:
        file.write('{"scan": "a')
    assert cache.missing(scans) == scans[2:]
    with cache.writer() as add:
        add(scans, values)
    read = CachedTensors(cache, scans)
    assert all(torch.equal(read.read(s), v) for s, v in zip(scans, values, strict=True))


def _write_share(root, folder, place):
    scans = find_scans(folder)
    with posterior_cache(root).writer(place) as add:
        for scan, value in zip(scans[place::2], moments(scans)[place::2], strict=True):
            add([scan], value[None])


def test_processes_write_at_once(tmp_path, scans):
    folder = tmp_path / "scans"
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(_write_share, tmp_path / "c", folder, place) for place in (0, 1)]
        [job.result() for job in jobs]
    read = CachedTensors(posterior_cache(tmp_path / "c"), scans)
    for scan, value in zip(scans, moments(scans), strict=True):
        assert torch.equal(read.read(scan), value)


def test_what_is_read_is_a_copy(tmp_path, scans):
    cache = posterior_cache(tmp_path)
    with cache.writer() as add:
        add(scans, moments(scans))
    read = CachedTensors(cache, scans)
    read.read(scans[0]).zero_()
    assert torch.equal(read.read(scans[0]), moments(scans)[0])


def test_wrong_shapes_and_unwritable_folders_are_named(tmp_path, scans):
    with (
        posterior_cache(tmp_path / "c").writer() as add,
        pytest.raises(ValueError, match=r"must be \(5, 4, 2, 16\), got \(5, 4, 2, 8\)"),
    ):
        add(scans, moments(scans)[..., :8])
    (tmp_path / "file").write_text("")
    cache = posterior_cache(tmp_path / "file")
    with pytest.raises(TensorCacheError, match="cannot be written to"), cache.writer():
        pass


def test_rotating_a_cached_image_is_projecting_the_rotated_scan(tmp_path, scans, projection):
    """By 3 of 8 grid columns, each of 4 pixels."""
    codec, view = RangeCodec(), View(columns=3, mirrored=False, grid_columns=8)
    write_range_images(scans, projection, codec, tmp_path)
    images = CachedTensors(range_image_cache(tmp_path, projection, codec), scans)
    plain = LidarDataset(scans, projection, codec)[0]["range_image"]
    seen = view.sample(LidarDataset(scans, projection, codec, images=images)[0])
    assert torch.equal(seen["range_image"], plain.roll(12, -1))
    assert torch.equal(seen["valid_mask"], codec.valid_mask(plain.roll(12, -1)))


def test_posteriors_turn_with_the_scan(tmp_path, scans):
    cache = posterior_cache(tmp_path)
    with cache.writer() as add:
        add(scans, moments(scans))
    sample = LatentDataset(scans, CachedTensors(cache, scans))[1]
    seen = View(columns=3, mirrored=False, grid_columns=8).sample(sample)
    assert torch.equal(seen["posterior_moments"], moments(scans)[1].roll(6, -1))
    assert (seen["index"], seen["name"]) == (1, scans[1].name)


@pytest.mark.parametrize(
    ("augmentation", "latent_columns", "message"),
    [
        (Augmentation(flip=True), 16, "flip: .*mirroring.*cache_latents: false"),
        (Augmentation(rotate=True), 4, "rotate: 8 grid columns do not divide the 4 columns"),
    ],
)
def test_augmentation_that_latents_do_not_follow(augmentation, latent_columns, message):
    with pytest.raises(ValueError, match=message):
        augmentation.check_latents(latent_columns, 8)


def test_augmentation_that_latents_follow():
    Augmentation(rotate=True).check_latents(16, 8)
    Augmentation().check_latents(4, 8)


def data(folder, **kwargs):
    """Loaded like in a fit."""
    module = LidarDataModule(
        str(folder), sensor=LidarSensor(beams=8, columns=32), grid_size=(2, 8), batch_size=2,
        val_every=None, **kwargs,
    )  # fmt: skip
    module.prepare_data()
    module.setup("fit")
    return module


@pytest.mark.parametrize("augmentation", [Augmentation(), Augmentation(rotate=True, flip=True)])
def test_batches_of_the_data_module_are_the_same(tmp_path, scans, augmentation):
    folder = tmp_path / "scans"
    plain = data(folder, augmentation=augmentation)
    cached = data(folder, augmentation=augmentation, images_dir=str(tmp_path / "i"), num_workers=1)
    pairs = zip(plain.train_dataloader(), cached.train_dataloader(), strict=True)
    for number, (one, other) in enumerate(pairs):
        assert one["name"] == other["name"], number
        assert torch.equal(one["range_image"], other["range_image"])


def test_the_data_module_refuses_latents_that_do_not_follow(tmp_path, scans):
    cache = posterior_cache(tmp_path / "c")
    with cache.writer() as add:
        add(scans, moments(scans))
    module = data(tmp_path / "scans", augmentation=Augmentation(flip=True))
    with pytest.raises(ValueError, match="mirroring"):
        module.use_posteriors(CachedTensors(cache, scans))
