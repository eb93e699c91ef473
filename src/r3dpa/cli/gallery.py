"""``r3dpa gallery``: one page of generated scenes, their nearest scans, edits and weather."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jsonargparse.typing import NonNegativeInt, PositiveInt

from r3dpa.cli.parser import check_file
from r3dpa.pretrained import DEFAULT_WEIGHTS


def gallery(
    *,
    out: Path,
    ckpt: Path = Path(DEFAULT_WEIGHTS),
    num: PositiveInt = 64,
    data: Path | None = None,
    quality: Literal["draft", "good", "best"] = "good",
    seed: NonNegativeInt = 0,
    batch_size: PositiveInt = 8,
    device: str = "auto",
) -> str:
    """Write one page of scenes in order, none left out, with clouds to turn.

    Beside each scene its nearest training scan shows what is memorised. Edits of the first scene
    and fog, rain and snow in it follow.

    Args:
        out: HTML file to write.
        ckpt: Checkpoint of stage joint or flow_matching, a name of ``r3dpa models``, or
            ``hf://owner/name``.
        num: Number of scenes.
        data: Training data, a folder of scans or a data YAML; default: no nearest scans.
        quality: Sampler of the scenes.
        seed: Number of the collection; the scenes are its first ones.
        batch_size: Scenes made together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from functools import partial

    import torch
    from tqdm import tqdm

    from lidarsim.weather import Weather
    from r3dpa import viz
    from r3dpa.cli.features import read_data
    from r3dpa.editing import SceneEditor, regions
    from r3dpa.generation import SceneGenerator
    from r3dpa.geometry import points_of, range_image
    from r3dpa.io import usable_device, write_text
    from r3dpa.metrics.nearest import nearest_images

    check_file(out)
    generator = SceneGenerator.from_checkpoint(ckpt, quality, device=usable_device(device))
    projection = generator.geometry.projection
    module = None if data is None else read_data(data)
    if module is not None:
        module.setup("fit")
        if module.sensor != projection.sensor:
            raise ValueError(f"{data}: is of another sensor than {ckpt}: {module.sensor}")
    picture = partial(viz.range_image_picture, sensor=projection.sensor)
    scans: list[viz.PageScan] = []
    tiles: dict[str, list[viz.Tile]] = {}

    def show(
        group: str, name: str, range_m: torch.Tensor, note: str = "", **beside: torch.Tensor
    ) -> None:
        if not (range_m > 0).any():  # neither empty nor NaN
            return
        strips = {name: picture(image) for name, image in {"scene": range_m, **beside}.items()}
        tiles.setdefault(group, []).append(viz.Tile(len(scans), note, strips))
        scans.append(viz.PageScan(name, points_of(range_m, projection).numpy()))

    firsts = tqdm(range(0, num, batch_size), "scenes", unit="batch", disable=None)
    parts = [generator.generate(range(f, min(f + batch_size, num)), seed) for f in firsts]
    made = torch.cat([part.range_m.cpu() for part in parts])
    about = [f"{ckpt}: {num} scenes in the order of their seeds, {parts[0].nfe} evaluations each."]
    if module is None:
        for number, range_m in enumerate(made):
            show("Scenes", f"seed {number}", range_m)
    else:
        train, held_out = module.train_set.ranges_m, module.val_set.ranges_m
        held_out_m = next(held_out(num), made[:0])
        batches = tqdm(train(256), "training scans", unit_scale=256, unit="scan", disable=None)
        distance, nearest = nearest_images(torch.cat([made, held_out_m]), batches)
        for number, range_m in enumerate(made):
            note = f"nearest training scan at {distance[number]:.2f}"
            beside = module.train_set.range_m(int(nearest[number]))
            show("Scenes", f"seed {number}", range_m, note, nearest=beside)
        medians = [part.median() for part in distance.split([num, len(held_out_m)])]
        about.append(
            f"Median distance to the nearest of {len(module.train_set)} training scans: "
            f"{medians[0]:.2f}, of held-out scans {medians[1]:.2f} (log2 of the range)."
        )
    editor, scene = SceneEditor(generator, batch_size=batch_size), made[0]
    ahead = regions.angle_box(projection, -30, 30, -25, 3)
    beams = regions.dropped_beams(projection, range(0, projection.sensor.beams, 2))
    edits = {
        "ahead generated anew": editor.inpaint(scene, ahead, 2, seed),
        "every other beam filled": editor.complete(scene, beams, 1, seed),
        "varied": editor.vary(scene, 2, seed),
    }
    for name, result in edits.items():
        for range_m in result.range_m:
            show("Edits of seed 0", name, range_m)
    weathers = {
        "fog, 60 m": Weather(visibility_m=60),
        "rain, 20 mm/h": Weather(rain_mm_h=20, water_film_mm=0.5),
        "snow, 3 mm/h": Weather(snow_mm_h=3),
    }
    for name, weather in weathers.items():
        range_m = range_image(weather.apply(points_of(scene, projection), seed), projection)[0]
        show("Weather in seed 0", name, range_m)
    page = viz.scan_page(scans, "r3dpa gallery", {}, {}, None, projection.sensor, tiles, about)
    write_text(out, page)
    return f"open {out}: {len(scans)} scenes, {len(page) / 1e6:.0f} MB"
