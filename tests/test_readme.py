"""The Python of the README runs, its layout links to definitions, paths in documents exist."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tiny_networks import tiny_checkpoint

from r3dpa import pretrained
from r3dpa.data import write_bin

TOP = Path(__file__).resolve().parents[1]
README = TOP / "README.md"
# What a reader of the paper looks for, and a definition in the file that the layout table links.
ANSWERS = {
    "spherical projection": "class SphericalProjection",
    "log2 encoding": "class RangeCodec",
    "pooling to 8 x 64": "def pool_cells",
    "interpolant": "class Interpolant",
    "Euler-Maruyama": "def euler_maruyama",
    "alignment loss": "def alignment_loss",
    "circular convolution": "class CircularConv2d",
    "posterior and KL": "class Posterior",
    "SiT block": "class SiTBlock",
    "latent norm": "class LatentNorm",
    "EMA": "class EMA",
    "FWID": "FWID and FGEO are",
}


def test_python_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "_FOLDER", tmp_path)
    tiny_checkpoint(tmp_path / "r3dpa-s.safetensors")
    points = np.random.default_rng(0).normal(size=(4000, 4)).astype(np.float32) * 10
    points[:, 3] = 0.5
    for place in ("scan.bin", "scans/0.bin", "runs/demo/scenes/bin/0.bin"):
        write_bin(tmp_path / place, points)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names: dict = {}
    for block in blocks:
        exec(block, names)  # noqa: S102
    assert names["scenes"].range_m.shape[0] == 4
    assert names["jsd"] == 0
    assert names["image_m"].shape == (64, 1024)


@pytest.mark.parametrize(("question", "definition"), ANSWERS.items())
def test_layout_table_links_to_the_definition(question, definition):
    layout = README.read_text().partition("## Layout")[2]
    link = re.search(rf"\[{question}\]\(([^)]+)\)", layout)
    assert link, question
    assert definition in (TOP / link[1]).read_text()


@pytest.mark.parametrize(
    "name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "notebooks/LOG.md"]
)
def test_links_and_paths_of_documents_exist(name):
    document = TOP / name
    text = document.read_text()
    for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (document.parent / link).exists(), link
    if name == "CONTRIBUTING.md":
        roots = (TOP, TOP / "src", TOP / "src/r3dpa", TOP / "src/lidarsim")
        for path in re.findall(r"`([\w.]+/[\w./]*)`", text):
            built = path.startswith("build/")
            assert built or any((root / path).exists() for root in roots), path


def test_another_seed_changes_the_first_weights_too():
    keys = ("seed_everything", "model.init_args.seed", "data.init_args.seed")
    assert " ".join(f"--{key} 1" for key in keys) in README.read_text()
