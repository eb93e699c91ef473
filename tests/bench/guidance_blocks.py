"""Which block of a SiT to perturb: distance of scenes by block and strength of guidance.

    python tests/bench/guidance_blocks.py --ckpt runs/r3dpa_s_2/joint/checkpoints/last.ckpt \
        --reference runs/r3dpa_s_2/reference.safetensors --blocks 3 4 5 6 --scales 1.5 2 \
        --num 200 --out blocks.json

Perturbed-attention guidance, the same noise for all, beside no guidance. What wins is recorded by
``guidance`` of the YAML of the next stage (conf/r3dpa_s_2/few_step.yaml), whose checkpoint
``r3dpa convert`` exports. 200 scenes take five minutes of a core for each row.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from r3dpa.flow import PerturbedAttention
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.generation import SceneGenerator
from r3dpa.metrics.evaluation import evaluate, load_reference, reference_spaces
from r3dpa.metrics.scene import EvaluationScene

BATCH = 8


def scenes_of(generator, num):
    """Scenes in order, as the evaluation reads them."""
    for first in range(0, num, BATCH):
        numbers = range(first, min(first + BATCH, num))
        for number, range_m in zip(numbers, generator.generate(numbers).range_m, strict=True):
            yield EvaluationScene(f"{number:06d}", None, range_m.cpu())


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--ckpt", required=True)
    parser.add_argument(
        "--reference", type=Path, required=True, help="file of r3dpa data reference"
    )
    parser.add_argument("--blocks", type=int, nargs="+", required=True)
    parser.add_argument("--scales", type=float, nargs="+", default=[1.5])
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--num", type=int, default=200)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    reference = load_reference(options.reference)
    spaces = reference_spaces(reference, None, None, "cpu")
    plain = SceneGenerator.from_checkpoint(
        options.ckpt, SamplerConfig("ab3", options.steps, shift=2.5), device="cpu", guidance_scale=1
    )
    settings = [None]
    settings += [PerturbedAttention(b, s) for b in options.blocks for s in options.scales]
    rows = []
    for guidance in settings:
        generator = SceneGenerator(
            plain.vae,
            plain.sit,
            plain.latent_norm,
            plain.geometry,
            plain.sampler,
            plain.interpolant.path,
            guidance=guidance,
        )
        scenes = scenes_of(generator, options.num)
        found = evaluate(scenes, reference, spaces, label="", allow_few=True).evaluation
        row = {"block": guidance and guidance.block, "scale": guidance and guidance.scale}
        row |= {r.name: [r.value, r.interval] for r in found.rows if r.value is not None}
        rows.append(row)
        named = [f"{s.label} {row[s.label][0]:.4f}" for s in spaces]
        sys.stdout.write(f"block {row['block']}, scale {row['scale']}: {', '.join(named)}\n")
    if options.out is not None:
        about = {"scenes": options.num, "steps": options.steps}
        options.out.write_text(json.dumps({**about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
