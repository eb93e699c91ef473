"""Training stages and feature extraction as LightningModules."""

from r3dpa.modules.base import GenerativeModule
from r3dpa.modules.feature_extraction import FeatureExtraction
from r3dpa.modules.few_step import FewStep
from r3dpa.modules.flow_matching import FlowMatching
from r3dpa.modules.image_vae import ImageVAETraining
from r3dpa.modules.joint_alignment import JointAlignment
from r3dpa.modules.point_pretraining import PointPretraining
from r3dpa.modules.point_segmentation import PointSegmentation
from r3dpa.modules.rgb_pretraining import RGBPretraining
from r3dpa.modules.settings import LossWeights, OptimizerConfig
from r3dpa.modules.vae_alignment import VAEAlignment

__all__ = [
    "FeatureExtraction",
    "FewStep",
    "FlowMatching",
    "GenerativeModule",
    "ImageVAETraining",
    "JointAlignment",
    "LossWeights",
    "OptimizerConfig",
    "PointPretraining",
    "PointSegmentation",
    "RGBPretraining",
    "VAEAlignment",
]
