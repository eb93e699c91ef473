"""Callbacks of the trainer: checkpoints, pictures, scores, snapshots, step guard."""

from r3dpa.callbacks.checkpointing import AtomicCheckpointIO, RunCheckpoint
from r3dpa.callbacks.pictures import PictureLogger, ReconstructionWriter
from r3dpa.callbacks.scene_scoring import SceneScorer
from r3dpa.callbacks.snapshots import EMASnapshots
from r3dpa.callbacks.step_guard import StepGuard

__all__ = [
    "AtomicCheckpointIO",
    "EMASnapshots",
    "PictureLogger",
    "ReconstructionWriter",
    "RunCheckpoint",
    "SceneScorer",
    "StepGuard",
]
