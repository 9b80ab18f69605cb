"""Settings of the pipeline."""

from dataclasses import dataclass, field

from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import KINDS, settings_from_json
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.recognition import RecognizerSettings
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.robust.options import LOOP_THRESHOLD, THRESHOLD, options_of
from stavpr_ros.recognition.verification import GeometricSettings

OPERATIONS = ('localization', 'mapping', 'loop_closure')


@dataclass(frozen=True)
class PipelineSettings:
    """
    How images are turned into answers; the fields are the node's parameters of these names.

    :param threshold: a window is matched when its distance is below it; None = the mode's default, which
        mode paper does not have.
    :param features: kind of the features of a route that is begun without a map.
    :param feature_settings: settings of that kind as a JSON object, '' = its defaults.
    :param exclude_places: the latest places that are not compared in operation loop_closure.
    :param exclude_seconds: nor are places younger than this.
    :param max_places: most places of a growing map. When it is full, mapping stops, and loop closure forgets
        the oldest eighth of its route.
    :param thumbnail_width: pixels of the pictures that growing maps keep, 0 = none.
    :param candidates: nearest places that are told for every window.
    :param geometric: the geometric check of matches, None = none.
    :raises SettingsError: a value that cannot be meant, or values that do not go together.
    """

    threshold: float | None = None
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    nms_radius: int = 20
    mode: str = 'robust'
    backend: str = 'cpu'
    precision: str = 'float32'
    model_path: str = ''
    features: str = 'gradient'
    feature_settings: str = ''
    exclude_places: int = 50
    exclude_seconds: float = 0.0
    max_places: int = 20000
    thumbnail_width: int = 192
    candidates: int = 10
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    geometric: GeometricSettings | None = None

    def __post_init__(self) -> None:
        if self.threshold == 0:
            raise SettingsError('threshold = 0 would match nothing: set it above 0, or negative = not set')
        if self.features not in KINDS:
            raise SettingsError(f'features {self.features!r} are unknown: take one of {", ".join(KINDS)}')
        if self.feature_settings:
            settings_from_json(self.features, self.feature_settings)
        self.recognition(self.threshold or THRESHOLD)

    def applied_threshold(self, operation: str) -> float | None:
        """Return the threshold in force; distances of mode robust mean the same on every route."""
        if self.threshold is not None:
            return self.threshold
        if not options_of(self.mode).second_best_margin:
            return None
        return LOOP_THRESHOLD if operation == 'loop_closure' else THRESHOLD

    def recognition(self, threshold: float) -> RecognizerSettings:
        """Return the recognizer's part."""
        return RecognizerSettings(threshold, self.spatial, self.sequence, self.nms_radius, self.mode)

    def extractor(self) -> FeatureExtractor:
        """
        Make the extractor of a route that is begun without a map.

        :raises StavprError: the features' settings do not do, a model's file is not there.
        """
        backbone = None
        if self.feature_settings or self.model_path:
            backbone = settings_from_json(self.features, self.feature_settings or '{}', self.model_path)
        return FeatureExtractor(self.features, backbone, device=self.backend)

    def loop_closer(self, extractor: FeatureExtractor, threshold: float) -> LoopCloser:
        """
        Make what closes loops, with an empty route.

        :raises SettingsError: settings that it does not have.
        """
        return LoopCloser(
            self.recognition(threshold),
            self.exclude_places,
            extractor.settings,
            limit=self.max_places,
            exclude_seconds=self.exclude_seconds,
            backend=self.backend,
            precision=self.precision,
        )
