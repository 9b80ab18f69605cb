# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Saving a recorded map while images are processed; files of other maps are never overwritten."""

from collections.abc import Callable
import itertools
from logging import Logger
from pathlib import Path
from typing import Any

from stavpr_ros.errors import OutputTakenError, StavprError
from stavpr_ros.mapping import save_map
from stavpr_ros.output_file import Force, MAP, require_replaceable
from stavpr_ros.pipeline.pipeline import Pipeline

OnWorker = Callable[[Callable[[], Any]], Any]


def write_map(pipeline: Pipeline, on_worker: OnWorker, path: str, overwrite: Force) -> int:
    """
    Write the map of the pipeline to a file, on this thread; return its number of places.

    :param on_worker: calls a function on the thread of the pipeline.
    :raises StavprError: no places, an existing file, or a file that cannot be written.
    """
    require_replaceable(path, MAP, overwrite)  # before places are copied
    snapshot = on_worker(pipeline.snapshot)
    save_map(snapshot.places, path, overwrite)
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
            log.info(f'writing the map to {path}')
            places, target = _write_beside(pipeline, on_worker, path)
            log.info(f'{places} places written to {target}')
        elif unsaved and pipeline.operation != 'loop_closure':
            log.warning(f'{unsaved} recorded places are lost: set save_path, or call ~/save_map')
    except TimeoutError:
        if pipeline.unsaved:
            log.error('the map is not saved: the worker is still busy at the end of the node')
    except Exception as error:  # any error: the node must end, and the loss must be logged
        cause = str(error) if isinstance(error, StavprError) else repr(error)
        log.error(f'the map is not saved: {cause}')


def _write_beside(pipeline: Pipeline, on_worker: OnWorker, path: str) -> tuple[int, str]:
    """Write the map to the path, or the first numbered name that is free or holds this map."""
    there = Path(path)
    for number in itertools.count(1):
        name = path if number == 1 else str(there.with_stem(f'{there.stem}-{number}'))
        try:
            overwrite = pipeline.save_state.owned(name)
            return write_map(pipeline, on_worker, name, overwrite), name
        except OutputTakenError:
            continue
    raise AssertionError
