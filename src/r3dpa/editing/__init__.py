"""Editing of scans: regions, gaps, latents, objects, and the editor that uses them."""

from r3dpa.editing.editor import EditResult, SceneEditor
from r3dpa.editing.objects import most_like_first
from r3dpa.editing.settings import EditSettings

__all__ = ["EditResult", "EditSettings", "SceneEditor", "most_like_first"]
