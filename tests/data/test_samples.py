import io
import pickle
import re
import shutil

import numpy as np
import pytest
import torch

from lidarsim.scan_files import ScanError, write_bin, write_npz, write_ply
from r3dpa.data.samples import _READERS, READABLE, read_samples
from r3dpa.data.scans import scan_files
from r3dpa.geometry import EMPTY_RANGE_M, LidarSensor, SphericalProjection, range_image, unproject

SENSOR = LidarSensor(beams=4, columns=8)
CLOUDS = [
    np.array([[10, 0, -1, 0.5], [0, 20, 0.25, 0.125], [-30, 1, -2, 1.0]], np.float32),
    np.array([[5, 5, 0, 0.0], [-7, 2, -0.5, 0.75]], np.float32),
]


def image(seed=0, channels=5):
    """Range, x, y, z and intensity ``(C, H, W)``; 0, 0.5 m and 60 m are no returns."""
    generator = torch.Generator().manual_seed(seed)
    range_m = 2 + 50 * torch.rand(4, 8, generator=generator)
    range_m[0, 0], range_m[1, 1], range_m[2, 2] = 0.0, 0.5, 60.0
    xyz = unproject(range_m, SphericalProjection(SENSOR)).movedim(-1, 0)
    intensity = torch.rand(1, 4, 8, generator=generator)
    return torch.cat([range_m[None], xyz, intensity])[:channels]


def returns(image):
    return (image[0] > 1) & (image[0] < 56)


def assert_is(sample, image):
    """The sample holds just the pixels of the image that are returns."""
    valid = returns(image)
    expected = torch.where(valid, image[0], EMPTY_RANGE_M)
    torch.testing.assert_close(sample.range_m, expected, rtol=0, atol=0)
    torch.testing.assert_close(sample.points[:, :3], image[1:4, valid].T, rtol=0, atol=0)
    if len(image) == 5:
        torch.testing.assert_close(sample.intensity, image[4] * valid, rtol=0, atol=0)
        torch.testing.assert_close(sample.points[:, 3], image[4, valid], rtol=0, atol=0)
    else:
        assert sample.intensity is None
        assert sample.points.shape == (29, 3)


def write_text(path, points):
    np.savetxt(path, np.hstack([points[:, :3], np.zeros((len(points), 3))]), fmt="%.3f")


@pytest.mark.parametrize(
    ("suffix", "write", "columns"),
    [("bin", write_bin, 4), ("ply", write_ply, 4), ("txt", write_text, 3)],
)
def test_clouds_of_a_folder_in_the_order_of_their_names(tmp_path, suffix, write, columns):
    folder = tmp_path / "generated"
    for name, points in zip(("0", "1"), CLOUDS, strict=True):
        (folder / "deep").mkdir(parents=True, exist_ok=True)
        write(folder / "deep" / f"{name}.{suffix}", points)
    (folder / "deep" / "0.png").touch()
    samples = read_samples(folder, SENSOR)
    for _ in range(2):  # every iteration starts anew
        found = list(samples)
        assert [sample.name for sample in found] == ["deep/0", "deep/1"]
        for sample, points in zip(found, CLOUDS, strict=True):
            assert sample.points.dtype == torch.float32
            assert sample.points.tolist() == points[:, :columns].tolist()
            assert sample.range_m is None
            assert sample.intensity is None
        assert samples.bad == []


def test_points_out_of_range_are_left_out(tmp_path):
    points = np.array([[0.5, 0, 0, 1], [10, 0, 0, 0.5], [60, 0, 0, 1]], np.float32)
    write_bin(tmp_path / "a.bin", points)
    (sample,) = read_samples(tmp_path / "a.bin", SENSOR)
    assert sample.name == "a"
    assert sample.points.tolist() == [[10, 0, 0, 0.5]]


def test_folder_of_r3dpa_sample_is_read_once(tmp_path):
    for name, points in (("000000", CLOUDS[0]), ("000001", CLOUDS[1])):
        write_bin(tmp_path / "bin" / f"{name}.bin", points[:, :3])
        write_ply(tmp_path / "ply" / f"{name}.ply", points[:, :3])
    write_npz(
        tmp_path / "scenes.npz", {"000000": CLOUDS[0][:, :3], "000001": CLOUDS[1][:, :3]}.items()
    )
    with pytest.raises(ScanError, match=r"several formats \(2 \.bin, 1 \.npz, 2 \.ply\).*"):
        read_samples(tmp_path, SENSOR)
    (tmp_path / "metadata.json").touch()
    names, points, _, _ = zip(*read_samples(tmp_path, SENSOR), strict=True)
    assert names == ("000000", "000001")
    assert points[1].tolist() == CLOUDS[1][:, :3].tolist()
    names = [sample.name for sample in read_samples(tmp_path / "ply", SENSOR)]
    assert names == ["000000", "000001"]
    (tmp_path / "scenes.npz").unlink()
    names = [sample.name for sample in read_samples(tmp_path, SENSOR)]
    assert names == ["bin/000000", "bin/000001"]
    shutil.rmtree(tmp_path / "bin")
    np.save(tmp_path / "range_m.npy", np.ones((2, 64, 1024), np.float32))
    names = [sample.name for sample in read_samples(tmp_path, SENSOR)]
    assert names == ["000000", "000001"]
    assert [file.suffix for file in scan_files(tmp_path)] == [".ply", ".ply"]


@pytest.mark.parametrize("order", ["C", "F"])
def test_cloud_in_either_memory_order(tmp_path, order):
    np.savez(tmp_path / "a.npz", first=np.asarray(CLOUDS[0], order=order))
    (sample,) = read_samples(tmp_path / "a.npz", SENSOR)
    assert sample.name == "first"
    assert sample.points.tolist() == CLOUDS[0].tolist()


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed, np.save])
@pytest.mark.parametrize("channels", [4, 5])
def test_stack_of_images_with_points(tmp_path, write, channels):
    images = [image(seed, channels) for seed in range(3)]
    file = tmp_path / ("img.npy" if write is np.save else "img.npz")
    write(file, torch.stack(images).numpy())
    samples = list(read_samples(file, SENSOR))
    assert [sample.name for sample in samples] == ["000000", "000001", "000002"]
    for sample, expected in zip(samples, images, strict=True):
        assert_is(sample, expected)


@pytest.mark.parametrize("unprojection", ["corner", "centre"])
def test_stack_of_ranges_gets_its_points_from_the_rays(tmp_path, unprojection):
    expected = image()
    np.savez(tmp_path / "img.npz", expected[:1].numpy())  # (N, H, W), N = 1
    (sample,) = read_samples(tmp_path / "img.npz", SENSOR, unprojection=unprojection)
    in_metres = torch.where(returns(expected), expected[0], EMPTY_RANGE_M)
    torch.testing.assert_close(sample.range_m, in_metres, rtol=0, atol=0)
    back, _ = range_image(sample.points, SphericalProjection(SENSOR))
    first = sample.points[0] / sample.points[0].norm()
    azimuth = torch.atan2(first[1], first[0])  # of column 1 of 8, which starts 45 degrees from -x
    if unprojection == "centre":
        torch.testing.assert_close(back, sample.range_m, rtol=0, atol=1e-4)
    assert azimuth.rad2deg().item() == pytest.approx({"corner": 135, "centre": 112.5}[unprojection])


def test_intensity_of_images_without_points(tmp_path):
    expected = image()
    np.save(tmp_path / "a.npy", expected[None, [0, 4]].numpy())
    (sample,) = read_samples(tmp_path / "a.npy", SENSOR)
    torch.testing.assert_close(sample.points[:, 3], expected[4, returns(expected)], rtol=0, atol=0)


def test_golden_images_and_clouds_of_the_official_code(tmp_path, request):
    folder = request.config.rootpath / "tests" / "parity" / "data"
    case = np.load(folder / "generate_postprocess.npz")
    sensor = LidarSensor(*case["in/decoded"].shape[-2:])
    for name in ("linear", "log"):
        (tmp_path / name / "numpy").mkdir(parents=True)
        (tmp_path / name / "pcd").mkdir()
        images = case[f"out/{name}/dxyzi"]
        np.savez(tmp_path / name / "numpy" / "img.npz", arr_0=images)
        for index in range(len(images)):
            write_text(
                tmp_path / name / "pcd" / f"{index:06d}.txt", case[f"out/{name}/pcd_txt_{index}"]
            )
        samples = list(read_samples(tmp_path / name, sensor))
        assert [sample.name for sample in samples] == ["000000", "000001"]
        texts = list(read_samples(tmp_path / name / "pcd", sensor))
        for index, (sample, text) in enumerate(zip(samples, texts, strict=True)):
            range_m, intensity = case[f"out/{name}/eval_range_images"][index]
            assert np.array_equal(sample.range_m, range_m)
            assert np.array_equal(sample.intensity, intensity)
            assert np.array_equal(sample.points[:, :3], case[f"out/{name}/eval_pcd_{index}"])
            rounded = case[f"out/{name}/pcd_txt_{index}"]
            np.testing.assert_allclose(text.points, rounded, atol=5.1e-4)  # three decimals


@pytest.mark.parametrize("old_file", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_tensor_files_of_r2dm(tmp_path, old_file, dtype):
    for seed in range(2):
        path = tmp_path / f"samples_{seed:010d}.pth"
        torch.save(image(seed).to(dtype), path, _use_new_zipfile_serialization=not old_file)
    samples = list(read_samples(tmp_path, SENSOR))
    assert [sample.name for sample in samples] == ["samples_0000000000", "samples_0000000001"]
    assert_is(samples[1], image(1).to(dtype).float())


@pytest.mark.parametrize("channels", [4, 5])  # without a reflectance channel it is (0, H, W)
@pytest.mark.parametrize("stacked", [False, True])
def test_dictionaries_of_r2flow(tmp_path, channels, stacked):
    images = torch.stack([image(seed, channels) for seed in range(2)])
    parts = {"depth": images[:, :1], "xyz": images[:, 1:4], "reflectance": images[:, 4:]}
    if stacked:
        torch.save(parts, tmp_path / "all.pth")
    else:
        for index in range(2):
            single = {key: part[index].clone() for key, part in parts.items()}
            torch.save(single, tmp_path / f"sample_{index}.pth")
    samples = list(read_samples(tmp_path, SENSOR))
    assert [sample.name for sample in samples] == (
        ["all/000000", "all/000001"] if stacked else ["sample_0", "sample_1"]
    )
    for sample, expected in zip(samples, images, strict=True):
        assert_is(sample, expected)


class Payload:
    def __reduce__(self):
        return print, ("executed",)


@pytest.mark.parametrize("width", [3, 4])
def test_a_stack_of_clouds_is_no_stack_of_images(tmp_path, width):
    clouds = 5 + np.random.default_rng(0).random((6, 40, width), np.float32)
    np.save(tmp_path / "a.npy", clouds)
    samples = list(read_samples(tmp_path / "a.npy", SENSOR))
    assert [sample.name for sample in samples] == [f"{i:06d}" for i in range(6)]
    for sample, cloud in zip(samples, clouds, strict=True):
        assert sample.range_m is None
        np.testing.assert_array_equal(sample.points, cloud)


@pytest.mark.parametrize("suffix", ["pcd", "pth", "npy", "npz"])
def test_no_file_runs_code(tmp_path, capsys, suffix):
    file = tmp_path / f"evil.{suffix}"
    objects = np.array([Payload()], dtype=object)
    if suffix == "pcd":
        file.write_bytes(pickle.dumps([Payload()]))
    elif suffix == "pth":
        torch.save([Payload()], file)
    else:
        {"npy": np.save, "npz": np.savez}[suffix](file, objects)
    reason = {"pcd": "is damaged or of another layout", "pth": "cannot be read as tensors alone"}
    with pytest.raises(ScanError, match=rf"evil\.{suffix}.*{reason.get(suffix, '(?i:object)')}"):
        list(read_samples(file, SENSOR))
    assert capsys.readouterr().out == ""


def changed(value, *index):
    stack = torch.stack([image(0), image(1)])
    stack[index] = value
    return stack.numpy()


def encoded(array, save=np.save):
    stream = io.BytesIO()
    save(stream, array)
    return stream.getvalue()


IMAGES, ONES = changed(0.0, 0, 4), np.ones((2, 5, 4, 8), np.float32)
CLOUD = encoded(np.random.default_rng(0).random((9, 4)), np.savez_compressed)
FLIPPED = CLOUD[:120] + bytes([CLOUD[120] ^ 255]) + CLOUD[121:]
BAD = {
    "empty file": ("a.txt", b"", r"a\.txt: is empty"),
    "other text": ("a.txt", b"model: r3dpa\n", r"a\.txt: is not text rows"),
    "ragged text": ("a.txt", b"1 2 3\n4 5\n", r"a\.txt: is not text rows"),
    "narrow text": ("a.txt", b"9 2\n4 5\n", r"a\.txt: has rows of 2 numbers; needs 3"),
    "NaN": ("a.txt", b"9 2 nan\n4 5 6\n", r"a\.txt: has NaN or inf.* 1 of 2 points"),
    "far": ("a.txt", b"0 0 99\n0 0 0.5", r"a\.txt: has no point within .* 1\.\.56 m"),
    "no point": ("a.npy", ONES[:0, 0, 0, :3], r"a\.npy: has no point within"),
    "no image": ("a.npy", ONES[:0], r"a\.npy: no sample .* empty"),
    "bytes": ("a.npy", ONES.astype(np.uint8), r"a\.npy: holds uint8 numbers; metres"),
    "vector": ("a.npy", np.ones(3), r"a\.npy: has shape \(3,\); needs \(P, 3\)"),
    "cut .npy": ("a.npy", encoded(ONES)[:-300], r"a\.npy: cannot be read as an array \(mmap len"),
    "cut .npz": ("a.npz", CLOUD[:-30], r"a\.npz: "),
    "damaged .npz": ("a.npz", FLIPPED, r"a\.npz.* is damaged"),
    "no member": ("a.npz", b"PK\x05\x06" + bytes(18), r"a\.npz: "),
    "no tensor": ("a.pth", {"model": {}}, r"a\.pth: cannot be .*; needs a tensor"),
    "no .pth": ("a.pth", b"\x80\x02", r"a\.pth: cannot be read as tensors alone"),
    "unlike parts": (
        "a.pth",
        {"depth": torch.ones(1, 4, 8), "xyz": torch.ones(3, 4, 9)},
        r"a\.pth: cannot be read as tensors alone \(Sizes",
    ),
    "channels": ("a.pth", torch.ones(3, 4, 8), r"a\.pth: has 3 channels; needs range"),
    "image size": (
        "a.pth",
        torch.ones(5, 8, 4),
        r"a\.pth: has an image of 8 x 4 pixels, but the sensor has 4 x 8; use images of",
    ),
    "encoded": ("a.npy", IMAGES[:, :1] / 56 - 1, r"000000: .*values go from -1 to 0\.07"),
    "NaN range": ("a.npy", changed(np.nan, 1, 0, 3), r"a\.npy, sample 000001: has NaN .* 8 pixels"),
    "NaN xyz": ("a.npy", changed(np.nan, 1, 2, 3), r"sample 000001: channel 0 is not .* 8 of"),
    "NaN intensity": ("a.npy", changed(np.nan, 0, 4, 3), r"000000: has NaN .* 8 pixels"),
    "order": ("a.npy", abs(IMAGES[:, [1, 2, 3, 0, 4]]), r"channel 0 is not the length"),
    "nothing": ("a.png", b"x", r"holds no samples; what can be read: clouds"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_file_is_named_with_what_was_found(tmp_path, kind):
    name, content, message = BAD[kind]
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    elif isinstance(content, np.ndarray):
        np.save(tmp_path / name, content)
    else:
        torch.save(content, tmp_path / name)
    with pytest.raises(ScanError, match=message) as caught:
        list(read_samples(tmp_path, SENSOR))
    assert str(tmp_path) in str(caught.value)


def test_every_suffix_that_can_be_read_is_named():
    assert {*_READERS, ".pcd.bin"} == set(re.findall(r"\.[a-z.]*[a-z]", READABLE))


def test_a_missing_path_is_named(tmp_path):
    with pytest.raises(ScanError, match="there is no such file or folder"):
        read_samples(tmp_path / "gone", SENSOR)


def test_bad_samples_are_counted_and_listed(tmp_path):
    stack = torch.stack([image(seed) for seed in range(4)])
    stack[1, 0] = torch.nan
    stack[2, 0] = 0
    np.savez(tmp_path / "a.npz", stack.numpy())
    (tmp_path / "b.npz").write_bytes(b"PK no archive")
    np.savez(tmp_path / "c.npz", image(5)[None].numpy())
    samples = read_samples(tmp_path, SENSOR, skip_bad=True)
    with pytest.warns(UserWarning, match=r"3 bad samples left out beside 3 good .*sample 000001"):
        names = [sample.name for sample in samples]
    assert names == ["a/000000", "a/000003", "c/000000"]
    assert [bad.partition(".npz")[0][-1] for bad in samples.bad] == ["a", "a", "b"]
    with pytest.raises(ScanError, match=r"a\.npz.*sample 000001: has NaN"):
        list(read_samples(tmp_path, SENSOR))


def test_only_bad_samples_are_an_error(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"123")
    with pytest.raises(ScanError, match=r"no sample can be used; all are bad; .*a\.bin: has 3 b"):
        list(read_samples(tmp_path, SENSOR, skip_bad=True))
