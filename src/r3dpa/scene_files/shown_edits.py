"""Edits that ``r3dpa gallery`` shows of its first scene."""

from __future__ import annotations

from functools import partial
from typing import cast

from torch import Tensor

from r3dpa.checkpoints import Checkpoint
from r3dpa.data import Extractor
from r3dpa.editing import SceneEditor, most_like_first, regions
from r3dpa.editing.objects import ObjectLibrary
from r3dpa.feature_names import OWN_WEIGHTS
from r3dpa.features import feature_source
from r3dpa.generation import SceneGenerator
from r3dpa.pretrained import OBJECTS_SUFFIX
from r3dpa.scenes import Scene

_CAR_CENTRE_M, _CAR_SIZE_M = (10.0, 0.0, -0.95), (4.2, 1.8, 1.5)
_CAR_DRAWS, _CARS_SHOWN = 8, 2


class ShownEdits:
    """Edits of a scene: a sector, dropped beams, variations and, with features of cars, a car.

    The features come from the file of objects beside the weights, if there is one.

    Args:
        generator: Generator of the scenes.
        checkpoint: Its checkpoint.
        seed: Edits depend on it.
        batch_size: Scenes generated together.
    """

    def __init__(
        self, generator: SceneGenerator, checkpoint: Checkpoint, seed: int, batch_size: int
    ) -> None:
        self.editor = SceneEditor(generator, batch_size=batch_size)
        self.projection = generator.geometry.projection
        self.grid_size = generator.sit.grid_size
        self.seed = seed
        self.car: Tensor | None = None
        self.car_class: int | None = None
        self.teacher: Extractor | None = None
        objects = checkpoint.path.with_suffix(OBJECTS_SUFFIX)
        if objects.is_file():
            feature_dim = generator.sit.feature_dim
            library = ObjectLibrary.load(objects)
            library.check_source(checkpoint.feature_source, feature_dim)
            if "car" in library.names:
                self.car, self.car_class = library.feature("car"), library.semantic_class("car")
            if library.source in OWN_WEIGHTS:
                teacher = feature_source(library.source, dim=feature_dim)
                self.teacher = cast(Extractor, teacher)

    def __call__(self, scene: Scene) -> dict[str, Tensor]:
        """Results ``(N, H, W)`` in metres of the edits of a scene, by what they show."""
        projection, seed = self.projection, self.seed
        street_ahead = regions.angle_box(projection, -30, 30, -25, 3)
        missing = regions.dropped_beams(projection, range(0, projection.sensor.beams, 2))
        results = {
            "ahead generated anew": self.editor.inpaint(scene, street_ahead, 2, seed).range_m,
            "every other beam filled": self.editor.complete(scene, missing, 1, seed).range_m,
            "varied": self.editor.vary(scene, 2, seed).range_m,
        }
        if self.car is not None:
            results["a car 10 m ahead"] = self._cars(scene, self.car)
        return results

    def _cars(self, scene: Scene, car: Tensor) -> Tensor:
        place = regions.box3d(self.projection, _CAR_CENTRE_M, _CAR_SIZE_M)
        front_m = regions.box3d_front_m(self.projection, _CAR_CENTRE_M, _CAR_SIZE_M)
        draws = self.editor.inpaint(
            scene, place, _CAR_DRAWS, self.seed, feature=car, front_m=front_m
        )
        if self.teacher is not None:
            inside = partial(regions.in_box3d, centre_m=_CAR_CENTRE_M, size_m=_CAR_SIZE_M)
            draws = most_like_first(
                draws, place, car, self.teacher, self.grid_size, inside, self.car_class
            )
        return draws.range_m[:_CARS_SHOWN]
