"""The paper's data sets as people have them on disk: where map and query are, and which places are right."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.ground_truth_files import ARRAYS, TEXT
from stavpr_ros.evaluation.warp import FrameSource, cropped
from stavpr_ros.sources.folder import SUFFIXES, FolderSource

SYNTH = 'synth_'  # before a name: the same with both drives cropped
CROP_MAP, CROP_QUERY = 0.3, 0.1  # right of every map image, left of every query image (synth-Nord)
TRUTHS = ('groundtruth', 'gt', 'truth', 'groundtruthnew')
HOLDERS = ('images', 'data', 'datasets', 'test')  # folders that only hold others
# What folder names say beside the drive: sizes, rates, that there are images in it.
NOISE = re.compile(r'\d+x\d+|\dfps|images|image|imgs|frames|grayscale|greyscale|jpg|png|test')


@dataclass(frozen=True)
class Layout:
    """
    A data set on disk. Names are compared without case, punctuation and what every name may say.

    :param folders: what its own folder may be called, or begin with.
    :param map_names: what the folder of the map may be called.
    :param query_names: what that of the query may be called.
    :param tolerance: the paper's, places.
    :param paired: the same index is right where both drives have equally many images; else a file says it.
    """

    folders: tuple[str, ...]
    map_names: tuple[str, ...]
    query_names: tuple[str, ...]
    tolerance: int
    paired: bool = True


GARDENS = ('gardenspoint', 'gardenpoint', 'gardens', 'garden', 'gpw', 'gp')
LAYOUTS = {
    'nordland': Layout(('nordland',), ('summer',), ('winter',), 3),
    'gardens_point': Layout(GARDENS, ('dayleft',), ('dayright',), 2),
    'gardens_point_night': Layout(GARDENS, ('dayleft',), ('nightright',), 2),
    'ua': Layout(('ua', 'uacampus', 'uadataset'), ('day',), ('evening',), 3),
    'berlin_a100': Layout(
        ('berlina100', 'a100'), ('reference', 'ref', '2'), ('live', 'query', '1'), 2, paired=False
    ),
}
NAMES = (*LAYOUTS, *(SYNTH + name for name in LAYOUTS))


@dataclass(frozen=True)
class Dataset:
    """
    Two drives along one route.

    :param map: images of the map, in the order of the route.
    :param query: images of the query.
    :param truth: the places that count as right, the tolerance included.
    :param tolerance: the paper's, or the one that was asked for, places.
    """

    map: FrameSource
    query: FrameSource
    truth: GroundTruth
    tolerance: int

    def synth(self, crop_map: float = CROP_MAP, crop_query: float = CROP_QUERY) -> 'Dataset':
        """
        Change the viewpoint as the paper's synth-Nord does.

        :param crop_map: fraction of the width cut away on the right of every map image.
        :param crop_query: the same on the left of every query image.
        """
        return replace(self, map=cropped(self.map, 0, crop_map), query=cropped(self.query, crop_query, 0))


def open_dataset(name: str, root: str | Path, tolerance: int | None = None) -> Dataset:
    """
    Find a data set on disk.

    :param name: one of ``NAMES``; ``synth_`` before a name crops both drives as synth-Nord is cropped.
    :param root: its own folder, or one that holds it.
    :param tolerance: places; None = the paper's.
    :raises SettingsError: an unknown name.
    :raises SourceError: it is not there; says what was looked for.
    """
    if name not in NAMES:
        raise SettingsError(f'data set {name!r} is unknown: take one of {", ".join(NAMES)}')
    layout = LAYOUTS[name.removeprefix(SYNTH)]
    folder, map_folder, query_folder = _find(name, layout, Path(root))
    places, query = FolderSource(map_folder), FolderSource(query_folder)
    tolerance = layout.tolerance if tolerance is None else tolerance
    if layout.paired and len(query) == len(places):
        truth = GroundTruth.identity(len(query), len(places), tolerance)
    else:
        file = _truth_file(name, folder, len(query), len(places))
        truth = GroundTruth.from_file(file, len(query), len(places), tolerance)
    dataset = Dataset(places, query, truth, tolerance)
    return dataset.synth() if name.startswith(SYNTH) else dataset


# ------------------------------------------------------------------------------------------ finding


def _letters(name: str) -> str:
    return re.sub(r'[^a-z0-9]', '', name.casefold())


def _plain(name: str) -> str:
    # before the punctuation goes: 64x32-1fps
    return _letters(NOISE.sub('', name.casefold()))


def _is_called(name: str, layout: Layout) -> bool:
    plain = _plain(name)
    # short names only as they stand: too many others begin with them
    return any(plain == folder or (len(folder) > 3 and plain.startswith(folder)) for folder in layout.folders)


def _drive_name(name: str, layout: Layout) -> str:
    """Return what a folder's name says about the drive: ``nordland_winter_images`` says ``winter``."""
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


def _holders(paths: list[Path]) -> list[Path]:
    return [child for path in paths for child in _folders(path) if _letters(child.name) in HOLDERS]


def _find(name: str, layout: Layout, root: Path) -> tuple[Path, Path, Path]:
    """Find the data set's folder and those of its map and query, the nearest to the root first."""
    inside = _holders([root])
    own = [child for path in (root, *inside) for child in _folders(path) if _is_called(child.name, layout)]
    looked: list[Path] = []
    for level in ([root], inside, own, _holders(own)):
        looked += [path for path in level if path not in looked]
        hits = [(path, *drives) for path in level if (drives := _drives(path, layout))]
        if len(hits) > 1:
            several = ', '.join(str(path) for path, *_ in hits)
            raise SourceError(
                f'data set {name} is there more than once: {several}; name the one that is meant'
            )
        if hits:
            return hits[0]
    seen = ', '.join(folder.name for path in looked for folder in _folders(path)) or 'no folder'
    raise SourceError(
        f'data set {name} is not in {root}: looked in {", ".join(map(str, looked))} for the map, a folder '
        f'called {_or(layout.map_names)}, and the query, {_or(layout.query_names)}, and found {seen}; '
        'rename them, or give map and query by their paths'
    )


def _drives(path: Path, layout: Layout) -> tuple[Path, Path] | None:
    drives = []
    for names in (layout.map_names, layout.query_names):
        found = [folder for folder in _folders(path) if _drive_name(folder.name, layout) in names]
        if not found:
            return None
        if len(found) > 1:
            several = ', '.join(folder.name for folder in found)
            raise SourceError(f'{path} holds several folders for one drive: {several}; leave one of them')
        drives.append(found[0])
    return drives[0], drives[1]


def _truth_file(name: str, folder: Path, queries: int, places: int) -> Path:
    files = [file for file in sorted(folder.iterdir()) if _letters(file.stem) in TRUTHS and file.is_file()]
    for suffixes in (TEXT, ARRAYS, tuple(SUFFIXES)):  # text first: nothing is unclear about it
        found = [file for file in files if file.suffix.lower() in suffixes]
        if len(found) > 1:
            several = ', '.join(file.name for file in found)
            raise SourceError(f'data set {name} in {folder} has several ground truths: {several}; leave one')
        if found:
            return found[0]
    raise SourceError(
        f'data set {name} in {folder} has {queries} query images for {places} places and no ground truth: '
        f'looked for a file called {_or(TRUTHS)}, text, array or image, such as GroundTruth.csv, a line '
        'query,place'
    )


def _or(names: tuple[str, ...]) -> str:
    return ' or '.join(repr(name) for name in names)
