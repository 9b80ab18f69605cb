"""Engines for made-up routes, and images shown to them."""

from contextlib import contextmanager

import numpy as np

from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.threads import limit_threads

LENGTH, EXCLUDED = 5, 10
SECOND = 10**9
IDENTITY = [0.0, 0.0, 0.0, 1.0]


def settings_of(**changes):
    short = {'sequence': SequenceSettings(LENGTH), 'nms_radius': 5, 'exclude_places': EXCLUDED}
    return PipelineSettings(**short | changes)


def message(image):
    return ImageRecord.of_image(image, 0)


def at(i):
    return np.array([float(i), 0, 0, *IDENTITY])


def show(pipeline, images, first=0, poses=False):
    """Image i of all is stamped i + 1 seconds and, if at all, taken at x = i."""
    return [
        pipeline.process(message(image), (i + 1) * SECOND, at(i) if poses else None)
        for i, image in enumerate(images, first)
    ]


def as_if_saved(pipeline):
    """Take every place for written to a file."""
    pipeline.save_state.written = pipeline.save_state.grown


def answers(outcomes):
    return [outcome.status for outcome in outcomes]


def stamps_of(place_map):
    return [] if place_map is None else [int(stamp) // SECOND for stamp in place_map.stamps]


@contextmanager
def one_thread():
    """Threads that wait for each other spin, 100 ms an image where others want the cores as well."""
    limit_threads(1)
    try:
        yield
    finally:
        limit_threads(0)


def localizing(map_file, **changes):
    """An pipeline that localizes on a map's file."""
    pipeline = Pipeline(settings_of(**changes))
    pipeline.use(read_map(map_file, pipeline.settings))
    return pipeline
