"""Which pixels of a scan completions may fill, and how far they are off."""

import torch

from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.scene_files.completions import _occupied, held_out_errors

PROJECTION = SphericalProjection(LidarSensor(beams=8, columns=16))


def test_points_out_of_view_and_at_the_origin_occupy_no_pixel():
    ahead, above, origin = [10.0, 0.0, -1.0], [1.0, 0.0, 10.0], [0.0, 0.0, 0.0]
    occupied = _occupied(torch.tensor([ahead, above, origin]), PROJECTION)
    row, column = PROJECTION.pixel_of(torch.tensor(ahead))
    assert occupied.nonzero().tolist() == [[row, column]]


def test_no_common_return_gives_no_errors():
    """The only missing pixel with a return is one that the completion leaves empty."""
    range_m = torch.full((8, 16), 10.0)
    missing = torch.zeros(8, 16, dtype=torch.bool)
    missing[3, 4] = True
    completed = torch.where(missing, -1.0, range_m)[None]
    assert held_out_errors(completed, range_m, missing) == {}
    assert held_out_errors(range_m[None], range_m, missing)["completed"]["mae_m"] == 0
