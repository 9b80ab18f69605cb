"""Writing a map that has grown: images go on meanwhile, and no file is replaced that it did not come from."""

import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stavpr_ros.errors import StavprError
from stavpr_ros.mapping import save_map
from stavpr_ros.pipeline import Pipeline
from stavpr_ros.pipeline.save_state import SaveState

OnWorker = Callable[[Callable[[], Any]], Any]


def write_map(pipeline: Pipeline, on_worker: OnWorker, path: str, overwrite: bool) -> int:
    """
    Write the pipeline's map to a file, on this thread; return its number of places.

    :param on_worker: has the worker call a function.
    :raises StavprError: there is nothing to save, a file is there already, or it cannot be written.
    """
    snapshot = on_worker(lambda: pipeline.to_save(path, overwrite))
    save_map(snapshot.places, path)
    on_worker(lambda: pipeline.saved(path, snapshot))
    return len(snapshot.places)


def write_at_the_end(pipeline: Pipeline, on_worker: OnWorker, path: str, log: Any) -> None:
    """
    Write what has grown and is in no file yet to ``path``, or beside a file of another map that is there.

    :param path: '' = nowhere: it is said what is lost.
    :param log: the node's logger.
    """
    try:
        unsaved = on_worker(lambda: pipeline.unsaved)  # with the image in work
        if unsaved and path:
            target = _own_name(path, pipeline.save_state)
            log.info(f'writing the map to {target}')
            places = write_map(pipeline, on_worker, target, overwrite=True)
            log.info(f'{places} places written to {target}')
        elif unsaved and pipeline.operation != 'loop_closure':
            log.warning(f'{unsaved} places are in no file: neither save_path nor ~/save_map named one')
    except TimeoutError:
        if pipeline.unsaved:
            log.error('the map is not saved: the worker is busy, and the node ends')
    except Exception as error:  # whatever it is, the node must end, and it must be said
        log.error(f'the map is not saved: {error if isinstance(error, StavprError) else repr(error)}')


def _own_name(path: str, save_state: SaveState) -> str:
    """Return the path, or the first of name-2.end, name-3.end ... that is free, or is of this map."""
    there = Path(path)
    numbered = (str(there.with_name(f'{there.stem}-{number}{there.suffix}')) for number in itertools.count(2))
    names = itertools.chain([path], numbered)
    return next(name for name in names if save_state.owns(name) or not os.path.exists(name))
