# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pipelines on synthetic routes, and images for them."""

from functools import partial

import numpy as np
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map
from stavpr_ros.pipeline.saving import write_map
from stavpr_ros.sources.frame import ImageRecord

LENGTH, EXCLUDED = 5, 10
MIN_PROBABILITY = 0.05  # windows as short as these are certain of nothing
SECOND = 10**9


class Log:
    """A logger that keeps its lines, (level, text)."""

    def __init__(self):
        self.lines = []
        for level in ('info', 'warning', 'error'):
            setattr(self, level, partial(self._add, level))

    def _add(self, level, text):
        self.lines.append((level, text))

    def of(self, level):
        """Return the lines of a level as one text."""
        return '\n'.join(text for own, text in self.lines if own == level)


def settings_of(**changes):
    short = {'sequence': SequenceSettings(LENGTH), 'nms_radius': 5, 'exclude_places': EXCLUDED}
    short['min_probability'] = MIN_PROBABILITY
    return PipelineSettings(**{'backend': 'cpu', 'features': 'gradient'} | short | changes)


def message(image):
    return ImageRecord.of_image(image, 0)


def at(i):
    return np.array([float(i), 0, 0, 0, 0, 0, 1])


def process(pipeline, images, first=0, poses=False):
    """Image i of all is stamped i + 1 seconds and, with poses, taken at x = i."""
    return [
        pipeline.operation.process(message(image), (i + 1) * SECOND, at(i) if poses else None)
        for i, image in enumerate(images, first)
    ]


def record(route, operation='mapping', count=30, **changes):
    """Return a pipeline on a saved map of the route; in loop_closure, on the route itself."""
    pipeline = Pipeline(settings_of(**changes), 'mapping')
    process(pipeline, route[:count], poses=True)
    mark_saved(pipeline)
    if operation != 'mapping':
        pipeline.change(operation=operation)
    if operation == 'loop_closure':
        process(pipeline, route[:count], poses=True)
    return pipeline


def localizing(map_file, **changes):
    """Return a pipeline that localizes on a map file."""
    pipeline = Pipeline(settings_of(**changes))
    pipeline.change(loaded=read_map(map_file, pipeline.settings))
    return pipeline


def mark_saved(pipeline):
    """Mark every place as written to a file."""
    pipeline.save_state.saved = pipeline.save_state.recorded


def save(pipeline, path, overwrite=False):
    return write_map(pipeline, lambda function: function(), str(path), overwrite)


def statuses(matches):
    return [result.match.status for result in matches]


def stamps_of(places):
    return [] if places is None else [int(stamp) // SECOND for stamp in places.stamps]
