"""How straight the walls of scenes are: distance of neighbouring returns from their line.

    python tests/bench/wall_straightness.py --scenes runs/scenes --ckpt r3dpa-s \
        --data conf/r3dpa_s_2/data.yaml --num 500 --out walls.json

A window is 9 neighbouring returns of a beam, no lower than 0.8 m below the sensor, within 30 m and
without a step of 0.5 m between neighbours. Its residual is the RMS distance of the returns from
their line, seen from above; the figure is the median over all windows. Of scenes of
``r3dpa sample``, of held-out scans, and of these through the VAE: what the decoder costs. Ranges of
cached scans have 11 bits. 10 ms per scene.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch
from reconstruction_quality import held_out_pixels, reconstruct

from r3dpa.cli.features import read_data
from r3dpa.geometry import unproject
from r3dpa.scene_vae import SceneVAE

RETURNS = 9
LOWEST_M, FARTHEST_M, STEP_M = -0.8, 30.0, 0.5


def residuals_m(range_m, projection):
    """Residuals ``(R,)`` of all windows of a range image ``(H, W)``, metres."""
    points = unproject(range_m, projection).double()
    usable = (range_m > 0) & (range_m < FARTHEST_M) & (points[..., 2] > LOWEST_M)
    windows = range_m.unfold(1, RETURNS, 1)
    smooth = (windows.diff(dim=-1).abs() < STEP_M).all(dim=-1)
    chosen = usable.unfold(1, RETURNS, 1).all(dim=-1) & smooth
    plan = points[..., :2].unfold(1, RETURNS, 1)[chosen]  # (R, 2, 9)
    centred = plan - plan.mean(dim=-1, keepdim=True)
    (xx, xy), (_, yy) = (centred @ centred.mT / RETURNS).permute(1, 2, 0)
    least = (xx + yy - ((xx - yy).square() + 4 * xy.square()).sqrt()) / 2
    return least.clamp(min=0).sqrt()


def figures(images, projection):
    """Median residual in cm over the windows of all images, and how many there are."""
    each = torch.cat([residuals_m(image, projection) for image in images])
    return {"residual_cm": 100 * each.median().item(), "windows": len(each)}


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=Path, required=True, help="folder of r3dpa sample")
    parser.add_argument("--ckpt", default="r3dpa-s", help="weights with the VAE")
    parser.add_argument("--data", type=Path, required=True, help="data YAML with held-out scans")
    parser.add_argument("--num", type=int, default=500, help="scenes, and held-out scans")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    vae = SceneVAE.from_checkpoint(options.ckpt, "cpu")
    projection = vae.geometry.projection
    scenes = torch.from_numpy(np.load(options.scenes / "range_m.npy")[: options.num])
    pixels = list(held_out_pixels(read_data(options.data), options.num))
    pairs = [reconstruct(vae, [each]) for each in pixels]
    results = {
        "scenes": figures(scenes, projection),
        "held-out scans": figures([scans.range_m[0] for scans, _ in pairs], projection),
        "reconstructions": figures([made.range_m[0] for _, made in pairs], projection),
    }
    for name, found in results.items():
        sys.stdout.write(f"{name}: {found['residual_cm']:.2f} cm, {found['windows']:,} windows\n")
    if options.out is not None:
        about = {"returns": RETURNS, "lowest_m": LOWEST_M, "farthest_m": FARTHEST_M}
        about |= {"step_m": STEP_M, "scenes": len(scenes), "scans": len(pixels)}
        options.out.write_text(json.dumps({**about, "walls": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
