"""Editing of scans: regions, gaps, latents, objects, and the editor that uses them."""

from r3dpa.editing.editor import EditResult, EditSettings, SceneEditor

__all__ = ["EditResult", "EditSettings", "SceneEditor"]
