"""What to simulate, as data: validated scenarios, and presets in TOML files."""

from .layouts import place_landmarks as place_landmarks
from .scenario import Scenario as Scenario
from .scenario import action_sequence as action_sequence
from .scenario import drawn_scenario as drawn_scenario
from .scenario_errors import ScenarioError as ScenarioError
from .scenario_files import list_presets as list_presets
from .scenario_files import load_scenario as load_scenario
from .scenario_files import save_scenario as save_scenario
from .scenario_parts import Robot as Robot

__all__ = [
    "Robot",
    "Scenario",
    "ScenarioError",
    "action_sequence",
    "drawn_scenario",
    "list_presets",
    "load_scenario",
    "place_landmarks",
    "save_scenario",
]
