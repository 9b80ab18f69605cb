# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Saving a recorded map while images are processed; files of other maps are never overwritten."""

from collections.abc import Callable
import itertools
from logging import Logger
import os
from pathlib import Path
from typing import Any

from stavpr_ros.errors import StavprError
from stavpr_ros.mapping import save_map
from stavpr_ros.pipeline.pipeline import Pipeline
from stavpr_ros.pipeline.save_state import SaveState

OnWorker = Callable[[Callable[[], Any]], Any]


def write_map(pipeline: Pipeline, on_worker: OnWorker, path: str, overwrite: bool) -> int:
    """
    Write the map of the pipeline to a file, on this thread; return its number of places.

    :param on_worker: calls a function on the thread of the pipeline.
    :raises StavprError: no places, an existing file, or a file that cannot be written.
    """
    snapshot = on_worker(lambda: pipeline.snapshot(path, overwrite))
    save_map(snapshot.places, path)
    on_worker(lambda: snapshot.mark_saved(path))
    return len(snapshot.places)


def save_recorded_map(
    pipeline: Pipeline, on_worker: OnWorker, path: str, log: 'Logger | Any'
) -> None:
    """
    Write unsaved places to ``path``; log errors.

    A file of another map is not overwritten, a numbered name beside it is used.

    :param path: '' = nowhere; the loss is logged.
    """
    try:
        unsaved = on_worker(lambda: pipeline.unsaved)  # includes the image being processed
        if unsaved and path:
            target = _free_name(path, pipeline.save_state)
            log.info(f'writing the map to {target}')
            places = write_map(pipeline, on_worker, target, overwrite=True)
            log.info(f'{places} places written to {target}')
        elif unsaved and pipeline.operation != 'loop_closure':
            log.warning(f'{unsaved} recorded places are lost: set save_path, or call ~/save_map')
    except TimeoutError:
        if pipeline.unsaved:
            log.error('the map is not saved: the worker is still busy at the end of the node')
    except Exception as error:  # any error: the node must end, and the loss must be logged
        cause = str(error) if isinstance(error, StavprError) else repr(error)
        log.error(f'the map is not saved: {cause}')


def _free_name(path: str, state: SaveState) -> str:
    """Return the path, or the first numbered name that is free or holds this map."""
    there = Path(path)
    numbered = (
        str(there.with_name(f'{there.stem}-{number}{there.suffix}'))
        for number in itertools.count(2)
    )
    names = itertools.chain([path], numbered)
    return next(name for name in names if state.owns(name) or not os.path.exists(name))
