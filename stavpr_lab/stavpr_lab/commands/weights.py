# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab weights``: download the published weights of a network."""

import socket
import sys

from stavpr_lab.features import PublishedSettings
from stavpr_ros.commands.program import make_parser, run_program
from stavpr_ros.errors import SettingsError
from stavpr_ros.features.registry import backbone_class, kinds, settings_class

TIMEOUT_SECONDS = 30.0  # without a byte

EPILOG = """
Nothing else in this package goes online. The file is downloaded over https, compared with its
SHA-256, and then lies where the features of this kind look for it.

exit codes: 0 it is there; 1 it is not (the reason is printed); 2 usage
"""


def main(args: list[str] | None = None) -> int:
    """Run the command."""

    def work() -> None:
        parser = make_parser('weights', 'Download the published weights of a network.', EPILOG)
        published = [kind for kind in kinds() if settings_class(kind) is PublishedSettings]
        parser.add_argument('features', choices=published, help='kind of features')
        parser.add_argument(
            '--sha256', default='', help='hash of the file, 64 digits; known for vgg16'
        )
        arguments = parser.parse_args(args)
        from stavpr_lab.features import weights
        from stavpr_ros.features.model_files import cache_folder

        published = backbone_class(arguments.features).published
        sha256 = arguments.sha256.lower() or published.sha256
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
        print(f'{path}: sha256 {sha256}')

    return run_program('weights', work)


if __name__ == '__main__':
    sys.exit(main())
