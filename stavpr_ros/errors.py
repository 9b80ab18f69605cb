# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every error that the package raises on purpose; all of them are a :class:`StavprError`."""


class StavprError(Exception):
    """
    Root of all errors raised on purpose.

    Its text names the value that came, what was expected and what to do.
    """


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
    :param kind: what is wrong in a word or two, to count by and to explain each kind only once:
        ``encoding`` (not read), ``depth`` (not a color or gray image), ``size``, ``step``, ``cut
        off``, ``damaged``, ``too large``, ``unreadable`` (a file), ``features`` (not finite), or
        just ``image``.
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


class JournalError(StavprError):
    """The journal of a recorded map cannot be read, or is in use."""


class FeatureMismatchError(StavprError):
    """The query's features were made with other settings than the map's."""


class FleetError(StavprError):
    """A fleet's map cannot be reached, or its data is damaged."""
