# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The language of README and docs: ``make lint`` fails at words that a reader stumbles over."""

from collections.abc import Iterable
from pathlib import Path
import re
import sys

ROOT = Path(__file__).resolve().parents[1]
PLAIN = {  # by pattern: what to write in its place
    r'(?-i:\bOf\b)|(?:^[*|]|[|;:])\s+of\s': 'begin with what acts, not with "of"',
    r'\b(?:that|those|the ones?) of\b': 'repeat the noun',
    r'\b(?:is|are|was|were) (?:not (?:an?|the)|no) [^.;:|]{,60}?,? but (?:an?|the|one)\b': (
        'say what it is, not what it is not'
    ),
    r'\b(?:all|every\w*|any\w*|none|no one) (?:\w+ ){,3}but (?:the|its|an?|for|those|these)\b': (
        'write "except"'
    ),
    r'\b(?:the|those|all) (?:given|found|kept|held|seen|driven|answered|missed|lost)'
    r'(?= (?:is|are|was|were|of|in|by|from)\b|[.,;:)])': 'a participle needs its noun',
    r'\b(?:what|all that) there (?:is|are|was)\b': 'name it',
    r'\bare no such\b': 'name them',
    r'\b(?:tells?|told) apart|\b(?:nodes?|robots?|maps?|filters?) (?:tells?|told|hears?)\b': (
        'write "distinguishes", "shows", "receives"'
    ),
    r'\b(?:[01]|features|means?) less (?!than)': 'write "minus"',
    r'\bthe ways? of an?\b': 'write "path", "route", "steps"',
    r'\b(?:map|file|route|session|window|journal|store)s? (?:holds?|held)\b': 'write "contains"',
    r'\bstanding (?:camera|robot)\b|\bcamera stands\b': 'write "at rest"',
}
CODE = re.compile(r'^```.*?^```|::\n\n(?: .*\n|\n)+|``.*?``|`[^`]*`', re.M | re.S)


def remarks(text: str) -> Iterable[tuple[int, str, str]]:
    """Yield line, words and remedy of each pattern that the prose of a page contains."""
    prose = CODE.sub(lambda code: re.sub(r'[^\n]', 'x', code[0]), text)
    for pattern, remedy in PLAIN.items():
        for words in re.finditer(pattern.replace(' ', r'\s+'), prose, re.M | re.I):
            line = prose.count('\n', 0, words.start()) + 1
            yield line, ' '.join(words[0].split()), remedy


def main() -> int:
    """Run the command; 1 where a page has a remark."""
    docs = (*ROOT.glob('docs/**/*.md'), *ROOT.glob('docs/**/*.rst'))
    pages = [ROOT / 'README.md', *sorted(page for page in docs if '_build' not in page.parts)]
    lines = [
        f'{page.relative_to(ROOT)}:{line}: "{words}": {remedy}'
        for page in pages
        for line, words, remedy in sorted(remarks(page.read_text()))
    ]
    print('\n'.join(lines), file=sys.stderr, end='\n' * bool(lines))
    return bool(lines)


if __name__ == '__main__':
    sys.exit(main())
