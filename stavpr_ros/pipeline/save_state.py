"""Which files hold the places in use, and how many places are in none of them."""

import os
from dataclasses import dataclass, field


@dataclass
class SaveState:
    """
    What is known of the files of a map, or of a route, for as long as it is in use.

    :param path: of the file that it came from, or was written to last, '' = none.
    :param grown: places that have come since it was read or begun; ``written`` of them are in a file.
    """

    path: str = ''
    grown: int = 0
    written: int = 0
    _files: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if self.path:
            self._files.add(os.path.abspath(self.path))

    @property
    def unsaved(self) -> int:
        """Places that are in no file."""
        return self.grown - self.written

    def wrote(self, path: str, grown: int) -> None:
        """Take note that all of it was written when it had grown by so many places."""
        self.path, self.written = path, max(self.written, grown)
        self._files.add(os.path.abspath(path))

    def owns(self, path: str) -> bool:
        """Tell whether a file holds, or held, this map and no other, so that it may be replaced."""
        return os.path.abspath(path) in self._files
