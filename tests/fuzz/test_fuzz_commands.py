"""Command lines, in this process: each ends with an answer or one line of refusal."""

from fuzzing import words
from hypothesis import strategies as st
from typer.main import get_command
from typer.testing import CliRunner

from slamgym.experiments.command_line import run_files
from slamgym.experiments.command_line.app import main

COMMANDS = get_command(main).commands
LEFT_OUT = {"--help", "--address", "--backend", "--jobs", "--open", "--install"}
LEFT_OUT |= {"--show", "--live", "--threads"}
OPTIONS = {
    name: sorted(
        option
        for parameter in command.params
        for option in parameter.opts
        if option.startswith("--") and option not in LEFT_OUT
    )
    for name, command in COMMANDS.items()
}
VALUES = (
    *("six_landmarks", "six_landmarks", "log.csv", "bad.csv", "bad.toml", "."),
    *("ekf", "ekf,invariant", "ekf[iterations=2]", "ekf[", "x:y", "..:x", "ekf,ekf"),
    *("out", "out/deep", "log.csv/x", "film.gif", "2", "1", "0", "3,4", "1e9"),
    *("--json", "--fresh", "--steps", "2", "sensor.std=0", "steps=3", "a.b=[[["),
)
LOG = """# format: slamlog 1
# motion_std: 0.1,0.1,0.05
# measurement_std: 0.02,0.1
measurement,0,7,0.01,5.1
odometry,1,1,0,1
measurement,1,7,-0.01,4.1
"""
values = st.one_of(st.sampled_from(VALUES), words.filter(lambda word: "/" not in word))


@st.composite
def command_lines(draw):
    """Return a command with a few options and values."""
    name = draw(st.sampled_from([*sorted(COMMANDS), "nonsense"]))
    line = [name, *draw(st.lists(values, max_size=2))]
    for option in draw(
        st.lists(st.sampled_from(OPTIONS.get(name) or ["--x"]), max_size=3)
    ):
        line += [option, *draw(st.lists(values, max_size=1))]
    return line


def test_command_lines_answer_or_refuse_in_one_line(fuzzer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_files, "write_figures", lambda *_, **__: None)
    (tmp_path / "log.csv").write_text(LOG)
    (tmp_path / "bad.csv").write_text(LOG + "measurement,x")
    (tmp_path / "bad.toml").write_text("name = [")

    def call(line):
        result = CliRunner().invoke(main, line)
        said = result.stderr
        assert result.exit_code in (0, 1, 2), (line, result.exception)
        assert "internal error" not in said, (line, said)
        assert "Traceback" not in said, line
        if result.exit_code:
            assert said.strip(), line

    fuzzer.check(call, command_lines(), few=20)
