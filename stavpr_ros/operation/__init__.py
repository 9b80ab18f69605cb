"""What the node does with each image, without ROS: localization, mapping, loop closure."""

from stavpr_ros.operation.begin import read_map
from stavpr_ros.operation.engine import Engine
from stavpr_ros.operation.outcome import Answer, Outcome, place_facts
from stavpr_ros.operation.settings import OPERATIONS, EngineSettings

__all__ = ['OPERATIONS', 'Answer', 'Engine', 'EngineSettings', 'Outcome', 'place_facts', 'read_map']
