"""The choice of the device that the products are computed on."""

from stavpr_ros.errors import SettingsError, UnavailableError

DEVICES = ('auto', 'cpu', 'cuda')


def choose_device(wish: str) -> str:
    """
    Turn ``auto`` into ``cuda`` or ``cpu``.

    :raises SettingsError: no such device.
    :raises UnavailableError: ``cuda`` was asked for and is not there.
    """
    import torch

    if wish not in DEVICES:
        raise SettingsError(f'device {wish!r} is unknown: take one of {", ".join(DEVICES)}')
    available = torch.cuda.is_available()
    if wish == 'cuda' and not available:
        raise UnavailableError("device 'cuda': torch sees no CUDA device here; take 'cpu' or 'auto'")
    return ('cuda' if available else 'cpu') if wish == 'auto' else wish
