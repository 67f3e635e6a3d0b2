"""Every option of a command reaches its work, and every command reports its files."""

import contextlib
import inspect
import json
import re
from importlib import import_module
from pathlib import Path
from types import GeneratorType, MethodType

import pytest
from commands import slamgym
from matplotlib.figure import Figure
from recordings import recorded

from slamgym.experiments import figures
from slamgym.experiments.command_line import commands
from slamgym.experiments.command_line.monte_carlo import connected
from slamgym.experiments.command_line.options import Options
from slamgym.experiments.job_folders import files_below
from slamgym.experiments.logs.slamlog import SlamLog, write_slamlog
from slamgym.experiments.run_and_replay.filter_settings import FilterSettings
from slamgym.sim_configs import Scenario

pytestmark = pytest.mark.usefixtures("here")
LOG = """# format: slamlog 1
# name: little
# motion_std: 0.1,0.1,0.05
# measurement_std: 0.02,0.1
measurement,0,7,0.01,5.1
odometry,1,1,0,1
measurement,1,7,-0.01,4.1
"""
NOISE = "--motion-std .1,.2,.3 --measurement-std .4,.5 --initial-pose-std .6,.7,.8"
NOISE += " --range-std-per-metre .01 --noise-at-rest"
#: A command, the function that works for it, and its arguments.
COMMANDS = """
run loop
  → experiments.command_line.run_files.filter_and_write log=loop
    filters=invariant=invariant/0.00884,0,0.0354/0.0349,0.1/0.0001,0.0001,0.0001
    given=0/open_loop/None/0 world=loop/1005/1
run loop -e ekf,invariant --option min_range=2 --seed 5 --steps 9 --controller random
  --set dt=0.5 --out mine --every-step --resolution 0.5
  → experiments.command_line.run_files.filter_and_write log=loop
    filters=ekf=ekf/0.00884,0,0.0354/0.0349,0.1/0.0001,0.0001,0.0001[min_range=2]
    invariant=invariant/0.00884,0,0.0354/0.0349,0.1/0.0001,0.0001,0.0001[min_range=2]
    given=5/random/True/0.5 world=loop/9/0.5
replay little.csv
  → experiments.command_line.run_files.filter_and_write log=little
    filters=invariant=invariant/0.1,0.1,0.05/0.02,0.1/0,0,0[noise_at_rest=False]
    given=0/open_loop/None/0
replay little.csv -e ekf NOISE --landmark-init independent --gate-probability 0.9
  --option min_range=2 --hide-identities --resolution 0.5 --no-every-step
  → experiments.command_line.run_files.filter_and_write log=little/hidden
    filters=ekf=ekf/0.1,0.2,0.3/0.4,0.5/0.6,0.7,0.8[noise_at_rest=True management=True
    landmark_init=independent gate_probability=0.9 range_std_per_metre=0.01 min_range=2]
    given=0/open_loop/False/0.5
smooth little.csv
  → experiments.run_and_replay.smooth_log log=little
    settings=SmoothingSlam/0.1,0.1,0.05/0.02,0.1/0,0,0[noise_at_rest=False
    follow=invariant] associate=False progress=filtering repairing=filtering
smooth little.csv -e ekf NOISE --robust huber --associate --gate-probability 0.9
  --option iterations=2
  → experiments.run_and_replay.smooth_log log=little
    settings=SmoothingSlam/0.1,0.2,0.3/0.4,0.5/0.6,0.7,0.8[noise_at_rest=True
    robust=huber gate_probability=0.9 range_std_per_metre=0.01 iterations=2 follow=ekf]
    associate=True progress=filtering repairing=filtering
fit-noise little.csv
  → experiments.noise_fitting.fit_noise log=little
    settings=invariant/0.1,0.1,0.05/0.02,0.1/0,0,0[noise_at_rest=False] progress=fitting
fit-noise little.csv -e ekf NOISE --option min_range=2 --hide-identities
  → experiments.noise_fitting.fit_noise log=little/hidden
    settings=ekf/0.1,0.2,0.3/0.4,0.5/0.6,0.7,0.8[noise_at_rest=True management=True
    range_std_per_metre=0.01 min_range=2] progress=fitting
monte-carlo loop
  → experiments.monte_carlo_study.monte_carlo scenario=loop/1005/1
    estimators=ekf,invariant runs=200 seed=0 assumed=loop/1005/1
    out=results/monte-carlo-loop block_size=64 first_run=0 fresh=False resolution=0
    progress=running-runs
monte-carlo loop -e ekf --runs 9 --until decided --seed 5 --steps 7 --set dt=0.5
  --assume dt=0.25 --resolution 0.5 --jobs 2 --backend dask --scheduler tcp://b:1
  --block-size 3 --first-run 6 --fresh --out mine
  → experiments.monte_carlo_study.monte_carlo scenario=loop/7/0.5 estimators=ekf runs=9
    seed=5 until=decided assumed=loop/7/0.25 out=mine jobs=2 backend=dask block_size=3
    first_run=6 fresh=True resolution=0.5 progress=running-runs cluster=tcp://b:1,2
generate loop --episodes 3
  → experiments.trajectories.generate_trajectories scenario=loop/1005/1
    out=results/loop-waypoints-npz episodes=3 controller=waypoints seed=0 format=npz
    progress=driving-steps
generate loop --episodes 3 --controller random --seed 5 --format g2o --shard 7
  --smallest-std .01 -e ekf --jobs 2 --backend dask --scheduler tcp://b:1 --steps 9
  --set dt=0.5 --out mine
  → experiments.trajectories.generate_trajectories scenario=loop/9/0.5 out=mine
    episodes=3 controller=random seed=5 format=g2o episodes_per_shard=7
    smallest_std=0.01 estimator=ekf jobs=2 backend=dask progress=driving-steps
    cluster=tcp://b:1,2
judge little.csv
  → experiments.judging.judge estimates=little.csv
judge a b --drives c --truth d --truth e --covariances left --align 1,2,3
  → experiments.judging.judge estimates=a,b drives=c truth=d,e covariances=left
    align=1,2,3
judge a --truth b --space left
  → experiments.space_poses.judge_in_space estimates=a truth=b covariances=left
    order=translation-first
judge a b --truth c --space right,rotation-first
  → experiments.space_poses.judge_in_space estimates=a,b truth=c covariances=right
    order=rotation-first
benchmark
  → experiments.consistency_protocol.score_filters estimators=ekf,invariant
    progress=running-worlds
benchmark -e ekf
  → experiments.consistency_protocol.score_filters estimators=ekf
    progress=running-worlds
noise-study little.csv
  → experiments.noise_study.study_log log=little
    settings=invariant/0.1,0.1,0.05/0.02,0.1/0,0,0[noise_at_rest=False]
    progress=filtering
noise-study little.csv -e ekf NOISE --landmark-init independent --gate-probability 0.9
  --option min_range=2 --hide-identities
  → experiments.noise_study.study_log log=little/hidden
    settings=ekf/0.1,0.2,0.3/0.4,0.5/0.6,0.7,0.8[noise_at_rest=True management=True
    landmark_init=independent gate_probability=0.9 range_std_per_metre=0.01 min_range=2]
    progress=filtering
noise-study loop
  → experiments.noise_study.study_scenario scenario=loop/1005/1
    record=0/open_loop/None/0 estimator=invariant options= progress=filtering
noise-study loop -e ekf --option min_range=2 --gate-probability .9 --seed 5 --steps 9
  --controller random --set dt=0.5
  → experiments.noise_study.study_scenario scenario=loop/9/0.5 record=5/random/None/0
    estimator=ekf options=gate_probability=0.9 min_range=2 progress=filtering
noise-study loop --runs 3
  → experiments.noise_study.noise_effects scenario=loop/1005/1 estimators=invariant
    runs=3 seed=0 changed=both,world,filter progress=running-runs
noise-study loop --runs 3 -e ekf,invariant[min_range=1] --option min_range=2
  --landmark-init independent --seed 5 --steps 9 --set dt=0.5 --change world --jobs 2
  → experiments.noise_study.noise_effects scenario=loop/9/0.5
    estimators=ekf[landmark_init="independent",min_range=2],invariant[min_range=1,landmark_init="independent"]
    runs=3 seed=5 changed=world jobs=2 progress=running-runs
explore loop
  → experiments.noise_explorer.explore_noise scenario=loop/1005/1
    estimators=ekf,invariant runs=100 seed=0 change=filter progress=running-runs
explore loop -e ekf --runs 9 --seed 5 --steps 7 --set dt=0.5 --change both
  → experiments.noise_explorer.explore_noise scenario=loop/7/0.5 estimators=ekf runs=9
    seed=5 change=both progress=running-runs
render loop --out film.gif
  → envs.rendering.write_video frames=scenario=loop/1005/1
    settings=invariant/0.00884,0,0.0354/0.0349,0.1/0.0001,0.0001,0.0001 driver=OpenLoop
    seed=0 tick=filming path=film.gif fps=30
render loop --out film.gif --steps 120 -e none
  → envs.rendering.write_video frames=scenario=loop/120/1 driver=OpenLoop seed=0
    tick=filming path=film.gif fps=10
render loop --out film.gif -e ekf --option min_range=2 --seed 5 --steps 9 --controller
  random --set dt=0.5 --fps 3
  → envs.rendering.write_video frames=scenario=loop/9/0.5
    settings=ekf/0.00884,0,0.0354/0.0349,0.1/0.0001,0.0001,0.0001[min_range=2]
    driver=RandomWalk seed=5 tick=filming path=film.gif fps=3
"""
REACHED = {
    command.replace("NOISE", NOISE): each.split(" ", 1)
    for block in re.split(r"\n(?=\w)", COMMANDS)[1:]
    for command, each in [" ".join(block.split()).split(" → ")]
}
UNCOMPARED = ("command", "folder", "reporter", "small_noise")


class Bar(contextlib.nullcontext):
    """A progress bar that shows nothing."""

    def __init__(self, doing, unit, console):
        super().__init__(self)
        self.texts = doing, unit

    def __call__(self, done, of):
        pass


@pytest.mark.parametrize("command", REACHED)
def test_every_option_reaches_the_work(command, monkeypatch, here):
    place, expected = REACHED[command]
    module, _, name = f"slamgym.{place}".rpartition(".")
    work, given = getattr(import_module(module), name), []

    def listen(*arguments, **named):
        given.append(inspect.signature(work).bind(*arguments, **named).arguments)
        raise ValueError("that is enough")

    monkeypatch.setattr(commands, "progress_bar", Bar)
    monkeypatch.setattr(f"{module}.{name}", listen)
    joined = {}
    monkeypatch.setattr(
        f"{connected.__module__}._dask_client",
        lambda *cluster: contextlib.nullcontext(joined.update(cluster=cluster)),
    )
    (here / "little.csv").write_text(LOG)
    assert slamgym(*command.split()).stderr.endswith("slamgym: that is enough\n")
    assert words(compared(given[-1]) | joined) == expected
    if " -" not in command:  # what Python assumes, too
        parameters = compared(inspect.signature(work).parameters)
        usual = {name: each.default for name, each in parameters.items()}
        plain = {k: v for k, v in usual.items() if type(v) in (str, int, float)}
        assert plain == {name: given[-1].get(name, plain[name]) for name in plain}


def words(value):
    """Write an argument in few words."""
    for kind, written in WORDS.items():
        if isinstance(value, kind):
            return written(value)
    plain = isinstance(value, str | int | Path | None)
    return str(value) if plain else type(value).__name__


def of_settings(settings):
    stds = settings.motion_std, settings.measurement_std, settings.initial_pose_std
    options = f"[{words(settings.options)}]" * bool(settings.options)
    name = settings.estimator.rpartition(":")[2]
    return f"{name}/{'/'.join(map(words, stds))}{options}"


def of_options(given):
    names = "seed", "controller", "every_step", "resolution"
    return "/".join(words(getattr(given, name)) for name in names)


def compared(given):
    named = {k: v for k, v in given.items() if k not in UNCOMPARED}
    return {k: v for k, v in named.items() if v is not None}


WORDS = {
    dict: lambda found: " ".join(f"{k}={words(v)}" for k, v in found.items()),
    list | tuple: lambda found: ",".join(map(words, found)),
    float: "{:.3g}".format,
    Bar: lambda bar: "-".join(filter(None, bar.texts)),
    Scenario: lambda world: f"{world.name}/{world.steps}/{world.dt:g}",
    SlamLog: lambda log: log.name + "/hidden" * ("identities" in log.header),
    FilterSettings: of_settings,
    Options: of_options,
    GeneratorType: lambda frames: words(compared(frames.gi_frame.f_locals)),
    MethodType: lambda method: words(method.__self__),
}


#: A command, and its folder by default.
FOLDERS = {
    "run six_landmarks --steps 3": "six_landmarks-invariant",
    "replay little.csv -e ekf,invariant": "little-ekf-invariant",
    "smooth little.csv": "little-smoother",
    "fit-noise longer.csv": "six_landmarks-noise",
    "noise-study little.csv -e ekf": "noise-study-little-ekf",
    "noise-study six_landmarks --steps 3 -e ekf": "noise-study-six_landmarks-ekf",
    "noise-study six_landmarks --steps 3 --runs 2 -e ekf --change filter": (
        "noise-study-six_landmarks-2-runs"
    ),
    "monte-carlo six_landmarks --steps 3 --runs 2 -e ekf": "monte-carlo-six_landmarks",
    "judge drives": "judge-six_landmarks",
}


@pytest.mark.usefixtures("_no_figures_in_reports")
@pytest.mark.parametrize("command", FOLDERS)
def test_every_command_reports_the_files_that_it_writes(command, monkeypatch, here):
    monkeypatch.setattr(figures, "save_figure", lambda _, path, **__: path.touch())
    for name in ("noise_study_figure", "map_figure"):
        monkeypatch.setattr(figures, name, lambda _, **__: Figure())
    monkeypatch.setattr(figures, "map_sequence", lambda *_, **__: None)
    (here / "little.csv").write_text(LOG)
    if "longer" in command:
        write_slamlog(recorded("six_landmarks", 3, steps=30), here / "longer.csv")
    if "drives" in command:
        world = ("six_landmarks", "--steps", 3, "--episodes", 2, "-e", "ekf")
        slamgym("generate", *world, "--out", "drives")
    out = Path("results", FOLDERS[command])
    monkeypatch.setattr("sys.argv", ["/bin/slamgym", *command.split()])
    done = slamgym(*command.split())
    assert done.exit_code == 0, done.stderr
    summary = json.loads((out / "summary.json").read_text())
    below = [name for name in files_below(out) if "blocks/" not in name]
    assert sorted(summary["files"]) == sorted({*below} - {"job.json"})
    end = done.stdout.partition(f"Wrote {out}/")[2].split("Test with")[0]
    for name in summary["files"]:
        assert (name if "/" not in name else name.split("/")[0]) in end
    answer = json.loads(slamgym(*command.split(), "--json").stdout)
    assert answer.pop("out") == str(out)
    assert not answer.pop("written", False)
    typed = f"slamgym {command}"
    assert summary.get("command", typed) == typed
    assert answer == summary
