"""Weights of an RGB model in a network for range images."""

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from whole_checkpoint import EXACT, GEOMETRY, SIT_ARGS, randomised

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    load_into,
    transfer_rgb,
    with_projector_of,
)
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.unet import UNet


class TestTransfer:
    def source(self, **changes):
        args = {**SIT_ARGS, **changes}
        norm_args = {"channels": args["in_channels"]}
        networks = {
            "sit": NetworkState.of(randomised(SiT(**args)), args),
            "latent_norm": NetworkState.of(randomised(LatentNorm(**norm_args)), norm_args),
        }
        return Checkpoint(Path("rgb.pt"), "rgb", networks)

    def results(self, report):
        return {row.group: row.result for row in report}

    def test_a_network_of_the_same_size_keeps_all_weights(self):
        source, sit, norm = self.source(), SiT(**SIT_ARGS), LatentNorm(4)
        report = transfer_rgb(source, sit, norm, keep_projector=True)
        assert set(self.results(report).values()) == {"kept"}
        torch.testing.assert_close(sit.state_dict(), source.network("sit").state_dict, **EXACT)
        norm_there = source.network("latent_norm").state_dict
        assert torch.equal(norm.running_mean, norm_there["running_mean"])

    def test_patches_of_two_rows_and_one_column_are_kept(self):
        """As many tokens as patches of 2 x 2 give on square images."""
        args = {**SIT_ARGS, "patch_size": [2, 1]}
        sit = randomised(SiT(**args))
        report = transfer_rgb(self.source(patch_size=[2, 1]), sit, LatentNorm(4), True)
        assert set(self.results(report).values()) == {"kept"}
        report = transfer_rgb(
            self.source(patch_size=[2, 1], input_size=(8, 8)), sit, LatentNorm(4), True
        )
        assert self.results(report)["pos_embed"] == "resized"

    @pytest.mark.parametrize(
        ("changes", "expected"),
        [
            # a new head may look at another block; as many tokens in another grid
            ({"feature_dim": 5, "alignment_depth": 1}, {"projector": "fresh"}),
            ({"input_size": (8, 4)}, {"pos_embed": "resized"}),
            (
                {"patch_size": 1},
                {"x_embedder": "fresh", "final_layer.linear": "fresh", "pos_embed": "resized"},
            ),
        ],
    )
    def test_layers_that_do_not_fit_are_fresh(self, changes, expected):
        sit = randomised(SiT(**SIT_ARGS))
        before = {key: value.clone() for key, value in sit.state_dict().items()}
        rows = transfer_rgb(self.source(**changes), sit, LatentNorm(4), True)
        assert {row.group: row.result for row in rows if row.result != "kept"} == expected
        for key, value in sit.state_dict().items():
            assert torch.equal(value, before[key]) == key.startswith(tuple(expected)), key

    @pytest.mark.parametrize(("rows_there", "rows_here"), [(1001, 1), (1, 1), (2, 2)])
    def test_label_tables_of_other_lengths(self, rows_there, rows_here):
        def labels(rows):
            return {"num_classes": max(1, rows - 1), "class_dropout": rows > 1}

        source = self.source(**labels(rows_there))
        sit = randomised(SiT(**SIT_ARGS | labels(rows_here)))
        key = "y_embedder.embedding_table.weight"
        table = source.network("sit").state_dict[key]
        report = transfer_rgb(source, sit, LatentNorm(4), keep_projector=False)
        assert torch.equal(sit.state_dict()[key], table[:rows_here])
        kept = rows_there == rows_here
        assert self.results(report)["y_embedder"] == ("kept" if kept else "truncated")

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"depth": 4}, "unknown to the network: blocks.3"),
            ({"depth": 2}, "missing in the checkpoint: blocks.2"),
            ({"alignment_depth": 1}, "alignment_depth: checkpoint 1, network 2"),
            (
                {"hidden_size": 16, "num_classes": 2},  # label tables of other lengths and widths
                r"shape of y_embedder.embedding_table.weight: checkpoint \(2, 16\), network \(4, 8",
            ),
        ],
    )
    def test_other_differences_are_an_error_before_any_change(self, changes, message):
        sit = SiT(**SIT_ARGS | ({"num_classes": 4} if "num_classes" in changes else {}))
        before = copy.deepcopy(sit.state_dict())
        with pytest.raises(ValueError, match=message):
            transfer_rgb(self.source(**changes), sit, LatentNorm(4), keep_projector=True)
        torch.testing.assert_close(sit.state_dict(), before, **EXACT)

    def test_another_width_of_attention_heads_fits_but_computes_something_else(self):
        args = {"in_channels": 4, "input_size": (4, 8), "channels": 32, "feature_dim": 8}
        state = NetworkState.of(UNet(**args, head_channels=16), args | {"head_channels": 16})
        with pytest.raises(ValueError, match="head_channels: checkpoint 16, network 32"):
            load_into(
                {"sit": UNet(**args)}, Checkpoint(Path("unet"), "joint", {"sit": state}), "joint"
            )

    def test_weights_of_range_images_are_none_of_rgb(self):
        source = replace(self.source(), stage="joint", geometry=GEOMETRY.to_dict())
        sit = randomised(SiT(**SIT_ARGS))
        before = copy.deepcopy(sit.state_dict())
        with pytest.raises(
            ValueError, match=r"rgb\.pt is of stage joint .* range images: .*init_f"
        ):
            transfer_rgb(source, sit, LatentNorm(4), keep_projector=True)
        torch.testing.assert_close(sit.state_dict(), before, **EXACT)

    def test_only_a_sit_has_rgb_weights(self):
        args = {"in_channels": 4, "input_size": (4, 8), "channels": 32, "feature_dim": 8}
        networks = {
            "sit": NetworkState.of(UNet(**args), args),
            "latent_norm": NetworkState.of(LatentNorm(4), {"channels": 4}),
        }
        source = Checkpoint(Path("unet.ckpt"), "flow_matching", networks)
        with pytest.raises(ValueError, match=r"unet\.ckpt holds a UNet, but .* to a SiT"):
            transfer_rgb(source, SiT(**SIT_ARGS), LatentNorm(4), keep_projector=False)


class TestProjectionHead:
    """An aligned run starts from weights that were trained without features."""

    def source(self, **facts):
        networks = {"ema": NetworkState.of(randomised(SiT(**SIT_ARGS)), SIT_ARGS)}
        return Checkpoint(Path("unaligned.safetensors"), "few_step", networks, **facts)

    @pytest.mark.parametrize(
        "changes",
        [{"feature_dim": 5}, {"alignment_depth": 1}, {"projector": "conv"}],
        ids=lambda changes: next(iter(changes)),
    )
    def test_is_that_of_the_run_where_the_other_does_not_fit(self, changes):
        source = self.source()
        sit = randomised(SiT(**SIT_ARGS | changes))
        head = copy.deepcopy(sit.projector.state_dict())
        load_into({"sit": sit}, with_projector_of(source, sit, aligns=True), "flow_matching")
        torch.testing.assert_close(sit.projector.state_dict(), head, **EXACT)
        for key, value in source.network("ema").state_dict.items():
            if not key.startswith("projector."):
                assert torch.equal(sit.state_dict()[key], value), key

    def test_is_kept_where_it_fits(self):
        source = self.source()
        sit = SiT(**SIT_ARGS)
        assert with_projector_of(source, sit, aligns=True).networks == source.networks

    @pytest.mark.parametrize(
        "facts", [{"feature_source": "scalr"}, {}], ids=["aligned", "official"]
    )
    def test_that_has_learned_is_refused_in_a_run_that_aligns(self, facts):
        source = self.source(**facts)
        if not facts:
            source = replace(source, stage="official")
        sit = SiT(**SIT_ARGS | {"feature_dim": 5})
        with pytest.raises(ValueError, match="projector"):
            load_into({"sit": sit}, with_projector_of(source, sit, aligns=True), "flow_matching")
        load_into({"sit": sit}, with_projector_of(source, sit, aligns=False), "flow_matching")
