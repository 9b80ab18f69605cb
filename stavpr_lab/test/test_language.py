# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Words that the prose, names and messages of this package avoid, and their replacements."""

from collections.abc import Iterator
import os
from pathlib import Path
import re

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
REPLACEMENTS = WORDS | SPELLINGS
# Vague words, where terms of the field are exact: path, state, block, except, or a repeated noun.
VAGUE = re.compile(r'\b(ways?|some|holds?|held|stands?|sees?|seen|th(at|ose) of)\b', re.IGNORECASE)
MAX_VAGUE, SLACK = 207, 20  # MAX_VAGUE only falls
INNER = ('stavpr_fleet', 'stavpr_slam', 'stavpr_nav', 'stavpr_lab')
PACKAGES = ('stavpr_ros', 'stavpr_msgs', *(f'{name}/{name}' for name in INNER))
AVOIDED = re.compile('|'.join([rf'(?<![^\W_])(?:{"|".join(WORDS)})(?![^\W_])', *SPELLINGS]))


def repository_files(*suffixes: str) -> Iterator[Path]:
    for folder, subfolders, files in os.walk(ROOT):
        subfolders[:] = sorted(
            name for name in subfolders if not name.startswith('.') and name not in NOT_OURS
        )
        yield from (Path(folder, name) for name in sorted(files) if name.endswith(suffixes))


def findings(text: str) -> Iterator[str]:
    """Yield 'LINE: TEXT (REPLACEMENT)' for every avoided word or part of a word."""
    text = re.sub(r'https?://\S+', '', text).lower()
    for match in AVOIDED.finditer(text):
        line, words = text.count('\n', 0, match.start()) + 1, match.group()
        replacement = next(REPLACEMENTS[old] for old in REPLACEMENTS if re.match(old, words))
        yield f'{line}: {words} ({replacement})'


def test_prose_uses_terms_of_field():
    found = [
        f'{path.relative_to(ROOT)}:{line}'
        for path in repository_files(*SUFFIXES)
        if path != Path(__file__).resolve()
        for line in findings(path.read_text(encoding='utf-8'))
    ]
    assert not found, f'{len(found)} avoided words:\n' + '\n'.join(found)


def test_vague_words_become_fewer():
    files = [
        path
        for path in repository_files('.py', '.msg', '.srv')
        if any(path.is_relative_to(ROOT / package) for package in PACKAGES)
    ]
    count = sum(len(VAGUE.findall(path.read_text(encoding='utf-8'))) for path in files)
    assert count <= MAX_VAGUE, f'{count} of {VAGUE.pattern}: {MAX_VAGUE} is the limit'
    assert count >= MAX_VAGUE - SLACK, f'lower MAX_VAGUE to {count}'
