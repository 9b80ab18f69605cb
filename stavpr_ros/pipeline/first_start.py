# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The first start on a map: two processes compile the kernels, which the node loads then."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
import pickle
import subprocess
import sys

import numpy as np
from stavpr_ros.compilation import CACHE, progress
from stavpr_ros.errors import StavprError
from stavpr_ros.mapping.keyframes import image_change, small_gray
from stavpr_ros.method import PlaceRecognizer
from stavpr_ros.method.filter import PlaceFilter
from stavpr_ros.method.path import best_straight
from stavpr_ros.pipeline.operations import BLANK_IMAGE, WARM_IMAGES, warm_up
from stavpr_ros.pipeline.pipeline import read_map
from stavpr_ros.pipeline.settings import PipelineSettings

PROGRAM = 'from stavpr_ros.pipeline.first_start import compile_part; compile_part()'
WINDOW, IMAGES = 'window', 'images'  # parts that take about as long
OF_WINDOW = f'{PlaceFilter.__module__}.*'  # files that no other command leaves
POLL = 0.1  # seconds until the end of the node is noticed


def compile_beside(
    settings: PipelineSettings,
    path: str,
    log: Callable[[str], object],
    is_over: Callable[[], bool],
) -> None:
    """
    Compile the kernels of a localization in mode robust on the CPU, if its filter has none yet.

    On two cores, it takes .6 of the time, and what compilers take, 200 MB, is free again. What is
    missing then, as where a process failed, is compiled at its first use.

    :param path: of the map; nothing is compiled without such a file.
    :param is_over: returns whether to give up.
    """
    is_filled = CACHE is None or any(CACHE.glob(OF_WINDOW))
    on_cpu = settings.matching_backend('localization') == 'cpu' and settings.mode == 'robust'
    if is_filled or not on_cpu or not Path(path).is_file():
        return
    log('compiling the kernels of features, distances and place filter, once: half a minute')
    content, parts = pickle.dumps((settings, path)), []
    for name in (WINDOW, IMAGES):
        command = [sys.executable, '-P', '-c', PROGRAM, name]
        # a signal to the node must not reach them: they end with it
        part = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
        parts.append(part)
        assert part.stdin is not None
        with suppress(BrokenPipeError), part.stdin as pipe:
            pipe.write(content)
    for part in parts:
        while part.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                part.wait(POLL)
            if is_over():
                part.terminate()


def compile_part() -> None:
    """Compile what images need up to their distances, or what the window of a query needs."""
    progress.announce = lambda line: None
    settings, path = pickle.load(sys.stdin.buffer)
    with suppress(StavprError):  # the node reports it
        loaded = read_map(path, settings)
        places = loaded.places
        images = places.features[: settings.sequence.length + WARM_IMAGES]
        recognizer = PlaceRecognizer(places, settings, 'cpu', settings.precision)
        if sys.argv[1] == WINDOW:
            apart = np.abs(np.subtract.outer(np.arange(len(images)), np.arange(len(places))))
            rows = iter((apart / (1 + apart)).astype(np.float32))
            recognizer._matcher.distances = lambda *image: next(rows)  # type: ignore[method-assign]
            warm_up(recognizer, images, places)
            return
        row, path = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.int64)
        best_straight(row, path[0], 0, 1, path, np.zeros((0, 2), np.int64))  # for the balance
        loaded.extractor.extract([BLANK_IMAGE])
        image_change(*[small_gray(BLANK_IMAGE)] * 2)
        recognizer._matcher.distances(images.strips[:, 0], images.weights[:, 0])
