# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Ceilings on the size of the repository: ``make lint`` fails above one.

A change that takes something away lowers its ceiling to what is there; one that may add says by
how much, and raises it by that. ``python3 tools/ceilings.py`` prints the table.
"""

import ast
from collections.abc import Iterable, Mapping
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = {
    'lines of stavpr_ros': 30_885,
    'lines of stavpr_fleet': 1_199,
    'lines of stavpr_slam': 4_298,
    'lines of stavpr_nav': 1_622,
    'lines of stavpr_lab': 12_190,
    'lines of the method (prepare, method)': 5_642,
    'lines of all tests': 33_648,
    'lines of benchmarks and tools': 9_250,
    'lines of docs and README': 3_300,
    'parameters of the node': 51,
    'numbers in constants of the method': 147,
}
METHOD = ('prepare', 'method')


def lines(*patterns: str) -> int:
    """Return the lines of all files that match; built documentation aside."""
    files = {file for pattern in patterns for file in ROOT.glob(pattern)}
    texts = (file.read_text() for file in sorted(files) if '_build' not in file.parts)
    return sum(text.count('\n') for text in texts)


def node_parameters() -> int:
    """Return the number of parameters of the node."""
    tree = ast.parse((ROOT / 'stavpr_ros' / 'parameters.py').read_text())
    names = (node.func.id for node in ast.walk(tree) if is_call(node))
    return sum(name == 'NodeParameter' for name in names)


def is_call(node: ast.AST) -> bool:
    """Whether a node calls a function by its name."""
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name)


def numbers_of(tree: ast.Module) -> int:
    """Return how many numbers, but 0 and 1, are in constants, and in defaults of fields."""
    values: list[ast.AST] = []
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (
                part.id for t in targets for part in ast.walk(t) if isinstance(part, ast.Name)
            )
            if node.value and all(name.isupper() for name in names):
                values.append(node.value)
        elif isinstance(node, ast.ClassDef):
            fields = (field for field in node.body if isinstance(field, ast.AnnAssign))
            values += [field.value for field in fields if field.value]
    literals = (literal for value in values for literal in ast.walk(value))
    return sum(
        isinstance(literal, ast.Constant)
        and type(literal.value) in (int, float)
        and literal.value not in (0, 1)
        for literal in literals
    )


def method_numbers() -> int:
    """Return how many numbers the rooms of the method have in constants and defaults."""
    files = (file for room in METHOD for file in (ROOT / 'stavpr_ros' / room).rglob('*.py'))
    return sum(numbers_of(ast.parse(file.read_text())) for file in files)


def sizes() -> dict[str, int]:
    """Measure all that has a ceiling."""
    packages = ('stavpr_fleet', 'stavpr_slam', 'stavpr_nav', 'stavpr_lab')
    return {
        'lines of stavpr_ros': lines('stavpr_ros/**/*.py'),
        **{f'lines of {name}': lines(f'{name}/{name}/**/*.py') for name in packages},
        'lines of the method (prepare, method)': lines(
            *(f'stavpr_ros/{room}/**/*.py' for room in METHOD)
        ),
        'lines of all tests': lines('test/**/*.py', 'stavpr_*/test/**/*.py'),
        'lines of benchmarks and tools': lines('benchmarks/*.py', 'tools/*.py'),
        'lines of docs and README': lines('docs/**/*.md', 'docs/**/*.rst', 'README.md'),
        'parameters of the node': node_parameters(),
        'numbers in constants of the method': method_numbers(),
    }


def excess(measured: Mapping[str, int], ceilings: Mapping[str, int]) -> Iterable[str]:
    """Yield a sentence for each size above its ceiling."""
    for name, size in measured.items():
        if size > ceilings[name]:
            yield (
                f'{size:,} {name}, {size - ceilings[name]:,} above the ceiling {ceilings[name]:,} '
                'of tools/ceilings.py: take something away, or raise it by what your issue allows'
            )


def main() -> int:
    """Run the command; 1 above a ceiling."""
    measured = sizes()
    for name, size in measured.items():
        print(f'{size:>7,} of {CEILINGS[name]:>7,} {name}')
    above = list(excess(measured, CEILINGS))
    print('\n'.join(above), file=sys.stderr, end='\n' * bool(above))
    return bool(above)


if __name__ == '__main__':
    sys.exit(main())
