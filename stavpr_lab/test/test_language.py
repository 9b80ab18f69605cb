# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Words that the prose, names and messages of this package avoid, and their replacements."""

from collections.abc import Iterator
import os
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[2]
SUFFIXES = ('.py', '.md', '.msg', '.srv', '.yaml', '.yml')
NOT_OURS = {'build', 'install', 'log'}

# Pattern of whole words (an underscore separates words as well): replacement.
WORDS = {
    # software is no person
    r'hears?|heard|hearing': 'subscribes, receives',
    r'tells?|told|telling': 'reports, logs, returns',
    r'says|said': 'logs, publishes, states',
    r'is asked|are asked|was asked': 'is requested',
    r'nobody (waits|listens)': 'no subscriber, no client',
    r'patience': 'timeout',
    r'wish|wishes': 'requested',
    r'judges?|judged|judgements?|judging': 'evaluate, metrics',
    # phrases
    r'do not do|does not do|will do': 'is invalid, is supported',
    r'what has grown': 'recorded map',
    r'made-up|made up': 'synthetic',
    r'worth the name': 'leave it out',
    r'in vain': 'without success',
    r'by chance': 'at random, coincidentally',
    r'for ever': 'indefinitely',
    r'diseases?|cures?': 'failure modes, mitigations',
    r'describers?': 'feature extractor',
    r'rivals?': 'second best',
    r'pictures?': 'image, plot, thumbnail',
}
# American spelling; anywhere in a word.
SPELLINGS = {
    r'(recogn|normal|penal|initial|serial|synchron|vector|visual)is(?!t|m)': '...iz...',
    r'(optim|organ)is(e|ing|ation)': '...iz...',
    r'colour': 'color',
    r'neighbour': 'neighbor',
    r'behaviour': 'behavior',
    r'centre|centring': 'center',
    r'grey': 'gray',
    r'metre': 'meter',
    r'licence': 'license',
}
PATTERNS = {
    re.compile(rf'(?<![^\W_])(?:{words})(?![^\W_])'): replacement
    for words, replacement in WORDS.items()
} | {re.compile(part): replacement for part, replacement in SPELLINGS.items()}

# Text that is taken out before the search, and the reason.
ALLOWED = {
    r'https?://\S+': 'addresses',
}


def prose_files() -> Iterator[Path]:
    """Yield all files with prose but this one."""
    for folder, subfolders, files in os.walk(ROOT):
        subfolders[:] = sorted(
            name for name in subfolders if not name.startswith('.') and name not in NOT_OURS
        )
        for name in sorted(files):
            path = Path(folder, name)
            if name.endswith(SUFFIXES) and path != Path(__file__).resolve():
                yield path


def findings(text: str) -> list[str]:
    """Return 'LINE: TEXT (REPLACEMENT)' for every avoided word or part of a word."""
    text = re.sub('|'.join(ALLOWED), '', text).lower()
    found = [
        (text.count('\n', 0, match.start()) + 1, match.group(), replacement)
        for pattern, replacement in PATTERNS.items()
        for match in pattern.finditer(text)
    ]
    return [f'{line}: {words} ({replacement})' for line, words, replacement in sorted(found)]


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('The node hears images.', ['hears']),
        ('keyframe_metres = 1', ['metre']),
        ('PlaceRecogniser(colours)', ['colour', 'recognis']),
        ('COLOR_BGR2GRAY, parameter, recognizer, whichever, shear, picturesque, realistic', []),
        ('see https://example.org/colour', []),
        ('first line\nWhat has grown', ['what has grown']),
    ],
)
def test_findings_names_avoided_words(text, words):
    assert [re.match(r'\d+: (.*) \(', line).group(1) for line in findings(text)] == words


def test_prose_uses_terms_of_field():
    found = [
        f'{path.relative_to(ROOT)}:{line}'
        for path in prose_files()
        for line in findings(path.read_text(encoding='utf-8'))
    ]
    assert not found, f'{len(found)} avoided words:\n' + '\n'.join(found)
