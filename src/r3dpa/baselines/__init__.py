"""The paper's competitors, R2DM, R2Flow and LiDM, on the data, solvers and commands of r3dpa."""

from r3dpa.baselines.adm_unet import ADMUNet
from r3dpa.baselines.base import AveragedNetwork, Baseline
from r3dpa.baselines.efficient_unet import EfficientUNet
from r3dpa.baselines.generator import BaselineGenerator
from r3dpa.baselines.hdit import HDiT
from r3dpa.baselines.lidm import LiDM
from r3dpa.baselines.lidm_first_stage import LiDMFirstStage
from r3dpa.baselines.r2dm import R2DM
from r3dpa.baselines.r2flow import R2Flow
from r3dpa.baselines.reflow import ReflowPairs
from r3dpa.baselines.stages import BASELINES, baseline_generator, baseline_of

__all__ = [
    "BASELINES",
    "R2DM",
    "ADMUNet",
    "AveragedNetwork",
    "Baseline",
    "BaselineGenerator",
    "EfficientUNet",
    "HDiT",
    "LiDM",
    "LiDMFirstStage",
    "R2Flow",
    "ReflowPairs",
    "baseline_generator",
    "baseline_of",
]
