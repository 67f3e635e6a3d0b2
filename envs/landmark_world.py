"""The landmark world: a unicycle robot among landmarks, as a Gymnasium environment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter, getitem
from pathlib import Path
from reprlib import repr as short_repr
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array, ComplexArray, ImageArray, WordArray
from ..restorable import Restorable, State, refuse_other_state
from ..sim_configs import Scenario, load_scenario
from ..sim_configs.landmarks_and_controls import possible_positions
from ..sim_configs.scenario import refuse_unknown_keywords
from ..suggestions import closest
from .bearing_range import BearingRangeSensor, hide_identities
from .drives import drive_of
from .noise_streams import NoiseRows, PoseSensors, WorldNoise, row_of
from .random_numbers import EpisodeStarts, drawn_scenarios, episode_keys
from .robot import OdometrySensor, UnicycleBody
from .spaces import action_space, clipped_action, observation_space
from .specs import plain_spec

if TYPE_CHECKING:
    from .rendering.episode_renderer import EpisodeRenderer
    from .rendering.render_state import BeliefLike

Observation = dict[str, Any]

OF_A_WORLD = "of a world"  # in messages
_OPTIONS = "pose", "landmarks", "scenario"
_FPS = 30


class LandmarkWorldEnv(Restorable, gymnasium.Env[Observation, AnyArray]):
    """A robot drives among point landmarks and measures its motion and the landmarks.

    ## Description
    The plant of a SLAM problem. A unicycle robot drives among N point landmarks and
    stops at walls. It returns noisy odometry and bearing-range measurements. Only
    `info` contains the truth. A :class:`~slamgym.sim_configs.Scenario` describes the
    world. One step drives d = v Δt along the heading, then turns by α = ω Δt.

    ## Action Space
    ``Box(float32, (2,))``: (v, ω), speed [m/s] and turn rate [rad/s], within ± the
    limits of the robot. Actions beyond the limits are clipped, and float64 keeps its
    precision. Anything but two finite numbers raises a `ValueError`.

    ## Observation Space
    ``Dict`` of three arrays:

    | key | shape | content |
    |---|---|---|
    | ``landmarks`` | (M, 2) float64 | rows (bearing in [-π, π), range) [rad, m], zeros where unseen |
    | ``mask`` | (M,) bool | rows with a measurement |
    | ``odometry`` | (2,) float64 | measured (d, α) [m, rad]; zeros at reset |

    With identities, M = N and row i is landmark i. With hidden identities, M = N +
    ``max_clutter``, and the first rows hold the measurements in random order. The
    observation of `reset` is measured from the start pose.

    `info` has the same keys in `reset` and `step`: ``pose``, the true (x, y, θ) with θ
    not wrapped; ``collision``, whether a wall stopped the robot; and, with hidden
    identities, ``landmark_ids`` (M,) int64, -1 where a row is clutter or empty.

    ## Rewards
    Always 0.

    ## Starting State
    ``scenario.start.pose``. Either the true start or the start pose of a filter
    (`start_estimate`) is drawn around it. A random layout without its own seed places
    new landmarks in every episode. Ranges (``randomise``) draw noise, sensor and start
    anew, see `drawn_scenario`. The options of `reset` change one episode:

    | option | content |
    |---|---|
    | ``pose`` | (x, y, θ) [m, m, rad] in place of ``scenario.start.pose`` |
    | ``landmarks`` | positions of all N landmarks, shape (N, 2) [m] |
    | ``scenario`` | a world for the same robot, with readings of the same form |

    ## Episode End
    Never terminated; truncated after ``scenario.steps`` steps.

    ## Arguments
    scenario : Scenario, mapping, str or Path, default "six_landmarks"
        A preset's name, a ``.toml`` file, a mapping of plain values, or a scenario. An
        ``EnvSpec`` written as JSON keeps plain data only.
    render_mode : {"human", "rgb_array"}, optional
        "human" shows every step in a window; with "rgb_array" `render` returns frames.
    **changes
        Fields of the scenario to replace, as in `Scenario.with_changes`.

    ## Version History
    * v0: initial version

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> env = gymnasium.make("slamgym/LandmarkWorld-v0", sensor={"max_range": 7.0})
    >>> observation, info = env.reset(seed=0)
    >>> observation["mask"]
    array([ True, False, False, False, False, False])
    >>> observation, *_ = env.step([1.0, 0.0])
    >>> observation["odometry"]
    array([3., 0.])
    """  # noqa: E501 (tables)

    metadata = {  # noqa: RUF012 (Gymnasium's form)
        "render_modes": ["human", "rgb_array"],
        "render_fps": _FPS,
    }
    changing: ClassVar[tuple[str, ...]] = (
        *("_np_random", "_body", "_motion_noise", "_sensor_noise", "_renderer"),
    )
    replaced = (
        *("_drawn_scenario", "_np_random_seed", "_key"),
        *("_landmarks", "_start_estimate", "_steps_left", "scenario"),
    )
    #: What the worlds of all episodes have in common.
    fixed: ClassVar[tuple[str, ...]] = (
        *("dt", "steps", "robot", "compass", "gps", "landmarks.count"),
        *("sensor.kind", "sensor.identities", "sensor.max_clutter"),
    )
    _spec: EnvSpec | None = None
    _key: WordArray

    def __init__(
        self,
        scenario: Scenario | Mapping[str, object] | str | Path = "six_landmarks",
        *,
        render_mode: str | None = None,
        **changes: object,
    ) -> None:
        refuse_unknown_keywords(changes, ("scenario", "render_mode"), where=OF_A_WORLD)
        self.scenario = load_scenario(scenario).with_changes(**changes)
        self.action_space = action_space(self.scenario)
        self.observation_space = observation_space(self.scenario)
        self.render_mode = render_mode
        self._renderer: EpisodeRenderer | None = None
        if render_mode is not None:
            from .rendering.episode_renderer import EpisodeRenderer  # noqa: PLC0415

            self._renderer = EpisodeRenderer(self.scenario, render_mode, fps=_FPS)
        robot, self._dt = self.scenario.robot, self.scenario.dt
        self._limits = robot.max_speed, robot.max_turn_rate
        self._drive = drive_of(robot)
        self._body = UnicycleBody(robot.radius, self.scenario.walls, self._drive)
        self._pose_sensors = PoseSensors(self.scenario)
        self._hides_identities = not self.scenario.sensor.identities
        self._landmarks: ComplexArray = np.empty(0, dtype=np.complex128)
        self._drawn_scenario = self.scenario
        self._adopt(self.scenario)

    @property
    def spec(self) -> EnvSpec | None:
        """The specification it was made from, with the length of its episodes."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and plain_spec(spec, self.scenario.steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode, and measure from the start pose.

        Parameters
        ----------
        seed : int >= 0, optional
            Seed of all randomness in this episode and the following ones.
        options : dict, optional
            ``pose``, ``landmarks`` and ``scenario`` of this episode.

        Raises
        ------
        ValueError
            If an option is unknown or malformed, or the readings would not fit the
            observation space. The episode before it then continues.
        """
        world, changes = self._asked(options) if options else (self.scenario, {})
        super().reset(seed=seed)
        self._key = key = episode_keys([self.np_random])
        drawn = drawn_scenarios(world, key)[0]
        if changes and drawn is not world:  # ranges have changed them once more
            drawn = drawn.with_changes(**changes)
        is_new = drawn is not self._drawn_scenario
        if is_new:
            self._adopt(drawn)
        if is_new or self._starts.redraws_landmarks or len(self._landmarks) == 0:
            self._landmarks = self._starts.landmarks(key)
        poses, estimates = self._starts.poses(key)
        self._body.place(poses[0].tolist())
        self._start_estimate: Array = estimates[0]
        self._motion_noise.begin(key, first=1)
        self._sensor_noise.begin(key, first=0)
        self._steps_left = self.scenario.steps
        if self._renderer is not None:
            self._renderer.begin(self.landmarks, world)
        return self._observe(odometry=np.zeros(2), collision=False)

    def step(
        self, action: ArrayLike
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive and turn for one step, then measure.

        Parameters
        ----------
        action : array_like, shape (2,)
            (v, ω) [m/s, rad/s].

        Raises
        ------
        ValueError
            If the action is not two finite numbers. The world does not change.
        """
        speed, turn_rate = clipped_action(action, self._limits)
        command = speed * self._dt, turn_rate * self._dt
        if self._drive is not None:
            command = self._drive.feasible(*command)
        self._refuse_before_reset()
        noise = next(self._motion_noise).tolist()
        slip, error = self._odometer.split_noise(command, noise)
        share = self._body.drive(command, slip)
        odometry = self._odometer.read(command, share, error)
        self._steps_left -= 1
        observation, info = self._observe(odometry, collision=share < 1.0)
        return observation, 0.0, False, self._steps_left <= 0, info

    def state(self) -> State:
        """Return all that later steps depend on, for `restore`.

        It includes the generator, and with it the noise and episodes to come. A planner
        that must not know them seeds its own world. Wrappers keep what is theirs, so
        call it on ``env.unwrapped``.

        Examples
        --------
        >>> env = LandmarkWorldEnv("corridor")
        >>> observation, info = env.reset(seed=0)
        >>> state = env.state()
        >>> first = [env.step([1.0, 0.2])[0]["odometry"] for _ in range(5)]
        >>> env.restore(state)
        >>> second = [env.step([1.0, 0.2])[0]["odometry"] for _ in range(5)]
        >>> np.array_equal(first, second)
        True
        """
        self._refuse_before_reset()
        return super().state()

    def restore(self, state: State) -> None:
        """Return to a state of this world, which stays usable for further calls.

        Raises
        ------
        gymnasium.error.ResetNeeded
            Before the first episode.
        ValueError
            If this is no state of such a world, or that of another scenario.
        """
        self._refuse_before_reset()
        refuse_other_state(self, state, len(self.changing) + len(self.replaced))
        scenario = state[len(self.changing) + self.replaced.index("scenario")]
        refuse_other_world(self.scenario, scenario)
        drawn = state[len(self.changing) + self.replaced.index("_drawn_scenario")]
        if drawn is not self._drawn_scenario:
            self._adopt(drawn)
        super().restore(state)

    def render(self) -> ImageArray | None:
        """Return a frame in mode "rgb_array", else None."""
        self._refuse_before_reset()
        if self._renderer is None:
            gymnasium.logger.warn("render shows nothing without a render_mode")
            return None
        return self._renderer.draw() if self.render_mode == "rgb_array" else None

    def show_belief(self, belief: BeliefLike | None) -> None:
        """Show a belief in the following frames; None hides it."""
        if self._renderer is not None:
            self._renderer.show_belief(belief)

    def close(self) -> None:
        """Close the window, if there is one. Further calls have no effect."""
        if self._renderer is not None:
            self._renderer.close()

    def _asked(self, options: Mapping[str, Any]) -> tuple[Scenario, dict[str, Any]]:
        """Return the world that options of `reset` ask for, and how they change it."""
        if not isinstance(options, Mapping):
            raise ValueError(f"options must be a dict, got {short_repr(options)}")
        for name in options:
            if name not in _OPTIONS:
                known = ", ".join(_OPTIONS)
                hint = closest(str(name), _OPTIONS)
                raise ValueError(f"options may hold {known}, got {name!r}{hint}")
        changes: dict[str, Any] = {}
        if "pose" in options:
            changes["start"] = {"pose": _numbers("pose", options["pose"], (3,))}
        if "landmarks" in options:
            shape = self.scenario.landmarks.count, 2
            points = _numbers("landmarks", options["landmarks"], shape)
            changes["landmarks"] = {"layout": "points", "points": points}
        world = load_scenario(options.get("scenario", self.scenario))
        world = world.with_changes(**changes)
        refuse_other_spaces(self.scenario, world, self.fixed)
        return world, changes

    def _adopt(self, scenario: Scenario) -> None:
        """Take the settings of an episode from its scenario."""
        if self._drawn_scenario.walls != scenario.walls:
            radius = self.scenario.robot.radius
            self._body = UnicycleBody(radius, scenario.walls, self._drive)
        self._drawn_scenario = scenario
        self._odometer = OdometrySensor(scenario)
        self._sensor = BearingRangeSensor(scenario)
        self._starts = EpisodeStarts(scenario)
        noise = WorldNoise(scenario)
        self._motion_noise = NoiseRows(noise.motion, getitem)
        self._sensor_noise = NoiseRows(noise.sensor, row_of)

    @property
    def drawn_scenario(self) -> Scenario:
        """The scenario of this episode, with what it drew from ranges."""
        self._refuse_before_reset()
        return self._drawn_scenario

    @property
    def pose(self) -> Array:
        """True (x, y, θ), shape (3,) [m, m, rad], a copy; θ is not wrapped."""
        self._refuse_before_reset()
        return self._body.pose

    @property
    def landmarks(self) -> Array:
        """True positions of this episode's landmarks, shape (N, 2) [m], a copy."""
        self._refuse_before_reset()
        return self._landmarks.copy().view(np.float64).reshape(-1, 2)

    @property
    def start_estimate(self) -> Array:
        """Start pose for a filter, shape (3,) [m, m, rad], a copy.

        Its standard deviations are ``scenario.start.std``.
        """
        self._refuse_before_reset()
        return self._start_estimate.copy()

    def _refuse_before_reset(self) -> None:
        if len(self._landmarks) == 0:
            raise ResetNeeded("call reset first: there is no world yet")

    def _observe(
        self, odometry: Array, collision: bool
    ) -> tuple[Observation, dict[str, Any]]:
        body, noise = self._body, next(self._sensor_noise)
        scan = self._sensor.scan(self._landmarks, body.frame, noise)
        measurements, mask = scan[0][0], scan[1][0]
        info: dict[str, Any] = {"pose": body.pose, "collision": collision}
        if self._hides_identities:
            measurements, mask, info["landmark_ids"] = hide_identities(
                measurements, mask, noise
            )
        if self._pose_sensors.present:
            step = np.array([self.scenario.steps - self._steps_left])
            at = self._pose_sensors.read(self._key, step, body.pose[None])[0]
            info |= self._pose_sensors.by_name(at)
        if self._renderer is not None:
            ids = info.get("landmark_ids")
            clutter = None if ids is None else ids[mask] < 0
            self._renderer.add(body.pose, measurements[mask], collision, clutter)
        return {"landmarks": measurements, "mask": mask, "odometry": odometry}, info


def _numbers(name: str, value: object, shape: tuple[int, ...]) -> list[Any]:
    """Return an option of `reset` as lists of finite numbers."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of several lengths
        array = np.array(np.nan)
    is_real = array.dtype.kind in "iuf"
    if array.shape != shape or not (is_real and np.isfinite(array).all()):
        raise ValueError(
            f"options['{name}'] must be finite numbers of shape {shape}, "
            f"got {short_repr(value)}"
        )
    numbers: list[Any] = array.astype(np.float64).tolist()
    return numbers


def refuse_other_spaces(own: Scenario, asked: Scenario, fixed: Sequence[str]) -> None:
    """Refuse the world of an episode that differs in what is fixed, or in its spaces.

    Without a finite range, the readings at the start have to fit.
    """
    for name in fixed:
        needed, given = map(attrgetter(name), (own, asked))
        if needed != given:
            raise ValueError(
                f"options['scenario'] must have {name} = {short_repr(needed)}, as the "
                f"environment, got {short_repr(given)}"
            )
    if math.isinf(asked.sensor.max_range):
        away = possible_positions(asked.landmarks) - asked.start.pose[:2]
        reach = max(asked.sensor.min_range + 1.0, np.linalg.norm(away, axis=1).max())
        asked = asked.with_changes(sensor={"max_range": float(reach)})
    spaces = observation_space(own), observation_space(asked)
    for name in ("landmarks", "odometry"):
        bounds: list[Any] = [space[name] for space in spaces]
        most, given = (float(each.high.max()) for each in bounds)
        if given > most:
            raise ValueError(
                f"options must keep '{name}' in the observation space, up to "
                f"{most:.6g}, got {given:.6g}"
            )


def refuse_other_world(own: Scenario, other: Scenario) -> None:
    """Refuse the state of a world of another scenario, and name a difference."""
    if own is not other and own != other:
        raise ValueError(f"state must be of the same world: {own.difference(other)}")
