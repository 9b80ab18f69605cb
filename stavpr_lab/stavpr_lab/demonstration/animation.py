# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The animation in the README, of the files of a demonstration.

``python3 -m stavpr_lab.demonstration.animation demo_output docs/demo.webp`` (``make animation``).
With a distance behind it, such as 3, the subgoals at this distance are beside the query instead of
the matched places: meters, on a map without poses places, as parameter ``subgoal_distance``.
"""

import json
from pathlib import Path
import sys

import cv2
import numpy as np
from PIL import Image
from stavpr_ros.mapping import load_map, Map
from stavpr_ros.pipeline.overlay import match_image
from stavpr_ros.sources import open_source

INTERVAL = 5  # images per drawn one
MILLISECONDS = 120  # an image is shown
SIZE = (240, 180)  # pixels of the query, and of the place beside it
QUALITY = 40  # of the WebP compression


def draw(
    image: np.ndarray, record: dict[str, object], place_map: Map, ahead: float = 0.0
) -> np.ndarray:
    """
    Draw an image of the query beside the newest place of its match.

    :param image: RGB, uint8.
    :param record: the match, as the command ``record`` writes it.
    :param ahead: the subgoal at this distance is drawn instead of the place.
    :returns: RGB, uint8.
    """
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    place, probability = record['newest_index'], record['probability']
    text, thumbnail, accepted = str(record['status']), None, record['status'] == 'MATCH'
    if accepted and isinstance(place, int):
        text = f'{text}: place {place}'
        if ahead:
            from stavpr_ros.ros.subgoal import place_ahead

            place = place_ahead(place_map, place, ahead)
            text += f', subgoal {place}'
        thumbnail = place_map.thumbnail(place)
    if probability is not None:
        text += f', probability {probability:.2f}'
    return match_image(small, thumbnail, text, accepted, 'subgoal' if ahead else 'map')


def write_animation(folder: Path, path: Path, ahead: float = 0.0) -> None:
    """
    Write an animation of the query's images beside their places, as WebP.

    :param folder: output of the command ``demo`` without options.
    :param ahead: as for :func:`draw`.
    :raises StavprError: a file of the demonstration cannot be read.
    """
    place_map = load_map(folder / 'map.stavpr')
    records = (folder / 'matches.jsonl').read_text().splitlines()
    frames = [
        Image.fromarray(draw(frame.image, json.loads(line), place_map, ahead))
        for i, (frame, line) in enumerate(
            zip(open_source(folder / 'second_traverse'), records, strict=True)
        )
        if i % INTERVAL == 0
    ]
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=MILLISECONDS,
        loop=0,
        quality=QUALITY,
        method=6,
    )


if __name__ == '__main__':
    write_animation(Path(sys.argv[1]), Path(sys.argv[2]), *map(float, sys.argv[3:4]))
