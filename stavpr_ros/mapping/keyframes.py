"""Which images of a drive become places: rules of time, motion and change of the picture."""

import dataclasses
from dataclasses import dataclass
from math import isfinite

import cv2
import numpy as np

from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.trajectory import checked_pose, distance, rotation

SECOND = 1_000_000_000
OVERTAKEN = SECOND // 10  # images less than this out of order overtook each other; the clock did not jump
SIZE = (32, 24)  # width and height of the pictures compared: noise is averaged out, motion is not
BLUR = 0.5  # pixels of the small picture
FLAT = 1.0  # gray levels of deviation below which a picture shows nothing but noise


@dataclass(frozen=True)
class KeyframeSettings:
    """
    Least differences between an image and the last keyframe; 0 = that rule is off.

    All rules that are on must agree, but meters and degrees are one rule: moved so far *or* turned so much.

    :param seconds: time between the two.
    :param meters: way between where the two were taken.
    :param degrees: angle by which the camera was turned, up to 180.
    :param change: :func:`image_change` of the two, up to 2.
    :raises SettingsError: a number that is negative, not finite or out of reach.
    """

    seconds: float = 0.0
    meters: float = 0.0
    degrees: float = 0.0
    change: float = 0.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value >= 0):
                raise SettingsError(f'keyframe {field.name} = {value} must be 0 (rule off) or more')
        if self.degrees > 180:
            raise SettingsError(f'keyframe degrees = {self.degrees}: nothing turns further than 180')
        if self.change > 2:
            raise SettingsError(f'keyframe change = {self.change}: no two images differ by more than 2')

    @property
    def any(self) -> bool:
        """Any rule is on: not every image is a keyframe."""
        return bool(self.seconds or self.needs_poses or self.change)

    @property
    def needs_poses(self) -> bool:
        """The rule of motion is on."""
        return bool(self.meters or self.degrees)


def small_gray(image: np.ndarray) -> np.ndarray:
    """
    Return the small, blurred, gray picture by which images are compared.

    :param image: RGB, uint8, shape (h, w, 3).
    :returns: float32, shape (24, 32).
    """
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(gray, (0, 0), BLUR))


def image_change(a: np.ndarray, b: np.ndarray) -> float:
    """
    Tell how much two pictures differ: 1 - their normalized cross-correlation, blind to brightness and gain.

    :param a: of :func:`small_gray`, shape (24, 32), float32; so is b.
    :returns: 0 (alike) to 2 (one is the other's negative); two flat pictures 0, one flat picture 1.
    """
    a, b = a - a.mean(), b - b.mean()
    least = FLAT * np.sqrt(a.size)
    norms = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    flat = [norm < least for norm in norms]
    if any(flat):
        return 0.0 if all(flat) else 1.0
    return float(np.clip(1.0 - np.vdot(a, b) / (norms[0] * norms[1]), 0.0, 2.0))


class KeyframeSelector:
    """
    Tells the images that become keyframes from those that are too like the last one.

    Ask :meth:`too_soon` first, which needs no image, then :meth:`too_alike`; if neither objects,
    :meth:`accept`. The first image of all is a keyframe, unless the rule of motion is on and has no pose.

    :param settings: the rules; may be replaced at any time, the last keyframe is kept.
    """

    def __init__(self, settings: KeyframeSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget the last keyframe: the next image is one."""
        self._stamp = 0
        self._pose: np.ndarray | None = None
        self._gray: np.ndarray | None = None
        self._asked: tuple[np.ndarray, np.ndarray] | None = None  # the image asked about last, and its gray

    def too_soon(self, stamp: int, pose: np.ndarray | None) -> str:
        """
        Tell why an image is no keyframe, as far as time and motion say.

        A moment or pose that is not known of the last keyframe cannot object; nor can a stamp 0.1 s
        or more before its stamp: the clock has jumped.

        :param stamp: nanoseconds; 0 = unknown.
        :param pose: where it was taken, shape (7,), see :class:`PlaceMap`; None = unknown.
        :returns: the reason in words; empty if there is none.
        :raises InputError: a pose that is none.
        """
        settings = self.settings
        if settings.needs_poses and pose is None:
            return 'no odometry for this image, and the rule of motion (meters, degrees) is on'
        if settings.seconds and stamp and self._stamp:
            passed = stamp - self._stamp
            if -OVERTAKEN < passed < round(settings.seconds * SECOND):
                return f'{passed / SECOND:.3f} s after the last keyframe: less than {settings.seconds:g} s'
        if settings.needs_poses and self._pose is not None and pose is not None:
            return self._not_moved(checked_pose(pose), self._pose)
        return ''

    def too_alike(self, image: np.ndarray) -> str:
        """
        Tell why an image is no keyframe, as far as its picture says.

        :param image: RGB, uint8, shape (h, w, 3).
        :returns: the reason in words; empty if there is none.
        """
        least = self.settings.change
        if not least or self._gray is None:
            return ''
        self._asked = image, small_gray(image)
        change = image_change(self._asked[1], self._gray)
        if change < least:
            return f'differs by {change:.4f} from the last keyframe: less than {least:g}'
        return ''

    def accept(self, stamp: int, pose: np.ndarray | None, image: np.ndarray) -> None:
        """
        Make an image the last keyframe: the next ones are compared with it.

        :param stamp: nanoseconds; 0 = unknown.
        :param pose: where it was taken, shape (7,); None = unknown.
        :param image: RGB, uint8, shape (h, w, 3).
        :raises InputError: a pose that is none; nothing is changed then.
        """
        pose = None if pose is None else checked_pose(pose)
        # made even if the rule is off: it may be on when the next image comes
        asked, self._asked = self._asked, None
        gray = asked[1] if asked is not None and asked[0] is image else small_gray(image)
        self._stamp, self._pose, self._gray = stamp, pose, gray

    def _not_moved(self, pose: np.ndarray, last: np.ndarray) -> str:
        rules = self.settings
        moved, turned = distance(pose, last), rotation(pose, last)
        if (rules.meters and moved >= rules.meters) or (rules.degrees and turned >= rules.degrees):
            return ''
        words = []
        if rules.meters:
            words.append(f'moved {moved:.3f} m of {rules.meters:g} m')
        if rules.degrees:
            words.append(f'turned {turned:.2f} of {rules.degrees:g} degrees')
        return ' and '.join(words) + ' since the last keyframe'
