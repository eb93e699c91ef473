import torch
from classifier_saliency import RANGE_M, layout, returns_alone, texture, without_gaps

# Two blocks of 4 x 8 pixels: ranges 4 and 16 m in turn, and 9 m; a gap of two pixels in row 1.
IMAGE = torch.tensor([4.0, 16.0] * 4 + [9.0] * 8).expand(1, 4, 16).clone()
IMAGE[0, 1, 9:11] = -1.0


def test_returns_alone_keep_only_where_there_is_one():
    alone = returns_alone(IMAGE)
    assert torch.equal(alone > 0, IMAGE > 0)
    assert set(alone.unique().tolist()) == {-1.0, RANGE_M}


def test_gaps_take_the_return_before_them_around_the_turn():
    assert torch.equal(without_gaps(IMAGE)[0, 1], IMAGE[0, 0])
    first = IMAGE.clone()
    first[0, 2, :2] = -1.0
    assert without_gaps(first)[0, 2, :2].tolist() == [9.0, 9.0]  # the last return of the ring


def test_layout_and_texture_are_the_mean_of_a_block_and_what_differs_from_it():
    coarse, fine = layout(IMAGE), texture(IMAGE)
    torch.testing.assert_close(coarse[..., :8], torch.full((1, 4, 8), 8.0))  # sqrt(4 * 16)
    torch.testing.assert_close(coarse[..., 8:], torch.full((1, 4, 8), 9.0))
    torch.testing.assert_close(coarse * fine / RANGE_M, without_gaps(IMAGE))
