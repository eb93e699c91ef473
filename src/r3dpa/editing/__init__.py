"""Editing of scans: regions, gaps, latents, objects, and the editor that uses them."""

from r3dpa.editing.editor import EditResult, EditSettings, SceneEditor
from r3dpa.editing.objects import most_like_first

__all__ = ["EditResult", "EditSettings", "SceneEditor", "most_like_first"]
