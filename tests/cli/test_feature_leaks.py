"""Features made from labels: recorded wherever they go, and refused where numbers are reported."""

from __future__ import annotations

import json
import warnings

import pytest

from r3dpa.checkpoints import leaks_labels, read_checkpoint, refuse_leak
from r3dpa.cli import main

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")

ORACLE = {"class_path": "r3dpa.nn.backbones.OracleFeatures", "init_args": {"dim": 16}}
ORACLE_DATA = ["--data.init_args.extractor", json.dumps(ORACLE)]
NO_GRIDS = ["--data.init_args.extractor=null"]
QUIET = ["--trainer.logger=false", "--trainer.limit_val_batches=1", "--trainer.callbacks=[]"]
READ_THE_LABELS = r"made with features of 'oracle', which read the labels.*--allow_oracle"


def train(arguments):
    """Runs a fit; the warnings that name the labels."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        main(arguments)
    return [str(each.message) for each in caught if "read the labels" in str(each.message)]


@pytest.fixture(scope="module")
def oracle_run(smoke_args, tmp_path_factory):
    """Run of the VAE-alignment stage on the oracle's grids."""
    run_dir = tmp_path_factory.mktemp("oracle")
    found = train(smoke_args("vae_alignment", run_dir, *ORACLE_DATA, *QUIET))
    assert len(found) == 1
    return run_dir


@pytest.fixture(scope="module")
def oracle_checkpoint(oracle_run):
    return oracle_run / "checkpoints" / "last.ckpt"


@pytest.fixture
def evaluate(smoke_args):
    """``evaluate(command, checkpoint, *more)``"""

    def run(command, run_dir, checkpoint, *more):
        arguments = smoke_args("vae_alignment", run_dir, *QUIET, "--ckpt_path", str(checkpoint))
        main([command, *arguments[1:], *more])

    return run


def test_the_rule():
    assert [leaks_labels(name) for name in ("oracle", "scalr", None)] == [True, False, False]
    with pytest.raises(ValueError, match=rf"^scenes/: {READ_THE_LABELS}"):
        refuse_leak("oracle", "scenes/")
    refuse_leak("oracle", "scenes/", allow=True)
    refuse_leak("geometric", "scenes/")
    refuse_leak(None, "scenes/")


def test_checkpoints_tell_the_feature_source(oracle_checkpoint, vae_checkpoint, tmp_path):
    assert read_checkpoint(oracle_checkpoint).feature_source == "oracle"
    assert read_checkpoint(vae_checkpoint).feature_source == "geometric"
    main(["convert", str(oracle_checkpoint), str(tmp_path / "ours.safetensors")])
    assert read_checkpoint(tmp_path / "ours.safetensors").feature_source == "oracle"


@pytest.mark.parametrize("command", ["validate", "test"])
def test_metrics_are_refused_unless_asked_for(
    command, evaluate, oracle_run, oracle_checkpoint, vae_checkpoint, tmp_path, capsys
):
    with pytest.raises(ValueError, match=rf"^the feature grids of the data: {READ_THE_LABELS}"):
        evaluate(command, tmp_path, vae_checkpoint, *ORACLE_DATA)
    with pytest.raises(ValueError, match=rf"^the model of .*last.ckpt: {READ_THE_LABELS}"):
        evaluate(command, tmp_path, oracle_checkpoint)  # on geometric features
    with pytest.raises(ValueError, match=rf"^the model of .*last.ckpt: {READ_THE_LABELS}"):
        evaluate(command, oracle_run, "last")  # a word instead of a file
    assert "range_error_m" not in capsys.readouterr().out
    evaluate(command, tmp_path, oracle_checkpoint, *ORACLE_DATA, "--allow_oracle")
    evaluate(command, tmp_path, oracle_checkpoint, "--allow-oracle=true")
    assert capsys.readouterr().out.count("range_error_m") == 2


def test_what_reports_no_metrics_is_not_refused(evaluate, oracle_checkpoint, tmp_path, capsys):
    evaluate("predict", tmp_path, oracle_checkpoint)
    with pytest.raises(SystemExit):
        evaluate("predict", tmp_path, oracle_checkpoint, "--allow_oracle")
    assert "allow_oracle" in capsys.readouterr().err


def test_a_later_stage_does_not_undo_the_leak(smoke_args, oracle_checkpoint, tmp_path):
    """Neither one without features nor one with others, nor a resume; and its scenes tell it."""
    flow, joint = tmp_path / "flow", tmp_path / "joint"
    start = ["--model.init_args.init_from", str(oracle_checkpoint), *QUIET]
    assert train(smoke_args("flow_matching", flow, *start, *NO_GRIDS))
    assert read_checkpoint(flow / "checkpoints/last.ckpt").feature_source == "oracle"
    assert train(smoke_args("joint", joint, *start))
    last = joint / "checkpoints/last.ckpt"
    assert read_checkpoint(last).feature_source == "oracle"
    more = ["--ckpt_path", str(last), "--trainer.max_steps=4"]
    assert train(smoke_args("joint", joint, *QUIET, *more))
    assert read_checkpoint(last).step == 4
    assert read_checkpoint(last).feature_source == "oracle"
    out = tmp_path / "scenes"
    main(["sample", "--ckpt", str(last), "--out", str(out), "--num", "1", "--steps", "2"])
    assert json.loads((out / "metadata.json").read_text())["feature_source"] == "oracle"


def test_a_stage_without_grids_has_no_feature_source(smoke_args, vae_checkpoint, tmp_path):
    start = ["--model.init_args.init_from", str(vae_checkpoint), *QUIET, *NO_GRIDS]
    assert not train(smoke_args("flow_matching", tmp_path, *start))
    assert read_checkpoint(tmp_path / "checkpoints/last.ckpt").feature_source is None
