# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every error that the package raises on purpose; all of them are a :class:`StavprError`."""

from collections import Counter
from collections.abc import Mapping

CAUSES = {
    'encoding': 'images with an unknown encoding',
    'depth': 'images with depth or measurements',
    'size': 'images with a size that their encoding cannot have',
    'step': 'images whose rows are too short',
    'cut off': 'images that are cut off',
    'damaged': 'images that are damaged',
    'too large': 'images that are too large',
    'unreadable': 'files that cannot be opened',
    'features': 'images whose features are not finite',
    'image': 'images that cannot be decoded',
    'elsewhere': 'files whose content is not here or not complete',
    'format': 'images in a format that is not read (convert them to JPEG)',
    'pages': 'pages, frames or views behind the first one of a file (to read them, split it)',
    'video': 'videos among images (to read one, name it)',
    'bag': 'files of bags among images (to read one, name it)',
    'beside': 'images beside the sub-folders of the drive',
    'below': 'images in sub-folders of the drive',
    'foreign': 'folders of a NAS, an archive program or a viewer',
    'odometry': 'messages of odometry without a valid pose',
}
"""What readers of foreign files leave out, by the cause that they count."""


def left_out(*counts: Mapping[str, int]) -> str:
    """Return what was left out and why, by the causes of several readers; '' = nothing."""
    total = sum(map(Counter, counts), Counter())
    parts = (f'{CAUSES.get(cause, f"images ({cause})")}: {n}' for cause, n in total.items())
    return f'left out: {"; ".join(parts)}' if total else ''


def printable(text: str) -> str:
    """Return a text with control characters and lone surrogates escaped: names are of anyone."""
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class StavprError(Exception):
    """
    Root of all errors raised on purpose.

    Its text, :func:`printable`, names the value that came, what was expected and what to do.
    """

    def __init__(self, text: str = '') -> None:
        super().__init__(printable(text))


class InputError(StavprError, ValueError):
    """An array or argument has the wrong shape, type or values."""


class SettingsError(StavprError, ValueError):
    """A setting is out of its range, or settings contradict each other."""


class UnavailableError(StavprError):
    """Something requested by name is not available: a device, an extra, a file of weights."""


class ImageError(StavprError):
    """
    One image cannot be decoded; the next one may be fine.

    :param text: what came, what was expected and what to do.
    :param kind: what is wrong in a word or two, one of :data:`CAUSES`, to count by and to explain
        each only once.
    """

    def __init__(self, text: str, *, kind: str = 'image') -> None:
        super().__init__(text)
        self.kind = kind


class SourceError(StavprError):
    """A folder or a bag of images cannot be read."""


class OutputError(StavprError):
    """A file cannot be written."""


class OutputTakenError(OutputError):
    """A file is not written, since one is there that must stay, or another program writes it."""


class MapFileError(StavprError):
    """A map file is damaged, truncated, foreign or too new to be read."""


class UnfitMapError(MapFileError):
    """A sound map requires another version of this program, or a package that is not installed."""


class JournalError(StavprError):
    """The journal of a recorded map cannot be read, or is in use."""


class FeatureMismatchError(StavprError):
    """The query's features were made with other settings than the map's."""


class FleetError(StavprError):
    """A fleet's map cannot be reached, or its data is damaged."""
