"""What the node's worker owns: the map, the describer, the recogniser; one answer for one image message."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.errors import SettingsError, StavprError
from stavpr_ros.features import Describer
from stavpr_ros.mapping import PlaceMap, load_map
from stavpr_ros.recognition import Recogniser, RecognitionSettings
from stavpr_ros.recognition.cures import THRESHOLD, cures_of
from stavpr_ros.ros.messages import blank_match, match_message
from stavpr_ros.sources.encodings import decode_message


@dataclass(frozen=True)
class EngineOptions:
    """What is fixed while the node runs; see the table of parameters."""

    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    neighbourhood: int = 20
    mode: str = 'robust'
    backend: str = 'cpu'
    precision: str = 'float32'
    model_path: str = ''


class Engine:
    """
    Answers image messages. Belongs to one thread, which makes every call.

    :param options: what is fixed.
    """

    def __init__(self, options: EngineOptions) -> None:
        self._options = options
        self._map: PlaceMap | None = None
        self._describer: Describer | None = None
        self._recogniser: Recogniser | None = None
        self._threshold = self._default_threshold
        self._problem = "parameter 'map_path' is not set: make a map with build_map and name its file"
        self._headers: deque[Header] = deque(maxlen=options.sequence.length)
        self.invalid = 0

    @property
    def _default_threshold(self) -> float | None:
        """What is taken where none is set: distances of mode robust mean the same on every route."""
        return THRESHOLD if cures_of(self._options.mode).contrast else None

    def check_threshold(self, threshold: float) -> None:
        """
        Refuse a value of the parameter that cannot be meant; negative = not set.

        :raises SettingsError: 0, or in mode robust above 1.
        """
        if threshold == 0:
            raise SettingsError('threshold = 0 would match nothing: set it above 0, or negative = not set')
        if threshold > 0:
            RecognitionSettings(threshold, mode=self._options.mode)

    @property
    def threshold(self) -> float | None:
        """The threshold in force, None = not set."""
        return self._threshold

    @property
    def missing(self) -> str:
        """Why there can be no match yet, in words; empty when everything is there."""
        if self._map is None:
            return self._problem
        if self._threshold is None:
            return "parameter 'threshold' is not set: build_map suggests one, 'ros2 param set' sets it"
        return ''

    def load(self, path: str) -> PlaceMap:
        """
        Load a map and make ready for it; on an error everything stays as it was.

        :raises StavprError: the file, the model or the settings do not do.
        """
        try:
            place_map = load_map(path)
            describer = place_map.describer(self._options.backend, self._options.model_path)
            self._warm_up(place_map, describer)
        except StavprError as error:
            if self._map is None:
                self._problem = str(error)
            raise
        self._map, self._describer = place_map, describer
        self._restart()
        return place_map

    def set_threshold(self, threshold: float | None) -> None:
        """Change the threshold; None takes it away (mode paper) or back to the default (mode robust)."""
        self._threshold = self._default_threshold if threshold is None else threshold
        if self._recogniser is not None and self._threshold is not None:
            self._recogniser.set_threshold(self._threshold)
        else:
            self._restart()

    def _restart(self) -> None:
        self._headers.clear()
        self._recogniser = None
        if self._map is not None and self._threshold is not None:
            self._recogniser = self._make_recogniser(self._map, self._threshold)

    def _make_recogniser(self, place_map: PlaceMap, threshold: float) -> Recogniser:
        o = self._options
        settings = RecognitionSettings(threshold, o.spatial, o.sequence, o.neighbourhood, o.mode)
        return Recogniser(place_map, settings, o.backend, o.precision)

    def _warm_up(self, place_map: PlaceMap, describer: Describer) -> None:
        """Compile and touch everything once, so that the first image is as fast as the rest."""
        recogniser = self._make_recogniser(place_map, 1.0)
        features = describer.describe([np.zeros((480, 640, 3), np.uint8)])
        for _ in range(self._options.sequence.length):
            recogniser.add(features)

    def process(self, message: Image) -> PlaceMatch:
        """Answer one image. Bad images are counted and answered as such; the window goes on without them."""
        if self._recogniser is None or self._describer is None or self._map is None:
            return blank_match(message.header, PlaceMatch.NOT_READY, self.missing, self._threshold)
        try:
            features = self._describer.describe([decode_message(message)])
            recognition = self._recogniser.add(features)
        except StavprError as error:
            self.invalid += 1
            return blank_match(message.header, PlaceMatch.INVALID_IMAGE, str(error), self._threshold)
        self._headers.append(message.header)
        return match_message(recognition, list(self._headers), self._map)
