# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``map recover``: make a map of the journal that an interrupted recording has left."""

import argparse

from stavpr_ros.errors import SourceError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument('journal', metavar='JOURNAL', help='such as route.stavpr.journal')
    parser.add_argument(
        '--output',
        metavar='MAP',
        help='the file to write; without it that of the recording, or a numbered name beside it',
    )


def recover_map(journal: str, output: str | None = None) -> int:
    """
    Make a map of a journal, and delete the journal unless it is damaged.

    :returns: the exit code, 1 if places may be missing.
    :raises StavprError: no journal, or a map that cannot be written; the journal stays.
    """
    from stavpr_ros.mapping.journal import SUFFIX
    from stavpr_ros.mapping.journal_map import recover

    if output is None and not journal.endswith(SUFFIX):
        raise SourceError(f'{journal} does not end with {SUFFIX}: name the map, --output')
    found = recover(journal, output)
    print(f'{found.path}: {found.places} places, {found.recorded} of them from {journal}')
    print(*found.problems, sep='\n', end='\n' if found.problems else '')
    return int(bool(found.problems))
