"""One page of generated scenes, their nearest training scans, edits and weather."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lidarsim import Semantic
from lidarsim.weather import Weather
from r3dpa.geometry import Projection, points_of, range_image
from r3dpa.io import number_of
from r3dpa.metrics.nearest import nearest_images
from r3dpa.viz.page import PageScan, Tile, scan_page
from r3dpa.viz.pictures import range_image_picture
from r3dpa.viz.scenes import categories

if TYPE_CHECKING:
    from r3dpa.data import LidarDataModule
    from r3dpa.generation import SceneGenerator
    from r3dpa.scenes import Scene

_WEATHERS = {
    "fog, 60 m": Weather(visibility_m=60),
    "rain, 20 mm/h": Weather(rain_mm_h=20, water_film_mm=0.5),
    "snow, 3 mm/h": Weather(snow_mm_h=3),
}


class GalleryPage:
    """Scans and tiles of the page, in the order in which they are added.

    Args:
        projection: Projection of all range images.
    """

    def __init__(self, projection: Projection) -> None:
        self.projection = projection
        self.scans: list[PageScan] = []
        self.tiles: dict[str, list[Tile]] = {}
        self.about: list[str] = []  # lines on top of the page

    def add(
        self,
        group: str,
        name: str,
        range_m: Tensor,
        note: str = "",
        nearest: Tensor | None = None,
        labels: Tensor | None = None,
    ) -> None:
        """Add a range image ``(H, W)`` in metres and the scan beside it, unless it is empty.

        ``labels`` are ``(P,)``, one for each return.
        """
        if not (range_m > 0).any():  # neither empty nor NaN
            return
        images = {"scene": range_m} if nearest is None else {"scene": range_m, "nearest": nearest}
        sensor = self.projection.sensor
        strips = {key: range_image_picture(image, sensor) for key, image in images.items()}
        self.tiles.setdefault(group, []).append(Tile(len(self.scans), note, strips))
        points = points_of(range_m, self.projection).numpy()
        numbers = None if labels is None else labels.numpy().astype(np.uint32)
        self.scans.append(PageScan(name, points, numbers))

    def html(self, title: str) -> str:
        """Return the page."""
        sensor = self.projection.sensor
        classes = categories(Semantic)
        return scan_page(self.scans, title, classes, {}, None, sensor, self.tiles, self.about)


def gallery_page(
    generator: SceneGenerator,
    source: str,
    num: int,
    edit: Callable[[Scene], Mapping[str, Tensor]],
    data: LidarDataModule | None = None,
    seed: int = 0,
    batch_size: int = 8,
) -> GalleryPage:
    """Generate scenes, edits of the first one, and weather in it.

    Args:
        generator: Makes the scenes.
        source: Name of its weights, for the text.
        num: Number of scenes.
        edit: Edits of a scene: results ``(N, H, W)`` in metres by name.
        data: Training data, set up for a fit, whose nearest scans are shown; None shows none.
        seed: Scenes and edits depend on it.
        batch_size: Scenes made together.
    """
    projection = generator.geometry.projection
    page = GalleryPage(projection)
    firsts = tqdm(range(0, num, batch_size), "scenes", unit="batch", disable=None)
    batches = [generator.generate(range(f, min(f + batch_size, num)), seed) for f in firsts]
    scenes = [scene for batch in batches for scene in batch]
    scenes_m = torch.stack([scene.range_m.cpu() for scene in scenes])
    labels = [None if scene.labels is None else scene.point_labels for scene in scenes]
    page.about.append(
        f"{source}: {number_of(num, 'scene')} in seed order, {batches[0].nfe} evaluations each."
    )
    if data is None:
        for number, range_m in enumerate(scenes_m):
            page.add("Scenes", f"seed {number}", range_m, labels=labels[number])
    else:
        page.about.append(_add_with_nearest(page, scenes_m, labels, data))
    for name, results_m in edit(scenes[0]).items():
        for range_m in results_m:
            page.add("Edits of seed 0", name, range_m)
    points = points_of(scenes_m[0], projection)
    for name, weather in _WEATHERS.items():
        range_m = range_image(weather.apply(points, seed), projection)[0]
        page.add("Weather in seed 0", name, range_m)
    return page


def _add_with_nearest(
    page: GalleryPage, scenes_m: Tensor, labels: Sequence[Tensor | None], data: LidarDataModule
) -> str:
    """Add scenes beside their nearest training scans; return the median distances as a line."""
    held_out_m = next(data.val_set.ranges_m(len(scenes_m)), scenes_m[:0])
    references = data.train_set.ranges_m(256)
    batches = tqdm(references, "training scans", unit_scale=256, unit="scan", disable=None)
    distance, nearest = nearest_images(torch.cat([scenes_m, held_out_m]), batches)
    for number, range_m in enumerate(scenes_m):
        note = f"nearest training scan at {distance[number]:.2f}"
        beside = data.train_set.range_m(int(nearest[number]))
        page.add("Scenes", f"seed {number}", range_m, note, beside, labels[number])
    of_scenes, of_held_out = distance.split([len(scenes_m), len(held_out_m)])
    return (
        f"Median distance to the nearest of {len(data.train_set)} training scans: "
        f"{of_scenes.median():.2f}, of held-out scans {of_held_out.median():.2f} "
        "(log2 of the range)."
    )
