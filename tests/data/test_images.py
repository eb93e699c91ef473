"""Images from folders and tar shards, their cached latents, and dead leaves."""

import io
import os
import tarfile
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from r3dpa.data import DeadLeaves, ImageDataModule, ImageFolder
from r3dpa.data.dead_leaves import dead_leaves
from r3dpa.data.image_datamodule import latent_statistics
from r3dpa.data.images import ImageEntry, ImageError, center_crop
from r3dpa.data.store import CachedTensors, tensor_cache


def encoded(pixels):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.fixture
def pictures():
    generator = np.random.default_rng(0)
    return {
        f"n01/{index}.png": generator.integers(0, 256, (8, 8, 3), dtype=np.uint8)
        for index in range(4)
    }


@pytest.fixture
def folder(pictures, tmp_path):
    for name, pixels in pictures.items():
        path = tmp_path / "folder" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded(pixels))
    (tmp_path / "folder" / "notes.txt").write_text("no image")
    return tmp_path / "folder"


@pytest.fixture
def shards(pictures, tmp_path):
    root = tmp_path / "shards"
    root.mkdir()
    for number, (name, pixels) in enumerate(pictures.items()):
        with tarfile.open(root / f"{number % 2:03d}.tar", "a") as file:
            for suffix, data in ((name, encoded(pixels)), (name + ".cls", b"7")):
                member = tarfile.TarInfo(suffix)
                member.size = len(data)
                file.addfile(member, io.BytesIO(data))
    return root


def test_folder_and_shards_hold_the_same_images(folder, shards, pictures):
    for source in (ImageFolder(str(folder)), ImageFolder(str(shards))):
        entries = source.entries()
        assert len(entries) == len(pictures)
        for entry in entries:
            wanted = pictures["/".join(entry.name.split("/")[-2:])]
            assert np.array_equal(source.read(entry, 8), wanted)


def test_damaged_files_are_named(folder, shards):
    source = ImageFolder(str(folder))
    entry = source.entries()[0]
    entry.path.write_bytes(entry.path.read_bytes()[:40])
    with pytest.raises(ImageError, match=r"n01/0\.png is no image"):
        source.read(entry, 8)
    (shards / "000.tar").write_bytes(b"\x1f\x8b" + bytes(600))
    with pytest.raises(ImageError, match=r"000\.tar is no uncompressed tar file"):
        ImageFolder(str(shards)).entries()
    for root in (shards / "none", shards.with_name("gone")):
        with pytest.raises(ImageError, match="holds no image"):
            ImageFolder(str(root)).entries()


def test_a_damaged_chunk_of_a_png_names_the_file(folder):
    """Of a name that is none: a SyntaxError of Pillow."""
    pixels = np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    first, second, third = encoded(pixels).split(b"IDAT")
    (folder / "n01/0.png").write_bytes(first + b"IDAT" + second + bytes(4) + third)
    source = ImageFolder(str(folder))
    with pytest.raises(ImageError, match=r"0\.png is no image .*broken PNG"):
        source.read(source.entries()[0], 8)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: data.index(b"n01/2")],  # before a header
        lambda data: data[: data.index(b"n01/2") + 100],  # within it
        lambda data: data.replace(b"n01/2", b"n02/2"),  # no longer of its checksum
    ],
)
def test_a_shard_that_ends_too_soon_is_refused(damage, shards):
    """tarfile takes what it cannot read behind the first member for the end."""
    path = shards / "000.tar"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ImageError, match=r"000\.tar is .*damaged"):
        ImageFolder(str(shards)).entries()


def test_links_are_followed_and_what_is_hidden_is_left_out(folder, tmp_path):
    root = tmp_path / "linked"
    root.mkdir()
    (root / "n02").symlink_to(folder / "n01")
    (root / "n03").mkdir()
    (root / "n03" / "up").symlink_to(root)
    for hidden in (".cache/0.png", "n03/._0.png"):
        (root / hidden).parent.mkdir(exist_ok=True)
        (root / hidden).write_bytes(b"no image")
    (root / "._000.tar").write_bytes(b"what macOS writes beside files")
    with tarfile.open(root / "000.tar", "w") as file:
        file.addfile(tarfile.TarInfo("n01/._0.png"))
    names = [entry.name for entry in ImageFolder(str(root)).entries()]
    assert names == [f"n02/{index}.png" for index in range(4)]


def test_a_link_to_nothing_is_named(folder):
    (folder / "n02").mkdir()
    (folder / "n02" / "0.png").symlink_to(folder / "gone")
    with pytest.raises(ImageError, match=r"n02/0\.png.* mend or remove it"):
        ImageFolder(str(folder)).entries()


def test_names_that_leave_the_folder_are_refused(tmp_path):
    with tarfile.open(tmp_path / "a.tar", "w") as file:
        file.addfile(tarfile.TarInfo("../../evil.png"), io.BytesIO())
    with pytest.raises(ImageError, match="leads out of its folder"):
        ImageFolder(str(tmp_path)).entries()


def test_the_crop_is_the_centre():
    """A 4 x 12 image: columns 4..7 remain; halved exactly where it is twice as large."""
    pixels = np.zeros((4, 12, 3), np.uint8)
    pixels[:, 4:8] = 200
    assert np.array_equal(center_crop(Image.fromarray(pixels), 4), pixels[:, 4:8])
    large = pixels.repeat(2, axis=0).repeat(2, axis=1)
    assert np.array_equal(center_crop(Image.fromarray(large), 4), pixels[:, 4:8])
    assert center_crop(Image.fromarray(pixels), 7).shape == (7, 7, 3)


def test_images_are_split_mirrored_and_scaled(folder):
    module = ImageDataModule(
        ImageFolder(str(folder)), image_size=8, batch_size=2, val_every=4, mirrored=True
    )
    module.setup("fit")
    assert (len(module.train_set), len(module.val_set)) == (6, 1)
    assert {e.name for e in module.val_set.entries}.isdisjoint(
        e.name.removesuffix(".mirrored") for e in module.train_set.entries
    )
    plain, mirrored = module.train_set[0], module.train_set[1]
    assert mirrored["name"] == plain["name"] + ".mirrored"
    assert torch.equal(mirrored["image"], plain["image"].flip(-1))
    pixels = module.source.read(module.train_set.entries[0], 8)
    expected = torch.from_numpy(pixels.copy()).permute(2, 0, 1) / 127.5 - 1
    torch.testing.assert_close(plain["image"], expected)


def test_few_images_make_smaller_batches_and_fewer_than_processes_are_refused(folder, caplog):
    module = ImageDataModule(ImageFolder(str(folder)), image_size=8, batch_size=2, val_every=4)
    module.setup("fit")
    module.trainer = SimpleNamespace(world_size=2, global_rank=0, limit_train_batches=1.0)
    assert [len(batch["image"]) for batch in module.val_dataloader()] == [1]  # both get it
    with caplog.at_level("INFO"):
        assert [len(batch["image"]) for batch in module.train_dataloader()] == [1]
    assert "only 3 training images: batch_size 1 in place of 2" in caplog.text
    module.trainer.world_size = 4
    with pytest.raises(ValueError, match=r"3 training images do not fill .* 4 processes"):
        module.train_dataloader()


@pytest.mark.parametrize("packed", [False, True])
def test_a_replaced_image_of_the_same_size_is_another_one(packed, folder, shards):
    source = ImageFolder(str(shards if packed else folder))
    before = source.entries()[0]
    os.utime(before.path, ns=(0, before.path.stat().st_mtime_ns + 1))
    after = source.entries()[0]
    assert (after.name, after.num_bytes) == (before.name, before.num_bytes)
    assert after.cache_key != before.cache_key
    assert after.mirror().cache_key[1:] == after.cache_key[1:]


def test_dead_leaves_depend_on_seed_and_number_alone():
    long, short = DeadLeaves(50), DeadLeaves(3)
    entry = short.entries()[2]
    assert entry == long.entries()[2]
    image = short.read(entry, 16)
    assert image.shape == (16, 16, 3)
    assert np.array_equal(image, long.read(entry, 16))
    assert not np.array_equal(image, DeadLeaves(3, seed=1).read(entry, 16))
    assert not np.array_equal(image, short.read(short.entries()[1], 16))
    assert short.settings() == long.settings() != DeadLeaves(3, seed=1).settings()


def test_dead_leaves_have_the_spectrum_and_the_edges_of_photographs():
    """Power of photographs falls as f^-2 to f^-3; their derivatives have heavy tails."""
    size = 64
    images = [dead_leaves(np.random.default_rng(i), size).mean(axis=2) for i in range(24)]
    grey = np.stack(images)
    centred = grey - grey.mean(axis=(1, 2), keepdims=True)
    power = np.square(np.abs(np.fft.fft2(centred))).mean(axis=0)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size)[None])
    band = (frequency > 1.5 / size) & (frequency < 0.3)
    slope = np.polyfit(np.log(frequency[band]), np.log(power[band]), 1)[0]
    assert -3.2 < slope < -1.8
    steps = np.diff(grey, axis=2).ravel()
    kurtosis = np.mean((steps - steps.mean()) ** 4) / steps.var() ** 2
    assert kurtosis > 6  # a Gaussian field has 3


def test_statistics_of_cached_latents(tmp_path):
    entries = [ImageEntry(str(i), tmp_path / "x", i) for i in range(5)]
    cache, moments = tensor_cache(tmp_path, "posterior", {}, (4, 2, 3)), torch.randn(5, 4, 2, 3)
    with cache.writer() as writer:
        writer.add([entry.cache_key for entry in entries], moments)
    posteriors = CachedTensors(cache, entries)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as that of torch on memory that it must not write
        mean, variance = latent_statistics(posteriors)
    means, logvars = moments.chunk(2, dim=1)
    torch.testing.assert_close(mean, means.mean(dim=(0, 2, 3)))
    # Law of total variance: of the means, plus the mean of the posteriors' own.
    spread = means.var(dim=(0, 2, 3), unbiased=False) + logvars.exp().mean(dim=(0, 2, 3))
    torch.testing.assert_close(variance, spread)
