"""Caches that the processes of a training fill together, above all of VAE posteriors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor
from torch.utils.data import Dataset

from r3dpa.data.loaders import plain_loader
from r3dpa.data.store import Cacheable, CachedTensors, Store, tensor_cache
from r3dpa.io import weights_sha256

Item = TypeVar("Item", bound=Cacheable)


@torch.no_grad()
def cache_posteriors(
    module: Any,
    settings: Mapping[str, Any],
    items: Sequence[Item],
    dataset_of: Callable[[list[Item]], Dataset[Any]],
    image: str,
) -> CachedTensors[Item]:
    """Cache posterior moments ``(2C, h, w)``; encodes only the items that the cache lacks.

    They are computed in float32 whatever the precision of the steps, and kept in the
    ``latents_dir`` of the module; in ``<run_dir>/latents`` where that is None.

    Args:
        module: In training, on its device; has a frozen ``vae`` and ``latent_shape`` (C, h, w).
        settings: What the moments depend on beside the weights of the VAE, as JSON values.
        items: Scans or images, the same in all processes, which share the work.
        dataset_of: Dataset of some items, whose samples hold their ``index`` and an image.
        image: Name of the image in a sample, ``(C', H, W)``.

    Raises:
        StoreError: If the cache cannot be written or is damaged, or moments are not finite.
    """
    trainer, datamodule = module.trainer, module.trainer.datamodule
    root = Path(module.latents_dir or Path(trainer.default_root_dir) / "latents")
    channels, *size = module.latent_shape
    about = {**settings, "vae": weights_sha256(module.vae.state_dict())}
    cache = tensor_cache(root, "posterior", about, (2 * channels, *size))

    def moments_of(some: list[Item]) -> Iterator[Tensor]:
        loader = plain_loader(dataset_of(some), datamodule.batch_size, datamodule.num_workers)
        for batch in loader:
            posterior = module.vae.encode(batch[image].to(module.device))
            yield torch.cat([posterior.mean, posterior.logvar], dim=1)

    return fill_cache(trainer, cache, items, moments_of)


def fill_cache(
    trainer: Any,
    cache: Store,
    items: Sequence[Item],
    rows_of: Callable[[list[Item]], Iterator[Tensor]],
) -> CachedTensors[Item]:
    """Make the missing rows of a cache; all processes of a training call it and share the work.

    Args:
        trainer: Trainer of the process.
        cache: Store with a row for each item.
        items: Items, the same in all processes.
        rows_of: Yields rows ``(B, ...)`` of some items in order.

    Returns:
        Reader of the complete cache.
    """
    # Shares of all items: another job may fill the cache while the processes look for missing ones.
    # Where each node has a disk of its own, its processes make everything.
    if trainer.datamodule.prepare_data_per_node:
        share = items[trainer.local_rank :: trainer.num_devices]
    else:
        share = items[trainer.global_rank :: trainer.world_size]
    missing = cache.missing(share)
    if missing:
        rank_zero_info(f"making {len(missing)} of {len(share)} once, into {cache.folder}")
        keys = [item.cache_key for item in missing]
        num_done = 0
        with cache.writer(trainer.global_rank) as writer:
            for rows in rows_of(missing):
                writer.add(keys[num_done : num_done + len(rows)], rows)
                num_done += len(rows)
    trainer.strategy.barrier("cached tensors: all are written")
    return CachedTensors(cache, items)
