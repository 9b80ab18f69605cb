# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which floor: a folder of maps of look-alike floors, as parameter ``map_path`` takes one.

The odd images of each floor of the data set tower are its map, the even ones the query, floor
after floor without a reset, as by an elevator; beside each floor with the map of it alone.
``python benchmarks/floors.py``, on STAVPR_DATA, in ten seconds; prints the table of
benchmarks/results/unseen.md.
"""

from pathlib import Path
import tempfile

from data import data_folder
import numpy as np
from results import parser_of
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, merge_maps, save_map
from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map
from stavpr_ros.sources import open_source
from stavpr_ros.sources.frame import ImageRecord

SECOND = 10**9


def drive(
    path: str, floors: list[list[np.ndarray]], resets: bool = False
) -> list[list[tuple[str, str]]]:
    """
    Return the session of each match, '' = none, and the most probable session, by floor.

    :param resets: the window is emptied between the floors, as by ``~/reset``.
    """
    pipeline = Pipeline(PipelineSettings(backend='cpu'))
    pipeline.change(loaded=read_map(path, pipeline.settings))
    places, stamp = pipeline.operation.reference, 0
    assert places is not None
    results: list[list[tuple[str, str]]] = []
    for images in floors:
        results.append([])
        if resets:
            pipeline.operation.reset()
        for image in images:
            stamp += SECOND // 10
            result = pipeline.operation.process(ImageRecord.of_image(image, 0), stamp)
            best = int(np.argmax(result.session_probabilities or (0.0,)))
            session = places.place(result.match.place).session if result.match.accepted else ''
            results[-1].append((session, places.sessions[best].id if places.sessions else ''))
    return results


def main() -> None:
    """Print the table."""
    parser_of(__doc__).parse_args()
    floors = sorted(path for path in (data_folder() / 'tower').iterdir() if path.is_dir())
    columns = ['floor', 'images', 'matched', 'right floor, of these', 'most probable floor right']
    columns += ['images until a match', 'with `~/reset`: matched', 'right floor']
    columns += ['matched on the map of the floor alone']
    print(f'| {" | ".join(columns)} |\n|{len(columns) * "---|"}')
    total = np.zeros(8, int)
    with tempfile.TemporaryDirectory() as folder:
        queries = []
        for floor in floors:
            frames = list(open_source(floor))
            place_map = build_map(frames[1::2], FeatureExtractor('gradient'), progress=False)
            save_map(merge_maps([place_map], [floor.name]), Path(folder) / f'{floor.name}.stavpr')
            queries.append([frame.image for frame in frames[::2]])
        of_all = drive(folder, queries), drive(folder, queries, resets=True)
        for floor, images, results, resets in zip(floors, queries, *of_all, strict=True):
            alone = drive(str(Path(folder) / f'{floor.name}.stavpr'), [images])[0]
            sessions, after_reset = ([name for name, _ in rows] for rows in (results, resets))
            right = sessions.count(floor.name)
            row = [
                *(len(images), len(images) - sessions.count(''), right),
                sum(best == floor.name for _, best in results),
                sessions.index(floor.name) + 1 if right else 0,
                *(len(images) - after_reset.count(''), after_reset.count(floor.name)),
                sum(bool(session) for session, _ in alone),
            ]
            total += row
            print(f'| {floor.name} | {" | ".join(str(count or "-") for count in row)} |')
    total[4] = 0
    print(f'| all | {" | ".join(str(count or "") for count in total)} |')


if __name__ == '__main__':
    main()
