"""Scenes and scans as files: the work of ``r3dpa sample``, ``edit``, ``data weather`` and others.

:mod:`~r3dpa.scene_files.options` can be imported without torch.
"""
