import numpy as np
import pytest
import torch
from PIL import Image

from r3dpa.data.images import read_mask


def drawn(path, values, mode=None):
    Image.fromarray(np.asarray(values), mode).save(path)
    return path


def test_bright_and_opaque_pixels_are_selected(tmp_path, sensor):
    grey = np.zeros((8, 32), np.uint8)
    grey[2, 3], grey[7, 31], grey[0, 0] = 255, 128, 127
    expected = torch.zeros(8, 32, dtype=torch.bool)
    expected[2, 3] = expected[7, 31] = True
    assert read_mask(drawn(tmp_path / "grey.png", grey), sensor).equal(expected)
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.png")
    assert read_mask(tmp_path / "palette.png", sensor).equal(expected)
    assert read_mask(drawn(tmp_path / "one_bit.png", grey > 127), sensor).equal(expected)

    red = np.zeros((8, 32, 4), np.uint8)
    red[..., 3] = 255
    red[2, 3, 0] = red[7, 31, 0] = 255  # red on black, as the paper draws masks
    red[4, 4] = (255, 255, 255, 0)  # white, but transparent
    assert read_mask(drawn(tmp_path / "red.png", red), sensor).equal(expected)


def test_a_picture_that_is_no_mask_is_named(tmp_path, sensor):
    small = drawn(tmp_path / "small.png", np.zeros((4, 32), np.uint8))
    with pytest.raises(ValueError, match=r"small\.png: has 4 x 32 pixels .* image 8 x 32"):
        read_mask(small, sensor)
    deep = drawn(tmp_path / "deep.png", np.zeros((8, 32), np.uint16))
    with pytest.raises(ValueError, match=r"deep\.png: has pixels of type I"):
        read_mask(deep, sensor)
    cut = tmp_path / "cut.png"
    cut.write_bytes(drawn(tmp_path / "a.png", np.full((8, 32), 255, np.uint8)).read_bytes()[:50])
    text = tmp_path / "text.png"
    text.write_text("no picture")
    array = tmp_path / "mask.npy"
    np.save(array, np.ones((8, 32), bool))
    for path in (cut, text, array, tmp_path / "absent.png", tmp_path):
        with pytest.raises(
            ValueError,
            match=f"{path.name}: cannot be read as a picture .*; give a picture, such as a .png, "
            "of 8 x 32 pixels",
        ):
            read_mask(path, sensor)
