# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab export_model``: any network to one ONNX file of vectors and maps."""

import argparse
import hashlib
import json
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from stavpr_ros.commands.program import make_parser, run_program, say
from stavpr_ros.errors import SettingsError
from stavpr_ros.output_file import atomic_output, ONNX, require_replaceable

if TYPE_CHECKING:
    from stavpr_lab.features.export import Exported

LICENSES = ('LICEN', 'COPYING')  # in American and British spelling

DESCRIPTION = """
Makes one ONNX file, with the outputs `global` (a vector an image) and `map`, of the network that
an entry of a torch.hub repository returns. The file is compared with the original on random
images. build_map and the node take it as features onnx.
"""

EPILOG = """
A repository is a program of somebody else, which runs with all your rights, here and only here,
and only with --allow-foreign-code. Its own downloads (weights, other repositories) are not pinned
by --commit.

examples:
  export_model --repository gmberton/MegaLoc --commit SHA --entry get_trained_model --size 322 \\
      --map-module backbone --allow-foreign-code --output megaloc.onnx
  export_model --repository facebookresearch/dinov2 --commit SHA --entry dinov2_vits14_reg \\
      --map-module norm --prefix-tokens 5 --size 224 --allow-foreign-code --output dinov2.onnx

docs/features.md has recipes. exit codes: 0 done, 1 failed (the reason is printed), 2 usage
"""


def _argument(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition('=')
    if not separator or not name.isidentifier():
        raise argparse.ArgumentTypeError(f'{text}: expected NAME=JSON')
    try:
        return name, json.loads(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text}: {value!r} is no JSON ({error})') from error


def _parser() -> argparse.ArgumentParser:
    parser = make_parser('export_model', DESCRIPTION, EPILOG)
    add = parser.add_argument_group('network').add_argument
    repository = 'with a hubconf.py'
    add('--repository', required=True, metavar='OWNER/NAME|FOLDER', help=repository)
    add('--commit', default='', metavar='SHA', help='commit of a repository on GitHub, 40 digits')
    add('--entry', required=True, metavar='NAME', help='function in hubconf.py')
    text = 'argument of the entry: fc_output_dim=512, backbone=\'"ResNet18"\'; may be repeated'
    add('--argument', action='append', type=_argument, default=[], metavar='NAME=JSON', help=text)
    add('--allow-foreign-code', action='store_true', help='run the repository')
    add = parser.add_argument_group('outputs').add_argument
    add('--size', type=int, default=224, help='side of the images in pixels (%(default)s)')
    vector = "which output of the network is the vector: number or key, '' for none (0)"
    add('--vector', default='0', metavar='OUTPUT', help=vector)
    add('--map-module', default='', metavar='PATH', help='module whose output is the map')
    maps = 'which of its outputs, or of the network, is the map or the tokens (0 with a module)'
    add('--map', metavar='OUTPUT', help=maps)
    prefix = 'leading tokens that are no patches: class token, registers (%(default)s)'
    add('--prefix-tokens', type=int, default=1, metavar='N', help=prefix)
    add('--output', required=True, metavar='FILE', help='the ONNX file to write')
    add('--force', action='store_true', help='replace an existing file')
    return parser


def _export(arguments: argparse.Namespace) -> 'Exported':
    if not arguments.allow_foreign_code:
        raise SettingsError(
            f'--repository {arguments.repository} is a program, which would run with all your '
            'rights: give --allow-foreign-code if you trust its source'
        )
    if not 8 <= arguments.size <= 4096:
        raise SettingsError(f'--size {arguments.size} must be 8 to 4096 pixels')
    require_replaceable(arguments.output, ONNX, arguments.force)
    from stavpr_lab.features.export import Chosen, export_network, load_hub
    import torch

    torch.backends.mha.set_fastpath_enabled(False)  # its operator is not in the ONNX standard
    hub_arguments, module, maps = dict(arguments.argument), arguments.map_module, arguments.map
    if maps is None:
        maps = '0' if module else ''
    network = load_hub(arguments.repository, arguments.commit, arguments.entry, hub_arguments)
    say(f'license of {arguments.repository}: {_license(arguments)}')
    outputs = Chosen(network, arguments.vector, module, maps, arguments.prefix_tokens)
    return export_network(outputs, arguments.size)


def _license(arguments: argparse.Namespace) -> str:
    """Return the first lines of the repository's license, or that there is none."""
    import torch

    folder = Path(arguments.repository)
    if not folder.is_dir():
        name = f'{arguments.repository.replace("/", "_")}_{arguments.commit}'
        folder = Path(torch.hub.get_dir()) / name
    for path in sorted(folder.glob('*')) if folder.is_dir() else ():
        if path.name.upper().startswith(LICENSES) and path.is_file():
            lines = [line.strip() for line in path.read_text(errors='replace').splitlines()]
            return ', '.join([line for line in lines if line][:2])[:120]
    return 'none was found: without one, its weights may not be used'


def main(args: list[str] | None = None) -> int:
    """Run the command."""

    def work() -> None:
        arguments = _parser().parse_args(args)
        result = _export(arguments)
        with atomic_output(arguments.output, ONNX, arguments.force) as file:
            file.write(result.content)
        for name, shape in result.shapes.items():
            say(f'output {name}: {shape}')
        print(
            f'verified on random images: largest difference {result.difference:.1e} of the '
            f'largest value; {"batches" if result.batch else "one image at a time"}'
        )
        digest = hashlib.sha256(result.content).hexdigest()
        size = len(result.content) / 1e6
        say(f'{arguments.output}: {size:.1f} MB, sha256 {digest}')
        layer = 'global' if 'global' in result.shapes else 'map'
        print(
            f'use: --features onnx --onnx-model {arguments.output} --onnx-layer {layer} '
            f'--onnx-size {arguments.size}'
        )
        if len(result.shapes) > 1:
            print('or, strips: --onnx-layer map')

    return run_program('export_model', work)


if __name__ == '__main__':
    sys.exit(main())
