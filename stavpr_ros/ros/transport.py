"""Makes Fast DDS, the default middleware of ROS 2 Jazzy, carry images without dropping them."""

import os
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from stavpr_ros.errors import UnavailableError

PROFILES_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""What Fast DDS 2.14 reads; it ignores the ``FASTDDS_`` spelling of later versions."""

PROFILES_FILE = 'config/fastdds_large_images.xml'


def prepare_transport() -> None:
    """
    Give this process shared memory that holds images; call it before ``rclpy.init``.

    The default segment of 512 KiB is smaller than one 640x480 color image, and the publisher's segment is
    what counts. A profile that the user has set stays; other middlewares do not read it.

    :raises UnavailableError: the package's share folder is not found.
    """
    if os.environ.get(PROFILES_VARIABLE):
        return
    try:
        profiles = Path(get_package_share_directory('stavpr_ros')) / PROFILES_FILE
    except PackageNotFoundError as error:
        raise UnavailableError(
            'the package stavpr_ros is not installed here (no entry in AMENT_PREFIX_PATH): expected its '
            f'share folder with {PROFILES_FILE}; build it, source local_setup.bash'
        ) from error
    if not profiles.is_file():
        raise UnavailableError(f'{profiles} is not there: expected it in the installed package; build again')
    os.environ[PROFILES_VARIABLE] = str(profiles)
