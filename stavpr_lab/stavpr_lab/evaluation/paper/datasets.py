# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data sets of the paper and of the field on disk: folders of map and query, ground truth."""

from dataclasses import dataclass, replace
from pathlib import Path
import re

from stavpr_lab.evaluation.drive import crop, FrameSource
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.ground_truth_files import ARRAYS, TEXT
from stavpr_lab.evaluation.paper.traverses import msls, read_traverse, Reader, robotcar, utm_names
from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.suffixes import SUFFIXES

SYNTH = 'synth_'  # before a name: the same with both traverses cropped
CROP_MAP, CROP_QUERY = 0.3, 0.1  # right of every map image, left of every query image (synth-Nord)
GROUND_TRUTHS = ('groundtruth', 'gt', 'truth', 'groundtruthnew')
DEPTH = 4  # levels of folders, the root among them
PARENTS = ('images', 'data', 'datasets', 'test', 'trainval')  # folders of folders
LIST_FILE = 'cleanImageNames.txt'  # beside the traverses: names of the images that count
# Parts of folder names besides the traverse: sizes, rates, kinds of files.
NOISE = re.compile(r'\d+x\d+|\dfps|images|image|imgs|frames|gr[ae]yscale|jpg|png|test')


@dataclass(frozen=True)
class Layout:
    """
    Names of a data set's folders, compared without case, punctuation and ``NOISE``.

    :param folders: names, or their first parts, of the data set's folder.
    :param map_names: names of the folder of the map.
    :param query_names: names of the folder of the query.
    :param tolerance: the paper's or the field's, places.
    :param paired: the same index is the ground truth where both have equally many images; else a
        file is needed.
    :param reader: reads traverses whose images have positions, which are the ground truth then.
    :param meters, degrees: largest distance and angle to a correct place, by these positions.
    """

    folders: tuple[str, ...]
    map_names: tuple[str, ...]
    query_names: tuple[str, ...]
    tolerance: int
    paired: bool = True
    reader: Reader | None = None
    meters: float = 25.0
    degrees: float | None = None


NORDLAND = ('nordland',)
GARDENS = ('gardenspoint', 'gardenpoint', 'gardens', 'garden', 'gpw', 'gp')
LAYOUTS = {
    'nordland': Layout(NORDLAND, ('summer',), ('winter',), 3),
    'gardens_point': Layout(GARDENS, ('dayleft',), ('dayright',), 2),
    'gardens_point_night': Layout(GARDENS, ('dayleft',), ('nightright',), 2),
    'ua': Layout(('ua', 'uacampus', 'uadataset'), ('day',), ('evening',), 3),
    'berlin_a100': Layout(
        ('berlina100', 'a100'), ('reference', 'ref', '2'), ('live', 'query', '1'), 2, paired=False
    ),
}
OXFORD = ('oxfordrobotcar', 'robotcar', 'oxford')
PAIR = ('database',), ('query', 'queries')  # names of map and query
FIELD_LAYOUTS = {
    **{
        f'nordland_{season}': Layout(NORDLAND, ('summer',), (season,), 10)
        for season in ('winter', 'spring', 'fall')
    },
    'nordland_winter_1': Layout(NORDLAND, ('summer',), ('winter',), 1),
    **{
        f'msls_{city}': Layout((city, 'msls', 'mapillarysls'), *PAIR, 0, reader=msls, degrees=40.0)
        for city in ('cph', 'sf')
    },
    'st_lucia': Layout(('stlucia',), *PAIR, 0, reader=utm_names),
    'st_lucia_small': Layout(('stlucia',), ('1009090845',), ('1808091545',), 0, paired=False),
    'robotcar': Layout(OXFORD, ('20150317110844',), ('20141216184424',), 0, reader=robotcar),
    'sfu': Layout(('sfu', 'sfumountain'), ('dry',), ('jan',), 0, paired=False),
    'utm': Layout((), *PAIR, 0, reader=utm_names),
}
FIELD = (  # rows of the field's table
    *(name for name in FIELD_LAYOUTS if name != 'utm'),
    *(name for name in LAYOUTS if name != 'nordland'),
)
LAYOUTS |= FIELD_LAYOUTS
NAMES = (*LAYOUTS, *(SYNTH + name for name in LAYOUTS))


@dataclass(frozen=True)
class Dataset:
    """
    Two traverses of one route.

    :param map: images of the map, in the order of the route.
    :param query: images of the query.
    :param ground_truth: accepted places of the query's images, tolerance included.
    :param tolerance: the data set's or the requested one, places.
    """

    map: FrameSource
    query: FrameSource
    ground_truth: GroundTruth
    tolerance: int

    @property
    def criterion(self) -> str:
        """Return which places are correct, for a table."""
        around = f' +-{self.tolerance}' if self.tolerance else ''
        return f'{self.ground_truth.kind}{around}'


def open_dataset(name: str, root: str | Path, tolerance: int | None = None) -> Dataset:
    """
    Find a data set on disk.

    :param name: one of ``NAMES``; ``synth_`` before a name crops both traverses as synth-Nord.
    :param root: its own folder, or a folder around it.
    :param tolerance: places; None = the data set's.
    :raises SettingsError: an unknown name.
    :raises SourceError: it is not found; names the folders that were searched.
    """
    if name not in NAMES:
        raise SettingsError(f'data set {name!r} is unknown: take one of {", ".join(NAMES)}')
    layout = LAYOUTS[name.removeprefix(SYNTH)]
    folder, map_folder, query_folder = _find(name, layout, Path(root))
    tolerance = layout.tolerance if tolerance is None else tolerance
    places: FrameSource
    query: FrameSource
    if layout.reader is not None:
        reference, queries = (
            read_traverse(layout.reader, path) for path in (map_folder, query_folder)
        )
        places, query = reference.source, queries.source
        poses = queries.poses, reference.poses
        ground_truth = GroundTruth.from_poses(*poses, layout.meters, layout.degrees)
        is_counted = queries.counted[ground_truth.keys // ground_truth.n]
        ground_truth = replace(ground_truth, keys=ground_truth.keys[is_counted]).widened(tolerance)
    else:
        places, query = _images(map_folder), _images(query_folder)
        if layout.paired and len(query) == len(places):
            ground_truth = GroundTruth.identity(len(query), len(places), tolerance)
        else:
            file = _ground_truth_file(name, folder, len(query), len(places))
            ground_truth = GroundTruth.from_file(file, len(query), len(places), tolerance)
    if name.startswith(SYNTH):
        places, query = crop(places, 0, CROP_MAP), crop(query, CROP_QUERY, 0)
    return Dataset(places, query, ground_truth, tolerance)


def _images(folder: Path) -> FolderSource:
    """Return the images of a traverse, where a list is beside it only the images that it names."""
    images, names = FolderSource(folder), folder.parent / LIST_FILE
    if names.is_file():
        selection = set(names.read_text(encoding='utf-8', errors='replace').split())
        images.files = [file for file in images.files if file.name in selection]
        if not images.files:
            raise SourceError(
                f'{folder} has none of the images that {names} lists; remove the list'
            )
    return images


def _letters(name: str) -> str:
    return re.sub(r'[^a-z0-9]', '', name.casefold())


def _plain(name: str) -> str:
    # noise before punctuation: 64x32-1fps
    return _letters(NOISE.sub('', name.casefold()))


def _is_called(name: str, layout: Layout) -> bool:
    plain = _plain(name)
    # short names must be equal: too many others begin with them
    return any(
        plain == folder or (len(folder) > 3 and plain.startswith(folder))
        for folder in layout.folders
    )


def _traverse_name(name: str, layout: Layout) -> str:
    """Return the traverse in a folder's name: ``winter`` of ``nordland_winter_images``."""
    plain = _plain(name)
    for folder in sorted(layout.folders, key=len, reverse=True):
        if plain.startswith(folder):
            return plain.removeprefix(folder)
    return plain


def _folders(path: Path) -> list[Path]:
    try:
        return sorted(child for child in path.iterdir() if child.is_dir() and child.name[0] != '.')
    except OSError as error:
        raise SourceError(
            f'{path} cannot be listed: {error.strerror}; name the folder of the data'
        ) from error


def _find(name: str, layout: Layout, root: Path) -> tuple[Path, Path, Path]:
    """Return the folders of data set, map and query that are nearest to the root."""
    level, searched = [root], []
    for _ in range(DEPTH):
        searched += level
        hits = [(path, *folders) for path in level if (folders := _traverses(path, layout))]
        if len(hits) > 1:
            several = ', '.join(str(path) for path, *_ in hits)
            raise SourceError(
                f'data set {name} exists more than once: {several}; name one of these folders'
            )
        if hits:
            return hits[0]
        level = [
            child
            for path in level
            for child in _folders(path)
            if _letters(child.name) in PARENTS or _is_called(child.name, layout)
        ]
    present = (
        ', '.join(folder.name for path in searched for folder in _folders(path)) or 'no folder'
    )
    raise SourceError(
        f'data set {name} is not in {root}: searched {", ".join(map(str, searched))} for the map, '
        f'a folder called {_or(layout.map_names)}, and the query, {_or(layout.query_names)}, and '
        f'found {present}; rename them, or give map and query by their paths'
    )


def _traverses(path: Path, layout: Layout) -> tuple[Path, Path] | None:
    traverses = []
    for names in (layout.map_names, layout.query_names):
        folders = [
            folder for folder in _folders(path) if _traverse_name(folder.name, layout) in names
        ]
        if not folders:
            return None
        if len(folders) > 1:
            several = ', '.join(folder.name for folder in folders)
            raise SourceError(
                f'{path} has several folders for one traverse: {several}; leave one of them'
            )
        traverses.append(folders[0])
    return traverses[0], traverses[1]


def _ground_truth_file(name: str, folder: Path, queries: int, places: int) -> Path:
    files = [
        file
        for file in sorted(folder.iterdir())
        if _letters(file.stem) in GROUND_TRUTHS and file.is_file()
    ]
    for suffixes in (TEXT, ARRAYS, tuple(SUFFIXES)):  # text first: the least ambiguous
        candidates = [file for file in files if file.suffix.lower() in suffixes]
        if len(candidates) > 1:
            several = ', '.join(file.name for file in candidates)
            raise SourceError(
                f'data set {name} in {folder} has several ground truths: {several}; leave one'
            )
        if candidates:
            return candidates[0]
    raise SourceError(
        f'data set {name} in {folder} has {queries} query images for {places} places and no '
        f'ground truth: searched for a file called {_or(GROUND_TRUTHS)}, text, array or image, '
        'such as GroundTruth.csv, a line query,place'
    )


def _or(names: tuple[str, ...]) -> str:
    return ' or '.join(repr(name) for name in names)
