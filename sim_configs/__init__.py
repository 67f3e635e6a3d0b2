"""What to simulate, as data: validated scenarios, and presets in TOML files."""

from typing import TYPE_CHECKING

from ..public_names import attach

if TYPE_CHECKING:
    from .field_types import ScenarioError as ScenarioError
    from .landmarks_and_controls import place_landmarks as place_landmarks
    from .scenario import Robot as Robot
    from .scenario import Scenario as Scenario
    from .scenario import action_sequence as action_sequence
    from .scenario_files import drawn_scenario as drawn_scenario
    from .scenario_files import list_presets as list_presets
    from .scenario_files import load_scenario as load_scenario
    from .scenario_files import save_scenario as save_scenario
else:
    __getattr__, __dir__, __all__ = attach(__name__)
