# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fast DDS, the default middleware of ROS 2 Jazzy, without dropped images."""

import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory, PackageNotFoundError
from stavpr_ros.errors import UnavailableError

PROFILES_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""Read by Fast DDS 2.14, which ignores the ``FASTDDS_`` spelling of later versions."""

PROFILES_FILE = 'config/fastdds_large_images.xml'


def prepare_transport() -> None:
    """
    Give this process shared memory that holds images; to be called before ``rclpy.init``.

    The default segment of 512 KiB is smaller than one 640x480 color image, and the publisher's
    segment is the one that counts. A profile set by the user stays; other middlewares ignore it.

    :raises UnavailableError: the package's share folder is not found.
    """
    if os.environ.get(PROFILES_VARIABLE):
        return
    try:
        profiles = Path(get_package_share_directory('stavpr_ros')) / PROFILES_FILE
    except PackageNotFoundError as error:
        raise UnavailableError(
            'the package stavpr_ros is not installed (no entry in AMENT_PREFIX_PATH): expected '
            f'its share folder with {PROFILES_FILE}; build it, source local_setup.bash'
        ) from error
    if not profiles.is_file():
        raise UnavailableError(
            f'{profiles} is missing: expected it in the installed package; build again'
        )
    os.environ[PROFILES_VARIABLE] = str(profiles)
